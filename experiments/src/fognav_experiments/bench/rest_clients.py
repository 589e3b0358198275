"""Clients that ask a map-service for all that costs it time, legal and illegal, as fast as it answers."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections import Counter
from typing import TYPE_CHECKING, Final, Self

import msgspec

from fog_supervisor.net import LOOPBACK

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

    from fog_contracts.messages import Shape

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
