"""The planner's threads, and the bounded queue of long answers: one at a time, the most important first.

Whatever runs here never delays planning: it is work for another thread. Who asks too much is told to come back later.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal, TypeVar

from prometheus_client import Counter, Gauge

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

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


Kind = Literal["map", "egress", "explanation", "plan", "dry_run"]

PRIORITY: Final[dict[Kind, int]] = {"map": 0, "egress": 1, "explanation": 2, "plan": 3, "dry_run": 4}
"""The order of answers: a robot that wants out comes before people who want to know."""
WAITING: Final[dict[Kind, int]] = {"map": 1, "egress": 64, "explanation": 1, "plan": 16, "dry_run": 8}
"""How many may be in the queue, with the one that runs."""
PER_ASKER: Final[dict[Kind, int]] = {"map": 1, "egress": 2, "explanation": 1, "plan": 4, "dry_run": 1}
"""How many of them may be of one asker."""
RETRY_AFTER_S: Final = 1.0
BUSY_PAUSE_S: Final = 0.25
"""Who is refused by REST is told so after a pause: clients that ask again at once would keep the event loop busy."""

REFUSED = Counter(
    "fognav_planner_queries_refused_total", "Queries refused because too many were waiting, by kind", ["kind"]
)
WAITING_NOW = Gauge("fognav_planner_queries_waiting", "Queries that wait for their answer, by kind", ["kind"])


class BusyError(Exception):
    """Too many queries are waiting; the text says whose. Ask again after `retry_after` (s)."""

    def __init__(self, text: str, retry_after: float = RETRY_AFTER_S) -> None:
        super().__init__(text)
        self.retry_after = retry_after


@dataclass(order=True)
class _Entry:
    priority: int
    number: int
    kind: Kind = field(compare=False)
    asker: str = field(compare=False)
    work: Callable[[], Awaitable[Any]] = field(compare=False)
    answer: asyncio.Future[Any] = field(compare=False)


class QueryQueue:
    """Runs answers one after another, as tasks of the event loop on which it is used."""

    def __init__(self, threads: Threads, on_idle: Callable[[], object] | None = None) -> None:
        """`on_idle` runs on the thread `query` whenever all have been answered."""
        self._on_idle = on_idle
        self.threads = threads
        """Where the work runs: what is on `query` comes from this queue alone."""
        self._waiting: list[_Entry] = []
        self._admitted: dict[tuple[Kind, str], int] = {}
        self._numbers = itertools.count()
        self._worker: asyncio.Task[None] | None = None

    async def run(self, kind: Kind, asker: str, work: Callable[[], Awaitable[T]]) -> T:
        """Return the result of `work` when its turn has come; raises `BusyError` when too many are waiting."""
        self._admit(kind, asker)
        answer: asyncio.Future[T] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._waiting, _Entry(PRIORITY[kind], next(self._numbers), kind, asker, work, answer))
        if self._worker is None or self._worker.done():
            self._worker = asyncio.get_running_loop().create_task(self._work(), name="queries")
        return await answer

    def close(self) -> None:
        """Answer nothing more."""
        if self._worker is not None:
            self._worker.cancel()
        for entry in self._waiting:
            entry.answer.cancel()

    def _admit(self, kind: Kind, asker: str) -> None:
        own = self._admitted.get((kind, asker), 0)
        total = sum(count for (other, _), count in self._admitted.items() if other == kind)
        problem = ""
        if own >= PER_ASKER[kind]:
            problem = f"{own} of your queries are waiting already"
        elif total >= WAITING[kind]:
            problem = f"{total} queries are waiting already"
        if problem:
            REFUSED.labels(kind).inc()
            raise BusyError(f"the planner is busy: {problem}; try again in {RETRY_AFTER_S:.0f} s")
        self._admitted[kind, asker] = own + 1
        WAITING_NOW.labels(kind).inc()

    def _release(self, entry: _Entry) -> None:
        key = entry.kind, entry.asker
        self._admitted[key] -= 1
        if not self._admitted[key]:
            del self._admitted[key]
        WAITING_NOW.labels(entry.kind).dec()

    async def _work(self) -> None:
        while self._waiting:
            await self._answer_all()
            if self._on_idle is not None:
                await self.threads.run("query", self._on_idle)

    async def _answer_all(self) -> None:
        while self._waiting:
            entry = heapq.heappop(self._waiting)
            try:
                if not entry.answer.done():  # an asker that has gone needs no answer
                    result = await entry.work()
                    if not entry.answer.done():
                        entry.answer.set_result(result)
            except Exception as error:  # noqa: BLE001  # the asker gets it
                if not entry.answer.done():
                    entry.answer.set_exception(error)
            finally:
                self._release(entry)
