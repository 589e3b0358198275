"""How long an area stays clear on a robot's map after the aggregator's heartbeat has stopped, whatever stopped it.

Real processes, one fault after another; each test begins and ends with a clear area. The time is measured from the
fault to the moment at which the map-service, by its own clock, took the area for unknown.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import time
from typing import TYPE_CHECKING, Final

import httpx
import programs
import pytest
import pytest_asyncio
from msgspec import structs
from text_file import replace_text

from fog_contracts import channels as ch
from fog_contracts.messages import AggregatorHeartbeat, AreaHazard, HazardArea, MapDelta, MapSnapshot, NodeReading
from fog_contracts.replica import Replica

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytest.importorskip("hazard_aggregator")
pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.asyncio(loop_scope="module")]

_log = logging.getLogger("live")
"""Logs measured times (`pytest --log-cli-level=info`)."""
DISTURBED: Final = "tests.support.disturbed_aggregator"
LIMIT_S: Final = 1.5
"""No area is clear for longer without the aggregator's heartbeat: a heartbeat's maximum age, a tick and a new map."""
BUSY_S: Final = 0.4
"""How much later a tick may come on a busy machine."""
FAULT_S: Final = 3.0


class SwallowingProxy:
    """Forwards TCP connections to a port; while `swallowing`, connections stay open and all data disappears."""

    def __init__(self, port: int) -> None:
        self._target = port
        self._tasks: set[asyncio.Task[None]] = set()
        self._writers: list[asyncio.StreamWriter] = []
        self.swallowing = False
        self.port = 0

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._connect, "127.0.0.1", 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there = await asyncio.open_connection("127.0.0.1", self._target)
        except OSError:
            writer.close()
            return
        self._writers += [writer, there[1]]
        for source, sink in ((reader, there[1]), (there[0], writer)):
            task = asyncio.create_task(self._pump(source, sink))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _pump(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(65536):
                if not self.swallowing:
                    sink.write(data)
        sink.close()

    async def stop(self) -> None:
        self._server.close()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for writer in self._writers:
            writer.close()
        await asyncio.gather(*(writer.wait_closed() for writer in self._writers), return_exceptions=True)


class System:
    """An aggregator behind a proxy, its node, and a follower of the map."""

    def __init__(self, fog, mqtt, zenoh, until) -> None:
        self.fog = fog
        self.mqtt = mqtt
        self.zenoh = zenoh
        self._until = until
        self.proxy = SwallowingProxy(int(fog.mosquitto.url.rpartition(":")[2]))
        self.clock = fog.folder / "clock"
        self.distance = 3.0
        self.replica = Replica()
        self.heartbeat: AggregatorHeartbeat | None = None
        self.hazard: AreaHazard | None = None
        self.shown: list[tuple[float, AreaHazard]] = []  # with the time of arrival
        self.aggregator: programs.Program | None = None
        mqtt.on(ch.AGGREGATOR_HEARTBEAT, self._on_heartbeat, AggregatorHeartbeat)
        mqtt.on(ch.AREA_HAZARD, self._on_hazard, AreaHazard)
        zenoh.subscribe(ch.MAP_DELTA, MapDelta, lambda _, delta: self.replica.apply(delta))
        zenoh.subscribe(ch.HAZARD, HazardArea, lambda _, described: self.shown.append((time.time(), described.hazard)))

    def _on_heartbeat(self, _: object, heartbeat: AggregatorHeartbeat) -> None:
        self.heartbeat = heartbeat

    def _on_hazard(self, _: object, hazard: AreaHazard) -> None:
        self.hazard = hazard

    async def measure(self) -> None:
        """Publish the node's readings, ten times a second."""
        began, seq = time.monotonic(), 0
        while True:
            reading = NodeReading(
                seq=seq, boot=1, uptime_ms=round(1000 * (time.monotonic() - began)), range_m=[self.distance, 3.0],
                status=["ok", "ok"], state="blocked" if self.distance < 1.5 else "clear",
            )  # fmt: skip
            seq += 1
            # While the broker does not answer, readings must not queue up in this client.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.05):
                    await self.mqtt.publish(ch.NODE_READING, reading, node="n1")
            await asyncio.sleep(0.1)

    def start_aggregator(self, clock: float = 0.0) -> None:
        """Start the aggregator; its wall clock is ahead by `clock` seconds."""
        replace_text(self.clock, str(clock))
        environment = {
            **self.fog.environment,
            "FOGNAV_MQTT_URL": f"mqtt://127.0.0.1:{self.proxy.port}",
            "FOGNAV_PORT_FILE": str(self.fog.folder / "aggregator.port"),
            "FAULT_CLOCK": str(self.clock),
            "FAULT_HANG_S": str(FAULT_S),
        }
        self.aggregator = programs.start(DISTURBED, environment, self.fog.folder / "aggregator.log")

    def kill_aggregator(self) -> None:
        assert self.aggregator is not None
        self.aggregator.kill()
        self.aggregator.wait()
        self.aggregator = None

    def log(self) -> str:
        return (self.fog.folder / "aggregator.log").read_text()

    @property
    def cost(self) -> int:
        """The cost in the area's middle on the follower's map."""
        column, row = self.replica.geometry.cell(3.5, 3.0)
        return int(self.replica.cost[row, column])

    async def until(self, condition: Callable[[], object], expected: str) -> None:
        await self._until(condition, expected, lambda: f"{self.log()[-6000:]}\n{self.fog.log('map_service')[-6000:]}")

    async def until_clear(self) -> None:
        await self.until(lambda: self.cost == 0, "the area is clear")

    async def clear_for(self, fault: float) -> float:
        """Wait until the area is not clear; return how long (s) it stayed clear after the fault (wall clock, s).

        What a busy machine let the processes wait meanwhile does not count.
        """
        late = self.fog.lateness()
        await self.until(lambda: self.cost != 0, "the area is not clear any more")
        await self.until(lambda: self.shown[-1][1].state != "clear", "its hazard is published")
        arrival, hazard = next((at, shown) for at, shown in self.shown if at > fault and shown.state != "clear")
        # The map-service's own clock excludes the delays of this process.
        end = hazard.since if fault < hazard.since < arrival else arrival
        _log.info("clear_for_s: %.2f, late_s: %.2f", end - fault, late.seconds())
        return end - fault - late.seconds()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def system(shared_open_fog, until) -> AsyncIterator[System]:
    await shared_open_fog.ready("map_service")
    async with shared_open_fog.edges() as (mqtt, zenoh, connect):
        running = System(shared_open_fog, mqtt, zenoh, until)
        await running.proxy.start()
        connect()
        await mqtt.wait_connected()
        snapshot, deadline = None, time.monotonic() + 60.0
        while snapshot is None:
            assert time.monotonic() < deadline, "the map-service has answered no query for the map in a minute"
            snapshot = await zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, 1.0)
        running.replica.load(snapshot)
        node = asyncio.create_task(running.measure())
        running.start_aggregator()
        try:
            await running.until_clear()
            yield running
        finally:
            node.cancel()
            await asyncio.gather(node, return_exceptions=True)
            if running.aggregator is not None:
                running.kill_aggregator()
            await running.proxy.stop()


async def test_killed_aggregator(system: System) -> None:
    system.kill_aggregator()
    assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
    system.start_aggregator()
    await system.until_clear()


async def test_stopped_aggregator(system: System) -> None:
    os.kill(system.aggregator.pid, signal.SIGSTOP)
    try:
        assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
    finally:
        os.kill(system.aggregator.pid, signal.SIGCONT)
    await system.until_clear()


async def test_aggregator_with_a_hung_event_loop(system: System) -> None:
    os.kill(system.aggregator.pid, signal.SIGUSR1)
    assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
    await system.until_clear()


async def test_aggregator_cut_off_from_the_broker(system: System) -> None:
    system.proxy.swallowing = True
    assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
    system.proxy.swallowing = False
    await system.until_clear()


async def test_frozen_broker_whose_queue_outlives_the_aggregator(system: System) -> None:
    broker = system.fog.mosquitto.pid
    os.kill(broker, signal.SIGSTOP)
    try:
        assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
        await asyncio.sleep(FAULT_S)  # heartbeats queue up in the broker's socket
        system.kill_aggregator()
        released = system.heartbeat
    finally:
        os.kill(broker, signal.SIGCONT)
    await system.until(lambda: system.heartbeat is not released, "queued heartbeats are released")
    states: set[int] = set()
    for _ in range(50):
        states.add(system.cost)
        await asyncio.sleep(0.02)
    assert 0 not in states
    system.start_aggregator()
    await system.until_clear()


async def test_killed_broker(system: System) -> None:
    system.fog.mosquitto.kill()
    assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
    system.fog.mosquitto.start()
    await system.until_clear()


async def test_steps_of_the_aggregators_clock(system: System) -> None:
    published = len(system.shown)
    for step in (-3600.0, 7200.0):
        replace_text(system.clock, str(step))
        await system.until(
            lambda step=step: abs(system.heartbeat.stamp - time.time() - step) < 60.0,
            "the heartbeat's clock has stepped",
        )
        for _ in range(round((LIMIT_S + 0.4) / 0.05)):
            assert system.cost == 0
            await asyncio.sleep(0.05)
    assert len(system.shown) == published, "the area is clear, and nothing of it has changed"
    system.kill_aggregator()
    assert await system.clear_for(time.time()) < LIMIT_S + BUSY_S
    system.start_aggregator()
    await system.until_clear()


@pytest.mark.parametrize("ahead", [0, 10**9])
async def test_foreign_clear_of_a_blocked_area(system: System, ahead: int) -> None:
    system.distance = 0.8
    await system.until(lambda: system.cost == 254, "the area is blocked")
    await system.until(lambda: system.hazard.state == "blocked", "its hazard is published")
    own = system.hazard
    foreign = structs.replace(own, state="clear", severity=0, penalty=0, seq=own.seq + 9, epoch=own.epoch + ahead)
    assert await system.mqtt.publish(ch.AREA_HAZARD, foreign, wait=True, area="hall")
    costs: set[int] = set()

    def answered() -> bool:
        costs.add(system.cost)
        return system.hazard.state == "blocked" and system.hazard.epoch > foreign.epoch

    await system.until(answered, "the aggregator goes above it")
    assert costs == {254}
    assert "foreign_message" in system.log()
    port = (system.fog.folder / "aggregator.port").read_text().strip()
    async with httpx.AsyncClient(timeout=60) as client:
        metrics = (await client.get(f"http://127.0.0.1:{port}/metrics")).text
    assert 'fognav_foreign_messages_total{kind="hazard"}' in metrics
    system.distance = 3.0
    await system.until_clear()


async def test_reboot_without_a_clock_and_with_redis_late(system: System) -> None:
    system.kill_aggregator()
    fault = time.time()
    before = system.hazard
    system.fog.redis.kill()
    system.distance = 0.8
    system.start_aggregator(clock=-time.time() + 60.0)
    assert await system.clear_for(fault) < LIMIT_S + BUSY_S
    await system.until(lambda: system.cost == 254, "a danger is shown without Redis")
    await system.until(lambda: system.hazard.epoch > before.epoch, "its epoch is above what it heard on the broker")
    provisional = system.hazard.epoch
    system.distance = 3.0
    system.fog.redis.start()
    await system.until_clear()
    # Redis has confirmed the provisional epoch, or given a higher one: the relief had to be stored with it.
    assert system.hazard.epoch >= provisional
