"""Measures what the console's events cost, and how late they are, with many readers: real processes, as in the field.

Sensor nodes flip areas and robots send poses ten times a second (`bench.pipeline`). The readers are a process of their
own (`python -m fognav_experiments.bench.console`), each with a login and a connection; some of them take the events
apart, and compare the stamps of their publication with the time of their arrival. Another process times the map's
heartbeat (`bench.rest`): with and without readers, as only the two together mean something on a busy machine.

The same for a list of many floors: another process answers for each of them, and asks this one as some of them do.
"""

from __future__ import annotations

import asyncio
import sys
import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
import psutil

from fog_runtime.clock import SystemClock, ticker
from fog_supervisor.net import LOOPBACK
from fognav.output import FailedError
from fognav.programs import AGGREGATOR, CONSOLE, MAP_SERVICE, SERVERS
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import SITE, ask
from fognav_experiments.bench.pipeline import BENCH, MB, Fog, ended, load_generator, write_nodes
from fognav_experiments.bench.rest import figures_of, gaps_of, heartbeat_listener

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

NODES: Final = 40
NODE_HZ: Final = 10.0
SAMPLED: Final = 10
"""Readers that take the events apart."""
_AT_ONCE: Final = 20
"""Readers that connect at the same time."""
_READY_S: Final = 120.0
_CONNECTED_S: Final = 300.0
_MOST_ASKERS: Final = 100
"""How many of the floors at most ask the one that lists them: those of a campus have each other, not all have all."""
_CONNECTIONS: Final = 20
"""Over which they ask: one address gets no more than some."""
_SETTLE_S: Final = 12.0
"""In which a console has asked a thousand floors twice."""


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


async def measure_floors(folder: Path, count: int, seconds: float, on_phase: Callable[[str], object]) -> dict[str, Any]:
    """Return what a list of so many other floors costs a console-service; `folder` is empty. Raises `FailedError`."""
    write_nodes(folder, NODES)
    pipe = asyncio.subprocess.PIPE
    words = ["-m", "fognav_experiments.bench.console", "floors", str(count)]
    playing = await asyncio.create_subprocess_exec(sys.executable, *words, stdin=pipe, stdout=pipe, limit=1 << 20)
    assert playing.stdin is not None
    assert playing.stdout is not None
    try:
        ports = (await playing.stdout.readline()).split()
        (folder / "there.toml").write_text('user = "bench"\ntoken = "bench"\n', "utf-8")
        listed = folder / "floors.toml"
        entries = (
            f'[floors.f{number}]\naddress = "http://{LOOPBACK}:{int(port)}"\ncredentials = "there.toml"\n'
            for number, port in enumerate(ports)
        )
        listed.write_text("".join(entries), "utf-8")
        config = StackConfig(
            site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, console={"FLOORS_FILE": str(listed)}
        )
        async with Stack(config) as stack:
            on_phase(f"{count} floors: starting servers and services of one more")
            await stack.start_servers(_READY_S)
            await stack.start_services(_READY_S)
            playing.stdin.write(f"{stack.port(CONSOLE)} {stack.token}\n".encode())
            on_phase(f"{count} floors: measuring for {seconds:g} s")
            await asyncio.sleep(_SETTLE_S)
            playing.stdin.write(b"begin\n")
            process = psutil.Process(stack.pids()[CONSOLE])
            begun, ages, load = _cpu_s(process), [], psutil.getloadavg()[0]
            until = time.monotonic() + seconds
            while time.monotonic() < until:
                answer = await ask(stack, CONSOLE, "GET", "/api/v1/floors")
                for entry in msgspec.convert(answer.body, list[dict[str, Any]]):
                    if entry["address"]:
                        if not entry["reachable"]:
                            raise FailedError(f"{entry['id']} is not reachable: {entry['detail']}")
                        ages.append(entry["age_s"])
                await asyncio.sleep(1.0)
            used, memory = _cpu_s(process) - begun, process.memory_info().rss
            playing.stdin.write(b"end\n")
            out = msgspec.json.decode(await playing.stdout.readline(), type=list[float])
    finally:
        if playing.returncode is None:
            playing.kill()
        await playing.wait()
    return {
        "floors": count,
        "cpu_percent": round(100 * used / seconds, 1),
        "rss_mb": round(memory / MB, 1),
        **{f"age_p{p}_s": round(float(np.percentile(ages, p)), 1) for p in (50, 99)},
        "answers": len(out),
        **{f"answer_p{p}_ms": round(1000 * float(np.percentile(out, p)), 1) for p in (50, 99)},
        "load": round(load, 1),
    }


async def _play_floors(count: int) -> None:
    """Answer for so many floors, each at a port of its own; some of them have the one under test in their lists."""
    took: list[float] = []
    servers = [await asyncio.start_server(_answering(number), LOOPBACK, 0) for number in range(count)]
    sys.stdout.write(" ".join(str(server.sockets[0].getsockname()[1]) for server in servers) + "\n")
    sys.stdout.flush()
    port, token = (await asyncio.to_thread(sys.stdin.readline)).split()
    askers = min(count, _MOST_ASKERS)
    connections = min(askers, _CONNECTIONS)
    async with asyncio.TaskGroup() as tasks:
        asking = [
            tasks.create_task(_ask_on(port, token, number / askers, connections / askers, took))
            for number in range(connections)
        ]
        await asyncio.to_thread(sys.stdin.readline)
        took.clear()
        await asyncio.to_thread(sys.stdin.readline)
        for each in asking:
            each.cancel()
    sys.stdout.buffer.write(msgspec.json.encode(took) + b"\n")
    sys.stdout.flush()
    await asyncio.Event().wait()  # until it is killed, so that no connection ends before


def _answering(number: int) -> Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]:
    robots = [{"id": f"r{each}", "age_s": 0.1, "mode": "NORMAL", "enabled": True, "codes": []} for each in range(5)]
    view = {"site": f"f{number}", "not_ready": {}, "robots": robots, "blocked": ["a1"], "unknown": [], "stopped": False}
    body = msgspec.json.encode(view)
    answer = b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n%b" % (len(body), body)

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                await reader.readuntil(b"\r\n\r\n")
                writer.write(answer)
        writer.close()

    return serve


async def _ask_on(port: str, token: str, begin_s: float, period_s: float, took: list[float]) -> None:
    await asyncio.sleep(begin_s)
    reader, writer = await asyncio.open_connection(LOOPBACK, int(port))
    asked = f"GET /api/v1/floors/here HTTP/1.1\r\nHost: fog\r\nAuthorization: Bearer {token}\r\n\r\n".encode()
    async for _ in ticker(SystemClock(), period_s):
        begun = time.monotonic()
        writer.write(asked)
        head = await reader.readuntil(b"\r\n\r\n")
        if not head.startswith(b"HTTP/1.1 200"):
            raise ConnectionError(head.decode("latin-1"))
        _, _, length = head.lower().partition(b"content-length:")
        await reader.readexactly(int(length.partition(b"\r\n")[0]))
        took.append(time.monotonic() - begun)


def main() -> None:
    """Read as the command line says: PORT TOKEN READERS SECONDS. Or play floors: floors COUNT.

    Readers write `ready` once all have the first state; from the first line of standard input on so many seconds are
    measured. Floors write their ports, and are told PORT TOKEN of another, when to begin to measure, and when to end.
    """
    if sys.argv[1] == "floors":
        asyncio.run(_play_floors(int(sys.argv[2])))
    else:
        port, token, readers, seconds = sys.argv[1:]
        asyncio.run(_read(port, token, int(readers), float(seconds)))


if __name__ == "__main__":
    main()
