"""Two aggregators and two map-services with one Redis: one of each leads, the other takes over within 2 s."""

import asyncio
import contextlib
import signal
import time

import httpx
import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, MapHeartbeat, NodeReading

pytestmark = pytest.mark.live

TAKEOVER_S = 2.0
BUSY_S = 0.5
"""How much later everything may come on a busy machine."""
COPIES = {"aggregator": "hazard_aggregator", "map": "map_service"}


class Receiver:
    """Records hazards and heartbeats of the map, and publishes the readings of a node that measures an obstacle."""

    def __init__(self, mqtt, zenoh) -> None:
        self.mqtt = mqtt
        self.received: dict[str, list[tuple[float, AreaHazard | MapHeartbeat]]] = {"aggregator": [], "map": []}
        mqtt.on(ch.AREA_HAZARD, lambda _, hazard: self.add("aggregator", hazard), AreaHazard)
        zenoh.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, lambda _, heartbeat: self.add("map", heartbeat))

    def add(self, service: str, message: AreaHazard | MapHeartbeat) -> None:
        self.received[service].append((time.monotonic(), message))

    def epochs(self, service: str) -> list[int]:
        return [message.epoch for _, message in self.received[service]]

    def since(self, service: str, begin: float) -> list[AreaHazard | MapHeartbeat]:
        return [message for at, message in self.received[service] if at >= begin]

    async def publish_readings(self) -> None:
        booted = time.monotonic()
        for seq in range(100_000):
            reading = NodeReading(
                seq=seq,
                boot=7,
                uptime_ms=round(1000 * (time.monotonic() - booted)),
                range_m=[0.5, 0.5],
                status=["ok", "ok"],
                state="blocked",
            )
            await self.mqtt.publish(ch.NODE_READING, reading, node="n1")
            await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def receiver(fog):
    async with fog.edges() as (mqtt, zenoh, connect):
        made = Receiver(mqtt, zenoh)
        connect()
        await mqtt.wait_connected()
        publishing = asyncio.create_task(made.publish_readings())
        try:
            yield made
        finally:
            publishing.cancel()
            await asyncio.gather(publishing, return_exceptions=True)


async def lease(fog, name: str) -> str:
    """Return what a process says about its lease."""
    async with httpx.AsyncClient() as client:
        return (await client.get(f"{await fog.url(name)}/readyz")).json()["parts"]["lease"]["detail"]


async def waits(fog, name: str, begins: str) -> None:
    deadline = time.monotonic() + 60.0
    while not (detail := await lease(fog, name)).startswith(begins):
        assert time.monotonic() < deadline, (detail, fog.log(name)[-3000:])
        await asyncio.sleep(0.05)


@pytest.mark.parametrize("service", COPIES)
async def test_second_copy_takes_over_after_death_hang_and_partition(fog, proxy, until, service):
    module = COPIES[service]
    first, second = module, f"{module}-2"
    redis = f"rediss://127.0.0.1:{await proxy.start()}/0"
    async with receiver(fog) as heard:
        for needed in COPIES.values():
            fog.start(needed)
            await fog.ready(needed)
        await until(lambda: heard.received["map"], "the map")
        await until(lambda: any(m.state == "blocked" for _, m in heard.received["aggregator"]), "the hazard")
        fog.start(module, second, FOGNAV_REDIS_URL=redis)
        await waits(fog, second, "this process stands by: ")
        assert len({m.epoch for _, m in heard.received[service]}) == 1, "two that run, one that speaks"

        old, killed = heard.epochs(service)[-1], time.monotonic()
        fog.kill(first)
        await until(lambda: heard.epochs(service)[-1] > old, "the second copy")
        assert time.monotonic() - killed <= TAKEOVER_S + BUSY_S, fog.log(second)

        fog.start(module, first)
        await waits(fog, first, "this process stands by: ")
        old, stopped = heard.epochs(service)[-1], time.monotonic()
        fog.processes[second].send_signal(signal.SIGSTOP)
        await until(lambda: heard.epochs(service)[-1] > old, "the first copy")
        assert time.monotonic() - stopped <= TAKEOVER_S + BUSY_S, fog.log(first)
        woken = time.monotonic()
        fog.processes[second].send_signal(signal.SIGCONT)
        await waits(fog, second, "this process stands by: ")
        assert not [m for m in heard.since(service, woken + 0.05) if m.epoch == old], "it says nothing when it wakes up"

        fog.kill(first)
        await waits(fog, second, "leads with epoch")
        fog.start(module, first)
        await waits(fog, first, "this process stands by: ")
        old, cut = heard.epochs(service)[-1], time.monotonic()
        proxy.cut()
        await until(lambda: heard.epochs(service)[-1] > old, "the first copy")
        assert time.monotonic() - cut <= TAKEOVER_S + BUSY_S, fog.log(first)
        taken = time.monotonic()
        await waits(fog, second, "this process stands by: ")
        assert not [m for m in heard.since(service, taken + 1.0) if m.epoch == old]

        begun = next(i for i, (_, m) in enumerate(heard.received["aggregator"]) if m.state == "blocked")
        assert {m.penalty for _, m in heard.received["aggregator"][begun:]} == {254}, "no takeover clears an area"
        async with httpx.AsyncClient() as client:
            shown = (await client.get(f"{await fog.ready('map_service')}/api/v1/hazards")).json()
        assert [area["hazard"]["penalty"] for area in shown] == [254]
