"""The path ahead, point by point: what lies on it, how much room is beside it, whether anything known blocks it.

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
from fog_kernels.lines import nearest_place

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


# These keep the GIL: they take some microseconds, and another thread may keep it for longer before it gives it back.
# They return no arrays, since numba takes longer to hand one over than numpy to make it.
@njit(int64(_arrays.F64_GRID, float64, _arrays.I64_OUT), cache=True, error_model="numpy")
def _count_samples(corners: Any, spacing: float, counts: Any) -> int:
    """Write into how many parts each line is divided; return how many points there are."""
    total = 1
    for i in range(counts.size):
        length = math.hypot(corners[i + 1, 0] - corners[i, 0], corners[i + 1, 1] - corners[i, 1])
        counts[i] = max(math.ceil(length / spacing), 1)
        total += counts[i]
    return int(total)


@njit(
    void(_arrays.F64_GRID, types.Array(types.int64, 1, "C", readonly=True), _arrays.F64_GRID_OUT, _arrays.F64_OUT),
    cache=True, error_model="numpy",
)  # fmt: skip
def _sample(corners: Any, counts: Any, points: Any, along: Any) -> None:
    """Write the points along a line, and how far along it each is."""
    x, y = corners[0, 0], corners[0, 1]
    points[0, 0], points[0, 1] = x, y
    along[0] = total = 0.0
    n = 1
    for i in range(counts.size):
        step_x, step_y = corners[i + 1, 0] - corners[i, 0], corners[i + 1, 1] - corners[i, 1]
        for k in range(1, counts[i] + 1):
            before_x, before_y = x, y
            x, y = corners[i + 1, 0], corners[i + 1, 1]
            if k < counts[i]:
                share = k / counts[i]
                x, y = corners[i, 0] + share * step_x, corners[i, 1] + share * step_y
            total += math.hypot(x - before_x, y - before_y)
            points[n, 0], points[n, 1], along[n] = x, y, total
            n += 1


@njit(
    void(_arrays.F64_GRID, _arrays.U8_GRID, float64, float64, float64, types.Array(types.uint8, 1, "C")),
    cache=True, error_model="numpy",
)  # fmt: skip
def _values(points: Any, grid: Any, left: float, bottom: float, resolution: float, found: Any) -> None:
    """Write the grid's values at points, as far as it has any."""
    height, width = grid.shape
    for i in range(points.shape[0]):
        column = math.floor((points[i, 0] - left) / resolution)
        row = math.floor((points[i, 1] - bottom) / resolution)
        if 0 <= column < width and 0 <= row < height:
            found[i] = grid[int(row), int(column)]


@njit(
    void(_arrays.F64_GRID, _arrays.F64_FLAT, _arrays.U8_GRID, float64, float64, float64, float64, _arrays.F64_OUT),
    cache=True, error_model="numpy",
)  # fmt: skip
def _seconds(
    points: Any, along: Any, limits: Any, left: float, bottom: float, resolution: float, usual: float, found: Any
) -> None:
    """Write the time (s) to each point: at the usual speed (m/s), or by limits (cm/s, 0: none) that are lower."""
    height, width = limits.shape
    found[0] = total = 0.0
    for i in range(1, along.size):
        column = math.floor(((points[i - 1, 0] + points[i, 0]) / 2.0 - left) / resolution)
        row = math.floor(((points[i - 1, 1] + points[i, 1]) / 2.0 - bottom) / resolution)
        speed = usual
        if 0 <= column < width and 0 <= row < height and limits[int(row), int(column)] > 0:
            speed = min(usual, limits[int(row), int(column)] / 100.0)
        total += (along[i] - along[i - 1]) / speed
        found[i] = total


@njit(
    int64(_arrays.F64_GRID, _arrays.F64_GRID, _arrays.F64_FLAT, float64, float64, float64),
    cache=True, error_model="numpy",
)  # fmt: skip
def _last_beside(points: Any, line: Any, along: Any, reach: float, behind: float, ahead: float) -> int:
    """See `last_beside`."""
    found = np.empty(2)
    reached = 0.0
    last = 0
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        nearest_place(line, along, reached - behind, reached + ahead, x, y, found)
        if math.isinf(found[1]):
            nearest_place(line, along, -math.inf, math.inf, x, y, found)
        if math.isinf(found[1]):  # all its points are one
            found[1] = (line[0, 0] - x) ** 2 + (line[0, 1] - y) ** 2
        if math.sqrt(found[1]) > reach:
            break
        reached = max(reached, found[0])
        last = i
    return last


def sampled_along(corners: NDArray[np.float64], spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return `fog_contracts.geometry.sampled`, float64 (m, 2), and how far along the line each point is, (m,).

    Bit for bit, in a fraction of the time. Raises TypeError or ValueError for corners other than float64 (n, 2).
    """
    counts = np.empty(len(_polyline(corners, "corners")) - 1, np.int64)
    count = int(_count_samples(corners, _arrays.positive(spacing, "spacing"), counts))
    points, along = np.empty((count, 2)), np.empty(count)
    _sample(corners, counts, points, along)
    return points, along


def values_at(
    points: NDArray[np.float64], grid: NDArray[np.uint8], place: tuple[float, float, float], outside: int
) -> NDArray[np.uint8]:
    """Return the values (n,) of a grid (h, w) at points (n, 2; m); `outside` where it has none.

    `place`: x and y (m) of its lower left corner, and its resolution (m). Raises TypeError or ValueError for other
    types or shapes.
    """
    values = np.full(len(_polyline(points, "points")), outside, np.uint8)
    _values(points, _arrays.grid(grid, "grid"), *place, values)
    return values


def seconds_along(
    points: NDArray[np.float64],
    along: NDArray[np.float64],
    limits: NDArray[np.uint8],
    place: tuple[float, float, float],
    usual: float,
) -> NDArray[np.float64]:
    """Return the time (s, (n,)) that a robot takes to each point of a line, as `sampled_along` returns them.

    At `usual` (m/s), or slower where the cell between two points has a limit (cm/s, 0: none); `place` as for
    `values_at`. Raises TypeError or ValueError for other types or shapes.
    """
    _arrays.exact(along, np.float64, 1, "along")
    if len(_polyline(points, "points")) != along.size:
        raise ValueError(f"along must have one number for each of the {len(points)} points, not {along.size}")
    seconds = np.empty(along.size)
    _seconds(points, along, _arrays.grid(limits, "limits"), *place, _arrays.positive(usual, "usual"), seconds)
    return seconds


def last_beside(
    points: NDArray[np.float64],
    line: NDArray[np.float64],
    along: NDArray[np.float64],
    reach: float,
    window: tuple[float, float],
) -> int:
    """Return the last of the points (n, 2; m) up to which all are within `reach` (m) of another line; 0 without one.

    Each is looked for within `window` (m behind and ahead) of how far along the other line (m, 2; m) one before it got;
    `along`: how far its points are. Raises TypeError or ValueError for other types or shapes.
    """
    _arrays.exact(along, np.float64, 1, "along")
    if len(_polyline(line, "line")) != along.size:
        raise ValueError(f"along must have one number for each of the {len(line)} points of the line, not {along.size}")
    return int(_last_beside(_polyline(points, "points"), line, along, float(reach), *window))


def _polyline(points: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    _arrays.exact(points, np.float64, 2, name)
    if len(points) == 0 or points.shape[1] != 2:
        raise ValueError(f"{name} must have shape (n, 2) with n >= 1, not {points.shape}")
    return points


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
