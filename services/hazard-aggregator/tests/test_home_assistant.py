"""Areas in Home Assistant: what its MQTT discovery is told, and whether the aggregator is there, on a real broker."""

import asyncio
import json
import secrets

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import AreaDefinition
from fog_runtime.transports.mqtt_connection import Broker
from hazard_aggregator.publications import discovery, discovery_publication

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
POLYGON = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]]


def test_area_is_a_device_whose_entities_read_its_hazard():
    found = json.loads(discovery("lab", AreaDefinition(id="hall", label="the hall", polygon=SQUARE)))
    assert found["dev"] == {"ids": "fognav-lab-area-hall", "name": "the hall", "mf": "Fognav", "mdl": "watched area"}
    assert found["o"] == {"name": "fognav"}
    assert found["state_topic"] == "fog/v1/lab/areas/hall/hazard"
    assert found["availability_topic"] == "fog/v1/lab/aggregator/availability"
    kinds = {name: (entity["p"], entity.get("device_class")) for name, entity in found["cmps"].items()}
    assert kinds == {
        "state": ("sensor", "enum"), "blocked": ("binary_sensor", "safety"), "since": ("sensor", "timestamp"),
        "cause": ("sensor", None),
    }  # fmt: skip
    unique = {entity["unique_id"] for entity in found["cmps"].values()}
    assert len(unique) == 4
    assert all(name.startswith("fognav-lab-area-hall-") for name in unique)
    assert found["cmps"]["state"]["options"] == ["blocked", "clear", "unknown"]


def test_unknown_area_is_neither_on_nor_off():
    found = json.loads(discovery("lab", AreaDefinition(id="hall", polygon=SQUARE)))
    template = found["cmps"]["blocked"]["value_template"]
    assert template == "{{ {'blocked': 'ON', 'clear': 'OFF'}.get(value_json.state, 'None') }}"


def test_largest_description_fits_its_channel_and_a_removed_area_is_forgotten():
    area = AreaDefinition(id="a" * 32, label="\N{GRINNING FACE}" * 100, polygon=SQUARE)
    assert len(discovery("s" * 32, area).encode()) < ch.HOME_ASSISTANT_AREA.limit
    removed = AreaDefinition(id="hall", polygon=SQUARE, removed=True)
    for message in (removed, None):
        forgotten = discovery_publication("lab", Publication(ch.AREA_DEFINITION, message, {"area": "hall"}))
        assert (forgotten.message, forgotten.ids) == (None, {"area": "hall"})


async def retained_areas(fog) -> set[str]:
    """Return the areas that a Home Assistant that starts now discovers."""
    areas = set()
    broker = Broker.of(fog.mosquitto.url, fog.test_credentials)
    async with broker.client(f"home-{secrets.token_hex(4)}", None) as client:
        await client.subscribe("homeassistant/device/test/+/config")
        await client.subscribe("end")
        await client.publish("end", "")
        async for message in client.messages:
            if message.topic.value == "end":
                break
            areas.add(message.topic.value.split("/")[3])
    return areas


@pytest.mark.live
async def test_areas_are_discovered_and_the_aggregators_end_is_told_also_by_a_copy_that_takes_over(fog, until, tokens):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    areas: dict[str, str] = {}
    available: list[str] = []
    async with fog.edges() as (mqtt, _, connect), httpx.AsyncClient(timeout=60) as client:
        mqtt.on(ch.HOME_ASSISTANT_AREA, lambda ids, text: areas.__setitem__(ids["area"], text))
        mqtt.on(ch.AGGREGATOR_AVAILABILITY, lambda _, text: available.append(text))
        connect()
        await until(lambda: "hall" in areas and available[-1:] == ["online"], "discovered")
        body = {"polygon": POLYGON, "label": "the yard"}
        put = await client.put(f"{url}/api/v1/areas/yard", json=body, headers=tokens["operator"])
        assert put.is_success, put.text
        await until(lambda: "the yard" in areas.get("yard", ""), "new area")
        gone = await client.put(f"{url}/api/v1/areas/yard", json={**body, "removed": True}, headers=tokens["operator"])
        assert gone.is_success, gone.text
        async with asyncio.timeout(60):
            while "yard" in await retained_areas(fog):
                pass
        fog.kill("hazard_aggregator")
        await until(lambda: available[-1] == "offline", "its last will")
        fog.start("hazard_aggregator")
        await until(lambda: available[-1] == "online", "online again", lambda: fog.log("hazard_aggregator"))
        fog.processes["hazard_aggregator"].terminate()
        await until(lambda: available[-1] == "offline", "an orderly end", lambda: fog.log("hazard_aggregator"))
        fog.start("hazard_aggregator", "second")
        await until(lambda: available[-1] == "online", "online again", lambda: fog.log("second"))
        # A copy that stands by ends: the one that leads corrects the state.
        await mqtt.publish(ch.AGGREGATOR_AVAILABILITY, "offline", wait=True)
        await until(lambda: available[-2:] == ["offline", "online"], "corrected", lambda: fog.log("second"))
