"""Local motion by the Dynamic Window Approach (Fox, Burgard and Thrun 1997) for a robot with two driven wheels.

Every pair of speeds that the motors can reach within a control period is rolled out as an arc through the distances
around the robot (`fog_kernels.clearance`); among the arcs on which the body keeps its padding from everything, the one
with the lowest cost is chosen. The cost adds up the distance from the path, the
distance to go, the heading error relative to the path ahead, and the highest costmap value on the arc. Large heading
errors are corrected by turning in place, so that a path that starts behind the robot isn't reached by a wide arc.

The tests contain a plain reference implementation, with which a property test compares the kernel.

One module, although long: all of it is compiled into the one kernel.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import float64, int64, njit, types

from fog_contracts.costs import INSCRIBED, LETHAL, PENALTY_MAX
from fog_kernels import _arrays
from fog_kernels.clearance import NEAR, sampling_slack
from fog_kernels.robot import DEFAULT_SETTINGS, MAX_STEPS, DwaLimits, DwaResult, DwaSettings

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from fog_kernels.clearance import Clearance
    from fog_kernels.robot import Body

__all__ = ["DwaLimits", "DwaParameters", "DwaResult", "DwaSettings", "dwa"]

_MAX_SEGMENTS = 64
_MERGED_LENGTH = 0.25
"""Points of the path are merged into segments of at most this length (m)."""
_MERGED_OFFSET = 0.01
"""Points are merged only if they lie this close (m) to the segment."""
_TURN_IN_PLACE_WEIGHT = 10.0
"""Weight per m/s of forward speed while turning in place; high enough that braking always wins."""
_ESCAPE_LENGTH = 0.3
"""Distance (m) within which an escaping robot must regain its padding."""
_SWEEP_STEP = 0.025
"""The discs of a body that isn't round are looked up at least every so many metres of their way."""
_ROUNDING = 1e-6
"""Clearance (m) may shrink by this much on an escaping arc: the field is of single precision."""


class DwaParameters(NamedTuple):
    """Limits, settings and the body's radii as a named tuple, which numba kernels can read by name.

    m/s: v_max, wheel_max, escape_v. rad/s: w_max. m/s^2: acc_v, acc_lateral, approach. rad/s^2: acc_w. m: axle,
    lookahead, goal_tolerance, padding, the body's inscribed and circumscribed radius, and how much nearer than where
    they are looked up the body and its discs may come (`slack`, `disc_slack`). rad: turn_in_place, heading_tolerance.
    s: sim_time, dt, period. Weights: w_path and w_goal per m, w_heading per rad, w_cost for the highest cost (0..1),
    w_turn per rad/s. Numbers of samples: n_v, n_w.
    """

    v_max: float
    w_max: float
    acc_v: float
    acc_w: float
    acc_lateral: float
    wheel_max: float
    axle: float
    sim_time: float
    dt: float
    period: float
    w_path: float
    w_goal: float
    w_heading: float
    w_cost: float
    w_turn: float
    lookahead: float
    turn_in_place: float
    approach: float
    goal_tolerance: float
    heading_tolerance: float
    escape_v: float
    padding: float
    inscribed: float
    circumscribed: float
    slack: float
    disc_slack: float
    n_v: int
    n_w: int


class _Route(NamedTuple):
    """The path ahead as straight segments, from its point nearest to the robot.

    Segment i < size begins at (x[i], y[i]) in m, points along the unit vector (ux[i], uy[i]), is length[i] m long and
    begins start[i] m along the route; all float64 (64,). `remaining`: m from the route's start to the goal.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    ux: NDArray[np.float64]
    uy: NDArray[np.float64]
    length: NDArray[np.float64]
    start: NDArray[np.float64]
    size: int
    remaining: float


class _Window(NamedTuple):
    """The speeds (m/s, rad/s) that the motors can reach within a period."""

    v_low: float
    v_high: float
    w_low: float
    w_high: float


_PARAMETERS: Any = types.NamedTuple((*(float64,) * 26, int64, int64), DwaParameters)  # type: ignore[no-untyped-call]  # numba has no types
_RESULT: Any = types.NamedTuple((float64, float64, float64, int64), DwaResult)  # type: ignore[no-untyped-call]  # numba has no types

# Inlined before compilation: passing an array to a compiled function costs reference counting at each call, which more
# than doubles the time of the loop over the arcs.
_helper = njit(inline="always", cache=True)


@_helper
def _wrapped(angle: float) -> float:
    """Return the angle in -pi..pi."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@_helper
def _path_point(path: Any, index: int, goal_x: float, goal_y: float) -> tuple[float, float]:
    """Return a point of the path (m); the goal follows its last one."""
    x, y = goal_x, goal_y
    if index < path.shape[0]:
        x, y = path[index, 0], path[index, 1]
    return x, y


@_helper
def _nearest_segment(path: Any, goal_x: float, goal_y: float, x: float, y: float) -> tuple[int, float]:
    """Return the index of the path's segment nearest to (x, y), and the nearest point's position (0..1) on it."""
    nearest = 0
    nearest_fraction = 0.0
    least = math.inf
    for i in range(path.shape[0]):
        ax, ay = path[i, 0], path[i, 1]
        bx, by = _path_point(path, i + 1, goal_x, goal_y)
        ux, uy = bx - ax, by - ay
        square = ux * ux + uy * uy
        fraction = ((x - ax) * ux + (y - ay) * uy) / square if square > 0.0 else 0.0
        fraction = min(max(fraction, 0.0), 1.0)
        square_distance = (ax + fraction * ux - x) ** 2 + (ay + fraction * uy - y) ** 2
        if square_distance < least - 1e-12:
            least = square_distance
            nearest = i
            nearest_fraction = fraction
    return nearest, nearest_fraction


@_helper
def _route_ahead(path: Any, goal_x: float, goal_y: float, x: float, y: float, p: DwaParameters) -> _Route:
    """Return the path ahead of its point nearest to the robot, as far as the arcs can reach.

    Without a path, or beside its end, the route leads straight to the goal.
    """
    seg_x = np.empty(_MAX_SEGMENTS)
    seg_y = np.empty(_MAX_SEGMENTS)
    seg_ux = np.empty(_MAX_SEGMENTS)
    seg_uy = np.empty(_MAX_SEGMENTS)
    seg_length = np.empty(_MAX_SEGMENTS)
    seg_start = np.empty(_MAX_SEGMENTS)
    count = 0
    remaining = 0.0
    reach = p.v_max * p.sim_time + 2.0 * p.lookahead
    points = path.shape[0]
    if points > 0:
        nearest, fraction = _nearest_segment(path, goal_x, goal_y, x, y)
        to_x, to_y = _path_point(path, nearest + 1, goal_x, goal_y)
        from_x = path[nearest, 0] + fraction * (to_x - path[nearest, 0])
        from_y = path[nearest, 1] + fraction * (to_y - path[nearest, 1])
        for i in range(nearest + 2, points + 2):
            # The segment from..to is extended over points that lie nearly on it, to get few segments.
            ux, uy = to_x - from_x, to_y - from_y
            length = math.sqrt(ux * ux + uy * uy)
            next_x, next_y = _path_point(path, i, goal_x, goal_y)
            wx, wy = next_x - from_x, next_y - from_y
            grown = math.sqrt(wx * wx + wy * wy)
            straight = abs(ux * wy - uy * wx) <= _MERGED_OFFSET * grown and ux * wx + uy * wy > 0.0
            if i <= points and (length < 1e-9 or (length < grown <= _MERGED_LENGTH and straight)):
                to_x, to_y = next_x, next_y
                continue
            if length > 1e-9:
                if remaining < reach and count < _MAX_SEGMENTS:
                    seg_x[count] = from_x
                    seg_y[count] = from_y
                    seg_ux[count] = ux / length
                    seg_uy[count] = uy / length
                    seg_length[count] = length
                    seg_start[count] = remaining
                    count += 1
                remaining += length
            from_x, from_y = to_x, to_y
            to_x, to_y = next_x, next_y
    to_goal = math.sqrt((goal_x - x) ** 2 + (goal_y - y) ** 2)
    if remaining < p.goal_tolerance < to_goal:
        seg_x[0] = x
        seg_y[0] = y
        seg_ux[0] = (goal_x - x) / to_goal
        seg_uy[0] = (goal_y - y) / to_goal
        seg_length[0] = to_goal
        seg_start[0] = 0.0
        count = 1
        remaining = to_goal
    return _Route(seg_x, seg_y, seg_ux, seg_uy, seg_length, seg_start, count, remaining)


@_helper
def _point_along(route: _Route, along: float) -> tuple[float, float]:
    """Return the point (m) of the route at a length along it, or the end of its last segment."""
    k = 0
    while k + 1 < route.size and route.start[k + 1] <= along:
        k += 1
    on = min(along - route.start[k], route.length[k])
    return route.x[k] + on * route.ux[k], route.y[k] + on * route.uy[k]


@_helper
def _offset(dx: float, dy: float, ux: float, uy: float, length: float) -> tuple[float, float]:
    """Return the squared distance (m^2) from a point to a segment, and how far along it (m) the nearest point lies.

    (dx, dy): the point seen from the segment's begin; (ux, uy): the segment's direction.
    """
    along = min(max(dx * ux + dy * uy, 0.0), length)
    dx -= along * ux
    dy -= along * uy
    return dx * dx + dy * dy, along


@_helper
def _reachable_speeds(v_now: float, w_now: float, v_top: float, p: DwaParameters) -> _Window:
    """Return the speeds that can be reached within a period; `v_top` (m/s) is a further limit of the forward speed.

    A speed above its limit is reduced as fast as possible.
    """
    v_low = min(max(v_now - p.acc_v * p.period, 0.0), p.v_max)
    v_high = max(min(v_now + p.acc_v * p.period, p.v_max, v_top), v_low)
    w_low = max(w_now - p.acc_w * p.period, -p.w_max)
    w_high = min(w_now + p.acc_w * p.period, p.w_max)
    if w_high < w_low:
        w_low = w_high = w_now - math.copysign(p.acc_w * p.period, w_now)
    return _Window(v_low, v_high, w_low, w_high)


@_helper
def _turning_rate(error: float, w_now: float, p: DwaParameters) -> float:
    """Return the angular speed (rad/s) for correcting a heading error (rad) by turning in place.

    It lets the robot stop at the desired heading with a third of its angular deceleration, for smooth motion.
    """
    rate = math.copysign(min(p.w_max, 2.0 * abs(error), math.sqrt(0.67 * p.acc_w * abs(error))), error)
    if abs(error) > 2.8 and rate * w_now < -0.01:
        rate = -rate  # half a turn: keep the direction of rotation, noise must not reverse it
    return rate


@_helper
def _roll_out(w: float, theta: float, dt: float, cells_per_m: float, unit_x: Any, unit_y: Any) -> None:
    """Fill unit_x, unit_y with the exact arc of angular speed w per unit of speed (cells per m/s), at each step."""
    half = 0.5 * w * dt
    chord = dt * cells_per_m * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
    cos_now = math.cos(theta + half)
    sin_now = math.sin(theta + half)
    cos_step = math.cos(2.0 * half)
    sin_step = math.sin(2.0 * half)
    unit_x[0] = 0.0
    unit_y[0] = 0.0
    for t in range(1, unit_x.size):
        unit_x[t] = unit_x[t - 1] + chord * cos_now
        unit_y[t] = unit_y[t - 1] + chord * sin_now
        turned = cos_now * cos_step - sin_now * sin_step
        sin_now = sin_now * cos_step + cos_now * sin_step
        cos_now = turned


@_helper
def _distance_at(distance: Any, column: float, row: float) -> float:
    """Return the distance (m) to the nearest thing at a position in cells, between cells' centres interpolated."""
    size = distance.shape[0]
    c = min(max(column - 0.5, 0.0), size - 1.001)
    r = min(max(row - 0.5, 0.0), size - 1.001)
    i = int(c)
    j = int(r)
    c -= i
    r -= j
    below = (1.0 - c) * distance[j, i] + c * distance[j, i + 1]
    above = (1.0 - c) * distance[j + 1, i] + c * distance[j + 1, i + 1]
    between: float = (1.0 - r) * below + r * above
    return between


@_helper
def _clearance_at(
    distance: Any, discs: Any, column: float, row: float, theta: float, cells_per_m: float, p: DwaParameters
) -> float:
    """Return how far (m) the body keeps from everything at least; negative where it may touch something.

    It is exact enough to be compared with the padding; a body that is far away may be farther still.
    """
    away = _distance_at(distance, column, row)
    least = away - p.inscribed - p.slack
    if discs.shape[0] > 0 and away < p.circumscribed + p.padding + p.slack:
        cos = math.cos(theta) * cells_per_m
        sin = math.sin(theta) * cells_per_m
        for k in range(discs.shape[0]):
            x, y = discs[k, 0], discs[k, 1]
            off = _distance_at(distance, column + x * cos - y * sin, row + x * sin + y * cos)
            least = min(least, off - discs[k, 2] - p.disc_slack)
    return least


@_helper
def _highest_cost(
    cost: Any,
    distance: Any,
    discs: Any,
    column: float,
    row: float,
    theta: float,
    v: float,
    w: float,
    unit_x: Any,
    unit_y: Any,
    steps: int,
    cells_per_m: float,
    p: DwaParameters,
) -> int:
    """Return the highest cost (0..252) on an arc from (column, row), LETHAL when the body comes too near to something.

    Keep the early returns: with a single one at the end, numba's code is half as fast.
    """
    size = cost.shape[0]
    highest = 0
    parts = 1
    if discs.shape[0] > 0:
        parts = max(1, math.ceil((v + abs(w) * p.circumscribed) * p.dt / _SWEEP_STEP))
    before = NEAR
    for t in range(1, steps + 1):
        c = math.floor(column + v * unit_x[t])
        r = math.floor(row + v * unit_y[t])
        if c < 0 or c >= size or r < 0 or r >= size:
            return LETHAL
        here = int(cost[r, c])
        if here > NEAR:
            return LETHAL
        if here == NEAR or (parts > 1 and before == NEAR):
            for part in range(1, parts + 1):
                share = part / parts
                at_x = column + v * (unit_x[t - 1] + share * (unit_x[t] - unit_x[t - 1]))
                at_y = row + v * (unit_y[t - 1] + share * (unit_y[t] - unit_y[t - 1]))
                turned = theta + w * (t - 1 + share) * p.dt
                if _clearance_at(distance, discs, at_x, at_y, turned, cells_per_m, p) < p.padding:
                    return LETHAL
        before = here
        highest = max(highest, here)
    return highest


@_helper
def _escape_cost(
    cost: Any,
    distance: Any,
    discs: Any,
    column: float,
    row: float,
    theta: float,
    v: float,
    w: float,
    unit_x: Any,
    unit_y: Any,
    steps: int,
    cells_per_m: float,
    p: DwaParameters,
) -> int:
    """Return the highest cost on an arc from a place that is too near to something, LETHAL when it is inadmissible.

    The clearance must never shrink until the padding is regained, and then never fall below it again; INSCRIBED means
    that it isn't regained. Cells that the map calls inscribed count as too near; none may be entered again.
    """
    size = cost.shape[0]
    highest = 0
    inside = True
    parts = 1
    if discs.shape[0] > 0:
        parts = max(1, math.ceil((v + abs(w) * p.circumscribed) * p.dt / _SWEEP_STEP))
    level = min(_clearance_at(distance, discs, column, row, theta, cells_per_m, p), p.padding)
    for t in range(1, steps + 1):
        for part in range(1, parts + 1):
            share = part / parts
            at_x = column + v * (unit_x[t - 1] + share * (unit_x[t] - unit_x[t - 1]))
            at_y = row + v * (unit_y[t - 1] + share * (unit_y[t] - unit_y[t - 1]))
            c = math.floor(at_x)
            r = math.floor(at_y)
            if c < 0 or c >= size or r < 0 or r >= size:
                return LETHAL
            here = int(cost[r, c])
            if here >= LETHAL:
                return LETHAL
            turned = theta + w * (t - 1 + share) * p.dt
            clear = _clearance_at(distance, discs, at_x, at_y, turned, cells_per_m, p)
            if clear < level - _ROUNDING:
                return LETHAL
            level = max(level, min(clear, p.padding))
            if here <= NEAR and clear >= p.padding:
                inside = False
                highest = max(highest, here)
            elif not inside:
                return LETHAL
    return INSCRIBED if inside else highest


@_helper
def _route_cost(
    route: _Route, mid_x: float, mid_y: float, end_x: float, end_y: float, end_theta: float, p: DwaParameters
) -> float:
    """Return the weighted cost of how an arc with this middle (m) and end (m, rad) follows the route."""
    off_end = math.inf
    off_mid = math.inf
    along = 0.0
    for k in range(route.size):
        x, y, ux, uy, length = route.x[k], route.y[k], route.ux[k], route.uy[k], route.length[k]
        square, on = _offset(end_x - x, end_y - y, ux, uy, length)
        if square < off_end:
            off_end = square
            along = route.start[k] + on
        square, on = _offset(mid_x - x, mid_y - y, ux, uy, length)
        off_mid = min(off_mid, square)
    aim_x, aim_y = _point_along(route, min(along + p.lookahead, route.remaining))
    ahead_x = aim_x - end_x
    ahead_y = aim_y - end_y
    # Near its end the path gives no direction.
    trust = min(math.sqrt(ahead_x * ahead_x + ahead_y * ahead_y) / p.lookahead, 1.0)
    turn = abs(_wrapped(math.atan2(ahead_y, ahead_x) - end_theta)) * trust
    return (
        p.w_path * 0.5 * (math.sqrt(off_end) + math.sqrt(off_mid))
        + p.w_goal * (route.remaining - along)
        + p.w_heading * turn
    )


@njit(  # type: ignore[untyped-decorator]  # numba has no types for named tuples
    _RESULT(
        float64,
        float64,
        float64,
        float64,
        float64,
        _arrays.U8_GRID,
        _arrays.F32_GRID,
        float64,
        float64,
        float64,
        _arrays.F64_GRID,
        _arrays.F64_GRID,
        float64,
        float64,
        float64,
        _PARAMETERS,
    ),
    cache=True,
    nogil=True,
)
def _choose(
    v_now: float,
    w_now: float,
    x: float,
    y: float,
    theta: float,
    cost: Any,
    distance: Any,
    resolution: float,
    origin_x: float,
    origin_y: float,
    discs: Any,
    path: Any,
    goal_x: float,
    goal_y: float,
    goal_theta: float,
    p: DwaParameters,
) -> DwaResult:
    """Return the best arc; arguments as for `dwa`, goal_theta may be nan."""
    size = cost.shape[0]
    cells_per_m = 1.0 / resolution
    column = (x - origin_x) * cells_per_m
    row = (y - origin_y) * cells_per_m
    if not (0.0 <= column < size and 0.0 <= row < size):
        return DwaResult(0.0, 0.0, -math.inf, 0)
    cost_here = cost[math.floor(row), math.floor(column)]
    too_near = cost_here == INSCRIBED
    if cost_here == NEAR:
        too_near = _clearance_at(distance, discs, column, row, theta, cells_per_m, p) < p.padding
    escaping = too_near and p.escape_v > 0.0
    if cost_here >= LETHAL or (too_near and not escaping):
        return DwaResult(0.0, 0.0, -math.inf, 0)

    route = _route_ahead(path, goal_x, goal_y, x, y, p)
    to_goal = math.sqrt((goal_x - x) ** 2 + (goal_y - y) ** 2)
    at_goal = to_goal <= p.goal_tolerance and route.remaining <= 3.0 * p.goal_tolerance
    v_top = math.inf
    if at_goal:
        error = 0.0 if math.isnan(goal_theta) else _wrapped(goal_theta - theta)
        turning = abs(error) > p.heading_tolerance
        if not turning:
            return DwaResult(0.0, 0.0, 0.0, 1)
    else:
        aim_x, aim_y = _point_along(route, min(p.lookahead, route.remaining))
        error = _wrapped(math.atan2(aim_y - y, aim_x - x) - theta)
        turning = abs(error) > p.turn_in_place
        v_top = math.sqrt(2.0 * p.approach * max(to_goal, route.remaining, 0.25 * p.goal_tolerance))
    if escaping:
        v_top = min(v_top, p.escape_v)
    if turning:
        v_top = 0.0
    window = _reachable_speeds(v_now, w_now, v_top, p)
    rate = _turning_rate(error, w_now, p) if turning else 0.0

    # Long enough to stop the robot on the fastest arc before an obstacle on it.
    horizon = max(p.sim_time, p.period + window.v_high / p.acc_v)
    if escaping:
        horizon = max(horizon, _ESCAPE_LENGTH / p.escape_v)
    steps = min(math.ceil(horizon / p.dt - 1e-9), MAX_STEPS)
    end = min(max(round(p.sim_time / p.dt), 1), steps)
    middle = max(end // 2, 1)
    unit_x = np.empty(steps + 1)
    unit_y = np.empty(steps + 1)
    v_step = (window.v_high - window.v_low) / (p.n_v - 1)
    w_step = (window.w_high - window.w_low) / (p.n_w - 1)
    straight = -1
    if window.w_low <= 0.0 <= window.w_high and w_step > 0.0:
        straight = round(-window.w_low / w_step)
    admissible = 0
    least = math.inf
    best_v = 0.0
    best_w = 0.0
    for j in range(p.n_w):
        w = 0.0 if j == straight else window.w_low + j * w_step
        _roll_out(w, theta, p.dt, cells_per_m, unit_x, unit_y)
        for i in range(p.n_v if v_step > 0.0 else 1):
            v = window.v_low + i * v_step
            if v + 0.5 * p.axle * abs(w) > p.wheel_max + 1e-9 or (i > 0 and v * abs(w) > p.acc_lateral):
                break  # faster ones exceed these limits too
            if escaping:
                highest = _escape_cost(
                    cost, distance, discs, column, row, theta, v, w, unit_x, unit_y, steps, cells_per_m, p
                )
            else:
                highest = _highest_cost(
                    cost, distance, discs, column, row, theta, v, w, unit_x, unit_y, steps, cells_per_m, p
                )
            if highest == LETHAL:
                continue
            if turning:
                total = abs(w - rate) + _TURN_IN_PLACE_WEIGHT * v
            elif highest == INSCRIBED and v > 0.0:
                continue  # the arc leads along the wall, not away from it
            else:
                arc_cost = 0 if highest == INSCRIBED else highest
                total = (
                    _route_cost(
                        route,
                        x + v * unit_x[middle] * resolution,
                        y + v * unit_y[middle] * resolution,
                        x + v * unit_x[end] * resolution,
                        y + v * unit_y[end] * resolution,
                        theta + w * p.sim_time,
                        p,
                    )
                    + p.w_cost * arc_cost / PENALTY_MAX
                    + p.w_turn * abs(w - w_now)
                )
            admissible += 1
            if total < least:
                least = total
                best_v = v
                best_w = w
    return DwaResult(best_v, best_w, -least, admissible)


@lru_cache(maxsize=32)
def _parameters(
    radii: tuple[float, float, float], slack: float, cell: float, limits: DwaLimits, settings: DwaSettings
) -> DwaParameters:
    """Return body, limits and settings as the kernel reads them: most decisions are made with the same ones.

    `radii`: the body's inscribed and circumscribed radius, and that of its smallest disc (m). `slack`: how much nearer
    (m) than where it is looked up the body may come. `cell`: m per cell of the field.
    """
    inscribed, circumscribed, smallest = radii
    near = smallest + settings.padding
    return DwaParameters(
        v_max=float(limits.v_max),
        w_max=float(limits.w_max),
        acc_v=float(limits.acc_v),
        acc_w=float(limits.acc_w),
        acc_lateral=float(limits.acc_lateral),
        wheel_max=float(limits.wheel_max),
        axle=float(limits.axle),
        sim_time=float(settings.sim_time),
        dt=float(settings.dt),
        period=float(settings.period),
        w_path=float(settings.w_path),
        w_goal=float(settings.w_goal),
        w_heading=float(settings.w_heading),
        w_cost=float(settings.w_cost),
        w_turn=float(settings.w_turn),
        lookahead=float(settings.lookahead),
        turn_in_place=float(settings.turn_in_place),
        approach=float(settings.approach),
        goal_tolerance=float(settings.goal_tolerance),
        heading_tolerance=float(settings.heading_tolerance),
        escape_v=float(settings.escape_v),
        padding=float(settings.padding),
        inscribed=float(inscribed),
        circumscribed=float(circumscribed),
        slack=slack,
        disc_slack=_SWEEP_STEP**2 / (8.0 * near) + cell**2 / (4.0 * near),
        n_v=settings.n_v,
        n_w=settings.n_w,
    )


def dwa(
    v: float,
    w: float,
    x: float,
    y: float,
    theta: float,
    around: Clearance,
    path: ArrayLike,
    goal_x: float,
    goal_y: float,
    goal_theta: float | None,
    body: Body,
    limits: DwaLimits,
    settings: DwaSettings = DEFAULT_SETTINGS,
) -> DwaResult:
    """Choose the speeds for the next control period.

    `v`, `w`: current speeds (m/s, rad/s). `x`, `y`, `theta`: pose of the point between the wheels in `map`. `around`:
    the distances around the robot, made for the same body, limits and settings; arcs on which the body comes nearer
    than the padding to anything, whose centre enters cells of 253 or more, or which lead beyond the window, are
    inadmissible. `path`: (n, 2) points in `map`, the rest of the path (earlier points do no harm unless the path passes
    here twice; none means straight to the goal). `goal_x`, `goal_y`: where to stop; the path is extended to it in a
    straight line. `goal_theta`: final heading, or None.

    Returns the best admissible pair. Within `goal_tolerance` of the goal it brakes and turns to `goal_theta`.
    Raises ValueError for numbers that aren't finite.
    """
    points = np.ascontiguousarray(path, dtype=np.float64).reshape(-1, 2)
    state = (float(v), float(w), float(x), float(y), float(theta))
    aims = (float(goal_x), float(goal_y), 0.0 if goal_theta is None else float(goal_theta))
    if not all(map(math.isfinite, state + aims)) or not np.isfinite(points).all():
        raise ValueError("speeds, pose, path and goal must be finite: stop the robot while its pose is unknown")
    chosen: DwaResult = _choose(
        *state,
        around.cost,
        around.distance,
        around.resolution,
        around.origin_x,
        around.origin_y,
        body.discs,
        points,
        *aims[:2],
        math.nan if goal_theta is None else aims[2],
        _parameters(
            (body.inscribed, body.circumscribed, body.smallest_disc),
            sampling_slack(body, around.resolution, limits, settings),
            around.resolution,
            limits,
            settings,
        ),
    )
    return chosen
