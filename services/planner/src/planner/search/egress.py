"""Plans a path out of a blocked area for a robot inside it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from fog_contracts.costs import FREE, INSCRIBED
from fog_kernels.astar import nearest_traversable
from planner.reasons.explanation import remove_regions
from planner.reasons.refusals import start_occupied, start_outside
from planner.search.path_search import SearchResult, refused
from planner.search.route import Route

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import PointXY
    from fog_kernels.astar import Planner
    from planner.config import PlannerConfig
    from planner.maps.planning_map import Cell, Grid, PlanningMap
    from planner.reasons.regions import Region


def find_egress(
    planning_map: PlanningMap, regions: Sequence[Region], start: PointXY, config: PlannerConfig, planner: Planner
) -> SearchResult:
    """Return the cheapest path from a point (m, frame `map`) to a traversable cell, however far it is.

    Inside the regions that close the robot's cell, and in their inflation, the static map's costs apply; elsewhere the
    costmap's. `regions` are those that are on, `planner` searches on maps of this size.
    """
    geometry = planning_map.geometry
    cell = geometry.cell(*start)
    if not geometry.contains_cell(*cell):
        return refused(start_outside(geometry, start))
    around_robot = [region for region in regions if region.closes(*cell)]
    others = [region for region in regions if region not in around_robot]
    margin = math.ceil(config.inflation.inflation_radius / geometry.resolution) + 2
    free = remove_regions(planning_map, around_robot, others, margin)
    begin = _traversable(free, planning_map, cell, config)
    cells = None if begin is None else planner.exit_path(free, planning_map.cost, begin)
    if cells is None:
        return refused(start_occupied(start, around_robot))
    corners = geometry.centres(cells)
    return SearchResult(Route(corners, config.point_spacing, escape_lines=len(corners) - 1), 0.0, None)


def _traversable(free: Grid, planning_map: PlanningMap, cell: Cell, config: PlannerConfig) -> Cell | None:
    """Return the robot's cell, or, if it is too near to a wall or obstacle, the nearest one where a robot may be."""
    if free[cell[1], cell[0]] < INSCRIBED:
        return cell
    if planning_map.static[cell[1], cell[0]] != FREE:
        return None
    reach = math.floor(config.inflation.inscribed_radius / planning_map.geometry.resolution) + 1
    return nearest_traversable(free, cell, reach)
