"""Measures how steadily a map-service sends its heartbeat while clients ask it for all that costs it time.

A real process with Redis, broker and router of its own, locked as in the field; the heartbeat is timed by another
process. The same run measures it without clients first: on a busy machine only the two together mean something.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
from contextlib import asynccontextmanager, contextmanager
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
import psutil

from fog_runtime.stores.redis_store import Audit
from fognav.programs import MAP_SERVICE, PLANNER, SERVERS
from fognav.stack import Stack, StackConfig
from fognav.stack_doors import Doors
from fognav_experiments.bench.costmap import random_zones, worst_shapes
from fognav_experiments.bench.rest_clients import Load
from fognav_experiments.bench.site import SITE
from map_service.store import Store

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import Zone

IDLE_S: Final = 5.0
"""How long the heartbeat is measured without clients, unless told otherwise."""
_READY_S: Final = 120.0


async def measure(
    folder: Path, floor: StaticMap, *, zones: int, clients: int, seconds: float, idle_s: float = IDLE_S
) -> dict[str, float | int | dict[str, int]]:
    """Return the gaps between heartbeats (ms), without clients (`idle_`) and with them, and what these were answered.

    Before, for a single client: how long it takes to read all zones from Redis, until the service is ready with them,
    to list them over REST, and until the costliest zone is stored and on the map. `folder` holds a site
    (`site.write_site`) of this floor; `zones` are stored before.
    """
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, doors=Doors(site=SITE))
    async with _map_service(config, random_zones(floor, zones)) as (stack, started):
        pid, port = stack.pids()[MAP_SERVICE], stack.port(MAP_SERVICE)
        assert port is not None
        load = Load(port, stack.token, worst_shapes(floor))
        alone = await load.alone()
        with _listener(stack) as listener:
            await asyncio.sleep(idle_s)
            idle = _gaps(listener)
            service, *fronts = psutil.Process(pid), *psutil.Process(pid).children()
            begun = service.cpu_times()
            await load.run(clients, seconds)
            loaded = _gaps(listener)
            ended = service.cpu_times()
        return {
            **started,
            **{name: round(seconds * 1000.0, 1) for name, seconds in alone.items()},
            **_figures("idle_heartbeat_gap", idle),
            **_figures("heartbeat_gap", loaded),
            "requests": dict(sorted(load.answers.items())),
            "cpu_s": round(sum(ended[:2]) - sum(begun[:2]), 1),
            "rss_mb": round(service.memory_info().rss / 1e6, 1),
            "front_rss_mb": round(sum(_own_bytes(front) for front in fronts) / 1e6, 1),
        }


def _own_bytes(process: psutil.Process) -> int:
    """Return the memory that a process does not share with the one that it was forked from."""
    return int(process.memory_full_info().uss)


def _figures(name: str, gaps: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(gaps, [50, 99])
    return {
        f"{name}_p50_ms": round(float(p50) * 1000.0, 1),
        f"{name}_p99_ms": round(float(p99) * 1000.0, 1),
        f"{name}_max_ms": round(max(gaps) * 1000.0, 1),
    }


@asynccontextmanager
async def _map_service(config: StackConfig, zones: list[Zone]) -> AsyncIterator[tuple[Stack, dict[str, float]]]:
    """Run a map-service that has these zones, and its servers; tell how long it took to read them, and its start."""
    loop = asyncio.get_running_loop()
    async with Stack(config) as stack:
        await stack.start_servers(_READY_S)
        async with Store(stack.redis_url, SITE, credentials=stack.doors.credentials(MAP_SERVICE)) as store:
            await store.restore(zones, Audit(0.0, "bench", "restore"))
            begun = loop.time()
            await store.zones()
            read_s = loop.time() - begun
        begun = loop.time()
        stack.supervisor.start(MAP_SERVICE)
        await stack.supervisor.wait_ready([*SERVERS, MAP_SERVICE], _READY_S)
        yield stack, {"read_zones_ms": round(read_s * 1000.0, 1), "ready_s": round(loop.time() - begun, 2)}


@contextmanager
def _listener(stack: Stack) -> Iterator[subprocess.Popen[bytes]]:
    command = (
        sys.executable, "-m", "fognav_experiments.bench.heartbeats", SITE, stack.zenoh_endpoint,
        str(stack.doors.file(PLANNER)),
    )  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        _gaps(process)  # once it listens
        yield process
        process.terminate()


def _gaps(listener: subprocess.Popen[bytes]) -> list[float]:
    """Return the gaps (s) since the last call."""
    assert listener.stdin is not None
    assert listener.stdout is not None
    listener.stdin.write(b"\n")
    listener.stdin.flush()
    return msgspec.json.decode(listener.stdout.readline(), type=list[float])
