"""The robot's own global costmap: floor plan, what its lidar sees, and the closed places it is told of; inflated.

The layers are those of the ROS navigation stack (static, obstacle and inflation layer, and the layer that the thesis
added to them); what did not change is not computed again.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION, FREE, INSCRIBED, LETHAL, Inflation
from fog_contracts.grid import Window
from fog_contracts.replica import Replica, Version
from fog_kernels.inflation import inflate, inflate_window, inflation_table, raise_costs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import PointXY
    from fog_contracts.shapes import Spans
    from robot_agent.localization.pose import Pose2

    Cells = NDArray[np.int64]

_NOWHERE: Final = Window(0, 0, 0, 0)
_NO_POINTS: Final = np.zeros((0, 2))
_SECTORS: Final = 360
_SEEN_BEYOND_M: Final = 0.2
"""A cell is seen to be free when the lidar sees this much farther in its direction."""
_PIECE_M: Final = 0.3
"""Marked cells this near to each other may be pieces of one obstacle."""
_NEARER_M: Final = 0.5
"""A view from this much nearer than the nearest that showed an obstacle is the better one."""
_SURE_M: Final = 3.0
"""What is seen from this near is there: the robot's heading errs by less than what a wall explains."""


class OnboardCostmap:
    """A costmap that only this robot writes and reads.

    `replica` holds it in the form in which the fog's map comes, with a version that grows by one with each change.
    """

    def __init__(self, floor: Replica, inscribed_radius: float) -> None:
        """Begin with the floor plan of a loaded map; `inscribed_radius` (m) is the robot's."""
        assert floor.geometry is not None
        assert floor.version is not None
        self.geometry: GridGeometry = floor.geometry
        inflation = Inflation(
            inscribed_radius=inscribed_radius,
            inflation_radius=DEFAULT_INFLATION.inflation_radius,
            cost_scaling=DEFAULT_INFLATION.cost_scaling,
        )
        self._table = inflation_table(self.geometry.resolution, inflation)
        self._static = floor.static
        self._raw = floor.static.copy()
        self._marks = Marks(self.geometry)
        self._touching = _touching(self.geometry.resolution, inscribed_radius)
        self._closed: dict[str, Spans] = {}
        self.replica = Replica()
        self.replica.site, self.replica.geometry, self.replica.static = floor.site, floor.geometry, floor.static
        self.replica.layers = {
            "cost": inflate(self._raw, self._table),
            "speed": np.zeros(self.geometry.shape, np.uint8),
        }
        self.replica.version = Version(floor.version.epoch, 0, 0)
        self.replica.needs_snapshot = False

    def close(self, places: Mapping[str, Spans]) -> None:
        """Close exactly these places, each by a name that stands for the same cells as before."""
        if places.keys() == self._closed.keys():
            return
        changed = _NOWHERE
        for name in places.keys() ^ self._closed.keys():
            changed = changed.union((places.get(name) or self._closed[name]).window)
        self._closed = dict(places)
        part = self._static[changed.rows, changed.columns].copy()
        raise_costs([(spans, LETHAL) for spans in places.values()], changed.x, changed.y, part)
        self._raw[changed.rows, changed.columns] = part
        self._raw[self._marks.cells[:, 1], self._marks.cells[:, 0]] = LETHAL
        self._inflate(changed)

    def observe(
        self,
        seen_from: Pose2,
        points: NDArray[np.float64],
        unexplained: NDArray[np.bool_],
        impassable: NDArray[np.float64] = _NO_POINTS,
    ) -> None:
        """Mark what a scan shows and the floor plan does not explain; free the marked cells that it sees to be free.

        points: (n, 2) m, frame `map`, of all beams that returned, from the pose `seen_from`. unexplained: (n,).
        impassable: (n, 2) m, a place that the robot could not pass although the scan may show nothing there.
        """
        occupied = self._cells(np.concatenate((points[unexplained], impassable)))
        self._update(*self._marks.observe(seen_from, points, occupied))

    def doubt(self, around: PointXY | None = None) -> bool:
        """Forget what was only seen from far away, all or near a place (m); return whether there was any.

        If so, only what is seen from near is marked there from then on until `believe`.
        """
        forgotten = self._marks.doubt(around)
        self._update(self._marks.cells[:0], forgotten)
        return len(forgotten) > 0

    def believe(self) -> None:
        """Mark everywhere again what is seen from as far as the lidar sees."""
        self._marks.believe()

    def _update(self, fresh: Cells, freed: Cells) -> None:
        """Write cells (n, 2) that are marked now and were not, and those that no longer are."""
        changed = np.concatenate((fresh, freed))
        if not len(changed):
            return
        self._raw[fresh[:, 1], fresh[:, 0]] = LETHAL
        self._raw[freed[:, 1], freed[:, 0]] = self._static[freed[:, 1], freed[:, 0]]
        low, high = changed.min(axis=0), changed.max(axis=0) + 1
        window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
        part = np.ascontiguousarray(self._raw[window.rows, window.columns])
        raise_costs([(spans, LETHAL) for spans in self._closed.values()], window.x, window.y, part)
        self._raw[window.rows, window.columns] = part
        self._inflate(window)

    def _cells(self, points: NDArray[np.float64]) -> Cells:
        """Return the cells of points (n, 2; m) that lie on known, free floor, each once."""
        cells, inside = self.geometry.cells(points)
        cells = cells[inside]
        return np.unique(cells[self._static[cells[:, 1], cells[:, 0]] == FREE], axis=0)

    def _inflate(self, window: Window) -> None:
        """Inflate a window in which cells changed, and count a version."""
        cost, version = self.replica.cost, self.replica.version
        assert version is not None
        inflate_window(self._raw, self._table, window.x, window.y, window.width, window.height, cost)
        self._keep_clear_of_marks(cost)
        self.replica.version = Version(version.epoch, version.seq + 1, 0)

    def _keep_clear_of_marks(self, cost: NDArray[np.uint8]) -> None:
        """Keep the robot's centre off the cells where its body might reach what a mark stands for."""
        around = (self._marks.cells[:, np.newaxis] + self._touching).reshape(-1, 2)
        around = around[((around >= 0) & (around < (self.geometry.width, self.geometry.height))).all(axis=1)]
        columns, rows = around.T
        cost[rows, columns] = np.maximum(cost[rows, columns], INSCRIBED)


def _touching(resolution: float, inscribed_radius: float) -> Cells:
    """Return the cells (n, 2; column, row) around one in which something was seen that the body might touch there.

    It may be anywhere in its cell. On a grid of 0.1 m a gap of three cells between two marks would else be open for a
    body that is wider than that.
    """
    radius = inscribed_radius + math.sqrt(0.5) * resolution
    reach = math.floor(radius / resolution)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    near = np.hypot(rows, columns) * resolution <= radius
    return np.column_stack((columns[near], rows[near])).astype(np.int64)


class Marks:
    """What the lidar saw and the floor plan does not have, and when it is believed to be gone: cells of a grid.

    A scan errs more the farther it sees: by the error of the robot's heading times the distance, and by the space
    between two beams. At an obstacle's edge one scan therefore hits a cell that the next one sees past. Were the last
    one believed, a gap that is about as wide as the robot would open and close with each scan, and a robot that has
    turned back from it would turn round again, and again. By the same error one beam of 10 m may mark the floor before
    a wall; where the lidar sees nothing beyond, no later scan from there corrects it, and the robot must go nearer
    (`doubt`).
    """

    def __init__(self, geometry: GridGeometry) -> None:
        self._geometry = geometry
        self._piece = math.ceil(_PIECE_M / geometry.resolution - 1e-9)
        self.cells: Cells = np.zeros((0, 2), np.int64)
        """(n, 2); column, row."""
        self._seen_from: NDArray[np.float64] = np.zeros(0)
        """(n,) m: how far away the robot was when it saw something in each cell, the nearest time."""
        self._doubted_at: PointXY = (0.0, 0.0)
        self._doubted_within = -math.inf
        """So near (m) to that place only what is seen from near is newly marked."""

    def doubt(self, around: PointXY | None = None) -> Cells:
        """Forget the cells that were never seen from near, all or those near a place (m); return them (n, 2).

        If there were any, nothing is marked there from farther away any more, until `believe`: else the robot would
        turn back from what it sees again at once, having forgotten what it had turned back from before, and never come
        near either.
        """
        place, within = ((0.0, 0.0), math.inf) if around is None else (around, _SURE_M)
        doubtful = (self._seen_from > _SURE_M) & (self._away(self.cells, place) <= within)
        if doubtful.any() and within > self._doubted_within:
            self._doubted_at, self._doubted_within = place, within
        forgotten = self.cells[doubtful]
        self.cells, self._seen_from = self.cells[~doubtful], self._seen_from[~doubtful]
        return forgotten

    def believe(self) -> None:
        """Mark everywhere again what is seen from as far as the lidar sees."""
        self._doubted_within = -math.inf

    def observe(self, seen_from: Pose2, points: NDArray[np.float64], occupied: Cells) -> tuple[Cells, Cells]:
        """Take a scan into account; return the cells (n, 2) that are marked now and were not, and those no longer.

        points: (n, 2) m, frame `map`, of all beams that returned, from the pose `seen_from`. occupied: (n, 2) the cells
        that the scan shows to be occupied, each once.

        A marked cell is freed when the scan sees beyond it, and either nothing near it stays marked (the obstacle as a
        whole is gone), or the robot is clearly nearer than it was whenever it saw something there.
        """
        robot = (seen_from.x, seen_from.y)
        away = self._away(self.cells, robot)
        # What the same scan shows is there, whatever its other beams pass by.
        seen = self._contains(occupied, self.cells)
        self._seen_from[seen] = np.minimum(self._seen_from[seen], away[seen])
        gone = ~seen & self._is_free(seen_from, points, away)
        if gone.any():
            better = away <= self._seen_from - _NEARER_M
            staying = np.concatenate((self.cells[~gone], occupied))
            gone[gone] = better[gone] | ~self._is_beside(self.cells[gone], staying)
        freed = self.cells[gone]
        fresh = occupied[~self._contains(self.cells, occupied)]
        believed = (self._away(fresh, robot) <= _SURE_M) | (self._away(fresh, self._doubted_at) > self._doubted_within)
        fresh = fresh[believed]
        self.cells = np.concatenate((self.cells[~gone], fresh))
        self._seen_from = np.concatenate((self._seen_from[~gone], self._away(fresh, robot)))
        return fresh, freed

    def _away(self, cells: Cells, place: PointXY) -> NDArray[np.float64]:
        """Return how far (m) the centres of cells (n, 2) are from a place."""
        away: NDArray[np.float64] = np.hypot(*(self._geometry.centres(cells) - place).T)
        return away

    def _is_free(self, seen_from: Pose2, points: NDArray[np.float64], away: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return beyond which of the marked cells the scan sees: by its nearest return of each direction."""
        dx, dy = points[:, 0] - seen_from.x, points[:, 1] - seen_from.y
        reach = np.full(_SECTORS, np.inf)
        np.minimum.at(reach, _sectors(dx, dy), np.hypot(dx, dy))
        reach[np.isinf(reach)] = 0.0
        # A beam that only just passes an obstacle's edge says nothing of the cell beside it.
        reach = np.minimum(reach, np.minimum(np.roll(reach, 1), np.roll(reach, -1)))
        centres = self._geometry.centres(self.cells)
        free: NDArray[np.bool_] = (
            away + _SEEN_BEYOND_M < reach[_sectors(centres[:, 0] - seen_from.x, centres[:, 1] - seen_from.y)]
        )
        return free

    def _is_beside(self, cells: Cells, others: Cells) -> NDArray[np.bool_]:
        """Return which of the cells (n, 2) are so near to one of the others (m, 2) that both may be one obstacle."""
        margin = self._piece
        low, high = cells.min(axis=0) - margin, cells.max(axis=0) + margin + 1
        near = others[((others >= low) & (others < high)).all(axis=1)] - low
        columns, rows = (high - low).tolist()
        there = np.zeros((rows, columns), np.bool_)
        there[near[:, 1], near[:, 0]] = True
        # Summed over the square around each cell.
        sums = np.zeros((rows + 1, columns + 1), np.int64)
        sums[1:, 1:] = there.cumsum(axis=0).cumsum(axis=1)
        x, y = (cells - low).T
        left, right, bottom, top = x - margin, x + margin + 1, y - margin, y + margin + 1
        found: NDArray[np.bool_] = sums[top, right] - sums[bottom, right] - sums[top, left] + sums[bottom, left] > 0
        return found

    def _contains(self, cells: Cells, wanted: Cells) -> NDArray[np.bool_]:
        """Return which of the wanted cells (n, 2) are among the cells (m, 2)."""
        width = self._geometry.width
        found: NDArray[np.bool_] = np.isin(wanted[:, 1] * width + wanted[:, 0], cells[:, 1] * width + cells[:, 0])
        return found


def _sectors(dx: NDArray[np.float64], dy: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the sector of each direction, counted counter-clockwise from the map's x axis."""
    return np.floor(np.arctan2(dy, dx) % math.tau * (_SECTORS / math.tau)).astype(np.int64) % _SECTORS
