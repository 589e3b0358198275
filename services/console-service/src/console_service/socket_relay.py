"""Passes WebSockets on to the bridge, which checks the caller itself, as each service does."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus, InvalidURI
from websockets.typing import Subprotocol

from fog_runtime.http.problems import RETRY_AFTER, ProblemCode, problem

if TYPE_CHECKING:
    import ssl

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
