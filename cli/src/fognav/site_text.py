"""A site as a commented `site.toml`. Pure."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fog_contracts.site import AreaSite, DemoPlan, NodeSite, Place, RobotSite, Site


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
