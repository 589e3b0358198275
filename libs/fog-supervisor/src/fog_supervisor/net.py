"""Loopback ports, and the small HTTP client that a local operator needs."""

import asyncio
import contextlib
import http.client
import json
import random
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

LOOPBACK: Final = "127.0.0.1"
PORTS = range(20_000, 32_000)
"""Below the range from which systems take the ports of outgoing connections: a client that tries to reach a server
that is just restarting could otherwise be given the server's port, and even connect to itself."""
_TRIES: Final = 200
HTTP_TIMEOUT_S: Final = 5.0


def free_port(taken: set[int] | None = None) -> int:
    """Return a port that nobody listens on and that is not in `taken`, and add it there."""
    taken = set() if taken is None else taken
    generator = random.SystemRandom()
    for _ in range(_TRIES):
        port = generator.choice(PORTS)
        if port in taken:
            continue
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind((LOOPBACK, port))
            taken.add(port)
            return port
    raise OSError(f"no free port from {PORTS[0]} to {PORTS[-1]} after {_TRIES} tries: who listens on them all?")


def read_port(path: Path) -> int | None:
    """Return the port that a process wrote to its port file, or None when it has not yet."""
    try:
        return int(path.read_text("ascii"))
    except (FileNotFoundError, ValueError):
        return None


@dataclass(frozen=True)
class Answer:
    """Status and JSON body of an HTTP answer; a body that is no JSON is its text."""

    status: int
    body: Any

    @property
    def reason(self) -> str:
        """What a problem document (RFC 9457) says, or the whole body."""
        if isinstance(self.body, dict):
            return str(self.body.get("detail") or self.body.get("title") or self.body)
        return str(self.body)


def request(
    method: str,
    port: int,
    path: str,
    *,
    body: object = None,
    token: str | None = None,
    headers: Mapping[str, str] | None = None,
) -> Answer:
    """Ask a server on the loopback address; raises `OSError` or `http.client.HTTPException` when it can't be had."""
    sent = {"Accept": "application/json", **(headers or {})}
    data = None
    if body is not None:
        data = json.dumps(body).encode()
        sent["Content-Type"] = "application/json"
    if token is not None:
        sent["Authorization"] = f"Bearer {token}"
    connection = http.client.HTTPConnection(LOOPBACK, port, timeout=HTTP_TIMEOUT_S)
    try:
        connection.request(method, path, body=data, headers=sent)
        answer = connection.getresponse()
        text = answer.read().decode("utf-8", "replace")
    finally:
        connection.close()
    try:
        return Answer(answer.status, json.loads(text))
    except json.JSONDecodeError:
        return Answer(answer.status, text)


async def readiness(port_file: Path) -> str | None:
    """Return what a process says that it still misses (`/readyz`), or None when it is ready."""
    port = read_port(port_file)
    if port is None:
        return "it has not said where it listens"
    try:
        answer = await asyncio.to_thread(request, "GET", port, "/readyz")
    except (OSError, http.client.HTTPException) as error:
        return f"/readyz does not answer: {error}"
    if answer.status == http.client.OK:
        return None
    if isinstance(answer.body, dict) and isinstance(answer.body.get("parts"), dict):
        parts = answer.body["parts"]
        lacking = [f"{name} ({part.get('detail') or 'not yet'})" for name, part in parts.items() if not part.get("ok")]
        return "it waits for " + ", ".join(lacking)
    return answer.reason


async def listens(port: int, hello: bytes = b"", wanted: bytes = b"") -> str | None:
    """Return None when a server takes connections on the port (and answers `hello` with `wanted`), or what is wrong."""
    try:
        reader, writer = await asyncio.wait_for(asyncio.open_connection(LOOPBACK, port), HTTP_TIMEOUT_S)
    except (OSError, TimeoutError) as error:
        return f"nobody listens on port {port}: {error}"
    try:
        if hello:
            writer.write(hello)
            said = await asyncio.wait_for(reader.read(64), HTTP_TIMEOUT_S)
            if not said.startswith(wanted):
                return f"port {port} answers {said!r} instead of {wanted!r}"
    except (OSError, TimeoutError) as error:
        return f"port {port} does not answer: {error}"
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
    return None
