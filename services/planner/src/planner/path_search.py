"""Searches a path on the costmap from a robot's position to a goal, both in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import FREE, INSCRIBED
from fog_kernels.astar import Planner, line_cost, nearest_traversable
from planner.refusals import GoalRefusals, goal_out_of_reach, refuse, start_occupied, start_outside
from planner.route import Floats, Route

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import PointXY, Refusal
    from planner.config import PlannerConfig
    from planner.goal_fields import GoalFields
    from planner.planning_map import Cell, Grid, PlanningMap
    from planner.regions import Region


@dataclass(frozen=True)
class SearchResult:
    """A route with its cost, as the kernels integrate it, or a refusal."""

    route: Route | None
    cost: float
    refusal: Refusal | None


def refused(refusal: Refusal) -> SearchResult:
    """Return the result of a search without a path."""
    return SearchResult(None, math.inf, refusal)


class PathSearch:
    """Searches paths on maps of one geometry; owns the memory that A* needs."""

    def __init__(self, config: PlannerConfig, geometry: GridGeometry, fields: GoalFields) -> None:
        self._config = config
        self._geometry = geometry
        self._fields = fields
        self._planner = Planner(geometry.width, geometry.height)

    def find(  # noqa: PLR0911  # one return per reason for a refusal
        self, planning_map: PlanningMap, blocking: Sequence[Region], start: PointXY, goal: PointXY
    ) -> SearchResult:
        """Return the cheapest path between two points (m, frame `map`), or why there is none."""
        geometry, cost = self._geometry, planning_map.cost
        first, last = geometry.cell(*start), geometry.cell(*goal)
        if not geometry.contains_cell(*first):
            return refused(start_outside(geometry, start))
        if (unreachable := goal_out_of_reach(planning_map, goal)) is not None:
            return refused(unreachable)
        free = self._free_start(planning_map, blocking, first)
        if free is None:
            return refused(start_occupied(blocking, first, start))
        refusals = GoalRefusals(planning_map, blocking, self._planner, free)
        if cost[last[1], last[0]] >= INSCRIBED:
            return refused(refusals.goal_occupied(last, goal))
        found = (self._fields.guide(last) or self._planner).plan(cost, free, last, self._config.max_expansions)
        if found.timed_out:
            return refused(refuse(207, f"no path was found within {self._config.max_expansions} expanded cells"))
        if not found.found:
            return refused(refusals.no_path(last))
        corners = self._planner.shortcut(cost, found.cells)
        points = self._points(cost, corners, start, goal, escaping=free != first)
        route = Route(points, self._config.point_spacing, escape_lines=int(free != first))
        return SearchResult(route, route.cost(cost, geometry), None)

    def _points(self, cost: Grid, corners: Floats, start: PointXY, goal: PointXY, *, escaping: bool) -> Floats:
        """Return corners ((n, 2), columns and rows) as points (m) that start at the robot and end at the goal exactly.

        Where the line between the exact point and the next corner crosses an impassable cell, the centre of the point's
        cell is used: at most 4 cm away.
        """
        geometry = self._geometry
        cells = corners.astype(np.float64)
        exact_start, exact_goal = geometry.grid_coordinates(np.array((start, goal)))
        if len(cells) == 1:
            cells = np.concatenate((cells, cells))
        if _is_passable(cost, cells[-2], exact_goal):
            cells[-1] = exact_goal
        if escaping:
            cells = np.concatenate((exact_start[None, :], cells))
        elif _is_passable(cost, exact_start, cells[1]):
            cells[0] = exact_start
        return geometry.centres(cells)

    def _free_start(self, planning_map: PlanningMap, blocking: Sequence[Region], start: Cell) -> Cell | None:
        """Return the start's cell, or the nearest one where a robot may be; None when it is in a hazard, zone or wall.

        The line to it may cross inscribed cells and lidar obstacles, but no wall and no blocked region.
        """
        column, row = start
        if planning_map.cost[row, column] < INSCRIBED:
            return start
        if any(region.covers(column, row) for region in blocking):
            return None
        reach = math.floor(self._config.escape_distance / self._geometry.resolution)
        free = nearest_traversable(planning_map.cost, start, reach)
        if free is None:
            return None
        steps = 2 * max(abs(free[0] - column), abs(free[1] - row))
        for step in range(1, steps + 1):
            x = round(column + (free[0] - column) * step / steps)
            y = round(row + (free[1] - row) * step / steps)
            if planning_map.static[y, x] != FREE or any(region.covers(x, y) for region in blocking):
                return None
        return free


def _is_passable(cost: Grid, a: Floats, b: Floats) -> bool:
    return not math.isinf(line_cost(cost, float(a[0]), float(a[1]), float(b[0]), float(b[1])))
