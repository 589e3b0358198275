"""The simulated floor and the robot on it: the ground truth. Pure; all randomness comes from one seed.

Frames as everywhere: x right, y up, metres, radians; row 0 of the grid at the bottom. The distance that a wheel rolls
and the distance that the robot covers differ by a systematic error of each wheel's diameter and by slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import LETHAL
from fog_contracts.geometry import distance_to_polygon, normalized_polygon
from fog_contracts.messages import SimObstacle, SimTruth
from fog_kernels.distance import squared_distance_capped
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import Pose
    from fog_contracts.site import NodeSite, RobotSite

SOUND_M_S: Final = 343.0
"""Speed of sound in air at 20 degrees Celsius."""
SONAR_HALF_CONE: Final = math.radians(7.5)
SONAR_MIN_M: Final = 0.02
SONAR_MAX_M: Final = 4.0
SONAR_RAYS: Final = 16
SONAR_MAX_INCIDENCE: Final = math.radians(45.0)
"""Smooth surfaces reflect ultrasound like a mirror: beyond this angle of incidence no echo returns."""
LIDAR_MIN_M: Final = 0.15
LIDAR_MAX_M: Final = 12.0
LIDAR_HEIGHT_M: Final = 0.25
_EXACT_CLEARANCE_M: Final = 0.6
"""Below this distance to a wall the clearance is computed exactly, above it to half a cell."""
_CONTACT_RELEASE_M: Final = 0.01
"""A contact has ended when the clearance exceeds this."""
_MAX_CLEARANCE_M: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Errors of the robot and its sensors; zeros give a perfect world.

    Standard deviations: `wheel_diameter` (share, drawn once per wheel), `slip` (share of the travel, per square root
    of a metre), lidar `range_sigma` (m) plus `range_share` of the range, `lidar_dropout` (probability per beam),
    `sonar_sigma` (m), `sonar_spike` (probability of a single outlier).
    """

    wheel_diameter: float = 0.004
    slip: float = 0.01
    range_sigma: float = 0.008
    range_share: float = 0.004
    lidar_dropout: float = 0.01
    sonar_sigma: float = 0.004
    sonar_spike: float = 0.004


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
    min_clearance: float = _MAX_CLEARANCE_M


class World:
    """A floor (grid and obstacles) with one robot."""

    def __init__(
        self,
        geometry: GridGeometry,
        cells: NDArray[np.uint8],
        robot: RobotSite,
        seed: int,
        *,
        noise: Noise | None = None,
        wheel_lag: float = 0.05,
    ) -> None:
        """Put the robot at its start; `cells` is the static map (0 free, 254 occupied, 255 unknown)."""
        if cells.shape != geometry.shape:
            raise ValueError(f"the map has shape {cells.shape}, its geometry {geometry.shape}")
        self.geometry = geometry
        self.robot = robot
        self.noise = noise or Noise()
        self.axle = 0.235
        """Distance (m) between the base's wheels; `Hardware` sets it."""
        self._wheel_lag = wheel_lag
        self._occupied = np.ascontiguousarray(cells == LETHAL, dtype=np.uint8)
        squared = squared_distance_capped(self._occupied, math.ceil(_MAX_CLEARANCE_M / geometry.resolution))
        self._wall_distance = np.sqrt(squared.astype(np.float64)) * geometry.resolution
        self._rng = np.random.default_rng(seed)
        self._diameter_scale = [1.0 + self.noise.wheel_diameter * float(self._rng.standard_normal()) for _ in range(2)]
        self._obstacles: dict[str, SimObstacle] = {}
        self._outlines: dict[str, list[Point]] = {}
        self._edges: dict[str, NDArray[np.float64]] = {}
        self._wheel_commands = (0.0, 0.0)
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
        return list(self._obstacles.values())

    def place(self, obstacle: SimObstacle) -> None:
        """Place an obstacle, replacing one with the same id.

        Raises `GeometryError` for an invalid outline, `ValueError` if it would stand on the robot.
        """
        outline = normalized_polygon(obstacle.polygon)
        if distance_to_polygon(outline, self._body.x, self._body.y) <= self.robot.radius:
            raise ValueError(f"{obstacle.id} would stand on robot {self.robot.id}: place it elsewhere")
        points = np.array(outline)
        self._obstacles[obstacle.id] = obstacle
        self._outlines[obstacle.id] = outline
        self._edges[obstacle.id] = np.hstack((points, np.roll(points, -1, axis=0)))

    def remove(self, obstacle_id: str) -> bool:
        """Remove an obstacle; return False if there is none with this id."""
        self._outlines.pop(obstacle_id, None)
        self._edges.pop(obstacle_id, None)
        return self._obstacles.pop(obstacle_id, None) is not None

    # --- the robot ---------------------------------------------------------------------------------------------------

    @property
    def pose(self) -> tuple[float, float, float]:
        """The robot's true pose: x, y (m), theta (rad)."""
        return self._body.x, self._body.y, self._body.theta

    @property
    def bumpers(self) -> tuple[bool, bool]:
        """Whether the left and the right half of the bumper are pressed."""
        return self._body.bump_left, self._body.bump_right

    @property
    def contacts(self) -> int:
        """Number of contacts with walls and obstacles so far."""
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

    def step(self, dt: float) -> tuple[float, float]:
        """Simulate `dt` seconds; return how far the left and the right wheel rolled (m at nominal diameter)."""
        body = self._body
        share = 1.0 - math.exp(-dt / self._wheel_lag) if self._wheel_lag > 0 else 1.0
        # Friction stops the motors within a few millimetres, which cuts off the exponential tail.
        body.left = _first_order_step(body.left, self._wheel_commands[0], share)
        body.right = _first_order_step(body.right, self._wheel_commands[1], share)
        wheel_travel = (body.left * dt, body.right * dt)
        if wheel_travel == (0.0, 0.0):
            return wheel_travel
        ground = [
            travel * scale + self.noise.slip * math.sqrt(abs(travel)) * float(self._rng.standard_normal())
            for travel, scale in zip(wheel_travel, self._diameter_scale, strict=True)
        ]
        self._move(ground[0], ground[1])
        return wheel_travel

    def _move(self, left: float, right: float) -> None:
        body = self._body
        travel, rotation = (left + right) / 2, (right - left) / self.axle
        middle = body.theta + rotation / 2
        x, y = body.x + travel * math.cos(middle), body.y + travel * math.sin(middle)
        clearance, towards = self._nearest_obstacle(x, y)
        body.theta = math.remainder(body.theta + rotation, math.tau)
        if clearance < 0 and clearance < self._nearest_obstacle(body.x, body.y)[0]:
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
        """Distance (m) from the robot's rim to the nearest wall or obstacle, negative inside it; at most about 2."""
        return self._nearest_obstacle(self._body.x, self._body.y)[0]

    def _nearest_obstacle(self, x: float, y: float) -> tuple[float, float]:
        """Return the clearance (m) at (x, y) and the direction (rad) to the nearest wall or obstacle."""
        nearest, direction = self._nearest_wall(x, y)
        for outline in self._outlines.values():
            distance = distance_to_polygon(outline, x, y)
            if distance < nearest:
                middle = np.mean(outline, axis=0)
                nearest, direction = distance, math.atan2(middle[1] - y, middle[0] - x)
        return nearest - self.robot.radius, direction

    def _nearest_wall(self, x: float, y: float) -> tuple[float, float]:
        g = self.geometry
        column, row = g.cell(x, y)
        if not g.contains_cell(column, row):
            return 0.0, 0.0
        coarse = float(self._wall_distance[row, column])
        if coarse > _EXACT_CLEARANCE_M:
            return coarse - g.resolution / 2, 0.0
        reach = math.ceil(_EXACT_CLEARANCE_M / g.resolution) + 1
        left, bottom = max(0, column - reach), max(0, row - reach)
        part = self._occupied[bottom : row + reach + 1, left : column + reach + 1]
        rows, columns = np.nonzero(part)
        if rows.size == 0:
            return coarse, 0.0
        # Exact distance to each occupied cell's square.
        low_x = g.origin_x + (columns + left) * g.resolution
        low_y = g.origin_y + (rows + bottom) * g.resolution
        dx = np.clip(x, low_x, low_x + g.resolution) - x
        dy = np.clip(y, low_y, low_y + g.resolution) - y
        squared = dx * dx + dy * dy
        best = int(np.argmin(squared))
        return math.sqrt(float(squared[best])), math.atan2(float(dy[best]), float(dx[best]))

    # --- sensors ------------------------------------------------------------------------------------------------------

    def lidar(self, angles: NDArray[np.float64], now: float) -> NDArray[np.float64]:
        """Measure along `angles` (rad, counter-clockwise, frame of the lidar): ranges (m), nan without a return.

        The robot does not move during a call; `now` is unused, because the world has only its current state.
        """
        del now
        body = self._body
        directions = np.ascontiguousarray(angles + body.theta)
        ranges = self._cast(body.x, body.y, directions, LIDAR_MAX_M)
        for obstacle_id, obstacle in self._obstacles.items():
            if obstacle.height >= LIDAR_HEIGHT_M:
                ranges = np.minimum(ranges, _edge_ranges(self._edges[obstacle_id], body.x, body.y, directions)[0])
        sigma = self.noise.range_sigma + self.noise.range_share * np.where(np.isfinite(ranges), ranges, 0.0)
        ranges = ranges + sigma * self._rng.standard_normal(ranges.size)
        lost = self._rng.random(ranges.size) < self.noise.lidar_dropout
        valid = (ranges >= LIDAR_MIN_M) & (ranges <= LIDAR_MAX_M) & ~lost
        return np.where(valid, ranges, np.nan)

    def sonar(self, node: NodeSite, index: int) -> float | None:
        """Measure with one sonar of a node: range of the nearest echo (m), None without an echo.

        The cone is a fan of rays. Walls and boxes echo only below a maximum angle of incidence; an obstacle that is
        lower than the cone at its range is not seen.
        """
        sonar = node.sonars[index]
        middle = node.theta + sonar.angle
        directions = middle + np.linspace(-SONAR_HALF_CONE, SONAR_HALF_CONE, SONAR_RAYS)
        if self._rng.random() < self.noise.sonar_spike:
            return float(self._rng.uniform(0.1, SONAR_MAX_M))
        # A node is mounted on a wall, and its own cell may be occupied: measure from one cell in front of it.
        ahead = self.geometry.resolution
        x, y = node.x + ahead * math.cos(node.theta), node.y + ahead * math.sin(node.theta)
        walls = self._cast(x, y, directions, SONAR_MAX_M)
        # A wall hides everything behind it, whether it echoes or not.
        echoes = [_echo_ranges(walls, directions)]
        for obstacle_id, obstacle in self._obstacles.items():
            ranges, incidence = _edge_ranges(self._edges[obstacle_id], x, y, directions)
            seen = (
                (ranges < walls) & (incidence <= SONAR_MAX_INCIDENCE) & _in_cone(obstacle.height, node.height, ranges)
            )
            echoes.append(np.where(seen, ranges, np.inf))
        ranges = _circle_ranges(self._body.x, self._body.y, self.robot.radius, x, y, directions)
        seen = (ranges < walls) & _in_cone(self.robot.height, node.height, ranges)
        echoes.append(np.where(seen, ranges, np.inf))
        nearest = float(np.min(echoes)) + ahead
        if not SONAR_MIN_M <= nearest <= SONAR_MAX_M:
            return None
        return max(SONAR_MIN_M, nearest + self.noise.sonar_sigma * float(self._rng.standard_normal()))

    def _cast(self, x: float, y: float, directions: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
        g = self.geometry
        return cast(self._occupied, g.resolution, g.origin_x, g.origin_y, x, y, directions, reach)

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


def _in_cone(top: float, node_height: float, ranges: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether an obstacle of height `top` (m) reaches up into the cone at its range."""
    reach = np.where(np.isfinite(ranges), ranges, 0.0) * math.tan(SONAR_HALF_CONE)
    return np.asarray(top >= node_height - reach)


def _echo_ranges(ranges: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Keep the ranges of a fan where the angle of incidence, estimated from neighbouring rays, gives an echo."""
    finite = np.where(np.isfinite(ranges), ranges, 1e3)
    x, y = finite * np.cos(directions), finite * np.sin(directions)
    dx, dy = np.gradient(x), np.gradient(y)
    # The surface runs along (dx, dy); the incidence is zero where the ray is at a right angle to it.
    along = np.abs(dx * np.cos(directions) + dy * np.sin(directions)) / np.maximum(np.hypot(dx, dy), 1e-9)
    return np.where(np.isfinite(ranges) & (along <= math.sin(SONAR_MAX_INCIDENCE)), ranges, np.inf)


def _edge_ranges(
    edges: NDArray[np.float64], x: float, y: float, directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Range of each ray to the nearest of `edges` (k, 4: x0, y0, x1, y1), infinite for none, and its incidence."""
    cos, sin = np.cos(directions)[:, None], np.sin(directions)[:, None]
    ax, ay = edges[:, 0] - x, edges[:, 1] - y
    ex, ey = edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]
    across = cos * ey - sin * ex
    safe = np.where(across == 0, 1.0, across)
    along_ray = (ax * ey - ay * ex) / safe
    along_edge = (ax * sin - ay * cos) / safe
    hit = (across != 0) & (along_ray >= 0) & (along_edge >= 0) & (along_edge <= 1)
    ranges = np.where(hit, along_ray, np.inf)
    nearest = np.argmin(ranges, axis=1)
    rows = np.arange(directions.size)
    squareness = np.abs(across) / np.maximum(np.hypot(ex, ey), 1e-12)
    incidence = np.arccos(np.clip(squareness[rows, nearest], 0.0, 1.0))
    return ranges[rows, nearest], incidence


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
