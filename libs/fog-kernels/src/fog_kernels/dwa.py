"""Local motion by the Dynamic Window Approach (Fox, Burgard and Thrun 1997) for a round robot with two driven wheels.

Every pair of speeds that the motors can reach within a control period is rolled out as an arc over the local costmap;
among the arcs that stay clear of obstacles the cheapest wins. Costs count metres off the path, metres still to go,
the heading relative to the path ahead, and the dearest cell touched. Large heading errors are turned away in place,
so that a path that starts behind the robot isn't reached by a wide arc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import float64, int64, njit

from fog_contracts.costs import INSCRIBED, PENALTY_MAX
from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_MAX_STEPS = 200
_SEGMENTS = 64
_MERGED = 0.25
_MERGE_OFF = 0.01


@dataclass(frozen=True, slots=True)
class DwaLimits:
    """What the base can do: m/s, rad/s, m/s^2, rad/s^2, and the bound on each wheel (m/s) with the axle's length (m).

    The defaults are a Roomba 600's with the speeds and accelerations of the thesis that Fognav builds on.
    """

    v_max: float = 0.3
    w_max: float = 2.75
    acc_v: float = 2.5
    acc_w: float = 3.2
    wheel_max: float = 0.5
    axle: float = 0.235

    def __post_init__(self) -> None:
        for name in ("w_max", "acc_v", "acc_w", "wheel_max", "axle"):
            _arrays.positive(getattr(self, name), name)
        if not 0.0 <= self.v_max < math.inf:
            raise ValueError(f"v_max must not be negative, not {self.v_max}")


@dataclass(frozen=True, slots=True)
class DwaSettings:
    """How arcs are sampled, rolled out and judged; lengths in metres, times in seconds.

    `period` is the time until the next decision. Weights: `w_path` per metre off the path, `w_goal` per metre still to
    go, `w_heading` per radian between the heading at the end and the path ahead of there, `w_cost` for the dearest
    cell touched (0..1), `w_turn` per rad/s of change in turning rate. `lookahead` is how far ahead on the path the
    heading aims; heading errors above `turn_in_place` are turned away standing. Towards the goal the speed follows
    sqrt(2 * approach * distance). A robot whose centre already stands on an inscribed cell (253), where a map change or
    the rounding to cells may put it, may turn, and drive at up to `escape_v` on arcs that leave these cells within
    0.3 m and never touch 254 or 255; with 0 it may not move at all.
    """

    n_v: int = 25
    n_w: int = 35
    sim_time: float = 1.5
    dt: float = 0.1
    period: float = 0.2
    w_path: float = 2.0
    w_goal: float = 1.0
    w_heading: float = 0.25
    w_cost: float = 0.1
    w_turn: float = 0.01
    lookahead: float = 0.3
    turn_in_place: float = 1.0
    approach: float = 0.15
    goal_tolerance: float = 0.10
    heading_tolerance: float = 0.17
    escape_v: float = 0.1

    def __post_init__(self) -> None:
        for name in ("sim_time", "dt", "period", "lookahead", "turn_in_place", "approach", "goal_tolerance"):
            _arrays.positive(getattr(self, name), name)
        if self.n_v < 2 or self.n_w < 3:
            raise ValueError(f"n_v must be at least 2 and n_w at least 3, not {self.n_v} and {self.n_w}")
        if self.sim_time / self.dt > _MAX_STEPS:
            raise ValueError(f"sim_time / dt must not exceed {_MAX_STEPS} steps")


class DwaResult(NamedTuple):
    """The chosen speeds (m/s, rad/s), the score of their arc (higher is better) and the number of admissible arcs.

    With no admissible arc, or at the goal, both speeds are 0; `n_admissible` 0 means that every arc was blocked.
    """

    v: float
    w: float
    score: float
    n_admissible: int


DEFAULT_LIMITS = DwaLimits()
DEFAULT_SETTINGS = DwaSettings()


@njit(float64(float64), cache=True, nogil=True)
def _wrapped(angle: float) -> float:
    """Return the angle in -pi..pi."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@njit(
    int64(
        float64,
        float64,
        float64,
        float64,
        float64,
        _arrays.U8_GRID,
        float64,
        float64,
        float64,
        _arrays.F64_GRID,
        float64,
        float64,
        float64,
        _arrays.F64_FLAT,
        int64,
        int64,
        _arrays.F64_OUT,
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
    costmap: Any,
    resolution: float,
    origin_x: float,
    origin_y: float,
    path: Any,
    goal_x: float,
    goal_y: float,
    goal_theta: float,
    numbers: Any,
    n_v: int,
    n_w: int,
    chosen: Any,
) -> int:
    """Fill chosen = (v, w, score); return the number of admissible arcs. goal_theta may be nan."""
    v_max, w_max, acc_v, acc_w, wheel_max, axle = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4], numbers[5]
    sim_time, dt, period = numbers[6], numbers[7], numbers[8]
    w_path, w_goal, w_heading, w_cost, w_turn = numbers[9], numbers[10], numbers[11], numbers[12], numbers[13]
    lookahead, turn_in_place, approach = numbers[14], numbers[15], numbers[16]
    goal_tolerance, heading_tolerance, escape_v = numbers[17], numbers[18], numbers[19]
    height, width = costmap.shape
    inverse = 1.0 / resolution
    chosen[0] = 0.0
    chosen[1] = 0.0
    chosen[2] = -math.inf

    column = math.floor((x - origin_x) * inverse)
    row = math.floor((y - origin_y) * inverse)
    if column < 0 or column >= width or row < 0 or row >= height:
        return 0
    here = costmap[row, column]
    escaping = here == INSCRIBED and escape_v > 0.0
    if here >= INSCRIBED and not escaping:
        return 0

    # The piece of the path that this decision can reach, from the point nearest to the robot on; then the goal.
    points = path.shape[0]
    nearest = 0
    along = 0.0
    least = math.inf
    for i in range(points):
        ax, ay = path[i, 0], path[i, 1]
        bx, by = (path[i + 1, 0], path[i + 1, 1]) if i + 1 < points else (goal_x, goal_y)
        ux, uy = bx - ax, by - ay
        square = ux * ux + uy * uy
        part = ((x - ax) * ux + (y - ay) * uy) / square if square > 0.0 else 0.0
        part = min(max(part, 0.0), 1.0)
        away = (ax + part * ux - x) ** 2 + (ay + part * uy - y) ** 2
        if away < least - 1e-12:
            least = away
            nearest = i
            along = part
    seg_x = np.empty(_SEGMENTS)
    seg_y = np.empty(_SEGMENTS)
    seg_ux = np.empty(_SEGMENTS)
    seg_uy = np.empty(_SEGMENTS)
    seg_length = np.empty(_SEGMENTS)
    seg_from = np.empty(_SEGMENTS)
    segments = 0
    reach = v_max * sim_time + 2.0 * lookahead
    remaining = 0.0
    if points > 0:
        bx, by = (path[nearest + 1, 0], path[nearest + 1, 1]) if nearest + 1 < points else (goal_x, goal_y)
        from_x = path[nearest, 0] + along * (bx - path[nearest, 0])
        from_y = path[nearest, 1] + along * (by - path[nearest, 1])
        to_x, to_y = bx, by
        for i in range(nearest + 2, points + 2):
            # The segment from..to grows over points that lie within a centimetre of it: few segments to measure to.
            ux, uy = to_x - from_x, to_y - from_y
            length = math.sqrt(ux * ux + uy * uy)
            if i <= points:
                bx, by = (path[i, 0], path[i, 1]) if i < points else (goal_x, goal_y)
                wx, wy = bx - from_x, by - from_y
                grown = math.sqrt(wx * wx + wy * wy)
                if length < 1e-9 or (
                    length < grown <= _MERGED
                    and abs(ux * wy - uy * wx) <= _MERGE_OFF * grown
                    and ux * wx + uy * wy > 0.0
                ):
                    to_x, to_y = bx, by
                    continue
            if length > 1e-9:
                if remaining < reach and segments < _SEGMENTS:
                    seg_x[segments] = from_x
                    seg_y[segments] = from_y
                    seg_ux[segments] = ux / length
                    seg_uy[segments] = uy / length
                    seg_length[segments] = length
                    seg_from[segments] = remaining
                    segments += 1
                remaining += length
            from_x, from_y = to_x, to_y
            to_x, to_y = bx, by
    to_goal = math.sqrt((goal_x - x) ** 2 + (goal_y - y) ** 2)
    at_goal = to_goal <= goal_tolerance and remaining <= 3.0 * goal_tolerance
    if not at_goal and (segments == 0 or remaining < goal_tolerance):
        # No path, or beside its end: straight to the goal.
        seg_x[0] = x
        seg_y[0] = y
        seg_ux[0] = (goal_x - x) / to_goal
        seg_uy[0] = (goal_y - y) / to_goal
        seg_length[0] = to_goal
        seg_from[0] = 0.0
        segments = 1
        remaining = to_goal

    # Where the path ahead lies, seen from here: decides between turning in place and driving.
    error = 0.0
    turning = False
    if at_goal:
        if not math.isnan(goal_theta):
            error = _wrapped(goal_theta - theta)
            turning = abs(error) > heading_tolerance
        if not turning:
            chosen[2] = 0.0
            return 1
    else:
        aim = min(lookahead, remaining)
        k = 0
        while k + 1 < segments and seg_from[k + 1] <= aim:
            k += 1
        on = min(aim - seg_from[k], seg_length[k])
        aim_x = seg_x[k] + on * seg_ux[k]
        aim_y = seg_y[k] + on * seg_uy[k]
        error = _wrapped(math.atan2(aim_y - y, aim_x - x) - theta)
        turning = abs(error) > turn_in_place

    v_low = max(v_now - acc_v * period, 0.0)
    v_high = min(v_now + acc_v * period, v_max)
    if not at_goal:
        v_high = min(v_high, math.sqrt(2.0 * approach * max(to_goal, remaining, 0.25 * goal_tolerance)))
    if escaping:
        v_high = min(v_high, escape_v)
    if turning:
        v_high = 0.0
    v_low = min(v_low, v_max)
    v_high = max(v_high, v_low)
    w_low = max(w_now - acc_w * period, -w_max)
    w_high = min(w_now + acc_w * period, w_max)
    if w_high < w_low:
        # Faster than allowed already: brake as hard as possible.
        w_low = w_high = w_now - math.copysign(acc_w * period, w_now)
    w_step = (w_high - w_low) / (n_w - 1)
    v_step = (v_high - v_low) / (n_v - 1)
    wanted = 0.0
    if turning:
        # Turn so fast that the error can be braked away, at a third of the braking power to stay smooth.
        wanted = math.copysign(min(w_max, 2.0 * abs(error), math.sqrt(0.67 * acc_w * abs(error))), error)
        if abs(error) > 2.8 and wanted * w_now < -0.01:
            wanted = -wanted  # about face: keep the sense of turning, noise must not reverse it

    # Long enough to prove that the fastest arc can be braked before anything that it would hit.
    horizon = max(sim_time, period + v_high / acc_v)
    if escaping:
        horizon = max(horizon, 0.3 / escape_v)
    steps = min(math.ceil(horizon / dt - 1e-9), _MAX_STEPS)
    judged = min(max(round(sim_time / dt), 1), steps)
    halfway = max(judged // 2, 1)
    unit_x = np.empty(steps + 1)
    unit_y = np.empty(steps + 1)
    base_x = (x - origin_x) * inverse
    base_y = (y - origin_y) * inverse
    zero_w = -1
    if w_low <= 0.0 <= w_high and w_step > 0.0:
        zero_w = round(-w_low / w_step)
    admissible = 0
    best = math.inf
    for j in range(n_w):
        w = 0.0 if j == zero_w else w_low + j * w_step
        # Exact arc per unit of speed, in cells: positions are linear in v.
        unit_x[0] = 0.0
        unit_y[0] = 0.0
        half = 0.5 * w * dt
        chord = dt * inverse * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        cos_now = math.cos(theta + half)
        sin_now = math.sin(theta + half)
        cos_step = math.cos(2.0 * half)
        sin_step = math.sin(2.0 * half)
        for t in range(1, steps + 1):
            unit_x[t] = unit_x[t - 1] + chord * cos_now
            unit_y[t] = unit_y[t - 1] + chord * sin_now
            turned = cos_now * cos_step - sin_now * sin_step
            sin_now = sin_now * cos_step + cos_now * sin_step
            cos_now = turned
        end_theta = theta + w * sim_time
        for i in range(n_v):
            v = v_low + i * v_step
            if v + 0.5 * axle * abs(w) > wheel_max + 1e-9:
                break  # so would every faster one
            dearest = 0
            leaving = escaping
            blocked = False
            for t in range(1, steps + 1):
                c = math.floor(base_x + v * unit_x[t])
                r = math.floor(base_y + v * unit_y[t])
                if c < 0 or c >= width or r < 0 or r >= height:
                    blocked = True
                    break
                cost = int(costmap[r, c])
                if cost >= INSCRIBED:
                    if leaving and cost == INSCRIBED:
                        continue
                    blocked = True
                    break
                leaving = False
                dearest = max(dearest, cost)
            if blocked:
                continue
            if turning:
                total = abs(w - wanted) + 10.0 * v
            else:
                if leaving and v > 0.0:
                    continue  # still inscribed at the end: this way leads along the wall, not off it
                off_end = math.inf
                off_half = math.inf
                at = 0.0
                end_x = x + v * unit_x[judged] * resolution
                end_y = y + v * unit_y[judged] * resolution
                mid_x = x + v * unit_x[halfway] * resolution
                mid_y = y + v * unit_y[halfway] * resolution
                for k in range(segments):
                    px = end_x - seg_x[k]
                    py = end_y - seg_y[k]
                    on = min(max(px * seg_ux[k] + py * seg_uy[k], 0.0), seg_length[k])
                    px -= on * seg_ux[k]
                    py -= on * seg_uy[k]
                    square = px * px + py * py
                    if square < off_end:
                        off_end = square
                        at = seg_from[k] + on
                    px = mid_x - seg_x[k]
                    py = mid_y - seg_y[k]
                    on = min(max(px * seg_ux[k] + py * seg_uy[k], 0.0), seg_length[k])
                    px -= on * seg_ux[k]
                    py -= on * seg_uy[k]
                    off_half = min(off_half, px * px + py * py)
                aim = min(at + lookahead, remaining)
                k = 0
                while k + 1 < segments and seg_from[k + 1] <= aim:
                    k += 1
                on = min(aim - seg_from[k], seg_length[k])
                ahead_x = seg_x[k] + on * seg_ux[k] - end_x
                ahead_y = seg_y[k] + on * seg_uy[k] - end_y
                ahead = ahead_x * ahead_x + ahead_y * ahead_y
                # Near its end the path gives no direction any more.
                trust = min(math.sqrt(ahead) / lookahead, 1.0)
                turn = abs(_wrapped(math.atan2(ahead_y, ahead_x) - end_theta)) * trust
                total = (
                    w_path * 0.5 * (math.sqrt(off_end) + math.sqrt(off_half))
                    + w_goal * (remaining - at)
                    + w_heading * turn
                    + w_cost * dearest / PENALTY_MAX
                    + w_turn * abs(w - w_now)
                )
            admissible += 1
            if total < best:
                best = total
                chosen[0] = v
                chosen[1] = w
                chosen[2] = -total
            if v_step <= 0.0:
                break
    return admissible


def dwa(
    v: float,
    w: float,
    x: float,
    y: float,
    theta: float,
    costmap: NDArray[np.uint8],
    resolution: float,
    origin_x: float,
    origin_y: float,
    path: ArrayLike,
    goal_x: float,
    goal_y: float,
    goal_theta: float | None = None,
    limits: DwaLimits = DEFAULT_LIMITS,
    settings: DwaSettings = DEFAULT_SETTINGS,
) -> DwaResult:
    """Choose the speeds for the next control period.

    `v`, `w`: present speeds (m/s, rad/s). `x`, `y`, `theta`: pose of the robot's centre in `map`. `costmap`: inflated
    local window, uint8 (h, w), row 0 at the bottom, its lower-left corner at (origin_x, origin_y) in `map`; arcs that
    touch 253 or more, or leave the window, are inadmissible. `path`: (n, 2) points in `map`, what is left of the route
    (earlier points do no harm unless the path passes here twice; none means straight to the goal). `goal_x`, `goal_y`:
    where to stop; the path is continued to it in a straight line. `goal_theta`: heading to turn to there, or None.

    Returns the best admissible pair. Within `goal_tolerance` of the goal it brakes and turns to `goal_theta`.
    Raises TypeError or ValueError for wrong types or shapes, and ValueError for numbers that aren't finite.
    """
    costmap = _arrays.grid(costmap, "costmap")
    points = np.ascontiguousarray(path, dtype=np.float64).reshape(-1, 2)
    state = (float(v), float(w), float(x), float(y), float(theta), float(origin_x), float(origin_y))
    aims = (float(goal_x), float(goal_y), 0.0 if goal_theta is None else float(goal_theta))
    if not all(map(math.isfinite, state + aims)) or not np.isfinite(points).all():
        raise ValueError("speeds, pose, origin, path and goal must be finite: don't decide on a lost pose")
    numbers = np.array(
        (
            limits.v_max,
            limits.w_max,
            limits.acc_v,
            limits.acc_w,
            limits.wheel_max,
            limits.axle,
            settings.sim_time,
            settings.dt,
            settings.period,
            settings.w_path,
            settings.w_goal,
            settings.w_heading,
            settings.w_cost,
            settings.w_turn,
            settings.lookahead,
            settings.turn_in_place,
            settings.approach,
            settings.goal_tolerance,
            settings.heading_tolerance,
            settings.escape_v,
        ),
        np.float64,
    )
    chosen = np.empty(3)
    admissible = _choose(
        state[0],
        state[1],
        state[2],
        state[3],
        state[4],
        costmap,
        _arrays.positive(resolution, "resolution"),
        state[5],
        state[6],
        points,
        aims[0],
        aims[1],
        math.nan if goal_theta is None else aims[2],
        numbers,
        settings.n_v,
        settings.n_w,
        chosen,
    )
    return DwaResult(float(chosen[0]), float(chosen[1]), float(chosen[2]), int(admissible))
