"""Runs the core: passes messages to its thread, publishes what it returns, and stores missions.

The core runs on a thread of its own, one cycle after another, so that a long search never delays the event loop; the
kernels release the GIL. Inputs are timestamped on arrival, even while the previous cycle runs.
"""

from __future__ import annotations

import asyncio
import secrets
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from prometheus_client import Counter, Gauge, Histogram

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import (
    MapSnapshot,
    PlanReply,
    PlanRequest,
    Pose,
    Refusal,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
)
from fog_contracts.replica import MapError
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from fog_runtime.edges import Edges
from fog_runtime.redis_connection import StoreRefusedError
from planner.store import Audit, RecoveryError, StoredGoal, StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Literal

    from fog_contracts.handlers import Handler, Ids, Moment, Publication, QueryHandler
    from fog_contracts.messages import Message
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.idempotency import Attempt
    from fog_runtime.zenoh_edge import ZenohEdge
    from planner.core import PlannerCore
    from planner.goal_fields import FieldJob
    from planner.store import Store

T = TypeVar("T")

TICK_S = 0.1
STORE_PERIOD_S = 0.5
SNAPSHOT_TIMEOUT_S = 3.0

PLANS = Counter("fognav_plans_total", "Path searches, by reason", ["reason"])
REFUSALS = Counter("fognav_plan_refusals_total", "Path searches that ended in a refusal, by Nav2's code", ["code"])
CYCLE_SECONDS = Histogram(
    "fognav_plan_cycle_seconds",
    "Duration of one planning cycle: its messages and all path searches",
    buckets=(0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0),
)
ROBOTS = Gauge("fognav_planner_robots", "Robots with a mission")
SNAPSHOTS = Counter("fognav_planner_snapshots_total", "Queries for a snapshot of the map, by outcome", ["outcome"])

_log = logs.get("planner")


@dataclass(frozen=True)
class _CycleResult:
    """The results of one cycle of the core."""

    publications: Sequence[Publication]
    reached: list[tuple[str, str]]
    field_jobs: list[FieldJob]
    wants_snapshot: bool


class Service:
    """The running planner; its loops are tasks of the process."""

    def __init__(self, core: PlannerCore, store: Store, zenoh: ZenohEdge, clock: Clock, health: Health) -> None:
        self._core = core
        self._store = store
        self._zenoh = zenoh
        self._edges = Edges(clock, zenoh=zenoh)
        self._clock = clock
        self._health = health
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._field_thread = ThreadPoolExecutor(1, thread_name_prefix="field")
        self._inputs: deque[Callable[[], Sequence[Publication]]] = deque()
        self._goal_changes: deque[Callable[[], object]] = deque()
        self._wake = asyncio.Event()
        self._snapshot_needed = asyncio.Event()
        self._snapshot_needed.set()
        self._field_tasks: set[asyncio.Task[None]] = set()
        self._goals_loaded = asyncio.Event()
        self._goal_lock = asyncio.Lock()
        self._reload_goals = True
        self._reached: dict[str, str] = {}
        self._exported_counts: dict[tuple[int, object], int] = {}
        self.poses: dict[str, RobotPose] = {}
        self.states: dict[str, RobotState] = {}
        self.goals: dict[str, StoredGoal] = {}
        self._paths: dict[str, RobotPath] = {}

    def path(self, robot: str) -> RobotPath | None:
        """Return the last published path or refusal for the robot's current goal."""
        path, stored = self._paths.get(robot), self.goals.get(robot)
        return path if path and stored and path.goal_id == stored.goal.goal_id else None

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def subscribe(self) -> None:
        """Register subscriptions and queries."""
        handlers = {channel: self._queued(channel, handler) for channel, handler in self._core.handlers().items()}
        self._edges.subscribe(handlers, self._publish)
        for channel, query_handler in self._core.query_handlers().items():
            self._zenoh.serve(channel, partial(self._answer, query_handler))

    def _queued(self, channel: ch.Channel, handler: Handler) -> Handler:
        """Return a handler that queues its message, with its time of arrival, for the core's next cycle."""

        def enqueue(ids: Ids, message: object, at: Moment) -> Sequence[Publication]:
            self._record(ids, message)
            self._inputs.append(partial(self._handle, channel, handler, ids, message, at))
            if channel in self._core.URGENT:
                self._wake.set()
            return ()

        return enqueue

    def _handle(
        self, channel: ch.Channel, handler: Handler, ids: Ids, message: object, at: Moment
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

    def _record(self, ids: Ids, message: object) -> None:
        """Record what the API shows."""
        if isinstance(message, RobotPose):
            self.poses[ids["robot"]] = message
        elif isinstance(message, RobotState):
            self.states[ids["robot"]] = message

    # --- Queries ----------------------------------------------------------------------------------------------------

    async def _run_in_core(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def _answer(self, query_handler: QueryHandler, ids: Ids, request: object) -> Message:
        return await self._run_in_core(partial(query_handler, ids, request, self._edges.now()))

    async def preview(self, request: PlanRequest) -> PlanReply:
        """Plan a path without side effects."""
        reply = await self._answer(self._core.query_handlers()[ch.PLANNER_PLAN], {}, request)
        assert isinstance(reply, PlanReply)
        return reply

    # --- Missions: stored first, then in force ----------------------------------------------------------------------

    async def send(
        self, robot: str, pose: Pose, who: str, *, place: str | None, any_heading: bool, attempt: Attempt | None = None
    ) -> StoredGoal | Refusal:
        """Give a robot a mission; returns a refusal for an unreachable goal.

        An `attempt` that succeeded before returns its mission again and changes nothing. Raises `IdempotencyError` for
        another request's attempt, and `StoreError`, after which the mission may or may not be stored.
        """
        with self._uncertain_write():
            if (earlier := await self._store.earlier_result(attempt)) is not None:
                if self._reload_goals:
                    await self._load_goals()
                return earlier
        refusal = await self._run_in_core(lambda: self._core.check_goal(pose.x, pose.y))
        if refusal is not None:
            return refusal
        async with self._goal_lock:
            stamp = self._clock.stamp()
            goal = RobotGoal(goal_id=secrets.token_hex(8), pose=pose, place=place, stamp=stamp)
            stored = StoredGoal(goal=goal, any_heading=any_heading)
            with self._uncertain_write():
                outcome = await self._store.put(robot, stored, Audit(stamp, who, "goal", attempt))
            if outcome != "ok":
                raise StoreError("another request with this Idempotency-Key is in progress: repeat it")
            self._begin_mission(robot, stored)
        _log.info("goal_accepted", robot=robot, goal=goal.goal_id, x=pose.x, y=pose.y, place=place, who=who)
        return stored

    async def cancel(self, robot: str, who: str) -> bool:
        """End a robot's mission; False when it has none. Raises `StoreError`."""
        async with self._goal_lock:
            stored = self.goals.get(robot)
            if stored is None:
                return False
            with self._uncertain_write():
                await self._store.delete(robot, stored.goal.goal_id, Audit(self._clock.stamp(), who, "cancel"))
            self._cancel_mission(robot)
        _log.info("goal_cancelled", robot=robot, goal=stored.goal.goal_id, who=who)
        return True

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Restore the missions from memory, or accept those in Redis, after Redis lost records.

        Raises `RecoveryError` and `StoreError`.
        """
        await self._store.require_loss()
        async with self._goal_lock:
            audit = Audit(self._clock.stamp(), who, action)
            if action == "accept":
                await self._store.accept_loss(audit)
                self._reload_goals = True
            elif self._goals_loaded.is_set():
                await self._store.restore(self.goals, audit)
            else:
                raise RecoveryError(
                    "this service was started after the loss and has no missions: restore a backup of Redis, or accept"
                )

    @contextmanager
    def _uncertain_write(self) -> Iterator[None]:
        """Reload the missions after a failure: one may have been written although the reply was lost."""
        if not self._goals_loaded.is_set():
            raise StoreRefusedError("the stored missions are not loaded yet")
        try:
            yield
        except StoreError as error:
            self._reload_goals = True
            self._health.set("store", ok=False, detail=str(error))
            raise

    async def _load_goals(self) -> None:
        """Put the stored missions into force, and end those that are not stored; raises `StoreError`."""
        async with self._goal_lock:
            stored = await self._store.goals()
            for robot in [robot for robot in self.goals if robot not in stored]:
                self._cancel_mission(robot)
            for robot, mission in stored.items():
                # One that is reached may still be stored, until its deletion succeeds.
                if mission != self.goals.get(robot) and mission.goal.goal_id != self._reached.get(robot):
                    self._begin_mission(robot, mission)
            self._reload_goals = False
        self._goals_loaded.set()
        self._health.set("goals", ok=True, detail=f"{len(self.goals)} loaded")

    def _cancel_mission(self, robot: str) -> None:
        del self.goals[robot]
        self._change_goal(partial(self._core.cancel, robot))

    def _begin_mission(self, robot: str, stored: StoredGoal) -> None:
        self.goals[robot] = stored
        self._change_goal(partial(self._core.set_goal, robot, stored.goal, any_heading=stored.any_heading))

    def _change_goal(self, change: Callable[[], object]) -> None:
        self._goal_changes.append(change)
        self._wake.set()

    async def store_loop(self) -> None:
        """Load the missions, retrying until the store answers; then delete ended ones, and monitor the store."""
        while True:
            try:
                if self._reload_goals:
                    await self._load_goals()
                for robot, goal_id in list(self._reached.items()):
                    await self._store.delete(robot, goal_id, Audit(self._clock.stamp(), robot, "reached"))
                    if self._reached.get(robot) == goal_id:
                        del self._reached[robot]
                await self._store.check()
                self._health.set("store", ok=True)
            except StoreError as error:
                # What was stored but never acknowledged may have gone with a failed primary.
                self._reload_goals = True
                self._health.set("store", ok=False, detail=str(error))
                if not self._goals_loaded.is_set():
                    self._health.set("goals", ok=False, detail=f"not loaded yet: {error}")
            await asyncio.sleep(STORE_PERIOD_S)

    # --- The map ----------------------------------------------------------------------------------------------------

    async def snapshot_loop(self) -> None:
        """Fetch a snapshot of the map whenever the core needs one."""
        while True:
            await self._snapshot_needed.wait()
            if not await self._run_in_core(self._wants_snapshot):
                self._snapshot_needed.clear()
                continue
            try:
                snapshot = await self._zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
                if snapshot is not None:
                    await self._run_in_core(partial(self._core.load, snapshot, self._clock.now()))
                    self._snapshot_needed.clear()
                    self._wake.set()
                    SNAPSHOTS.labels("loaded").inc()
                    self._health.set("map", ok=True)
                    _log.info("map_loaded", epoch=snapshot.epoch, seq=snapshot.seq)
                    continue
                SNAPSHOTS.labels("unanswered").inc()
                self._health.set("map", ok=False, detail="the map-service does not answer")
            except (MapError, ContractError) as error:
                SNAPSHOTS.labels("refused").inc()
                self._health.set("map", ok=False, detail=str(error))
            await self._clock.sleep(TICK_S)

    def _wants_snapshot(self) -> bool:
        return self._core.wants_snapshot(self._clock.now())

    # --- Planning and publishing -----------------------------------------------------------------------------------

    async def tick_loop(self) -> None:
        """Start a planning cycle ten times a second."""
        async for _ in ticker(self._clock, TICK_S):
            self._wake.set()

    async def plan_loop(self) -> None:
        """Run planning cycles and publish their results: at every tick, and at once after an urgent message."""
        while True:
            await self._wake.wait()
            self._wake.clear()
            with CYCLE_SECONDS.time():
                result = await self._run_in_core(self._run_cycle)
            self._publish(result.publications)
            for robot, goal_id in result.reached:
                self._end_goal(robot, goal_id)
            for job in result.field_jobs:
                self._start_field_job(job)
            if result.wants_snapshot:
                self._snapshot_needed.set()
            self._health.set(
                "zenoh", ok=self._zenoh.connected, detail="" if self._zenoh.connected else "not connected to the router"
            )
            self._update_metrics()

    def _run_cycle(self) -> _CycleResult:
        """Run one cycle on the core's thread; goals that change during the search take effect before it publishes."""
        core = self._core
        replies = [publication for reply in _run_all(self._inputs) for publication in reply]
        _run_all(self._goal_changes)
        core.plan(self._edges.now())
        _run_all(self._goal_changes)
        publications = [*replies, *core.publish(self._edges.now())]
        return _CycleResult(publications, core.pop_reached(), core.field_jobs(), self._wants_snapshot())

    def _start_field_job(self, job: FieldJob) -> None:
        async def work() -> None:
            await asyncio.get_running_loop().run_in_executor(self._field_thread, job.run)
            self._inputs.append(partial(self._add_field, job))

        task = asyncio.get_running_loop().create_task(work(), name="field")
        self._field_tasks.add(task)
        task.add_done_callback(self._field_tasks.discard)

    def _add_field(self, job: FieldJob) -> Sequence[Publication]:
        self._core.add_field(job)
        return ()

    def _publish(self, publications: Sequence[Publication]) -> None:
        for publication in publications:
            if isinstance(path := publication.message, RobotPath):
                self._record_path(publication.ids["robot"], path)
            self._edges.publish(publication)

    def _record_path(self, robot: str, path: RobotPath) -> None:
        """Record what the API shows, and report a plan when it is first published."""
        before = self._paths.get(robot)
        self._paths[robot] = path
        if before is not None and before.plan_id == path.plan_id:
            return
        for trace in path.traces:
            metrics.observe_trace(trace, ["plan"])
        if path.refusal is not None:
            _log.warning("plan_refused", robot=robot, plan=path.plan_id, reason=path.refusal.reason)
        else:
            _log.info("plan_published", robot=robot, plan=path.plan_id, points=len(path.points), map_seq=path.map_seq,
                      hazards=[trace.area for trace in path.traces])  # fmt: skip

    def _end_goal(self, robot: str, goal_id: str) -> None:
        """Mark a reached goal for deletion, unless the robot has another one by now."""
        stored = self.goals.get(robot)
        if stored is not None and stored.goal.goal_id == goal_id:
            del self.goals[robot]
            self._reached[robot] = goal_id
            _log.info("goal_reached", robot=robot, goal=goal_id)

    def _update_metrics(self) -> None:
        ROBOTS.set(len(self.goals))
        for counter, values in ((PLANS, self._core.plans), (REFUSALS, self._core.refusals)):
            for label, count in dict(values).items():
                key = (id(counter), label)
                counter.labels(str(label)).inc(count - self._exported_counts.get(key, 0))
                self._exported_counts[key] = count

    def close(self) -> None:
        """Shut the threads down once their current work is done."""
        for thread in (self._thread, self._field_thread):
            thread.shutdown(wait=False, cancel_futures=True)


def _run_all(queued: deque[Callable[[], T]]) -> list[T]:
    """Run the functions queued by now, oldest first, and return their results.

    The event loop may append meanwhile: that waits for the next cycle, so that a flood can't put planning off.
    """
    return [queued.popleft()() for _ in range(len(queued))]
