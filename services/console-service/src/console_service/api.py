"""REST under /api/v1 and the page: nothing here changes anything but who is logged in."""

import hashlib
import math
from pathlib import Path
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlencode

import msgspec
from fastapi import FastAPI, Header, Query, Request, Response

from console_service.forward import CONSOLE, URGENT, Forward, ForwardProblem
from console_service.page_files import PageFiles
from console_service.readers import EventStream
from console_service.recording import STEP_S, Shown
from console_service.service import Service
from console_service.timeline import ALL_KINDS, TimelineEntry
from console_service.views import VitalsView
from fog_contracts.messages import Id, Message
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.http import (  # fmt: skip
    MAP_UPLOADS,
    Answer,
    ClientHost,
    Encoded,
    HttpProblem,
    ProblemError,
    Routes,
    Tokens,
    Viewer,
    add_session_routes,
    make_app,
    still_admits,
)
from fog_runtime.http.store_routes import PageSize, add_store_errors, next_page
from fog_runtime.stores.records import CursorError
from fog_runtime.stores.redis_connection import StoreError

PAGE: Final = Path(__file__).with_name("page")
"""Where a wheel or an image has the built page."""


Scans = Annotated[
    list[Id], Query(default_factory=list, alias="scan", max_length=4, description="Robots whose scans are wanted, too")
]
LastId = Annotated[str | None, Header(alias="Last-Event-ID", description="Up to where you have read: go on there")]


def make_api(
    service: Service,
    health: Health,
    tokens: Tokens,
    *,
    forward: Forward | None = None,
    page: Path | None = None,
) -> FastAPI:
    """Return the app over a running service.

    `forward` passes on what other services have (None: there are none), `page` is the folder of the built page (None:
    that of the package).
    """
    app = make_app("Fognav console-service", health, tokens, first_page=False, large=MAP_UPLOADS)
    app.state.sockets = True
    session = Routes(app, "session")
    add_session_routes(session, tokens, SystemClock())
    _add_events(Routes(app, "events"), service)
    _add_past(Routes(app, "past"), service)
    forward = forward or Forward({})

    @session.get("/api/v1/openapi.json", problems=[ForwardProblem.SERVICE_AWAY])
    async def openapi() -> Encoded[dict[str, Any]]:
        """Describe the routes of all services, as they are under this address."""
        return Encoded(await forward.openapi(app.openapi()))

    for path in URGENT:
        session.urgent(path)
    for prefix in ("api", *forward.names):
        app.mount(f"/{prefix}", forward)
    app.mount(f"/{CONSOLE}", app.router)  # as the other services are by their names
    app.mount("/", PageFiles(page or PAGE))  # last: it takes what no route has
    return app


def _add_events(routes: Routes, service: Service) -> None:
    path = "/api/v1/events"
    routes.lasting(path)

    @routes.get(path, media_type="text/event-stream")
    async def events(
        request: Request, caller: Viewer, client: ClientHost, scan: Scans, last_event_id: LastId = None
    ) -> Response:
        """Send the state of everything, and each change of it, for as long as you read (ADR 67: its events).

        First `hello`, the present state, `ready`; then what changes. With Last-Event-ID only what has changed since;
        `hello` with `fresh` says: drop what you have. Of what changes faster than you read you get the last state.
        """
        proof = request.headers.get("authorization", "") or request.headers.get("cookie", "")
        session = hashlib.blake2b(proof.encode(), digest_size=8).hexdigest()
        return EventStream(
            service.readers, caller.name, f"{client} {session}", last_event_id, scan,
            lambda: still_admits(request, "viewer"),
        )  # fmt: skip


Kinds = Annotated[
    list[Literal[ALL_KINDS]],  # type: ignore[valid-type]  # values that are made elsewhere
    Query(default_factory=list, alias="kind", description="Only these kinds; without any all"),
]
Begin = Annotated[float, Query(alias="from", description="s since the epoch")]
End = Annotated[float | None, Query(alias="to", description="s since the epoch; now without it")]


class Moments(Message, frozen=True, kw_only=True):
    """What was changed at a time (s since the epoch): events as the stream of events has them."""

    stamp: float
    events: list[dict[str, Any]]


class RecordingView(Message, frozen=True, kw_only=True):
    """What there was: the first frame is the state of its time, each further one what changed until then.

    The recording goes from `begin` to `end` (s since the epoch; null: there is none yet), with a frame every `step_s`.
    `next`: ask from there on for the frames that did not fit.
    """

    begin: float | None
    end: float | None
    step_s: float
    next: float | None
    frames: list[Moments]


def _add_past(routes: Routes, service: Service) -> None:
    add_store_errors(routes)
    routes.raises(
        CursorError,
        [HttpProblem.REQUEST_INVALID],
        lambda error: ProblemError(HttpProblem.REQUEST_INVALID, str(error), field="query.cursor"),
    )

    @routes.get("/api/v1/timeline", raises=[CursorError, StoreError])
    async def timeline(
        _caller: Viewer, kind: Kinds, limit: PageSize, begin: Begin = 0.0, end: End = None, cursor: str | None = None
    ) -> Answer[list[TimelineEntry]]:
        """Return what happened, newest first; the Link header has the next page's address.

        Operators' changes, commands, missions and alerts (as in the audit trail), hazards of areas, and those faults of
        robots that this service has seen since its start.
        """
        page = await service.timeline(kind or ALL_KINDS, begin, end, cursor, limit)
        given = [("kind", each) for each in kind] + [("from", begin)] + ([] if end is None else [("to", end)])
        address = f"/api/v1/timeline?{urlencode(given)}&" if page.next else ""
        link = next_page("/api/v1/timeline", page.next, limit)
        if link and address:
            link = {"Link": link["Link"].replace("/api/v1/timeline?", address, 1)}
        return Answer(page.entries, link)

    @routes.get("/api/v1/vitals/{robot}")
    async def vitals(robot: str, _caller: Viewer) -> list[VitalsView]:
        """Return how a robot did in the last ten minutes, oldest first: CPU, Wi-Fi, battery. Empty: nothing is known.

        What comes later is in the events (`vitals`).
        """
        return service.core.vitals(robot)

    @routes.get("/api/v1/recording")
    async def recording(
        _caller: Viewer, begin: Annotated[float | None, Query(alias="from")] = None, end: End = None
    ) -> Encoded[RecordingView]:
        """Return what the events showed from `from` to `to`, within the last hour; without `from` only how far it goes.

        It is kept in memory, and begins anew with the service and with another map.
        """
        shown, frames = (Shown([], None), b"") if begin is None else await service.show(begin, end or math.inf)
        first, last = service.recording.span or (None, None)
        head = RecordingView(begin=first, end=last, step_s=STEP_S, next=shown.next, frames=[])
        return Encoded(msgspec.json.encode(head).removesuffix(b"[]}") + b"[" + frames + b"]}")
