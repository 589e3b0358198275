"""Composes refusals: Nav2's code, a sentence on what blocks the path, and the nearest reachable point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from fog_contracts.costs import INSCRIBED, LETHAL, UNKNOWN
from fog_contracts.messages import PLAN_CODES, Cause, PlanCode, PointXY, Refusal
from fog_kernels.astar import Planner, nearest_traversable
from planner.regions import Region, decisive_regions, remove_regions

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from fog_contracts.grid import GridGeometry
    from planner.planning_map import Cell, Grid, PlanningMap

_OBSTACLE: Final = Cause(kind="obstacle", id="lidar", state="seen")
_NEAR_GOAL_M: Final = 5.0
"""How far from a goal in a wall a reachable point is searched."""


def refuse(code: PlanCode, reason: str, causes: Iterable[Cause] = (), nearest: PointXY | None = None) -> Refusal:
    """Return a refusal, its sentence and causes cut to the message's limits; `nearest` in m, frame `map`."""
    sentence = f"{PLAN_CODES[code]}: {reason}"
    return Refusal(code=code, reason=sentence[:500], causes=list(causes)[:16], nearest=nearest)


def no_map() -> Refusal:
    """Refuse because no map was received yet."""
    return refuse(207, "the planner has no map yet: try again when it is ready")


def start_outside(geometry: GridGeometry, start: PointXY) -> Refusal:
    """Refuse because the robot stands off the map."""
    return refuse(203, f"the robot at {_point(start)} is outside the map {_extent(geometry)}")


def start_occupied(blocking: Sequence[Region], cell: Cell, start: PointXY) -> Refusal:
    """Refuse because the robot stands on an impassable cell, and no free one is near."""
    inside = [region for region in blocking if region.influences(*cell)]
    where = f"the robot at {_point(start)} stands "
    if inside:
        return refuse(205, f"{where}inside or at the edge of {_listed(inside)}", _causes(inside))
    return refuse(205, f"{where}on a wall, an obstacle or unknown space")


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


@dataclass(frozen=True)
class GoalRefusals:
    """Refusals that depend on what can be reached on the map from `start`, a traversable cell."""

    planning_map: PlanningMap
    blocking: Sequence[Region]
    planner: Planner
    start: Cell

    def goal_occupied(self, cell: Cell, goal: PointXY) -> Refusal:
        """Refuse because a hazard, a zone or an obstacle lies on the goal."""
        inside = [region for region in self.blocking if region.influences(*cell)]
        nearest = self._nearest(cell)
        where = (
            f"inside or at the edge of {_listed(inside)}" if inside else "on or beside an obstacle that a robot sees"
        )
        reason = f"the goal {_point(goal)} lies {where}{_nearest_clause(nearest)}"
        return refuse(206, reason, _causes(inside) or [_OBSTACLE], nearest)

    def no_path(self, cell: Cell) -> Refusal:
        """Refuse because every path to the goal's cell is blocked, naming what blocks it."""
        cost, lower_bound = self.planning_map.cost, self.planning_map.lower_bound

        def has_path(costmap: Grid) -> bool:
            return self.planner.nearest_reachable(costmap, self.start, cell) == cell

        nearest = self._nearest(cell)
        regions = decisive_regions(cost, lower_bound, self.blocking, has_path)
        if regions:
            joint = len(regions) > 1 and not has_path(remove_regions(cost, lower_bound, regions[:1], regions[1:]))
            blockers = _listed(regions) + (", which must all end" if joint else "")
            return refuse(
                208, f"every path is blocked by {blockers}{_nearest_clause(nearest)}", _causes(regions), nearest
            )
        if has_path(lower_bound):
            reason = f"every path is blocked by obstacles that robots see{_nearest_clause(nearest)}"
            return refuse(208, reason, [_OBSTACLE], nearest)
        cause = Cause(kind="map", id="static", state="occupied")
        reason = f"no path leads there: walls or unknown space lie between{_nearest_clause(nearest)}"
        return refuse(208, reason, [cause], nearest)

    def _nearest(self, cell: Cell) -> PointXY:
        reachable = self.planner.nearest_reachable(self.planning_map.cost, self.start, cell)
        x, y = self.planning_map.geometry.centre(*reachable)
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
