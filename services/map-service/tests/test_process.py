"""The running map-service with a real broker, Redis and router, each of them killed and restarted."""

import asyncio
import io
import json
import subprocess
import sys
import time
from contextlib import asynccontextmanager
from functools import partial

import httpx
import numpy as np
import pytest
from PIL import Image
from text_file import replace_text

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.messages import (
    AreaHazard,
    HazardArea,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    NodeReading,
    RobotObstacles,
    RobotPose,
    ZoneSet,
)
from fog_contracts.replica import Applied, Replica

pytestmark = pytest.mark.live
CIRCLE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [6.0, 3.0], "radius": 0.5}, "reason": "wet floor"}


async def poll(request, accepted):
    """Repeat a request until its reply is accepted, and return that reply."""
    async with asyncio.timeout(60):
        while True:
            reply = await request()
            if accepted(reply):
                return reply
            await asyncio.sleep(0.02)


class Robot:
    """Follows the map as a robot does, and records what it receives."""

    def __init__(self, zenoh) -> None:
        self.zenoh = zenoh
        self.replica = Replica()
        self.deltas: list[MapDelta] = []
        self.heartbeats: list[MapHeartbeat] = []
        self.hazards: list[HazardArea] = []
        self.zones: list[ZoneSet] = []
        zenoh.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)
        zenoh.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, lambda _, m: self.heartbeats.append(m))
        zenoh.subscribe(ch.HAZARD, HazardArea, lambda _, m: self.hazards.append(m))
        zenoh.subscribe(ch.ZONES, ZoneSet, lambda _, m: self.zones.append(m))

    def _on_delta(self, _, delta: MapDelta) -> None:
        if isinstance(self.replica.apply(delta), Applied):
            self.deltas.append(delta)

    async def load(self) -> None:
        request = partial(self.zenoh.query, ch.MAP_SNAPSHOT, None, MapSnapshot, 1.0)
        self.replica.load(await poll(request, lambda snapshot: snapshot is not None))

    def cost(self, x: float, y: float) -> int:
        column, row = self.replica.geometry.cell(x, y)
        return int(self.replica.cost[row, column])


@asynccontextmanager
async def running(fog, *modules: str):
    """Start processes (unless the map-service runs already); yield its HTTP client, a robot and an MQTT edge."""
    for module in modules:
        fog.start(module)
    url = await fog.ready("map_service")
    async with (
        fog.edges() as (mqtt, zenoh, connect),
        httpx.AsyncClient(base_url=url, timeout=60) as client,
    ):
        robot = Robot(zenoh)
        connect()
        await mqtt.wait_connected()
        await robot.load()
        yield client, robot, mqtt


def hazard(state: str, seq: int) -> AreaHazard:
    penalty = {"blocked": 254, "unknown": 200, "clear": 0}[state]
    return AreaHazard(area="hall", state=state, severity=3, penalty=penalty, since=0, seq=seq, epoch=1, cause="test")


async def test_blocked_readings_become_lethal_cells_on_the_robots_map(fog, until):
    pytest.importorskip("hazard_aggregator")
    async with running(fog, "hazard_aggregator", "map_service") as (_, robot, mqtt):
        await fog.ready("hazard_aggregator")
        for seq in range(5):
            reading = NodeReading(
                seq=seq, boot=1, uptime_ms=100 * seq, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked"
            )
            await mqtt.publish(ch.NODE_READING, reading, node="n1")
        await until(lambda: robot.cost(3.5, 3.0) == LETHAL, "lethal", lambda: fog.log("map_service"))
        delta = robot.deltas[-1]
        assert [(cause.id, cause.state) for cause in delta.causes] == [("hall", "blocked")]
        trace = delta.traces[0]
        assert trace.first_reading <= trace.confirmed <= trace.costmap_published
        await until(lambda: robot.hazards and robot.hazards[-1].hazard.state == "blocked", "the reason")
        asked = await robot.zenoh.query(ch.HAZARD, None, HazardArea, 5.0, area="hall")
        assert asked.hazard.state == "blocked"


@pytest.mark.smoke
async def test_zone_reaches_the_robot_and_survives_a_kill_of_the_map_service(fog, until, tokens):
    async with running(fog, "map_service") as (client, robot, _):
        answer = await client.post("/api/v1/zones", json=CIRCLE, headers=tokens["operator"])
        assert answer.status_code == 201, answer.text
        zone = answer.json()
        assert (zone["author"], zone["version"], answer.headers["etag"]) == ("anna", 1, '"1"')
        await until(lambda: robot.cost(6.0, 3.0) == LETHAL, "lethal", lambda: fog.log("map_service"))
        await until(lambda: robot.zones and robot.zones[-1].zones, "the reason")
        assert robot.deltas[-1].causes[0].id == zone["id"]
        epoch = robot.replica.version.epoch
        fog.kill("map_service")
        fog.start("map_service")
        await fog.ready("map_service")
        await until(lambda: robot.heartbeats and robot.heartbeats[-1].epoch > epoch, "a new epoch")
        assert robot.replica.version.epoch == epoch
        await robot.load()
        assert robot.cost(6.0, 3.0) == LETHAL


async def test_zones_are_versioned_and_audited(shared_fog, tokens):
    async with running(shared_fog) as (client, _, _):
        operator = tokens["operator"]
        body = {**CIRCLE, "id": "wet"}
        assert (await client.post("/api/v1/zones", json=body, headers=operator)).status_code == 201
        assert (await client.post("/api/v1/zones", json=body, headers=operator)).status_code == 409
        changed = {**CIRCLE, "reason": "drying"}
        answer = await client.put("/api/v1/zones/wet", json=changed, headers={**operator, "If-Match": '"1"'})
        assert (answer.status_code, answer.headers["etag"]) == (200, '"2"')
        for method in ("PUT", "DELETE"):
            stale = await client.request(
                method, "/api/v1/zones/wet", json=changed, headers={**operator, "If-Match": '"1"'}
            )
            assert stale.status_code == 412
            assert stale.headers["content-type"] == "application/problem+json"
        listed = (await client.get("/api/v1/zones")).json()
        assert [zone["reason"] for zone in listed["zones"] if zone["id"] == "wet"] == ["drying"]
        assert "wet" in listed["active"]
        assert (await client.delete("/api/v1/zones/wet", headers=operator)).status_code == 204
        assert (await client.get("/api/v1/zones/wet")).status_code == 404
        entries = (await client.get("/api/v1/audit", params={"kind": "zone"}, headers=tokens["viewer"])).json()
        assert [(e["who"], e["action"], e["id"]) for e in entries[:3]] == [
            ("anna", action, "wet") for action in ("delete", "replace", "create")
        ]
        assert (entries[1]["before"]["reason"], entries[1]["after"]["reason"]) == ("wet floor", "drying")
        assert (entries[0]["after"], entries[2]["before"]) == (None, None)
        again = await client.post("/api/v1/zones", json=body, headers=operator)
        assert again.headers["etag"] == '"3"', "an ETag never names two states"


async def test_invalid_zone_is_refused_naming_its_field(client, tokens):
    for change, field, message in (
        ({"shape": {"type": "polygon", "points": [[1, 1], [2, 2]]}}, "body.shape.points", "three corners"),
        ({"kind": "PENALTY", "factor": 5.1}, "body.factor", "<= 5.0"),
        ({"kind": "CLOSED"}, "body.kind", "CLOSED"),
        ({"ttl_s": 5, "expires_at": 5}, "body.ttl_s", "not both"),
    ):
        answer = await client.post("/api/v1/zones", json={**CIRCLE, **change}, headers=tokens["operator"])
        assert answer.status_code == 422
        assert answer.headers["content-type"] == "application/problem+json"
        (error,) = answer.json()["errors"]
        assert error["field"] == field
        assert message in error["problem"]


@pytest.fixture
async def client(shared_fog):
    url = await shared_fog.ready("map_service")
    async with httpx.AsyncClient(base_url=url, timeout=60) as client:
        yield client


async def test_only_operators_write_and_openapi_describes_the_routes(client, tokens):
    assert (await client.post("/api/v1/zones", json=CIRCLE)).status_code == 401
    assert (await client.post("/api/v1/zones", json=CIRCLE, headers=tokens["viewer"])).status_code == 403
    described = (await client.get("/openapi.json")).json()
    assert {"/api/v1/zones", "/api/v1/zones/{zone_id}", "/api/v1/hazards", "/api/v1/map"} <= set(described["paths"])
    assert "ZoneBody" in described["components"]["schemas"]
    info = (await client.get("/api/v1/map")).json()
    assert info["geometry"]["width"] == 160
    for name in ("map", "costmap"):
        picture = Image.open(io.BytesIO((await client.get(f"/api/v1/{name}.png")).content))
        assert picture.size == (160, 120)
        assert np.asarray(picture)[0, 0] == LETHAL
    assert (await client.get("/api/v1/places")).json() == {}


async def test_without_redis_zones_stay_writes_fail_and_a_restart_serves_no_map_until_zones_are_loaded(
    fog, until, tokens
):
    async with running(fog, "map_service") as (client, robot, _):
        assert (await client.post("/api/v1/zones", json=CIRCLE, headers=tokens["operator"])).status_code == 201
        fog.redis.kill()
        refused = await client.post("/api/v1/zones", json={**CIRCLE, "id": "other"}, headers=tokens["operator"])
        assert refused.status_code == 503
        assert refused.headers["content-type"] == "application/problem+json"
        assert len((await client.get("/api/v1/zones")).json()["zones"]) == 1
        fog.kill("map_service")
        fog.start("map_service")
        url = await fog.url("map_service")
        async with httpx.AsyncClient(base_url=url, timeout=60) as restarted:
            report = (await restarted.get("/readyz")).json()
            assert {"store", "zones", "map"} <= set(report["missing"])
            assert (await restarted.get("/api/v1/zones")).status_code == 503
            robot.heartbeats.clear()
            # Long enough for several attempts to load the zones, and for the hazards: only the zones are missing.
            for _ in range(15):
                assert "zones" in (await restarted.get("/readyz")).json()["missing"]
                await asyncio.sleep(0.1)
            assert robot.heartbeats == []
            fog.redis.start()
            await until(lambda: robot.heartbeats, "heartbeats again", lambda: fog.log("map_service"))
            await robot.load()
            assert robot.cost(6.0, 3.0) == LETHAL


async def test_hazards_arrive_after_malformed_messages_and_a_restart_of_the_broker(fog, until):
    async with running(fog, "hazard_aggregator", "map_service") as (client, robot, mqtt):
        await fog.ready("hazard_aggregator")
        hall = {"site": "test", "area": "hall"}
        await mqtt._client.publish(ch.AREA_HAZARD.key(**hall), b"x" * 200_000, qos=1, timeout=30)
        await mqtt._client.publish(ch.AREA_DEFINITION.key(**hall), json.dumps({"id": "hall"}).encode(), qos=1)
        counter = 'fognav_refused_messages_total{{channel="{}"}} 1.0'
        counters = [counter.format(channel) for channel in ("area_hazard", "area_definition")]
        request = partial(client.get, "/metrics")
        await poll(request, lambda reply: all(line in reply.text for line in counters))
        fog.mosquitto.kill()
        (fog.mosquitto.folder / "mosquitto.db").unlink(missing_ok=True)
        fog.mosquitto.start()
        await mqtt.wait_connected()
        for seq in range(600):
            if robot.cost(3.5, 3.0) == LETHAL:
                break
            reading = NodeReading(
                seq=seq, boot=1, uptime_ms=100 * seq, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked"
            )
            await mqtt.publish(ch.NODE_READING, reading, node="n1")
            await asyncio.sleep(0.02)
        assert robot.cost(3.5, 3.0) == LETHAL, fog.log("map_service")


async def test_obstacles_of_a_robot_are_on_the_map_until_they_expire(shared_fog, until):
    async with running(shared_fog) as (_, robot, _):
        seen = RobotObstacles(points=[(1.0, 1.0)], stamp=1.0, ttl=0.5)
        pose = RobotPose(x=2.0, y=1.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=1.0)

        def is_seen() -> bool:
            # As robots do, again and again: the pose may arrive after what was seen from it.
            robot.zenoh.publish(ch.ROBOT_POSE, pose, robot="r1")
            robot.zenoh.publish(ch.ROBOT_OBSTACLES, seen, robot="r1")
            return robot.cost(1.0, 1.0) == LETHAL

        await until(is_seen, "seen", lambda: shared_fog.log("map_service"))
        await until(lambda: robot.cost(1.0, 1.0) == 0, "gone")


async def test_clear_area_becomes_unknown_when_the_aggregator_dies(fog, until):
    async with running(fog, "hazard_aggregator", "map_service") as (_, robot, mqtt):
        await fog.ready("hazard_aggregator")
        for seq in range(300):
            if robot.cost(3.5, 3.0) == 0:
                break
            reading = NodeReading(
                seq=seq, boot=1, uptime_ms=100 * seq, range_m=[3, 3], status=["ok", "ok"], state="clear"
            )
            await mqtt.publish(ch.NODE_READING, reading, node="n1")
            await asyncio.sleep(0.02)
        assert robot.cost(3.5, 3.0) == 0
        fog.kill("hazard_aggregator")
        await until(lambda: robot.cost(3.5, 3.0) == 200, "unknown", lambda: fog.log("map_service"))


STEPPED_CLOCK = """
import sys, time
from pathlib import Path
real, error = time.time, Path(sys.argv[1])
time.time = lambda: real() + float(error.read_text())
from fog_runtime import process
from map_service.__main__ import main
process.run(main)
"""


async def test_steps_of_the_wall_clock_end_no_zone_and_a_boot_without_a_clock_puts_all_in_force(fog, until, tokens):
    error = fog.folder / "clock-error"
    replace_text(error, "0.0")

    def start() -> None:
        port_file = fog.folder / "map_service.port"
        port_file.unlink(missing_ok=True)
        environment = {
            **fog.environment,
            "FOGNAV_CREDENTIALS_FILE": str(fog.credentials_file("map-service")),
            "FOGNAV_PORT_FILE": str(port_file),
            "FOGNAV_WALL_CLOCK": "trusted",
        }
        with (fog.folder / "map_service.log").open("ab") as log:
            command = [sys.executable, "-c", STEPPED_CLOCK, str(error)]
            fog.processes["map_service"] = subprocess.Popen(command, env=environment, stdout=log, stderr=log)

    async def zones(client) -> dict[str, bool]:
        listed = (await client.get("/api/v1/zones")).json()
        return {zone["id"]: zone["id"] in listed["active"] for zone in listed["zones"]}

    await asyncio.to_thread(start)
    now = time.time()
    times = {
        "started": {"starts_at": now - 10.0, "expires_at": now + 1800.0},
        "limited": {"ttl_s": 1800.0},
        "later": {"starts_at": now + 7 * 86_400.0},
    }
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client:
        for name, fields in times.items():
            body = {**CIRCLE, "id": name, **fields}
            answer = await client.post("/api/v1/zones", json=body, headers=tokens["operator"])
            assert answer.status_code == 201, answer.text
        expected = {"started": True, "limited": True, "later": False}
        for step in (0.0, 3600.0, -3600.0):
            replace_text(error, str(step))
            # Half a second: several ticks of the map-service.
            for _ in range(5):
                assert await zones(client) == expected, step
                await asyncio.sleep(0.1)
    fog.kill("map_service")
    replace_text(error, str(60.0 - now))
    await asyncio.to_thread(start)
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client:
        assert "time of day" in (await client.get("/readyz")).json()["parts"]["clock"]["detail"]
        assert await zones(client) == {"started": True, "limited": True, "later": True}
        replace_text(error, "0.0")
        expected = {"started": True, "limited": True, "later": False}
        await poll(partial(zones, client), lambda found: found == expected)
        assert (await client.get("/readyz")).json()["parts"]["clock"]["detail"] == ""


SMALL_CIRCLE = {"type": "circle", "centre": [2.0, 3.0], "radius": 0.2}
BOW_TIE = {"type": "polygon", "points": [[1, 1], [2, 2], [2, 1], [1, 2]]}


async def test_map_service_starts_without_its_unusable_zones_and_names_them_until_they_are_deleted(fog, tokens):
    stored = {
        "good": {"id": "good", "kind": "BLOCKED", "shape": SMALL_CIRCLE, "version": 1},
        "too-costly": {"id": "too-costly", "kind": "PENALTY", "factor": 9.0, "shape": SMALL_CIRCLE, "version": 1},
        "bow-tie": {"id": "bow-tie", "kind": "BLOCKED", "shape": BOW_TIE, "version": 1},
    }
    async with fog.raw_redis() as raw:
        await raw.hset("fog:test:zones", mapping={name: json.dumps(zone) for name, zone in stored.items()})
    fog.start("map_service")
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=60) as client:
        assert [zone["id"] for zone in (await client.get("/api/v1/zones")).json()["zones"]] == ["good"]
        left_out = {zone["id"]: zone["reason"] for zone in (await client.get("/api/v1/unusable-zones")).json()}
        assert left_out.keys() == {"too-costly", "bow-tie"}
        assert "$.factor" in left_out["too-costly"]
        detail = (await client.get("/readyz")).json()["parts"]["zones"]["detail"]
        assert all(name in detail for name in left_out)
        for name in left_out:
            deleted = await client.delete(f"/api/v1/zones/{name}", headers=tokens["operator"])
            while deleted.status_code == 503:  # it does not lead yet
                deleted = await client.delete(f"/api/v1/zones/{name}", headers=tokens["operator"])
            assert deleted.status_code == 204
        assert (await client.get("/api/v1/unusable-zones")).json() == []
        assert (await client.get("/readyz")).json()["parts"]["zones"]["detail"] == "1 loaded"
        put = await client.put(
            "/api/v1/zones/too-costly", headers={**tokens["operator"], "If-None-Match": "*"},
            json={"kind": "PENALTY", "factor": 5.0, "shape": SMALL_CIRCLE},
        )  # fmt: skip
        assert put.status_code == 201, put.text
