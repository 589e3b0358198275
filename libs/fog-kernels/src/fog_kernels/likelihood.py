"""Likelihood field of a range scanner (Thrun, Burgard and Fox 2005, chapter 6.4)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fog_kernels import _arrays
from fog_kernels.distance import squared_distance_capped

if TYPE_CHECKING:
    from numpy.typing import NDArray


def likelihood_field(  # noqa: PLR0913  # the field's grid and the sensor's model, as plain numbers
    occupied: NDArray[np.bool_ | np.uint8],
    resolution: float,
    sigma_hit: float = 0.2,
    max_distance: float = 2.0,
    z_hit: float = 0.5,
    z_rand: float = 0.5,
    range_max: float = 12.0,
) -> NDArray[np.float32]:
    """Return each cell's contribution to the score of a beam that ends in it: p^3, float32 (h, w).

    p = z_hit * exp(-d^2 / (2 sigma_hit^2)) + z_rand / range_max, with d the distance in metres to the nearest occupied
    cell, at most `max_distance`. Summing cubes over beams instead of multiplying p is what AMCL's likelihood field
    model does: it tempers the dependence between beams. `occupied` is (h, w), bool or uint8, non-zero is a wall.
    Raises TypeError or ValueError for wrong types, shapes or ranges.
    """
    resolution = _arrays.positive(resolution, "resolution")
    sigma_hit = _arrays.positive(sigma_hit, "sigma_hit")
    max_distance = _arrays.positive(max_distance, "max_distance")
    range_max = _arrays.positive(range_max, "range_max")
    if z_hit < 0.0 or z_rand < 0.0:
        raise ValueError(f"z_hit and z_rand must not be negative, not {z_hit} and {z_rand}")
    cap = math.ceil(max_distance / resolution)
    distance = np.minimum(np.sqrt(np.arange(cap * cap + 1)) * resolution, max_distance)
    p = z_hit * np.exp(-(distance**2) / (2.0 * sigma_hit**2)) + z_rand / range_max
    return (p**3).astype(np.float32)[squared_distance_capped(occupied, cap)]
