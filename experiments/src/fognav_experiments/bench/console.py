"""Measures what the console's events cost, and how late they are, with many readers: real processes, as in the field.

Sensor nodes flip areas and robots send poses ten times a second (`bench.pipeline`). The readers are a process of their
own (`python -m fognav_experiments.bench.console`), each with a login and a connection; some of them take the events
apart, and compare the stamps of their publication with the time of their arrival. Another process times the map's
heartbeat (`bench.rest`): with and without readers, as only the two together mean something on a busy machine.
"""

from __future__ import annotations

import asyncio
import sys
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import psutil

from fog_supervisor.net import LOOPBACK
from fognav.output import FailedError
from fognav.programs import AGGREGATOR, CONSOLE, MAP_SERVICE, SERVERS
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import SITE
from fognav_experiments.bench.pipeline import BENCH, MB, Fog, ended, load_generator, write_nodes
from fognav_experiments.bench.rest import figures_of, gaps_of, heartbeat_listener

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

NODES: Final = 40
NODE_HZ: Final = 10.0
SAMPLED: Final = 10
"""Readers that take the events apart."""
_AT_ONCE: Final = 20
"""Readers that connect at the same time."""
_READY_S: Final = 120.0
_CONNECTED_S: Final = 300.0


async def measure(
    folder: Path, *, readers: int, robots: int, seconds: float, on_phase: Callable[[str], object]
) -> dict[str, Any]:
    """Return the figures; `folder` is empty. Raises `FailedError` if the readers can't all connect."""
    write_nodes(folder, NODES)
    users = StackUsers(site=SITE, unrestricted=(BENCH,))
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, users=users)
    async with Stack(config) as stack:
        on_phase("starting broker, Redis, router, aggregator, map-service and console-service")
        await stack.start_servers(_READY_S)
        services = (AGGREGATOR, MAP_SERVICE, CONSOLE)
        for name in services:
            stack.supervisor.start(name)
        await stack.supervisor.wait_ready([*SERVERS, *services], _READY_S)
        process = psutil.Process(stack.pids()[CONSOLE])
        async with load_generator(stack, NODES, NODE_HZ, robots, seconds) as load:
            with heartbeat_listener(stack) as listener:
                on_phase(f"{robots} robots and {NODES} nodes, until all are clear")
                await Fog(stack).wait_clear()
                on_phase(f"the same for {seconds:g} s without readers")
                gaps_of(listener)
                begun = _cpu_s(process)
                await asyncio.sleep(seconds)
                idle_cpu, idle, rss = _cpu_s(process) - begun, gaps_of(listener), process.memory_info().rss
                on_phase(f"{readers} readers connect")
                reading = await _readers(stack, readers, seconds)
                on_phase(f"hazards for {seconds:g} s with {readers} readers")
                gaps_of(listener)
                begun = _cpu_s(process)
                _, (out, err) = await asyncio.gather(ended(load, seconds), reading.communicate(b"begin\n"))
                loaded_cpu, loaded = _cpu_s(process) - begun, gaps_of(listener)
        if reading.returncode != 0:
            raise FailedError(f"the readers failed: {err.decode(errors='replace').strip()[-500:]}")
        found = msgspec.json.decode(out.splitlines()[-1], type=dict[str, Any])
        return {
            **found,
            "cpu_percent_without_readers": round(100 * idle_cpu / seconds, 1),
            "cpu_percent": round(100 * loaded_cpu / seconds, 1),
            "us_per_reader_and_s": round(1e6 * (loaded_cpu - idle_cpu) / seconds / readers, 1),
            "rss_mb_without_readers": round(rss / MB, 1),
            "rss_mb": round(process.memory_info().rss / MB, 1),
            **figures_of("idle_heartbeat_gap", idle),
            **figures_of("heartbeat_gap", loaded),
        }


def _cpu_s(process: psutil.Process) -> float:
    return float(sum(process.cpu_times()[:2]))


async def _readers(stack: Stack, readers: int, seconds: float) -> asyncio.subprocess.Process:
    """Start the readers; return once all have read the first state. Raises `FailedError`."""
    port = stack.port(CONSOLE)
    pipe = asyncio.subprocess.PIPE
    words = [str(port), stack.token, str(readers), repr(seconds)]
    reading = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "fognav_experiments.bench.console", *words, stdin=pipe, stdout=pipe, stderr=pipe
    )
    assert reading.stdout is not None
    try:
        async with asyncio.timeout(_CONNECTED_S):
            line = await reading.stdout.readline()
    except BaseException:
        reading.kill()
        raise
    if line != b"ready\n":
        _, err = await reading.communicate()
        raise FailedError(f"the readers failed: {err.decode(errors='replace').strip()[-500:]}")
    return reading


class _Reader(asyncio.Protocol):
    """One connection; with `delays` it takes its events apart and notes how late each is (s), by the event's name."""

    def __init__(self, request: bytes, delays: dict[str, list[float]] | None) -> None:
        self._request = request
        self._delays = delays
        self._rest = b""
        self.bytes = 0
        self.ready = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.write(self._request)

    def data_received(self, data: bytes) -> None:
        self.bytes += len(data)
        if not self.ready.done() and b"event: ready" in data:
            self.ready.set_result(None)
        if self._delays is not None:
            self._take(self._delays, time.time(), data)

    def connection_lost(self, exc: Exception | None) -> None:
        if not self.ready.done():
            self.ready.set_exception(exc or ConnectionError("closed before the first state was complete"))
        self.bytes = -1

    def _take(self, delays: dict[str, list[float]], now: float, data: bytes) -> None:
        *events, self._rest = (self._rest + data).split(b"\n\n")
        for event in events:
            head, _, value = event.partition(b"\ndata: ")
            if head.endswith(b"event: pose"):
                delays["pose"].append(now - msgspec.json.decode(value)["value"]["stamp"])
            elif head.endswith(b"event: area"):
                trace = (msgspec.json.decode(value)["value"]["hazard"] or {}).get("trace")
                if trace and trace["confirmed"] and (age := now - trace["confirmed"]) < 1.0:  # told again later, too
                    delays["area"].append(age)


async def _log_in(port: str, token: str) -> bytes:
    """Return a new session's cookie; raises `OSError`."""
    reader, writer = await asyncio.open_connection(LOOPBACK, int(port))
    body = msgspec.json.encode({"token": token})
    writer.write(
        b"POST /api/v1/session HTTP/1.1\r\nHost: fog\r\nContent-Type: application/json\r\nConnection: close\r\n"
        b"Content-Length: %d\r\n\r\n%b" % (len(body), body)
    )
    answer = await reader.read()
    writer.close()
    _, found, rest = answer.partition(b"set-cookie: ")
    if not found:
        raise ConnectionError(answer[:300].decode("latin-1"))
    return rest.partition(b";")[0]


async def _read(port: str, token: str, readers: int, seconds: float) -> None:
    loop = asyncio.get_running_loop()
    delays: dict[str, list[float]] = {"pose": [], "area": []}
    connected: list[_Reader] = []

    async def connect(number: int) -> None:
        cookie = await _log_in(port, token)
        request = b"GET /api/v1/events HTTP/1.1\r\nHost: fog\r\nCookie: %b\r\n\r\n" % cookie
        # Spread over all: the first ones are served first in each pass.
        sampled = number % max(1, readers // SAMPLED) == 0
        _, reader = await loop.create_connection(
            lambda: _Reader(request, delays if sampled else None), LOOPBACK, int(port)
        )
        connected.append(reader)
        await reader.ready

    for first in range(0, readers, _AT_ONCE):
        await asyncio.gather(*(connect(number) for number in range(first, min(first + _AT_ONCE, readers))))
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    await asyncio.to_thread(sys.stdin.readline)
    for each in delays.values():
        each.clear()
    before = sum(reader.bytes for reader in connected)
    await asyncio.sleep(seconds)
    figures: dict[str, Any] = {"lost_readers": sum(reader.bytes < 0 for reader in connected)}
    figures["bytes_per_reader_and_s"] = round((sum(r.bytes for r in connected) - before) / seconds / readers)
    for name, found in delays.items():
        figures[f"{name}s"] = len(found)
        for p in (50, 99):
            figures[f"{name}_p{p}_ms"] = round(1000 * float(np.percentile(found, p)), 1) if found else None
    sys.stdout.buffer.write(msgspec.json.encode(figures) + b"\n")


def main() -> None:
    """Read as the command line says: PORT TOKEN READERS SECONDS.

    Writes `ready` once all have the first state; from the first line of standard input on so many seconds are measured.
    """
    port, token, readers, seconds = sys.argv[1:]
    asyncio.run(_read(port, token, int(readers), float(seconds)))


if __name__ == "__main__":
    main()
