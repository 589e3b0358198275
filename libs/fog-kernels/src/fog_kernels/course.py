"""The path ahead, point by point: how much room is beside it, and whether anything that the robot knows blocks it.

Each is one call for a path: while nothing is in the way, which is nearly always, no cost of a cell beside it is needed.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import boolean, float64, int64, njit, types, void

from fog_contracts.costs import INSCRIBED, UNKNOWN
from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.clearance import Clearance


class Cells(NamedTuple):
    """A costmap (uint8 (h, w)), m per cell, and its lower-left corner (m)."""

    cost: NDArray[np.uint8]
    resolution: float
    left: float
    bottom: float


_VECTOR: Any = types.Array(types.float64, 1, "C")
_ALONG: Any = types.Tuple((types.Array(types.float64, 2, "C"), _VECTOR, _VECTOR))  # type: ignore[no-untyped-call]  # numba has no types

# Inlined before compilation: passing an array to a compiled function costs reference counting at each call.
_helper = njit(inline="always", cache=True)


@_helper
def _lengths(path: Any, along: Any) -> None:
    """Write how far (m) along a path each of its points is."""
    along[0] = 0.0
    for i in range(1, along.size):
        dx = path[i, 0] - path[i - 1, 0]
        dy = path[i, 1] - path[i - 1, 1]
        along[i] = along[i - 1] + math.sqrt(dx * dx + dy * dy)


@_helper
def _point_at(path: Any, along: Any, where: float, segment: int) -> tuple[float, float, int]:
    """Return the point (m) so far along a path, and its segment; `segment`: where to begin to look for it."""
    last = along.size - 1
    while segment < last and along[segment + 1] <= where:
        segment += 1
    x, y = path[segment, 0], path[segment, 1]
    if segment < last and along[segment] != where:
        length = along[segment + 1] - along[segment]
        on = where - along[segment]
        x = (path[segment + 1, 0] - x) / length * on + x
        y = (path[segment + 1, 1] - y) / length * on + y
    return x, y, segment


@_helper
def _distance_at(field: Any, column: float, row: float) -> float:
    """Return the distance (m) at a place (cells, centres being whole numbers), interpolated between centres."""
    last = field.shape[0] - 1
    column = min(max(column, 0.0), float(last))
    row = min(max(row, 0.0), float(last))
    i = min(int(column), last - 1)
    j = min(int(row), last - 1)
    c = column - i
    r = row - j
    below = (1.0 - c) * field[j, i] + c * field[j, i + 1]
    above = (1.0 - c) * field[j + 1, i] + c * field[j + 1, i + 1]
    between: float = (1.0 - r) * below + r * above
    return between


@njit(
    void(_arrays.F64_GRID, _arrays.F32_GRID, float64, float64, float64, _arrays.F64_OUT),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _distances(points: Any, field: Any, resolution: float, left: float, bottom: float, found: Any) -> None:
    """Write the distances (m) at points."""
    for i in range(points.shape[0]):
        column = (points[i, 0] - left) / resolution - 0.5
        row = (points[i, 1] - bottom) / resolution - 0.5
        found[i] = _distance_at(field, column, row)


@njit(  # type: ignore[untyped-decorator]  # numba has no types for tuples
    _ALONG(_arrays.F64_GRID, float64, _arrays.F32_GRID, float64, float64, float64),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _beside(path: Any, spacing: float, field: Any, resolution: float, left: float, bottom: float) -> Any:
    """Return points (n, 2; m) of a path, how far along it they are (m), and the distances there (m)."""
    along = np.empty(path.shape[0])
    _lengths(path, along)
    length = along[along.size - 1]
    count = max(2, math.ceil(length / spacing) + 1)
    step = length / (count - 1)
    points = np.empty((count, 2))
    ahead = np.empty(count)
    found = np.empty(count)
    segment = 0
    for i in range(count):
        where = length if i == count - 1 else i * step
        x, y, segment = _point_at(path, along, where, segment)
        points[i, 0] = x
        points[i, 1] = y
        ahead[i] = where
        column = (x - left) / resolution - 0.5
        row = (y - bottom) / resolution - 0.5
        found[i] = _distance_at(field, column, row)
    return points, ahead, found


@njit(
    boolean(
        float64, float64, _arrays.F64_GRID, float64, _arrays.U8_GRID, float64, float64, float64, _arrays.F64_GRID,
        int64, int64, _arrays.F32_GRID, int64, int64, int64, float64,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _is_blocked(
    x: float,
    y: float,
    path: Any,
    spacing: float,
    costmap: Any,
    resolution: float,
    left: float,
    bottom: float,
    points: Any,
    reach: int,
    square: int,
    field: Any,
    finer: int,
    first_column: int,
    first_row: int,
    narrowest: float,
) -> bool:
    """See `is_blocked`; the field begins in this column and row of the costmap."""
    height, width = costmap.shape
    marks = np.zeros((height + 2 * reach, width + 2 * reach), np.bool_)
    for i in range(points.shape[0]):
        c = math.floor((points[i, 0] - left) / resolution)
        r = math.floor((points[i, 1] - bottom) / resolution)
        if 0 <= c < width and 0 <= r < height:
            marks[int(r) + reach, int(c) + reach] = True
    route = np.empty((path.shape[0] + 1, 2))
    route[0, 0] = x
    route[0, 1] = y
    for i in range(path.shape[0]):
        route[i + 1, 0] = path[i, 0]
        route[i + 1, 1] = path[i, 1]
    along = np.empty(route.shape[0])
    _lengths(route, along)
    length = along[along.size - 1]
    count = max(2, math.ceil(length / spacing) + 1)
    step = length / (count - 1)
    side = field.shape[0] // finer
    least = np.float32(narrowest)
    segment = 0
    for i in range(count):
        at_x, at_y, segment = _point_at(route, along, length if i == count - 1 else i * step, segment)
        across = math.floor((at_x - left) / resolution)
        up = math.floor((at_y - bottom) / resolution)
        if not (0 <= across < width and 0 <= up < height):
            continue
        column, row = int(across), int(up)
        cost = costmap[row, column]
        if cost == UNKNOWN:
            continue
        if cost >= INSCRIBED:
            return True
        begin, low = column - first_column, row - first_row
        if 0 <= begin < side and 0 <= low < side:
            free = np.float32(0.0)
            for r in range(low * finer, (low + 1) * finer):
                for c in range(begin * finer, (begin + 1) * finer):
                    free = max(free, field[r, c])
            if free < least:
                return True
            continue
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                if dx * dx + dy * dy <= square and marks[row + reach + dy, column + reach + dx]:
                    return True
    return False


def distances(around: Clearance, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances (m) at points (n, 2; m) from the nearest thing, interpolated between cells.

    Raises ValueError for points that are not finite.
    """
    found = np.empty(len(points))
    places = np.ascontiguousarray(points, np.float64)
    if not np.isfinite(places).all():
        raise ValueError("points must be finite")
    _distances(places, around.distance, around.resolution, around.origin_x, around.origin_y, found)
    return found


def beside(
    path: NDArray[np.float64], spacing: float, around: Clearance
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return points (n, 2; m) every `spacing` m of a path (m, 2; m), how far along it they are, and their distances.

    The path's first and last point are among them. Distances (m) are those from the nearest thing; beyond the window of
    `around` they are those at its border.
    Raises ValueError for a path without a point or with one that isn't finite.
    """
    line = _line(path)
    found: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] = _beside(
        line, spacing, around.distance, around.resolution, around.origin_x, around.origin_y
    )
    return found


def is_blocked(
    x: float,
    y: float,
    path: NDArray[np.float64],
    spacing: float,
    cells: Cells,
    lidar_points: NDArray[np.float64],
    square: int,
    around: Clearance,
    narrowest: float,
) -> bool:
    """Whether the straight way to a path (n, 2; m), or the path itself, enters a cell in which the body can't be.

    It is looked up every `spacing` m. A cell that the map calls inscribed or lethal is one, an unknown one is none. Of
    the others, those in the window of `around` are when nowhere in them `narrowest` (m) are free; those beyond, when a
    lidar point (m, 2; m) lies in a cell of the map whose squared distance (in cells) is `square` or less.
    `lidar_points` must be finite. Raises ValueError for a path without a point or with one that isn't finite.
    """
    finer = round(cells.resolution / around.resolution)
    column = math.floor((around.origin_x + 0.5 * around.resolution - cells.left) / cells.resolution)
    row = math.floor((around.origin_y + 0.5 * around.resolution - cells.bottom) / cells.resolution)
    blocked: bool = _is_blocked(
        x, y, _line(path), spacing, _arrays.grid(cells.cost, "cost"), cells.resolution, cells.left, cells.bottom,
        np.ascontiguousarray(lidar_points, np.float64).reshape(-1, 2), math.isqrt(square), square, around.distance,
        finer, column, row, narrowest,
    )  # fmt: skip
    return blocked


def _line(path: NDArray[np.float64]) -> NDArray[np.float64]:
    line = np.ascontiguousarray(path, np.float64)
    if line.ndim != 2 or line.shape[1] != 2 or len(line) == 0:
        raise ValueError(f"a path has shape (n, 2) with n >= 1, not {line.shape}")
    if not math.isfinite(float(line.sum())):
        raise ValueError("a path must be finite: leave out what is not known")
    return line
