"""Where on its path the robot is, how much is released, where it is blocked, and the way round that. Frame: `map`."""

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
from fog_kernels.lines import nearest_on

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry
    from fog_kernels.clearance import Clearance
    from fog_kernels.inflation import InflationTable
    from robot_agent.localization.pose import Pose2

_SEARCH_BACK_M: Final = 0.5
_SEARCH_AHEAD_M: Final = 2.5
_OFF_PATH_M: Final = 1.0
_PROGRESS_M: Final = 0.1
_SLOW_M_S: Final = 0.1
"""A robot that must drive more slowly than this gets longer before it counts as stuck."""
_END_M: Final = 0.05
"""A path released to within this of its end counts as released whole: rounded points change its length."""


class PathFollower:
    """Progress of the robot along a path. It is searched near the last progress only, so a path may cross itself."""

    def __init__(self, points: NDArray[np.float64], released_length: float) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        deltas = self.points[1:] - self.points[:-1]
        lengths = np.sqrt(deltas[:, 0] ** 2 + deltas[:, 1] ** 2)
        self.along = np.concatenate(([0.0], np.cumsum(lengths)))
        """Metres from the path's start to each point."""
        self.released = 0.0
        self.release(released_length)
        self.progress = 0.0
        self.distance = 0.0
        """Metres from the robot to the path, as of the last `advance`."""
        self._started = False
        self._best_progress = 0.0
        self._best_at: float | None = None

    @property
    def length(self) -> float:
        """Metres of the whole path."""
        return float(self.along[-1])

    @property
    def released_remaining(self) -> float:
        """Metres of released path ahead of the robot."""
        return max(0.0, self.released - self.progress)

    @property
    def remaining(self) -> float:
        """Metres of path ahead of the robot."""
        return max(0.0, self.length - self.progress)

    def release(self, length: float) -> None:
        """Update how much of the path (m) is released."""
        self.released = length if length < self.length - _END_M else self.length

    def advance(self, x: float, y: float, now: float) -> None:
        """Update the progress from the robot's position (m)."""
        low, high = 0.0, math.inf
        if self._started:
            low, high = self.progress - _SEARCH_BACK_M, self.progress + _SEARCH_AHEAD_M
        found = self._nearest(x, y, low, high)
        if found[1] > _OFF_PATH_M:
            found = self._nearest(x, y, 0.0, math.inf)
        self.progress, self.distance = found
        self._started = True
        if self._best_at is None or self.progress > self._best_progress + _PROGRESS_M:
            self._best_progress, self._best_at = self.progress, now

    def restart_progress_timer(self, now: float) -> None:
        """Restart the timer of `stuck_for`: a robot that must not drive is not stuck."""
        self._best_at = now

    def stuck_for(self, now: float) -> float:
        """Seconds without progress while driving was allowed."""
        return 0.0 if self._best_at is None else now - self._best_at

    def released_ahead(self, limit: float) -> tuple[NDArray[np.float64], bool]:
        """Return the next `limit` metres of the released path (n, 2), and whether its last point is the path's end."""
        end = min(self.progress + limit, self.released)
        end = max(end, self.progress)
        first, last = int(self.along.searchsorted(self.progress, "right")), int(self.along.searchsorted(end))
        points = np.empty((max(last - first, 0) + 2, 2))
        points[0], points[1:-1], points[-1] = self._point(self.progress), self.points[first:last], self._point(end)
        return points, end >= self.length - 1e-6

    def next_points(self, limit: float) -> NDArray[np.float64]:
        """Return those of the path's points (n, 2) that lie on the next `limit` metres of it, released or not."""
        first, last = self.along.searchsorted((self.progress, self.progress + limit))
        return self.points[first:last]

    def ahead(self, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (n, 2) every `spacing` metres of the rest of the path, and their distances ahead (m)."""
        count = max(2, math.ceil(self.remaining / spacing) + 1)
        step = (self.length - self.progress) / (count - 1)
        distances = np.arange(count, dtype=np.float64) * step + self.progress
        distances[-1] = self.length
        xs, ys = (np.interp(distances, self.along, self.points[:, i]) for i in (0, 1))
        return np.column_stack((xs, ys)), distances - self.progress

    def _point(self, along: float) -> tuple[float, float]:
        """Return the point so many metres along the path; its first or last one before its begin and beyond its end."""
        after = int(self.along.searchsorted(along, "right"))
        if after == 0 or after == len(self.along):
            x, y = self.points[min(after, len(self.points) - 1)].tolist()
            return x, y
        (x, y), (next_x, next_y) = self.points[after - 1 : after + 1].tolist()
        begin, end = self.along[after - 1 : after + 1].tolist()
        return (next_x - x) / (end - begin) * (along - begin) + x, (next_y - y) / (end - begin) * (along - begin) + y

    def _nearest(self, x: float, y: float, low: float, high: float) -> tuple[float, float]:
        if len(self.points) == 1:
            return 0.0, math.hypot(self.points[0, 0] - x, self.points[0, 1] - y)
        first = max(int(self.along.searchsorted(low)) - 1, 0)
        last = min(int(self.along.searchsorted(high, "right")), len(self.points) - 1)
        progress, distance = nearest_on(self.points, self.along, first, last, x, y)
        return (self.progress if math.isinf(distance) else progress), distance


def at_speed(cap: float) -> float:
    """Return which share of the time without progress counts for a robot that may go at `cap` (m/s) at most."""
    return min(cap / _SLOW_M_S, 1.0)


def first_blocked(
    cost: NDArray[np.uint8],
    geometry: GridGeometry,
    follower: PathFollower,
    skip: float = 0.5,
    *,
    known_to_planner: bool = False,
) -> float | None:
    """Return how far ahead (m) the rest of the path first meets a cell that the robot must not enter, or None.

    Inscribed and unknown cells count beyond the first `skip` metres, where the planner may lead the robot out of a
    tight place. Lethal ones count everywhere, unless the planner knew of them (`known_to_planner`).
    """
    points, ahead = follower.ahead(0.5 * geometry.resolution)
    cells = geometry.sample(cost, points, UNKNOWN)
    bad = (cells >= INSCRIBED) & (ahead > skip)
    if not known_to_planner:
        bad |= cells == LETHAL
    return float(ahead[int(bad.argmax())]) if bad.any() else None


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
