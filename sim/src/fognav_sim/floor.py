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
from fog_kernels.emulation import edge_ranges, nearest_occupied
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
_ROUNDING_M: Final = 1e-6
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
        self._edges: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}
        self._circles: dict[str, tuple[float, float, float]] = {}
        self._soft: set[str] = set()
        self.changes = 0
        """How often an obstacle was placed or removed."""

    @property
    def obstacles(self) -> list[SimObstacle]:
        """The obstacles on the floor; walls are in the map."""
        return list(self._obstacles.values())

    def is_soft(self, obstacle_id: str) -> bool:
        """Return whether an obstacle swallows sound."""
        return obstacle_id in self._soft

    def place(self, obstacle: SimObstacle, *, solid: bool = True, soft: bool = False) -> None:
        """Place an obstacle, replacing one with the same id; raises `GeometryError` for an invalid outline.

        One that is not `solid` is seen by sensors only: `nearest` passes over it. One that is `soft` swallows sound.
        """
        outline = normalized_polygon(obstacle.polygon)
        points = np.array(outline)
        edges = np.hstack((points, np.roll(points, -1, axis=0)))
        self.changes += 1
        self._obstacles[obstacle.id] = obstacle
        if solid:
            self._outlines[obstacle.id] = outline
        else:
            self._outlines.pop(obstacle.id, None)
        self._edges[obstacle.id] = edges, np.hypot(edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1])
        self._circles[obstacle.id] = _circle_around(points)
        (self._soft.add if soft else self._soft.discard)(obstacle.id)

    def remove(self, obstacle_id: str) -> bool:
        """Remove an obstacle; return False if there is none with this id."""
        self.changes += 1
        self._outlines.pop(obstacle_id, None)
        self._edges.pop(obstacle_id, None)
        self._circles.pop(obstacle_id, None)
        self._soft.discard(obstacle_id)
        return self._obstacles.pop(obstacle_id, None) is not None

    def nearest(self, x: float, y: float) -> tuple[float, float]:
        """Return the distance (m) from (x, y) to the nearest wall or solid obstacle and the direction (rad) to it."""
        nearest, direction = self._nearest_wall(x, y)
        for name, outline in self._outlines.items():
            middle_x, middle_y, radius = self._circles[name]
            if math.hypot(middle_x - x, middle_y - y) - radius > nearest + _ROUNDING_M:
                continue
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
        found = nearest_occupied(self._occupied, (column, row), reach, g.resolution, (g.origin_x, g.origin_y), (x, y))
        if found is None:
            return coarse, 0.0
        squared, dx, dy = found  # to an occupied cell's square, exactly
        return math.sqrt(squared), math.atan2(dy, dx)

    def wall_ranges(self, x: float, y: float, directions: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
        """Return the range (m) of each ray from (x, y) to the first wall, infinite for none within `reach`."""
        g = self.geometry
        return cast(self._occupied, g.resolution, g.origin_x, g.origin_y, x, y, directions, reach)

    def obstacle_ranges(
        self, x: float, y: float, directions: NDArray[np.float64], reach: float
    ) -> Iterator[tuple[SimObstacle, NDArray[np.float64], NDArray[np.float64]]]:
        """Yield each obstacle with the range (m; infinite for none) of each ray, and how square the ray meets it.

        That is the sine of the angle between ray and edge, the cosine of the angle of incidence.

        Those that a sensor of this `reach` (m) can't measure are left out.
        """
        waves = None
        for name, obstacle in self._obstacles.items():
            middle_x, middle_y, radius = self._circles[name]
            if math.hypot(middle_x - x, middle_y - y) - radius <= reach + _REACH_MARGIN_M:
                waves = waves or (np.cos(directions), np.sin(directions))
                yield obstacle, *edge_ranges(*self._edges[name], x, y, *waves)


def _circle_around(points: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return centre and radius (m) of a circle that holds all points."""
    x, y = (float(value) for value in np.mean(points, axis=0))
    return x, y, float(np.max(np.hypot(points[:, 0] - x, points[:, 1] - y)))
