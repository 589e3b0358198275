"""The planner's state of one robot: its pose, its goal, and its current plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from msgspec import structs

from fog_contracts.messages import PointXY, Refusal, RobotGoal, RobotPath, RobotPose, Trace

if TYPE_CHECKING:
    from fog_contracts.handlers import Moment
    from fog_contracts.messages import Pose
    from fog_contracts.replica import Version
    from planner.config import PlannerConfig
    from planner.route import Route

ReplanReason = Literal["goal", "map", "epoch", "off_path", "clearing", "refused"]
"""Why a path is replanned; `map` is a change of costs within the swept corridor of the remaining path."""


@dataclass
class Plan:
    """The current path, or the refusal; `progress` is how far along it (m) the robot is."""

    plan_id: int
    route: Route | None
    refusal: Refusal | None
    traces: list[Trace]
    planned_from: PointXY
    progress: float = 0.0
    published: bool = False


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
    goal_due: float = math.inf
    path_due: float = -math.inf

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
        self.plan, self.replan, self.traces = None, "goal", []
        self.goal_due = -math.inf

    def end(self) -> None:
        """End the goal, if there is one; its next publication has no pose."""
        if self.goal is None or self.goal.pose is None:
            return
        self.goal = structs.replace(self.goal, pose=None)
        self.plan, self.replan, self.traces = None, None, []
        self.goal_due = -math.inf

    def request_replan(self, reason: ReplanReason, traces: list[Trace]) -> None:
        """Request a replan; the first reason is kept, except that `map` replaces it."""
        if self.replan is None or reason == "map":
            self.replan = reason
        self.traces += [trace for trace in traces if trace not in self.traces]

    def publish_path_now(self) -> None:
        """Make the path due, new or kept: it was compared with the newest map."""
        self.path_due = -math.inf

    def due_goal(self, at: Moment, config: PlannerConfig) -> RobotGoal | None:
        """Return the goal when it is due for publication."""
        if self.goal is None or at.now < self.goal_due:
            return None
        self.goal_due = at.now + config.goal_republish_s
        return structs.replace(self.goal, stamp=at.stamp)

    def due_path(self, at: Moment, config: PlannerConfig, epoch: int, version: Version) -> RobotPath | None:
        """Return the path or refusal, with the released length, when it is due for publication; `version` is the map's.

        The first publication stamps the plan's traces; later ones leave them unchanged.
        """
        goal, plan, target = self.goal, self.plan, self.target
        if goal is None or plan is None or target is None or at.now < self.path_due:
            return None
        self.path_due = at.now + config.republish_s
        if not plan.published:
            plan.published = True
            plan.traces = [structs.replace(trace, plan_published=at.stamp) for trace in plan.traces]
        route = plan.route
        return RobotPath(
            plan_id=plan.plan_id,
            planner_epoch=epoch,
            goal_id=goal.goal_id,
            points=[(round(float(x), 4), round(float(y), 4)) for x, y in route.points] if route else [],
            map_epoch=version.epoch,
            map_seq=version.seq,
            released_length=min(route.length, plan.progress + config.release_length) if route else 0.0,
            goal_theta=None if self.any_heading else target.theta,
            refusal=plan.refusal,
            traces=plan.traces,
            stamp=at.stamp,
        )
