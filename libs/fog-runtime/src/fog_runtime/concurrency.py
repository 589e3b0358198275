"""One-slot queues, a worker thread with a limit, and cancellations that got lost in a library."""

from __future__ import annotations

import asyncio
import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Final, Generic, ParamSpec, Self, TypeVar

from prometheus_client import Gauge, Histogram

if TYPE_CHECKING:
    from collections.abc import Callable


def raise_if_cancelled() -> None:
    """Go on with a cancellation of the current task that a library swallowed, or replaced by an error of its own.

    Libraries do so when they disconnect while they are cancelled, and `asyncio.wait_for` (Python 3.11) when its wait
    ends at that moment. A loop that went on would never end, nor would its process.
    """
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


T = TypeVar("T")


class Slot(Generic[T]):
    """Holds the newest value and when it arrived, by the receiver's own monotonic clock.

    For one event loop: call `put` only on the loop's thread.
    """

    def __init__(self) -> None:
        self._value: T | None = None
        self._arrived_at = -math.inf
        self._count = 0
        self._waiters: list[asyncio.Future[None]] = []

    @property
    def count(self) -> int:
        """How many values were put so far."""
        return self._count

    def put(self, value: T, now: float) -> None:
        """Replace the value and wake all waiters."""
        self._value = value
        self._arrived_at = now
        self._count += 1
        waiters, self._waiters = self._waiters, []
        for waiter in waiters:
            if not waiter.done():
                waiter.set_result(None)

    def get(self) -> T | None:
        """Return the newest value, however old, or None before the first."""
        return self._value

    def age(self, now: float) -> float:
        """Seconds since the newest value arrived; infinite before the first."""
        return now - self._arrived_at

    async def wait(self) -> T:
        """Wait for a newer value than the current one, and return the newest."""
        waiter = asyncio.get_running_loop().create_future()
        self._waiters.append(waiter)
        try:
            await waiter
        finally:
            if waiter in self._waiters:
                self._waiters.remove(waiter)
        assert self._value is not None
        return self._value


P = ParamSpec("P")

QUEUED: Final = Gauge("fognav_worker_queue", "Calculations that run or wait on a worker thread", ["worker"])
SECONDS: Final = Histogram(
    "fognav_worker_seconds",
    "Time from the request of a calculation to its result, with the wait for the thread",
    ["worker"],
    buckets=(0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0),
)


class BusyError(Exception):
    """Too many calculations wait for a worker already; try again later."""


class Worker:
    """Runs functions one after another on a thread of its own; close it, or use it as a context manager.

    For functions that spend their time in NumPy, in compiled kernels or in compression, which let the event loop run
    meanwhile. Call it on the event loop's thread only.
    """

    def __init__(self, name: str, *, limit: int) -> None:
        """Start with at most `limit` calculations running and waiting; `name` labels the metrics."""
        self._name = name
        self._limit = limit
        self._queued = 0
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Accept nothing more; what runs is not waited for."""
        self._thread.shutdown(wait=False, cancel_futures=True)

    async def run(self, function: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
        """Return what the function returns, or raise what it raises; raises `BusyError` when too many wait."""
        if self._queued >= self._limit:
            raise BusyError(f"{self._queued} calculations wait for the {self._name} thread")
        loop = asyncio.get_running_loop()
        begun = loop.time()
        self._queued += 1
        QUEUED.labels(self._name).set(self._queued)
        # Counted until it has really ended: a request that was cancelled leaves its calculation running.
        future = loop.run_in_executor(self._thread, partial(function, *arguments, **options))
        future.add_done_callback(lambda _: self._ended(loop.time() - begun))
        return await asyncio.shield(future)

    def _ended(self, seconds: float) -> None:
        self._queued -= 1
        QUEUED.labels(self._name).set(self._queued)
        SECONDS.labels(self._name).observe(seconds)
