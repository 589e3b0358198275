"""Between the core and the world: poses and map versions in, paths out, missions stored before they count.

The core runs on one thread of its own, one turn after another, so that a long search never keeps the event loop from
its beats; the kernels release the GIL.
"""

from __future__ import annotations

import asyncio
import secrets
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from msgspec import structs
from prometheus_client import Counter, Gauge, Histogram

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import (
    EgressRequest,
    HazardArea,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    PlanReply,
    PlanRequest,
    Pose,
    Refusal,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
    ZoneSet,
)
from fog_contracts.replica import MapError
from fog_runtime import logs, metrics
from planner.store import StoredGoal, StoreError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.zenoh_edge import ZenohEdge
    from planner.core import FieldJob, PlannerCore
    from planner.store import Store

T = TypeVar("T")

BEAT_S = 0.1
RETRY_S = 0.5
SNAPSHOT_TIMEOUT_S = 3.0

PLANS = Counter("fognav_plans_total", "Ways that were computed, by reason", ["reason"])
REFUSALS = Counter("fognav_plan_refusals_total", "Computed ways that ended in a refusal, by Nav2's code", ["code"])
TURN_SECONDS = Histogram(
    "fognav_plan_turn_seconds",
    "One turn of the planner: its inputs, all searches that they lead to",
    buckets=(0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0),
)
ROBOTS = Gauge("fognav_planner_robots", "Robots with a mission")
SNAPSHOTS = Counter("fognav_planner_snapshots_total", "Whole maps that were fetched", ["outcome"])

_log = logs.get("planner")


class Service:
    """The running planner; its loops are tasks of the process."""

    def __init__(self, core: PlannerCore, store: Store, zenoh: ZenohEdge, clock: Clock, health: Health) -> None:
        self._core = core
        self._store = store
        self._zenoh = zenoh
        self._clock = clock
        self._health = health
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._field_thread = ThreadPoolExecutor(1, thread_name_prefix="field")
        self._inbox: list[Callable[[], object]] = []
        self._wake = asyncio.Event()
        self._wants_map = asyncio.Event()
        self._wants_map.set()
        self._fields: set[asyncio.Task[None]] = set()
        self._goals_read = asyncio.Event()
        self._writing = asyncio.Lock()
        self._over: dict[str, str] = {}
        self._told: dict[str, int] = {}
        self._counted: dict[tuple[int, object], int] = {}
        self.poses: dict[str, RobotPose] = {}
        self.states: dict[str, RobotState] = {}
        self.goals: dict[str, StoredGoal] = {}
        self.paths: dict[str, RobotPath] = {}

    # --- What comes in ----------------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Say what to be called for."""
        core, clock = self._core, self._clock
        zenoh = self._zenoh
        zenoh.subscribe(
            ch.MAP_DELTA, MapDelta, lambda _, m: self._post(lambda: core.on_delta(m, clock.now()), wake=True)
        )
        zenoh.subscribe(
            ch.MAP_HEARTBEAT, MapHeartbeat, lambda _, m: self._post(lambda: core.on_heartbeat(m, clock.now()))
        )
        zenoh.subscribe(ch.HAZARD, HazardArea, lambda _, m: self._post(lambda: core.on_hazard(m)))
        zenoh.subscribe(ch.ZONES, ZoneSet, lambda _, m: self._post(lambda: core.on_zones(m)))
        zenoh.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose)
        zenoh.subscribe(ch.ROBOT_STATE, RobotState, self._on_state)
        zenoh.serve(ch.PLANNER_PLAN, lambda _, request: self.preview(request))
        zenoh.serve(ch.PLANNER_EGRESS, lambda _, request: self._egress(request))

    def _post(self, job: Callable[[], object], *, wake: bool = False) -> None:
        """Leave an input for the core's next turn; inputs are taken in the order in which they came."""
        self._inbox.append(job)
        if wake:
            self._wake.set()

    def _on_pose(self, ids: dict[str, str], pose: RobotPose) -> None:
        robot = ids["robot"]
        self.poses[robot] = pose
        # The age counts from the arrival here, however long the core's turn before takes.
        self._post(partial(self._core.on_pose, robot, pose, self._clock.now()))

    def _on_state(self, ids: dict[str, str], state: RobotState) -> None:
        robot = ids["robot"]
        self.states[robot] = state
        self._post(partial(self._core.on_state, robot, state, self._clock.now()))

    # --- Questions --------------------------------------------------------------------------------------------------

    async def _in_core(self, function: Callable[[], T]) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def preview(self, request: PlanRequest) -> PlanReply:
        """Plan without side effects."""
        return await self._in_core(lambda: self._core.plan(request))

    async def _egress(self, request: EgressRequest) -> PlanReply:
        return await self._in_core(lambda: self._core.egress(request))

    # --- Missions: stored first, then they count --------------------------------------------------------------------

    async def send(
        self, robot: str, pose: Pose, who: str, *, place: str | None, any_heading: bool
    ) -> StoredGoal | Refusal:
        """Give a robot a mission; returns why not when it can never be reached. Raises `StoreError`."""
        refusal = await self._in_core(lambda: self._core.check_goal(pose.x, pose.y))
        if refusal is not None:
            return refusal
        async with self._writing:
            stamp = self._clock.stamp()
            goal = RobotGoal(goal_id=secrets.token_hex(8), pose=pose, place=place, stamp=stamp)
            stored = StoredGoal(goal=goal, any_heading=any_heading)
            await self._stored(lambda: self._store.put(robot, stored, who, stamp))
            self._begin(robot, stored)
        _log.info("goal", robot=robot, goal=goal.goal_id, x=pose.x, y=pose.y, place=place, who=who)
        return stored

    async def cancel(self, robot: str, who: str) -> bool:
        """End a robot's mission; False when it has none. Raises `StoreError`."""
        async with self._writing:
            stored = self.goals.get(robot)
            if stored is None:
                return False
            stamp = self._clock.stamp()
            goal_id = stored.goal.goal_id
            await self._stored(lambda: self._store.delete(robot, goal_id, who, "cancel", stamp))
            del self.goals[robot]
            self._post(lambda: self._core.cancel(robot), wake=True)
        _log.info("goal_cancelled", robot=robot, goal=stored.goal.goal_id, who=who)
        return True

    async def _stored(self, write: Callable[[], Awaitable[None]]) -> None:
        if not self._goals_read.is_set():
            raise StoreError("the stored missions are not read yet")
        try:
            await write()
        except StoreError as error:
            self._health.set("store", ok=False, detail=str(error))
            raise

    def _begin(self, robot: str, stored: StoredGoal) -> None:
        self.goals[robot] = stored
        self.paths.pop(robot, None)
        goal, any_heading = stored.goal, stored.any_heading
        self._post(lambda: self._core.set_goal(robot, goal, any_heading=any_heading), wake=True)

    async def store_loop(self) -> None:
        """Read the missions, however long it takes; afterwards delete those that are over, and watch the store."""
        while True:
            try:
                if not self._goals_read.is_set():
                    for robot, stored in (await self._store.goals()).items():
                        self._begin(robot, stored)
                    self._goals_read.set()
                    self._health.set("goals", ok=True, detail=f"{len(self.goals)} read")
                for robot, goal_id in list(self._over.items()):
                    await self._store.delete(robot, goal_id, robot, "reached", self._clock.stamp())
                    del self._over[robot]
                await self._store.ping()
                self._health.set("store", ok=True)
            except StoreError as error:
                self._health.set("store", ok=False, detail=str(error))
                if not self._goals_read.is_set():
                    self._health.set("goals", ok=False, detail=f"not read yet: {error}")
            await asyncio.sleep(RETRY_S)

    # --- The map ----------------------------------------------------------------------------------------------------

    async def map_loop(self) -> None:
        """Fetch the whole map whenever the core needs it."""
        while True:
            await self._wants_map.wait()
            if not self._core.wants_snapshot(self._clock.now()):
                self._wants_map.clear()
                continue
            try:
                snapshot = await self._zenoh.ask(ch.MAP_SNAPSHOT, None, MapSnapshot, SNAPSHOT_TIMEOUT_S)
                if snapshot is not None:
                    await self._in_core(partial(self._core.load, snapshot, self._clock.now()))
                    self._wants_map.clear()
                    self._wake.set()
                    SNAPSHOTS.labels("taken").inc()
                    self._health.set("map", ok=True)
                    _log.info("map", epoch=snapshot.epoch, seq=snapshot.seq)
                    continue
                SNAPSHOTS.labels("unanswered").inc()
                self._health.set("map", ok=False, detail="the map-service does not answer")
            except (MapError, ContractError) as error:
                SNAPSHOTS.labels("refused").inc()
                self._health.set("map", ok=False, detail=str(error))
            await self._clock.sleep(BEAT_S)

    # --- What goes out ----------------------------------------------------------------------------------------------

    async def plan_loop(self) -> None:
        """Give the core its inputs and publish what it says: at 10 Hz, and at once after a change of the map."""
        while True:
            try:
                async with asyncio.timeout(self._clock.real(BEAT_S)):
                    await self._wake.wait()
            except TimeoutError:
                pass
            self._wake.clear()
            jobs, self._inbox = self._inbox, []
            with TURN_SECONDS.time():
                told = await self._in_core(partial(self._turn, jobs))
            for robot, message in told:
                self._publish(robot, message)
            if self._core.wants_snapshot(self._clock.now()):
                self._wants_map.set()
            self._health.set("zenoh", ok=self._zenoh.connected, detail="" if self._zenoh.connected else "no router")
            self._measure()

    def _turn(self, jobs: list[Callable[[], object]]) -> list[tuple[str, RobotPath | RobotGoal]]:
        """One turn on the core's thread."""
        for job in jobs:
            job()
        told = self._core.tick(self._clock.now(), self._clock.stamp())
        for field in self._core.field_jobs():
            self._zenoh.call(self._compute, field)
        return told

    def _compute(self, job: FieldJob) -> None:
        async def work() -> None:
            await asyncio.get_running_loop().run_in_executor(self._field_thread, job.run)
            self._post(partial(self._core.take_field, job))

        task = asyncio.get_running_loop().create_task(work(), name="field")
        self._fields.add(task)
        task.add_done_callback(self._fields.discard)

    def _publish(self, robot: str, message: RobotPath | RobotGoal) -> None:
        if isinstance(message, RobotGoal):
            self._publish_goal(robot, message)
            return
        current = self.goals.get(robot)
        if current is None or current.goal.goal_id != message.goal_id:
            return  # cancelled or replaced while it was planned
        new = self._told.get(robot) != message.plan_id
        stamp = self._clock.stamp()
        if new:
            self._told[robot] = message.plan_id
            # The searches took a while: what counts is when the path leaves.
            traces = [structs.replace(trace, plan_published=stamp) for trace in message.traces]
            message = structs.replace(message, traces=traces)
        elif (before := self.paths.get(robot)) is not None:
            message = structs.replace(message, traces=before.traces)
        message = structs.replace(message, stamp=stamp)
        self._zenoh.publish(ch.ROBOT_PATH, message, robot=robot)
        self.paths[robot] = message
        if new:
            self._tell_new(robot, message)

    def _tell_new(self, robot: str, path: RobotPath) -> None:
        for trace in path.traces:
            metrics.observe_trace(trace, ["plan"])
        if path.refusal is not None:
            _log.warning("refused", robot=robot, plan=path.plan_id, reason=path.refusal.reason)
        else:
            _log.info("plan", robot=robot, plan=path.plan_id, points=len(path.points), map_seq=path.map_seq,
                      because=[trace.area for trace in path.traces])  # fmt: skip

    def _publish_goal(self, robot: str, goal: RobotGoal) -> None:
        self._zenoh.publish(ch.ROBOT_GOAL, goal, robot=robot)
        stored = self.goals.get(robot)
        if goal.pose is None and stored is not None and stored.goal.goal_id == goal.goal_id:
            del self.goals[robot]
            self.paths.pop(robot, None)
            self._over[robot] = goal.goal_id
            _log.info("goal_reached", robot=robot, goal=goal.goal_id)

    def _measure(self) -> None:
        ROBOTS.set(len(self.goals))
        for counter, values in ((PLANS, self._core.plans), (REFUSALS, self._core.refusals)):
            for label, count in dict(values).items():
                key = (id(counter), label)
                counter.labels(str(label)).inc(count - self._counted.get(key, 0))
                self._counted[key] = count

    def close(self) -> None:
        """Let the threads end when their work is done."""
        for thread in (self._thread, self._field_thread):
            thread.shutdown(wait=False, cancel_futures=True)
