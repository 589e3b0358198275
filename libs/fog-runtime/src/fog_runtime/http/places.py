"""How many requests are served at the same time, in all and of each client: further ones are answered with 503.

Who opens many requests and never ends them (a body that comes byte by byte) takes the places of one client, not all.
Stops have places of their own, which no other request takes.
"""

from __future__ import annotations

from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from fog_runtime.http.problems import RETRY_AFTER, problem
from fog_runtime.http.routes import ALWAYS_SERVED

if TYPE_CHECKING:
    import re
    from collections.abc import Awaitable, Callable, Collection, Iterator, MutableMapping

    Scope = MutableMapping[str, Any]
    Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
    Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
    App = Callable[[Scope, Receive, Send], Awaitable[None]]

MAX_OPEN: Final = 128
"""Most requests that are served at the same time."""
MAX_OF_CLIENT: Final = 64
"""Most of them of one client, by its address."""
MAX_URGENT: Final = 64
MAX_URGENT_OF_CLIENT: Final = 16


class Places:
    """The requests of one kind that are open."""

    def __init__(self, limit: int, of_client: int) -> None:
        self._limit = limit
        self._of_client = of_client
        self._open: Counter[str] = Counter()

    def refusal(self, client: str) -> str:
        """Return why a further request of a client can't be served; empty if it can."""
        if self._open.total() >= self._limit:
            return f"{self._limit} requests are being served: try again"
        if self._open[client] >= self._of_client:
            return f"{self._of_client} of your requests are being served: try again once some are answered"
        return ""

    @contextmanager
    def taken(self, client: str) -> Iterator[None]:
        """Take a place while entered."""
        self._open[client] += 1
        try:
            yield
        finally:
            self._open[client] -= 1
            if not self._open[client]:
                del self._open[client]


class OpenLimit:
    """Serves only so many requests at the same time. Health and metrics are always served."""

    def __init__(self, app: App, urgent: Collection[re.Pattern[str]]) -> None:
        """`urgent` are the paths of requests with places of their own."""
        self._app = app
        self._urgent_paths = urgent
        self._usual = Places(MAX_OPEN, MAX_OF_CLIENT)
        self._urgent = Places(MAX_URGENT, MAX_URGENT_OF_CLIENT)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] != "http" or scope["path"] in ALWAYS_SERVED:
            await self._app(scope, receive, send)
            return
        urgent = any(path.fullmatch(scope["path"]) for path in self._urgent_paths)
        places, client = self._urgent if urgent else self._usual, (scope.get("client") or ("",))[0]
        if refusal := places.refusal(client):
            await problem(503, refusal, headers=RETRY_AFTER)(scope, receive, send)
            return
        with places.taken(client):
            await self._app(scope, receive, send)
