"""Plans a path out of a blocked area for a robot inside it."""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import COST_WEIGHT, INSCRIBED, NEUTRAL_WEIGHT
from planner.path_search import SearchResult, refused
from planner.refusals import start_occupied, start_outside
from planner.regions import Region, remove_regions
from planner.route import Route

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import PointXY
    from planner.config import PlannerConfig
    from planner.planning_map import Cell, Grid, PlanningMap

_NEIGHBOURS: Final = tuple((dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy)


def find_egress(
    planning_map: PlanningMap, blocking: Sequence[Region], start: PointXY, config: PlannerConfig
) -> SearchResult:
    """Return the cheapest path from a point (m, frame `map`) to a traversable cell.

    Inside the regions that influence the robot's cell the static map's costs apply; elsewhere the costmap's.
    """
    geometry, cost = planning_map.geometry, planning_map.cost
    cell = geometry.cell(*start)
    if not geometry.contains_cell(*cell):
        return refused(start_outside(geometry, start))
    around_robot = [region for region in blocking if region.influences(*cell)]
    others = [region for region in blocking if region not in around_robot]
    without_regions = remove_regions(cost, planning_map.lower_bound, around_robot, others)
    cells = _search_exit(without_regions, cost, cell, config.max_egress_cells)
    if cells is None:
        return refused(start_occupied(blocking, cell, start))
    corners = geometry.centres(np.array(cells))
    return SearchResult(Route(corners, config.point_spacing, escape_lines=len(corners) - 1), 0.0, None)


def _search_exit(free: Grid, cost: Grid, start: Cell, max_cells: int) -> list[Cell] | None:
    """Search over `free` from a cell to the first one that is traversable on `cost` (Dijkstra 1959)."""
    height, width = cost.shape
    came_from: dict[Cell, Cell] = {}
    queue: list[tuple[float, Cell, Cell]] = [(0.0, start, start)]
    while queue and len(came_from) < max_cells:
        spent, cell, previous = heapq.heappop(queue)
        if cell in came_from:
            continue
        came_from[cell] = previous
        x, y = cell
        if cost[y, x] < INSCRIBED:
            return _backtracked(came_from, cell, start)
        for dx, dy in _NEIGHBOURS:
            column, row = x + dx, y + dy
            if not (0 <= column < width and 0 <= row < height) or (column, row) in came_from:
                continue
            if max(free[row, column], free[y, column], free[row, x]) >= INSCRIBED:
                continue
            step = math.hypot(dx, dy) * (NEUTRAL_WEIGHT + COST_WEIGHT * float(free[row, column]))
            heapq.heappush(queue, (spent + step, (column, row), cell))
    return None


def _backtracked(came_from: dict[Cell, Cell], end: Cell, start: Cell) -> list[Cell]:
    cells = [end]
    while cells[-1] != start:
        cells.append(came_from[cells[-1]])
    return cells[::-1]
