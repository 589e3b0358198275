"""Measures the way from many nodes' readings to the map: real broker, aggregator and map-service, the load apart.

The time of a hazard runs from its confirmation, by the clock of this machine, to the arrival of the map's delta at a
zenoh subscriber in this process, so that broker, both services and the router count.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import psutil
import zenoh

from fog_contracts import channels as ch
from fog_contracts.codec import decode
from fog_contracts.messages import MapDelta
from fog_runtime.zenoh_edge import session_config
from fog_supervisor import net
from fognav.bench.office import make_office
from fognav.bench.site import SITE, write_site
from fognav.output import FailedError
from fognav.programs import AGGREGATOR, MAP_SERVICE, SERVERS
from fognav.stack import Stack, StackConfig

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from fog_contracts.grid import StaticMap

LARGEST_AREA: Final = 130
"""Nodes of one area; the others share theirs with three more."""
_AREA: Final = 4
_SIDE: Final = 1.0
"""Side of an area (m)."""
_SETTLE_S: Final = 3.0
_WARM_UP_S: Final = 4.0
_READY_S: Final = 120.0


async def measure(
    folder: Path, *, nodes: int, rate: float, robots: int, seconds: float, on_phase: Callable[[str], object]
) -> dict[str, Any]:
    """Return the figures; times in ms, None when no hazard reached the map. `folder` is empty."""
    write_nodes(folder, nodes)
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"})
    async with Stack(config) as stack:
        on_phase("starting broker, Redis, router, aggregator and map-service")
        await stack.start_servers(_READY_S)
        for name in (AGGREGATOR, MAP_SERVICE):
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready([*SERVERS, AGGREGATOR, MAP_SERVICE], _READY_S)
        processes = {name: psutil.Process(stack.pids()[name]) for name in (AGGREGATOR, MAP_SERVICE)}
        on_phase(f"{nodes} nodes at {rate:g} Hz for {seconds:g} s")
        delays: list[float] = []
        with zenoh.open(session_config("client", connect=[stack.zenoh_endpoint])) as session:
            # The first hazards meet kernels that are loaded just then.
            await asyncio.to_thread(_load, stack, nodes, rate, robots, _WARM_UP_S)
            warm_up = await _received(stack)
            session.declare_subscriber(ch.MAP_DELTA.key(site=SITE), lambda sample: delays.extend(_delays(sample)))
            before = {name: sum(process.cpu_times()[:2]) for name, process in processes.items()}
            load = await asyncio.to_thread(_load, stack, nodes, rate, robots, seconds)
            cpu = {name: sum(process.cpu_times()[:2]) - before[name] for name, process in processes.items()}
            await asyncio.sleep(_SETTLE_S)
        received = await _received(stack) - warm_up
        # On a machine that can't keep up, readings are too old to count, and no hazard may come of them.
        p50, p99 = (round(1000 * float(np.percentile(delays, p)), 1) if delays else None for p in (50, 99))
        return {
            "sent": load["sent"],
            "lost": load["sent"] - received,
            "hazards": len(delays),
            "confirmed_to_delta_p50_ms": p50,
            "confirmed_to_delta_p99_ms": p99,
            "load_late_s": load["late_s"],
            "aggregator_cpu_percent": round(100 * cpu[AGGREGATOR] / seconds, 1),
            "aggregator_us_per_reading": round(1e6 * cpu[AGGREGATOR] / load["sent"], 1),
            "map_cpu_percent": round(100 * cpu[MAP_SERVICE] / seconds, 1),
            "aggregator_rss_mb": round(processes[AGGREGATOR].memory_info().rss / 1e6, 1),
        }


def write_nodes(folder: Path, nodes: int) -> None:
    """Write a site with so many nodes: up to 130 of them watch one area, the others one for each four."""
    floor = make_office(60.0, 40.0, seed=1)
    write_site(folder, floor)
    corners = _free_corners(floor)
    lines: list[str] = []
    first = min(LARGEST_AREA, nodes)
    areas = ["z0"] * first + [f"z{1 + i // _AREA}" for i in range(nodes - first)]
    for index, area in enumerate(dict.fromkeys(areas)):
        x, y = corners[index % len(corners)]
        ring = [[x, y], [x + _SIDE, y], [x + _SIDE, y + _SIDE], [x, y + _SIDE]]
        lines += ["[[areas]]", f'id = "{area}"', f"polygon = {ring}", ""]
    for index, area in enumerate(areas):
        lines += ["[[nodes]]", f'id = "n{index}"', f'area = "{area}"', f"x = {corners[0][0]}", f"y = {corners[0][1]}"]
        lines += ["theta = 1.57", "sonars = [{ range_limit = 2.65 }, { angle = 0.22, range_limit = 2.65 }]", ""]
    with (folder / "site.toml").open("a", encoding="utf-8") as file:
        file.write("\n".join(lines))


def _free_corners(floor: StaticMap) -> list[tuple[float, float]]:
    """Return the lower left corners (m) of separate free squares: a hazard elsewhere would change no cell."""
    size = round(_SIDE / floor.geometry.resolution)
    rows, columns = (cells // size for cells in floor.cells.shape)
    squares = floor.cells[: rows * size, : columns * size].reshape(rows, size, columns, size)
    free = np.argwhere(~squares.any(axis=(1, 3)))
    left, bottom, _, _ = floor.geometry.bounds
    return [(left + float(column) * _SIDE, bottom + float(row) * _SIDE) for row, column in free]


def _load(stack: Stack, nodes: int, rate: float, robots: int, seconds: float) -> dict[str, Any]:
    options = [SITE, stack.mqtt_url, stack.zenoh_endpoint, str(nodes), str(rate), str(robots), str(seconds)]
    command = [sys.executable, "-m", "fognav.bench.node_load", *options]
    done = subprocess.run(command, capture_output=True, timeout=4 * seconds + 60, check=False)
    if done.returncode != 0:
        raise FailedError(f"the load generator failed: {done.stderr.decode(errors='replace').strip()[-500:]}")
    return msgspec.json.decode(done.stdout.splitlines()[-1], type=dict[str, Any])


def _delays(sample: zenoh.Sample) -> list[float]:
    """Return the times (s) since the confirmation of the hazards in a delta."""
    now = time.time()
    delta = decode(ch.MAP_DELTA, sample.payload.to_bytes(), MapDelta)
    last = delta.part == delta.parts - 1
    return [now - trace.confirmed for trace in delta.traces if trace.confirmed > 0] if last else []


async def _received(stack: Stack) -> int:
    """Return how many readings the aggregator has received, whether they count or not."""
    port = stack.port(AGGREGATOR)
    assert port is not None
    answer = await asyncio.to_thread(net.request, "GET", port, "/api/v1/nodes", token=stack.token)
    if not isinstance(answer.body, list):
        raise FailedError(f"the aggregator does not list its nodes: {answer.reason}")
    return sum(node["received"] + node["ignored"] for node in answer.body)
