"""A planned route as a polyline: its cost, progress along it, and changes near it. Metres in the frame `map`."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fog_contracts.geometry import lengths_along, sampled
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import PointXY
from fog_kernels.lines import cost_from, first_inside, leaves, nearest_between

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
        return sampled(self.corners, self.spacing)

    @property
    def corner_points(self) -> list[PointXY]:
        """The corners as they are published; whoever samples them at the same spacing gets `points`, bit for bit."""
        return [(x, y) for x, y in self.corners.tolist()]

    @property
    def length(self) -> float:
        """Length in m."""
        return float(self._corner_along[-1])

    def nearest(self, x: float, y: float, after: float = 0.0, window: float = math.inf) -> tuple[float, float]:
        """Return how far along (m) the point nearest to (x, y) is, and its distance.

        Only `after - 0.5 .. after + window` along is searched, so that a route that passes a place twice is not cut
        short.
        """
        lengths = self._corner_along
        found = nearest_between(self.corners, lengths, after - 0.5, after + window, x, y)
        if math.isinf(found[1]):
            found = nearest_between(self.corners, lengths, -math.inf, math.inf, x, y)
        if math.isinf(found[1]):  # all corners are one point
            return 0.0, math.hypot(self.corners[0, 0] - x, self.corners[0, 1] - y)
        return found

    @cached_property
    def _corner_along(self) -> Floats:
        return lengths_along(self.corners)

    def remaining(self, along: float) -> Floats:
        """Return the polyline from `along` (m) to the end: a point there, then the corners that follow."""
        lengths = self._corner_along
        after = int(np.searchsorted(lengths, along, side="right"))
        if after == 0 or after == len(lengths):
            return self.corners[max(0, after - 1) :]
        before, behind = self.corners[after - 1], self.corners[after]
        share = (along - lengths[after - 1]) / (lengths[after] - lengths[after - 1])
        return np.concatenate(((before + share * (behind - before))[None, :], self.corners[after:]))

    def cost(self, costmap: Grid, geometry: GridGeometry, along: float = 0.0) -> float:
        """Return the cost of the route from `along` on, as the kernels integrate it; infinite when it is impassable.

        Escape lines are left out, because they lead through impassable cells on purpose.
        """
        lengths = self._corner_along
        begin = max(along, float(lengths[self.escape_lines]))
        grid = geometry.origin_x, geometry.origin_y, geometry.resolution
        return cost_from(costmap, self.corners, lengths, begin, grid)

    def distance_to(self, mask: NDArray[np.bool_], window: Window, geometry: GridGeometry, along: float) -> float:
        """Return how far (m) beyond `along` the route first enters the cells of a mask over a window; else infinity."""
        grid = geometry.origin_x, geometry.origin_y, geometry.resolution
        begin = along - geometry.resolution
        first = first_inside(self.corners, self._corner_along, self.spacing, begin, grid, (window.x, window.y), mask)
        return max(0.0, first - along)

    def differs_from(self, other: "Route", along: float, reach: float) -> bool:
        """Whether this route leaves the rest of another, from `along` (m) on, by more than `reach` (m) somewhere."""
        return leaves(self.corners, other.remaining(along), reach, max(reach, self.spacing))
