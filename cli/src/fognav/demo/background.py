"""Background tasks of a drive, and waiting that notices when one of them has failed."""

import asyncio
import time
from collections.abc import Callable, Coroutine
from types import TracebackType
from typing import Any, Final, Self

_PERIOD_S: Final = 0.05


class Background:
    """Runs coroutines as tasks beside the body of its context, and cancels them at its end."""

    def __init__(self, *coroutines: Coroutine[Any, Any, None]) -> None:
        self._coroutines = coroutines
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(coroutine) for coroutine in self._coroutines]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def check(self) -> None:
        """Raise the exception of a task that has failed."""
        for task in self._tasks:
            if task.done():
                task.result()

    async def until(
        self, condition: Callable[[], bool], timeout_s: float, description: str, situation: Callable[[], str]
    ) -> None:
        """Wait until the condition holds; raises `TimeoutError` with the situation after `timeout_s` real seconds."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            self.check()
            if time.monotonic() > deadline:
                raise TimeoutError(f"timeout after {timeout_s:.0f} s, waiting until {description}; {situation()}")
            await asyncio.sleep(_PERIOD_S)
