"""Who asks through a gateway: the client that it names in `X-Forwarded-For`.

Nobody but the gateway is believed, for others could pretend to be many clients, or another one. It is known by its
name: in a network of containers its address changes with each start.
"""

from __future__ import annotations

import asyncio
import math
import socket
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, MutableMapping

    Scope = MutableMapping[str, Any]
    Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
    Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
    App = Callable[[Scope, Receive, Send], Awaitable[None]]
    Resolve = Callable[[str], Awaitable[set[str]]]

KNOWN_S: Final = 10.0
"""For how long an address is believed to be the gateway's."""
AGAIN_S: Final = 1.0
"""How soon the name is looked up again for somebody who is not the gateway."""
_HEADER: Final = b"x-forwarded-for"


async def addresses_of(name: str) -> set[str]:
    """Return the addresses of a name; none if it has none now."""
    try:
        found = await asyncio.get_running_loop().getaddrinfo(name, None, type=socket.SOCK_STREAM)
    except OSError:
        return set()
    return {str(address[0]) for *_, address in found}


class BehindGateway:
    """Gives the app the gateway's client instead of the gateway."""

    def __init__(self, app: App, gateway: str, resolve: Resolve = addresses_of) -> None:
        """`gateway` is its name or address; `resolve` looks a name up."""
        self._app = app
        self._gateway = gateway
        self._resolve = resolve
        self._addresses: set[str] = set()
        self._looked_up = -math.inf

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on."""
        peer = scope.get("client")
        named = _named(scope["headers"]) if scope["type"] == "http" else ""
        if named and peer and await self._is_gateway(peer[0]):
            scope = {**scope, "client": (named, 0)}
        await self._app(scope, receive, send)

    async def _is_gateway(self, address: str) -> bool:
        age = asyncio.get_running_loop().time() - self._looked_up
        if age > (KNOWN_S if address in self._addresses else AGAIN_S):
            self._looked_up = asyncio.get_running_loop().time()
            self._addresses = await self._resolve(self._gateway)
        return address in self._addresses


def _named(headers: Iterable[tuple[bytes, bytes]]) -> str:
    """Return the client that the gateway itself has seen: the last one, after those that the client claims."""
    values = [value for name, value in headers if name == _HEADER]
    return values[-1].decode("latin-1").rpartition(",")[2].strip() if values else ""
