"""A reference implementation of the dynamic window approach in plain numpy, without `fog_kernels.dwa`'s optimizations.

Every arc is rolled out in closed form at every step, the path is a polyline whose points are all kept, and all scores
are returned, so that a test can compare arcs and not only the winner. Metres, radians, seconds; frame `map`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import INSCRIBED, PENALTY_MAX, UNKNOWN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.dwa import DwaLimits, DwaSettings


@dataclass(frozen=True)
class Scene:
    """The inputs of a decision: speeds, pose, costmap with resolution and origin, path (n, 2), goal (x, y), heading."""

    v: float
    w: float
    pose: tuple[float, float, float]
    costmap: NDArray[np.uint8]
    resolution: float
    origin: tuple[float, float]
    path: NDArray[np.float64]
    goal: tuple[float, float]
    goal_theta: float | None

    def cost_at(self, x: float, y: float) -> int:
        """Return the cost at a point; outside the window it is unknown."""
        column = math.floor((x - self.origin[0]) / self.resolution)
        row = math.floor((y - self.origin[1]) / self.resolution)
        height, width = self.costmap.shape
        return int(self.costmap[row, column]) if 0 <= column < width and 0 <= row < height else UNKNOWN


@dataclass(frozen=True)
class Arc:
    """An admissible arc; a higher score is better."""

    v: float
    w: float
    score: float


def wrapped(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


class Route:
    """The polyline from the path's point nearest to the robot to the goal."""

    def __init__(self, scene: Scene, limits: DwaLimits, settings: DwaSettings) -> None:
        here = np.array(scene.pose[:2])
        goal = np.array(scene.goal)
        points = np.vstack((scene.path.reshape(-1, 2), goal))
        if len(points) > 1:
            on_pieces = [nearest_on(here, a, b) for a, b in itertools.pairwise(points)]
            piece = int(np.argmin([np.hypot(*(point - here)) for point in on_pieces]))
            points = np.vstack((on_pieces[piece], points[piece + 1 :]))
        self.length = float(np.hypot(*np.diff(points, axis=0).T).sum())
        if self.length < settings.goal_tolerance < np.hypot(*(goal - here)):
            points = np.vstack((here, goal))
            self.length = float(np.hypot(*(goal - here)))
        steps = np.hypot(*np.diff(points, axis=0).T)
        starts = np.concatenate(([0.0], np.cumsum(steps)))[: len(steps)]
        # A later part of the route that passes here again must not attract the arc.
        reached = (starts < limits.v_max * settings.sim_time + 2.0 * settings.lookahead) & (steps > 0.0)
        self.begins, self.ends = points[:-1][reached], points[1:][reached]
        self.starts, self.steps = starts[reached], steps[reached]

    def nearest(self, point: NDArray[np.float64]) -> tuple[float, float]:
        """Return the distance to the route and how far along it the nearest point lies."""
        found = [nearest_on(point, a, b) for a, b in zip(self.begins, self.ends, strict=True)]
        away = np.array([np.hypot(*(one - point)) for one in found])
        best = int(away.argmin())
        return float(away[best]), float(self.starts[best] + np.hypot(*(found[best] - self.begins[best])))

    def at(self, along: float) -> NDArray[np.float64]:
        """Return the point this far along the route."""
        best = int(np.flatnonzero(self.starts <= along)[-1])
        share = min((along - self.starts[best]) / self.steps[best], 1.0)
        point: NDArray[np.float64] = self.begins[best] + share * (self.ends[best] - self.begins[best])
        return point


def nearest_on(point: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    square = float((b - a) @ (b - a))
    share = float(np.clip((point - a) @ (b - a) / square, 0.0, 1.0)) if square > 0.0 else 0.0
    nearest: NDArray[np.float64] = a + share * (b - a)
    return nearest


def position(scene: Scene, v: float, w: float, time: float) -> NDArray[np.float64]:
    """Return where an arc is after a time: the chord of a circle, at half the turn."""
    x, y, theta = scene.pose
    chord = v * time * float(np.sinc(w * time / (2.0 * math.pi)))
    return np.array((x + chord * math.cos(theta + 0.5 * w * time), y + chord * math.sin(theta + 0.5 * w * time)))


def highest_cost(scene: Scene, v: float, w: float, times: NDArray[np.float64], *, escaping: bool) -> int | None:
    """Return the highest cost on an arc, INSCRIBED if it never leaves the inscribed cells, None if it is blocked."""
    costs = [scene.cost_at(*position(scene, v, w, float(time))) for time in times]
    outside = next((i for i, cost in enumerate(costs) if cost != INSCRIBED), len(costs)) if escaping else 0
    if any(cost >= INSCRIBED for cost in costs[outside:]):
        return None
    return max(costs[outside:], default=INSCRIBED)


def decide(scene: Scene, limits: DwaLimits, settings: DwaSettings) -> list[Arc] | None:  # noqa: C901, PLR0912  # a single function, like the description of the method
    """Return all admissible arcs in any order; None when the goal and its heading are reached."""
    x, y, theta = scene.pose
    here = scene.cost_at(x, y)
    escaping = here == INSCRIBED and settings.escape_v > 0.0
    if here >= INSCRIBED and not escaping:
        return []
    route = Route(scene, limits, settings)
    to_goal = math.hypot(scene.goal[0] - x, scene.goal[1] - y)
    top = limits.v_max
    if to_goal <= settings.goal_tolerance and route.length <= 3.0 * settings.goal_tolerance:
        error = 0.0 if scene.goal_theta is None else wrapped(scene.goal_theta - theta)
        turning = abs(error) > settings.heading_tolerance
        if not turning:
            return None
    else:
        aim = route.at(min(settings.lookahead, route.length)) - (x, y)
        error = wrapped(math.atan2(aim[1], aim[0]) - theta)
        turning = abs(error) > settings.turn_in_place
        left = max(to_goal, route.length, 0.25 * settings.goal_tolerance)
        top = min(top, math.sqrt(2.0 * settings.approach * left))
    if escaping:
        top = min(top, settings.escape_v)
    if turning:
        top = 0.0
    slowest = min(max(scene.v - limits.acc_v * settings.period, 0.0), limits.v_max)
    fastest = max(min(scene.v + limits.acc_v * settings.period, top), slowest)
    speeds = np.linspace(slowest, fastest, settings.n_v) if fastest > slowest else np.array([slowest])

    horizon = max(settings.sim_time, settings.period + fastest / limits.acc_v)
    if escaping:
        horizon = max(horizon, 0.3 / settings.escape_v)
    steps = min(math.ceil(horizon / settings.dt - 1e-9), 200)
    times = settings.dt * np.arange(1, steps + 1)
    arcs = []
    for w in turning_rates(scene.w, limits, settings):
        for v in speeds:
            if v + 0.5 * limits.axle * abs(w) > limits.wheel_max + 1e-9:
                continue
            cost = highest_cost(scene, float(v), w, times, escaping=escaping)
            if cost is None or (cost == INSCRIBED and v > 0.0 and not turning):
                continue
            if turning:
                total = abs(w - turning_goal(error, scene.w, limits)) + 10.0 * v
            else:
                total = route_total(scene, route, float(v), w, steps, settings)
                total += settings.w_cost * (cost if cost < INSCRIBED else 0) / PENALTY_MAX
                total += settings.w_turn * abs(w - scene.w)
            arcs.append(Arc(float(v), w, -float(total)))
    return arcs


def turning_rates(w_now: float, limits: DwaLimits, settings: DwaSettings) -> list[float]:
    """Return the reachable angular speeds; the one nearest to zero is set to zero."""
    change = limits.acc_w * settings.period
    low, high = max(w_now - change, -limits.w_max), min(w_now + change, limits.w_max)
    if high < low:  # faster than allowed: only braking
        return [w_now - math.copysign(change, w_now)] * settings.n_w
    rates = np.linspace(low, high, settings.n_w)
    if low <= 0.0 <= high:
        rates[np.abs(rates).argmin()] = 0.0
    return [float(rate) for rate in rates]


def turning_goal(error: float, w_now: float, limits: DwaLimits) -> float:
    """Return the angular speed at which a heading error is corrected."""
    size = min(limits.w_max, 2.0 * abs(error), math.sqrt(0.67 * limits.acc_w * abs(error)))
    sign = math.copysign(1.0, error)
    if abs(error) > 2.8 and sign * size * w_now < -0.01:
        sign = -sign
    return sign * size


def route_total(scene: Scene, route: Route, v: float, w: float, steps: int, settings: DwaSettings) -> float:
    """Return the cost of following the route: offsets at middle and end, distance to go, heading error at the end."""
    end = min(max(round(settings.sim_time / settings.dt), 1), steps)
    at_end = position(scene, v, w, end * settings.dt)
    at_middle = position(scene, v, w, max(end // 2, 1) * settings.dt)
    off_end, along = route.nearest(at_end)
    off_middle, _ = route.nearest(at_middle)
    ahead = route.at(min(along + settings.lookahead, route.length)) - at_end
    trust = min(float(np.hypot(*ahead)) / settings.lookahead, 1.0)
    turn = abs(wrapped(math.atan2(ahead[1], ahead[0]) - (scene.pose[2] + w * settings.sim_time))) * trust
    return (
        settings.w_path * 0.5 * (off_end + off_middle)
        + settings.w_goal * (route.length - along)
        + settings.w_heading * turn
    )
