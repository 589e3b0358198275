"""REST under /api/v1 and the page: nothing here changes anything but who is logged in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from console_service.page_files import PageFiles
from fog_runtime.clock import SystemClock
from fog_runtime.http import Routes, add_session_routes, make_app

if TYPE_CHECKING:
    from fastapi import FastAPI

    from console_service.service import Service
    from fog_runtime.health import Health
    from fog_runtime.http import Tokens

PAGE: Final = Path(__file__).with_name("page")
"""Where a wheel or an image has the built page."""


def make_api(service: Service, health: Health, tokens: Tokens, *, page: Path | None = None) -> FastAPI:  # noqa: ARG001  # the events' source
    """Return the app over a running service; `page` is the folder of the built page (None: that of the package)."""
    app = make_app("Fognav console-service", health, tokens, first_page=False)
    add_session_routes(Routes(app, "session"), tokens, SystemClock())
    app.mount("/", PageFiles(page or PAGE))  # last: it takes what no route has
    return app
