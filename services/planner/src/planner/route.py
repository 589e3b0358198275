"""A planned route as a polyline: its cost, progress along it, and changes near it. Metres in the frame `map`."""

import itertools
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fog_contracts.grid import GridGeometry, Window
from fog_kernels.astar import line_cost
from fog_kernels.distance import squared_distance_capped

Floats = NDArray[np.float64]
Grid = NDArray[np.uint8]


@dataclass(frozen=True)
class Route:
    """Corners (n, 2) joined by straight lines; the first `escape_lines` lines lead out of impassable cells."""

    corners: Floats
    spacing: float
    escape_lines: int = 0

    @cached_property
    def points(self) -> Floats:
        """The polyline (n, 2), sampled at most `spacing` apart; every corner is a sample."""
        parts: list[Floats] = [self.corners[:1]]
        for a, b in zip(self.corners[:-1], self.corners[1:], strict=True):
            count = max(1, math.ceil(math.hypot(*(b - a)) / self.spacing))
            fraction = np.arange(1, count + 1)[:, None] / count
            parts.append(a + fraction * (b - a))
        return np.concatenate(parts)

    @cached_property
    def along(self) -> Floats:
        """Distance (m) along the line of every point."""
        if len(self.points) < 2:
            return np.zeros(len(self.points))
        return np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(self.points, axis=0).T))))

    @property
    def length(self) -> float:
        """Length in m."""
        return float(self.along[-1])

    def nearest(self, x: float, y: float, after: float = 0.0, window: float = math.inf) -> tuple[float, float]:
        """Return how far along (m) the point nearest to (x, y) is, and its distance.

        Only `after - 0.5 .. after + window` along is searched, so that a route that passes a place twice is not cut
        short.
        """
        chosen = np.flatnonzero((self.along >= after - 0.5) & (self.along <= after + window))
        if len(chosen) == 0:
            chosen = np.arange(len(self.points))
        distances = np.hypot(self.points[chosen, 0] - x, self.points[chosen, 1] - y)
        best = int(np.argmin(distances))
        return float(self.along[chosen[best]]), float(distances[best])

    @cached_property
    def _corner_along(self) -> Floats:
        steps = np.hypot(*np.diff(self.corners, axis=0).T) if len(self.corners) > 1 else np.zeros(0)
        return np.concatenate(([0.0], np.cumsum(steps)))

    def remaining(self, along: float) -> Floats:
        """Return the polyline from `along` (m) to the end: a point there, then the corners that follow."""
        corners = self.corners[np.searchsorted(self._corner_along, along, side="right") :]
        first = np.array([[np.interp(along, self._corner_along, self.corners[:, k]) for k in (0, 1)]])
        return np.concatenate((first, corners))

    def cost(self, costmap: Grid, geometry: GridGeometry, along: float = 0.0) -> float:
        """Return the cost of the route from `along` on, as the kernels integrate it; infinite when it is impassable.

        Escape lines are left out, because they lead through impassable cells on purpose.
        """
        points = self.remaining(max(along, float(self._corner_along[self.escape_lines])))
        cells = geometry.grid_coordinates(points)
        total = 0.0
        for (x0, y0), (x1, y1) in itertools.pairwise(cells):
            total += line_cost(costmap, float(x0), float(y0), float(x1), float(y1))
            if math.isinf(total):
                return total
        return total

    def passes_near(
        self, changed: NDArray[np.bool_], window: Window, geometry: GridGeometry, reach: float, along: float
    ) -> bool:
        """Whether a changed cell of the window lies within `reach` (m) of the route from `along` on."""
        cells = math.ceil(reach / geometry.resolution)
        remaining = self.points[self.along >= along - geometry.resolution]
        on_line, _ = geometry.cells(remaining)
        columns, rows = on_line.T
        grown = geometry.clip(window.grown(cells))
        inside = (columns >= grown.x) & (columns < grown.x + grown.width)
        inside &= (rows >= grown.y) & (rows < grown.y + grown.height)
        if not inside.any():
            return False
        padded = np.zeros((grown.height, grown.width), dtype=np.bool_)
        x, y = window.x - grown.x, window.y - grown.y
        padded[y : y + window.height, x : x + window.width] = changed
        squares = squared_distance_capped(padded, cells + 1)
        return bool(np.any(squares[rows[inside] - grown.y, columns[inside] - grown.x] <= cells * cells))
