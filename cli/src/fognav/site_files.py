"""A site's files: proposed or checked, and a node's table in `site.toml`, added or replaced, all else left as it is."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any, Final

from fog_contracts.cones import seen_share
from fog_contracts.grid import StaticMap
from fog_contracts.messages import Place
from fog_contracts.site import AreaSite, DemoPlan, NodeSite, RobotSite, Site
from fog_runtime.configuration.maps import MapFileError, load_map, read_provenance, save_map
from fog_runtime.configuration.site import SITE_FILE, LoadedSite, SiteError, load_site
from fog_runtime.files import SHARED, atomic_write
from fognav.output import FailedError, WrongUseError, writing


def _number(value: float) -> str:
    return repr(round(value, 7))


def to_toml(site: Site) -> str:
    """Return a site as a commented `site.toml`."""
    head = (
        "# A site: a map, named places, watched areas with their sensor nodes, robots, and a demonstration.",
        "# Metres, radians; map frame: x right, y up. After a change run: fognav site check DIR",
        "",
        f'id = "{site.id}"',
        f"name = {_quoted(site.name)}",
        "# map_server YAML, relative to this folder or absolute.",
        f"map = {_quoted(site.map)}",
        "",
    )
    about_areas = (
        "# A watched area: `number` is its number in the topics of the thesis's nodes. Optional tables:",
        "# `debounce` (default: the rule `evidence`) and `unknown` (cost while its nodes are silent). Instead of a",
        "# polygon, `cone_of` may name one of its nodes: then the area is what that node's sonars see.",
    )
    about_nodes = (
        "# A sensor node on a wall: `range_limit` is the calibrated distance below which an echo means an",
        "# obstacle, `range_max` the one beyond which it comes from behind the opposite wall and says nothing;",
        "# `no_echo_is_clear` is for a calibration to say.",
    )
    lines = [
        *head,
        *(line for identifier, place in site.places.items() for line in _place_lines(identifier, place)),
        *about_areas,
        *(line for area in site.areas for line in _area_lines(area)),
        *about_nodes,
        *(line for node in site.nodes for line in node_lines(node)),
        *(line for robot in site.robots for line in _robot_lines(robot)),
        *(_demo_lines(site.demo) if site.demo is not None else ()),
    ]
    return "\n".join(lines) + "\n"


def _place_lines(identifier: str, place: Place) -> list[str]:
    return [
        f"[places.{identifier}]",
        f"label = {_quoted(place.label)}",
        f"x = {_number(place.x)}",
        f"y = {_number(place.y)}",
        "# theta = 0.0   # without it any heading is accepted",
        *(["public = true"] if place.public else []),
        "",
    ]


def _area_lines(area: AreaSite) -> list[str]:
    corners = ", ".join(f"[{_number(x)}, {_number(y)}]" for x, y in area.polygon)
    place = f"polygon = [{corners}]" if area.cone_of is None else f'cone_of = "{area.cone_of}"'
    return [
        "[[areas]]",
        f'id = "{area.id}"',
        f"label = {_quoted(area.label)}",
        *([] if area.number is None else [f"number = {area.number}"]),
        place,
        "",
    ]


def node_lines(node: NodeSite) -> list[str]:
    """Return a node as a table of `site.toml`, with an empty line at its end."""
    sonars = (
        f"    {{ angle = {_number(s.angle)}, range_limit = {_number(s.range_limit)}, "
        + ("" if s.range_max is None else f"range_max = {_number(s.range_max)}, ")
        + f"no_echo_is_clear = {str(s.no_echo_is_clear).lower()}"
        + ("" if s.false_echo_rate is None else f", false_echo_rate = {_number(s.false_echo_rate)}")
        + " },"
        for s in node.sonars
    )
    return [
        "[[nodes]]",
        f'id = "{node.id}"',
        f'area = "{node.area}"',
        f"x = {_number(node.x)}",
        f"y = {_number(node.y)}",
        f"theta = {_number(node.theta)}",
        f"height = {_number(node.height)}",
        "sonars = [",
        *sonars,
        "]",
        *([] if node.penalty is None else [f"penalty = {node.penalty}"]),
        *(["every_reading = true"] if node.every_reading else []),
        "",
    ]


def _robot_lines(robot: RobotSite) -> list[str]:
    start = robot.start
    return [
        "[[robots]]",
        f'id = "{robot.id}"',
        f"start = {{ x = {_number(start.x)}, y = {_number(start.y)}, theta = {_number(start.theta)} }}",
        f"radius = {_number(robot.radius)}",
        f"height = {_number(robot.height)}",
        "",
    ]


def _demo_lines(demo: DemoPlan) -> list[str]:
    areas = ", ".join(f'"{area}"' for area in demo.areas)
    return [
        "# `fognav demo` drives from start to goal and blocks one of these areas on the path. Without areas there",
        "# is no hazard.",
        "[demo]",
        f'start = "{demo.start}"',
        f'goal = "{demo.goal}"',
        f"areas = [{areas}]",
    ]


def _quoted(text: str) -> str:
    """Return a text as a TOML string, whose escapes are those of JSON; TOML takes no DEL as it is."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


_TABLE = re.compile(r"^\s*\[")
_MAP_LINE = re.compile(r"^\s*map\s*=")
_NODE_TABLE = re.compile(r"^\s*\[\[\s*nodes\s*\]\]")


def node_of(loaded: LoadedSite, name: str) -> NodeSite:
    """Return a node of a site; raises `WrongUseError` with the names that there are."""
    for node in loaded.site.nodes:
        if node.id == name:
            return node
    names = ", ".join(node.id for node in loaded.site.nodes) or "none"
    raise WrongUseError(f"{loaded.directory / SITE_FILE} has no node {name!r}: it has {names}")


def with_node(loaded: LoadedSite, node: NodeSite) -> str:
    """Return the text of the site's file with one more node; raises `WrongUseError` if that makes the site invalid."""
    text = _read(loaded.directory).rstrip("\n") + "\n\n" + "\n".join(node_lines(node))
    _check(loaded.directory, text)
    return text


def replace(loaded: LoadedSite, node: NodeSite) -> None:
    """Replace a node's table in the site's file; raises `WrongUseError` if that makes the site invalid.

    Comments between the lines of its table are lost. Raises `FailedError` for a file that is written in another way.
    """
    text = _read(loaded.directory)
    new = replaced(text, node)
    if new is None:
        block = "\n".join(node_lines(node))
        raise FailedError(
            f"the table of node {node.id} was not found in {loaded.directory / SITE_FILE}: replace it by\n{block}"
        )
    _check(loaded.directory, new)
    write(loaded, new)


def replaced(text: str, node: NodeSite) -> str | None:
    """Return the text of a site's file with another table of a node, or None if that is written in another way."""
    lines = text.splitlines(keepends=True)
    begin, end = _table_of(lines, node.id)
    # Comments after the table are about what follows.
    while end > begin and (not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#")):
        end -= 1
    if begin == end:
        return None
    new = "\n".join(node_lines(node)).rstrip("\n") + "\n"
    return "".join(lines[:begin]) + new + "".join(lines[end:])


def with_map(loaded: LoadedSite, map_name: str) -> str:
    """Return the text of the site's file with another map; raises `WrongUseError` if that makes the site invalid."""
    lines = _read(loaded.directory).splitlines(keepends=True)
    tables = next((index for index, line in enumerate(lines) if _TABLE.match(line)), len(lines))
    known = next((index for index in range(tables) if _MAP_LINE.match(lines[index])), None)
    # A site whose file names no map has map.yaml.
    lines[slice(0, 0) if known is None else slice(known, known + 1)] = [f"map = {_quoted(map_name)}\n"]
    text = "".join(lines)
    _check(loaded.directory, text)
    return text


def _table_of(lines: list[str], name: str) -> tuple[int, int]:
    """Return the first line of a node's table and the one after its last, or an empty range."""
    starts = [index for index, line in enumerate(lines) if _TABLE.match(line)]
    for index, start in enumerate(starts):
        end = starts[index + 1] if index + 1 < len(starts) else len(lines)
        if not _NODE_TABLE.match(lines[start]):
            continue
        try:
            table = tomllib.loads("".join(lines[start:end]))
        except tomllib.TOMLDecodeError:
            continue  # a table with tables of its own, whose lines end elsewhere
        if table["nodes"][0].get("id") == name:
            return start, end
    return 0, 0


def _read(folder: Path) -> str:
    try:
        return (folder / SITE_FILE).read_text("utf-8")
    except OSError as error:
        raise WrongUseError(f"{folder / SITE_FILE} can't be read: {error.strerror}") from error


def _check(folder: Path, text: str) -> None:
    """Raise `WrongUseError` for an invalid text before it replaces the file: a service may read that at any time."""
    try:
        load_site(folder, text)
    except SiteError as error:
        raise WrongUseError(f"{error} (nothing was changed)") from error


def write(loaded: LoadedSite, text: str) -> None:
    """Replace the site's file by a text that was found valid; raises `WrongUseError`."""
    file = loaded.directory / SITE_FILE
    with writing(file, "Run this as its owner"):
        atomic_write(file, text.encode(), mode=SHARED)


_ID_LENGTH = 32
_MAP: Final = "map.yaml"


def identifier(name: str) -> str:
    """Return an id for a name: lower-case letters, digits and hyphens."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    return plain[:_ID_LENGTH].strip("-") or "site"


def _map_in(out: Path, map_file: Path) -> str:
    """Return the name of the site's map in its own folder, where it is copied to unless it is there already.

    A site must not depend on files elsewhere: containers get nothing but its folder. Raises `WrongUseError` if another
    map is in the way.
    """
    if map_file.resolve().parent == out.resolve():
        return map_file.name
    for name in (_MAP, f"{Path(_MAP).stem}.pgm"):
        if (out / name).exists():
            raise WrongUseError(f"{out / name} already exists: name another folder with --out, or remove it")
    return _MAP


def new_site(map_file: Path, out: Path, seed: int, *, whole_floor: bool = False) -> dict[str, Any]:
    """Write `out`/site.toml for a map, and copy the map there; raises `WrongUseError`, and then writes nothing.

    `whole_floor`: see `site_proposal.propose`.
    """
    # Checking a site must not wait for the kernels, which only a proposal needs.
    from fognav.site_proposal import NoSiteError, propose  # noqa: PLC0415  # see above

    target = out / SITE_FILE
    if target.exists():
        raise WrongUseError(f"{target} already exists: name another folder with --out, or remove it")
    map_name = _map_in(out, map_file)
    copied = None if (out / map_name).exists() else out / map_name
    try:
        static = load_map(map_file)
        name = identifier(out.resolve().name)
        site, why = propose(name, map_name, static.geometry, static.cells, seed, whole_floor=whole_floor)
    except (MapFileError, NoSiteError) as error:
        raise WrongUseError(str(error)) from error
    with writing(target, "Name another folder with --out"):
        if copied is not None:
            save_map(copied.with_suffix(""), static, read_provenance(map_file))
        atomic_write(target, to_toml(site).encode(), mode=SHARED)
    try:
        load_site(out)
    except SiteError:
        target.unlink()
        raise
    return {
        "file": str(target),
        "site": site.id,
        "areas": len(site.areas),
        "nodes": len(site.nodes),
        "why_no_areas": why,
        "places": {name: [place.x, place.y] for name, place in site.places.items()},
    }


def check_site(folder: Path) -> dict[str, Any]:
    """Return the contents of a site, or the problem with it."""
    try:
        loaded = load_site(folder)
    except SiteError as error:
        return {"ok": False, "problem": str(error)}
    site = loaded.site
    return {
        "ok": True,
        "site": site.id,
        "areas": len(site.areas),
        "nodes": len(site.nodes),
        "places": len(site.places),
        "robots": len(site.robots),
        "markers": len(site.markers),
        "demo": site.demo is not None,
        "unbounded_nodes": [node.id for node in site.nodes if any(each.range_max is None for each in node.sonars)],
        "seen_shares": seen_shares(site, loaded.map),
        "areas_never_half_free": [area.id for area in site.areas if area.free_width and not _shows_free(site, area.id)],
    }


def seen_shares(site: Site, static: StaticMap) -> dict[str, float]:
    """Return on which share of its floor (0 to 1) each area's nodes would notice something; areas without any lack."""
    watched = {node.area for node in site.nodes}
    return {
        area.id: round(seen_share(area.polygon, [node for node in site.nodes if node.area == area.id], static), 3)
        for area in site.areas
        if area.id in watched
    }


def _shows_free(site: Site, area: str) -> bool:
    """Whether enough of an area's sonars can tell the far wall: two, or one that measures by light (ADR 74)."""
    able = [each for node in site.nodes if node.area == area for each in node.sonars if each.range_max is not None]
    return len(able) >= 2 or any(each.time_of_flight for each in able)  # as the hazard-aggregator asks for
