"""A thread for calculations that would hold up the event loop, with a limit on how many may wait for it."""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final, ParamSpec, Self, TypeVar

from prometheus_client import Gauge, Histogram

P = ParamSpec("P")
T = TypeVar("T")

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
