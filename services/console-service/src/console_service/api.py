"""REST under /api/v1 and the page: nothing here changes anything but who is logged in."""

import hashlib
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import FastAPI, Header, Query, Request, Response

from console_service.forward import CONSOLE, URGENT, Forward, ForwardProblem
from console_service.page_files import PageFiles
from console_service.readers import EventStream
from console_service.service import Service
from fog_contracts.messages import Id
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from fog_runtime.http import ClientHost, Encoded, Routes, Tokens, Viewer, add_session_routes, make_app, still_admits

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
    app = make_app("Fognav console-service", health, tokens, first_page=False)
    session = Routes(app, "session")
    add_session_routes(session, tokens, SystemClock())
    _add_events(Routes(app, "events"), service)
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
