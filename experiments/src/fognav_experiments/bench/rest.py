"""Measures how steadily a map-service sends its heartbeat while clients ask it for all that costs it time.

A real process with Redis, broker and router of its own, locked as in the field; the heartbeat is timed by another
process (`python -m fognav_experiments.bench.rest`), in which no other work delays what it measures. The same run
measures it without clients first: on a busy machine only the two together mean something.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import subprocess
import sys
import time
from collections import Counter
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

import msgspec
import numpy as np
import psutil
import zenoh

from fog_contracts import channels as ch
from fog_runtime.credentials import Credentials
from fog_runtime.stores.redis_store import Audit
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor.net import LOOPBACK
from fognav.programs import MAP_SERVICE, PLANNER, SERVERS
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import SITE
from fognav_experiments.bench.cores import random_zones, worst_shapes
from map_service.store import ZONES, Store

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import Shape, Zone


IDLE_S: Final = 5.0
"""How long the heartbeat is measured without clients, unless told otherwise."""
_READY_S: Final = 120.0


async def measure(
    folder: Path, floor: StaticMap, *, zones: int, clients: int, seconds: float, idle_s: float = IDLE_S
) -> dict[str, float | int | dict[str, int]]:
    """Return the gaps between heartbeats (ms), without clients (`idle_`) and with them, and what these were answered.

    Before, for a single client: how long it takes to read all zones from Redis, until the service is ready with them,
    to list them over REST, and until the costliest zone is stored and on the map. `folder` holds a site
    (`office.write_site`) of this floor; `zones` are stored before.
    """
    config = StackConfig(site_dir=folder, robot="none", extra={"HAZARDS_WAIT_S": "0"}, users=StackUsers(site=SITE))
    async with _map_service(config, random_zones(floor, zones)) as (stack, started):
        pid, port = stack.pids()[MAP_SERVICE], stack.port(MAP_SERVICE)
        assert port is not None
        load = Load(port, stack.token, worst_shapes(floor))
        alone = await load.alone()
        with heartbeat_listener(stack) as listener:
            await asyncio.sleep(idle_s)
            idle = gaps_of(listener)
            service, *http_processes = psutil.Process(pid), *psutil.Process(pid).children()
            begun = service.cpu_times()
            await load.run(clients, seconds)
            loaded = gaps_of(listener)
            ended = service.cpu_times()
        return {
            **started,
            **{name: round(seconds * 1000.0, 1) for name, seconds in alone.items()},
            **figures_of("idle_heartbeat_gap", idle),
            **figures_of("heartbeat_gap", loaded),
            "requests": dict(sorted(load.answers.items())),
            "cpu_s": round(sum(ended[:2]) - sum(begun[:2]), 1),
            "rss_mb": round(service.memory_info().rss / 1e6, 1),
            "front_rss_mb": round(sum(_own_bytes(http_process) for http_process in http_processes) / 1e6, 1),
        }


def _own_bytes(process: psutil.Process) -> int:
    """Return the memory that a process does not share with the one that it was forked from."""
    return int(process.memory_full_info().uss)


def figures_of(name: str, gaps: list[float]) -> dict[str, float]:
    """Return median, 99th percentile and the longest of gaps (s) in ms."""
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
        own = stack.security.credentials(MAP_SERVICE)
        async with Store(stack.redis_url, SITE, service=MAP_SERVICE, credentials=own) as store:
            await store.restore({ZONES.name: {zone.id: zone for zone in zones}}, {}, Audit(0.0, "bench", "restore"))
            begun = loop.time()
            await store.zones()
            read_s = loop.time() - begun
        begun = loop.time()
        stack.supervisor.start(MAP_SERVICE)
        await stack.supervisor.wait_ready([*SERVERS, MAP_SERVICE], _READY_S)
        yield stack, {"read_zones_ms": round(read_s * 1000.0, 1), "ready_s": round(loop.time() - begun, 2)}


@contextmanager
def heartbeat_listener(stack: Stack) -> Iterator[subprocess.Popen[bytes]]:
    """Run a process that times the map's heartbeat: see `gaps_of`."""
    command = (
        sys.executable, "-m", "fognav_experiments.bench.rest", SITE, stack.zenoh_endpoint,
        str(stack.security.file(PLANNER)),
    )  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        gaps_of(process)  # once it listens
        yield process
        process.terminate()


def gaps_of(listener: subprocess.Popen[bytes]) -> list[float]:
    """Return the gaps (s) since the last call."""
    assert listener.stdin is not None
    assert listener.stdout is not None
    listener.stdin.write(b"\n")
    listener.stdin.flush()
    return msgspec.json.decode(listener.stdout.readline(), type=list[float])


_ZONES: Final = "/api/v1/zones"
_READS: Final = ("/api/v1/audit?limit=1000", "/api/v1/hazards", "/api/v1/map", "/openapi.json", "/metrics", "/readyz")
_PICTURES: Final = ("/api/v1/costmap.png", "/api/v1/map.png")
_SLOW_S: Final = 0.2
"""Time between two pieces of what a slow client sends or reads."""
_SLOW_BYTES: Final = 4096
_NESTED: Final = b"[" * 900_000
_TOO_LARGE: Final = b" " * (2 * 1024 * 1024)
_CROSSING: Final[object] = {
    "kind": "BLOCKED",
    "shape": {"type": "polygon", "points": [[1.0 + 0.1 * i, 10.0 + (-1) ** i * (i % 7)] for i in range(500)]},
}
_WITHOUT_SHAPE: Final[object] = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [1.0], "radius": -1.0}}


class Load:
    """Clients of the map-service at a port; `answers` counts what they got, by status."""

    def __init__(self, port: int, token: str, shapes: Sequence[Shape]) -> None:
        self.answers: Counter[str] = Counter()
        self._port = port
        self._authorization = f"Authorization: Bearer {token}\r\n"
        self._shapes = shapes

    async def alone(self) -> dict[str, float]:
        """Return how long (s) a single client waits for the list of all zones, and for the costliest zone (`_ms`)."""
        loop = asyncio.get_running_loop()
        async with _Connection(self._port) as connection:
            begun = loop.time()
            await self._ask(connection, "GET", _ZONES)
            listed, worst = loop.time() - begun, 0.0
            for shape in self._shapes:
                body = msgspec.json.encode({"id": "alone", "kind": "BLOCKED", "shape": shape})
                begun = loop.time()
                await self._post(connection, body)
                worst = max(worst, loop.time() - begun)
                await self._ask(connection, "DELETE", f"{_ZONES}/alone")
        return {"list_zones_ms": listed, "worst_zone_ms": worst}

    async def run(self, clients: int, seconds: float) -> None:
        """Let this many clients, of each kind about as many, ask for `seconds`."""
        kinds = itertools.cycle(self._kinds())
        tasks = [asyncio.ensure_future(self._repeat(next(kinds), number)) for number in range(clients)]
        done, _ = await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_EXCEPTION)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for task in done:
            task.result()

    def _kinds(self) -> list[Callable[[_Connection, int], Awaitable[None]]]:
        bodies = [msgspec.json.encode(body) for body in (_CROSSING, _WITHOUT_SHAPE)]
        return [
            self._draw,
            lambda connection, _: self._ask(connection, "GET", _ZONES),
            lambda connection, _: self._post(connection, bodies[0]),
            lambda connection, _: self._post(connection, bodies[1]),
            lambda connection, _: self._post(connection, _NESTED),
            lambda connection, _: self._post(connection, _TOO_LARGE),
            self._look,
            self._read_all,
            self._write_slowly,
            self._read_slowly,
        ]

    async def _repeat(self, request: Callable[[_Connection, int], Awaitable[None]], number: int) -> None:
        while True:
            try:
                async with _Connection(self._port) as connection:
                    while True:
                        await request(connection, number)
            except (OSError, asyncio.IncompleteReadError):
                self.answers["disconnected"] += 1
                await asyncio.sleep(0.01)

    # --- Kinds of clients -------------------------------------------------------------------------------------------

    async def _draw(self, connection: _Connection, number: int) -> None:
        """Add and delete each of the costliest zones."""
        for shape in self._shapes:
            name = f"client-{number}"
            body = msgspec.json.encode({"id": name, "kind": "BLOCKED", "shape": shape})
            await self._post(connection, body)
            await self._ask(connection, "DELETE", f"{_ZONES}/{name}")

    async def _look(self, connection: _Connection, _number: int) -> None:
        for path in _PICTURES:
            await self._ask(connection, "GET", path)

    async def _read_all(self, connection: _Connection, _number: int) -> None:
        for path in _READS:
            await self._ask(connection, "GET", path)

    async def _write_slowly(self, connection: _Connection, _number: int) -> None:
        """Send a body that never ends, until the service has enough of it."""
        connection.write(self._head("POST", _ZONES, 1024 * 1024))
        for _ in range(50):
            connection.write(b" " * _SLOW_BYTES)
            await asyncio.sleep(_SLOW_S)
        raise ConnectionAbortedError

    async def _read_slowly(self, connection: _Connection, _number: int) -> None:
        """Ask for all zones, several times, and read little of them."""
        for _ in range(20):
            connection.write(self._head("GET", _ZONES, 0))
        for _ in range(50):
            await connection.reader.read(_SLOW_BYTES)
            await asyncio.sleep(_SLOW_S)
        raise ConnectionAbortedError

    # --- Requests ---------------------------------------------------------------------------------------------------

    async def _post(self, connection: _Connection, body: bytes) -> None:
        await self._ask(connection, "POST", _ZONES, body)

    async def _ask(self, connection: _Connection, method: str, path: str, body: bytes = b"") -> None:
        status = await connection.ask(self._head(method, path, len(body)) + body)
        self.answers[str(status)] += 1

    def _head(self, method: str, path: str, size: int) -> bytes:
        return (
            f"{method} {path} HTTP/1.1\r\nHost: fog\r\n{self._authorization}Content-Type: application/json\r\n"
            f"Content-Length: {size}\r\n\r\n"
        ).encode()


class _Connection:
    """A connection that is kept open; far cheaper than a general HTTP client, so that the service is what is slow."""

    def __init__(self, port: int) -> None:
        self._port = port

    async def __aenter__(self) -> Self:
        self.reader, self._writer = await asyncio.open_connection(LOOPBACK, self._port)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    def write(self, data: bytes) -> None:
        """Send without waiting."""
        self._writer.write(data)

    async def ask(self, request: bytes) -> int:
        """Send a request, read the whole answer and return its status; raises `OSError` when it is cut off."""
        self._writer.write(request)
        await self._writer.drain()
        head = (await self.reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        status = int(head.split(" ", 2)[1])
        _, _, rest = head.partition("\r\ncontent-length:")
        if rest:
            await self.reader.readexactly(int(rest.split("\r\n", 1)[0]))
        if "\r\nconnection: close" in head:
            self._writer.close()
        return status


def main() -> None:
    """Listen as the command line says, until standard input ends: SITE ENDPOINT CREDENTIALS_FILE.

    Each line on standard input ends a measurement, whose gaps (s) are written as one JSON list.
    """
    site, endpoint, own = sys.argv[1:]
    config = session_config("client", connect=[endpoint], credentials=Credentials.read(Path(own)))
    times: list[float] = []
    with zenoh.open(config) as session:
        session.declare_subscriber(ch.MAP_HEARTBEAT.key(site=site), lambda _: times.append(time.monotonic()))
        begin = time.monotonic()
        for _ in sys.stdin:
            end = time.monotonic()
            inside = [begin, *(at for at in times.copy() if begin < at < end), end]
            gaps = [later - earlier for earlier, later in itertools.pairwise(inside)]
            sys.stdout.buffer.write(msgspec.json.encode(gaps) + b"\n")
            sys.stdout.flush()
            begin = end


if __name__ == "__main__":
    main()
