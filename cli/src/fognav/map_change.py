"""What another map would mean for a site: what lies in a wall there, and which floor is new or gone. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fog_contracts.costs import FREE, LETHAL, ROBOT_RADIUS, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap, Window
from fog_contracts.shapes import ShapeError, rasterize, rasterize_shape
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from fog_mapping.alignment import LEAST_SHARE, Alignment, align, judged, laid_onto
from fog_runtime.configuration.site import BEFORE_MARKER_M
from fognav.nodes.placing import heard
from fognav_sim.floor import Floor
from fognav_sim.node import classify, default_config

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from fog_contracts.messages import Place, Zone
    from fog_contracts.shapes import ShapeMask
    from fog_contracts.site import NodeSite, Site

_EDGE_M: Final = 1e-6
_MARGIN_M: Final = 1.0
_MOVED: Final = "operators' place"
_IN_PLACE: Final = (0.0, 0.0, 0.0)


class Finding(NamedTuple):
    """A thing of the site that does not fit the new map; `refused`: with it the services would not start."""

    kind: str
    id: str
    x: float
    y: float
    problem: str
    refused: bool = False

    def __str__(self) -> str:
        return f"{self.kind} {self.id} at ({self.x:.2f}, {self.y:.2f}) {self.problem}"


def in_frame_of(new: StaticMap, present: StaticMap) -> tuple[StaticMap, Alignment]:
    """Return a map in the frame of the present one, and where its own frame lies there, by matching of the walls.

    One that lies well as it is stays as it is. Raises `MisfitError` for one that fits nowhere, or in two ways.
    """
    found = judged(new, present, _IN_PLACE)
    if found.share >= LEAST_SHARE and found.residual <= present.geometry.resolution:
        return new, found
    found = align(new, present)
    return _trimmed(laid_onto(new, present, found.pose), present), found


def _trimmed(static: StaticMap, present: StaticMap) -> StaticMap:
    """Return a map without what is far from all that it knows, and off the present one.

    One that was turned has wide empty corners.
    """
    rows, columns = np.nonzero(static.cells != UNKNOWN)
    g, margin = static.geometry, math.ceil(_MARGIN_M / static.geometry.resolution)
    x, y, size = int(columns.min()), int(rows.min()), g.resolution
    known = Window(x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1).grown(margin)
    window = g.clip(known.union(g.window_around(*present.geometry.bounds)))
    origin = g.origin_x + window.x * size, g.origin_y + window.y * size
    return StaticMap(
        GridGeometry(window.width, window.height, size, *origin),
        np.ascontiguousarray(static.cells[window.rows, window.columns]),
    )


def changed_area(before: StaticMap, after: StaticMap) -> dict[str, float]:
    """Return how much floor (m2) of each map is wall on the other, and how much one of both alone knows as free."""
    side = after.geometry.resolution
    rows, columns = np.nonzero(after.cells == FREE)
    was = before.geometry.sample(before.cells, after.geometry.centres(np.column_stack((columns, rows))), UNKNOWN)
    other = before.geometry.resolution
    rows, columns = np.nonzero(before.cells == FREE)
    now = after.geometry.sample(after.cells, before.geometry.centres(np.column_stack((columns, rows))), UNKNOWN)
    return {
        "wall_to_floor_m2": round(float((was == LETHAL).sum()) * side * side, 2),
        "floor_to_wall_m2": round(float((now == LETHAL).sum()) * other * other, 2),
        "newly_known_m2": round(float(((was != LETHAL) & (was != FREE)).sum()) * side * side, 2),
        "no_longer_known_m2": round(float(((now != LETHAL) & (now != FREE)).sum()) * other * other, 2),
    }


class _Ground:
    """A map as a robot of a radius (m) meets it."""

    def __init__(self, static: StaticMap, radius: float) -> None:
        self.map, self.radius = static, radius
        self.geometry = static.geometry
        cap = math.ceil(2.0 * radius / self.geometry.resolution) + 1
        closed = (static.cells != FREE).astype(np.uint8)
        self._clearance = np.sqrt(squared_distance_capped(closed, cap).astype(np.float64)) * self.geometry.resolution
        self._parts = Components(np.where(self._clearance < radius, np.uint8(LETHAL), np.uint8(FREE)))
        self._floor = Floor(self.geometry, static.cells)

    def trouble(self, x: float, y: float) -> str:
        """Return why a robot's centre can't be at a point (m); empty if it can."""
        if not self.geometry.contains(x, y):
            return "lies off the map"
        column, row = self.geometry.cell(x, y)
        value = int(self.map.cells[row, column])
        return "" if value == FREE else "lies in a wall" if value == LETHAL else "lies where nothing is known"

    def holds(self, x: float, y: float) -> bool:
        """Whether a point (m) lies on the map, or on its edge."""
        left, bottom, right, top = self.geometry.bounds
        return left - _EDGE_M <= x <= right + _EDGE_M and bottom - _EDGE_M <= y <= top + _EDGE_M

    def tightness(self, x: float, y: float) -> str:
        """Return why a robot does not fit at a free point (m); empty if it does."""
        column, row = self.geometry.cell(x, y)
        room = float(self._clearance[row, column])
        return (
            "" if room >= self.radius else f"is {room:.2f} m from a wall, and the robot's radius is {self.radius:g} m"
        )

    def reaches(self, start: tuple[float, float], goal: tuple[float, float]) -> bool:
        """Whether a robot comes from one free point to the other."""
        return bool(self._parts.connected(self.geometry.cell(*start), self.geometry.cell(*goal)))

    def free_share(self, shape: ShapeMask) -> float:
        """Return which share of a shape is free floor."""
        window, mask = shape
        return float((self.map.cells[window.rows, window.columns][mask] == FREE).mean()) if mask.any() else 0.0

    def reported(self, node: NodeSite) -> str:
        """Return what a node reports while nothing stands there."""
        return classify(heard(self._floor, node), default_config(node))


def findings(
    site: Site,
    before: StaticMap,
    after: StaticMap,
    zones: Iterable[Zone] = (),
    poses: Mapping[str, tuple[float, float]] | None = None,
    places: Mapping[str, Place] | None = None,
) -> list[Finding]:
    """Return what of the site does not fit the new map, and did fit the one before.

    `poses`: where robots stand (m, frame of the map before). `places`: those of a running fog, which operators may
    have changed.
    """
    radius = max((robot.radius for robot in site.robots), default=ROBOT_RADIUS)
    old, new = _Ground(before, radius), _Ground(after, radius)
    return [
        *_of_points(site, places or {}, old, new),
        *_of_docks(site, old, new),
        *_of_nodes(site, old, new),
        *_of_markers(site, new),
        *_of_areas(site, old, new, zones),
        *(
            Finding("robot", name, x, y, f"stands where the new map says: it {problem}")
            for name, (x, y) in (poses or {}).items()
            if (problem := new.trouble(x, y)) and not old.trouble(x, y)
        ),
    ]


def _of_points(site: Site, running: Mapping[str, Place], old: _Ground, new: _Ground) -> Iterator[Finding]:
    points = [("place", name, place.x, place.y) for name, place in site.places.items()]
    known = {point[1:] for point in points}
    points += [(_MOVED, *put) for name, place in running.items() if (put := (name, place.x, place.y)) not in known]
    points += [("start of robot", robot.id, robot.start.x, robot.start.y) for robot in site.robots]
    home = (site.robots[0].start.x, site.robots[0].start.y) if site.robots else None
    for kind, name, x, y in points:
        if problem := new.trouble(x, y):
            yield Finding(kind, name, x, y, problem, refused=kind != _MOVED)
        elif (problem := new.tightness(x, y)) and not old.tightness(x, y):
            yield Finding(kind, name, x, y, problem)
        elif (
            home is not None and old.reaches(home, (x, y)) and not new.trouble(*home) and not new.reaches(home, (x, y))
        ):
            yield Finding(kind, name, x, y, f"can't be reached any more from the start of {site.robots[0].id}")


def _of_docks(site: Site, old: _Ground, new: _Ground) -> Iterator[Finding]:
    for robot in site.robots:
        if robot.dock is None or robot.staging is None:
            continue
        for kind, pose in (("dock of robot", robot.dock), ("place in front of the dock of robot", robot.staging)):
            if (problem := new.trouble(pose.x, pose.y)) and not old.trouble(pose.x, pose.y):
                yield Finding(kind, robot.id, pose.x, pose.y, problem)


def _of_nodes(site: Site, old: _Ground, new: _Ground) -> Iterator[Finding]:
    for node in site.nodes:
        if not new.holds(node.x, node.y):
            yield Finding("node", node.id, node.x, node.y, "lies off the map", refused=True)
        elif (problem := new.trouble(node.x, node.y)) and not old.trouble(node.x, node.y):
            yield Finding("node", node.id, node.x, node.y, problem)
        elif old.reported(node) == "clear" and (state := new.reported(node)) != "clear":
            problem = f"would report {state} with nothing there: by this map its walls are elsewhere"
            yield Finding("node", node.id, node.x, node.y, problem)


def _of_markers(site: Site, new: _Ground) -> Iterator[Finding]:
    for marker in site.markers:
        seen_from = [
            (marker.x + ahead * math.cos(marker.theta), marker.y + ahead * math.sin(marker.theta))
            for ahead in BEFORE_MARKER_M
        ]
        if not new.holds(marker.x, marker.y) or any(new.trouble(*point) for point in seen_from):
            yield Finding(
                "marker", str(marker.id), marker.x, marker.y, "looks into a wall, or off the map", refused=True
            )


def _of_areas(site: Site, old: _Ground, new: _Ground, zones: Iterable[Zone]) -> Iterator[Finding]:
    for area in site.areas:
        x, y = area.polygon[0]
        if area.cone_of is None and not all(new.holds(*corner) for corner in area.polygon):
            yield Finding("area", area.id, x, y, "lies off the map", refused=True)
        elif area.cone_of is None and not new.free_share(rasterize(area.polygon, new.geometry)):
            yield Finding("area", area.id, x, y, "lies in a wall")
    for zone in zones:
        try:
            shapes = [rasterize_shape(zone.shape, ground.geometry) for ground in (old, new)]
        except ShapeError:
            continue  # the map-service has left it out, and says so
        if old.free_share(shapes[0]) and not new.free_share(shapes[1]):
            x, y = _middle(shapes[0], old)
            yield Finding("zone", zone.id, x, y, "lies in a wall, or off the map")


def _middle(shape: ShapeMask, ground: _Ground) -> tuple[float, float]:
    window = shape.window
    return ground.geometry.centre(window.x + window.width // 2, window.y + window.height // 2)


def as_values(found: Iterable[Finding]) -> list[dict[str, Any]]:
    """Return findings for JSON."""
    return [one._asdict() for one in found]
