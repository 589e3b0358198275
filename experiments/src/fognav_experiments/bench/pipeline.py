"""Measures the way from many nodes' readings to the map: real broker, aggregator and map-service, the load apart.

The time of a hazard runs from its first reading, as it reached the aggregator, or from its confirmation, by the clock
of this machine, to the arrival of the map's delta at a zenoh subscriber in this process: broker, both services and the
router count.
"""

from __future__ import annotations

import asyncio
import sys
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import psutil
import zenoh

from fog_contracts import channels as ch
from fog_contracts.codec import decode
from fog_contracts.messages import MapDelta
from fog_runtime.credentials import NOBODY
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor import net
from fognav.output import FailedError
from fognav.programs import AGGREGATOR, MAP_SERVICE, SERVERS
from fognav.stack import Stack, StackConfig
from fognav.stack_doors import Doors
from fognav_experiments.bench.office import SITE, make_office, write_site

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from fog_contracts.grid import StaticMap

LARGEST_AREA: Final = 130
"""Nodes of one area, at most a third of all; the others share theirs with three more."""
_BENCH: Final = "bench"
"""The user who stands for all nodes and robots."""
_AREA: Final = 4
_SIDE: Final = 1.0
"""Side of an area (m)."""
_READY_S: Final = 120.0
_POLL_S: Final = 0.5
_STILL: Final = 3
"""So many polls without another reading, and all that arrive have arrived."""
MB: Final = 1e6


class _Fog:
    """The running processes of one measurement."""

    def __init__(self, stack: Stack) -> None:
        self._stack = stack
        self.processes = {name: psutil.Process(stack.pids()[name]) for name in (AGGREGATOR, MAP_SERVICE)}

    def cpu_s(self) -> dict[str, float]:
        """Return the CPU time (s) that each process has used."""
        return {name: sum(process.cpu_times()[:2]) for name, process in self.processes.items()}

    def rss_mb(self) -> dict[str, float]:
        """Return the memory of each process."""
        return {name: round(process.memory_info().rss / MB, 1) for name, process in self.processes.items()}

    async def received(self) -> int:
        """Return how many readings the aggregator has received, whether they count or not."""
        return sum(node["received"] + node["ignored"] for node in await self._list("/api/v1/nodes"))

    async def all_received(self) -> int:
        """Return the same, once none has arrived for a while."""
        received, still = await self.received(), 0
        while still < _STILL:
            await asyncio.sleep(_POLL_S)
            before, received = received, await self.received()
            still = still + 1 if received == before else 0
        return received

    async def wait_clear(self) -> None:
        """Wait until all areas are clear; raises `FailedError`."""
        for _ in range(round(_READY_S / _POLL_S)):
            if all(view["state"] == "clear" for view in await self._list("/api/v1/nodes")):
                return
            await asyncio.sleep(_POLL_S)
        raise FailedError("nodes are not clear though all measure that: this machine can't keep up")

    async def _list(self, path: str) -> list[dict[str, Any]]:
        port = self._stack.port(AGGREGATOR)
        assert port is not None
        answer = await asyncio.to_thread(net.request, "GET", port, path, token=self._stack.token)
        if not isinstance(answer.body, list):
            raise FailedError(f"the aggregator does not answer {path}: {answer.reason}")
        return answer.body


async def measure(  # noqa: PLR0913  # what is measured
    folder: Path,
    *,
    nodes: int,
    rate: float,
    robots: int,
    seconds: float,
    on_phase: Callable[[str], object],
    locked: bool = True,
) -> dict[str, Any]:
    """Return the figures; times in ms, None when no hazard reached the map. `folder` is empty.

    `locked`: broker, Redis and router encrypt, and ask everybody for a password.
    """
    write_nodes(folder, nodes)
    doors = Doors(site=SITE, unrestricted=(_BENCH,)) if locked else None
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, doors=doors)
    async with Stack(config) as stack:
        on_phase("starting broker, Redis, router, aggregator and map-service")
        await stack.start_servers(_READY_S)
        for name in (AGGREGATOR, MAP_SERVICE):
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready([*SERVERS, AGGREGATOR, MAP_SERVICE], _READY_S)
        fog, traces = _Fog(stack), _Traces()
        own = stack.doors.credentials(_BENCH) if locked else NOBODY
        with zenoh.open(session_config("client", connect=[stack.zenoh_endpoint], credentials=own)) as session:
            session.declare_subscriber(ch.MAP_DELTA.key(site=SITE), traces.on_delta)
            async with _load(stack, nodes, rate, robots, seconds) as load:
                # Kernels are loaded just then, and each node's first readings change its area.
                on_phase(f"{nodes} nodes at {rate:g} Hz, until all are clear")
                await fog.wait_clear()
                on_phase(f"the same with hazards for {seconds:g} s")
                cpu, memory = fog.cpu_s(), fog.rss_mb()
                sent = await _ended(load, seconds)
                cpu = {name: used - cpu[name] for name, used in fog.cpu_s().items()}
                received = await fog.all_received()
        return {
            "sent": sent["sent"],
            "lost": sent["sent"] - received,
            "load_late_s": sent["late_s"],
            **traces.figures(),
            "aggregator_cpu_percent": round(100 * cpu[AGGREGATOR] / seconds, 1),
            "aggregator_us_per_reading": round(1e6 * cpu[AGGREGATOR] / (nodes * rate * seconds), 1),
            "map_cpu_percent": round(100 * cpu[MAP_SERVICE] / seconds, 1),
            "rss_mb_before": memory,
            "rss_mb_after": fog.rss_mb(),
        }


def write_nodes(folder: Path, nodes: int) -> None:
    """Write a site with so many nodes: up to 130 of them watch one area, each four of the others another one."""
    floor = make_office(60.0, 40.0, seed=1)
    write_site(folder, floor)
    corners = _free_corners(floor)
    lines: list[str] = []
    first = min(LARGEST_AREA, max(1, nodes // 3))
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


@asynccontextmanager
async def _load(stack: Stack, nodes: int, rate: float, robots: int, seconds: float) -> AsyncIterator[Process]:
    """Run the load generator, which measures once it is told to."""
    options = [SITE, stack.mqtt_url, stack.zenoh_endpoint, str(nodes), str(rate), str(robots), str(seconds)]
    if (credentials := stack.doors.file(_BENCH)) is not None:
        options.append(str(credentials))
    pipe = asyncio.subprocess.PIPE
    load = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fognav_experiments.bench.node_load", *options, stdin=pipe, stdout=pipe, stderr=pipe
    )
    try:
        yield load
    finally:
        if load.returncode is None:
            load.kill()
            await load.wait()


async def _ended(load: Process, seconds: float) -> dict[str, Any]:
    """Let the load generator measure; return what it sent. Raises `FailedError`."""
    async with asyncio.timeout(4 * seconds + 60):
        out, err = await load.communicate(b"begin\n")
    if load.returncode != 0:
        raise FailedError(f"the load generator failed: {err.decode(errors='replace').strip()[-500:]}")
    return msgspec.json.decode(out.splitlines()[-1], type=dict[str, Any])


class _Traces:
    """The hazards that reached the map, with the times (s) since their first reading and since their confirmation."""

    def __init__(self) -> None:
        self._ages: list[tuple[float, float]] = []

    def on_delta(self, sample: zenoh.Sample) -> None:
        """Note the hazards of a delta that has arrived; it is called on another thread."""
        now = time.time()
        delta = decode(ch.MAP_DELTA, sample.payload.to_bytes(), MapDelta)
        if delta.part == delta.parts - 1:
            self._ages += [
                (now - trace.first_reading, now - trace.confirmed) for trace in delta.traces if trace.confirmed > 0
            ]

    def figures(self) -> dict[str, Any]:
        """Return how many hazards there were, and percentiles of their times (ms)."""
        # On a machine that can't keep up, readings are too old to count, and no hazard may come of them.
        figures: dict[str, Any] = {"hazards": len(self._ages)}
        for index, name in enumerate(("reading_to_delta", "confirmed_to_delta")):
            for p in (50, 99):
                ages = [age[index] for age in self._ages]
                figures[f"{name}_p{p}_ms"] = round(1000 * float(np.percentile(ages, p)), 1) if ages else None
        return figures
