"""The fleet hears the map's heartbeat whatever clients do to the map-service."""

import asyncio
import itertools
import json
import os
import signal
import sys
import time

import httpx
import numpy as np
import pytest

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import MapDelta, MapHeartbeat, MapSnapshot
from fog_contracts.replica import Applied, Replica
from fog_runtime.configuration.maps import save_map

pytestmark = pytest.mark.live
MAX_AGE_S = 1.0
"""A robot slows down when it has heard no heartbeat for this time."""
WIDTH, HEIGHT = 2000, 1200
# Every legal zone costs the service work; these cost the most.
LONG_CORRIDOR = {"type": "corridor", "line": [[0.1 + 0.6 * i, 59.9 if i % 2 else 0.1] for i in range(83)], "width": 0.4}
STAR = {
    "type": "polygon",
    "points": [
        [50 + r * np.cos(a), 30 + r * np.sin(a)]
        for a, r in ((2 * np.pi * i / 500, 14.0 if i % 2 else 3.0) for i in range(500))
    ],
}
WHOLE_FLOOR = {"type": "rectangle", "corner": [0.0, 0.0], "opposite": [100.0, 60.0]}
CROSSING = {"type": "polygon", "points": [[0.1 * i, 30.0 + (-1) ** i * (i % 7)] for i in range(500)]}
TOO_LONG = {"type": "corridor", "line": [[1.0 + i % 2 * 90.0, 1.0 + i % 2 * 58.0] for i in range(500)], "width": 0.3}
STOPPED_CLIENT = """
import pathlib, sys, time, zenoh
from fog_runtime.credentials import Credentials
from fog_runtime.transports.zenoh_edge import session_config
own = Credentials.read(pathlib.Path(sys.argv[2]))
session = zenoh.open(session_config("client", connect=[sys.argv[1]], credentials=own))
session.declare_subscriber("fog/test/map/heartbeat", lambda _: None)
answers = []
while not answers:
    time.sleep(0.1)
    answers = list(session.get("fog/test/map/snapshot", timeout=5.0))
for _ in range(20):
    session.get("fog/test/map/snapshot", zenoh.handlers.Callback(lambda _: time.sleep(60)), timeout=60.0)
print("asked", flush=True)
time.sleep(60)
"""


class Follower:
    """Follows the map, and measures the time between heartbeats."""

    def __init__(self, zenoh) -> None:
        self.zenoh = zenoh
        self.replica = Replica()
        self.beats: list[float] = []
        self.refused = 0
        zenoh.subscribe(ch.MAP_HEARTBEAT, MapHeartbeat, lambda *_: self.beats.append(time.monotonic()))
        zenoh.subscribe(ch.MAP_DELTA, MapDelta, self._on_delta)

    def _on_delta(self, _ids, delta: MapDelta) -> None:
        if self.replica.version is not None and self.replica.apply(delta) == "gap":
            self.refused += 1

    async def load(self) -> None:
        async with asyncio.timeout(60):
            while (snapshot := await self.zenoh.query(ch.MAP_SNAPSHOT, None, MapSnapshot, 10.0)) is None:  # noqa: ASYNC110  # a query, no event
                await asyncio.sleep(0.1)
        assert isinstance(self.replica.load(snapshot), Applied)

    def longest_gap_since(self, begin: float) -> float:
        times = [begin, *(beat for beat in self.beats if beat > begin), time.monotonic()]
        return max(later - earlier for earlier, later in itertools.pairwise(times))


def large_floor(fog) -> None:
    """Give the fog a floor of 2000 x 1200 cells whose pictures and snapshots compress badly."""
    cells = np.random.default_rng(7).choice(np.array([0, 254, 255], np.uint8), (HEIGHT, WIDTH), p=[0.98, 0.01, 0.01])
    save_map(fog.site / "map", StaticMap(GridGeometry(WIDTH, HEIGHT, 0.05, 0.0, 0.0), cells))


async def test_heartbeats_and_deltas_continue_while_clients_flood_the_service(fog, until, tokens):
    large_floor(fog)
    fog.start("map_service")
    url = await fog.ready("map_service")
    statuses: set[int] = set()
    async with fog.edges() as (_, zenoh, _connect), httpx.AsyncClient(base_url=url, timeout=60) as client:
        follower = Follower(zenoh)
        await follower.load()
        begin = time.monotonic()
        stop = asyncio.Event()

        async def draw(number: int, shape: dict, status: int) -> None:
            while not stop.is_set():
                body = {"id": f"z{number}", "kind": "BLOCKED", "shape": shape}
                answer = await client.post("/api/v1/zones", json=body, headers=tokens["operator"])
                assert answer.status_code in {status, 503}, answer.text
                statuses.add(answer.status_code)
                if answer.status_code == 201:
                    await client.delete(f"/api/v1/zones/z{number}", headers=tokens["operator"])

        async def look(path: str, **options) -> None:
            while not stop.is_set():
                answer = await client.request("GET" if not options else "POST", path, **options)
                statuses.add(answer.status_code)

        shapes = [(LONG_CORRIDOR, 201), (STAR, 201), (WHOLE_FLOOR, 201), (CROSSING, 422), (TOO_LONG, 422)]
        flood = [asyncio.create_task(draw(n, shape, status)) for n, (shape, status) in enumerate(shapes)]
        flood += [asyncio.create_task(look(f"/api/v1/{name}.png")) for name in ("costmap", "map") for _ in range(2)]
        flood.append(asyncio.create_task(look("/api/v1/zones", content=b"[" * 900_000, headers=tokens["operator"])))
        seq = follower.replica.version.seq
        await until(lambda: follower.replica.version.seq >= seq + 30, "30 versions", lambda: fog.log("map_service"))
        gap = follower.longest_gap_since(begin)
        stop.set()
        await asyncio.gather(*flood)
        assert {200, 201, 422} <= statuses
        assert statuses <= {200, 201, 422, 503}
        assert gap < MAX_AGE_S, f"no heartbeat for {gap:.2f} s"
        assert follower.refused == 0


async def test_client_that_stops_with_twenty_open_snapshots_does_not_silence_the_heartbeat(fog, until):
    large_floor(fog)
    fog.start("map_service")
    await fog.ready("map_service")
    async with fog.edges() as (_, zenoh, _connect):
        follower = Follower(zenoh)
        await follower.load()
        client = await asyncio.create_subprocess_exec(
            sys.executable, "-c", STOPPED_CLIENT, fog.router.endpoint, str(fog.credentials_file("test")),
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            assert await client.stdout.readline() == b"asked\n"
            os.kill(client.pid, signal.SIGSTOP)
            begin, count = time.monotonic(), len(follower.beats)
            await until(lambda: len(follower.beats) >= count + 30, "30 heartbeats")
            gap = follower.longest_gap_since(begin)
            await follower.load()
        finally:
            client.kill()
            await client.wait()
        assert gap < MAX_AGE_S, f"no heartbeat for {gap:.2f} s"


async def test_whoever_reads_the_audit_trail_of_large_zones_does_not_silence_the_heartbeat(fog, until, tokens):
    zone = json.dumps({"id": "z", "kind": "BLOCKED", "shape": STAR}, default=float)
    async with fog.raw_redis() as redis, redis.pipeline(transaction=False) as pipeline:
        for _ in range(1000):
            fields = {"at": "1.0", "who": "anna", "action": "replace", "id": "z", "before": zone, "after": zone}
            pipeline.xadd("fog:test:audit:zone", fields)
        await pipeline.execute()
    fog.start("map_service")
    url = await fog.ready("map_service")
    async with fog.edges() as (_, zenoh, _connect), httpx.AsyncClient(base_url=url, timeout=60) as client:
        follower = Follower(zenoh)
        await follower.load()
        begin, count = time.monotonic(), len(follower.beats)
        answer = await client.get("/api/v1/audit?limit=1000", headers=tokens["viewer"])
        assert (len(answer.json()), "next" in answer.links) == (7, True), "a page ends with its size"
        await until(lambda: len(follower.beats) >= count + 10, "10 heartbeats")
        gap = follower.longest_gap_since(begin)
        assert gap < MAX_AGE_S, f"no heartbeat for {gap:.2f} s"
