"""The planner's state of one robot: its pose, its goal, and its current plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from msgspec import structs

from fog_contracts.messages import PointXY, Refusal, RobotGoal, RobotPath, RobotPose, RobotRelease, Trace
from planner.replanning.switch_limiter import SwitchLimiter

if TYPE_CHECKING:
    from fog_contracts.handlers import Moment
    from fog_contracts.messages import Pose, RobotState
    from fog_contracts.replica import Version
    from planner.config import PlannerConfig
    from planner.search.path_search import Question
    from planner.search.route import Route

ReplanReason = Literal["goal", "map", "epoch", "off_path", "clearing", "refused"]
"""Why a path is replanned; `map` is a change of costs within the swept corridor of the remaining path."""


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
    progress: float = 0.0
    published: bool = False
    path_due: float = -math.inf
    """When the path, or refusal, is published next, unless the robot has it: -inf for one that is new or changed."""
    explained_at: float = -math.inf
    explained_for: Explained | None = None
    """The versions of map and regions for which the refusal was last explained."""

    def released_length(self, config: PlannerConfig) -> float:
        """Return how much of the path (m) the robot may drive; 0 for a refusal."""
        return min(self.route.length, self.progress + config.release_length) if self.route else 0.0


@dataclass
class Mission:
    """The mission of one robot. Times are seconds of the planner's monotonic clock."""

    pose: RobotPose | None = None
    pose_received: float = -math.inf
    goal: RobotGoal | None = None
    """The last goal; its pose is None once it has ended."""
    any_heading: bool = False
    """Whether the robot may arrive with any heading: the goal's theta is ignored."""
    plan: Plan | None = None
    replan: ReplanReason | None = None
    traces: list[Trace] = field(default_factory=list)
    """Traces of the hazards that caused the replan."""
    danger: float = math.inf
    """How far along its path (m) the robot meets the first of the changes that caused the replan."""
    refused_search_at: float = -math.inf
    """When a search was last repeated after a refusal."""
    search_ran_out: bool = False
    """Whether the last search took too long; a passable path is kept all the same."""
    switches: SwitchLimiter = field(default_factory=SwitchLimiter)
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
        current = self.goal
        if current is not None and current.goal_id == goal.goal_id and current.pose == goal.pose:
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

    def _reset(self, reason: ReplanReason | None) -> None:
        self.plan, self.replan, self.traces, self.danger = None, reason, [], math.inf
        self.switches, self.search_ran_out = SwitchLimiter(), False

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

    def end_unknown(self, goal_id: str) -> None:
        """End a goal that the robot has and nobody stored any more: it was cancelled, or replaced, unheard by it."""
        if self.target is None and (self.goal is None or self.goal.goal_id != goal_id):
            self.goal = RobotGoal(goal_id=goal_id, pose=None)
            self.goal_sent = -math.inf

    def drop(self) -> None:
        """Forget the goal and its plan, without telling the robot."""
        self.goal = self.plan = self.replan = None
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
        return structs.replace(self.goal, any_heading=self.any_heading, stamp=at.stamp, planner_epoch=epoch)

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
