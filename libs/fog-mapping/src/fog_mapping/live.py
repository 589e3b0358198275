"""A map that grows while the robot drives: each scan matched to the last ones, in bounded memory and without loops.

It shows whether a recording will make a map. The map of the finished log closes loops, and is better.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.grid import GridGeometry, StaticMap
from fog_kernels.matching import BeamCounts
from fog_mapping.poses import place
from fog_mapping.scans import has_moved
from fog_mapping.trajectory import WINDOW, match_next

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_mapping.scans import Scan

_GROWN_M: Final = 10.0
"""A map that is too small grows by so much more than it must, on the sides on which it is."""
_MOST_CELLS: Final = 4_000_000
"""Of 0.1 m: 200 m by 200 m. What lies beyond is not drawn."""
_SHARES: Final = (1.0, 0.8, 0.6, 0.4, 0.2)
"""Of what it should grow by, the largest that the limit allows: the last of it needs no growth for each scan."""


class LiveMap:
    """Scans in, a map and the way out; 0.1 m a cell unless told otherwise."""

    def __init__(self, resolution: float = 0.1) -> None:
        self._resolution = resolution
        self._recent: list[Scan] = []
        self._poses = np.zeros((0, 3))
        self._grid: GridGeometry | None = None
        self._counts: BeamCounts | None = None
        self.scans = 0
        """How many scans are in the map."""
        self.pose: NDArray[np.float64] = np.zeros(3)
        """Where the robot is (x, y in m, theta in rad), from where it began."""

    def add(self, scan: Scan) -> bool:
        """Take a scan in; return whether it has changed the map: one at which the robot has moved does."""
        if self._recent and not has_moved(self._recent[-1], scan):
            return False
        if self._recent:
            pose, _ = match_next([*self._recent, scan], np.vstack((self._poses, np.zeros(3))), len(self._recent))
        else:
            pose = np.zeros(3)
        self._recent = [*self._recent, scan][-WINDOW:]
        self._poses = np.vstack((self._poses, pose))[-WINDOW:]
        self.pose = pose
        self.scans += 1
        points = place(pose, scan.points)
        self._make_room(np.vstack((points, pose[:2]))).add(float(pose[0]), float(pose[1]), points)
        return True

    def map(self) -> StaticMap | None:
        """Return the map so far; None without any."""
        if self._grid is None or self._counts is None:
            return None
        return StaticMap(self._grid, self._counts.cells())

    def _make_room(self, points: NDArray[np.float64]) -> BeamCounts:
        """Let the grid grow to these points (n, 2; m), as far as it may; return its counts."""
        low, high = points.min(axis=0), points.max(axis=0)
        grid, cell = self._grid, self._resolution
        if grid is None:
            corner = np.floor(low / cell) * cell
            grid = GridGeometry(1, 1, cell, float(corner[0]), float(corner[1]))
        left, bottom, right, top = grid.bounds
        missing = np.array((left - low[0], bottom - low[1], high[0] - right, high[1] - top))
        if self._counts is not None and missing.max() < 0.0:
            return self._counts
        growth = np.where(missing >= 0.0, missing + _GROWN_M, 0.0) / cell
        grown = [_grown(grid, np.ceil(share * growth).astype(int).tolist()) for share in _SHARES]
        larger = next((each for each in grown if each.width * each.height <= _MOST_CELLS), grid)
        if self._counts is not None and larger == grid:
            return self._counts
        counts = BeamCounts((larger.height, larger.width), cell, larger.origin_x, larger.origin_y)
        if self._counts is not None:
            row, column = (
                round((grid.origin_y - larger.origin_y) / cell),
                round((grid.origin_x - larger.origin_x) / cell),
            )
            counts.take(self._counts, row, column)
        self._grid, self._counts = larger, counts
        return counts


def _grown(grid: GridGeometry, cells: tuple[int, int, int, int]) -> GridGeometry:
    """Return a grid with so many cells more to the left, below, to the right and above."""
    left, below, right, above = cells
    return GridGeometry(
        grid.width + left + right, grid.height + below + above, grid.resolution,
        grid.origin_x - left * grid.resolution, grid.origin_y - below * grid.resolution,
    )  # fmt: skip
