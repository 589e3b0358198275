"""The planning cycle: the core's queued messages, its searches, and the publications, each as soon as it is ready."""

from __future__ import annotations

import time
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from prometheus_client import Histogram

from fog_contracts.handlers import RefusedMessageError
from fog_runtime import logs, metrics

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from planner.core import Job, PlannerCore

    Emit = Callable[[Sequence[Publication]], object]

T = TypeVar("T")

MOST_SEARCHING_S: Final = 0.05
"""After so long the searches that are left wait for the next cycle, if an urgent message has come meanwhile ..."""
LONGEST_SEARCHING_S: Final = 0.1
"""... and after so long in any case. The next cycle handles newer messages first, which holds the searches up."""

_BUCKETS: Final = (0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0)
CYCLE_SECONDS = Histogram(
    "fognav_plan_cycle_seconds",
    "Duration of one planning cycle: its messages and its path searches",
    buckets=_BUCKETS,
)
STEP_SECONDS = Histogram(
    "fognav_plan_cycle_step_seconds",
    "Duration of the steps of a planning cycle (messages, searches, publications)",
    ["step"],
    buckets=_BUCKETS,
)

_log = logs.get("planner")


@dataclass(frozen=True)
class CycleResult:
    """What one cycle leaves to do; `unfinished`: searches are left for the next one."""

    reached: list[tuple[str, str]]
    jobs: list[Job]
    wants_snapshot: bool
    unfinished: bool


class Cycle:
    """The core on its thread. Messages may be queued on another thread while it runs."""

    def __init__(self, core: PlannerCore, zenoh: ZenohEdge) -> None:
        self._core = core
        self._zenoh = zenoh
        self._inputs: deque[Callable[[], Sequence[Publication]]] = deque()
        self._goal_changes: deque[Callable[[], object]] = deque()
        self._urgent_waits = False
        self.steps = 0
        """How many searches, and rounds of messages, have ended: while it grows, the thread does not hang."""

    def queue_message(self, channel: Channel, handler: Handler, ids: Ids, message: object, at: Moment) -> None:
        """Queue a message, with its time of arrival, for the next cycle."""
        self._inputs.append(partial(self._handle, channel, handler, ids, message, at))
        if channel in self._core.URGENT:
            self._urgent_waits = True

    def queue_job(self, job: Job, now: float) -> None:
        """Queue the result of a job for the next cycle."""

        def add() -> Sequence[Publication]:
            self._core.add(job, now)
            return ()

        self._inputs.append(add)

    def change_goal(self, change: Callable[[], object]) -> None:
        """Queue a change of a goal: it takes effect before anything else is published."""
        self._goal_changes.append(change)

    def run(self, now: Callable[[], Moment], emit: Emit) -> CycleResult:
        """Run one cycle on the core's thread; `emit` is called with publications as soon as they are ready."""
        with CYCLE_SECONDS.time():
            core = self._core
            self._urgent_waits = False  # before they are handled, so that none that comes meanwhile is missed
            with _timed("messages"):
                for publications in _run_all(self._inputs):
                    emit(publications)
                self.steps += 1
                _run_all(self._goal_changes)
            with _timed("searches"):
                unfinished = self._search(now, emit)
            with _timed("publications"):
                _run_all(self._goal_changes)
                at = now()
                emit(core.publish(at))
            return CycleResult(
                core.missions.pop_reached(), core.jobs(at), core.wants_snapshot(at.now), unfinished=unfinished
            )

    def _search(self, now: Callable[[], Moment], emit: Emit) -> bool:
        """Search until all is planned or the time is up; return whether something is left."""
        begun = now()
        for robot in self._core.plan(begun):
            _run_all(self._goal_changes)
            at = now()
            emit(self._core.publish_for(robot, at))
            self.steps += 1
            if at.now - begun.now >= (MOST_SEARCHING_S if self._urgent_waits else LONGEST_SEARCHING_S):
                return True
        return False

    def _handle(
        self, channel: Channel, handler: Handler, ids: Ids, message: object, at: Moment
    ) -> Sequence[Publication]:
        """Run a handler on the core's thread; a refused message is counted and logged as by the edge."""
        try:
            return handler(ids, message, at)
        except RefusedMessageError as error:
            self._zenoh.refuse(channel, channel.pattern(**ids), str(error))
        except Exception as error:  # noqa: BLE001  # one message must not end the process; the bug is logged
            metrics.HANDLER_ERRORS.labels(channel.name).inc()
            _log.error("handler_failed", error=error, channel=channel.name, key=channel.pattern(**ids))
        return ()


@contextmanager
def _timed(step: str) -> Iterator[None]:
    begun = time.perf_counter()
    yield
    STEP_SECONDS.labels(step).observe(time.perf_counter() - begun)


def _run_all(queued: deque[Callable[[], T]]) -> list[T]:
    """Run the functions queued by now, oldest first, and return their results.

    The event loop may append meanwhile: that waits for the next cycle, so that a flood can't put planning off.
    """
    return [queued.popleft()() for _ in range(len(queued))]
