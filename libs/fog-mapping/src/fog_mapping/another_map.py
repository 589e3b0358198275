"""What another map would mean for a site: what lies in a wall there, and which floor is new or gone. Pure.

Needs no more than numpy and the kernels: the map-service has it, which has no simulator and lays no map onto another.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal

import msgspec
import numpy as np

from fog_contracts.cones import ConeError, node_cone
from fog_contracts.costs import FREE, LETHAL, ROBOT_RADIUS, UNKNOWN
from fog_contracts.shapes import ShapeError, rasterize, rasterize_shape
from fog_contracts.site import BEFORE_MARKER_M
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from fog_kernels.sonar import classify, default_config, heard_on_map

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import Place, Pose, Zone
    from fog_contracts.shapes import ShapeMask
    from fog_contracts.site import NodeSite, Site

_EDGE_M: Final = 1e-6
_ON_WALL_M: Final = 0.15
_KNOWN_CELLS: Final = 4

Kind = Literal["place", "moved-place", "start", "dock", "staging", "node", "marker", "area", "zone", "robot", "goal"]
_WORDS: Final[dict[Kind, str]] = {
    "moved-place": "operators' place", "start": "start of robot", "dock": "dock of robot", "goal": "goal of robot",
    "staging": "place in front of the dock of robot",
}  # fmt: skip
Code = Literal["off_map", "in_wall", "unknown", "tight", "cut_off", "misreads", "unseen"]


class Finding(msgspec.Struct, frozen=True):
    """A thing of the site at (x, y; m) that does not fit the new map; `refused`: with it the services would not start.

    `code` is what `problem` says in words: it lies off the map, in a wall, or where nothing is known; has no room for a
    robot or no way to it; is a node that would report what is not there, or a marker that nobody sees.
    """

    kind: Kind
    id: str
    x: float
    y: float
    code: Code
    problem: str
    refused: bool = False

    def __str__(self) -> str:
        return f"{_WORDS.get(self.kind, self.kind)} {self.id} at ({self.x:.2f}, {self.y:.2f}) {self.problem}"


class ChangedArea(msgspec.Struct, frozen=True, kw_only=True):
    """How much floor (m2) of each map is wall on the other, and how much one of both alone knows as free.

    `changed`: the share of the cells that either map knows, which are not the same on the other.
    """

    wall_to_floor_m2: float
    floor_to_wall_m2: float
    newly_known_m2: float
    no_longer_known_m2: float
    changed: float


def agreement(before: StaticMap, after: StaticMap) -> float:
    """Return which share of the walls of both maps lies on each other, of those where the other map knows the floor.

    0 where neither knows anything of the other. Maps of one floor in one frame have more than 0.7.
    """
    close = seen = 0
    for one, other in ((after, before), (before, after)):
        rows, columns = np.nonzero((one.cells == LETHAL) & _beside(one.cells == FREE))
        g = other.geometry
        cap = math.ceil(_ON_WALL_M / g.resolution) + 1
        on_wall = squared_distance_capped(other.cells == LETHAL, cap) <= (_ON_WALL_M / g.resolution) ** 2
        known = squared_distance_capped(other.cells == FREE, _KNOWN_CELLS) < _KNOWN_CELLS**2
        told = np.where(known, np.where(on_wall, np.uint8(2), np.uint8(1)), np.uint8(0))
        found = g.sample(told, one.geometry.centres(np.column_stack((columns, rows))), 0)
        close += int((found == 2).sum())
        seen += int((found > 0).sum())
    return close / seen if seen else 0.0


def _beside(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells of which a neighbour in the same row or column is one of these."""
    found = np.zeros_like(cells)
    found[1:] |= cells[:-1]
    found[:-1] |= cells[1:]
    found[:, 1:] |= cells[:, :-1]
    found[:, :-1] |= cells[:, 1:]
    return found


def changed_area(before: StaticMap, after: StaticMap) -> ChangedArea:
    """Return what differs between two maps of one frame."""
    side, other = after.geometry.resolution**2, before.geometry.resolution**2
    was, now = _of_free(before, after), _of_free(after, before)
    new = (was != LETHAL) & (was != FREE)
    gone = (now != LETHAL) & (now != FREE)
    differ = float((was != FREE).sum()) * side + float((now != FREE).sum()) * other
    whole = float(was.size) * side + float((now != FREE).sum()) * other
    return ChangedArea(
        wall_to_floor_m2=round(float((was == LETHAL).sum()) * side, 2),
        floor_to_wall_m2=round(float((now == LETHAL).sum()) * other, 2),
        newly_known_m2=round(float(new.sum()) * side, 2),
        no_longer_known_m2=round(float(gone.sum()) * other, 2),
        changed=round(differ / whole, 4) if whole else 0.0,
    )


def _of_free(one: StaticMap, free_on: StaticMap) -> NDArray[np.uint8]:
    """Return what a map has at each cell that is free on the other one."""
    rows, columns = np.nonzero(free_on.cells == FREE)
    g = one.geometry
    found: NDArray[np.uint8] = g.sample(one.cells, free_on.geometry.centres(np.column_stack((columns, rows))), UNKNOWN)
    return found


_Trouble = tuple[Code, str]
_OFF_MAP: Final[_Trouble] = "off_map", "lies off the map"
_IN_WALL: Final[_Trouble] = "in_wall", "lies in a wall"


class _Ground:
    """A map as a robot of a radius (m) meets it."""

    def __init__(self, static: StaticMap, radius: float) -> None:
        self.map, self.radius = static, radius
        self.geometry = static.geometry
        cap = math.ceil(2.0 * radius / self.geometry.resolution) + 1
        closed = (static.cells != FREE).astype(np.uint8)
        self._clearance = np.sqrt(squared_distance_capped(closed, cap), dtype=np.float32)
        self._clearance *= np.float32(self.geometry.resolution)
        self._parts = Components(np.where(self._clearance < radius, np.uint8(LETHAL), np.uint8(FREE)))

    def trouble(self, x: float, y: float) -> _Trouble | None:
        """Return why a robot's centre can't be at a point (m); None if it can."""
        if not self.geometry.contains(x, y):
            return _OFF_MAP
        column, row = self.geometry.cell(x, y)
        value = int(self.map.cells[row, column])
        return None if value == FREE else _IN_WALL if value == LETHAL else ("unknown", "lies where nothing is known")

    def holds(self, x: float, y: float) -> bool:
        """Whether a point (m) lies on the map, or on its edge."""
        left, bottom, right, top = self.geometry.bounds
        return left - _EDGE_M <= x <= right + _EDGE_M and bottom - _EDGE_M <= y <= top + _EDGE_M

    def tightness(self, x: float, y: float) -> _Trouble | None:
        """Return why a robot does not fit at a free point (m); None if it does."""
        column, row = self.geometry.cell(x, y)
        room = float(self._clearance[row, column])
        if room >= self.radius:
            return None
        return "tight", f"is {room:.2f} m from a wall, and the robot's radius is {self.radius:g} m"

    def reaches(self, start: tuple[float, float], goal: tuple[float, float]) -> bool:
        """Whether a robot comes from one free point to the other."""
        return bool(self._parts.connected(self.geometry.cell(*start), self.geometry.cell(*goal)))

    def free_share(self, shape: ShapeMask) -> float:
        """Return which share of a shape is free floor."""
        window, mask = shape
        return float((self.map.cells[window.rows, window.columns][mask] == FREE).mean()) if mask.any() else 0.0

    def reported(self, node: NodeSite) -> str:
        """Return what a node reports while nothing stands there."""
        return classify(heard_on_map(self.map, node), default_config(node))


def findings(  # noqa: PLR0913  # what stands on the map, each kind by itself
    site: Site,
    before: StaticMap,
    after: StaticMap,
    zones: Iterable[Zone] = (),
    poses: Mapping[str, tuple[float, float]] | None = None,
    places: Mapping[str, Place] | None = None,
    goals: Mapping[str, tuple[float, float]] | None = None,
) -> list[Finding]:
    """Return what of the site does not fit the new map, and did fit the one before.

    `poses`, `goals`: where robots stand and where they are sent (m, frame of the map before). `places`: those of a
    running fog, which operators may have changed.
    """
    radius = max((robot.radius for robot in site.robots), default=ROBOT_RADIUS)
    old, new = _Ground(before, radius), _Ground(after, radius)
    robots: list[tuple[Kind, str, tuple[float, float]]] = [
        *(("robot", name, at) for name, at in (poses or {}).items()),
        *(("goal", name, at) for name, at in (goals or {}).items()),
    ]
    return [
        *_of_points(site, places or {}, old, new),
        *_of_docks(site, old, new),
        *_of_nodes(site, old, new),
        *_of_markers(site, new),
        *_of_areas(site, old, new, zones),
        *(
            Finding(kind, name, *at, *trouble)
            for kind, name, at in robots
            if (trouble := new.trouble(*at)) and not old.trouble(*at)
        ),
    ]


def _of_points(site: Site, running: Mapping[str, Place], old: _Ground, new: _Ground) -> Iterator[Finding]:
    points: list[tuple[Kind, str, float, float]] = [("place", n, at.x, at.y) for n, at in site.places.items()]
    known = {point[1:] for point in points}
    points += [("moved-place", *put) for name, at in running.items() if (put := (name, at.x, at.y)) not in known]
    points += [("start", robot.id, robot.start.x, robot.start.y) for robot in site.robots]
    home = (site.robots[0].start.x, site.robots[0].start.y) if site.robots else None
    for kind, name, x, y in points:
        if trouble := new.trouble(x, y):
            yield Finding(kind, name, x, y, *trouble, refused=kind != "moved-place")
        elif (trouble := new.tightness(x, y)) and not old.tightness(x, y):
            yield Finding(kind, name, x, y, *trouble)
        elif (
            home is not None and old.reaches(home, (x, y)) and not new.trouble(*home) and not new.reaches(home, (x, y))
        ):
            problem = f"can't be reached any more from the start of {site.robots[0].id}"
            yield Finding(kind, name, x, y, "cut_off", problem)


def _of_docks(site: Site, old: _Ground, new: _Ground) -> Iterator[Finding]:
    for robot in site.robots:
        if robot.dock is None or robot.staging is None:
            continue
        poses: list[tuple[Kind, Pose]] = [("dock", robot.dock), ("staging", robot.staging)]
        for kind, pose in poses:
            if (trouble := new.trouble(pose.x, pose.y)) and not old.trouble(pose.x, pose.y):
                yield Finding(kind, robot.id, pose.x, pose.y, *trouble)


def _of_nodes(site: Site, old: _Ground, new: _Ground) -> Iterator[Finding]:
    for node in site.nodes:
        if not new.holds(node.x, node.y):
            yield Finding("node", node.id, node.x, node.y, *_OFF_MAP, refused=True)
        elif (trouble := new.trouble(node.x, node.y)) and not old.trouble(node.x, node.y):
            yield Finding("node", node.id, node.x, node.y, *trouble)
        elif old.reported(node) == "clear" and (state := new.reported(node)) != "clear":
            problem = f"would report {state} with nothing there: by this map its walls are elsewhere"
            yield Finding("node", node.id, node.x, node.y, "misreads", problem)


def _of_markers(site: Site, new: _Ground) -> Iterator[Finding]:
    for marker in site.markers:
        seen_from = [
            (marker.x + ahead * math.cos(marker.theta), marker.y + ahead * math.sin(marker.theta))
            for ahead in BEFORE_MARKER_M
        ]
        if not new.holds(marker.x, marker.y) or any(new.trouble(*point) for point in seen_from):
            problem = "looks into a wall, or off the map"
            yield Finding("marker", str(marker.id), marker.x, marker.y, "unseen", problem, refused=True)


def _of_areas(site: Site, old: _Ground, new: _Ground, zones: Iterable[Zone]) -> Iterator[Finding]:
    nodes = {node.id: node for node in site.nodes}
    for area in site.areas:
        if area.cone_of is not None:
            node = nodes[area.cone_of]
            try:
                node_cone(node, new.map)
            except ConeError:
                problem = f"is what node {node.id} sees, and that is nothing there"
                yield Finding("area", area.id, node.x, node.y, "in_wall", problem, refused=True)
            continue
        x, y = area.polygon[0]
        if not all(new.holds(*corner) for corner in area.polygon):
            yield Finding("area", area.id, x, y, *_OFF_MAP, refused=True)
        elif not new.free_share(rasterize(area.polygon, new.geometry)):
            yield Finding("area", area.id, x, y, *_IN_WALL)
    for zone in zones:
        try:
            shapes = [rasterize_shape(zone.shape, ground.geometry) for ground in (old, new)]
        except ShapeError:
            continue  # the map-service has left it out, and says so
        if old.free_share(shapes[0]) and not new.free_share(shapes[1]):
            yield Finding("zone", zone.id, *_middle(shapes[0], old), "in_wall", "lies in a wall, or off the map")


def _middle(shape: ShapeMask, ground: _Ground) -> tuple[float, float]:
    window = shape.window
    return ground.geometry.centre(window.x + window.width // 2, window.y + window.height // 2)
