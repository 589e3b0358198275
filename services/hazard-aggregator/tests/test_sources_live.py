"""Sources in the running aggregator: from the site file and over REST, through a real broker, kept across a kill."""

import asyncio
import json
import secrets

import aiomqtt
import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, MapDelta, NodeValue
from fog_runtime.transports.mqtt_connection import Broker

pytestmark = pytest.mark.live

POLYGON = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0], [1.0, 2.0]]
SITE_SOURCE = """
[[sources]]
id = "gate"
area = "hall"
profile = "esphome-binary"
device = "gate/binary_sensor/beam"
"""
DOOR = {"id": "door", "profile": "zigbee2mqtt-contact", "device": "fire_door"}


async def wait_for(client, area: str, condition) -> dict:
    async with asyncio.timeout(60):
        while True:
            view = (await client.get(f"/api/v1/areas/{area}")).json()
            if view["hazard"] is not None and condition(view["hazard"]):
                return view["hazard"]
            await asyncio.sleep(0.05)


def broker(fog) -> aiomqtt.Client:
    return Broker.of(fog.mosquitto.url, fog.test_credentials).client(f"device-{secrets.token_hex(4)}", None)


async def start_with_gate(fog) -> str:
    """Start an aggregator whose site has the gate alone; return its address."""
    file = fog.site / "site.toml"
    file.write_text(file.read_text().split("[[nodes]]")[0] + SITE_SOURCE)
    fog.start("hazard_aggregator")
    return await fog.ready("hazard_aggregator")


async def test_sources_of_the_site_and_over_rest_decide_their_areas_and_survive_a_kill(fog, tokens):
    url = await start_with_gate(fog)
    async with httpx.AsyncClient(base_url=url, timeout=60) as client, broker(fog) as mqtt:
        await mqtt.publish("gate/status", "online", retain=True)
        await mqtt.publish("gate/binary_sensor/beam/state", "OFF")
        await wait_for(client, "hall", lambda hazard: hazard["state"] == "clear")
        await mqtt.publish("gate/status", "offline", retain=True)
        offline = await wait_for(client, "hall", lambda hazard: hazard["state"] == "unknown")
        assert offline["cause"] == "source gate: it went offline"
        body = {"polygon": POLYGON, "sources": [DOOR]}
        put = await client.put("/api/v1/areas/yard", json=body, headers=tokens["operator"])
        assert put.status_code == 201, put.text
        await mqtt.publish("zigbee2mqtt/fire_door", '{"contact": true, "battery": 100}')
        blocked = await wait_for(client, "yard", lambda hazard: hazard["state"] == "blocked")
        assert blocked["nodes"] == {"door": "blocked"}
        nodes = {node["id"]: node for node in (await client.get("/api/v1/nodes")).json()}
        assert nodes["door"]["area"] == "yard"
    fog.kill("hazard_aggregator")
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    async with httpx.AsyncClient(base_url=url, timeout=60) as client, broker(fog) as mqtt:
        kept = await wait_for(client, "yard", lambda hazard: hazard["penalty"] == 254)
        assert kept["state"] == "blocked"
        await mqtt.publish("zigbee2mqtt/fire_door", '{"contact": false}')
        doubted = await wait_for(client, "yard", lambda hazard: "must say first" in hazard["cause"])
        assert doubted["state"] == "unknown"
        for topic in ("zigbee2mqtt/bridge/state", "zigbee2mqtt/fire_door/availability"):
            await mqtt.publish(topic, '{"state":"online"}', retain=True, qos=1)
        await mqtt.publish("zigbee2mqtt/fire_door", '{"contact": false}')  # the first one may be from before
        await mqtt.publish("zigbee2mqtt/fire_door", '{"contact": false}')
        await wait_for(client, "yard", lambda hazard: hazard["state"] == "clear")


async def test_changed_source_is_given_what_the_broker_retains_and_a_long_message_makes_it_unknown(fog, tokens):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    door = {"id": "door", "profile": "esphome-binary", "device": "gate/binary_sensor/beam"}
    async with httpx.AsyncClient(base_url=url, timeout=60) as client, broker(fog) as mqtt:
        await mqtt.publish("gate/status", "online", retain=True, qos=1)
        await mqtt.publish("gate/binary_sensor/beam/state", "OFF", retain=True, qos=1)

        async def put(**fields) -> None:
            body = {"polygon": POLYGON, "sources": [{**door, **fields}]}
            assert (await client.put("/api/v1/areas/yard", json=body, headers=tokens["operator"])).is_success

        await put()
        await wait_for(client, "yard", lambda hazard: hazard["state"] == "clear")
        await put(blocked=["OFF"], clear=["ON"])
        await wait_for(client, "yard", lambda hazard: hazard["state"] == "blocked")
        await mqtt.publish("gate/binary_sensor/beam/state", b" " * 20_000 + b"OFF")
        unknown = await wait_for(client, "yard", lambda hazard: hazard["state"] == "unknown")
        assert "its message is too long" in unknown["cause"]


async def test_topic_that_ends_the_brokers_connection_is_refused_and_stored_by_an_earlier_version_harms_its_area_only(
    fog, tokens
):
    """Mosquitto closes the connection of whoever subscribes to a topic with a control character."""
    url = await start_with_gate(fog)
    bell = {"id": "bell", "topic": "yard/bell", "blocked": ["1"], "clear": ["0"], "period_s": 60.0}
    async with httpx.AsyncClient(base_url=url, timeout=60) as client, broker(fog) as mqtt:
        body = {"polygon": POLYGON, "sources": [bell]}
        put = await client.put("/api/v1/areas/yard", json=body, headers=tokens["operator"])
        assert put.status_code == 201, put.text
        bad = {"polygon": POLYGON, "sources": [bell | {"topic": "yard/\u0001bell"}]}
        put = await client.put("/api/v1/areas/yard", json=bad, headers=tokens["operator"])
        assert put.status_code == 422
        assert put.json()["errors"][0]["field"] == "body.sources.bell.topic"
        assert "U+0001, which brokers refuse" in put.json()["detail"]
    fog.kill("hazard_aggregator")
    async with fog.raw_redis() as raw:
        record = json.loads(await raw.hget("fog:test:areas", "yard"))
        record["sources"][0]["topic"] = "yard/\u0001bell"
        await raw.hset("fog:test:areas", "yard", json.dumps(record))
    fog.start("hazard_aggregator")
    async with (
        httpx.AsyncClient(base_url=await fog.ready("hazard_aggregator"), timeout=60) as client,
        broker(fog) as mqtt,
    ):
        await mqtt.publish("gate/status", "online", retain=True)
        await mqtt.publish("gate/binary_sensor/beam/state", "OFF")
        await wait_for(client, "hall", lambda hazard: hazard["state"] == "clear")
        assert (await wait_for(client, "yard", lambda _: True))["state"] == "unknown"
        areas = (await client.get("/readyz")).json()
        assert "U+0001" in json.dumps(areas)


async def test_invalid_source_in_the_sites_file_leaves_its_area_unknown_and_the_others_watched(fog, tokens):
    file = fog.site / "site.toml"
    doors = SITE_SOURCE.replace('profile = "esphome-binary"', 'profile = "esphome-binary"\ntopic = "doors/+/state"')
    file.write_text(file.read_text().split("[[nodes]]")[0] + doors)
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    async with httpx.AsyncClient(base_url=url, timeout=60) as client, broker(fog) as mqtt:
        bell = {"id": "bell", "topic": "yard/bell", "blocked": ["1"], "clear": ["0"], "period_s": 60.0}
        body = {"polygon": POLYGON, "sources": [bell]}
        put = await client.put("/api/v1/areas/yard", json=body, headers=tokens["operator"])
        assert put.status_code == 201, put.text
        await mqtt.publish("yard/bell", "0")
        await wait_for(client, "yard", lambda hazard: hazard["state"] == "clear")
        assert (await wait_for(client, "hall", lambda _: True))["state"] == "unknown"
    assert "site_area_unusable" in fog.log("hazard_aggregator")
    assert "'doors/+/state' has a wildcard" in fog.log("hazard_aggregator")


HEAT_OF_A_NODE = """
[[sources]]
id = "heat"
area = "hall"
quantity = { node = "n1", kind = "temperature" }
number = { above = 40.0, hysteresis = 2.0 }
"""


async def test_temperature_of_a_node_becomes_a_hazard_and_changes_the_map(fog, until):
    """The payload is the one that the firmware's own test gets of a DS18B20, at 41.5 degrees."""
    file = fog.site / "site.toml"
    file.write_text(file.read_text() + HEAT_OF_A_NODE)
    for module in ("hazard_aggregator", "map_service"):
        fog.start(module)
        await fog.ready(module)
    hazards: list[AreaHazard] = []
    deltas: list[MapDelta] = []
    async with fog.edges() as (mqtt, zenoh, connect):
        mqtt.on(ch.AREA_HAZARD, lambda _, hazard: hazards.append(hazard), AreaHazard)
        zenoh.subscribe(ch.MAP_DELTA, MapDelta, lambda _, delta: deltas.append(delta))
        connect()
        await mqtt.wait_connected()
        for seq in range(1, 4):
            hot = NodeValue(seq=seq, boot=7, kind="temperature", value=41.5, unit="C")
            await mqtt.publish(ch.NODE_VALUE, hot, node="n1")
        await until(lambda: hazards and hazards[-1].state == "blocked", "blocked", lambda: fog.log("hazard_aggregator"))
        assert "source heat: 41.5 is above 40" in hazards[-1].cause
        await until(
            lambda: any(cause.kind == "hazard" and cause.state == "blocked" for d in deltas for cause in d.causes),
            "a delta of the hazard", lambda: fog.log("map_service"),
        )  # fmt: skip
