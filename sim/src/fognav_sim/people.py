"""People who walk about the simulated floor by the social-force model of Helbing and Molnár (1995). Pure.

Everybody accelerates to a speed and a direction of their own, and is repelled by others (of whom the robot is one) and
by walls. Parameters are those of the paper, as two open implementations have them. These differ in the time by which
others are thought to be ahead: 0.4 and 1 s; here it is 1 s. Not of the paper, and our own: where people go, that they
stand there for a while and give way to nobody then, and that nobody is pushed into a body or a wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import FREE, INSCRIBED, Inflation
from fog_contracts.messages import SimObstacle
from fog_kernels.astar import Planner
from fog_kernels.distance import squared_distance_capped
from fog_kernels.inflation import inflate, inflation_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.grid import StaticMap
    from fognav_sim.world import World

    Floats = NDArray[np.float64]

STEP_S: Final = 0.05
SPEED_M_S: Final = (1.34, 0.26)
"""Mean and standard deviation of the speeds at which people like to walk."""
_FASTEST: Final = 1.3
"""How many times that speed somebody walks at most."""
_RELAXATION_S: Final = 0.5
_OTHERS: Final = (2.1, 0.3)
"""Strength (m2/s2) and reach (m) of what repels people from one another."""
_WALLS: Final = (10.0, 0.2)
"""The same of walls."""
_AHEAD_S: Final = 1.0
_SIGHT: Final = math.cos(math.radians(100.0))
_BEHIND: Final = 0.5
"""What others weigh who are not within 100 degrees of where somebody goes."""
BODY_M: Final = 0.2
"""Radius of a person, round and as tall as all sensors look."""
FROM_ROBOT_M: Final = 0.1
"""Nobody walks nearer than this to a robot's rim: what comes nearer, the robot brought about."""
STANDS_S: Final = 20.0
"""Mean of the exponential time for which somebody stands at the end of a way."""
_ARRIVED_M: Final = 0.5
_PURSUED_M: Final = 0.8
_STUCK_S: Final = 5.0
_STUCK_M: Final = 0.3
"""Who gets no further than this within `_STUCK_S` goes elsewhere."""
_KEPT_FREE_M: Final = 3.0
"""Nobody begins so near to the robot."""
_CORNERS: Final = [(math.cos(k * math.tau / 12), math.sin(k * math.tau / 12)) for k in range(12)]


@dataclass
class _Way:
    """Where somebody goes: the points (m) of the way, the next of them, and where and when progress was last made."""

    points: Floats
    next: int
    stands_until: float
    seen_at: Point
    seen_s: float


class People:
    """So many people on a floor; the same for the same seed and the same robot."""

    def __init__(self, map_: StaticMap, count: int, seed: int, robot: Point) -> None:
        """Spread them over the floor, some on their way and some standing."""
        grid = map_.geometry
        self._grid, self._rng = grid, np.random.default_rng(seed)
        occupied = np.ascontiguousarray(map_.cells != FREE, dtype=np.uint8)
        squared = squared_distance_capped(occupied, math.ceil(2.0 / grid.resolution))
        self._wall_m = np.sqrt(squared.astype(np.float64)) * grid.resolution
        inflation = Inflation(inscribed_radius=BODY_M + 0.1, inflation_radius=1.0, cost_scaling=3.0)
        self._costs = inflate(
            np.where(map_.cells == FREE, 0, 254).astype(np.uint8), inflation_table(grid.resolution, inflation)
        )
        self._planner = Planner(grid.width, grid.height)
        self._places = np.argwhere(self._costs < INSCRIBED)[:, ::-1]
        self.now = 0.0
        self.places = np.zeros((count, 2))
        """Where everybody is (n, 2), m."""
        self._velocity = np.zeros((count, 2))
        self._speed = np.maximum(self._rng.normal(*SPEED_M_S, count), 0.3)
        self._robot = np.array(robot)
        for who in range(count):
            while True:
                self.places[who] = self._somewhere()
                others = np.hypot(*(self.places[:who] - self.places[who]).T)
                if math.dist(self.places[who], robot) > _KEPT_FREE_M and np.all(others > 1.0):
                    break
        self._ways = [self._way(who) for who in range(count)]
        for way in self._ways:
            if self._rng.random() < STANDS_S / (STANDS_S + 40.0):
                way.stands_until = float(self._rng.exponential(STANDS_S))
                way.next = len(way.points)

    @property
    def standing(self) -> NDArray[np.bool_]:
        """Who stands, of his own will, and gives way to nobody."""
        return np.array([way.next >= len(way.points) for way in self._ways], dtype=bool)

    def walk(self, world: World) -> None:
        """Let everybody walk for a step, with the robot where it is, and place them on its floor."""
        self.now += STEP_S
        x, y, _ = world.pose
        robot = np.array((x, y))
        pace, self._robot = (robot - self._robot) / STEP_S, robot
        standing = self._pursue()
        before = self.places.copy()
        bodies = np.vstack((self.places, robot))
        paces = np.vstack((self._velocity, pace))
        desired = self._desired(standing)
        change = (
            (desired - self._velocity) / _RELAXATION_S + self._repelled(bodies, paces, desired) + self._from_walls()
        )
        velocity = self._velocity + STEP_S * change
        speed = np.maximum(np.hypot(*velocity.T), 1e-9)
        velocity *= np.minimum(1.0, _FASTEST * self._speed / speed)[:, None]
        velocity[standing] = 0.0
        rim = np.append(np.full(len(self.places), 2.0 * BODY_M), BODY_M + FROM_ROBOT_M + world.robot.radius)
        self._velocity = self._kept_apart(velocity, bodies, rim)
        self._step(world)
        for who in np.flatnonzero(np.any(self.places != before, axis=1)):
            world.place(self._outline(int(who)))

    def begin(self, world: World) -> None:
        """Put everybody on the robot's floor."""
        for who in range(len(self.places)):
            world.place(self._outline(who))

    def _outline(self, who: int) -> SimObstacle:
        x, y = self.places[who]
        ring = [(float(x + BODY_M * cos), float(y + BODY_M * sin)) for cos, sin in _CORNERS]
        return SimObstacle(id=f"person-{who}", polygon=ring, height=1.7)

    def _somewhere(self) -> Point:
        column, row = self._places[self._rng.integers(len(self._places))]
        return self._grid.centre(int(column), int(row))

    def _way(self, who: int) -> _Way:
        """Return a way to somewhere else; nobody is asked to go where no way leads."""
        x, y = (float(value) for value in self.places[who])
        start = self._grid.cell(x, y)
        while True:
            found = self._planner.plan(self._costs, start, self._grid.cell(*self._somewhere()))
            if found.found and len(found.cells) > 1:
                return _Way(self._grid.centres(found.cells), 0, 0.0, (x, y), self.now)
            if self._costs[start[1], start[0]] >= INSCRIBED:
                near = self._places[np.argmin(np.hypot(*(self._places - start).T))]
                start = int(near[0]), int(near[1])

    def _pursue(self) -> NDArray[np.bool_]:
        """Move everybody's next point on; return who stands."""
        for who, way in enumerate(self._ways):
            place = self.places[who]
            if way.next >= len(way.points):
                if self.now >= way.stands_until:
                    self._ways[who] = self._way(who)
                continue
            while way.next < len(way.points) and math.dist(way.points[way.next], place) < _PURSUED_M:
                way.next += 1
            if way.next >= len(way.points):
                if math.dist(way.points[-1], place) < _ARRIVED_M:
                    way.stands_until = self.now + float(self._rng.exponential(STANDS_S))
                else:
                    way.next = len(way.points) - 1
            if math.dist(place, way.seen_at) > _STUCK_M:
                way.seen_at, way.seen_s = (float(place[0]), float(place[1])), self.now
            elif self.now - way.seen_s > _STUCK_S and way.next < len(way.points):
                self._ways[who] = self._way(who)
        return self.standing

    def _desired(self, standing: NDArray[np.bool_]) -> Floats:
        """Return the velocities (n, 2) that people would like to have."""
        targets = np.array([way.points[min(way.next, len(way.points) - 1)] for way in self._ways]).reshape(-1, 2)
        towards = targets - self.places
        length = np.maximum(np.hypot(*towards.T), 1e-9)
        return np.where(standing[:, None], 0.0, towards / length[:, None] * self._speed[:, None])

    def _repelled(self, bodies: Floats, paces: Floats, desired: Floats) -> Floats:
        """Return by how much (m/s2) others repel everybody: the gradient of a potential whose lines are ellipses."""
        strength, reach = _OTHERS
        apart = self.places[:, None] - bodies[None]
        step = np.broadcast_to(paces[None] * _AHEAD_S, apart.shape)
        here = np.maximum(np.linalg.norm(apart, axis=2), 1e-6)
        there = np.maximum(np.linalg.norm(apart - step, axis=2), 1e-6)
        minor = 0.5 * np.sqrt(np.maximum((here + there) ** 2 - np.sum(step**2, axis=2), 1e-9))
        towards = apart / here[..., None] + (apart - step) / there[..., None]
        size = strength / reach * np.exp(-minor / reach) * (here + there) / (4.0 * minor)
        force = size[..., None] * towards
        seen = (
            np.einsum("ik,ijk->ij", desired, -force)
            >= _SIGHT * np.linalg.norm(force, axis=2) * np.maximum(np.hypot(*desired.T), 1e-9)[:, None]
        )
        weight = np.where(seen, 1.0, _BEHIND)
        np.fill_diagonal(weight, 0.0)
        summed: Floats = np.sum(weight[..., None] * force, axis=1)
        return summed

    def _from_walls(self) -> Floats:
        """Return by how much (m/s2) the nearest wall repels everybody."""
        strength, reach = _WALLS
        away, towards = self._wall(self.places)
        size: Floats = strength / reach * np.exp(-away / reach)
        return size[:, None] * towards

    def _wall(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the distance (m) to the nearest wall, and the direction away from it."""
        step = 2.0 * self._grid.resolution
        away = self._grid.sample(self._wall_m, points, 0.0)
        rise = np.stack(
            [
                self._grid.sample(self._wall_m, points + offset, 0.0)
                - self._grid.sample(self._wall_m, points - offset, 0.0)
                for offset in (np.array((step, 0.0)), np.array((0.0, step)))
            ],
            axis=1,
        )
        return away, rise / np.maximum(np.linalg.norm(rise, axis=1), 1e-9)[:, None]

    def _kept_apart(self, velocity: Floats, bodies: Floats, rim: Floats) -> Floats:
        """Return velocities (n, 2) by which nobody comes nearer to a body that is too near: they slip along it."""
        apart = self.places[:, None] - bodies[None]
        away = np.linalg.norm(apart, axis=2)
        np.fill_diagonal(away, np.inf)
        for who, other in np.argwhere(away < rim[None] + STEP_S * 0.5):
            outwards = apart[who, other] / max(float(away[who, other]), 1e-6)
            velocity[who] -= min(0.0, float(velocity[who] @ outwards)) * outwards
        return velocity

    def _step(self, world: World) -> None:
        """Move everybody on whom no wall and no robot stops."""
        wanted = self.places + STEP_S * self._velocity
        away, _ = self._wall(wanted)
        now_away, _ = self._wall(self.places)
        gap = np.hypot(*(wanted - self._robot).T) - world.robot.radius - BODY_M
        free = ((away >= BODY_M) | (away > now_away)) & (gap > 0.5 * FROM_ROBOT_M)
        self.places = np.where(free[:, None], wanted, self.places)
        self._velocity[~free] = 0.0
