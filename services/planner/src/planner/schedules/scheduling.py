"""Gives the missions that begin by the clock, and sends idle robots where they stay."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Final, Protocol

from msgspec import structs
from prometheus_client import Counter

from fog_contracts.messages import Pose, Reason, ReasonCode, Refusal, ScheduleCode
from fog_contracts.messages.basics import SENTENCE_MAX
from fog_contracts.site import ON_DOCK
from fog_contracts.weekly import TimeZoneError, Window, Windows
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.http import HttpProblem, ProblemError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, IdempotencyError
from planner.config import PlannerConfig
from planner.problems import PlannerProblem
from planner.query_queue import BusyError
from planner.robot_operator import CommandError
from planner.schedules.occasions import IdleTimes, due, is_dated
from planner.stops import Occasion, Order
from planner.store import NO_MISSION, MissionConflictError, OutOfServiceError
from planner.tours.api import Conditions, mission_order
from planner.visits import is_free

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.messages import Place, PlanReply, PlanRequest, RobotPose, RobotState
    from fog_contracts.site import Site
    from fog_runtime.clock import Clock
    from planner.lifts.riding import Riding
    from planner.robot_operator import RobotOperator
    from planner.schedules.persistence import SchedulePersistence
    from planner.stops import ScheduledMission
    from planner.store import StoredGoal
    from planner.visiting import Visiting

STEP_S: Final = 1.0
RETRY_S: Final = 10.0
"""After a mission was refused, it is tried again so much later."""
HOME_M: Final = 0.5
"""A robot this close to where it stays is there."""
IDLE: Final = "planner, for an idle robot"
"""Who sends it, in the audit trail."""

SCHEDULED = Counter(
    "fognav_scheduled_missions_total", "Missions that were to begin by the clock, by outcome", ["outcome"]
)
for _outcome in ("given", "missed"):
    SCHEDULED.labels(_outcome)

_log = logs.get("planner")


_NO_REASON: Final = Reason("", "")
_PLANNER_AWAY: Final = Reason(ScheduleCode.PLANNER_AWAY, "the planner did not run, or its clock was not set")
_CODES: Final[Sequence[tuple[type[Exception], str]]] = (
    (BusyError, PlannerProblem.BUSY), (CommandError, PlannerProblem.COMMAND_LOST),
    (MissionConflictError, PlannerProblem.MISSION_CHANGED),
    (OutOfServiceError, PlannerProblem.OUT_OF_SERVICE), (StoreError, HttpProblem.STORE_AWAY),
)  # fmt: skip


def _reason(error: Exception) -> Reason:
    """Return why a mission was not given, by the error that says so."""
    known = (code for kind, code in _CODES if isinstance(error, kind))
    return Reason(error.code if isinstance(error, ProblemError) else next(known, ""), str(error))


class Robots(Protocol):
    """What scheduled missions need of the planner's service."""

    missions: SchedulePersistence
    operator: RobotOperator
    visiting: Visiting
    poses: dict[str, RobotPose]
    riding: Riding

    @property
    def places(self) -> Mapping[str, Place] | None:
        """All places by id; None until the map-service has told them."""

    @property
    def leads(self) -> bool:
        """Whether this process acts; else another planner does."""

    async def preview(self, request: PlanRequest, asker: str) -> PlanReply:
        """Plan a path without side effects."""

    def stamp(self) -> float:
        """Return the time, s since the epoch."""

    async def send(self, order: Order) -> StoredGoal | Refusal:
        """Give a robot a mission."""


class Scheduling:
    """The scheduled missions and idle robots of a running planner."""

    def __init__(self, service: Robots, site: Site, clock: Clock, synchronized: Callable[[], bool]) -> None:
        """`site` says where idle robots stay; `synchronized` tells whether the time of day is right."""
        self._service = service
        self._places = site.places
        self._clock = clock
        self._synchronized = synchronized
        self._idle = {robot.id: robot.idle for robot in site.robots if robot.idle is not None}
        self._idle_times = IdleTimes({robot: idle.after_s for robot, idle in self._idle.items()})
        self._windows: dict[str, tuple[str, Windows]] = {}
        self._why: dict[str, Reason] = {}
        self._tried: dict[str, float] = {}
        self._stored = True

    async def run(self) -> None:
        """Look each second what is due."""
        async for _ in ticker(self._clock, STEP_S):
            if self._service.leads:
                await self.step()
            else:
                self._idle_times.clear()

    async def step(self) -> None:
        """Do what is due now; what can't be stored is tried again."""
        try:
            if self._synchronized():
                await self._give_due()
            await self._send_idle()
        except StoreError as error:
            if self._stored:
                _log.warning("schedules_not_stored", reason=str(error))
            self._stored = False
        else:
            self._stored = True

    # --- What people see --------------------------------------------------------------------------------------------

    def following(self, schedule: ScheduledMission) -> float | None:
        """Return when a scheduled mission's next window begins (s since the epoch); None for none within a week."""
        if not schedule.enabled or not self._synchronized():
            return None
        try:
            window = self._windows_of(schedule).following(self._clock.stamp())
        except TimeZoneError:
            return None
        return None if window is None else window.begin

    def written_at(self) -> float:
        """Return the time for what is written now (s since the epoch); 0 while it is not known."""
        return self._clock.stamp() if self._synchronized() else 0.0

    def waits_for(self, schedule: ScheduledMission) -> Reason:
        """Return why a mission that is due was not given yet; empty if none is due."""
        return self._why.get(schedule.version, _NO_REASON)

    # --- Missions that begin by the clock ---------------------------------------------------------------------------

    def _windows_of(self, schedule: ScheduledMission) -> Windows:
        known = self._windows.get(schedule.id)
        if known is None or known[0] != schedule.version:
            known = self._windows[schedule.id] = schedule.version, Windows(schedule.weekly)
        return known[1]

    async def _give_due(self) -> None:
        """Give the missions that are due, the most urgent first; raises `StoreError`."""
        schedules, stamp = list(self._service.missions.schedules.values()), self._clock.stamp()
        self._windows = {one.id: self._windows[one.id] for one in schedules if one.id in self._windows}
        found: list[tuple[int, float, str, ScheduledMission, Window]] = []
        for schedule in schedules:
            # Windows are computed for some days at a time, which takes milliseconds: paths are answered in between.
            await asyncio.sleep(0)
            if not is_dated(schedule, stamp):
                await self._put(schedule, structs.replace(schedule, since=stamp), "dated")
                continue
            try:
                now = due(schedule, self._windows_of(schedule), stamp)
            except TimeZoneError as error:
                self._why[schedule.version] = Reason("", str(error))
                continue
            if now is None:
                self._why.pop(schedule.version, None)
            elif now.over:
                why = self._why.pop(schedule.version, _PLANNER_AWAY)
                missed = Occasion(begin=now.window.begin, at=stamp, outcome="missed", reason=str(why), code=why.code)
                await self._note(schedule, missed)
            else:
                found.append((-schedule.mission.priority, now.window.begin, schedule.id, schedule, now.window))
        for *_, schedule, window in sorted(found, key=lambda one: one[:3]):
            await self._give(schedule, window)
        self._why = {one.version: self._why[one.version] for one in schedules if one.version in self._why}
        self._tried = {one.version: self._tried[one.version] for one in schedules if one.version in self._tried}

    async def _give(self, schedule: ScheduledMission, window: Window) -> None:
        robot = schedule.robot
        if why := self._why_not(robot):
            self._why[schedule.version] = why
            return
        if self._clock.now() - self._tried.get(schedule.version, -math.inf) < RETRY_S:
            return
        self._tried[schedule.version] = self._clock.now()
        try:
            given = await self._order(schedule, window)
        except (
            BusyError,
            CommandError,
            IdempotencyError,
            MissionConflictError,
            OutOfServiceError,
            ProblemError,
        ) as error:
            self._why[schedule.version] = _reason(error)
            return
        except StoreError as error:
            self._why[schedule.version] = _reason(error)
            raise
        if given is None:
            return
        if isinstance(given, Refusal):
            self._why[schedule.version] = Reason(given.kind, given.reason)
            return
        mission = given.goal.goal_id if given.tour is None else given.tour.id
        occasion = Occasion(begin=window.begin, at=self._clock.stamp(), outcome="given", mission=mission)
        await self._note(schedule, occasion)

    async def _order(self, schedule: ScheduledMission, window: Window) -> StoredGoal | Refusal | None:
        """Give the mission of a window; the same one again, if that was done and could not be noted.

        None: schedule or robot have changed while the way was looked for.
        """
        who = f"schedule {schedule.id}, of {schedule.author}"[:100]
        attempt = Attempt.of("schedule", f"{schedule.version} {window.begin:.0f}", schedule.id, schedule.mission)
        if (earlier := await self._service.missions.earlier_result(attempt)) is not None:
            return earlier
        conditions = Conditions(who, attempt, NO_MISSION)
        places = self._places if self._service.places is None else self._service.places
        order = await mission_order(
            self._service, schedule.robot, schedule.mission, places, conditions, PlannerConfig.cruise_speed
        )
        known = self._service.missions.schedules.get(schedule.id)
        if known is None or known.version != schedule.version or self._why_not(schedule.robot):
            return None
        return await self._service.send(order._replace(action="schedule"))

    async def _note(self, schedule: ScheduledMission, occasion: Occasion) -> None:
        occasion = structs.replace(occasion, reason=occasion.reason[:SENTENCE_MAX])
        if not await self._put(schedule, structs.replace(schedule, last=occasion), occasion.outcome):
            return  # somebody has changed or removed it meanwhile
        self._why.pop(schedule.version, None)
        SCHEDULED.labels(occasion.outcome).inc()
        told = {"schedule": schedule.id, "robot": schedule.robot, "begin": occasion.begin}
        if occasion.outcome == "given":
            _log.info("scheduled_mission_given", **told, mission=occasion.mission)
        else:
            _log.warning("scheduled_mission_missed", **told, reason=occasion.reason)

    async def _put(self, schedule: ScheduledMission, after: ScheduledMission, action: str) -> bool:
        missions = self._service.missions
        return await missions.put_schedule(schedule.id, after, "planner", action, expected=schedule.version) == "ok"

    def _why_not(self, robot: str) -> Reason | None:
        """Return why a robot gets no mission by itself now; None if it may."""
        service = self._service
        state, pose, stored = service.operator.heard(robot), service.poses.get(robot), service.missions.goals.get(robot)
        if (out := service.missions.out_of_service(robot)) is not None:
            return Reason(PlannerProblem.OUT_OF_SERVICE, f"robot {robot} is out of service: {out.reason}")
        if state is None or service.operator.is_doubled(robot):
            return Reason(ScheduleCode.NOT_HEARD, f"robot {robot} is not heard, or two agents use its id")
        if stored is not None and not stored.goal.idle:
            return Reason(ScheduleCode.HAS_MISSION, f"robot {robot} has another mission")
        if service.visiting.visits.serves(robot):
            return Reason(ScheduleCode.SERVES_VISITOR, f"robot {robot} serves a visitor")
        if not is_free(state):
            why = "; ".join(state.reasons) or "without a reason"
            low = [ReasonCode.BATTERY_LOW] if ReasonCode.BATTERY_LOW in state.codes else []
            code = next(iter([*low, *state.codes]), ScheduleCode.CANT_DRIVE)
            return Reason(code, f"robot {robot} can't drive now: it is {state.mode}, {why}")
        lost = Reason(ReasonCode.POSE_UNKNOWN, f"robot {robot} does not know where it is")
        return None if pose is not None and pose.localized else lost

    # --- Idle robots ------------------------------------------------------------------------------------------------

    async def _send_idle(self) -> None:
        """Send robots that have been without a mission for long to where they stay; raises `StoreError`."""
        for robot, idle in self._idle.items():
            state, stored = self._service.operator.heard(robot), self._service.missions.goals.get(robot)
            docked = state is not None and (state.docked or ReasonCode.ON_DOCK in state.codes)
            waits = stored is None and not docked and not self._why_not(robot)
            afresh = docked or self._is_at(robot, idle.go) or self._serves(robot, state, stored)
            if not self._idle_times.is_due(robot, self._clock.now(), idle=waits, afresh=afresh):
                continue
            if idle.go == ON_DOCK:
                await self._dock(robot)
            else:
                await self._send_home(robot, idle.go)

    def _serves(self, robot: str, state: RobotState | None, stored: StoredGoal | None) -> bool:
        """Whether somebody uses or has stopped a robot, after which it may be elsewhere."""
        held = state is not None and (not state.enabled or state.mode == "TELEOP")
        return held or (stored is not None and not stored.goal.idle) or self._service.visiting.visits.serves(robot)

    def _is_at(self, robot: str, name: str) -> bool:
        """Whether a robot is at a place."""
        place, at = self._place(name), self._service.poses.get(robot)
        return place is not None and at is not None and math.hypot(at.x - place.x, at.y - place.y) <= HOME_M

    def _place(self, name: str) -> Place | None:
        return (self._places if self._service.places is None else self._service.places).get(name)

    async def _dock(self, robot: str) -> None:
        try:
            reply = await self._service.operator.send("dock", robot, IDLE)
        except CommandError as error:
            _log.warning("idle_robot_not_docked", robot=robot, reason=str(error))
            return
        if not reply.accepted:
            _log.warning("idle_robot_not_docked", robot=robot, reason=reply.reason)

    async def _send_home(self, robot: str, name: str) -> None:
        if (place := self._place(name)) is None:
            _log.warning("idle_robot_not_sent", robot=robot, reason=f"there is no place {name}")
            return
        if self._is_at(robot, name):
            return
        order = Order(
            robot, Pose(x=place.x, y=place.y, theta=place.theta or 0.0), IDLE, place=name,
            any_heading=place.theta is None, expected=NO_MISSION, action="idle", idle=True,
        )  # fmt: skip
        try:
            sent = await self._service.send(order)
        except (MissionConflictError, OutOfServiceError):
            return  # somebody was faster
        if isinstance(sent, Refusal):
            _log.warning("idle_robot_not_sent", robot=robot, place=name, reason=sent.reason)
