"""Loopback ports, and a small HTTP client for the services."""

import asyncio
import contextlib
import http.client
import json
import random
import socket
import ssl
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

LOOPBACK: Final = "127.0.0.1"
EVERY_ADDRESS: Final = ("0.0.0.0", "")  # noqa: S104  # compared, not listened on
PORTS = range(20_000, 32_000)
"""Below the ephemeral ports: a client that connects to a restarting server could otherwise be assigned the server's
own port, and even connect to itself."""
_TRIES: Final = 200
HTTP_TIMEOUT_S: Final = 5.0


def free_port(taken: set[int] | None = None) -> int:
    """Return a port that is free and not in `taken`, and add it to `taken`."""
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
    raise OSError(
        f"no free port from {PORTS[0]} to {PORTS[-1]} after {_TRIES} tries: stop programs that listen on them"
    )


def read_port(path: Path) -> int | None:
    """Return the port that a process wrote to its port file, or None when there is none yet."""
    try:
        return int(path.read_text("ascii"))
    except (FileNotFoundError, ValueError):
        return None


@dataclass(frozen=True)
class Response:
    """Status and JSON body of an HTTP response; a body that is not JSON is its text. `data` are its bytes."""

    status: int
    body: Any
    data: bytes = b""

    @property
    def reason(self) -> str:
        """The detail of a problem document (RFC 9457), else the whole body."""
        if isinstance(self.body, dict):
            return str(self.body.get("detail") or self.body.get("title") or self.body)
        return str(self.body)


def request(  # noqa: PLR0913  # the parts of a request
    method: str,
    port: int,
    path: str,
    *,
    body: object = None,
    token: str | None = None,
    headers: Mapping[str, str] | None = None,
    host: str = LOOPBACK,
    tls: ssl.SSLContext | None = None,
    timeout_s: float = HTTP_TIMEOUT_S,
) -> Response:
    """Send a request to a server on the loopback address or a `host`, by HTTPS with `tls`.

    Raises `OSError` or `HTTPException`.
    """
    sent_headers = {"Accept": "application/json", **(headers or {})}
    data = None
    if body is not None:
        data = json.dumps(body).encode()
        sent_headers["Content-Type"] = "application/json"
    if token is not None:
        sent_headers["Authorization"] = f"Bearer {token}"
    if tls is None:
        connection = http.client.HTTPConnection(host, port, timeout=timeout_s)
    else:
        connection = http.client.HTTPSConnection(host, port, timeout=timeout_s, context=tls)
    try:
        connection.request(method, path, body=data, headers=sent_headers)
        response = connection.getresponse()
        answer = response.read()
    finally:
        connection.close()
    text = answer.decode("utf-8", "replace")
    try:
        return Response(response.status, json.loads(text), answer)
    except json.JSONDecodeError:
        return Response(response.status, text, answer)


def put_goal(planner_url: str, robot: str, place: str, token: str) -> Response:
    """Give a robot a place of the site as its goal; return the planner's answer, which may be a refusal.

    Raises `OSError` if the planner can't be reached, `ValueError` for an address that is not like `http://host:8000`.
    """
    address = urlsplit(planner_url)
    if address.scheme != "http" or not address.hostname:
        raise ValueError(f"the planner's address must look like http://host:8000, not {planner_url}")
    try:
        return request(
            "PUT",
            address.port or http.client.HTTP_PORT,
            f"{address.path.rstrip('/')}/api/v1/robots/{robot}/goal",
            body={"place": place},
            token=token,
            host=address.hostname,
        )
    except http.client.HTTPException as error:
        raise ConnectionError(f"the planner closed the connection: {error!r}") from error


def reachable(address: str) -> str:
    """Return where programs of this computer reach a server that listens on an address, which may be every one."""
    return LOOPBACK if address in EVERY_ADDRESS else address


async def readiness(port_file: Path, *, host: str = LOOPBACK, encrypted: bool = False) -> str | None:
    """Return what a process still waits for by its `/readyz`, or None when it is ready; `encrypted`: by HTTPS."""
    port = read_port(port_file)
    if port is None:
        return "it has not written its port file yet"
    try:
        response = await asyncio.to_thread(
            request, "GET", port, "/readyz", host=host, tls=unverified() if encrypted else None
        )
    except (OSError, http.client.HTTPException) as error:
        return f"/readyz does not answer: {error}"
    if response.status == http.client.OK:
        return None
    if isinstance(response.body, dict) and isinstance(response.body.get("parts"), dict):
        parts = response.body["parts"]
        missing = [f"{name} ({part.get('detail') or 'not yet'})" for name, part in parts.items() if not part.get("ok")]
        return "it waits for " + ", ".join(missing)
    return response.reason


def unverified() -> ssl.SSLContext:
    """Return what a connection needs whose server need not prove its name: one to this computer, without secrets."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


async def server_problem(
    port: int, probe: bytes = b"", expected: bytes = b"", *, host: str = LOOPBACK, encrypted: bool = False
) -> str | None:
    """Return None when a server accepts connections on the port and answers `probe` as expected, else what is wrong.

    `encrypted`: by TLS.
    """
    try:
        # `asyncio.wait_for` (Python 3.11) loses a cancellation that comes as its wait ends.
        async with asyncio.timeout(HTTP_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(host, port, ssl=unverified() if encrypted else None)
    except (OSError, TimeoutError) as error:
        return f"no server listens on port {port}: {error}"
    try:
        if probe:
            writer.write(probe)
            async with asyncio.timeout(HTTP_TIMEOUT_S):
                reply = await reader.read(64)
            if not reply.startswith(expected):
                return f"port {port} answers {reply!r} instead of {expected!r}"
    except (OSError, TimeoutError) as error:
        return f"port {port} does not answer: {error}"
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()
    return None
