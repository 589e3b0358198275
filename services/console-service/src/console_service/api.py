"""REST under /api/v1 and the page: nothing here changes anything but who is logged in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from console_service.forward import CONSOLE, URGENT, Forward, ForwardProblem
from console_service.page_files import PageFiles
from fog_runtime.clock import SystemClock
from fog_runtime.http import Encoded, Routes, add_session_routes, make_app

if TYPE_CHECKING:
    from fastapi import FastAPI

    from console_service.service import Service
    from fog_runtime.health import Health
    from fog_runtime.http import Tokens

PAGE: Final = Path(__file__).with_name("page")
"""Where a wheel or an image has the built page."""


def make_api(
    service: Service,  # noqa: ARG001  # the events' source
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
