"""Exact squared Euclidean distances to the nearest occupied cell, capped, and the likelihood field made of them.

Method: separable transform, columns first, then the minimum over a window of each row (Saito and Toriwaki 1994); the
cap bounds the window, which makes a plain vectorized minimum faster than lower envelopes. The likelihood field of a
range scanner is that of Thrun, Burgard and Fox (2005, chapter 6.4).
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import int64, njit, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_CAP = 32_000  # twice its square still fits int32


@njit(void(_arrays.U8_GRID, int64, _arrays.I32_GRID_OUT), cache=True, nogil=True)
def _squared_distance(occupied: Any, cap: int, out: Any) -> None:
    height, width = occupied.shape
    for y in range(height):
        row = out[y]
        source = occupied[y]
        if y == 0:
            for x in range(width):
                row[x] = 0 if source[x] != 0 else cap
        else:
            above = out[y - 1]
            for x in range(width):
                step = min(above[x] + 1, cap)
                row[x] = 0 if source[x] != 0 else step
    for y in range(height - 2, -1, -1):
        row = out[y]
        below = out[y + 1]
        for x in range(width):
            row[x] = min(row[x], below[x] + 1)
    padded = np.full(width + 2 * cap, np.int32(cap * cap), np.int32)
    for y in range(height):
        row = out[y]
        centre = padded[cap : cap + width]
        nearest = cap
        for x in range(width):
            nearest = min(nearest, row[x])
            row[x] = np.int32(row[x] * row[x])
            centre[x] = row[x]
        if nearest == cap:
            continue  # nothing within reach of the whole row
        for shift in range(1, cap):
            square = np.int32(shift * shift)
            left = padded[cap - shift : cap - shift + width]
            right = padded[cap + shift : cap + shift + width]
            for x in range(width):
                best = np.int32(min(left[x], right[x]) + square)
                row[x] = min(row[x], best)


def squared_distance_capped(occupied: NDArray[np.bool_ | np.uint8], cap_cells: int) -> NDArray[np.int32]:
    """Return the exact squared distance (cells^2) of every cell to the nearest occupied one, at most cap_cells^2.

    `occupied` is (h, w), bool or uint8, non-zero meaning occupied; the result is int32 (h, w).
    Raises ValueError for a cap outside 1..32000 and for a wrong shape, TypeError for a wrong dtype.
    """
    cells = _arrays.grid(occupied, "occupied")
    if not 1 <= cap_cells <= MAX_CAP:
        raise ValueError(f"cap_cells must be 1..{MAX_CAP}, not {cap_cells}")
    out = np.empty(cells.shape, np.int32)
    _squared_distance(cells, cap_cells, out)
    return out


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
