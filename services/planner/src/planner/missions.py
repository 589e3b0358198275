"""Missions: each robot's pose, goal and current plan, and the order in which their paths are searched. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from msgspec import structs

from fog_contracts.messages import PointXY, Refusal, RobotGoal, RobotPath, RobotPose, RobotRelease, Trace

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Moment
    from fog_contracts.messages import OutOfService, Pose, RobotState
    from fog_contracts.replica import Version
    from planner.config import PlannerConfig
    from planner.path_search import Question, Route
    from planner.planning_map import Cell
    from planner.waits.choice import Judgement
    from planner.waits.pace import Times

_QUIET_S: Final = 60.0
"""After so long without a switch, the next one counts as the first again."""


@dataclass
class SwitchLimiter:
    """When a robot was last moved to another way, and how often in a row. Times are of the planner's clock (s)."""

    last: float = -math.inf
    in_a_row: int = 0
    deferred_until: float = math.inf
    """When a switch that had to wait is searched again."""

    def allowed_from(self, config: PlannerConfig) -> float:
        """Return from when on a passable path may be left for another way."""
        doubled = config.switch_dwell_s * 2.0 ** max(0, self.in_a_row - 1)
        return self.last + min(doubled, config.max_switch_dwell_s)

    def record(self, now: float) -> None:
        """Record a switch, forced or not."""
        self.in_a_row = self.in_a_row + 1 if now - self.last < _QUIET_S else 1
        self.last = now


ReplanReason = Literal["goal", "map", "epoch", "off_path", "clearing", "refused", "blocked"]
"""Why a path is replanned; `map`: costs changed in the swept corridor of its rest; `blocked`: to wait or go round."""

Explained = tuple["Version", int]
PathId = tuple[int, int]
"""Identity of a path: the planner's epoch and the plan's number."""


@dataclass
class Plan:
    """The current path, or the refusal; `progress` is how far along it (m) the robot is."""

    plan_id: int
    route: Route | None
    refusal: Refusal | None
    traces: list[Trace]
    planned_from: PointXY
    question: Question | None = None
    """What the refusal leaves open."""
    origin: PointXY | None = None
    """Where the mission's first path begins; None before it has one."""
    progress: float = 0.0
    published: bool = False
    path_due: float = -math.inf
    """When the path, or refusal, is published next, unless the robot has it: -inf for one that is new or changed."""
    explained_at: float = -math.inf
    explained_for: Explained | None = None
    """The versions of map and regions for which the refusal was last explained."""
    times: Times | None = None
    """How long the path takes, once somebody asked."""
    judged: Judgement | None = None
    """Why the robot goes round something, or waits before it."""
    waits_after: float = math.inf
    """How far along (m) the robot stands aside, until it gets another path."""
    lease: float = math.inf
    """How far along (m) no other robot is in the way (`leases`)."""

    @property
    def waits(self) -> bool:
        """Whether the robot waits before something, where the way round it branches off."""
        return self.judged is not None and self.judged.waits

    @property
    def ends_early(self) -> bool:
        """Whether the path is not released to its goal: the robot waits there, or stands aside."""
        return self.waits or not math.isinf(self.waits_after)

    def wanted_length(self, config: PlannerConfig) -> float:
        """Return how much of the path (m) the robot may drive if no other one is in the way; 0 for a refusal."""
        hold = self.judged.hold if self.judged is not None and self.judged.waits else self.waits_after
        return min(self.route.length, self.progress + config.release_length, hold) if self.route else 0.0

    def released_length(self, config: PlannerConfig) -> float:
        """Return how much of the path (m) the robot may drive; 0 for a refusal."""
        return min(self.wanted_length(config), self.lease)


@dataclass
class Mission:
    """The mission of one robot. Times are seconds of the planner's monotonic clock."""

    pose: RobotPose | None = None
    pose_received: float = -math.inf
    goal: RobotGoal | None = None
    """The last goal; its pose is None once it has ended."""
    any_heading: bool = False
    """Whether the robot may arrive with any heading: the goal's theta is ignored."""
    drives: bool = False
    """Whether the robot may drive as fast as usual, by its last state."""
    priority: int = 0
    """Of two missions that are equally urgent, the one of higher priority comes first."""
    out_of_service: OutOfService | None = None
    """Why the robot gets no goal, which is published with its goal."""
    plan: Plan | None = None
    replan: ReplanReason | None = None
    traces: list[Trace] = field(default_factory=list)
    """Traces of the hazards that caused the replan."""
    danger: float = math.inf
    """How far along its path (m) the robot meets the first of the changes that caused the replan."""
    refused_search_at: float = -math.inf
    """When a search was last repeated after a refusal."""
    blocked: Judgement | None = None
    """The last choice between waiting and going round, while something closes the robot's way."""
    search_ran_out: bool = False
    """Whether the last search took too long; a passable path is kept all the same."""
    switches: SwitchLimiter = field(default_factory=SwitchLimiter)
    beside: frozenset[str] = frozenset()
    """Robots beside whose corridors its paths lead, until they have met."""
    goal_sent: float = -math.inf
    """When the goal was published last; -inf for one that is new or changed."""
    release_due: float = -math.inf
    received: PathId | None = None
    """The path that the robot has, by its last state."""
    robots_goal: str | None = None
    """The goal that the robot has, by its last state ..."""
    heard: bool = False
    """... if there was one."""
    plans_itself: bool = False
    """Whether the robot does not drive by this planner's paths, by its last state: it never names one."""

    @property
    def target(self) -> Pose | None:
        """The pose to drive to; None when the robot has no goal, or its goal has ended."""
        return self.goal.pose if self.goal else None

    def begin(self, goal: RobotGoal, *, any_heading: bool) -> None:
        """Set a goal; the same one again changes nothing."""
        if (current := self.goal) is not None and (current.goal_id, current.pose) == (goal.goal_id, goal.pose):
            return
        self.goal, self.any_heading = goal, any_heading
        self._reset("goal")
        self.goal_sent = -math.inf

    def end(self) -> None:
        """End the goal, if there is one; its next publication has no pose."""
        if self.goal is None or self.goal.pose is None:
            return
        self.goal = structs.replace(self.goal, pose=None)
        self._reset(None)
        self.goal_sent = -math.inf

    def set_service(self, out: OutOfService | None) -> None:
        """Tell the robot, and whoever listens, that it is out of service, or in service again (None)."""
        if out == self.out_of_service:
            return
        self.out_of_service, self.goal_sent = out, -math.inf
        if self.goal is None:
            self.goal = RobotGoal(goal_id="", pose=None)

    def _reset(self, reason: ReplanReason | None) -> None:
        self.plan, self.replan, self.traces, self.danger = None, reason, [], math.inf
        self.switches, self.search_ran_out, self.blocked = SwitchLimiter(), False, None
        self.beside = frozenset()

    def request_replan(self, reason: ReplanReason, traces: list[Trace], danger: float = math.inf) -> None:
        """Request a replan; the first reason is kept, except that `map` replaces it.

        `danger`: how far along its path (m) the robot meets the change.
        """
        if self.replan is None or reason == "map":
            self.replan = reason
        self.danger = min(self.danger, danger)
        self.traces += [trace for trace in traces if trace not in self.traces]

    def replan_due(self, now: float, config: PlannerConfig) -> ReplanReason | None:
        """Return why a search is due now; None when none is, or when it has to wait."""
        if self.replan is None and self.plan is not None:
            if self.blocked is not None and self.blocked.is_due(now):
                return "blocked"
            return "clearing" if now >= self.switches.deferred_until else None
        if self.replan == "refused" and now - self.refused_search_at < config.refused_retry_s:
            return None
        return self.replan or "goal"

    def begin_replan(self, reason: ReplanReason, now: float) -> list[Trace]:
        """Withdraw the request, whose search begins; return its traces."""
        traces = self.traces
        self.replan, self.traces, self.danger = None, [], math.inf
        self.switches.deferred_until = math.inf
        if reason == "refused":
            self.refused_search_at = now
        return traces

    @property
    def path_is_outdated(self) -> bool:
        """Whether the path must not be published again before its replan."""
        return self.replan not in (None, "clearing", "refused")

    def release_now(self) -> None:
        """Make the release of the path due, new or kept: it was compared with the newest map."""
        self.release_due = -math.inf

    def replace_refusal(self, refusal: Refusal) -> None:
        """Publish another wording of the plan's refusal."""
        assert self.plan is not None
        self.plan.refusal, self.plan.path_due = refusal, -math.inf

    def on_state(self, state: RobotState) -> None:
        """Note what the robot has received."""
        self.received = received_path(state)
        self.robots_goal, self.heard = state.goal_id, True
        self.plans_itself = state.profile != "fog"
        self.drives = state.mode == "NORMAL"

    def end_unknown(self, goal_id: str) -> None:
        """End a goal that the robot has and nobody stored any more: it was cancelled, or replaced, unheard by it."""
        if self.target is None and (self.goal is None or self.goal.goal_id != goal_id):
            self.goal = RobotGoal(goal_id=goal_id, pose=None)
            self.goal_sent = -math.inf

    def drop(self) -> None:
        """Forget the goal and its plan, without telling the robot."""
        self.goal = self.plan = self.replan = self.out_of_service = self.blocked = None
        self.traces = []

    def publish_all_now(self) -> None:
        """Make goal, path and release due."""
        self.goal_sent = self.release_due = -math.inf
        if self.plan is not None:
            self.plan.path_due = -math.inf

    def due_goal(self, at: Moment, config: PlannerConfig, epoch: int) -> RobotGoal | None:
        """Return the goal when it is due for publication: seldom, once the robot's state agrees with it."""
        if self.goal is None:
            return None
        has_it = self.heard and (self.robots_goal == self.goal.goal_id) == (self.goal.pose is not None)
        if at.now < self.goal_sent + (config.goal_repeat_s if has_it else config.goal_retry_s):
            return None
        self.goal_sent = at.now
        return structs.replace(
            self.goal,
            any_heading=self.any_heading,
            out_of_service=self.out_of_service,
            stamp=at.stamp,
            planner_epoch=epoch,
        )

    def due_path(self, at: Moment, config: PlannerConfig, epoch: int, version: Version) -> RobotPath | None:
        """Return the path or refusal when it is new, has changed, or its robot has not received it for a while.

        Nothing is repeated to a robot that plans for itself. The first publication stamps the plan's traces; later ones
        leave them unchanged. `version` is the map's.
        """
        goal, plan, target = self.goal, self.plan, self.target
        if goal is None or plan is None or target is None or at.now < plan.path_due:
            return None
        if not math.isinf(plan.path_due) and (self.plans_itself or self.received == (epoch, plan.plan_id)):
            return None
        plan.path_due = at.now + config.path_retry_s
        self.release_due = at.now + config.release_period_s
        if not plan.published:
            plan.published = True
            plan.traces = [structs.replace(trace, plan_published=at.stamp) for trace in plan.traces]
        return RobotPath(
            plan_id=plan.plan_id,
            planner_epoch=epoch,
            goal_id=goal.goal_id,
            points=plan.route.corner_points if plan.route else [],
            map_epoch=version.epoch,
            map_seq=version.seq,
            released_length=plan.released_length(config),
            goal_theta=None if self.any_heading else target.theta,
            refusal=plan.refusal,
            blocked_way=plan.judged.choice if plan.judged else None,
            traces=plan.traces,
            stamp=at.stamp,
            sent=at.sent,
        )

    def due_release(self, at: Moment, config: PlannerConfig, epoch: int, version: Version) -> RobotRelease | None:
        """Return the release of the published path, or refusal, when it is due; `version` is the map's."""
        plan = self.plan
        if plan is None or self.target is None or not plan.published or at.now < self.release_due:
            return None
        self.release_due = at.now + config.release_period_s
        return RobotRelease(
            plan_id=plan.plan_id,
            planner_epoch=epoch,
            released_length=plan.released_length(config),
            map_epoch=version.epoch,
            map_seq=version.seq,
            sent=at.sent,
        )


def received_path(state: RobotState) -> PathId | None:
    """Return the path that a robot has by its state."""
    if state.plan_id is None or state.planner_epoch is None:
        return None
    return state.planner_epoch, state.plan_id


_URGENCY: Final[dict[ReplanReason, int]] = {
    "map": 0, "off_path": 1, "epoch": 2, "goal": 3, "clearing": 4, "refused": 5, "blocked": 6,
}  # fmt: skip
"""Whose path is searched first."""


class Missions:
    """The missions by robot."""

    def __init__(self) -> None:
        self._missions: dict[str, Mission] = {}
        self._reached: list[tuple[str, str]] = []

    def of(self, robot: str) -> Mission:
        """Return a robot's mission, which may have no goal."""
        if (mission := self._missions.get(robot)) is None:
            mission = self._missions[robot] = Mission()
        return mission

    def plan(self, robot: str) -> Plan | None:
        """Return a robot's plan, if it has one; any thread may ask."""
        return mission.plan if (mission := self._missions.get(robot)) is not None else None

    def items(self) -> list[tuple[str, Mission]]:
        """Return all robots with their missions."""
        return list(self._missions.items())

    def active(self) -> Iterator[tuple[str, Mission]]:
        """Yield the robots that have a goal, with their missions."""
        return ((robot, mission) for robot, mission in self.items() if mission.target is not None)

    def set_goal(self, robot: str, goal: RobotGoal, *, any_heading: bool) -> None:
        """Give a robot a mission; the same goal again changes nothing. `any_heading`: ignore the goal's theta."""
        if goal.pose is None:
            self.of(robot).end()
        else:
            self.of(robot).begin(goal, any_heading=any_heading)

    def goal(self, robot: str) -> RobotGoal | None:
        """Return the robot's goal, if it has one."""
        mission = self._missions.get(robot)
        return mission.goal if mission and mission.target else None

    def reach(self, robot: str, goal_id: str) -> None:
        """End a robot's mission because it has reached this goal; another goal of it stays."""
        if (goal := self.goal(robot)) is not None and goal.goal_id == goal_id:
            self.of(robot).end()
            self._reached.append((robot, goal_id))

    def publish_all_now(self) -> None:
        """Make all goals and paths due."""
        for mission in self._missions.values():
            mission.publish_all_now()

    def drop(self) -> None:
        """Forget all goals and plans, without telling the robots."""
        self._reached.clear()
        for mission in self._missions.values():
            mission.drop()

    def pop_reached(self) -> list[tuple[str, str]]:
        """Return (robot, goal id) of the goals that were reached since the last call."""
        reached, self._reached = self._reached, []
        return reached

    def located(self, now: float, config: PlannerConfig) -> set[str]:
        """Return the robots that have a goal and a recent pose."""
        return {
            robot
            for robot, mission in self.active()
            if mission.pose is not None and now - mission.pose_received <= config.max_pose_age_s
        }

    def to_replan(self, now: float, config: PlannerConfig) -> list[tuple[str, Mission, ReplanReason]]:
        """Return the located robots whose search is due now, most urgent first."""
        located = self.located(now, config)
        due = [
            (robot, mission, reason)
            for robot, mission in self.active()
            if robot in located and (reason := mission.replan_due(now, config)) is not None
        ]
        near = config.release_length  # no priority outranks a change on what a robot may drive now
        return sorted(due, key=lambda e: (_URGENCY[e[2]], min(e[1].danger, near), -e[1].priority, e[1].danger))

    def unexplained(self, now_known: Explained, now: float, config: PlannerConfig) -> dict[str, tuple[Plan, Question]]:
        """Return the refused plans whose reasons are unknown or may have changed, by robot, each with what is open.

        `now_known`: the newest versions of map and regions. While the map changes, reasons are not asked for all the
        time.
        """
        found = {}
        for robot, mission in self.active():
            plan = mission.plan
            if plan is None or plan.question is None:
                continue
            known = plan.explained_for
            new_regions = known is None or known[1] != now_known[1]
            new_map = known is not None and known[0] != now_known[0]
            if new_regions or (new_map and now - plan.explained_at >= config.explain_period_s):
                found[robot] = plan, plan.question
        return found

    def explain(
        self, plans: Mapping[str, Plan], answers: Mapping[str, Refusal], explained_for: Explained, now: float
    ) -> bool:
        """Use the explained refusals of these robots' plans; return whether one differs from what was published."""
        changed = False
        for robot, plan in plans.items():
            plan.explained_for, plan.explained_at = explained_for, now
            refusal, mission = answers.get(robot), self.of(robot)
            if refusal is not None and mission.plan is plan and refusal != plan.refusal:
                mission.replace_refusal(refusal)
                changed = True
        return changed

    def search_again(self, goal: Cell, geometry: GridGeometry) -> None:
        """Search again for the robots whose search for a path to a goal's cell took too long: it has a field now."""
        for _, mission in self.active():
            target = mission.target if mission.search_ran_out else None
            if target is not None and geometry.cell(target.x, target.y) == goal:
                mission.request_replan("refused", [])

    def goal_cells(self, geometry: GridGeometry) -> Iterator[Cell]:
        """Yield the cells of all goals that lie on the map."""
        for _, mission in self.active():
            if mission.target is not None:
                cell = geometry.cell(mission.target.x, mission.target.y)
                if geometry.contains_cell(*cell):
                    yield cell
