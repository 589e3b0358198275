"""The simulated floor and the robot on it: the ground truth. Pure; all randomness comes from one seed.

Frames as everywhere: x right, y up, metres, radians; row 0 of the grid at the bottom. The distance that a wheel rolls
and the distance that the robot covers differ by a systematic error of each wheel's diameter and by slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import contains_point, distance_to_polygon, normalized_polygon
from fog_contracts.messages import SimObstacle, SimTruth
from fog_kernels.emulation import set_in_sectors
from fognav_sim.floor import MAX_CLEARANCE_M
from fognav_sim.sensors import Deception, LidarPlace, Noise, Robot, Sonars, measure_lidar

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.messages import Pose
    from fog_contracts.site import NodeSite, RobotSite
    from fognav_sim.floor import Floor

_CONTACT_RELEASE_M: Final = 0.01
"""A contact has ended when the clearance exceeds this."""
_CLIFF_SENSORS_RAD: Final = (-1.05, -0.3, 0.3, 1.05)
_CLIFF_SENSORS_SHARE: Final = 0.95
"""Directions of the cliff sensors, and how far they are from the robot's middle, of its radius."""
_POST_M: Final = 0.16
"""How far parts of the robot that its lidar sees are from its axis."""
_WANDER_S: Final = 1.0
"""Within which the speed of a wheel for the same command changes."""
_BODY_CORNERS: Final = 8
"""Of the polygon around a robot's circle that the sensors of others measure."""


@dataclass
class _Body:
    x: float
    y: float
    theta: float
    left: float = 0.0
    right: float = 0.0
    distance: float = 0.0
    contacts: int = 0
    in_contact: bool = False
    bump_left: bool = False
    bump_right: bool = False
    min_clearance: float = MAX_CLEARANCE_M


class World:
    """A floor (grid and obstacles) with one robot; other robots may drive there, each in a world of its own."""

    def __init__(
        self,
        floor: Floor,
        robot: RobotSite,
        seed: int,
        *,
        axle_m: float,
        noise: Noise | None = None,
        wheel_lag: float = 0.05,
    ) -> None:
        """Put the robot at its start; `axle_m` is the distance between the wheels of its base."""
        self._floor = floor
        self._sonars = Sonars(floor)
        self.robot = robot
        self.noise = noise or Noise()
        self._axle_m = axle_m
        self._wheel_lag = wheel_lag
        self._rng = np.random.default_rng(seed)
        self._diameter_scale = [1.0 + self.noise.wheel_diameter * float(self._rng.standard_normal()) for _ in range(2)]
        self._wheel_commands = (0.0, 0.0)
        self.no_return_rad: tuple[float, float] | None = None
        """Sector of the lidar (from, to; rad, counter-clockwise) in which nothing returns its beams."""
        self.held_wheels = [False, False]
        """Whether the left and the right wheel turn on the spot."""
        self.holes: dict[str, list[Point]] = {}
        """Outlines of holes in the floor, such as stairs that lead down: only the base's cliff sensors find them."""
        self.deceived: dict[str, Deception] = {}
        """What the sonars of some nodes hear instead of what is there."""
        self._gain = [0.0, 0.0]
        self._ground = (0.0, 0.0)
        """How far (m) each wheel moved the robot in the last step, where the floor's grip is limited."""
        self._others: tuple[World, ...] = ()
        start = robot.start
        self._body = _Body(start.x, start.y, start.theta)
        clearance = self.clearance()
        if clearance < 0:
            raise ValueError(
                f"robot {robot.id} starts at ({start.x:.2f}, {start.y:.2f}), {-clearance:.2f} m inside an obstacle: "
                "move its start in site.toml"
            )
        self._body.min_clearance = clearance

    # --- the floor ---------------------------------------------------------------------------------------------------

    @property
    def obstacles(self) -> list[SimObstacle]:
        """The obstacles on the floor; walls are in the map."""
        return self._floor.obstacles

    def place(self, obstacle: SimObstacle, *, soft: bool = False) -> None:
        """Place an obstacle, replacing one with the same id; one that is `soft` swallows sound.

        Raises `GeometryError` for an invalid outline, `ValueError` if it would stand on the robot.
        """
        outline = normalized_polygon(obstacle.polygon)
        if distance_to_polygon(outline, self._body.x, self._body.y) <= self.robot.radius:
            raise ValueError(f"{obstacle.id} would stand on robot {self.robot.id}: place it elsewhere")
        self._floor.place(obstacle, soft=soft)

    def remove(self, obstacle_id: str) -> bool:
        """Remove an obstacle; return False if there is none with this id."""
        return self._floor.remove(obstacle_id)

    def share_with(self, others: Iterable[World]) -> None:
        """Let the robots of other worlds be in the way of this one, exactly where they are at each moment.

        This world's sensors find them where they were at the last `see_others`. Raises `ValueError` if robots overlap.
        """
        self._others = tuple(others)
        if self.clearance() < 0:
            raise ValueError(f"robot {self.robot.id} stands in another one: move its start")
        self.see_others()

    def see_others(self) -> None:
        """Let the sensors find the other robots where they are now."""
        for other in self._others:
            self._floor.place(other.outline(), solid=False)

    # --- the robot ---------------------------------------------------------------------------------------------------

    def outline(self) -> SimObstacle:
        """Return the robot as an obstacle to the sensors of others: a polygon around its circle."""
        reach = self.robot.radius / math.cos(math.pi / _BODY_CORNERS)
        turns = (math.tau * corner / _BODY_CORNERS for corner in range(_BODY_CORNERS))
        ring = [(self._body.x + reach * math.cos(turn), self._body.y + reach * math.sin(turn)) for turn in turns]
        return SimObstacle(id=self.robot.id, polygon=ring, height=self.robot.height)

    @property
    def pose(self) -> tuple[float, float, float]:
        """The robot's true pose: x, y (m), theta (rad)."""
        return self._body.x, self._body.y, self._body.theta

    @property
    def bumpers(self) -> tuple[bool, bool]:
        """Whether the left and the right half of the bumper are pressed."""
        return self._body.bump_left, self._body.bump_right

    @property
    def over_cliff(self) -> bool:
        """Whether a cliff sensor, one of four along the robot's front, is over a hole."""
        return bool(self.holes) and any(
            contains_point(hole, *self._ahead(angle)) for hole in self.holes.values() for angle in _CLIFF_SENSORS_RAD
        )

    @property
    def fallen(self) -> bool:
        """Whether the robot's middle is over a hole."""
        return any(contains_point(hole, self._body.x, self._body.y) for hole in self.holes.values())

    def _ahead(self, angle: float) -> Point:
        """Return the place (m) under the robot's rim in this direction (rad) from its heading."""
        reach, along = _CLIFF_SENSORS_SHARE * self.robot.radius, self._body.theta + angle
        return self._body.x + reach * math.cos(along), self._body.y + reach * math.sin(along)

    @property
    def contacts(self) -> int:
        """Number of contacts with walls, obstacles and other robots so far, as far as this one drove into them."""
        return self._body.contacts

    @property
    def distance(self) -> float:
        """True distance travelled, m."""
        return self._body.distance

    def set_wheels(self, left: float, right: float) -> None:
        """Command these wheel speeds (m/s) from now on."""
        self._wheel_commands = (left, right)

    def kidnap(self, pose: Pose) -> None:
        """Move the robot to another pose; raises `ValueError` if that is not free."""
        old = self.pose
        self._body.x, self._body.y, self._body.theta = pose.x, pose.y, pose.theta
        if self.clearance() < 0:
            self._body.x, self._body.y, self._body.theta = old
            raise ValueError(f"({pose.x:.2f}, {pose.y:.2f}) is not free: choose a free place for the robot")

    def turn(self, angle: float) -> None:
        """Turn the robot by this angle (rad) at once, without its wheels."""
        self._body.theta = math.remainder(self._body.theta + angle, math.tau)

    def step(self, dt: float) -> tuple[float, float]:
        """Simulate `dt` seconds; return how far the left and the right wheel rolled (m at nominal diameter)."""
        body = self._body
        share = 1.0 - math.exp(-dt / self._wheel_lag) if self._wheel_lag > 0 else 1.0
        # Friction stops the motors within a few millimetres, which cuts off the exponential tail.
        left, right = self._driven_speeds(dt)
        body.left = _first_order_step(body.left, left, share)
        body.right = _first_order_step(body.right, right, share)
        wheel_travel = (body.left * dt, body.right * dt)
        if wheel_travel == self._ground == (0.0, 0.0):
            return wheel_travel
        ground = [
            travel * scale + self.noise.slip * math.sqrt(abs(travel)) * float(self._rng.standard_normal())
            for travel, scale in zip(wheel_travel, self._diameter_scale, strict=True)
        ]
        if (grip := self.noise.grip) < math.inf:
            change = grip * dt * dt
            ground = [
                min(max(travel, before - change), before + change)
                for travel, before in zip(ground, self._ground, strict=True)
            ]
            self._ground = (ground[0], ground[1])
        left_scale, right_scale = self.noise.wheel_scale
        left_held, right_held = self.held_wheels
        self._move(0.0 if left_held else ground[0] * left_scale, 0.0 if right_held else ground[1] * right_scale)
        return wheel_travel

    def _driven_speeds(self, dt: float) -> tuple[float, float]:
        """Return the speeds (m/s) at which the motors turn for what is commanded."""
        left, right = self._wheel_commands
        gains = self.noise.wheel_gain
        if (wander := self.noise.wheel_wander) > 0.0:
            keep = math.exp(-dt / _WANDER_S)
            fresh = wander * math.sqrt(1.0 - keep * keep)
            self._gain = [keep * gain + fresh * float(self._rng.standard_normal()) for gain in self._gain]
        return left * (gains[0] + self._gain[0]), right * (gains[1] + self._gain[1])

    def _move(self, left: float, right: float) -> None:
        body = self._body
        travel, rotation = (left + right) / 2, (right - left) / self._axle_m
        middle = body.theta + rotation / 2
        x, y = body.x + travel * math.cos(middle), body.y + travel * math.sin(middle)
        clearance, towards = self._nearest(x, y)
        body.theta = math.remainder(body.theta + rotation, math.tau)
        if clearance < 0 and clearance < self._nearest(body.x, body.y)[0]:
            # In contact: the wheels keep turning, the robot stays.
            if not body.in_contact:
                body.contacts += 1
            body.in_contact = True
            self._press_bumper(towards)
        else:
            body.distance += math.hypot(x - body.x, y - body.y)
            body.x, body.y = x, y
            # Slip makes the clearance of a robot that pushes against an obstacle vary: that counts as one contact.
            if clearance > _CONTACT_RELEASE_M:
                body.in_contact = body.bump_left = body.bump_right = False
        body.min_clearance = min(body.min_clearance, clearance)

    def _press_bumper(self, direction: float) -> None:
        side = math.remainder(direction - self._body.theta, math.tau)
        if abs(side) < math.radians(95.0):
            self._body.bump_left = side > -math.radians(10.0)
            self._body.bump_right = side < math.radians(10.0)

    def clearance(self) -> float:
        """Distance (m) from its rim to the nearest wall, obstacle or other robot, negative inside; at most about 2."""
        return self._nearest(self._body.x, self._body.y)[0]

    def _nearest(self, x: float, y: float) -> tuple[float, float]:
        """Return the clearance (m) at (x, y) and the direction (rad) to the nearest wall, obstacle or other robot."""
        distance, direction = self._floor.nearest(x, y)
        for other in self._others:
            there_x, there_y, _ = other.pose
            if (apart := math.hypot(there_x - x, there_y - y) - other.robot.radius) < distance:
                distance, direction = apart, math.atan2(there_y - y, there_x - x)
        return distance - self.robot.radius, direction

    # --- sensors ------------------------------------------------------------------------------------------------------

    def lidar(self, angles: NDArray[np.float64], now: float) -> NDArray[np.float64]:
        """Measure along `angles` (rad, counter-clockwise, frame of the lidar): ranges (m), nan without a return.

        The robot does not move during a call; `now` is unused, because the world has only its current state.
        """
        return self.lidar_at(LidarPlace(), angles, now)

    def lidar_at(self, place: LidarPlace, angles: NDArray[np.float64], now: float) -> NDArray[np.float64]:
        """Measure as `lidar` does, with a lidar that is mounted elsewhere than on the robot's axis."""
        del now
        seen_along = -angles if place.mirrored else angles
        ranges = measure_lidar(self._floor, place.pose(self.pose), seen_along, self.noise, self._rng)
        if self.no_return_rad is not None:
            set_in_sectors(ranges, angles, np.array((self.no_return_rad,)), math.nan)
        if place.posts:
            set_in_sectors(ranges, seen_along + place.yaw, place.sectors, _POST_M)
        return ranges

    def sonar(self, node: NodeSite, index: int) -> float | None:
        """Measure with one sonar of a node: range of the nearest echo (m), None without an echo."""
        robot = Robot(x=self._body.x, y=self._body.y, radius=self.robot.radius, height=self.robot.height)
        measured = self._sonars.measure(robot, node, index, self.noise, self._rng)
        deception = self.deceived.get(node.id)
        return measured if deception is None else deception.hear(measured, self._rng)

    def truth(self, stamp: float, sustained_speed: float = 1.0) -> SimTruth:
        """Return the ground truth."""
        body = self._body
        return SimTruth(
            robot=self.robot.id,
            x=body.x,
            y=body.y,
            theta=body.theta,
            left=body.left,
            right=body.right,
            distance=body.distance,
            clearance=self.clearance(),
            min_clearance=body.min_clearance,
            contacts=body.contacts,
            obstacles=self.obstacles,
            stamp=stamp,
            sustained_speed=sustained_speed,
        )


def _first_order_step(current: float, target: float, share: float) -> float:
    """Move a speed (m/s) this share of the way to its target, as a first-order lag does."""
    following = current + (target - current) * share
    return target if abs(target - following) < 1e-3 else following
