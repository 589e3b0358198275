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

from fog_contracts.costs import INSCRIBED, LETHAL, PENALTY_MAX, UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from fog_kernels.clearance import Clearance
    from fog_kernels.dwa import DwaLimits, DwaSettings
    from fog_kernels.robot import Body

SWEEP_STEP = 0.025
"""m between two places on the way of a body that isn't round."""


@dataclass(frozen=True)
class Scene:
    """The inputs of a decision: speeds, pose, distances around the robot, path (n, 2), goal (x, y), heading."""

    v: float
    w: float
    pose: tuple[float, float, float]
    around: Clearance
    body: Body
    path: NDArray[np.float64]
    goal: tuple[float, float]
    goal_theta: float | None

    def cell(self, x: float, y: float) -> tuple[float, float]:
        """Return column and row of a point, with fractions."""
        around = self.around
        return (x - around.origin_x) / around.resolution, (y - around.origin_y) / around.resolution

    def cost_at(self, x: float, y: float) -> int:
        """Return the cost at a point; outside the window it is unknown."""
        column, row = map(math.floor, self.cell(x, y))
        height, width = self.around.cost.shape
        return int(self.around.cost[row, column]) if 0 <= column < width and 0 <= row < height else UNKNOWN

    def distance_at(self, x: float, y: float) -> float:
        """Return the distance, interpolated between the centres of the four nearest cells."""
        size = self.around.distance.shape[0]
        column, row = (min(max(value - 0.5, 0.0), size - 1.001) for value in self.cell(x, y))
        i, j = int(column), int(row)
        corner = self.around.distance[j : j + 2, i : i + 2].astype(np.float64)
        shares = np.outer((1.0 - row + j, row - j), (1.0 - column + i, column - i))
        return float((shares * corner).sum())

    def clearance(self, x: float, y: float, theta: float, limits: DwaLimits, settings: DwaSettings) -> float:
        """Return how far the body keeps from everything at least, after what may happen between two lookups."""
        body, cell, padding = self.body, self.around.resolution, settings.padding
        near = body.inscribed + padding
        bend = limits.wheel_max**2 / (2.0 * limits.axle) * settings.dt**2
        slack = ((limits.v_max * settings.dt) ** 2 / near + bend) / 8.0 + cell**2 / (4.0 * near)
        away = self.distance_at(x, y)
        keeps = [away - body.inscribed - slack]
        if away < body.circumscribed + padding + slack and len(body.discs):
            small = float(body.discs[:, 2].min()) + padding
            slack = SWEEP_STEP**2 / (8.0 * small) + cell**2 / (4.0 * small)
            turned = complex(math.cos(theta), math.sin(theta))
            for disc_x, disc_y, radius in body.discs:
                place = complex(x, y) + turned * complex(disc_x, disc_y)
                keeps.append(self.distance_at(place.real, place.imag) - radius - slack)
        return min(keeps)


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


def places(
    scene: Scene, v: float, w: float, times: NDArray[np.float64], settings: DwaSettings
) -> Iterator[tuple[bool, float, float, float]]:
    """Yield the poses of an arc, and whether each lies at one of the times or between two of them.

    A disc is looked up at the times only; between them, on the chord, a body that isn't round is looked up as well.
    """
    body, theta = scene.body, scene.pose[2]
    parts = 1
    if len(body.discs):
        parts = max(1, math.ceil((v + abs(w) * body.circumscribed) * settings.dt / SWEEP_STEP))
    begin, earlier = np.array(scene.pose[:2]), 0.0
    for time in times:
        end = position(scene, v, w, float(time))
        for part in range(1, parts + 1):
            share = part / parts
            at = earlier + share * settings.dt
            yield part == parts, *(begin + share * (end - begin)), theta + w * at
        begin, earlier = end, float(time)


def highest_cost(
    scene: Scene, v: float, w: float, times: NDArray[np.float64], limits: DwaLimits, settings: DwaSettings
) -> int | None:
    """Return the highest cost on an arc; None if the body comes too near to something."""
    highest = 0
    for at_step, x, y, theta in places(scene, v, w, times, settings):
        if at_step:
            cost = scene.cost_at(x, y)
            if cost >= INSCRIBED:
                return None
            highest = max(highest, cost)
        if scene.clearance(x, y, theta, limits, settings) < settings.padding:
            return None
    return highest


def escape_cost(
    scene: Scene, v: float, w: float, times: NDArray[np.float64], limits: DwaLimits, settings: DwaSettings
) -> int | None:
    """Return the highest cost on an escaping arc, INSCRIBED if it never regains the padding, None if it is blocked."""
    level = min(scene.clearance(*scene.pose, limits, settings), settings.padding)
    highest, inside = 0, True
    for _, x, y, theta in places(scene, v, w, times, settings):
        cost, clear = scene.cost_at(x, y), scene.clearance(x, y, theta, limits, settings)
        if cost >= LETHAL or clear < level - 1e-6:
            return None
        level = max(level, min(clear, settings.padding))
        if cost < INSCRIBED and clear >= settings.padding:
            highest, inside = max(highest, cost), False
        elif not inside:
            return None
    return INSCRIBED if inside else highest


def decide(scene: Scene, limits: DwaLimits, settings: DwaSettings) -> list[Arc] | None:  # noqa: C901, PLR0912  # a single function, like the description of the method
    """Return all admissible arcs in any order; None when the goal and its heading are reached."""
    x, y, theta = scene.pose
    here = scene.cost_at(x, y)
    too_near = here == INSCRIBED or scene.clearance(*scene.pose, limits, settings) < settings.padding
    escaping = too_near and settings.escape_v > 0.0
    if here >= LETHAL or (too_near and not escaping):
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
            if v > speeds[0] and v * abs(w) > limits.acc_lateral:
                continue
            on_arc = escape_cost if escaping else highest_cost
            cost = on_arc(scene, float(v), w, times, limits, settings)
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
