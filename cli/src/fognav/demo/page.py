"""Leads browsers to a demonstration's console, logged in, and tells the console's page about the scenario.

The address has a secret, because it logs in: only who reads the terminal may operate the demo.
"""

import asyncio
import contextlib
import secrets
import socket
from collections.abc import AsyncIterator
from typing import Any, Final

import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import RedirectResponse

from fog_supervisor import net
from fognav.demo.run import Demo
from fognav.output import WrongUseError

SCENARIO: Final = "/api/v1/scenario"
"""The route of the scenario, which the console-service passes on."""
_STARTING: Final = """\
<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="1">
<link rel="icon" href="data:,"><title>Fognav</title>
<p>The demo is starting. Its console opens here in a moment.</p></html>
"""
_HEADERS: Final = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer"}


def make_app(demo: Demo, secret: str) -> FastAPI:
    """Return the application; it knows the demo's current attempt."""
    app = FastAPI(title="Fognav demo", docs_url=None, redoc_url=None, openapi_url=None)

    @app.get(SCENARIO)
    async def scenario(trail: int = 0) -> dict[str, Any]:
        return demo.scene.scenario_view(trail)

    @app.get("/{name:path}")
    async def console(name: str) -> Response:
        if not secrets.compare_digest(name.encode(), secret.encode()):
            return Response("open the address that the demo printed, as it is", 404, media_type="text/plain")
        login = demo.attempt.console_login()
        if login is None:
            return Response(_STARTING, headers=_HEADERS, media_type="text/html")
        return RedirectResponse(login, 303, _HEADERS)

    return app


@contextlib.asynccontextmanager
async def serve(demo: Demo, port: int = 0) -> AsyncIterator[str]:
    """Serve while the context is open; yields the address that leads to the console. Port 0 chooses a free port.

    Raises `WrongUseError` for a port that is not available.
    """
    chosen = port or net.free_port()
    # Bound here, because uvicorn ends the whole process if it can't bind.
    listening = socket.socket(proto=socket.IPPROTO_TCP)  # named: asyncio then sets TCP_NODELAY
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((net.LOOPBACK, chosen))
    except OSError as error:
        listening.close()
        raise WrongUseError(
            f"the page can't be served on port {chosen} ({error.strerror}): choose another with --page-port, "
            "or omit the option to use any free port"
        ) from error
    secret = secrets.token_urlsafe(16)
    config = uvicorn.Config(
        make_app(demo, secret), host=net.LOOPBACK, port=chosen, log_level="warning", access_log=False, lifespan="off"
    )
    config.timeout_graceful_shutdown = 2
    server = uvicorn.Server(config)
    # The command handles signals itself.
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]  # a context manager too
    task = asyncio.create_task(server.serve([listening]))
    try:
        while not server.started:
            if task.done():
                task.result()
                raise OSError(f"the page's server on port {chosen} ended during its start")
            await asyncio.sleep(0.02)
        yield f"http://{net.LOOPBACK}:{chosen}/{secret}"
    finally:
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)
