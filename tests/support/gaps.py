"""Gaps that only the lidar sees, at which the local planner is driven many times.

A closed loop of the robot's own parts (path follower, dynamic window) with a body, its wheels and a lidar, all
simulated in a few milliseconds per second. The map is empty: everything in the way is seen by the lidar alone, with
noise and a scan's age. Lengths in m, angles in rad, times in s.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import ROBOT_RADIUS
from fog_contracts.grid import GridGeometry
from robot_agent.agent.wheel_control import WheelControl
from robot_agent.config import agent_config
from robot_agent.footprint import Footprint
from robot_agent.hardware import DriveTrain, LidarTraits
from robot_agent.localization.pose import Pose2
from robot_agent.localization.scans import DeskewedScan, RecentScans, smoothed
from robot_agent.motion.local_planner import decide, make_job, twist
from robot_agent.motion.path_follower import PathFollower
from robot_agent.motion.recovery import Recoveries
from robot_agent.safety.gate import SafetyOutputs
from robot_agent.safety.stop_field import StopField

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from robot_agent.safety.stop_field import Wheels

PASSABLE_M: Final = 2.0 * ROBOT_RADIUS + 0.08
"""A gap this wide is to be passed."""
NOISE_M: Final = 0.01
"""Standard deviation of a beam's length."""

_STEP_S: Final = 0.01
_STREAM: Final = 5
_CONTROL: Final = 20
_SCAN: Final = 18
"""Steps between two wheel commands, decisions and scans of the lidar."""
_BEAMS: Final = 360
_RANGE_M: Final = (0.15, 6.0)
_TIME_S: Final = 60.0
"""Longer than a drive that makes every move of a recovery and then passes."""
_GRID: Final = GridGeometry(120, 100, 0.05, -1.0, -2.5)
_END_X: Final = 3.6
_DRIVE: Final = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5)
_LIDAR: Final = LidarTraits(range_min_m=_RANGE_M[0], range_max_m=_RANGE_M[1], scan_period_s=_SCAN * _STEP_S)
_AGENT: Final = agent_config("gaps", b"", _DRIVE, _LIDAR, boot="gaps")
_CONFIG: Final = _AGENT.motion
_ALLOWED: Final = SafetyOutputs(
    mode="NORMAL", reasons=(), cap=_CONFIG.limits.v_max, stop="none", changed=False, refusal=None
)


@dataclass(frozen=True, slots=True)
class Scene:
    """Walls float64 (n, 4) from (x, y) to (x, y), posts (m, 3) with x, y and radius, the path (k, 2), and the start."""

    walls: NDArray[np.float64]
    posts: NDArray[np.float64]
    path: NDArray[np.float64]
    start: Pose2

    def ranges(self, x: float, y: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the exact ranges (m) of beams from a place at these angles; infinite without an echo."""
        ux, uy = np.cos(angles)[:, None], np.sin(angles)[:, None]
        ax, ay = self.walls[:, 0] - x, self.walls[:, 1] - y
        dx, dy = self.walls[:, 2] - self.walls[:, 0], self.walls[:, 3] - self.walls[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            across = ux * dy - uy * dx
            away = (ax * dy - ay * dx) / across
            along = (ax * uy - ay * ux) / across
            met = np.where((away > 0.0) & (along >= 0.0) & (along <= 1.0), away, math.inf).min(axis=1, initial=math.inf)
            px, py, radius = self.posts[:, 0] - x, self.posts[:, 1] - y, self.posts[:, 2]
            ahead = ux * px + uy * py
            half = np.sqrt(radius**2 - (ux * py - uy * px) ** 2)
            hit = np.where((ahead > 0.0) & (half >= 0.0), ahead - half, math.inf).min(axis=1, initial=math.inf)
        nearest: NDArray[np.float64] = np.fmin(met, hit)
        return nearest

    def clearance(self, x: float, y: float) -> float:
        """Return how far (m) a body of the robot's radius at a place is from the nearest thing."""
        here = np.array((x, y))
        begins, edges = self.walls[:, :2], self.walls[:, 2:] - self.walls[:, :2]
        share = np.clip(((here - begins) * edges).sum(axis=1) / (edges**2).sum(axis=1), 0.0, 1.0)
        walls = np.hypot(*(begins + share[:, None] * edges - here).T).min(initial=math.inf)
        posts = (np.hypot(*(self.posts[:, :2] - here).T) - self.posts[:, 2]).min(initial=math.inf)
        return float(min(walls, posts)) - ROBOT_RADIUS


class Outcome(NamedTuple):
    """How one drive ended: whether the robot passed, and the smallest clearance (m; below 0 is a contact)."""

    passed: bool
    clearance_m: float


class Row(NamedTuple):
    """A kind of place and the outcomes of its drives; `passable`: whether the robot is meant to pass."""

    passable: bool
    drives: int
    passed: int
    contacts: int
    clearance_min_m: float


def box(left: float, bottom: float, right: float, top: float) -> list[tuple[float, float, float, float]]:
    """Return the four sides of a box."""
    return [
        (left, bottom, right, bottom),
        (right, bottom, right, top),
        (right, top, left, top),
        (left, top, left, bottom),
    ]


def _scene(
    walls: Sequence[tuple[float, float, float, float]],
    posts: Sequence[tuple[float, float, float]],
    path: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> Scene:
    heading = math.atan2(path[1][1] - path[0][1], path[1][0] - path[0][0])
    start = Pose2(path[0][0] - rng.uniform(0.0, 0.05), path[0][1], heading + rng.uniform(-0.2, 0.2))
    outer = [(-0.9, -2.2, 4.6, -2.2), (-0.9, 2.2, 4.6, 2.2)]
    return Scene(np.array([*walls, *outer]), np.array(posts).reshape(-1, 3), np.array(path), start)


def doorway(gap: float, rng: np.random.Generator) -> Scene:
    """Return a wall, thin or thick, with one gap in it; the path leads through it, up to 3 cm off its middle."""
    thick, middle = rng.uniform(0.02, 0.3), rng.uniform(-0.2, 0.2)
    walls = [*box(1.6, -2.2, 1.6 + thick, middle - gap / 2), *box(1.6, middle + gap / 2, 1.6 + thick, 2.2)]
    off = middle + rng.uniform(-0.03, 0.03)
    return _scene(walls, [], [(0.3, off), (_END_X, off)], rng)


def door_ajar(gap: float, rng: np.random.Generator) -> Scene:
    """Return a doorway of 0.9 m whose door, opened towards the robot, leaves a gap between its edge and the other jamb.

    The path leads through the middle of this gap, and on round the jamb.
    """
    middle, width = rng.uniform(-0.2, 0.2), 0.9
    jamb, hinge = np.array((1.6, middle - width / 2)), np.array((1.6, middle + width / 2))
    opened = 2.0 * math.asin(gap / (2.0 * width))
    leaf = np.array((math.sin(opened), math.cos(opened)))
    edge = hinge - width * leaf
    # The leaf's thickness lies on the side away from the gap.
    back = 0.04 * np.array((-leaf[1], leaf[0]))
    walls = [
        *box(1.6, -2.2, 1.7, float(jamb[1])), *box(1.6, float(hinge[1]), 1.7, 2.2), (*hinge, *edge),
        (*(hinge + back), *(edge + back)), (*edge, *(edge + back)),
    ]  # fmt: skip
    across = (edge - jamb) / gap
    begin = math.atan2(across[1], across[0])
    round_jamb = [
        jamb + gap / 2 * np.array((math.cos(angle), math.sin(angle)))
        for angle in np.linspace(begin % math.tau, math.pi / 2, 6)
    ]
    before = round_jamb[0] - 0.9 * np.array((across[1], -across[0]))
    path = [before, *round_jamb, np.array((_END_X, jamb[1] + gap / 2))]
    return _scene(walls, [], [(float(x), float(y)) for x, y in path], rng)


def chair_legs(gap: float, rng: np.random.Generator) -> Scene:
    """Return two chairs between which the path leads, their legs a gap apart; there is room beside them."""
    middle, radius = rng.uniform(-0.1, 0.1), rng.uniform(0.008, 0.02)
    depth = rng.uniform(0.38, 0.45)
    posts = [
        (1.6 + back * depth, middle + side * (gap / 2 + radius + out * 0.42), radius)
        for back in (0, 1) for side in (-1, 1) for out in (0, 1)
    ]  # fmt: skip
    return _scene([], posts, [(0.3, middle), (_END_X, middle)], rng)


def corner(gap: float, rng: np.random.Generator) -> Scene:
    """Return a corner that the path hugs: its line is half a gap away from the corner's sides."""
    near = gap / 2
    walls = box(1.0, -2.2, 2.4, 0.0)
    path = [(0.3, near), (1.0 + rng.uniform(-0.1, 0.1), near), (2.4 + near, near), (2.4 + near, -0.8), (_END_X, -0.8)]
    return _scene(walls, [], path, rng)


KINDS: Final[dict[str, Callable[[float, np.random.Generator], Scene]]] = {
    "doorway": doorway,
    "door ajar": door_ajar,
    "chair legs": chair_legs,
    "corner": corner,
}


class _Robot:
    """A body on two wheels that follow commands as the base can, and its lidar."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene, self._rng = scene, rng
        self.pose = scene.start
        self.wheels = (0.0, 0.0)
        self.clearance = math.inf
        self.points: NDArray[np.float64] = np.zeros((0, 2))
        """Points (n, 2; m) of the last scans, frame `map`."""
        self._scans = RecentScans()
        self._raw: deque[tuple[float, NDArray[np.float64]]] = deque()
        """Times of the scans that the stop field remembers, and their points in `map`."""
        self._field = StopField(_AGENT.footprint, _DRIVE, _AGENT.stop_field)

    def scan(self, now: float) -> None:
        """Take a scan: where the beams met something, with noise."""
        bearings = np.arange(_BEAMS) * math.tau / _BEAMS + self._rng.uniform(0.0, math.tau / _BEAMS)
        ranges = self.scene.ranges(self.pose.x, self.pose.y, self.pose.theta + bearings)
        ranges += self._rng.normal(0.0, NOISE_M, _BEAMS)
        seen = (ranges > _RANGE_M[0]) & (ranges < _RANGE_M[1])
        there = np.column_stack((np.cos(bearings[seen]), np.sin(bearings[seen])))
        self._scans.add(DeskewedScan(ranges[seen, None] * there, self.pose, now), now)
        self.points = self._scans.points(self.pose, now)
        self._raw.append((now, self.pose.transform(smoothed(ranges[seen, None] * there))))

    def guarded(self, wheels: Wheels, now: float) -> Wheels:
        """Return what the stop field leaves of these wheel speeds."""
        while self._raw and self._raw[0][0] < now - _AGENT.stop_field.memory:
            self._raw.popleft()
        points = np.vstack([points for _, points in self._raw] or [np.zeros((0, 2))])
        return self._field.limit(wheels, self.pose.inverse_transform(points)).wheels

    def move(self, target: tuple[float, float]) -> None:
        """Drive for a step; each wheel approaches its target as fast as the base stops at least."""
        change = _DRIVE.deceleration_m_s2 * _STEP_S
        left, right = (
            now + min(max(wanted - now, -change), change) for now, wanted in zip(self.wheels, target, strict=True)
        )
        self.wheels = left, right
        v, w = twist(left, right, _CONFIG.limits.axle)
        x, y, theta = self.pose
        middle = theta + 0.5 * w * _STEP_S
        self.pose = Pose2(x + v * math.cos(middle) * _STEP_S, y + v * math.sin(middle) * _STEP_S, theta + w * _STEP_S)
        self.clearance = min(self.clearance, self.scene.clearance(self.pose.x, self.pose.y))


def _unguarded(wheels: Wheels, _now: float) -> Wheels:
    """Let every command pass: the stop field would hide what the local planner gets wrong."""
    return wheels


def drive(scene: Scene, rng: np.random.Generator, seconds: float = _TIME_S, *, stop_field: bool = False) -> Outcome:
    """Let the robot follow the scene's path for a time, or until it has passed, touched something or got stuck."""
    robot = _Robot(scene, rng)
    guard = robot.guarded if stop_field else _unguarded
    follower = PathFollower(scene.path, math.inf)
    free = np.zeros(_GRID.shape, np.uint8)
    wheels, recoveries = WheelControl(_AGENT), Recoveries()
    step = 0
    while step < round(seconds / _STEP_S) and robot.pose.x < _END_X - 0.15 and robot.clearance > 0.0:
        now = step * _STEP_S
        if step % _SCAN == 0:
            robot.scan(now)
        if step % _CONTROL == 0:
            follower.advance(robot.pose.x, robot.pose.y, now)
            if follower.stuck_for(now) > _CONFIG.stuck_after:
                break
            recovery = recoveries.due(follower, robot.pose, robot.pose, _CONFIG.limits.v_max, now)
            job = make_job(
                follower, plan_id=1, planner_epoch=1, now=now, pose=robot.pose,
                speeds=twist(*wheels.speeds, _CONFIG.limits.axle), goal_theta=None, cap=_CONFIG.limits.v_max, cost=free,
                speed_limits=free, geometry=_GRID, lidar_points=robot.points,
                footprint=Footprint.circle(ROBOT_RADIUS), config=_CONFIG, recovery=recovery,
            )  # fmt: skip
            wheels.decision = decision = None if job is None else decide(job)
            if decision is not None:
                recoveries.on_decision(decision.blocked)
        if step % _STREAM == 0:
            wheels.command(_ALLOWED, guard, now)
        robot.move(wheels.speeds)
        step += 1
    return Outcome(robot.pose.x >= _END_X - 0.15, robot.clearance)


def series(kind: str, gap: float, seeds: int, seconds: float = _TIME_S, *, stop_field: bool = False) -> Row:
    """Return the outcomes of drives of some seconds at most at one kind of place with gaps of one width (m)."""
    make = KINDS[kind]
    ends = []
    for seed in range(seeds):
        rng = np.random.default_rng((seed, round(gap * 1000), list(KINDS).index(kind)))
        ends.append(drive(make(gap, rng), rng, seconds, stop_field=stop_field))
    return Row(
        # There is always room beside the line along a corner.
        passable=gap >= PASSABLE_M - 1e-9 or kind == "corner",
        drives=seeds,
        passed=sum(end.passed for end in ends),
        contacts=sum(end.clearance_m <= 0.0 for end in ends),
        clearance_min_m=min(end.clearance_m for end in ends),
    )
