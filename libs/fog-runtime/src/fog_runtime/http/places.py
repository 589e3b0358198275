"""How many requests are served at the same time, in all and of each client: further ones are answered with 503.

A request takes its place once it is complete: who begins many and never ends them takes none. Who sends many that take
long takes the places of one client, not all. Stops have places of their own, which no other request takes, and each
robot's its own: nobody keeps one from being stopped by stopping others, which may not answer.
"""

from __future__ import annotations

import sys
from collections import Counter
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from fog_runtime.admission import source_of
from fog_runtime.http.problems import RETRY_AFTER, problem
from fog_runtime.http.routes import ALWAYS_SERVED

if TYPE_CHECKING:
    import re
    from collections.abc import Awaitable, Callable, Iterator, Mapping, MutableMapping

    Scope = MutableMapping[str, Any]
    Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
    Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
    App = Callable[[Scope, Receive, Send], Awaitable[None]]

MAX_OPEN: Final = 128
"""Most requests that are served at the same time."""
MAX_OF_CLIENT: Final = 64
"""Most of them of one client, by its address."""
MAX_URGENT: Final = 256
MAX_URGENT_OF_PATH: Final = 16
MAX_HEALTH_OF_CLIENT: Final = 8
"""Most requests of one client for health and metrics, which have places for every client."""


class Places:
    """The requests of one kind that are open."""

    def __init__(self, limit: int, of_each: int, what: str) -> None:
        """`of_each` of them are for each client, or each path; `what` they are in words."""
        self._limit = limit
        self._of_each = of_each
        self._what = what
        self._open: Counter[str] = Counter()

    def refusal(self, whose: str) -> str:
        """Return why a further request can't be served; empty if it can."""
        if self._open.total() >= self._limit:
            return f"{self._limit} requests are being served: try again"
        if self._open[whose] >= self._of_each:
            return f"{self._of_each} {self._what} are being served: try again once some are answered"
        return ""

    @contextmanager
    def taken(self, whose: str) -> Iterator[None]:
        """Take a place while entered."""
        self._open[whose] += 1
        try:
            yield
        finally:
            self._open[whose] -= 1
            if not self._open[whose]:
                del self._open[whose]


class OpenLimit:
    """Serves only so many requests at the same time."""

    def __init__(self, app: App, urgent: Mapping[str, re.Pattern[str]]) -> None:
        """`urgent` are the paths of requests with places of their own."""
        self._app = app
        self._urgent_paths = urgent
        self._usual = Places(MAX_OPEN, MAX_OF_CLIENT, "of your requests")
        self._urgent = Places(MAX_URGENT, MAX_URGENT_OF_PATH, "such requests")
        self._health = Places(sys.maxsize, MAX_HEALTH_OF_CLIENT, "of your requests")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        path, whose = scope["path"], _client(scope)
        if any(pattern.fullmatch(path) for pattern in self._urgent_paths.values()):
            places, whose = self._urgent, path
        else:
            places = self._health if path in ALWAYS_SERVED else self._usual
        if refusal := places.refusal(whose):
            # Who goes on must connect again, which `admission` paces.
            await problem(503, refusal, headers={**RETRY_AFTER, "Connection": "close"})(scope, receive, send)
            return
        with places.taken(whose):
            await self._app(scope, receive, send)


def _client(scope: Scope) -> str:
    """Return what counts as one client; a client that has no address (in tests) is named otherwise."""
    host: str = (scope.get("client") or ("",))[0]
    try:
        return source_of(host)
    except ValueError:
        return host
