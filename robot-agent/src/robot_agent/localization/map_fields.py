"""Fields of the static map for localization, computed once per map: likelihoods, wall distances, free places.

Method: likelihood field of a range scanner (Thrun, Burgard and Fox 2005, chapter 6.4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import FREE, LETHAL
from fog_kernels import amcl, scans
from fog_kernels.distance import likelihood_field, squared_distance_capped
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.pose import Pose2

_WALL_DISTANCE_MAX_M: Final = 1.0
"""Wall distances are exact up to here."""
_FREE_CLEARANCE_M: Final = 0.15
"""Candidate poses lie on free cells at least this far from a wall."""


@dataclass(frozen=True, slots=True)
class MapFields:
    """Tables over the cells of a static map, all (height, width) of `geometry`.

    occupied: uint8, 1 where the map has a wall. fine, coarse: float32, the likelihood of a beam that ends there, the
    coarse one blurred twice as wide; sharp: the same for matching, exp(-d^2 / 2 sigma^2). best_likelihood: the highest
    value of fine and coarse. wall_distance: float32, m to the
    nearest face of a wall, at most 1. free_places: float64 (n, 2), m in `map`, centres of the cells where a robot fits.
    """

    geometry: GridGeometry
    occupied: NDArray[np.uint8]
    fine: NDArray[np.float32]
    coarse: NDArray[np.float32]
    sharp: NDArray[np.float32]
    best_likelihood: float
    wall_distance: NDArray[np.float32]
    free_places: NDArray[np.float64]

    def matches(self, static: NDArray[np.uint8], geometry: GridGeometry) -> bool:
        """Whether these are the fields of a map with the same walls."""
        return self.geometry == geometry and np.array_equal(static == LETHAL, self.occupied)

    def wall_distances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances (n; m, at most 1) of points (n, 2; m) in `map` to the nearest wall; 1 off the map."""
        return self.geometry.sample(self.wall_distance, points, _WALL_DISTANCE_MAX_M).astype(np.float64)

    def ranges(self, x: float, y: float, angles: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
        """Return the ranges (n; m) to the first wall from (x, y) in `map` along angles (n; rad), inf beyond `reach`."""
        g = self.geometry
        return cast(self.occupied, g.resolution, g.origin_x, g.origin_y, x, y, angles, reach)

    def compared(
        self, pose: Pose2, points: NDArray[np.float64], reach: float, tolerances: scans.Tolerances
    ) -> scans.Compared:
        """Compare points (n, 2; m), measured at a pose in `map`, with the ranges to walls there, up to `reach` m."""
        g = self.geometry
        return scans.compared(
            points,
            pose,
            self.occupied,
            self.wall_distance,
            g.resolution,
            (g.origin_x, g.origin_y),
            _WALL_DISTANCE_MAX_M,
            reach,
            tolerances,
        )

    def scores(
        self, poses: NDArray[np.float64], points: NDArray[np.float64], field: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Return the mean of a likelihood field at the points (m, 2; m, frame `base`) for each pose (n, 3) in `map`."""
        g = self.geometry
        angles, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
        return amcl.score_poses(
            poses[:, 0], poses[:, 1], poses[:, 2], field, g.resolution, g.origin_x, g.origin_y, angles, ranges
        )

    def agreements(
        self, poses: NDArray[np.float64], points: NDArray[np.float64], field: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        """Return the same for `fine` or `coarse` as shares (n,) of the value that perfect agreement has."""
        return self.scores(poses, points, field) / self.best_likelihood


def map_fields(static: NDArray[np.uint8], geometry: GridGeometry, config: LocalizationConfig) -> MapFields:
    """Compute the fields of a static map (height, width; 0 free, 254 occupied, 255 unknown)."""
    occupied = np.ascontiguousarray(static == LETHAL).astype(np.uint8)
    # A beam ends at the face of a wall; cells inside solid blocks must not be likely.
    faces = occupied & ~_eroded(occupied)

    def field(sigma: float) -> NDArray[np.float32]:
        return likelihood_field(
            faces, geometry.resolution, sigma, config.field_reach, config.z_hit, config.z_rand, config.range_max
        )

    cap = max(1, math.ceil(_WALL_DISTANCE_MAX_M / geometry.resolution))
    wall_distance = (np.sqrt(squared_distance_capped(faces, cap)) * geometry.resolution).astype(np.float32)
    rows, columns = np.nonzero((static == FREE) & (wall_distance >= _FREE_CLEARANCE_M))
    return MapFields(
        geometry=geometry,
        occupied=occupied,
        fine=field(config.sigma_hit),
        coarse=field(2.0 * config.sigma_hit),
        # The field holds cubes: the cube of a Gaussian is one that is narrower by the root of 3.
        sharp=likelihood_field(
            faces, geometry.resolution, math.sqrt(3.0) * config.match_sigma, config.field_reach, 1.0, 0.0
        ),
        best_likelihood=(config.z_hit + config.z_rand / config.range_max) ** 3,
        wall_distance=wall_distance,
        free_places=geometry.centres(np.column_stack((columns, rows))),
    )


def _eroded(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return 1 where a cell and its eight neighbours are all 1; beyond the border counts as 1."""
    padded = np.pad(cells, 1, constant_values=1)
    height, width = cells.shape
    out = np.ones_like(cells)
    for row in range(3):
        for column in range(3):
            out &= padded[row : row + height, column : column + width]
    return out
