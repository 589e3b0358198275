"""The running aggregator with a real broker, Redis and router, each of them killed and restarted."""

import asyncio
import os
import signal
from contextlib import asynccontextmanager

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AggregatorHeartbeat, AreaDefinition, AreaHazard, NodeConfig, NodeReading, RobotPose

pytestmark = pytest.mark.live


class NodeClient:
    """Publishes the readings of a node, and records what the aggregator publishes."""

    def __init__(self, mqtt) -> None:
        self.mqtt = mqtt
        self.hazards: list[AreaHazard] = []
        self.definitions: list[AreaDefinition] = []
        self.configs: list[NodeConfig] = []
        self.lines: list[str] = []
        self.heartbeats: list[AggregatorHeartbeat] = []
        self.seq = 0
        self.boot = 1
        mqtt.on(ch.AREA_HAZARD, lambda _, m: self.hazards.append(m), AreaHazard)
        mqtt.on(ch.AREA_DEFINITION, lambda _, m: self.definitions.append(m), AreaDefinition)
        mqtt.on(ch.NODE_CONFIG, lambda _, m: self.configs.append(m), NodeConfig)
        mqtt.on(ch.AGGREGATOR_HEARTBEAT, lambda _, m: self.heartbeats.append(m), AggregatorHeartbeat)
        mqtt.on(ch.THESIS_WSN, lambda _, text: self.lines.append(text))

    async def read(self, distance: float, times: int = 1) -> None:
        for _ in range(times):
            self.seq += 1
            reading = NodeReading(
                seq=self.seq,
                boot=self.boot,
                uptime_ms=100 * self.seq,
                range_m=[distance, 3.0],
                status=["ok", "ok"],
                state="blocked" if distance < 1.5 else "clear",
            )
            await self.mqtt.publish(ch.NODE_READING, reading, node="n1")

    @property
    def state(self) -> str | None:
        return self.hazards[-1].state if self.hazards else None


@asynccontextmanager
async def connected_node(fog):
    async with fog.edges() as (mqtt, zenoh, connect):
        node = NodeClient(mqtt)
        connect()
        await mqtt.wait_connected()
        yield node, zenoh


@asynccontextmanager
async def aggregator_and_node(fog):
    fog.start("hazard_aggregator")
    await fog.ready("hazard_aggregator")
    async with connected_node(fog) as connected:
        yield connected


@pytest.mark.smoke
async def test_echoes_block_an_area_and_free_readings_clear_it(fog, until):
    async with aggregator_and_node(fog) as (node, _):
        await until(lambda: node.definitions and node.hazards and node.configs, "retained messages")
        assert node.hazards[0].state == "unknown"
        assert node.configs[0].range_limit_m == [1.5, 1.5]
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked", lambda: fog.log("hazard_aggregator"))
        trace = node.hazards[-1].trace
        assert 0 < trace.first_reading <= trace.confirmed
        await node.read(3.0, 8)
        await until(lambda: node.state == "clear", "clear", lambda: fog.log("hazard_aggregator"))
        await until(lambda: node.lines[-2:] == ["7,3.500,4.500", "7,-999,-999"], "thesis lines")


async def test_restarted_aggregator_restores_the_blocked_area(fog, until):
    async with aggregator_and_node(fog) as (node, _):
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked")
        epoch = node.hazards[-1].epoch
        fog.kill("hazard_aggregator")
        fog.start("hazard_aggregator")
        await until(lambda: node.hazards[-1].epoch > epoch, "restarted", lambda: fog.log("hazard_aggregator"))
        # A busy machine may start it so late that its node is silent by then.
        await until(lambda: node.state == "unknown", "unknown because its node is silent")
        assert {hazard.penalty for hazard in node.hazards if hazard.epoch > epoch} == {254}


async def test_blocked_period_lasts_from_its_first_announcement_whenever_the_aggregator_is_killed(fog, until):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    async with connected_node(fog) as (node, _):
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked")
        since = node.hazards[-1].since
        async with httpx.AsyncClient(timeout=60) as client, asyncio.timeout(60):
            while "fognav_hazards_unstored 0.0" not in (await client.get(f"{url}/metrics")).text:  # noqa: ASYNC110  # no event tells
                await asyncio.sleep(0.01)
        for _ in range(2):  # the first time before Redis has the period
            epoch = node.hazards[-1].epoch
            fog.kill("hazard_aggregator")
            fog.start("hazard_aggregator")
            await until(lambda epoch=epoch: node.hazards[-1].epoch > epoch, "restarted")
        url = await fog.ready("hazard_aggregator")
        await until(lambda: node.state == "unknown", "unknown because its node is silent")
        ended = node.hazards[-1].since
        async with httpx.AsyncClient(timeout=60) as client, asyncio.timeout(60):
            blocked = []
            while not blocked or blocked[0]["ended"] is None:
                views = (await client.get(f"{url}/api/v1/areas/hall/history")).json()
                blocked = [view for view in views if view["period"]["state"] == "blocked"]
                await asyncio.sleep(0.05)
    assert len(blocked) == 1
    assert blocked[0]["period"]["began"] == pytest.approx(since, abs=0.2)
    assert blocked[0]["lasted_s"] == pytest.approx(ended - since, abs=0.4)


async def test_danger_that_redis_never_had_survives_an_aggregator_that_is_killed_twice(fog, until):
    async with aggregator_and_node(fog) as (node, _):
        await until(lambda: node.hazards, "first hazard")
        os.kill(fog.redis.pid, signal.SIGSTOP)
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked without the store")
        blocked = len(node.hazards) - 1
        for _ in range(2):  # the second time as soon as it has said anything
            epoch = node.hazards[-1].epoch
            fog.kill("hazard_aggregator")
            os.kill(fog.redis.pid, signal.SIGCONT)
            fog.start("hazard_aggregator")
            await until(lambda epoch=epoch: node.hazards[-1].epoch > epoch, "restarted")
        await until(lambda: "silent" in node.hazards[-1].cause, "unknown because its node is silent")
    assert {hazard.penalty for hazard in node.hazards[blocked:]} == {254}


async def test_broker_that_lost_its_data_gets_everything_again(fog, until):
    async with aggregator_and_node(fog) as (node, _):
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked")
        fog.mosquitto.kill()
        (fog.mosquitto.folder / "mosquitto.db").unlink(missing_ok=True)
        node.hazards.clear()
        node.definitions.clear()
        fog.mosquitto.start()
        await until(lambda: node.hazards and node.definitions, "republished", lambda: fog.log("hazard_aggregator"))
        assert node.hazards[-1].penalty == 254


async def test_without_redis_danger_is_announced_and_relief_waits(fog, until):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    async with connected_node(fog) as (node, _), httpx.AsyncClient(timeout=60) as client:
        await until(lambda: node.hazards, "first hazard")
        fog.redis.kill()
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked without the store")
        await node.read(3.0, 8)
        async with asyncio.timeout(60):
            for _ in iter(int, 1):
                if "fognav_hazards_withheld 1.0" in (await client.get(f"{url}/metrics")).text:
                    break
                await asyncio.sleep(0.02)
        assert node.state == "blocked"
        assert (await client.get(f"{url}/readyz")).json()["missing"] == ["store"]
        fog.redis.start()
        await node.read(3.0, 8)
        await until(lambda: node.state == "clear", "clear once it is stored", lambda: fog.log("hazard_aggregator"))


async def test_aggregator_started_without_redis_restores_the_blocked_area_later(fog, until):
    async with aggregator_and_node(fog) as (node, _):
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked")
        await blockage_is_stored(fog)
        fog.kill("hazard_aggregator")
        fog.redis.kill()
        fog.mosquitto.kill()
        (fog.mosquitto.folder / "mosquitto.db").unlink(missing_ok=True)
        node.hazards.clear()
        fog.mosquitto.start()
        fog.start("hazard_aggregator")
        await until(lambda: node.state == "unknown", "unknown without the store", lambda: fog.log("hazard_aggregator"))
        assert node.hazards[-1].penalty == 200
        fog.redis.start()
        await until(lambda: node.hazards[-1].penalty == 254, "restored", lambda: fog.log("hazard_aggregator"))


async def blockage_is_stored(fog) -> None:
    async with fog.raw_redis() as raw, asyncio.timeout(60):
        while not any(b"blocked" in stored for stored in await raw.hvals("fog:test:hazards")):  # noqa: ASYNC110  # a query
            await asyncio.sleep(0.01)


async def test_robot_in_the_cone_does_not_block_the_area(fog, until):
    async with aggregator_and_node(fog) as (node, zenoh):
        await node.read(3.0, 8)
        await until(lambda: node.state == "clear", "clear")
        robot = RobotPose(
            x=3.5, y=3.5, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.35, stamp=1.0
        )
        while node.hazards[-1].explained_by is None:
            zenoh.publish(ch.ROBOT_POSE, robot, robot="r1")
            await node.read(0.83)
            await asyncio.sleep(0.05)
            assert node.state == "clear" or node.seq < 12  # the pose may come after the first readings
        assert node.hazards[-1].explained_by == "r1"


async def test_thesis_node_of_an_area_added_at_run_time_is_subscribed_without_a_restart(fog, until, tokens):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    async with connected_node(fog) as (node, _), httpx.AsyncClient(timeout=60) as client:
        body = {"polygon": [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]], "number": 8}
        put = await client.put(f"{url}/api/v1/areas/gate", json=body, headers=tokens["operator"])
        assert put.status_code == 201, put.text
        for _ in range(5):
            assert await node.mqtt.publish(ch.THESIS_AREA, "blocked", wait=True, number="8")
        await until(
            lambda: any(h.area == "gate" and h.state == "blocked" for h in node.hazards),
            "the area is blocked",
            lambda: fog.log("hazard_aggregator"),
        )


async def test_malformed_messages_are_refused_and_the_aggregator_goes_on(fog, until):
    fog.start("hazard_aggregator")
    url = await fog.ready("hazard_aggregator")
    async with connected_node(fog) as (node, _), httpx.AsyncClient(timeout=60) as client:
        raw = node.mqtt._client
        topic = ch.NODE_READING.key(site="test", node="n1")
        for payload in (b"x" * 200_000, b"{", b'{"seq":-1}', b"\xff\xfe"):
            await raw.publish(topic, payload, qos=0, timeout=30)
        await raw.publish(ch.NODE_AVAILABILITY.key(site="test", node="n1"), b"maybe", qos=1)
        await node.read(0.8, 5)
        await until(lambda: node.state == "blocked", "blocked", lambda: fog.log("hazard_aggregator"))
        metrics = (await client.get(f"{url}/metrics")).text
        assert 'fognav_refused_messages_total{channel="node_reading"} 4.0' in metrics
        assert 'fognav_refused_messages_total{channel="node_availability"} 1.0' in metrics
