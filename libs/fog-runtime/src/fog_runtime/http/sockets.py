"""WebSockets of an app: connections that `Admission` knows, and denials that say why."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, Final

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

if TYPE_CHECKING:
    from fog_runtime.admission import Visitor

_quiet = logging.getLogger("uvicorn.error.sockets")
# It would log each connection with its query, in which there may be a token.
_quiet.setLevel(logging.WARNING)
CLOSE_S: Final = 2.0
"""How long a client may take to read what was sent before the end."""


class Socket(WebSocketsSansIOProtocol):
    """A WebSocket is a stranger's connection until the app accepts it."""

    def __init__(self, visitor: Visitor, **options: Any) -> None:  # noqa: ANN401  # uvicorn's own
        super().__init__(**options)
        self._visitor = visitor
        self.logger = _quiet

    async def send(self, message: Any) -> None:  # noqa: ANN401  # ASGI's union of dicts
        """Pass a message on to the client."""
        await super().send(message)
        if message["type"] == "websocket.accept":
            self._visitor.admit()
        elif message["type"] == "websocket.http.response.body":
            self.handshake_complete = True  # else uvicorn complains of each denial

    async def run_asgi(self) -> None:
        """Run the app; whoever has not read the rest soon after its end never gets it."""
        await super().run_asgi()
        self.loop.call_later(CLOSE_S, self.transport.abort)

    def keepalive_timeout(self) -> None:
        """End the connection of a client that does not read: uvicorn would wait until it does."""
        super().keepalive_timeout()
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Let its place go."""
        self._visitor.left()
        super().connection_lost(exc)
