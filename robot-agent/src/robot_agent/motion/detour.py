"""A way round what blocks the path, inside the window around the robot. Frame: `map`."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED, LETHAL, PENALTY_MAX, UNKNOWN
from fog_kernels.astar import Planner
from fog_kernels.course import Cells, is_blocked
from fog_kernels.inflation import inflate, inflation_table
from robot_agent.motion.path_follower import PathFollower

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry
    from fog_kernels.clearance import Clearance
    from fog_kernels.inflation import InflationTable
    from robot_agent.localization.pose import Pose2

_REJOIN_M: Final = 0.2
"""A detour rejoins the path this far behind its last blocked point."""
_SPACING_CELLS: Final = 0.5
"""The path is looked up in the costs so many cells apart."""


def free_path(  # noqa: PLR0913  # all that may block a path
    path: NDArray[np.float64],
    cost: NDArray[np.uint8],
    window: GridGeometry,
    lidar_points: NDArray[np.float64],
    inflation: Inflation,
    around: Clearance,
    narrowest: float,
    pose: Pose2,
) -> NDArray[np.float64]:
    """Return the path (n, 2; m) with a detour around what blocks it; arguments as for `local_costs` and `detour`.

    Nearly always nothing does: then the costs beside the path, which take longer than all else here, are not needed.
    """
    cells = Cells(cost, window.resolution, window.origin_x, window.origin_y)
    square = _inscribed_square(_lidar_table(window.resolution, inflation, narrowest))
    spacing = _SPACING_CELLS * window.resolution
    if not is_blocked(pose.x, pose.y, path, spacing, cells, lidar_points, square, around, narrowest):
        return path
    return detour(path, local_costs(cost, window, lidar_points, inflation, around, narrowest), window, pose)


def local_costs(
    cost: NDArray[np.uint8],
    window: GridGeometry,
    lidar_points: NDArray[np.float64],
    inflation: Inflation,
    around: Clearance,
    narrowest: float,
) -> NDArray[np.uint8]:
    """Return the costs of the map (uint8 (h, w) over `window`) with those of the lidar points (n, 2; m).

    The master costmap is inflated already: only the lidar points are inflated here. Unknown cells stay unknown.
    Cells round a gap's width to multiples of theirs. Where `around` knows exact distances, a cell is inscribed when
    nowhere in it `narrowest` (m) are free; beyond, only when no rounding could free it.
    """
    table = _lidar_table(window.resolution, inflation, narrowest)
    marks = np.zeros(cost.shape, np.uint8)
    cells, inside = window.cells(lidar_points)
    marks[cells[inside, 1], cells[inside, 0]] = LETHAL
    costs = np.maximum(cost, inflate(marks, table))

    finer = round(window.resolution / around.resolution)
    size = len(around.distance) // finer
    free = _largest(around.distance, finer)
    column, row = window.cell(around.origin_x + 0.5 * around.resolution, around.origin_y + 0.5 * around.resolution)
    left, bottom = max(-column, 0), max(-row, 0)
    right, top = min(window.width - column, size), min(window.height - row, size)
    exact = slice(row + bottom, row + top), slice(column + left, column + right)
    seen = np.where(free[bottom:top, left:right] < narrowest, INSCRIBED, np.minimum(costs[exact], PENALTY_MAX))
    costs[exact] = np.maximum(cost[exact], seen)
    return costs


@lru_cache(maxsize=8)
def _lidar_table(resolution: float, inflation: Inflation, narrowest: float) -> InflationTable:
    """Return the table by which lidar points are inflated: the same in every decision, and dear to make."""
    certain = max(narrowest - resolution * math.sqrt(0.5), 0.0)
    return inflation_table(resolution, replace(inflation, inscribed_radius=certain))


def _inscribed_square(table: InflationTable) -> int:
    """Return the largest squared distance (in cells) from a lidar point at which a cell is inscribed."""
    return len(table.cost) - int((table.cost[::-1] >= INSCRIBED).argmax()) - 1


def _largest(field: NDArray[np.float32], finer: int) -> NDArray[np.float32]:
    """Return the largest values of squares of `finer` cells; along one axis of whole rows at a time, which is quick."""
    rows = field[::finer]
    for row in range(1, finer):
        rows = np.maximum(rows, field[row::finer])
    largest = rows[:, ::finer]
    for column in range(1, finer):
        largest = np.maximum(largest, rows[:, column::finer])
    return largest


def detour(
    path: NDArray[np.float64], costs: NDArray[np.uint8], window: GridGeometry, pose: Pose2
) -> NDArray[np.float64]:
    """Return the path (n, 2; m) with a detour around what blocks it, if one exists inside the local window.

    `costs`: uint8 (h, w) over `window`. The dynamic window alone is greedy and stops in front of an obstacle on its
    path. The robot itself searches only these few metres; everything beyond is planned by the fog. What lies between
    the robot and its path blocks it too: beside an obstacle the path may lead through what no beam can see.
    """
    route = PathFollower(np.vstack(((pose.x, pose.y), path)), math.inf)
    points, ahead = route.ahead(_SPACING_CELLS * window.resolution)
    cells = window.sample(costs, points, UNKNOWN)
    bad = np.flatnonzero((cells >= INSCRIBED) & (cells != UNKNOWN))
    start = window.cell(pose.x, pose.y)
    if not len(bad) or not window.contains_cell(*start) or costs[start[1], start[0]] >= INSCRIBED:
        return path
    clear = np.flatnonzero((ahead > ahead[bad[-1]] + _REJOIN_M) & (cells < INSCRIBED))
    if not len(clear):
        return path
    rejoin = points[clear[0]]
    search = Planner(window.width, window.height)
    found = search.plan(costs, start, window.cell(float(rejoin[0]), float(rejoin[1])))
    if not found.found:
        return path
    detour_cells = search.shortcut(costs, found.cells) if len(found.cells) > 1 else found.cells.astype(np.float64)
    return np.vstack((window.centres(detour_cells), route.points[route.along > ahead[clear[0]]]))
