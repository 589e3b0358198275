"""What lidar and sonars measure on the simulated floor, with their noise. Pure.

Frames as everywhere: x right, y up, metres, radians. A lidar errs as recorded ones do: what it loses has structure, and
its noise depends on the range. The figures are those of recordings of an RPLidar A1 (several series in living rooms,
some 690,000 measurements).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, NamedTuple, Self

import numpy as np

from fog_contracts.cones import SONAR_HALF_CONE
from fog_kernels.emulation import Beams, Drawn, RecordedErrors, disturb, disturb_as_recorded
from fog_kernels.sonar import SONAR_MAX_INCIDENCE, SONAR_MAX_M, SONAR_MIN_M, wall_fan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.robot import LidarSettings
    from fog_contracts.site import NodeSite
    from fog_kernels.sonar import Beam, Fan
    from fognav_sim.floor import Floor

LIDAR_MIN_M: Final = 0.15
LIDAR_MAX_M: Final = 12.0
_ERRORS: Final = RecordedErrors(
    noise=np.array(((0.0, 0.0016), (2.0, 0.0018), (2.5, 0.0030), (12.0, 0.054))),
    loss=np.array(((0.0, 0.20), (0.3, 0.15), (0.45, 0.05), (1.0, 0.01), (4.0, 0.01), (8.0, 0.03), (12.0, 0.06))),
    tail=0.15,
    tail_sigmas=4.0,
    outliers=4e-4,
    low=LIDAR_MIN_M,
    high=LIDAR_MAX_M,
)
_FLICKER_RAD: Final = math.radians(2.0)


@dataclass(frozen=True, kw_only=True)
class LidarFaults:
    """How a lidar errs on a floor, besides its noise.

    `patches`: places (x, y, radius; m, frame `map`) whose surfaces return a beam with this probability only, such as
    black or shiny ones. `dead`: sectors (from, to; rad, counter-clockwise, in the lidar's frame) in which nothing
    returns; their edges flicker.
    """

    patches: tuple[tuple[float, float, float, float], ...] = ()
    dead: tuple[tuple[float, float], ...] = ()

    @cached_property
    def _patches(self) -> NDArray[np.float64]:
        return np.array(self.patches).reshape(-1, 4)

    @cached_property
    def _dead(self) -> NDArray[np.float64]:
        return np.array(self.dead).reshape(-1, 2)

    def disturb(
        self,
        ranges: NDArray[np.float64],
        angles: NDArray[np.float64],
        place: tuple[float, float],
        directions: NDArray[np.float64],
        generator: np.random.Generator,
    ) -> None:
        """Turn these true ranges (m) into what is measured of them, nan for no return.

        `angles` are those of the beams in the lidar's frame, `directions` those on the floor (rad); it is at `place`.
        """
        drawn = Drawn(
            generator.random(ranges.size),
            generator.standard_normal(ranges.size),
            generator.random((3 + len(self.patches), ranges.size)),
        )
        dead = self._dead
        if dead.size:
            dead = dead + _FLICKER_RAD * generator.standard_normal(dead.shape)
        beams = Beams(angles, np.cos(directions), np.sin(directions))
        disturb_as_recorded(ranges, beams, drawn, _ERRORS, place, self._patches, dead)


SOUND_M_S: Final = 343.0
"""Speed of sound in air at 20 degrees Celsius."""
LIDAR_HEIGHT_M: Final = 0.25


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Errors of the robot and its sensors; zeros give a perfect world.

    Standard deviations: `wheel_diameter` (share, drawn once per wheel), `slip` (share of the travel, per square root
    of a metre), lidar `range_sigma` (m) plus `range_share` of the range, `lidar_dropout` (probability per beam),
    `sonar_sigma` (m), `sonar_spike` (probability of a single outlier). `grip` (m/s2): what a wheel holds on the floor
    without skidding.
    """

    wheel_diameter: float = 0.004
    slip: float = 0.01
    range_sigma: float = 0.008
    range_share: float = 0.004
    lidar_dropout: float = 0.01
    sonar_sigma: float = 0.004
    sonar_spike: float = 0.004
    wheel_scale: tuple[float, float] = (1.0, 1.0)
    wheel_gain: tuple[float, float] = (1.0, 1.0)
    wheel_wander: float = 0.0
    grip: float = math.inf
    sonar_miss: float = 0.0
    lidar: LidarFaults | None = None


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The robot as the sensors of a node see it: an upright cylinder at (x, y); radius and height in m."""

    x: float
    y: float
    radius: float
    height: float


@dataclass(frozen=True, kw_only=True)
class Deception:
    """What a node's sonars hear instead of what is there, in this order.

    An echo comes from `scale` times its range and `offset` (m) more: a wrong temperature, a detour, something on the
    sonar itself. None comes with the probability `lost`: a dead or covered sonar. Anything comes with `stray`.
    """

    scale: float = 1.0
    offset: float = 0.0
    lost: float = 0.0
    stray: float = 0.0

    def hear(self, measured: float | None, generator: np.random.Generator) -> float | None:
        """Return what is heard of a true measurement."""
        if generator.random() < self.stray:
            return float(generator.uniform(0.1, SONAR_MAX_M))
        if measured is None or generator.random() < self.lost:
            return None
        heard = self.scale * measured + self.offset
        return heard if heard <= SONAR_MAX_M else None


@dataclass(frozen=True, kw_only=True)
class LidarPlace:
    """Where a lidar is mounted: its axis (m) and the direction of its zero (rad) in the robot's frame.

    A `mirrored` one hangs upside down: its angles grow clockwise, seen from above. In the sectors `posts` (from, to;
    rad, counter-clockwise in the robot's frame) it sees parts of the robot, 0.16 m away.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    mirrored: bool = False
    posts: tuple[tuple[float, float], ...] = ()

    @cached_property
    def sectors(self) -> NDArray[np.float64]:
        """The posts as float64[n, 2]."""
        return np.array(self.posts).reshape(-1, 2)

    @classmethod
    def of(cls, mounted: LidarSettings) -> Self:
        """Return where a robot's settings say that it is."""
        return cls(
            x=mounted.x_m, y=mounted.y_m, yaw=mounted.yaw_rad, mirrored=mounted.mirrored, posts=tuple(mounted.masks)
        )

    def pose(self, robot: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the lidar's pose on the floor for the robot's (m, m, rad)."""
        x, y, theta = robot
        cos, sin = math.cos(theta), math.sin(theta)
        return x + cos * self.x - sin * self.y, y + sin * self.x + cos * self.y, theta + self.yaw


def measure_lidar(
    floor: Floor,
    pose: tuple[float, float, float],
    angles: NDArray[np.float64],
    noise: Noise,
    generator: np.random.Generator,
) -> NDArray[np.float64]:
    """Measure from `pose` (m, rad) along `angles` (rad, counter-clockwise): ranges (m), nan without a return."""
    x, y, theta = pose
    directions = np.ascontiguousarray(angles + theta)
    ranges = floor.wall_ranges(x, y, directions, LIDAR_MAX_M)
    for obstacle, seen, _ in floor.obstacle_ranges(x, y, directions, LIDAR_MAX_M):
        if obstacle.height >= LIDAR_HEIGHT_M:
            ranges = np.minimum(ranges, seen)
    if noise.lidar is not None:
        noise.lidar.disturb(ranges, angles, (x, y), directions, generator)
        return ranges
    disturb(
        ranges,
        generator.standard_normal(ranges.size),
        generator.random(ranges.size),
        sigma=noise.range_sigma,
        share=noise.range_share,
        dropout=noise.lidar_dropout,
        low=LIDAR_MIN_M,
        high=LIDAR_MAX_M,
    )
    return ranges


class _Heard(NamedTuple):
    """The range (m) of the nearest wall or obstacle that echoes, and what hides what is behind it, for each ray."""

    nearest: float
    hidden: NDArray[np.float64]


class Sonars:
    """The sonars of a floor's nodes.

    A sonar's cone is a fan of rays. Walls and boxes echo only below a maximum angle of incidence; an obstacle that is
    lower than the cone at its range is not seen, and a soft one hides what is behind it. Nodes and walls do not move,
    so what the walls echo is computed once, and what the obstacles do whenever one of them has changed.
    """

    def __init__(self, floor: Floor) -> None:
        self._floor = floor
        self._fans: dict[Beam, Fan] = {}
        self._obstacles: dict[tuple[Beam, float], _Heard] = {}
        self._as_of = floor.changes

    def measure(
        self, robot: Robot, node: NodeSite, index: int, noise: Noise, generator: np.random.Generator
    ) -> float | None:
        """Measure with one sonar of a node: range of the nearest echo (m), None without an echo."""
        if generator.random() < noise.sonar_spike:
            return float(generator.uniform(0.1, SONAR_MAX_M))
        beam = (node.x, node.y, node.theta, node.sonars[index].angle)
        fan = self._fan(beam)
        heard = self._nearest_standing(beam, fan, node.height)
        nearest = min(heard.nearest, _nearest_of_robot(fan, heard.hidden, robot, node))
        nearest += self._ahead_m
        if not SONAR_MIN_M <= nearest <= SONAR_MAX_M or (noise.sonar_miss and generator.random() < noise.sonar_miss):
            return None
        return max(SONAR_MIN_M, nearest + noise.sonar_sigma * float(generator.standard_normal()))

    @property
    def _ahead_m(self) -> float:
        """How far in front of its node a sonar begins: the node's own cell may be part of its wall."""
        return self._floor.geometry.resolution

    def _fan(self, beam: Beam) -> Fan:
        if beam not in self._fans:
            self._fans[beam] = wall_fan(beam, self._ahead_m, self._floor.wall_ranges)
        return self._fans[beam]

    def _nearest_standing(self, beam: Beam, fan: Fan, height: float) -> _Heard:
        """Return the range (m) of the nearest wall or obstacle that echoes, infinite for none."""
        if self._as_of != self._floor.changes:
            self._as_of = self._floor.changes
            self._obstacles.clear()
        if (beam, height) not in self._obstacles:
            self._obstacles[beam, height] = self._search_obstacles(fan, height)
        return self._obstacles[beam, height]

    def _search_obstacles(self, fan: Fan, height: float) -> _Heard:
        hidden, standing = fan.walls, []
        for obstacle, ranges, squareness in self._floor.obstacle_ranges(fan.x, fan.y, fan.directions, SONAR_MAX_M):
            met = np.where(_in_cone(obstacle.height, height, ranges), ranges, np.inf)
            if self._floor.is_soft(obstacle.id):
                hidden = np.minimum(hidden, met)
            else:
                standing.append(np.where(np.arccos(squareness) <= SONAR_MAX_INCIDENCE, met, np.inf))
        # A wall hides everything behind it, whether it echoes or not; so does what is soft.
        nearest = float(np.min(np.where(fan.walls <= hidden, fan.echoes, np.inf)))
        for met in standing:
            nearest = min(nearest, float(np.min(np.where(met < hidden, met, np.inf))))
        return _Heard(nearest, hidden)


def _nearest_of_robot(fan: Fan, hidden: NDArray[np.float64], robot: Robot, node: NodeSite) -> float:
    """Return the range (m) at which a robot echoes, infinite if it does not."""
    if math.hypot(robot.x - fan.x, robot.y - fan.y) - robot.radius > SONAR_MAX_M:
        return math.inf
    ranges = _circle_ranges(robot.x, robot.y, robot.radius, fan.x, fan.y, fan.directions)
    seen = (ranges < hidden) & _in_cone(robot.height, node.height, ranges)
    return float(np.min(np.where(seen, ranges, np.inf)))


def _in_cone(top: float, node_height: float, ranges: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether an obstacle of height `top` (m) reaches up into the cone at its range."""
    reach = np.where(np.isfinite(ranges), ranges, 0.0) * math.tan(SONAR_HALF_CONE)
    return np.asarray(top >= node_height - reach)


def _circle_ranges(
    cx: float, cy: float, radius: float, x: float, y: float, directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Range of each ray to a circle, infinite for none."""
    dx, dy = cx - x, cy - y
    along = dx * np.cos(directions) + dy * np.sin(directions)
    offset = dx * np.sin(directions) - dy * np.cos(directions)
    inside = radius * radius - offset * offset
    ranges = along - np.sqrt(np.maximum(inside, 0.0))
    return np.where((inside >= 0) & (ranges >= 0), ranges, np.inf)
