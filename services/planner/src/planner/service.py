"""Runs the core: passes messages to its thread, publishes what it returns, and runs its jobs on other threads.

The core runs on a thread of its own, one cycle after another (`Cycle`), so that a search never delays the event loop,
and nothing but searches of robots' paths runs there: distance fields are computed on a second thread; plans on
request, reasons of refusals and snapshots of the map on a third. Inputs are timestamped on arrival, during cycles too.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

from prometheus_client import Histogram

from fog_contracts import channels as ch
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import PlanReply, RobotPath, RobotPose, RobotState
from fog_contracts.site import Site
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from fog_runtime.transports.edges import Edges
from fog_runtime.transports.zenoh_declarations import ASKER
from planner.dock_missions import DockMissions
from planner.dry_run_queue import DryRuns
from planner.lifts.riding import Riding
from planner.plan_records import PathRecord, PlanMetrics
from planner.query_queue import BUSY_PAUSE_S, BusyError, QueryQueue, Threads
from planner.refusals import busy
from planner.robot_operator import RobotOperator
from planner.schedules.persistence import SchedulePersistence
from planner.schedules.scheduling import Scheduling
from planner.snapshot_fetcher import SnapshotFetcher
from planner.visiting import Visiting

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import (
        DryRunReply,
        DryRunRequest,
        EgressRequest,
        Message,
        Place,
        PlanRequest,
        Refusal,
    )
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.records import AuditEntry
    from fog_runtime.transports.edges import Gate
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from planner.core import Job, PlannerCore
    from planner.stops import Order
    from planner.store import Store, StoredGoal

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


TICK_S: Final = 0.1
RECORDED_AT_ONCE: Final = 8
"""Of so many publications the record is made without a pause for jobs, messages and the next cycle."""


class Service:
    """The running planner; its loops are tasks of the process."""

    def __init__(  # noqa: PLR0913  # the process's parts
        self,
        core: PlannerCore,
        store: Store,
        zenoh: ZenohEdge,
        clock: Clock,
        health: Health,
        gate: Gate | None = None,
        *,
        key: bytes | None = None,
        site: Site = Site(id="none"),  # noqa: B008  # frozen
        synchronized: Callable[[], bool] = lambda: True,
    ) -> None:
        """Prepare; `gate` decides who leads, `key` signs commands, `synchronized` tells if the time of day is right."""
        self._core = core
        self._store = store
        self._zenoh = zenoh
        self._gate = gate
        self._edges = Edges(clock, zenoh=zenoh, gate=gate, synchronized=synchronized)
        self._clock = clock
        self._health = health
        self._wake = asyncio.Event()
        self._threads = Threads()
        self._queue = QueryQueue(self._threads, on_idle=core.answerer.release)
        self.dry_runs = DryRuns(core, self._queue, clock.now)
        self._cycle = Cycle(core, zenoh)
        self.missions = SchedulePersistence(core, store, clock, health, self._change_goal, self.path, synchronized)
        self.snapshots = SnapshotFetcher(core, zenoh, clock, health, self._queue, on_loaded=self._wake.set)
        self.operator = RobotOperator(zenoh, store, clock, key)
        self._docks = DockMissions(site.staging, self.send)
        self.visiting = Visiting(self, site, clock)
        self.riding = Riding(self, site, zenoh, clock)
        self.scheduling = Scheduling(self, site, clock, synchronized)
        self._jobs: set[asyncio.Task[None]] = set()
        self._metrics = PlanMetrics()
        self.arrival = core.arrival
        self.poses: dict[str, RobotPose] = {}
        self.states: dict[str, RobotState] = {}
        self._record = PathRecord()

    # --- For the API ------------------------------------------------------------------------------------------------

    @property
    def goals(self) -> dict[str, StoredGoal]:
        """The missions by robot."""
        return self.missions.goals

    @property
    def places(self) -> Mapping[str, Place] | None:
        """All places by id; None until the map-service has told them."""
        return self._core.places

    def stamp(self) -> float:
        """Return the time, s since the epoch."""
        return self._clock.stamp()

    def path(self, robot: str) -> RobotPath | None:
        """Return the last published path or refusal for the robot's current goal, as last released."""
        path, stored = self._record.paths.get(robot), self.goals.get(robot)
        return path if path and stored and path.goal_id == stored.goal.goal_id else None

    async def send(self, order: Order) -> StoredGoal | Refusal:
        """Give a robot a mission; returns a refusal for an unreachable goal.

        An attempt that succeeded before returns its mission again. Raises as `earlier_result` and `send` of `missions`.
        """
        earlier = await self.missions.earlier_result(order.attempt)
        if earlier is not None:
            return earlier
        refusal = await self._threads.run("core", lambda: self._core.check_goal(order.pose.x, order.pose.y))
        return refusal if refusal is not None else await self.missions.send(order)

    async def undoable(self, entry: str, record: str, kinds: Sequence[str]) -> AuditEntry:
        """Return an entry of the audit trail that may be undone; raises `UndoError` and `StoreError`."""
        return await self._store.undoable(entry, record, kinds)

    async def preview(self, request: PlanRequest, asker: str) -> PlanReply:
        """Plan a path without side effects; raises `BusyError` when too many queries are waiting, or of this asker.

        The error comes after a pause: clients that ask again at once would keep the event loop from robots' messages.
        """
        try:
            return await self._queue.run("plan", asker, partial(self._answer, ch.PLANNER_PLAN, request))
        except BusyError:
            await asyncio.sleep(BUSY_PAUSE_S)
            raise

    # --- Messages and queries ---------------------------------------------------------------------------------------

    def subscribe(self) -> None:
        """Register subscriptions and queries."""
        handlers = {channel: self._queued(channel, handler) for channel, handler in self._core.handlers().items()}
        self._edges.subscribe(handlers, self._publish)
        self.riding.subscribe()
        self._zenoh.serve(ch.PLANNER_PLAN, self._serve_plan)
        self._zenoh.serve(ch.PLANNER_EGRESS, self._serve_egress)
        self._zenoh.serve(ch.PLANNER_DRY_RUN, self._serve_dry_run)

    def _queued(self, channel: ch.Channel, handler: Handler) -> Handler:
        """Return a handler that queues its message, with its time of arrival, for the core's next cycle."""

        def enqueue(ids: Ids, message: object, at: Moment) -> Sequence[Publication]:
            if isinstance(message, RobotPose):
                if self.operator.is_doubled(ids["robot"]) or not self.missions.is_here(ids["robot"]):
                    return ()  # nobody knows whose it is: the core plans for no robot whose pose is unknown
                self.poses[ids["robot"]] = message
            elif isinstance(message, RobotState):
                self.states[ids["robot"]] = message
                self.operator.on_state(ids["robot"], message, at.now)
                self.riding.on_state(ids["robot"], message)
                if self.leads:
                    stored = self.goals.get(ids["robot"])
                    self._docks.on_state(ids["robot"], message, stored.goal if stored else None, at.now)
                    self.visiting.on_state(ids["robot"], message)
            self._cycle.queue_message(channel, handler, ids, message, at)
            if channel in self._core.URGENT:
                self._wake.set()
            return ()

        return enqueue

    @property
    def leads(self) -> bool:
        """Whether this process answers queries; else another planner does."""
        return self._gate is None or self._gate.answers()

    async def _serve_plan(self, _ids: Ids, request: PlanRequest) -> PlanReply | None:
        if not self.leads:
            return None
        try:
            return await self.preview(request, f"zenoh {ASKER.get()}")
        except BusyError as error:
            return PlanReply(refusal=busy(str(error)), retry_after=error.retry_after)

    async def _serve_egress(self, _ids: Ids, request: EgressRequest) -> PlanReply | None:
        if not self.leads:
            return None
        try:
            # Of the session that asks: it may name any robot.
            answer = partial(self._answer, ch.PLANNER_EGRESS, request)
            return await self._queue.run("egress", f"zenoh {ASKER.get()}", answer)
        except BusyError as error:
            return PlanReply(refusal=busy(str(error)), retry_after=error.retry_after)

    async def _serve_dry_run(self, _ids: Ids, request: DryRunRequest) -> DryRunReply | None:
        return await self.dry_runs.change(request, f"zenoh {ASKER.get()}") if self.leads else None

    async def _answer(self, channel: ch.Channel, request: Message) -> PlanReply:
        """Answer a query on what the core knows now, which the core's thread only copies."""
        view = await self._threads.run("core", self._core.view)
        return await self._threads.run("query", partial(self._core.answers()[channel], view, request))

    # --- Leading and standing by ------------------------------------------------------------------------------------

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load the stored missions and continue with this epoch; raises `StoreError`."""
        await self.missions.lead(epoch, confirmed=confirmed)

    def stand_by(self) -> None:
        """Follow all inputs, without missions."""
        self.missions.stand_by()
        self.visiting.visits.clear()

    async def core_answers(self) -> bool:
        """Return True once the core's thread has ended a search, or all that it does; one that hangs never does.

        Searches of many robots, one after the other, may take longer than a thread may be silent.
        """
        steps = self._cycle.steps
        idle = asyncio.ensure_future(self._threads.run("core", lambda: None))
        while not idle.done() and self._cycle.steps == steps:
            await asyncio.wait((idle,), timeout=TICK_S)
        return True

    async def has_map(self) -> bool:
        """Return whether a map was ever loaded; a copy without one leaves the lease to one that has it."""
        return self.snapshots.loaded

    # --- Loops ------------------------------------------------------------------------------------------------------

    async def tick_loop(self) -> None:
        """Start a planning cycle ten times a second."""
        async for _ in ticker(self._clock, TICK_S):
            self._wake.set()

    async def plan_loop(self) -> None:
        """Run planning cycles: at every tick, and at once after an urgent message.

        Each path is published on the core's thread once it is found. What else there is to do about it waits for the
        end of the searches: here it would take turns with them, since one thread runs Python at a time.
        """
        while True:
            await self._wake.wait()
            self._wake.clear()
            result = await self._threads.run("core", lambda: self._cycle.run(self._edges.now, self._publish))
            if result.unfinished:
                self._wake.set()
            for job in result.jobs:
                self._start(job)
            for robot, goal_id in result.reached:
                self.missions.end(robot, goal_id)
            if result.wants_snapshot:
                self.snapshots.request()
            connected = self._zenoh.connected
            self._health.set("zenoh", ok=connected, detail="" if connected else "not connected to the router")
            self._health.set("robots", ok=True, detail=self.operator.doubled_detail())
            self._metrics.update(self._core, len(self.goals))
            if not result.unfinished or self._record.is_due(self._clock.now()):
                await self._record_sent()

    async def _record_sent(self) -> None:
        """Record what was published, until the next cycle is due: what is left then is recorded after it."""
        while self._record.take_over(RECORDED_AT_ONCE):
            await asyncio.sleep(0)
            if self._wake.is_set() and not self._record.is_due(self._clock.now()):
                return

    def _change_goal(self, change: Callable[[], object]) -> None:
        self._cycle.change_goal(change)
        self._wake.set()

    def _start(self, job: Job) -> None:
        task = asyncio.get_running_loop().create_task(self._run_job(job), name="job")
        self._jobs.add(task)
        task.add_done_callback(self._jobs.discard)

    async def _run_job(self, job: Job) -> None:
        try:
            if job.thread == "query":
                await self._queue.run("explanation", "", partial(self._threads.run, "query", job.run))
            else:
                await self._threads.run("field", job.run)
        except Exception as error:  # noqa: BLE001  # robots drive without it; the bug is logged
            _log.error("job_failed", error=error, job=type(job).__name__)
        self._cycle.queue_job(job, self._clock.now())
        if job.thread == "query":
            self._wake.set()

    # --- Publications and metrics -----------------------------------------------------------------------------------

    def _publish(self, publications: Sequence[Publication]) -> None:
        """Publish on the calling thread."""
        for publication in publications:
            self._edges.publish(publication)
        self._record.add(publications, self._clock.now())

    def close(self) -> None:
        """Shut the threads down once their current work is done."""
        self._queue.close()
        self._threads.close()
