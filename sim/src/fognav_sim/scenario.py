"""What happens in the world besides the robot: things that appear and vanish, at a time, a distance or a word. Pure."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import contains_point, distance_to_polygon
from fog_contracts.messages import SimObstacle
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from fog_contracts.site import AreaSite, NodeSite, Site
    from fog_runtime.maps import StaticMap
    from fognav_sim.world import World

KEEP_AWAY_M: Final = 3.0
"""Nothing appears nearer to the robot than this."""
BARRIER_HEIGHT_M: Final = 1.0
PERSON_RADIUS_M: Final = 0.22
PERSON_HEIGHT_M: Final = 1.7
_GAP_M: Final = 0.30
"""No gap beside a barrier is wider; the robot needs 0.34 m."""
_SEEN_FROM_M: Final = 0.20
"""A barrier begins this far before the node, where its sonars meet it squarely."""
_WALL_GAP_M: Final = 0.02
_THICKNESS_M: Final = (0.4, 0.8)
_SHIFT_M: Final = 0.1
_BEYOND_M: Final = 0.4
_REACH_M: Final = 20.0
_DRAWS: Final = 40


class ScenarioError(ValueError):
    """A scenario that can't be played on this site; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """One change of the world, once: things placed and removed.

    It is due when the robot has driven `at_distance` (m), when `at_time` (s since the start) has come, or when
    somebody says `on_word`; all that are given must hold. It waits until nothing that it places would stand nearer to
    the robot's centre than `keep_away` (m).
    """

    name: str
    place: tuple[SimObstacle, ...] = ()
    remove: tuple[str, ...] = ()
    at_distance: float = 0.0
    at_time: float = 0.0
    on_word: str | None = None
    keep_away: float = KEEP_AWAY_M


@dataclass(frozen=True, slots=True)
class Happened:
    """An event that came true: when (s since the start) and after which way of the robot (m)."""

    name: str
    time: float
    distance: float


class Scenario:
    """Plays events into a world, in their order where several are due. `start` is the time (s) that counts as zero."""

    def __init__(self, events: Iterable[Event], *, start: float, distance: float = 0.0) -> None:
        self._waiting = list(events)
        self._start = start
        self._begun_at = distance
        self._words: set[str] = set()

    @property
    def waiting(self) -> list[Event]:
        """The events that have not come true yet."""
        return list(self._waiting)

    def say(self, word: str) -> None:
        """Let the events that wait for this word come true."""
        self._words.add(word)

    def step(self, world: World, now: float) -> list[Happened]:
        """Let come true what is due at `now` (s); returns it."""
        happened: list[Happened] = []
        for event in self._waiting[:]:
            if not self._due(event, world, now):
                continue
            for obstacle in event.place:
                world.place(obstacle)
            for identifier in event.remove:
                world.remove(identifier)
            self._waiting.remove(event)
            happened.append(Happened(event.name, now - self._start, world.distance - self._begun_at))
        return happened

    def _due(self, event: Event, world: World, now: float) -> bool:
        x, y, _ = world.pose
        return (
            now - self._start >= event.at_time
            and world.distance - self._begun_at >= event.at_distance
            and (event.on_word is None or event.on_word in self._words)
            and all(distance_to_polygon(thing.polygon, x, y) >= event.keep_away for thing in event.place)
        )


def person_at(x: float, y: float, *, name: str = "person") -> SimObstacle:
    """Return somebody standing at (x, y) in metres: an upright octagon, 0.44 m wide and 1.7 m high."""
    corners = [(k + 0.5) * math.tau / 8 for k in range(8)]
    ring = [(x + PERSON_RADIUS_M * math.cos(a), y + PERSON_RADIUS_M * math.sin(a)) for a in corners]
    return SimObstacle(id=name, polygon=ring, height=PERSON_HEIGHT_M)


def barrier_across(area: AreaSite, site: Site, static: StaticMap, seed: int, *, name: str = "barrier") -> SimObstacle:
    """Return a box inside the area that nobody of the robot's width can pass, and that the area's nodes see.

    It spans the corridor along the beam of one of the area's nodes, from just before the node to the wall across (or,
    in an area without nodes, across its narrowest direction), and nowhere enters a wall. Raises `ScenarioError` when
    the area has no such place.
    """
    generator = np.random.default_rng((seed, *area.id.encode()))
    nodes = [node for node in site.nodes if node.area == area.id]
    for _ in range(_DRAWS):
        thickness = float(generator.uniform(*_THICKNESS_M))
        if nodes:
            node = nodes[int(generator.integers(len(nodes)))]
            box = _before_node(node, static, thickness, float(generator.uniform(-_SHIFT_M, _SHIFT_M)))
        else:
            box = _at_narrowest(area, static, thickness, float(generator.uniform(0.35, 0.65)))
        if box is not None and all(contains_point(area.polygon, *_shrunk(box, corner)) for corner in box):
            return SimObstacle(id=name, polygon=box, height=BARRIER_HEIGHT_M)
    raise ScenarioError(
        f"area {area.id}: no barrier fits in wall to wall with gaps below {_GAP_M} m: choose an area across a corridor"
    )


def _shrunk(box: Sequence[tuple[float, float]], corner: tuple[float, float]) -> tuple[float, float]:
    """Move a corner towards the middle: an area may end before the walls and their recesses, where a barrier ends."""
    mx, my = sum(x for x, _ in box) / len(box), sum(y for _, y in box) / len(box)
    share = min(1.0, _BEYOND_M / math.dist(corner, (mx, my)))
    return corner[0] + share * (mx - corner[0]), corner[1] + share * (my - corner[1])


def _before_node(node: NodeSite, static: StaticMap, thickness: float, shift: float) -> list[tuple[float, float]] | None:
    direction = node.theta + sum(sonar.angle for sonar in node.sonars) / len(node.sonars)
    x, y = node.x - shift * math.sin(direction), node.y + shift * math.cos(direction)
    return _box(static, x, y, direction, thickness, begin=_SEEN_FROM_M)


def _at_narrowest(
    area: AreaSite, static: StaticMap, thickness: float, share: float
) -> list[tuple[float, float]] | None:
    xs, ys = [x for x, _ in area.polygon], [y for _, y in area.polygon]
    x = min(xs) + share * (max(xs) - min(xs))
    y = min(ys) + share * (max(ys) - min(ys))
    if not contains_point(area.polygon, x, y):
        return None
    half = np.arange(0.0, math.pi, math.pi / 36)
    widths = _reach(static, x, y, half) + _reach(static, x, y, half + math.pi)
    return _box(static, x, y, float(half[int(np.argmin(widths))]), thickness, begin=None)


def _box(
    static: StaticMap, x: float, y: float, direction: float, thickness: float, *, begin: float | None
) -> list[tuple[float, float]] | None:
    """Return a box along `direction` around (x, y) from wall to wall, or from `begin` on; None when a gap stays open.

    Its ends follow the nearest point of the wall over the box's thickness, so that it never enters one.
    """
    along = (math.cos(direction), math.sin(direction))
    across = (-along[1], along[0])
    offsets = np.linspace(-0.5, 0.5, 17) * thickness
    ahead = np.empty(len(offsets))
    behind = np.empty(len(offsets))
    for index, offset in enumerate(offsets):
        px, py = x + offset * across[0], y + offset * across[1]
        ahead[index], behind[index] = _reach(static, px, py, np.array([direction, direction + math.pi]))
    if not (np.isfinite(ahead).all() and np.isfinite(behind).all()):
        return None
    end = float(ahead.min()) - _WALL_GAP_M
    first = begin if begin is not None else _WALL_GAP_M - float(behind.min())
    if end <= first or float(ahead.max()) - end > _GAP_M or float(behind.max()) + first > _GAP_M:
        return None
    sides = itertools.chain(((first, -0.5), (end, -0.5)), ((end, 0.5), (first, 0.5)))
    return [
        (x + way * along[0] + side * thickness * across[0], y + way * along[1] + side * thickness * across[1])
        for way, side in sides
    ]


def _reach(static: StaticMap, x: float, y: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cast rays that end at whatever is not known to be free floor."""
    grid = static.geometry
    return cast(static.cells, grid.resolution, grid.origin_x, grid.origin_y, x, y, angles, _REACH_M)
