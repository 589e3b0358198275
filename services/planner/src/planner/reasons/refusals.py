"""Composes refusals: Nav2's code, a sentence on what blocks the path, and the nearest reachable point."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.costs import INSCRIBED, LETHAL, UNKNOWN
from fog_contracts.messages import PLAN_CODES, Cause, PlanCode, PointXY, Refusal
from fog_kernels.astar import nearest_traversable

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from fog_contracts.grid import GridGeometry
    from planner.maps.planning_map import Cell, PlanningMap
    from planner.reasons.explanation import Cut
    from planner.reasons.regions import Region

_OBSTACLE: Final = Cause(kind="obstacle", id="lidar", state="seen")
_WALL: Final = Cause(kind="map", id="static", state="occupied")
TIMEOUT: Final[PlanCode] = 207
_NEAR_GOAL_M: Final = 5.0
"""How far from a goal in a wall a reachable point is searched."""


def refuse(code: PlanCode, reason: str, causes: Iterable[Cause] = (), nearest: PointXY | None = None) -> Refusal:
    """Return a refusal, its sentence and causes cut to the message's limits; `nearest` in m, frame `map`."""
    sentence = f"{PLAN_CODES[code]}: {reason}"
    return Refusal(code=code, reason=sentence[:500], causes=list(causes)[:16], nearest=nearest)


def no_map() -> Refusal:
    """Refuse because no map was received yet."""
    return refuse(TIMEOUT, "the planner has no map yet: try again when it is ready")


def busy(reason: str) -> Refusal:
    """Refuse because too many queries are waiting."""
    return refuse(TIMEOUT, reason)


def start_outside(geometry: GridGeometry, start: PointXY) -> Refusal:
    """Refuse because the robot stands off the map."""
    return refuse(203, f"the robot at {_point(start)} is outside the map {_extent(geometry)}")


def start_occupied(start: PointXY, inside: Sequence[Region] | None = None) -> Refusal:
    """Refuse because the robot stands on an impassable cell, and no free one is near.

    `inside`: the regions that close its cell; None while they are not known.
    """
    where = f"the robot at {_point(start)} stands "
    if inside:
        return refuse(205, f"{where}inside or at the edge of {_listed(inside)}", _causes(inside))
    what = "in a closed place" if inside is None else "on a wall, an obstacle or unknown space"
    return refuse(205, where + what)


def goal_out_of_reach(planning_map: PlanningMap, goal: PointXY) -> Refusal | None:
    """Return why a goal can never be reached: off the map, in a wall or in unknown space; else None.

    A goal inside a hazard or zone is accepted, because those end; until then its path is a refusal.
    """
    geometry, lower_bound = planning_map.geometry, planning_map.lower_bound
    column, row = geometry.cell(*goal)
    if not geometry.contains_cell(column, row):
        return refuse(204, f"the goal {_point(goal)} lies outside the map {_extent(geometry)}")
    if lower_bound[row, column] < INSCRIBED:
        return None
    near = nearest_traversable(lower_bound, (column, row), round(_NEAR_GOAL_M / geometry.resolution))
    nearest = geometry.centre(*near) if near else None
    where = {LETHAL: "in a wall", UNKNOWN: "in unknown space"}.get(
        int(planning_map.static[row, column]), "too near a wall for the robot"
    )
    return refuse(206, f"the goal {_point(goal)} lies {where}{_nearest_clause(nearest)}", nearest=nearest)


def goal_occupied(goal: PointXY, nearest: PointXY | None, inside: Sequence[Region] | None = None) -> Refusal:
    """Refuse because a hazard, a zone or an obstacle closes the goal's cell.

    `inside`: the regions that close it; None while they are not known.
    """
    if inside is None:
        where = "in a place that is closed now"
    elif inside:
        where = f"inside or at the edge of {_listed(inside)}"
    else:
        where = "on or beside an obstacle that a robot sees"
    causes = [] if inside is None else _causes(inside) or [_OBSTACLE]
    return refuse(206, f"the goal {_point(goal)} lies {where}{_nearest_clause(nearest)}", causes, nearest)


def no_path(nearest: PointXY, cut: Cut | None = None) -> Refusal:
    """Refuse because every path to the goal is blocked; `cut` tells by what, None while that is not known."""
    if cut is None:
        return refuse(208, f"every path is blocked{_nearest_clause(nearest)}", (), nearest)
    if cut.kind == "walls":
        reason = f"no path leads there: walls or unknown space lie between{_nearest_clause(nearest)}"
        return refuse(208, reason, [_WALL], nearest)
    if cut.kind == "obstacles":
        reason = f"every path is blocked by obstacles that robots see{_nearest_clause(nearest)}"
        return refuse(208, reason, [_OBSTACLE], nearest)
    joint = ", which must all end" if cut.jointly and len(cut.regions) > 1 else ""
    reason = f"every path is blocked by {_listed(cut.regions)}{joint}{_nearest_clause(nearest)}"
    return refuse(208, reason, _causes(cut.regions), nearest)


def nearest_reachable(planning_map: PlanningMap, start: Cell, goal: Cell) -> PointXY:
    """Return the point (m) nearest to the goal that can be reached from a traversable cell."""
    components = planning_map.components
    x, y = planning_map.geometry.centre(*components.nearest(components.of(*start), goal))
    return round(x, 3), round(y, 3)


def _point(point: PointXY) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"


def _extent(geometry: GridGeometry) -> str:
    left, bottom, right, top = geometry.bounds
    return f"({left:.1f} to {right:.1f}, {bottom:.1f} to {top:.1f})"


def _nearest_clause(point: PointXY | None) -> str:
    return "" if point is None else f"; the nearest reachable point is {_point(point)}"


def _causes(regions: Sequence[Region]) -> list[Cause]:
    return [region.cause for region in regions]


def _listed(regions: Sequence[Region]) -> str:
    names = [region.description for region in regions]
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
