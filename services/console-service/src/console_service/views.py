"""What the events say, where no other service's type says it: as JSON, in the words of the services' REST."""

from __future__ import annotations

import math
from typing import Any

from fog_contracts.messages import (
    REACH_UNIT_M,
    VIEW_SECTORS,
    Message,
    Pose,
    Refusal,
    RobotGoal,
    RobotPath,
    RobotState,
    View,
    Zone,
)
from fog_contracts.messages.maps import MapGeometry


class Hello(Message, frozen=True, kw_only=True):
    """The first event of a connection: which run of the service it is; `fresh`: drop what you have."""

    run: str
    fresh: bool
    site: str


class Thing(Message, frozen=True, kw_only=True):
    """A thing by its id; null when there is none any more."""

    id: str
    value: Any


class MapView(Message, frozen=True, kw_only=True):
    """The map's geometry and version, as the map-service's `MapInfo`."""

    site: str
    geometry: MapGeometry
    epoch: int
    seq: int


class ZoneView(Zone, frozen=True, kw_only=True):
    """A zone, and whether it is in force."""

    active: bool


class GoalView(Message, frozen=True, kw_only=True):
    """A mission, as the planner's REST has it."""

    robot: str
    goal_id: str
    pose: Pose
    place: str | None
    any_heading: bool
    stamp: float


class PlanView(Message, frozen=True, kw_only=True):
    """The current plan, as the planner's REST has it."""

    plan_id: int
    map_epoch: int
    map_seq: int
    points: int
    released_length: float
    refusal: Refusal | None


class RobotView(Message, frozen=True, kw_only=True):
    """A robot, as the planner's REST has it, without pose and path."""

    id: str
    configured: bool
    state: RobotState | None
    goal: GoalView | None
    plan: PlanView | None


class PathView(Message, frozen=True, kw_only=True):
    """A path: corners (m, frame `map`), its plan's number, and how much of it (m) was released with it."""

    plan_id: int
    points: list[tuple[float, float]]
    released_length: float


class ScanView(Message, frozen=True, kw_only=True):
    """What a robot's lidar sees: the nearest point (m, frame `map`) in each sector of 2 degrees that has one."""

    points: list[tuple[float, float]]
    stamp: float


def scan_view(view: View, stamp: float) -> ScanView:
    """Return the points of a robot's view, in the middle of their sectors."""
    width = math.tau / VIEW_SECTORS
    points = [
        (
            round(view.x + reach * REACH_UNIT_M * math.cos((sector + 0.5) * width), 3),
            round(view.y + reach * REACH_UNIT_M * math.sin((sector + 0.5) * width), 3),
        )
        for sector, reach in enumerate(view.reach)
        if reach
    ]
    return ScanView(points=points, stamp=stamp)


def goal_view(robot: str, goal: RobotGoal | None) -> GoalView | None:
    """Return a robot's mission; None without one."""
    if goal is None or goal.pose is None:
        return None
    return GoalView(
        robot=robot,
        goal_id=goal.goal_id,
        pose=goal.pose,
        place=goal.place,
        any_heading=goal.any_heading,
        stamp=goal.stamp,
    )


def plan_view(path: RobotPath | None) -> PlanView | None:
    """Return a plan without its path."""
    if path is None:
        return None
    return PlanView(
        plan_id=path.plan_id,
        map_epoch=path.map_epoch,
        map_seq=path.map_seq,
        points=len(path.points),
        released_length=path.released_length,
        refusal=path.refusal,
    )
