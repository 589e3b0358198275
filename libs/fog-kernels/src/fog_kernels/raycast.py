"""Ranges to the nearest occupied cell along rays, by exact grid traversal (Amanatides and Woo 1987)."""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import boolean, float64, njit, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


@njit(
    void(_arrays.U8_GRID, float64, float64, _arrays.F64_FLAT, float64, _arrays.F64_OUT),
    cache=True,
    nogil=True,
)
def _cast(occupied: Any, x: float, y: float, angles: Any, reach: float, out: Any) -> None:
    """Lengths are in cells; out[i] is the distance at which ray i enters an occupied cell, or infinite."""
    height, width = occupied.shape
    for i in range(angles.size):
        out[i] = math.inf
        dx = math.cos(angles[i])
        dy = math.sin(angles[i])
        # The part of the ray inside the grid.
        enter = 0.0
        leave = reach
        if dx != 0.0:
            near = (0.0 - x) / dx if dx > 0.0 else (width - x) / dx
            far = (width - x) / dx if dx > 0.0 else (0.0 - x) / dx
            enter = max(enter, near)
            leave = min(leave, far)
        elif x < 0.0 or x >= width:
            continue
        if dy != 0.0:
            near = (0.0 - y) / dy if dy > 0.0 else (height - y) / dy
            far = (height - y) / dy if dy > 0.0 else (0.0 - y) / dy
            enter = max(enter, near)
            leave = min(leave, far)
        elif y < 0.0 or y >= height:
            continue
        # A ray that only touches the grid enters no cell, but for the one in which it starts.
        starts_inside = 0.0 <= x < width and 0.0 <= y < height
        if enter > leave or (enter == leave and not starts_inside):
            continue
        column = min(max(math.floor(x + enter * dx), 0), width - 1)
        row = min(max(math.floor(y + enter * dy), 0), height - 1)
        step_x = 1 if dx > 0.0 else -1
        step_y = 1 if dy > 0.0 else -1
        delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
        delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
        next_x = (column + (1 if dx > 0.0 else 0) - x) / dx if dx != 0.0 else math.inf
        next_y = (row + (1 if dy > 0.0 else 0) - y) / dy if dy != 0.0 else math.inf
        travelled = enter
        while travelled <= reach:
            if occupied[row, column] != 0:
                out[i] = travelled
                break
            if next_x < next_y:
                travelled = next_x
                next_x += delta_x
                column += step_x
                if column < 0 or column >= width:
                    break
            else:
                travelled = next_y
                next_y += delta_y
                row += step_y
                if row < 0 or row >= height:
                    break


@njit(
    boolean(_arrays.U8_GRID, float64, float64, _arrays.F64_FLAT, float64, float64, _arrays.F64_OUT),
    cache=True,
    nogil=True,
)
def _cast_metres(occupied: Any, x: float, y: float, angles: Any, reach: float, resolution: float, out: Any) -> bool:
    """Write the ranges in metres; return False for angles that aren't finite."""
    for i in range(angles.size):
        if not math.isfinite(angles[i]):
            return False
    _cast(occupied, x, y, angles, reach, out)
    for i in range(out.size):
        out[i] *= resolution
    return True


def cast(
    occupied: NDArray[np.bool_ | np.uint8],
    resolution: float,
    origin_x: float,
    origin_y: float,
    x: float,
    y: float,
    angles: ArrayLike,
    max_range: float,
) -> NDArray[np.float64]:
    """Return the range in metres along each ray from (x, y), or inf when nothing is hit within `max_range`.

    `occupied`: (h, w) bool or uint8, non-zero blocks; row 0 at the bottom, the lower-left corner of cell (0, 0) at
    (origin_x, origin_y); cells outside the grid are empty. `angles`: radians in `map`, (n,). A start inside an occupied
    cell gives 0. Raises TypeError or ValueError for wrong types or shapes or numbers that aren't finite.
    """
    cells = _arrays.grid(occupied, "occupied")
    resolution = _arrays.positive(resolution, "resolution")
    directions = _arrays.vector(angles, "angles")
    start = ((float(x) - origin_x) / resolution, (float(y) - origin_y) / resolution)
    reach = _arrays.positive(max_range, "max_range") / resolution
    out = np.empty(directions.size)
    finite = math.isfinite(start[0]) and math.isfinite(start[1])
    if not (finite and _cast_metres(cells, *start, directions, reach, resolution, out)):
        raise ValueError("x, y, origin and angles must be finite")
    return out
