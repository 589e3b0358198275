"""What emulated sensors measure and send, in few calls: an emulation runs them a hundred times a second.

Each call of numpy costs more than the twenty values that it works on here. Whatever numpy computes otherwise than this
compiler would in the last digit (sine, cosine, arc cosine) the callers compute with numpy.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per value
# would cost more than its work.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numba import boolean, float64, int64, njit, types, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

FULL_CIRCLE_Q6: Final = 360 * 64
NODE_BYTES: Final = 5
_FULL_QUALITY_M: Final = 6.0

_BOOL_OUT = types.Array(boolean, 1, "C")
_BOOL_FLAT = types.Array(boolean, 1, "C", readonly=True)
_I64_FLAT = types.Array(types.int64, 1, "C", readonly=True)


class RecordedErrors(NamedTuple):
    """How a lidar of which there are recordings errs.

    noise, loss: float64[n, 2], ranges (m) with the standard deviation there (m), and with the share of measurements
    that don't return. Of all errors the share `tail` is `tail_sigmas` times as large; `outliers`: share of measurements
    that give any range from `low` to `high` (m), which are its limits.
    """

    noise: NDArray[np.float64]
    loss: NDArray[np.float64]
    tail: float
    tail_sigmas: float
    outliers: float
    low: float
    high: float


class Beams(NamedTuple):
    """A lidar's n beams: float64[n] each. angle: rad, in the lidar's frame. cos, sin: of the direction on the floor."""

    angle: NDArray[np.float64]
    cos: NDArray[np.float64]
    sin: NDArray[np.float64]


class Drawn(NamedTuple):
    """Numbers drawn for n beams.

    tail, normal: float64[n], one beneath 1 and one of the standard normal distribution. uniform: float64[3 + p, n],
    beneath 1: whether it is an outlier, where, whether it is lost, and whether each of p patches swallows it.
    """

    tail: NDArray[np.float64]
    normal: NDArray[np.float64]
    uniform: NDArray[np.float64]


class NodeAngles(NamedTuple):
    """Where a lidar's head stands at n measurements.

    position: rotations at the last one. angle_q6: int64[n], degrees / 64, clockwise, 0..23039. start: bool[n], first
    measurement of a rotation.
    """

    position: float
    angle_q6: NDArray[np.int64]
    start: NDArray[np.bool_]


@njit(float64(float64, float64, _arrays.I64_OUT, _BOOL_OUT), cache=True, nogil=True)
def _node_angles(position: float, step: float, angle_q6: Any, start: Any) -> float:
    before = position
    for i in range(angle_q6.size):
        rotation = position + (i + 1) * step
        angle_q6[i] = np.int64(math.floor(rotation % 1.0 * FULL_CIRCLE_Q6)) % FULL_CIRCLE_Q6
        start[i] = math.floor(rotation) > math.floor(before)
        before = rotation
    return before


@njit(
    void(_I64_FLAT, _BOOL_FLAT, _arrays.F64_FLAT, float64, float64, types.Array(types.uint8, 2, "C")),
    cache=True,
    nogil=True,
)
def _encode_nodes(angle_q6: Any, start: Any, ranges: Any, low: float, high: float, raw: Any) -> None:
    for i in range(ranges.size):
        distance = np.int64(0)
        quality = np.int64(0)
        if low <= ranges[i] <= high:
            distance = np.int64(np.rint(ranges[i] * 4000.0))
            strength = np.rint(15.0 - (distance / 4000.0 - _FULL_QUALITY_M) * 10.0 / 6.0)
            quality = np.int64(min(max(strength, 0.0), 15.0))
        raw[i, 0] = quality << 2 | (1 if start[i] else 2)
        raw[i, 1] = (angle_q6[i] << 1 | 1) & 0xFF
        raw[i, 2] = angle_q6[i] >> 7
        raw[i, 3] = distance & 0xFF
        raw[i, 4] = distance >> 8


@njit(
    void(_arrays.F64_OUT, _arrays.F64_FLAT, _arrays.F64_FLAT, float64, float64, float64, float64, float64),
    cache=True,
    nogil=True,
)
def _disturb(
    ranges: Any, normal: Any, uniform: Any, sigma: float, share: float, dropout: float, low: float, high: float
) -> None:
    for i in range(ranges.size):
        known = ranges[i] if math.isfinite(ranges[i]) else 0.0
        measured = ranges[i] + (sigma + share * known) * normal[i]
        ranges[i] = measured if low <= measured <= high and not uniform[i] < dropout else math.nan


_helper = njit(inline="always", cache=True)
"""As in `clearance`: small functions that are compiled into the kernels that use them."""


@_helper
def _interpolated(x: float, table: Any) -> float:
    """Return what `numpy.interp` does between the rows (x, y) of a table."""
    k = 0
    while k < table.shape[0] and x >= table[k, 0]:
        k += 1
    y: float = table[max(k - 1, 0), 1]
    if 0 < k < table.shape[0]:
        slope = (table[k, 1] - y) / (table[k, 0] - table[k - 1, 0])
        y += slope * (x - table[k - 1, 0])
    return y


@_helper
def _in_sector(angle: float, begin: float, end: float) -> bool:
    return (angle - begin) % math.tau <= (end - begin) % math.tau


@njit(void(_arrays.F64_OUT, _arrays.F64_FLAT, _arrays.F64_GRID, float64), cache=True, nogil=True)
def _set_in_sectors(ranges: Any, angles: Any, sectors: Any, value: float) -> None:
    for i in range(ranges.size):
        for k in range(sectors.shape[0]):
            if _in_sector(angles[i], sectors[k, 0], sectors[k, 1]):
                ranges[i] = value


@njit(
    void(
        _arrays.F64_OUT,
        _arrays.F64_FLAT,
        _arrays.F64_FLAT,
        _arrays.F64_FLAT,
        _arrays.F64_FLAT,
        _arrays.F64_FLAT,
        _arrays.F64_GRID,
        _arrays.F64_GRID,
        _arrays.F64_GRID,
        float64,
        float64,
        float64,
        float64,
        float64,
        float64,
        float64,
        _arrays.F64_GRID,
        _arrays.F64_GRID,
    ),
    cache=True,
    nogil=True,
)
def _disturb_as_recorded(
    ranges: Any,
    angles: Any,
    cos: Any,
    sin: Any,
    tail: Any,
    normal: Any,
    uniform: Any,
    noise: Any,
    loss: Any,
    tail_share: float,
    tail_sigmas: float,
    outliers: float,
    low: float,
    high: float,
    x: float,
    y: float,
    patches: Any,
    dead: Any,
) -> None:
    for i in range(ranges.size):
        known = ranges[i] if math.isfinite(ranges[i]) else high
        sigma = _interpolated(known, noise)
        if tail[i] < tail_share:
            sigma *= tail_sigmas
        measured = ranges[i] + sigma * normal[i]
        if uniform[0, i] < outliers:
            measured = low + (high - low) * uniform[1, i]
        lost = uniform[2, i] < _interpolated(known, loss)
        end_x = x + known * cos[i]
        end_y = y + known * sin[i]
        for k in range(patches.shape[0]):
            if math.hypot(end_x - patches[k, 0], end_y - patches[k, 1]) < patches[k, 2]:
                lost = lost or uniform[3 + k, i] >= patches[k, 3]
        for k in range(dead.shape[0]):
            lost = lost or _in_sector(angles[i], dead[k, 0], dead[k, 1])
        ranges[i] = measured if low <= measured <= high and not lost else math.nan


@njit(
    void(
        _arrays.F64_GRID,
        _arrays.F64_FLAT,
        float64,
        float64,
        _arrays.F64_FLAT,
        _arrays.F64_FLAT,
        _arrays.F64_OUT,
        _arrays.F64_OUT,
    ),
    cache=True,
    nogil=True,
)
def _edge_ranges(
    edges: Any, lengths: Any, x: float, y: float, cos: Any, sin: Any, ranges: Any, squareness: Any
) -> None:
    for i in range(cos.size):
        nearest = math.inf
        square = 0.0
        for k in range(lengths.size):
            ax = edges[k, 0] - x
            ay = edges[k, 1] - y
            ex = edges[k, 2] - edges[k, 0]
            ey = edges[k, 3] - edges[k, 1]
            across = cos[i] * ey - sin[i] * ex
            if k == 0:  # of a ray that meets none
                square = abs(across) / max(lengths[k], 1e-12)
            if across == 0.0:
                continue
            along_ray = (ax * ey - ay * ex) / across
            along_edge = (ax * sin[i] - ay * cos[i]) / across
            if along_ray >= 0.0 and 0.0 <= along_edge <= 1.0 and along_ray < nearest:
                nearest = along_ray
                square = abs(across) / max(lengths[k], 1e-12)
        ranges[i] = nearest
        squareness[i] = min(max(square, 0.0), 1.0)


@njit(
    void(_arrays.U8_GRID, int64, int64, int64, float64, float64, float64, float64, float64, _arrays.F64_OUT),
    cache=True,
    nogil=True,
)
def _nearest_occupied(
    occupied: Any,
    column: int,
    row: int,
    reach: int,
    resolution: float,
    origin_x: float,
    origin_y: float,
    x: float,
    y: float,
    found: Any,
) -> None:
    """Write the squared distance and its two parts; an infinite one where nothing is occupied."""
    height, width = occupied.shape
    found[0] = math.inf
    for r in range(max(0, row - reach), min(height, row + reach + 1)):
        low_y = origin_y + r * resolution
        dy = min(max(y, low_y), low_y + resolution) - y
        for c in range(max(0, column - reach), min(width, column + reach + 1)):
            if occupied[r, c] == 0:
                continue
            low_x = origin_x + c * resolution
            dx = min(max(x, low_x), low_x + resolution) - x
            squared = dx * dx + dy * dy
            if squared < found[0]:
                found[0] = squared
                found[1] = dx
                found[2] = dy


def node_angles(position: float, step: float, count: int) -> NodeAngles:
    """Return where a head is at the next `count` measurements, `step` rotations apart, after `position` rotations."""
    angle_q6, start = np.empty(count, np.int64), np.empty(count, np.bool_)
    return NodeAngles(_node_angles(position, step, angle_q6, start), angle_q6, start)


def encode_nodes(
    angle_q6: NDArray[np.int64], start: NDArray[np.bool_], ranges: NDArray[np.float64], low: float, high: float
) -> NDArray[np.uint8]:
    """Return n measurements as a lidar's nodes, uint8[n, 5]: `lidar.decode_nodes` has their layout.

    ranges: float64[n], m; one outside of `low` to `high`, or nan, is no return. The strength is full (15) up to 6 m and
    falls to 5 at 12 m. Raises ValueError for arrays of different sizes.
    """
    if not angle_q6.shape == start.shape == ranges.shape:
        raise ValueError(f"n angles, starts and ranges, not {angle_q6.shape}, {start.shape} and {ranges.shape}")
    raw = np.empty((ranges.size, NODE_BYTES), np.uint8)
    _encode_nodes(angle_q6, start, ranges, low, high, raw)
    return raw


def disturb(
    ranges: NDArray[np.float64],
    normal: NDArray[np.float64],
    uniform: NDArray[np.float64],
    *,
    sigma: float,
    share: float,
    dropout: float,
    low: float,
    high: float,
) -> None:
    """Add a lidar's errors to its ranges (m; float64[n]), in place; nan where it measures none.

    Each error is its number of `normal` standard deviations, which are `sigma` (m) and a `share` of the range. None is
    measured where `uniform` is below `dropout`, and outside of `low` to `high`. Raises ValueError for arrays of
    different sizes.
    """
    if not ranges.shape == normal.shape == uniform.shape:
        raise ValueError(f"n ranges and errors, not {ranges.shape}, {normal.shape} and {uniform.shape}")
    _disturb(ranges, normal, uniform, sigma, share, dropout, low, high)


def disturb_as_recorded(
    ranges: NDArray[np.float64],
    beams: Beams,
    drawn: Drawn,
    errors: RecordedErrors,
    place: tuple[float, float],
    patches: NDArray[np.float64],
    dead: NDArray[np.float64],
) -> None:
    """Add errors as recorded to the ranges of a lidar at `place` (m; float64[n]), in place; nan where it measures none.

    patches: float64[p, 4], x, y, radius (m) of what returns a beam with the fourth one's probability only. dead:
    float64[d, 2], sectors (from, to; rad, counter-clockwise) of beams that don't return. Raises ValueError for arrays
    that do not fit.
    """
    n, p = ranges.size, len(patches)
    shapes = {values.shape for values in (*beams, drawn.tail, drawn.normal)}
    if shapes != {(n,)} or drawn.uniform.shape != (3 + p, n) or patches.shape != (p, 4) or dead.shape[1:] != (2,):
        raise ValueError(f"{n} ranges and {p} patches do not fit beams, drawn numbers or sectors")
    noise, loss, tail, tail_sigmas, outliers, low, high = errors
    _disturb_as_recorded(
        ranges, *beams, *drawn, noise, loss, tail, tail_sigmas, outliers, low, high, *place, patches, dead
    )


def set_in_sectors(
    ranges: NDArray[np.float64], angles: NDArray[np.float64], sectors: NDArray[np.float64], value: float
) -> None:
    """Set the ranges (float64[n]), in place, whose angles (rad) lie in sectors (from, to; counter-clockwise).

    sectors: float64[k, 2], rad. Raises ValueError for arrays that do not fit.
    """
    if ranges.shape != angles.shape or sectors.shape[1:] != (2,):
        raise ValueError(f"n ranges and angles, k sectors, not {ranges.shape}, {angles.shape} and {sectors.shape}")
    _set_in_sectors(ranges, angles, sectors, value)


def edge_ranges(
    edges: NDArray[np.float64],
    lengths: NDArray[np.float64],
    x: float,
    y: float,
    cos: NDArray[np.float64],
    sin: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return each ray's range (m) from (x, y) to the nearest edge, infinite for none, and how square it meets it.

    edges: float64[k, 4], their ends x0, y0, x1, y1. lengths: float64[k]. cos, sin: float64[n], of the rays' directions.
    Squareness is the sine of the angle between ray and edge; that of a ray that meets none is of the first edge. Raises
    ValueError for arrays that do not fit.
    """
    if edges.shape != (lengths.size, 4) or cos.shape != sin.shape:
        raise ValueError(f"k edges and lengths, n cos and sin, not {edges.shape}, {lengths.shape}, {cos.shape}")
    ranges, squareness = np.empty(cos.size), np.empty(cos.size)
    _edge_ranges(edges, lengths, x, y, cos, sin, ranges, squareness)
    return ranges, squareness


def nearest_occupied(
    occupied: NDArray[np.uint8],
    cell: tuple[int, int],
    reach: int,
    resolution: float,
    origin: tuple[float, float],
    point: tuple[float, float],
) -> tuple[float, float, float] | None:
    """Return squared distance, dx and dy (m) to the nearest square of an occupied cell, None without one.

    It looks `reach` cells around `cell` (column, row), in which `point` (m) is; `origin` (m) is the grid's corner.
    """
    found = np.empty(3)
    _nearest_occupied(_arrays.grid(occupied, "occupied"), *cell, reach, resolution, *origin, *point, found)
    squared, dx, dy = found.tolist()
    return None if squared == math.inf else (squared, dx, dy)
