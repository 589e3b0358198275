"""Passes requests to the services behind the console's address: the gateway of a system without containers.

In containers it is Caddy that does so (deploy/gateway/Caddyfile), by the same table; a test compares them. Each service
checks the caller itself: what is passed on has the caller's own token or session, and no right of this service.
"""

from __future__ import annotations

import asyncio
import re
from typing import TYPE_CHECKING, Any, Final, Self

import httpx
import msgspec
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.typing import Subprotocol

from fog_runtime.http.http_process import PROOF
from fog_runtime.http.openapi import merged
from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, ProblemCode, ProblemError, allowed_methods, problem

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Mapping

    from starlette.types import Receive, Scope, Send


MESSAGE_LIMIT: Final = 64 * 1024 * 1024
"""Most bytes of a message from the bridge: a floor's whole costmap."""
_OPEN_S: Final = 5.0
_PASSED_ON: Final = ("authorization",)
"""Headers of the caller that the bridge needs."""
_GONE: Final = (ConnectionClosed, WebSocketDisconnect)


class SocketRelay:
    """The WebSockets of the service at an address; a slow client slows only what is read for it."""

    def __init__(self, url: str, trusted: ssl.SSLContext | None, away: ProblemCode) -> None:
        """`url` is the service's (HTTP or HTTPS); while it does not run, the problem `away` is answered."""
        self._url = "ws" + url.removeprefix("http")
        self._trusted = trusted if url.startswith("https:") else None
        self._away = away

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a connection until one of both sides ends it."""
        socket = WebSocket(scope, receive, send)
        query = scope["query_string"].decode("latin-1")
        target = scope["raw_path"].decode("latin-1") + (f"?{query}" if query else "")
        headers = [(name, socket.headers[name]) for name in _PASSED_ON if name in socket.headers]
        asked = [Subprotocol(each) for each in scope["subprotocols"]]
        opening = connect(
            self._url + target, additional_headers=headers, subprotocols=asked or None, ssl=self._trusted, proxy=None,
            compression=None, max_size=MESSAGE_LIMIT, max_queue=1, open_timeout=_OPEN_S, ping_interval=None,
        )  # fmt: skip
        try:
            upstream = await opening
        except InvalidStatus as error:
            answer = error.response
            kind = answer.headers.get("Content-Type")
            await socket.send_denial_response(Response(bytes(answer.body or b""), answer.status_code, media_type=kind))
            return
        except InvalidURI:  # its words have the whole address, in which may be a token
            await socket.send_denial_response(Response("this is no address of the bridge's", 404))
            return
        except (OSError, TimeoutError, InvalidHandshake) as error:
            detail = (
                f"the bridge gives no answer ({str(error) or 'it took too long'}): start the fog node with --bridge, "
                "`fognav logs bridge` says why it ended"
            )
            await socket.send_denial_response(problem(self._away, detail, headers=RETRY_AFTER, service="bridge"))
            return
        async with upstream:
            await socket.accept(upstream.subprotocol)
            ways = {asyncio.ensure_future(_up(socket, upstream)), asyncio.ensure_future(_down(socket, upstream))}
            _, going = await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for each in going:
                each.cancel()
            for result in await asyncio.gather(*ways, return_exceptions=True):
                if isinstance(result, Exception) and not isinstance(result, _GONE):
                    raise result


async def _up(socket: WebSocket, upstream: ClientConnection) -> None:
    while (message := await socket.receive())["type"] == "websocket.receive":
        text = message.get("text")
        await upstream.send(message["bytes"] if text is None else text)


async def _down(socket: WebSocket, upstream: ClientConnection) -> None:
    async for message in upstream:
        await (socket.send_text(message) if isinstance(message, str) else socket.send_bytes(message))
    await socket.close(upstream.close_code or 1011, upstream.close_reason or "")


AGGREGATOR, MAP_SERVICE, PLANNER, CONSOLE = "hazard-aggregator", "map-service", "planner", "console-service"
DEMO: Final = "demo"
"""A demo, which tells the page about its scenario."""
BRIDGE: Final = "bridge"
"""The bridge to other systems, where one runs: it has WebSockets."""
ROUTES: Final[Mapping[str, tuple[str, ...]]] = {
    AGGREGATOR: ("areas", "nodes", "alerts"),
    PLANNER: ("robots", "plan", "schedules", "visits"),
    CONSOLE: ("session", "events", "timeline", "recording", "vitals", "floors", "openapi.json"),
    DEMO: ("scenario",),
    BRIDGE: ("foxglove",),
}
"""Which routes each service has, by what follows /api/v1/; the map-service has all others."""
URGENT: Final = ("/api/v1/robots/{robot}/stop",)
"""Routes with places of their own in their service, and so here."""
_API: Final = "/api/v1/"
_TIMEOUT: Final = httpx.Timeout(30.0, connect=2.0)
"""As patient as Caddy: a service that hangs must not keep its clients."""
_KEPT: Final = httpx.Limits(max_connections=None, max_keepalive_connections=32, keepalive_expiry=30.0)
"""The app limits the requests; a service ends connections that are idle for a minute."""
_ONE_HOP: Final = frozenset(
    {b"connection", b"keep-alive", b"proxy-authenticate", b"proxy-authorization", b"proxy-connection", b"te"}
    | {b"trailer", b"transfer-encoding", b"upgrade"}
)
"""Headers of one connection (RFC 9110, section 7.6.1)."""
_OURS: Final = frozenset({b"forwarded", b"x-forwarded-for", b"x-forwarded-host", b"x-forwarded-proto", PROOF})
"""What a client may claim, and only the gateway knows."""
_ANEW_ASKED: Final = _OURS | {b"content-length", b"expect"}
_ANEW_ANSWERED: Final = frozenset({b"date", b"server"})
"""What this server says of a message anew."""


_READY_S: Final = 1.0
"""How long a service may take to say whether it is ready."""


class _Readiness(msgspec.Struct):
    ready: bool
    missing: list[str]


class ForwardProblem(ProblemCode):
    """Problems of what is passed on."""

    SERVICE_AWAY = (
        "service_away", 502, "A service does not run: `detail` names it",
        "Try again once it runs: `fognav status` shows it",
    )  # fmt: skip
    SERVICE_SILENT = (
        "service_silent", 504, "A service did not answer in time, or broke off: `detail` names it",
        "Look whether the change was made before you repeat it",
    )  # fmt: skip


def service_of(path: str) -> str:
    """Return the service that has a route of the API, by its path."""
    first = path.removeprefix(_API).partition("/")[0]
    return next((service for service, names in ROUTES.items() if first in names), MAP_SERVICE)


class Forward:
    """The services behind this one, as an ASGI app that has all their routes."""

    def __init__(
        self,
        urls: Mapping[str, str],
        *,
        bridge: str = "",
        proof: bytes = b"",
        trusted: ssl.SSLContext | None = None,
    ) -> None:
        """`urls` are the services' addresses by their names; `proof` lets them believe for whom we ask.

        `bridge` is the address of the bridge, whose WebSockets are passed on, too; empty without one.
        """
        self._urls = urls
        self._proof = proof
        self._merged: tuple[list[bytes], bytes] | None = None
        self._sockets: SocketRelay | None = None
        if bridge:
            self._sockets = SocketRelay(bridge, trusted, ForwardProblem.SERVICE_AWAY)
        self._client = httpx.AsyncClient(
            verify=True if trusted is None else trusted, timeout=_TIMEOUT, limits=_KEPT, trust_env=False
        )

    async def __aenter__(self) -> Self:
        """Return this."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._client.aclose()

    @property
    def names(self) -> list[str]:
        """The services behind this one."""
        return list(self._urls)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and its answer back. Raises `ProblemError`, which the app answers."""
        if scope["type"] == "websocket":
            await self._socket(scope, receive, send)
            return
        request = Request({**scope, "root_path": ""}, receive)
        named = scope["path"].split("/")[1]
        if named in self._urls:
            service, prefix = named, f"/{named}".encode()
        else:
            service, prefix = service_of(scope["path"]), b""
        raw: bytes = scope["raw_path"]
        if service not in self._urls or not raw.startswith(prefix):
            raise _no_route(request)
        if re.fullmatch(r"/api/v1/store(/.*)?", scope["path"]):
            each = ", ".join(f"/{name}/api/v1/store" for name in self._urls)
            raise ProblemError(HttpProblem.NO_ROUTE, f"each service has a store of its own: ask {each}")
        target = raw.removeprefix(prefix) or b"/"
        if scope["query_string"]:
            target += b"?" + scope["query_string"]
        answer = await self.send(service, request, target, await request.body())
        dropped = _of_connection(answer.headers) | _ANEW_ANSWERED
        response = StreamingResponse(_parts(answer), answer.status_code)
        response.raw_headers = [(n.lower(), value) for n, value in answer.headers.raw if n.lower() not in dropped]
        await response(scope, receive, send)

    async def _socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        if self._sockets is not None and service_of(scope["path"]) == BRIDGE:
            await self._sockets(scope, receive, send)
            return
        detail = f"there is no WebSocket at {scope['path']}: only a fog node with a bridge has one, at /api/v1/foxglove"
        await WebSocket(scope, receive, send).send_denial_response(problem(HttpProblem.NO_ROUTE, detail))

    async def send(self, service: str, request: Request, target: bytes, body: bytes) -> httpx.Response:
        """Send a request on to a service, for its caller; return the answer, to be read. Raises `ProblemError`."""
        host = request.client.host if request.client else ""
        dropped = _of_connection(request.headers) | _ANEW_ASKED
        headers = [(name, value) for name, value in request.headers.raw if name not in dropped]
        headers += [
            (b"x-forwarded-for", host.encode("latin-1")),
            (b"x-forwarded-proto", request.scope["scheme"].encode()),
        ]
        if self._proof:
            headers.append((PROOF, self._proof))
        if body or request.method in ("POST", "PUT", "PATCH"):
            headers.append((b"content-length", str(len(body)).encode()))
        made = httpx.Request(
            request.method, self._urls[service], headers=headers, stream=httpx.ByteStream(body),
            extensions={"target": target, "timeout": _TIMEOUT.as_dict()},
        )  # fmt: skip
        try:
            return await self._client.send(made, stream=True)
        except (httpx.ConnectError, httpx.ConnectTimeout) as error:
            detail = (
                f"the {service} does not run, so nothing was changed ({str(error) or 'no connection'}). Try again once "
                f"it does: `fognav status` shows it, `fognav logs {service}` says why it ended"
            )
            raise ProblemError(ForwardProblem.SERVICE_AWAY, detail, headers=RETRY_AFTER, service=service) from error
        except httpx.TransportError as error:
            detail = (
                f"the {service} gave no answer ({str(error) or 'it took too long'}): look whether the change was made "
                "before you repeat it"
            )
            raise ProblemError(ForwardProblem.SERVICE_SILENT, detail, headers=RETRY_AFTER, service=service) from error

    async def readiness(self) -> dict[str, str]:
        """Return what each service lacks that is not ready, by its name: all are asked at once."""
        services = [service for service in self._urls if service != DEMO]
        missing = await asyncio.gather(*(self._missing(service) for service in services))
        return {service: what for service, what in zip(services, missing, strict=True) if what}

    async def _missing(self, service: str) -> str:
        try:
            answer = await self._client.get(f"{self._urls[service]}/readyz", timeout=_READY_S)
            report = msgspec.json.decode(answer.content, type=_Readiness)
        except (httpx.HTTPError, msgspec.MsgspecError) as error:
            return f"it does not answer ({str(error) or type(error).__name__})"
        return "" if report.ready else ", ".join(report.missing)

    async def openapi(self, own: Mapping[str, object]) -> bytes:
        """Return the document of all services, `own` among them. Raises `ProblemError` naming one that does not run."""
        services = [service for service in self._urls if service != DEMO]
        described = await asyncio.gather(*(self._openapi(service) for service in services))
        if self._merged is None or self._merged[0] != described:
            forwarded = (_forwarded(msgspec.json.decode(each, type=dict[str, Any])) for each in described)
            documents = dict(zip(services, forwarded, strict=True))
            self._merged = described, msgspec.json.encode(merged({**documents, CONSOLE: own}))
        return self._merged[1]

    async def _openapi(self, service: str) -> bytes:
        try:
            return (await self._client.get(f"{self._urls[service]}/openapi.json")).raise_for_status().content
        except httpx.HTTPError as error:
            detail = f"the {service} does not describe its routes ({error}): try again once it runs (`fognav status`)"
            raise ProblemError(ForwardProblem.SERVICE_AWAY, detail, headers=RETRY_AFTER, service=service) from error


def _forwarded(described: dict[str, Any]) -> dict[str, Any]:
    """Return a service's document with what this one may answer in its place."""
    for operation in (each for operations in described["paths"].values() for each in operations.values()):
        answers = operation["responses"]
        for code in ForwardProblem:
            answers.setdefault(str(code.status), {**answers["500"], "description": code.says})
    return described


def _no_route(request: Request) -> ProblemError:
    """Return what to say of a request to this service itself, none of whose routes has taken it."""
    if methods := allowed_methods(request):
        detail = f"{request.url.path} has no {request.method}: use one of {', '.join(methods)}"
        return ProblemError(HttpProblem.METHOD_NOT_ALLOWED, detail, headers={"Allow": ", ".join(methods)})
    return ProblemError(HttpProblem.NO_ROUTE, f"there is no {request.url.path}: /api/v1/openapi.json has all routes")


def _of_connection(headers: Mapping[str, str]) -> frozenset[bytes]:
    """Return which of a message's headers are for this connection only."""
    named = headers.get("connection", "").lower().split(",")
    return _ONE_HOP | {name.strip().encode("latin-1") for name in named}


async def _parts(answer: httpx.Response) -> AsyncIterator[bytes]:
    try:
        async for part in answer.aiter_raw():
            yield part
    finally:
        await answer.aclose()
