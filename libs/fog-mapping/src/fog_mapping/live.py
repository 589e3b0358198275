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
"""A map that is too small grows by so much more than it must."""
_MOST_CELLS: Final = 4_000_000
"""Of 0.1 m: 200 m by 200 m. What lies beyond is not drawn."""


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
        if self._make_room(np.vstack((points, pose[:2]))) and self._counts is not None:
            self._counts.add(float(pose[0]), float(pose[1]), points)
        return True

    def map(self) -> StaticMap | None:
        """Return the map so far; None without any."""
        if self._grid is None or self._counts is None:
            return None
        return StaticMap(self._grid, self._counts.cells())

    def _make_room(self, points: NDArray[np.float64]) -> bool:
        """Let the grid grow to these points (n, 2; m); return whether it covers them."""
        low, high = points.min(axis=0), points.max(axis=0)
        grid, cell = self._grid, self._resolution
        if grid is not None and grid.contains(low[0], low[1]) and grid.contains(high[0], high[1]):
            return True
        if grid is not None:
            low = np.minimum(low, (grid.origin_x, grid.origin_y))
            high = np.maximum(high, (grid.origin_x + grid.width * cell, grid.origin_y + grid.height * cell))
        low = np.floor((low - _GROWN_M) / cell) * cell
        width, height = np.ceil((high + _GROWN_M - low) / cell).astype(int).tolist()
        if width * height > _MOST_CELLS:
            return False
        larger = BeamCounts((height, width), cell, float(low[0]), float(low[1]))
        if grid is not None and self._counts is not None:
            column = round((grid.origin_x - float(low[0])) / cell)
            row = round((grid.origin_y - float(low[1])) / cell)
            larger.take(self._counts, row, column)
        self._grid = GridGeometry(width, height, cell, float(low[0]), float(low[1]))
        self._counts = larger
        return True
