"""The base of every service's REST interface: health, metrics, problem documents, roles, limits, OpenAPI."""

import asyncio
import re
import sys
from collections import Counter
from collections.abc import Awaitable, Callable, Collection, Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager
from typing import Any, Final, Literal

import msgspec
from fastapi import FastAPI, Request, Response

from fog_contracts.messages import Message
from fog_runtime import metrics
from fog_runtime.admission import source_of
from fog_runtime.health import Health
from fog_runtime.http.problems import RETRY_AFTER, HttpProblem, add_problem_handlers, problem
from fog_runtime.http.routes import ALWAYS_SERVED, Answer, Routes
from fog_runtime.http.tokens import Tokens, still_admits
from fog_runtime.version import VERSION

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
    """Serves only so many requests at the same time.

    A request takes its place once it is complete: who begins many and never ends them takes none. Who sends many that
    take long takes the places of one client, not all. Stops have places of their own, which no other request takes, and
    each robot's its own: nobody keeps one from being stopped by stopping others, which may not answer.
    """

    def __init__(self, app: App, urgent: Mapping[str, re.Pattern[str]], lasting: Collection[str] = ()) -> None:
        """`urgent` are the paths of requests with places of their own; their routes count those in `lasting`."""
        self._app = app
        self._urgent_paths = urgent
        self._lasting = lasting
        self._usual = Places(MAX_OPEN, MAX_OF_CLIENT, "of your requests")
        self._urgent = Places(MAX_URGENT, MAX_URGENT_OF_PATH, "such requests")
        self._health = Places(sys.maxsize, MAX_HEALTH_OF_CLIENT, "of your requests")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] != "http" or scope["path"] in self._lasting:
            await self._app(scope, receive, send)
            return
        path, whose = scope["path"], _client(scope)
        if any(pattern.fullmatch(path) for pattern in self._urgent_paths.values()):
            places, whose = self._urgent, path
        else:
            places = self._health if path in ALWAYS_SERVED else self._usual
        if refusal := places.refusal(whose):
            # Who goes on must connect again, which `admission` paces.
            headers = {**RETRY_AFTER, "Connection": "close"}
            await problem(HttpProblem.OVERLOADED, refusal, headers=headers)(scope, receive, send)
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


BODY_LIMIT: Final = 1024 * 1024
MAP_UPLOAD: Final = "/api/v1/map/preview"
MAP_UPLOADS: Final[Mapping[str, int]] = {MAP_UPLOAD: 8 * 1024 * 1024}
"""A map's picture in base64 needs more than other bodies. What passes requests on lets as much through."""
_DRAINED: Final = 16 * BODY_LIMIT
"""So much of a body beyond the limit is read and discarded."""

BODY_S: Final = 10.0
"""How long a body may take to arrive ..."""
LARGE_BODY_S: Final = 60.0
"""... and one on a route for large ones."""
_LARGE_AT_ONCE: Final = 2


class _BodyLimit:
    """Reads a request's body, up to the limit, before the app runs, so that no handler has to hold more.

    Routes for large bodies take them of administrators only, and few at the same time.
    """

    def __init__(self, app: App, limit: int, large: Mapping[str, int]) -> None:
        self._app = app
        self._limit = limit
        self._large = large
        self._places = Places(_LARGE_AT_ONCE, 1, "of your large requests")

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._large.get(scope["path"], 0)
        if not limit or scope["method"] != "POST" or not still_admits(Request(scope), "admin"):
            await self._limited(scope, receive, send, self._limit, BODY_S)
        elif refusal := self._places.refusal(whose := _client(scope)):
            headers = {**RETRY_AFTER, "Connection": "close"}
            await problem(HttpProblem.OVERLOADED, refusal, headers=headers)(scope, receive, send)
        else:
            with ExitStack() as place:
                place.enter_context(self._places.taken(whose))

                async def told(message: MutableMapping[str, Any]) -> None:
                    if message["type"] == "http.response.body" and not message.get("more_body", False):
                        place.close()  # before the client knows the answer, and sends the next one
                    await send(message)

                await self._limited(scope, receive, told, limit, LARGE_BODY_S)

    async def _limited(  # an ASGI app's arguments, and the limits
        self, scope: Scope, receive: Receive, send: Send, limit: int, seconds: float
    ) -> None:
        try:
            async with asyncio.timeout(seconds):
                body, refusal = await _read(receive, limit)
        except TimeoutError:
            detail = f"the body did not arrive within {seconds:.0f} s"
            slow = problem(HttpProblem.BODY_SLOW, detail, headers={"Connection": "close"})
            await slow(scope, receive, send)
            return
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        if body is None:
            return
        replayed = False

        async def replay() -> MutableMapping[str, Any]:
            nonlocal replayed
            if replayed:
                return await receive()
            replayed = True
            return {"type": "http.request", "body": body, "more_body": False}

        await self._app(scope, replay, send)


async def _read(receive: Receive, limit: int) -> tuple[bytes | None, Response | None]:
    """Return the body, or None when the client disconnected, or the answer to one that is too large."""
    body = bytearray()
    size = 0
    more = True
    # The excess of a body is read for a while and discarded: a client whose connection is closed while it sends
    # sees a reset connection instead of the response.
    while more and size <= limit + _DRAINED:
        message = await receive()
        if message["type"] != "http.request":
            return None, None
        part = message.get("body", b"")
        size += len(part)
        more = message.get("more_body", False)
        if size <= limit:
            body += part
    if size > limit:
        headers = {"Connection": "close"} if more else None
        detail = f"the body has more than {limit} bytes"
        return None, problem(HttpProblem.BODY_TOO_LARGE, detail, headers=headers)
    return bytes(body), None


class Alive(Message, frozen=True, kw_only=True):
    """The process runs."""

    status: Literal["ok"] = "ok"


class Part(Message, frozen=True, kw_only=True):
    """A condition of readiness: whether it is met, and if not, why."""

    ok: bool
    detail: str


class Readiness(Message, frozen=True, kw_only=True):
    """Whether the process can do its work, the names of the unmet conditions, and every condition."""

    ready: bool
    missing: list[str]
    parts: dict[str, Part]


class Leads(Message, frozen=True, kw_only=True):
    """Whether this copy takes requests, and if not, why."""

    leads: bool
    detail: str


def _add_health(routes: Routes, health: Health, standby: Callable[[], str]) -> None:
    @routes.get("/healthz")
    async def healthz() -> Alive:
        """Whether the process runs."""
        return Alive()

    @routes.get("/readyz", status=(200, 503))
    async def readyz() -> Answer[Readiness]:
        """Whether the process can do its work; 503 names what is missing."""
        report = msgspec.convert(health.report(), Readiness)
        return Answer(report, status=200 if report.ready else 503)

    @routes.get("/leads", status=(200, 503))
    async def leads() -> Answer[Leads]:
        """Whether requests belong here; 503 while this copy stands by, so that a gateway asks the other one."""
        reason = standby()
        return Answer(Leads(leads=not reason, detail=reason), status=503 if reason else 200)

    @routes.get("/metrics", media_type="text/plain")
    async def prometheus() -> Response:
        """Metrics for Prometheus."""
        text, kind = metrics.exposition()
        return Response(text, media_type=kind)


def make_app(  # noqa: PLR0913  # what apps have in common, each by name
    title: str, health: Health, tokens: Tokens, *, body_limit: int = BODY_LIMIT, standby: Callable[[], str] = str,
    first_page: bool = True, large: Mapping[str, int] | None = None,
) -> FastAPI:  # fmt: skip
    """Build an app with health, metrics, problem documents, roles and a body limit; OpenAPI is at /openapi.json.

    While `standby` returns a reason, routes that write answer 503 with it. Without `first_page`, `/` is the caller's.
    `large` are the paths to which administrators POST larger bodies, with their limits.
    """
    # FastAPI's interactive pages would load scripts from the internet.
    app = FastAPI(title=title, version=VERSION, docs_url=None, redoc_url=None)
    app.state.tokens = tokens
    app.state.schemas = {}
    app.state.standby = standby
    app.state.endpoints = {}
    app.state.core = None
    app.state.urgent = {}
    app.state.lasting = set()
    app.state.sockets = False
    app.state.problems = {HttpProblem.NO_ROUTE, HttpProblem.METHOD_NOT_ALLOWED}
    add_problem_handlers(app)
    _add_health(Routes(app, "health"), health, standby)

    async def about() -> Response:  # for people who open the address
        text = f"{title}. Its routes: /openapi.json; is it ready: /readyz; its measurements: /metrics\n"
        return Response(text, media_type="text/plain")

    if first_page:
        app.get("/", include_in_schema=False)(about)

    app.add_middleware(OpenLimit, urgent=app.state.urgent, lasting=app.state.lasting)
    # Before it: who sends no whole body takes no place.
    app.add_middleware(_BodyLimit, limit=body_limit, large=large or {})
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            described = generate()
            described.setdefault("components", {}).setdefault("schemas", {}).update(app.state.schemas)
            described["x-problems"] = {
                code: {"status": code.status, "says": code.says, "remedy": code.remedy}
                for code in sorted(app.state.problems)
            }
            app.openapi_schema = described
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend the schema
    return app
