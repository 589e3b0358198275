"""The planner's threads: one for the core, one for distance fields, one for long answers."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Literal, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

T = TypeVar("T")

ThreadName = Literal["core", "field", "query"]


class Threads:
    """Runs functions on named threads; each thread runs one at a time. The kernels release the GIL."""

    def __init__(self) -> None:
        names: tuple[ThreadName, ...] = ("core", "field", "query")
        self._threads = {name: ThreadPoolExecutor(1, thread_name_prefix=f"planner {name}") for name in names}

    async def run(self, thread: ThreadName, function: Callable[[], T]) -> T:
        """Return the function's result, or raise its exception."""
        return await asyncio.get_running_loop().run_in_executor(self._threads[thread], function)

    def close(self) -> None:
        """Shut the threads down once their current work is done."""
        for thread in self._threads.values():
            thread.shutdown(wait=False, cancel_futures=True)
