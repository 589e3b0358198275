"""Zones that a system of others puts on the map over MQTT, as a user of the broker's own."""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import aiomqtt
import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import CircleShape, Zone
from fog_contracts.site import Site, ZoneSourceSite
from fog_runtime.credentials import Credentials
from fog_runtime.health import Health
from fog_runtime.http import Tokens
from fog_runtime.stores.redis_store import Audit
from fog_runtime.token_file import TokenEntry, token_hash
from fog_supervisor.servers import start_redis
from map_service.api import make_api
from map_service.core import MapCore
from map_service.registry import make_layers
from map_service.service import Service
from map_service.store import Store
from map_service.zone_times import SetOfZones

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = pytest.mark.live
SOURCES = """
[[zone_sources]]
id = "cleaning"
kinds = ["BLOCKED"]
max_zones = 2
max_area = 4.0
max_ttl_s = 600.0
sets = ["night"]

[[zone_sources]]
id = "doors"
"""
CIRCLE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [6.0, 3.0], "radius": 0.5}, "ttl_s": 300.0}
TOPIC = "fog/v1/test/zone-sources/{}"


class Source:
    """A system of others on the broker, as its user; hears what is refused."""

    def __init__(self, client: aiomqtt.Client) -> None:
        self.client = client
        self.problems: list[str] = []

    async def send(self, topic: str, payload: object, *, of: str = "cleaning", retain: bool = False) -> None:
        data = payload if isinstance(payload, str) else json.dumps(payload)
        await self.client.publish(f"{TOPIC.format(of)}/{topic}", data, qos=1, retain=retain, timeout=30)

    async def listen(self) -> None:
        await self.client.subscribe(f"{TOPIC.format('cleaning')}/problem", qos=1)
        async for message in self.client.messages:
            self.problems.append(message.payload.decode())


@asynccontextmanager
async def running(fog) -> AsyncIterator[tuple[httpx.AsyncClient, Source]]:
    """Start the map-service on a site with sources of zones; yield its client, and one of the sources."""
    (fog.site / "site.toml").write_text((fog.site / "site.toml").read_text() + SOURCES)
    fog.start("map_service", FOGNAV_WALL_CLOCK="trusted")
    own = Credentials.read(fog.credentials_file("cleaning"))
    async with (
        httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client,
        aiomqtt.Client(
            "127.0.0.1", fog.mosquitto.port, username=own.user, password=own.passwords["mqtt"],
            tls_context=own.tls_context(),
        ) as connection,
    ):  # fmt: skip
        source = Source(connection)
        listening = asyncio.create_task(source.listen())
        yield client, source
        listening.cancel()
        await asyncio.gather(listening, return_exceptions=True)


async def zones(client: httpx.AsyncClient) -> dict[str, dict[str, Any]]:
    return {zone["id"]: zone for zone in (await client.get("/api/v1/zones")).json()["zones"]}


async def until_zones(client: httpx.AsyncClient, *names: str) -> dict[str, dict[str, Any]]:
    async with asyncio.timeout(60):
        while True:
            if set(found := await zones(client)) == set(names):
                return found
            await asyncio.sleep(0.02)


async def until_off(client: httpx.AsyncClient) -> None:
    async with asyncio.timeout(60):
        while True:
            if not (await client.get("/api/v1/zone-sets/night")).json()["on"]:
                return
            await asyncio.sleep(0.02)


async def test_source_puts_changes_and_removes_its_zones_and_is_told_what_was_refused(fog, until, tokens):
    async with running(fog) as (client, source):
        await source.send("zones/spill", CIRCLE)
        zone = (await until_zones(client, "spill"))["spill"]
        assert (zone["source"], zone["author"]) == ("cleaning", "source cleaning")
        assert zone["expires_at"] == pytest.approx(time.time() + 300.0, abs=60.0)
        await client.put(
            "/api/v1/zones/wall", json={**CIRCLE, "ttl_s": None}, headers={**tokens["operator"], "If-None-Match": "*"}
        )
        for topic, payload, problem in (
            ("zones/wall", CIRCLE, "somebody else's"),
            ("zones/a", {**CIRCLE, "ttl_s": None}, "must end"),
            ("zones/a", {**CIRCLE, "ttl_s": 601.0}, "at most"),
            ("zones/a", {**CIRCLE, "kind": "PENALTY", "factor": 2.0}, "no PENALTY"),
            ("zones/a", {**CIRCLE, "shape": {**CIRCLE["shape"], "radius": 2.0}}, "4 is the limit"),
            ("zones/a", {**CIRCLE, "shape": {**CIRCLE["shape"], "centre": [90.0, 0.0]}}, "off the map"),
            ("zones/a", "nonsense", "malformed"),
            ("zones/wall", "", "somebody else's"),
            ("zones/A!", CIRCLE, "malformed id"),
            ("zones/a", "x" * 20_000, "too long"),
            ("sets/night", "off", "can't switch"),
        ):  # fmt: skip
            source.problems.clear()
            await source.send(topic, payload)
            await until(lambda: source.problems, f"an answer to {topic} {payload}", lambda: fog.log("map_service"))
            assert problem in source.problems[0], (topic, source.problems)
        assert set(await zones(client)) == {"spill", "wall"}
        await source.send("zones/mop", CIRCLE)
        await until_zones(client, "spill", "wall", "mop")
        await until(lambda: source.problems[-1] == "", "no problem any more")
        await source.send("zones/third", CIRCLE)
        await until(lambda: "one too many" in source.problems[-1], "the limit")
        await source.send("zones/mop", "")
        await until_zones(client, "spill", "wall")
        (view, doors) = (await client.get("/api/v1/zone-sources", headers=tokens["viewer"])).json()
        assert (view["id"], view["zones"], view["refused"], doors["zones"]) == ("cleaning", ["spill"], 12, [])
        assert 'fognav_zone_source_refusals_total{source="cleaning"} 12.0' in (await client.get("/metrics")).text


async def test_operator_takes_a_sources_zone_for_good_and_mutes_it(fog, until, tokens):
    async with running(fog) as (client, source):
        operator = tokens["operator"]
        lasting = {**CIRCLE, "ttl_s": None, "expires_at": time.time() + 500.0}
        for name in ("spill", "mop"):
            await source.send(f"zones/{name}", lasting, retain=True)
        await until_zones(client, "spill", "mop")
        assert (await client.delete("/api/v1/zones/spill", headers=operator)).status_code == 204
        fog.kill("map_service")
        fog.start("map_service", FOGNAV_WALL_CLOCK="trusted")
        async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as again:
            await source.send("zones/late", lasting, retain=True)
            assert (await until_zones(again, "late", "mop"))["mop"]["version"] < 3, (
                "told again by the broker, and the same"
            )
            taken = await again.patch("/api/v1/zones/mop", json={"reason": "stays"}, headers=operator)
            assert taken.json()["source"] is None
            await source.send("zones/mop", CIRCLE)
            await until(lambda: source.problems and "somebody else's" in source.problems[-1], "a refusal")
            mute = await again.put("/api/v1/zone-sources/cleaning", json={"muted": True}, headers=operator)
            assert (mute.status_code, mute.json()["muted"]) == (200, True)
            await source.send("zones/late", "")
            await until(lambda: "muted" in source.problems[-1], "a refusal")
            assert set(await zones(again)) == {"late", "mop"}
            trail = (await again.get("/api/v1/audit", params={"kind": "source"}, headers=tokens["viewer"])).json()
            assert [(each["who"], each["id"]) for each in trail] == [("anna", "cleaning")]


async def test_source_switches_the_sets_that_are_named_for_it_and_speaks_on_no_others_topics(fog, tokens):
    async with running(fog) as (client, source):
        operator = tokens["operator"]
        await client.put("/api/v1/zone-sets/night", json={}, headers=operator)
        await source.send("zones/forged", CIRCLE, of="doors")
        await source.send("sets/night", "off")
        await until_off(client)
        assert await zones(client) == {}, "the broker does not pass on what one source says as another"


@dataclass
class Plan:
    geometry: GridGeometry
    cells: np.ndarray


class Nobody:
    """Stands for both connections; nobody listens, and the broker acknowledges when it does."""

    connected = True
    acknowledges = True

    async def clear(self, *_: object, **ids: object) -> bool:  # noqa: ARG002  # an edge's signature
        return self.acknowledges

    def publish(self, *_: object, **ids: str) -> None: ...

    def publish_nowait(self, *_: object, **ids: str) -> None: ...


NAMES = st.sampled_from(["a", "b", "c"])
PAYLOADS = st.one_of(
    st.just(b""),
    st.binary(max_size=40),
    st.builds(
        lambda x, ttl_s, kind: json.dumps(
            {"kind": kind, "ttl_s": ttl_s, "shape": {"type": "circle", "centre": [x, 1.0], "radius": 0.3}}
        ).encode(),
        st.floats(0.5, 2.5), st.sampled_from([None, 1.0, 60.0, 1e6]), st.sampled_from(["BLOCKED", "SPEED_LIMIT"]),
    ),
)  # fmt: skip
STEPS = st.one_of(
    st.tuples(st.sampled_from(["one", "two"]), NAMES, PAYLOADS, st.booleans()),
    st.tuples(st.just("ann"), NAMES, st.sampled_from([b"put", b"delete"]), st.just(value=False)),
)


@settings(max_examples=40, deadline=None)
@given(steps=st.lists(STEPS, max_size=30))
def test_no_message_of_a_source_changes_a_zone_of_another_source_or_of_an_operator(redis_url, steps):
    asyncio.run(try_steps(redis_url, steps))


@pytest.fixture(scope="module")
def redis_url(tmp_path_factory):
    with start_redis(tmp_path_factory.mktemp("redis")) as redis:
        yield redis.url


@asynccontextmanager
async def leading_service(
    redis_url: str, edge: Nobody, names: tuple[str, ...] = ("one", "two")
) -> AsyncIterator[tuple[Service, Store]]:
    """A service over an empty store that carries out what these sources send."""
    plan = Plan(GridGeometry(60, 60, 0.05, 0.0, 0.0), np.zeros((60, 60), dtype=np.uint8))
    sources = [ZoneSourceSite(id=name, max_zones=2, sets=["night"]) for name in names]
    site = Site(id="test", zone_sources=sources)
    async with Store(redis_url, "test") as store:
        await store._redis.write(("FLUSHALL",))
        core = MapCore("test", plan, 1, layers=make_layers(plan), definitions=[])
        service = Service(core, store, cast("Any", edge), cast("Any", edge), ManualClock(1.0), Health(), site=site)
        await service.zones.load()
        service.zone_sources.leading = True
        yield service, store


async def test_zone_that_was_deleted_while_the_broker_is_away_does_not_come_back_with_it(redis_url):
    broker = Nobody()
    topic = ch.ZONE_REQUEST.key(site="test", source="one", zone="a")
    async with leading_service(redis_url, broker) as (service, _):
        sources, zones = service.zone_sources, service.core.zones

        async def say(x: float, *, retained: bool) -> bool:
            shape = {**CIRCLE["shape"], "centre": [x, 1.0]}
            wanted = json.dumps({"kind": "BLOCKED", "shape": shape, "expires_at": 60.0}).encode()
            sources.receive(topic, wanted, retained)
            while sources._waiting:
                assert await sources.carry_out_next()
            return zones.get("a") is not None

        assert await say(1.0, retained=False)
        broker.acknowledges = False
        for _ in range(2):
            zone = zones.zones()[0]
            await service.zones.delete("a", None, "ann")
            await sources.forget(zone)
            assert not await say(1.0, retained=True)
            assert await say(1.5, retained=True), "its source has changed it meanwhile"
            assert await say(1.0, retained=True), "as it was before, but newer"


async def test_zone_of_a_source_does_not_come_back_once_an_operator_took_and_deleted_it_or_undid_it(redis_url):
    retained: dict[str, bytes] = {}

    class Broker(Nobody):
        async def clear(self, channel: ch.Channel, *, wait: bool, **ids: str) -> bool:
            assert wait
            retained.pop(channel.key(site="test", **ids), None)
            return True

    async def zones_told_by(broker: dict[str, bytes]) -> set[str]:
        for topic, wanted in broker.items():
            service.zone_sources.receive(topic, wanted, retained=True)
        while service.zone_sources._waiting:
            assert await service.zone_sources.carry_out_next()
        return set(service.core.zones.ids())

    for name in ("a", "b"):
        wanted = {**CIRCLE, "ttl_s": None, "expires_at": 60.0, "shape": {**CIRCLE["shape"], "centre": [1.0, 1.0]}}
        retained[ch.ZONE_REQUEST.key(site="test", source="one", zone=name)] = json.dumps(wanted).encode()
    tokens = Tokens([TokenEntry(name="ann", role="operator", sha256=token_hash("secret"))])
    async with leading_service(redis_url, Broker()) as (service, _):
        app = make_api(service, Site(id="test"), ManualClock(1.0), Health(), tokens)
        own = {"base_url": "http://map", "headers": {"Authorization": "Bearer secret"}}
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), **own) as client:
            assert await zones_told_by(retained) == {"a", "b"}
            taken = await client.patch("/api/v1/zones/a", json={"reason": "stays for now"})
            assert taken.json()["source"] is None
            assert (await client.delete("/api/v1/zones/a")).status_code == 204
            trail = (await client.get("/api/v1/audit", params={"kind": "zone"})).json()
            made = next(entry for entry in trail if entry["id"] == "b")
            undone = await client.post("/api/v1/zones/b/undo", json={"entry": made["entry"]})
            assert (undone.status_code, undone.json()["value"]) == (200, None)
        assert await zones_told_by(retained) == set(), "as at the next connection to the broker"


async def test_source_switches_sets_even_if_its_id_is_a_word_of_the_topic(redis_url):
    async with leading_service(redis_url, Nobody(), ("zones",)) as (service, _):
        await service.sets.put(SetOfZones(id="night"), 0, "ann")
        topic = ch.ZONE_SET_SWITCH.key(site="test", source="zones", set="night")
        service.zone_sources.receive(topic, b"off", retained=False)
        assert await service.zone_sources.carry_out_next()
        assert not service.sets.records["night"].enabled


async def test_zone_that_cannot_be_stored_keeps_no_other_sources_zone_waiting(redis_url):
    def say(source: str, zone: str) -> None:
        wanted = json.dumps({**CIRCLE, "shape": {**CIRCLE["shape"], "centre": [1.0, 1.0]}}).encode()
        sources.receive(ch.ZONE_REQUEST.key(site="test", source=source, zone=zone), wanted, retained=False)

    async with leading_service(redis_url, Nobody()) as (service, store):
        sources, zones = service.zone_sources, service.core.zones
        stored = Zone(id="old", kind="BLOCKED", shape=CircleShape(centre=(1.0, 1.0), radius=0.3), author="ann")
        await store.create(stored, Audit(1.0, "ann", "create"))  # by a process that this one has not heard of
        say("one", "old")
        say("two", "fire")
        assert not await sources.carry_out_next(), "somebody has it"
        assert await sources.carry_out_next()
        assert zones.get("fire") is not None

        service.zones.unusable.replace({"older": "no such kind"})
        say("one", "older")
        assert [await sources.carry_out_next() for _ in range(2)] == [False, True]
        (problem,) = [view.problem for view in sources.views() if view.id == "one"]
        assert "zone older is stored, but its record is invalid (no such kind): an operator must delete it" in problem


async def try_steps(redis_url: str, steps: list[tuple[str, str, bytes, bool]]) -> None:
    async with leading_service(redis_url, Nobody()) as (service, store):
        core = service.core
        for who, name, payload, retained in steps:
            before = {zone.id: zone for zone in core.zones.zones()}
            if who == "ann":
                if payload == b"put":
                    shape = CircleShape(centre=(1.0, 1.0), radius=0.3)
                    zone = Zone(id=name, kind="BLOCKED", shape=shape, author="ann")
                    if name in before:
                        await service.zones.replace(zone, None, "ann")
                    else:
                        await service.zones.create(zone, "ann")
                elif name in before:
                    await service.zones.delete(name, None, "ann")
                continue
            topic = ch.ZONE_REQUEST.key(site="test", source=who, zone=name)
            service.zone_sources.receive(topic, payload, retained)
            while service.zone_sources._waiting:
                assert await service.zone_sources.carry_out_next()
            after = {zone.id: zone for zone in core.zones.zones()}
            others = {each for each, zone in before.items() if zone.source != who}
            assert {each: after.get(each) for each in others} == {each: before[each] for each in others}
            own = [zone for zone in after.values() if zone.source == who]
            assert all(each.ttl_s is not None or each.expires_at is not None for each in own)
            assert len(own) <= 2
            assert set(after) - set(before) <= {name}
        assert {zone.id: zone for zone in (await store.zones())[0]} == {zone.id: zone for zone in core.zones.zones()}
