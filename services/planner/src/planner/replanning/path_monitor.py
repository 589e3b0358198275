"""Detects what requires a replan: a change of the map, or a robot that left its path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from fog_contracts.costs import NEUTRAL_WEIGHT

if TYPE_CHECKING:
    from fog_contracts.grid import Window
    from fog_contracts.messages import PointXY, RobotPose
    from planner.config import PlannerConfig
    from planner.maps.planning_map import Cell, CostChange, PlanningMap
    from planner.replanning.mission import Mission, Plan, ReplanReason
    from planner.search.route import Route

_PROGRESS_WINDOW_M: Final = 5.0
"""How far ahead of its last progress a robot is searched on its path, so that a loop is not cut short."""


@dataclass(frozen=True)
class Effect:
    """A change of the map requires a replan; the robot meets it `distance` (m) along its path, if it does."""

    reason: ReplanReason
    distance: float = math.inf


def effect_of_change(
    mission: Mission, change: CostChange, planning_map: PlanningMap, config: PlannerConfig
) -> Effect | None:
    """Return why a change of the map requires a replan; None when it does not matter to the mission.

    A refused robot gets a path only where a cost fell.
    """
    plan = mission.plan
    if plan is None or mission.target is None:
        return None
    if plan.route is None:
        return Effect("refused") if change.any_decreased else None
    distance = distance_to_change(plan, plan.route, change, planning_map, config.corridor_half_width)
    if not math.isinf(distance):
        return Effect("map", distance)
    if change.any_decreased:
        robot = (mission.pose.x, mission.pose.y) if mission.pose else _point_at(plan.route, plan.progress)
        if may_save(plan, plan.route, change.window, planning_map, robot, config.min_saving):
            return Effect("clearing")
    return None


def distance_to_change(
    plan: Plan, route: Route, change: CostChange, planning_map: PlanningMap, half_width: float
) -> float:
    """Return how far (m) along its path a robot comes within `half_width` (m) of a changed cell; infinity if never."""
    window, near = change.near(half_width, planning_map.geometry)
    return route.distance_to(near, window, planning_map.geometry, plan.progress)


def may_save(
    plan: Plan, route: Route, window: Window, planning_map: PlanningMap, robot: PointXY, saving: float
) -> bool:
    """Whether a path through the window, if all its cells were free, could save the share `saving` of the cost."""
    geometry = planning_map.geometry
    end_x, end_y = route.corners[-1]
    distance = _cell_distance(geometry.cell(*robot), window) + _cell_distance(
        geometry.cell(float(end_x), float(end_y)), window
    )
    remaining = route.cost(planning_map.cost, geometry, plan.progress)
    return distance * NEUTRAL_WEIGHT < (1.0 - saving) * remaining


def reason_from_pose(plan: Plan, pose: RobotPose, config: PlannerConfig) -> ReplanReason | None:
    """Update the robot's progress; return why its pose requires a replan, None when it is on its path."""
    if plan.route is None:
        moved = math.hypot(pose.x - plan.planned_from[0], pose.y - plan.planned_from[1])
        return "refused" if moved > config.max_deviation else None
    along, deviation = plan.route.nearest(pose.x, pose.y, plan.progress, window=_PROGRESS_WINDOW_M)
    plan.progress = max(plan.progress, along)
    return "off_path" if deviation > config.max_deviation else None


def _cell_distance(cell: Cell, window: Window) -> float:
    """Return the distance (cells) from a cell to a window; 0 inside."""
    dx = max(window.x - cell[0], 0, cell[0] - window.x - window.width + 1)
    dy = max(window.y - cell[1], 0, cell[1] - window.y - window.height + 1)
    return math.hypot(dx, dy)


def _point_at(route: Route, along: float) -> PointXY:
    x, y = route.remaining(along)[0]
    return float(x), float(y)
