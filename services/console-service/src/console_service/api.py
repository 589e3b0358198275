"""REST under /api/v1 and the page: nothing here changes anything but who is logged in."""

import asyncio
import hashlib
import math
from pathlib import Path
from typing import Annotated, Any, Final, Literal
from urllib.parse import urlencode

import msgspec
from fastapi import FastAPI, Header, Query, Request, Response

from console_service.floors import FloorEntry, FloorStop, FloorView, Hub, OwnFloor
from console_service.forward import CONSOLE, URGENT, Forward, ForwardProblem
from console_service.page_files import PageFiles
from console_service.readers import EventStream
from console_service.recording import STEP_S, Shown
from console_service.service import Service
from console_service.timeline import ALL_KINDS, TimelineEntry
from console_service.views import VitalsView
from fog_contracts.messages import Id, Message
from fog_runtime import logs
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.http import (  # fmt: skip
    MAP_UPLOADS,
    Answer,
    Anybody,
    Body,
    ClientHost,
    Encoded,
    HttpProblem,
    ProblemCode,
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

_log = logs.get("console-service")

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
    hub: Hub | None = None,
    page: Path | None = None,
) -> FastAPI:
    """Return the app over a running service.

    `forward` passes on what other services have (None: there are none), `hub` knows the floors on other machines,
    `page` is the folder of the built page (None: that of the package).
    """
    app = make_app("Fognav console-service", health, tokens, first_page=False, large=MAP_UPLOADS)
    app.state.sockets = True
    session = Routes(app, "session")
    add_session_routes(session, tokens, SystemClock())
    _add_events(Routes(app, "events"), service)
    _add_past(Routes(app, "past"), service)
    forward = forward or Forward({})
    own = OwnFloor(service.core, forward, health, service.now)
    _add_floors(Routes(app, "floors"), own, hub or Hub([], SystemClock()))

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
            service.readers, caller.asker, f"{client} {session}", last_event_id, scan,
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


class FloorProblem(ProblemCode):
    """Problems of several floors."""

    NO_FLOOR = "no_floor", 404, "There is no such floor", "Choose one that GET /api/v1/floors lists"


class FloorsBody(Message, frozen=True, kw_only=True):
    """Which floors to stop; null: all."""

    floors: list[Id] | None = None


def _add_floors(routes: Routes, own: OwnFloor, hub: Hub) -> None:
    for path in ("/api/v1/floors/here/stop", "/api/v1/floors/stop"):
        routes.urgent(path)

    @routes.get("/api/v1/floors/here")
    async def here(_caller: Viewer) -> FloorView:
        """Return how this floor is: its services, robots, hazards, and whether it is stopped."""
        return await own.view()

    @routes.post("/api/v1/floors/here/stop")
    async def stop_here(request: Request, _caller: Anybody) -> FloorStop:
        """Stop all robots of this floor at once. Anybody may, as with one robot. An operator must enable them again."""
        return await own.stop(request)

    @routes.get("/api/v1/floors")
    async def floors(_caller: Viewer) -> list[FloorEntry]:
        """List this floor and those on other machines, with the age of what is known of each."""
        view = await own.view()
        this = FloorEntry(
            id=own.id, address="", reachable=True, age_s=0.0, heard=None, trouble="", detail="", floor=view
        )
        return [this, *hub.entries()]

    @routes.post("/api/v1/floors/stop", problems=[FloorProblem.NO_FLOOR])
    async def stop(request: Request, body: Body[FloorsBody], caller: Viewer) -> list[FloorStop]:
        """Stop floors, all at once, each once; say which have acknowledged it, and what to do about the others."""
        known = [own.id, *hub.ids]
        wanted = known if body.floors is None else list(dict.fromkeys(body.floors))
        if missing := [floor for floor in wanted if floor not in known]:
            detail = f"there is no floor {missing[0]}; known floors: {', '.join(known)}. Nothing was stopped"
            raise ProblemError(FloorProblem.NO_FLOOR, detail, field="body.floors")
        stops = await asyncio.gather(
            *(own.stop(request) if each == own.id else hub.stop(each, caller.name) for each in wanted)
        )
        failed = [each.id for each in stops if not each.acknowledged]
        _log.warning("floors_stopped", who=caller.name, floors=wanted, not_acknowledged=failed)
        return list(stops)


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
