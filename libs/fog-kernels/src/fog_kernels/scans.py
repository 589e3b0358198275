"""A lidar's scans in the plane: where their returns are, how they fit a map, and the pose nearby that fits best.

Each is one call for a scan or a batch of it: a call of numpy costs a small computer more than the hundred values that
it works on here.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per value
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numba import float64, int64, njit, types, void

from fog_kernels import _arrays
from fog_kernels.amcl import _score
from fog_kernels.raycast import _cast

if TYPE_CHECKING:
    from numpy.typing import NDArray

_F64_GRID_OUT = types.Array(types.float64, 2, "C")


class Track(NamedTuple):
    """Where the robot was: entries (k, 4), k >= 1, of times (s, growing), x, y (m) and theta (rad, not wrapped).

    v, w: the speeds (m/s, rad/s) at which it goes on after the last entry, for `ahead` s at most.
    """

    entries: NDArray[np.float64]
    v: float
    w: float
    ahead: float


class Mounting(NamedTuple):
    """Where the lidar is on the robot (m, rad)."""

    x: float
    y: float
    yaw: float


class Placed(NamedTuple):
    """Points (n, 2; m) and the times (n; s) at which they were measured."""

    points: NDArray[np.float64]
    times: NDArray[np.float64]


class Compared(NamedTuple):
    """Numbers of beams: those that end where the map has a wall, pass through one, or end before one.

    beside: of those that agree, the ones that end beside their wall rather than on it.
    """

    agree: int
    long: int
    short: int
    beside: int


class Tolerances(NamedTuple):
    """Distances (m) by which a scan is compared with a map.

    near: a beam that ends so near to a wall may agree with it, on: and ends on it, or within `on_share` of its range.
    range: by how much the range of one
    that agrees with none may differ from the expected range before it counts as short or long.
    """

    near: float
    on: float
    range: float
    on_share: float = 0.0


@njit(
    int64(
        _arrays.F64_FLAT, _arrays.F64_FLAT, float64, float64, _arrays.F64_GRID, float64, float64, float64,
        float64, float64, float64, float64, float64, _F64_GRID_OUT, _arrays.F64_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _placed(
    angles: Any,
    ranges: Any,
    started_at: float,
    ended_at: float,
    entries: Any,
    v: float,
    w: float,
    ahead: float,
    lidar_x: float,
    lidar_y: float,
    yaw: float,
    nearest: float,
    farthest: float,
    points: Any,
    times: Any,
) -> int:
    """Write the returns from `nearest` to `farthest`; return their number."""
    count, newest, entry, found = ranges.size, entries.shape[0] - 1, 0, 0
    period = (ended_at - started_at) / max(count - 1, 1)
    for i in range(count):
        if not nearest <= ranges[i] <= farthest:
            continue
        time = started_at + period * i
        while entry < newest and entries[entry + 1, 0] <= time:
            entry += 1
        x, y, theta = entries[entry, 1], entries[entry, 2], entries[entry, 3]
        late = time - entries[entry, 0]
        if entry < newest and late > 0.0:
            share = late / (entries[entry + 1, 0] - entries[entry, 0])
            x += share * (entries[entry + 1, 1] - x)
            y += share * (entries[entry + 1, 2] - y)
            theta += share * (entries[entry + 1, 3] - theta)
        elif late > 0.0:
            late = min(late, ahead)
            heading = theta + 0.5 * w * late
            x += v * late * math.cos(heading)
            y += v * late * math.sin(heading)
            theta += w * late
        base_x = lidar_x + ranges[i] * math.cos(angles[i] + yaw)
        base_y = lidar_y + ranges[i] * math.sin(angles[i] + yaw)
        cos, sin = math.cos(theta), math.sin(theta)
        points[found, 0] = x + cos * base_x - sin * base_y
        points[found, 1] = y + sin * base_x + cos * base_y
        times[found] = time
        found += 1
    return found


@njit(void(_arrays.F64_GRID, float64, float64, _F64_GRID_OUT), cache=True, nogil=True)
def _smoothed(points: Any, surface: float, farthest: float, out: Any) -> None:
    count = points.shape[0]
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        shift_x = shift_y = 0.0
        joined = 1.0
        for neighbour in ((i + 1) % count, (i - 1) % count):
            dx, dy = points[neighbour, 0] - x, points[neighbour, 1] - y
            if math.hypot(dx, dy) < surface:
                shift_x += dx
                shift_y += dy
                joined += 1.0
        shift_x /= joined
        shift_y /= joined
        excess = max(math.hypot(shift_x, shift_y) / farthest, 1.0)
        out[i, 0] = x + shift_x / excess
        out[i, 1] = y + shift_y / excess


@njit(void(_arrays.F64_GRID, float64, float64, float64, float64, _F64_GRID_OUT), cache=True, nogil=True)
def _out_of_frame(points: Any, x: float, y: float, cos: float, sin: float, out: Any) -> None:
    for i in range(points.shape[0]):
        out[i, 0] = x + cos * points[i, 0] - sin * points[i, 1]
        out[i, 1] = y + sin * points[i, 0] + cos * points[i, 1]


@njit(void(_arrays.F64_GRID, float64, float64, float64, float64, _F64_GRID_OUT), cache=True, nogil=True)
def _into_frame(points: Any, x: float, y: float, cos: float, sin: float, out: Any) -> None:
    for i in range(points.shape[0]):
        dx, dy = points[i, 0] - x, points[i, 1] - y
        out[i, 0] = cos * dx + sin * dy
        out[i, 1] = -sin * dx + cos * dy


@njit(
    void(
        _arrays.F64_GRID, float64, float64, float64, _arrays.U8_GRID, _arrays.F32_GRID, float64, float64, float64,
        float64, float64, float64, float64, float64, float64, _arrays.I64_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _compared(
    points: Any,
    x: float,
    y: float,
    theta: float,
    occupied: Any,
    wall_distance: Any,
    resolution: float,
    origin_x: float,
    origin_y: float,
    outside: float,
    reach: float,
    near: float,
    on: float,
    tolerance: float,
    on_share: float,
    counts: Any,
) -> None:
    height, width = wall_distance.shape
    count = points.shape[0]
    cos, sin = math.cos(theta), math.sin(theta)
    ends, angles, expected = np.empty((count, 2)), np.empty(count), np.empty(count)
    for i in range(count):
        ends[i, 0] = x + cos * points[i, 0] - sin * points[i, 1]
        ends[i, 1] = y + sin * points[i, 0] + cos * points[i, 1]
        angles[i] = math.atan2(ends[i, 1] - y, ends[i, 0] - x)
    _cast(occupied, (x - origin_x) / resolution, (y - origin_y) / resolution, angles, reach / resolution, expected)
    for i in range(count):
        column = math.floor((ends[i, 0] - origin_x) / resolution)
        row = math.floor((ends[i, 1] - origin_y) / resolution)
        distance = outside
        if 0 <= column < width and 0 <= row < height:
            distance = float(wall_distance[row, column])
        measured = math.hypot(ends[i, 0] - x, ends[i, 1] - y)
        excess = measured - expected[i] * resolution
        if distance > near:
            if excess > tolerance:
                counts[1] += 1
            elif excess < -tolerance:
                counts[2] += 1
        elif abs(excess) < 3.0 * tolerance:
            counts[0] += 1
            if distance > max(on, on_share * measured):
                counts[3] += 1


_SHIFTS: Final = 27
_MIDDLE: Final = 13


@njit(
    void(
        _arrays.F64_GRID, _arrays.F64_FLAT, _arrays.F64_GRID, _arrays.F32_GRID, float64, float64, float64, float64,
        _arrays.F64_GRID, _arrays.F64_FLAT, int64, _arrays.F64_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _climb(
    points: Any,
    pose: Any,
    prior: Any,
    field: Any,
    resolution: float,
    origin_x: float,
    origin_y: float,
    weight: float,
    steps: Any,
    bound: Any,
    climbs: int,
    best: Any,
) -> None:
    """Move `best`, an offset (3,) from the pose, to the highest value that is reached uphill from it."""
    beams = points.shape[0]
    end_x, end_y = np.empty(beams, np.float32), np.empty(beams, np.float32)
    for i in range(beams):
        end_x[i] = points[i, 0] / resolution
        end_y[i] = points[i, 1] / resolution
    tried = np.empty((3, _SHIFTS))
    poses = np.empty((3, _SHIFTS))
    fit = np.empty(_SHIFTS)
    for size in range(steps.shape[0]):
        for _ in range(climbs):
            for shift in range(_SHIFTS):
                tried[0, shift] = best[0] + (shift // 9 - 1) * steps[size, 0]
                tried[1, shift] = best[1] + (shift // 3 % 3 - 1) * steps[size, 1]
                tried[2, shift] = best[2] + (shift % 3 - 1) * steps[size, 2]
                for axis in range(3):
                    poses[axis, shift] = pose[axis] + tried[axis, shift]
            _score(
                poses[0],
                poses[1],
                poses[2],
                field,
                np.float32(1.0 / resolution),
                np.float32(origin_x),
                np.float32(origin_y),
                end_x,
                end_y,
                fit,
            )
            highest, highest_value, middle_value = -1, -math.inf, -math.inf
            for shift in range(_SHIFTS):
                squared = 0.0
                for one in range(3):
                    for other in range(3):
                        squared += tried[one, shift] * prior[one, other] * tried[other, shift]
                value = weight * fit[shift] - 0.5 * squared
                for axis in range(3):
                    if abs(tried[axis, shift]) > bound[axis]:
                        value = -math.inf
                if value > highest_value:
                    highest, highest_value = shift, value
                if shift == _MIDDLE:
                    middle_value = value
            if highest < 0 or highest_value <= middle_value + 1e-9:
                break
            for axis in range(3):
                best[axis] = tried[axis, highest]


def placed(
    angles: NDArray[np.floating],
    ranges: NDArray[np.floating],
    started_at: float,
    ended_at: float,
    track: Track,
    lidar: Mounting,
    nearest: float,
    farthest: float,
) -> Placed:
    """Return where the returns from `nearest` to `farthest` (m) are, each seen from where the robot was at its time.

    angles (n; rad, counter-clockwise in the lidar's frame), ranges (n; m; nan without a return): measured evenly from
    `started_at` to `ended_at` (s). The points are in the frame of the track. Raises ValueError for arrays of different
    sizes, and a track that is empty.
    """
    directions, distances = _arrays.vector(angles, "angles"), _arrays.vector(ranges, "ranges")
    if directions.size != distances.size:
        raise ValueError(f"angles and ranges must have one length, not {directions.size} and {distances.size}")
    _arrays.exact(track.entries, np.float64, 2, "the track's entries")
    if track.entries.shape[0] < 1 or track.entries.shape[1] != 4:
        raise ValueError(f"the track's entries must have shape (k, 4) with k >= 1, not {track.entries.shape}")
    points, times = np.empty((distances.size, 2)), np.empty(distances.size)
    found = _placed(
        directions, distances, started_at, ended_at, track.entries, track.v, track.w, track.ahead, *lidar, nearest,
        farthest, points, times,
    )  # fmt: skip
    return Placed(points[:found], times[:found])


def smoothed(points: NDArray[np.float64], surface: float, farthest: float) -> NDArray[np.float64]:
    """Return points (n, 2) in a ring, each moved to the mean with those of its two neighbours that are `surface` near.

    No point is moved farther than `farthest`. Raises TypeError or ValueError for other types or shapes.
    """
    _check_points(points)
    out = np.empty_like(points)
    _smoothed(points, surface, farthest, out)
    return out


def out_of_frame(points: NDArray[np.float64], x: float, y: float, theta: float) -> NDArray[np.float64]:
    """Return points (n, 2; m), given in a frame at a pose (m, rad), in the frame that this pose is in.

    Raises ValueError for other shapes.
    """
    given = _of_pairs(points)
    out = np.empty_like(given)
    _out_of_frame(given, x, y, math.cos(theta), math.sin(theta), out)
    return out


def into_frame(points: NDArray[np.float64], x: float, y: float, theta: float) -> NDArray[np.float64]:
    """Undo `out_of_frame`: return points (n, 2; m) as seen from a pose (m, rad). Raises ValueError for other shapes."""
    given = _of_pairs(points)
    out = np.empty_like(given)
    _into_frame(given, x, y, math.cos(theta), math.sin(theta), out)
    return out


def compared(
    points: NDArray[np.float64],
    pose: tuple[float, float, float],
    occupied: NDArray[np.uint8],
    wall_distance: NDArray[np.float32],
    resolution: float,
    origin: tuple[float, float],
    outside: float,
    reach: float,
    tolerances: Tolerances,
) -> Compared:
    """Compare points (n, 2; m), measured at a pose (m, rad), with the ranges that a map leads to expect there.

    occupied (h, w): non-zero blocks. wall_distance (h, w): m to the nearest wall, `outside` beyond the map. Both have
    cells of `resolution` m from `origin` (m) on. No range is expected beyond `reach` (m). Raises TypeError or
    ValueError for other types or shapes, or numbers that aren't finite.
    """
    _check_points(points)
    cells = _arrays.grid(occupied, "occupied")
    _arrays.exact(wall_distance, np.float32, 2, "wall_distance")
    if cells.shape != wall_distance.shape:
        raise ValueError(f"both grids must have one shape, not {cells.shape} and {wall_distance.shape}")
    if not all(map(math.isfinite, (*pose, *origin, float(points.sum())))):
        raise ValueError("points, pose and origin must be finite")
    counts = np.zeros(4, np.int64)
    _compared(
        points, *pose, cells, wall_distance, _arrays.positive(resolution, "resolution"), *origin, outside, reach,
        tolerances.near, tolerances.on, tolerances.range, tolerances.on_share, counts,
    )  # fmt: skip
    return Compared(*counts.tolist())


def climb(
    points: NDArray[np.float64],
    pose: tuple[float, float, float],
    prior: NDArray[np.float64],
    field: NDArray[np.float32],
    resolution: float,
    origin: tuple[float, float],
    weight: float,
    steps: NDArray[np.float64],
    bound: NDArray[np.float64],
    climbs: int,
) -> NDArray[np.float64]:
    """Return the offset (3,) from a pose at which points (n, 2; m) measured there fit a likelihood field best.

    Uphill from 0, by steps (k, 3) in turn, each `climbs` times at most, and within the bound (3,). What grows is the
    mean of the field (h, w; cells of `resolution` m from `origin` on) at the points, times `weight`, less half the
    squared Mahalanobis distance by `prior` (3, 3), the information on the pose. Raises TypeError or ValueError for
    other types or shapes.
    """
    _check_points(points)
    _arrays.exact(field, np.float32, 2, "field")
    for array, shape, name in ((prior, (3, 3), "prior"), (steps, (len(steps), 3), "steps")):
        _arrays.exact(array, np.float64, 2, name)
        if array.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, not {array.shape}")
    best = np.zeros(3)
    if len(points):
        _climb(
            points, np.array(pose), prior, field, _arrays.positive(resolution, "resolution"), *origin, weight, steps,
            _arrays.vector(bound, "bound"), climbs, best,
        )  # fmt: skip
    return best


def _of_pairs(points: NDArray[np.float64]) -> NDArray[np.float64]:
    given = np.ascontiguousarray(points, np.float64)
    _check_points(given)
    return given


def _check_points(points: NDArray[np.float64]) -> None:
    _arrays.exact(points, np.float64, 2, "points")
    if points.shape[1] != 2:
        raise ValueError(f"points must have shape (n, 2), not {points.shape}")
