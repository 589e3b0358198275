"""Loading of a site's folder: `site.toml` and its map, validated as a whole."""

import math
import re
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from fog_contracts.channels import ROLES
from fog_contracts.cones import ConeError, node_cone
from fog_contracts.costs import is_traversable
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.grid import StaticMap
from fog_contracts.messages import AREAS_MAX, Place
from fog_contracts.site import BEFORE_MARKER_M, ON_DOCK, AreaSite, MarkerSite, NodeSite, RobotSite, Site
from fog_runtime.configuration.maps import MapFileError, load_map

SITE_FILE: Final = "site.toml"
_MEANING: Final = {"radius": ", how far (m) the robot's body reaches from the point between its driven wheels"}
"""Of fields that files of an earlier version need not have."""
_BORDER: Final = 1e-6
"""Metres by which a vertex may lie off the map: the rounding error of a polygon drawn along the map's edge."""


class SiteError(ValueError):
    """A site is invalid; the message names the file, the field and the remedy.

    The field `file` means the file as a whole.
    """

    def __init__(self, file: Path, field: str, problem: str, remedy: str) -> None:
        where = f"{file}" if field == "file" else f"{file}: {field}:"
        super().__init__(f"{where} {problem}. {remedy}")
        self.file = file
        self.field = field


@dataclass(frozen=True)
class LoadedSite:
    """A validated site, its map, and its folder."""

    site: Site
    map: StaticMap
    directory: Path


def load_site(directory: Path, text: str | None = None, *, map_file: Path | None = None) -> LoadedSite:
    """Read and validate a site's folder, or what it would be with this `text` in its file; raises `SiteError`.

    A `map_file` takes the place of the map that the file names.

    Ids are unique and every referenced id exists; areas are simple polygons on the map (counter-clockwise in the
    result), nodes lie on the map, places and start poses on free cells. Markers look at free floor.
    """
    file = directory / SITE_FILE
    site = _read(file, text)
    _check_ids(file, site)
    try:
        static = load_map(directory / site.map if map_file is None else map_file)
    except MapFileError as error:
        remedy = f"`map` is {site.map!r}, relative to {directory}"
        if map_file is not None:
            remedy = "It was uploaded: restore the file from a backup, or upload the map again"
        raise SiteError(file, "map", str(error), remedy) from error
    for index, node in enumerate(site.nodes):
        _check_on_map(file, f"nodes[{index}] ({node.id})", node.x, node.y, static)
    areas = [_checked_area(file, site, index, static) for index in range(len(site.areas))]
    for name, place in site.places.items():
        _check_free(file, f"places.{name}", place.x, place.y, static)
    for index, robot in enumerate(site.robots):
        _check_free(file, f"robots[{index}].start ({robot.id})", robot.start.x, robot.start.y, static)
        _check_idle(file, f"robots[{index}].idle.go ({robot.id})", robot, site)
    _check_unique(file, "lifts.id", (lift.id for lift in site.lifts))
    for index, lift in enumerate(site.lifts):
        if site.id not in lift.floors:
            problem = f"{', '.join(lift.floors)} are not this site, {site.id!r}"
            raise SiteError(file, f"lifts[{index}].floors ({lift.id})", problem, "Name all floors that it serves")
        for name, pose in (("cabin", lift.cabin), ("wait", lift.wait)):
            _check_free(file, f"lifts[{index}].{name} ({lift.id})", pose.x, pose.y, static)
    for index, marker in enumerate(site.markers):
        _check_seen(file, f"markers[{index}] ({marker.id})", marker, static)
    return LoadedSite(msgspec.structs.replace(site, areas=areas), static, directory)


def _check_idle(file: Path, where: str, robot: RobotSite, site: Site) -> None:
    go = None if robot.idle is None else robot.idle.go
    if go == ON_DOCK and robot.dock is None:
        raise SiteError(file, where, "the robot has no dock here", "Set `dock` of the robot, or name a place")
    if go not in {None, ON_DOCK, *site.places}:
        known = ", ".join(sorted(site.places)) or "none"
        raise SiteError(file, where, f"there is no place {go}", f"Write `dock`, or a place of the site: {known}")


def _read(file: Path, text: str | None) -> Site:
    try:
        data = tomllib.loads(file.read_text("utf-8") if text is None else text)
    except OSError as error:
        remedy = "A site is a folder with site.toml and its map; check the path"
        raise SiteError(file, "file", f"can't be read ({error.strerror})", remedy) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SiteError(file, "file", f"is not valid TOML ({error})", "Correct that line") from error
    try:
        site = msgspec.convert(data, Site)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        if "places[...]" in path:
            path = path.replace("places[...]", f"places.{_bad_place(data)}")
        missing = re.search(r"required field `(\w+)`", problem)
        remedy = f"Add `{missing[1]}`{_MEANING.get(missing[1], '')}" if missing else "Correct the value"
        raise SiteError(file, path.strip("`").removeprefix("$").lstrip(".") or "file", problem, remedy) from error
    if unknown := _unknown_key(data, msgspec.to_builtins(site), ""):
        raise SiteError(file, unknown, "is not a field of a site", "Correct its spelling or remove it")
    return site


def _bad_place(data: dict[str, Any]) -> str:
    """Return the name of the invalid place, which the decoder's message does not contain."""
    for name, place in data["places"].items():
        try:
            msgspec.convert(place, Place)
        except msgspec.ValidationError:
            return str(name)
    return "(a name)"


def _unknown_key(data: object, decoded: object, path: str) -> str | None:
    """Return the path of the first key that decoding ignored, because it may be a misspelt optional field."""
    if isinstance(data, dict) and isinstance(decoded, dict):
        for key, value in data.items():
            key_path = f"{path}.{key}" if path else key
            if key not in decoded:
                return key_path
            if found := _unknown_key(value, decoded[key], key_path):
                return found
    elif isinstance(data, list) and isinstance(decoded, list | tuple):
        for index, (value, other) in enumerate(zip(data, decoded, strict=True)):
            if found := _unknown_key(value, other, f"{path}[{index}]"):
                return found
    return None


def _check_unique(file: Path, field: str, names: Iterable[object]) -> None:
    seen = set()
    for name in names:
        if name in seen:
            raise SiteError(file, field, f"{name!r} is used twice", "Give each its own")
        seen.add(name)


def _check_known(file: Path, field: str, name: str, known: Iterable[str]) -> None:
    names = sorted(known)
    if name not in names:
        raise SiteError(file, field, f"there is no {name!r}", f"Use one of: {', '.join(names) or '(none defined)'}")


def _check_ids(file: Path, site: Site) -> None:
    if len(site.areas) > AREAS_MAX:
        problem = f"there are {len(site.areas)} areas, and {AREAS_MAX} is the limit"
        raise SiteError(file, "areas", problem, "Remove some, or make a part of the floor a site of its own")
    _check_unique(file, "areas.id", (area.id for area in site.areas))
    _check_unique(file, "areas.number", (area.number for area in site.areas if area.number is not None))
    _check_unique(file, "nodes.id", (node.id for node in site.nodes))
    _check_unique(file, "robots.id", (robot.id for robot in site.robots))
    _check_unique(file, "markers.id", (marker.id for marker in site.markers))
    users = {
        "nodes": [node.id for node in site.nodes],
        "robots": [robot.id for robot in site.robots],
        "zone_sources": [source.id for source in site.zone_sources],
    }
    for kind, ids in users.items():
        for index, name in enumerate(ids):
            if name in ROLES:
                remedy = "Rename it: the brokers would give it that role's rights"
                raise SiteError(file, f"{kind}[{index}].id", f"{name!r} is the name of a role", remedy)
    _check_unique(file, "nodes.id and sources.id", [*(n.id for n in site.nodes), *(s.id for s in site.sources)])
    # Each is a user of the broker or the router, which know them by their names alone.
    _check_unique(file, "nodes.id and zone_sources.id", site.senders)
    _check_unique(file, "robots.id and zone_sources.id", [*users["robots"], *users["zone_sources"]])
    areas = [area.id for area in site.areas]
    for kind, watched in (("nodes", [n.area for n in site.nodes]), ("sources", [s.area for s in site.sources])):
        for index, area in enumerate(watched):
            _check_known(file, f"{kind}[{index}].area", area, areas)
    for index, robot in enumerate(site.visitors.robots):
        _check_known(file, f"visitors.robots[{index}]", robot, users["robots"])
    if site.demo:
        _check_known(file, "demo.start", site.demo.start, site.places)
        _check_known(file, "demo.goal", site.demo.goal, site.places)
        for index, area in enumerate(site.demo.areas):
            _check_known(file, f"demo.areas[{index}]", area, areas)


def _checked_area(file: Path, site: Site, index: int, static: StaticMap) -> AreaSite:
    """Return an area with its polygon, the given one or that of the node whose cone it is."""
    area, field = site.areas[index], f"areas[{index}]"
    if area.cone_of is not None:
        node = _node_of_cone(file, site, area, f"{field}.cone_of ({area.id})")
        try:
            return msgspec.structs.replace(area, polygon=node_cone(node, static))
        except ConeError as error:
            raise SiteError(file, f"{field}.cone_of ({area.id})", str(error), "Or give the area a polygon") from error
    if not area.polygon:
        remedy = "Add `polygon`, or `cone_of` with one of the area's nodes"
        raise SiteError(file, f"{field} ({area.id})", "has neither a polygon nor a node whose cone it is", remedy)
    try:
        ring = normalized_polygon(area.polygon)
    except GeometryError as error:
        raise SiteError(file, f"{field}.polygon ({area.id})", str(error), "Correct the vertices") from error
    for vertex, (x, y) in enumerate(ring):
        _check_on_map(file, f"{field}.polygon ({area.id}), vertex {vertex}", x, y, static)
    return msgspec.structs.replace(area, polygon=ring)


def _node_of_cone(file: Path, site: Site, area: AreaSite, field: str) -> NodeSite:
    """Return the node whose cone an area is, one of its own; raises `SiteError`."""
    if area.polygon:
        raise SiteError(file, field, "the area has a polygon, too", "Leave out one of them")
    known = {node.id: node for node in site.nodes}
    own = ", ".join(node.id for node in site.nodes if node.area == area.id) or "(none defined)"
    remedy = f"Use one of the area's nodes: {own}; or give the area a polygon"
    node = known.get(area.cone_of or "")
    if node is None:
        raise SiteError(file, field, f"there is no node {area.cone_of!r}", remedy)
    if node.area != area.id:
        raise SiteError(file, field, f"node {node.id!r} watches area {node.area!r}", remedy)
    return node


def _check_on_map(file: Path, field: str, x: float, y: float, static: StaticMap) -> None:
    left, bottom, right, top = static.geometry.bounds
    if not (left - _BORDER <= x <= right + _BORDER and bottom - _BORDER <= y <= top + _BORDER):
        extent = f"x {left:g} to {right:g}, y {bottom:g} to {top:g}"
        raise SiteError(file, field, f"({x:g}, {y:g}) lies off the map ({extent})", "Move it onto the map")


def _check_free(file: Path, field: str, x: float, y: float, static: StaticMap) -> None:
    _check_on_map(file, field, x, y, static)
    if not _is_free(x, y, static):
        problem = f"({x:g}, {y:g}) lies on a cell of the map that is occupied or unknown"
        raise SiteError(file, field, problem, "Move it to a free cell")


def _is_free(x: float, y: float, static: StaticMap) -> bool:
    column, row = static.geometry.cell(x, y)
    return static.geometry.contains_cell(column, row) and is_traversable(int(static.cells[row, column]))


def _check_seen(file: Path, field: str, marker: MarkerSite, static: StaticMap) -> None:
    """Raise `SiteError` for a marker off the map, in a wall, or that looks into one: no camera ever sees it."""
    _check_on_map(file, field, marker.x, marker.y, static)
    for ahead in BEFORE_MARKER_M:
        x, y = marker.x + ahead * math.cos(marker.theta), marker.y + ahead * math.sin(marker.theta)
        if not _is_free(x, y, static):
            problem = f"({marker.x:g}, {marker.y:g}) looks at ({x:.2f}, {y:.2f}), which is a wall or unknown"
            remedy = "Put it on the face of its wall; `theta` points away from the wall, to those who see the marker"
            raise SiteError(file, field, problem, remedy)
