"""What all measured systems have in common: parts that are started one by one, and ended together."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine


class RunningSystem(ABC):
    """A system that runs while its context is open; what `start` entered ends with it, also when `start` fails."""

    def __init__(self) -> None:
        self._contexts = AsyncExitStack()

    @abstractmethod
    async def _start(self) -> None:
        """Start the parts, each entered into `_contexts`."""

    async def __aenter__(self) -> Self:
        try:
            await self._start()
        except BaseException:
            await self._contexts.aclose()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._contexts.aclose()


@asynccontextmanager
async def in_background(work: Coroutine[None, None, None], name: str) -> AsyncIterator[None]:
    """Run a loop while the context is open, and cancel it then; raises what the loop raised."""
    task = asyncio.create_task(work, name=name)
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def first_child(pid: int) -> int | None:
    """Return the id of the first child of a process's main thread, such as the watchdog's guardian; None without one.

    Raises `FileNotFoundError` for a process that has ended.
    """
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text("ascii").split()
    return int(children[0]) if children else None
