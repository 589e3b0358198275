"""What the aggregator publishes about areas, hazards and nodes: its own messages, others' formats. Pure."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any, Final, get_args

import msgspec

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import AreaDefinition, AreaState, NodeConfig

if TYPE_CHECKING:
    from fog_contracts.messages import AreaHazard
    from fog_contracts.site import NodeSite


def definition_publication(definition: AreaDefinition, epoch: int) -> Publication:
    """Return the publication of an area's definition by the aggregator with this epoch."""
    return Publication(ch.AREA_DEFINITION, msgspec.structs.replace(definition, epoch=epoch), {"area": definition.id})


def hazard_publications(
    hazard: AreaHazard, definition: AreaDefinition | None, node: NodeSite | None
) -> list[Publication]:
    """Return the publications of a hazard: itself, and its line for the thesis's robots (`wsn_line`)."""
    publications = [Publication(ch.AREA_HAZARD, hazard, {"area": hazard.area})]
    if definition is not None and (line := wsn_line(definition, hazard, node)):
        publications.append(Publication(ch.THESIS_WSN, line))
    return publications


def deletions(area: str) -> list[Publication]:
    """Return the publications that delete an area's retained messages from the broker."""
    return [Publication(channel, None, {"area": area}) for channel in (ch.AREA_HAZARD, ch.AREA_DEFINITION)]


def node_publication(node: NodeSite) -> Publication:
    """Return the publication of a node's configuration."""
    return Publication(ch.NODE_CONFIG, node_config(node), {"node": node.id})


def node_config(node: NodeSite) -> NodeConfig:
    """Return the configuration of a node; its version is a checksum of its content."""
    config = NodeConfig(
        version=0,
        range_limit_m=[sonar.range_limit for sonar in node.sonars],
        range_max_m=[sonar.range_max or 0.0 for sonar in node.sonars],
        no_echo_is_clear=[sonar.no_echo_is_clear for sonar in node.sonars],
    )
    return msgspec.structs.replace(config, version=zlib.crc32(msgspec.json.encode(config)))


def wsn_line(definition: AreaDefinition, hazard: AreaHazard, node: NodeSite | None = None) -> str | None:
    """Return the line for the thesis's robots: `n,x,y`, or `n,-999,-999` when clear; None for an area without number.

    (x, y) is the node's position (m, frame `map`), or the mean of the area's corners when it has no node. Those robots
    have no third state: an unknown area is sent as blocked (Mendes 2022, section 3.4).
    """
    if definition.number is None:
        return None
    if hazard.state == "clear":
        return f"{definition.number},-999,-999"
    if node is not None:
        x, y = node.x, node.y
    else:
        x = sum(point[0] for point in definition.polygon) / len(definition.polygon)
        y = sum(point[1] for point in definition.polygon) / len(definition.polygon)
    return f"{definition.number},{x:.3f},{y:.3f}"


# A sensor is unknown to Home Assistant when its template gives None: an area that nobody measures is not safe.
_BLOCKED: Final = "{{ {'blocked': 'ON', 'clear': 'OFF'}.get(value_json.state, 'None') }}"


def discovery_publication(site: str, publication: Publication) -> Publication:
    """Return the publication by which Home Assistant discovers, or forgets, the area whose definition is published."""
    definition, text = publication.message, None
    if isinstance(definition, AreaDefinition) and not definition.removed:
        text = discovery(site, definition)
    return Publication(ch.HOME_ASSISTANT_AREA, text, publication.ids)


def discovery(site: str, definition: AreaDefinition) -> str:
    """Return the description (JSON) of an area as a device: its state, since when and why, whether it is blocked."""
    area = f"fognav-{site}-area-{definition.id}"
    components: dict[str, dict[str, Any]] = {
        "state": {
            "p": "sensor",
            "name": "state",
            "device_class": "enum",
            "options": list(get_args(AreaState)),
            "value_template": "{{ value_json.state }}",
        },
        "blocked": {"p": "binary_sensor", "name": "blocked", "device_class": "safety", "value_template": _BLOCKED},
        "since": {
            "p": "sensor",
            "name": "since",
            "device_class": "timestamp",
            "value_template": "{{ value_json.since | as_datetime }}",
        },
        # A state of Home Assistant has 255 characters at most.
        "cause": {"p": "sensor", "name": "cause", "value_template": "{{ value_json.cause[:255] }}"},
    }
    for name, component in components.items():
        component["unique_id"] = f"{area}-{name}"
    description = {
        "dev": {"ids": area, "name": definition.label or definition.id, "mf": "Fognav", "mdl": "watched area"},
        "o": {"name": "fognav"},
        "cmps": components,
        "state_topic": ch.AREA_HAZARD.key(site=site, area=definition.id),
        "availability_topic": ch.AGGREGATOR_AVAILABILITY.key(site=site),
    }
    return msgspec.json.encode(description).decode()
