"""The simulated floor: walls of the static map and obstacles, which can be placed and removed. Pure.

Frames as everywhere: x right, y up, metres, radians; row 0 of the grid at the bottom.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import LETHAL
from fog_contracts.geometry import distance_to_polygon, normalized_polygon
from fog_kernels.distance import squared_distance_capped
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import SimObstacle

MAX_CLEARANCE_M: Final = 2.0
_EXACT_CLEARANCE_M: Final = 0.6
"""Below this distance to a wall the distance is computed exactly, above it to half a cell."""
_REACH_MARGIN_M: Final = 1.0
"""Obstacles this much beyond a sensor's reach can't be measured, whatever its noise."""


class Floor:
    """Walls and obstacles, and how far they are from a point."""

    def __init__(self, geometry: GridGeometry, cells: NDArray[np.uint8]) -> None:
        """`cells` is the static map (0 free, 254 occupied, 255 unknown)."""
        if cells.shape != geometry.shape:
            raise ValueError(f"the map has shape {cells.shape}, its geometry {geometry.shape}")
        self.geometry = geometry
        self._occupied = np.ascontiguousarray(cells == LETHAL, dtype=np.uint8)
        squared = squared_distance_capped(self._occupied, math.ceil(MAX_CLEARANCE_M / geometry.resolution))
        self._wall_distance = np.sqrt(squared.astype(np.float64)) * geometry.resolution
        self._obstacles: dict[str, SimObstacle] = {}
        self._outlines: dict[str, list[Point]] = {}
        self._edges: dict[str, NDArray[np.float64]] = {}
        self._circles: dict[str, tuple[float, float, float]] = {}

    @property
    def obstacles(self) -> list[SimObstacle]:
        """The obstacles on the floor; walls are in the map."""
        return list(self._obstacles.values())

    def place(self, obstacle: SimObstacle) -> None:
        """Place an obstacle, replacing one with the same id; raises `GeometryError` for an invalid outline."""
        outline = normalized_polygon(obstacle.polygon)
        points = np.array(outline)
        self._obstacles[obstacle.id] = obstacle
        self._outlines[obstacle.id] = outline
        self._edges[obstacle.id] = np.hstack((points, np.roll(points, -1, axis=0)))
        self._circles[obstacle.id] = _circle_around(points)

    def remove(self, obstacle_id: str) -> bool:
        """Remove an obstacle; return False if there is none with this id."""
        self._outlines.pop(obstacle_id, None)
        self._edges.pop(obstacle_id, None)
        self._circles.pop(obstacle_id, None)
        return self._obstacles.pop(obstacle_id, None) is not None

    def nearest(self, x: float, y: float) -> tuple[float, float]:
        """Return the distance (m) from (x, y) to the nearest wall or obstacle and the direction (rad) to it."""
        nearest, direction = self._nearest_wall(x, y)
        for outline in self._outlines.values():
            distance = distance_to_polygon(outline, x, y)
            if distance < nearest:
                middle = np.mean(outline, axis=0)
                nearest, direction = distance, math.atan2(middle[1] - y, middle[0] - x)
        return nearest, direction

    def _nearest_wall(self, x: float, y: float) -> tuple[float, float]:
        g = self.geometry
        column, row = g.cell(x, y)
        if not g.contains_cell(column, row):
            return 0.0, 0.0
        coarse = float(self._wall_distance[row, column])
        if coarse > _EXACT_CLEARANCE_M:
            return coarse - g.resolution / 2, 0.0
        reach = math.ceil(_EXACT_CLEARANCE_M / g.resolution) + 1
        left, bottom = max(0, column - reach), max(0, row - reach)
        part = self._occupied[bottom : row + reach + 1, left : column + reach + 1]
        rows, columns = np.nonzero(part)
        if rows.size == 0:
            return coarse, 0.0
        # Exact distance to each occupied cell's square.
        low_x = g.origin_x + (columns + left) * g.resolution
        low_y = g.origin_y + (rows + bottom) * g.resolution
        dx = np.clip(x, low_x, low_x + g.resolution) - x
        dy = np.clip(y, low_y, low_y + g.resolution) - y
        squared = dx * dx + dy * dy
        best = int(np.argmin(squared))
        return math.sqrt(float(squared[best])), math.atan2(float(dy[best]), float(dx[best]))

    def wall_ranges(self, x: float, y: float, directions: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
        """Return the range (m) of each ray from (x, y) to the first wall, infinite for none within `reach`."""
        g = self.geometry
        return cast(self._occupied, g.resolution, g.origin_x, g.origin_y, x, y, directions, reach)

    def obstacle_ranges(
        self, x: float, y: float, directions: NDArray[np.float64], reach: float
    ) -> Iterator[tuple[SimObstacle, NDArray[np.float64], NDArray[np.float64]]]:
        """Yield each obstacle with the range (m; infinite for none) and the incidence (rad) of each ray on it.

        Those that a sensor of this `reach` (m) can't measure are left out.
        """
        for name, obstacle in self._obstacles.items():
            middle_x, middle_y, radius = self._circles[name]
            if math.hypot(middle_x - x, middle_y - y) - radius <= reach + _REACH_MARGIN_M:
                yield obstacle, *_edge_ranges(self._edges[name], x, y, directions)


def _circle_around(points: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return centre and radius (m) of a circle that holds all points."""
    x, y = (float(value) for value in np.mean(points, axis=0))
    return x, y, float(np.max(np.hypot(points[:, 0] - x, points[:, 1] - y)))


def _edge_ranges(
    edges: NDArray[np.float64], x: float, y: float, directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Range of each ray to the nearest of `edges` (k, 4: x0, y0, x1, y1), infinite for none, and its incidence."""
    cos, sin = np.cos(directions)[:, None], np.sin(directions)[:, None]
    ax, ay = edges[:, 0] - x, edges[:, 1] - y
    ex, ey = edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]
    across = cos * ey - sin * ex
    safe = np.where(across == 0, 1.0, across)
    along_ray = (ax * ey - ay * ex) / safe
    along_edge = (ax * sin - ay * cos) / safe
    hit = (across != 0) & (along_ray >= 0) & (along_edge >= 0) & (along_edge <= 1)
    ranges = np.where(hit, along_ray, np.inf)
    nearest = np.argmin(ranges, axis=1)
    rows = np.arange(directions.size)
    squareness = np.abs(across) / np.maximum(np.hypot(ex, ey), 1e-12)
    incidence = np.arccos(np.clip(squareness[rows, nearest], 0.0, 1.0))
    return ranges[rows, nearest], incidence
