"""What Home Assistant is told of an area, so that it shows up there by itself (its MQTT device discovery). Pure."""

from __future__ import annotations

from typing import Any, Final, get_args

import msgspec

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import AreaDefinition, AreaState

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
