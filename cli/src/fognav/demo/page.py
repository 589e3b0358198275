"""Serves a demonstration to browsers on loopback: the page, the map as an image, the scene as a stream of events."""

import asyncio
import contextlib
import io
import json
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Final

import numpy as np
import uvicorn
from fastapi import FastAPI, Response
from fastapi.responses import FileResponse, StreamingResponse
from PIL import Image

from fog_contracts.costs import FREE, UNKNOWN
from fog_contracts.grid import StaticMap
from fog_supervisor import net
from fognav.demo.run import Demo
from fognav.output import WrongUseError

_STATIC: Final = Path(__file__).parent / "static"
_PERIOD_S: Final = 0.15
_FILES: Final = {"": "index.html", "app.js": "app.js", "style.css": "style.css"}
_POLICY: Final = "default-src 'self'; img-src 'self' data:; style-src 'self'; script-src 'self'"


def map_png(static: StaticMap) -> bytes:
    """Encode the map as a PNG with one channel, 0 free, 1 occupied, 2 unknown; the image's first row is the map's top.

    The page adds the colours, for its light and dark themes.
    """
    kinds = np.ones(static.cells.shape, dtype=np.uint8)
    kinds[static.cells == FREE] = 0
    kinds[static.cells == UNKNOWN] = 2
    buffer = io.BytesIO()
    Image.fromarray(np.flipud(kinds)).save(buffer, "PNG")
    return buffer.getvalue()


def make_app(demo: Demo, closing: asyncio.Event) -> FastAPI:
    """Return the page's application; it shows the demo's current attempt until `closing` is set."""
    app = FastAPI(title="Fognav demo", docs_url=None, redoc_url=None, openapi_url=None)
    png = map_png(demo.site.map)

    @app.get("/map.png")
    async def map_image() -> Response:
        return Response(png, media_type="image/png")

    @app.get("/scene.json")
    async def static_scene() -> dict[str, object]:
        return demo.scene.static_view()

    @app.get("/events")
    async def events() -> StreamingResponse:
        return StreamingResponse(
            _stream(demo, closing), media_type="text/event-stream", headers={"Cache-Control": "no-store"}
        )

    @app.get("/{name:path}")
    async def static(name: str) -> Response:
        file = _FILES.get(name)
        if file is None:
            return Response(f"there is no page {name}", status_code=404, media_type="text/plain")
        return FileResponse(_STATIC / file, headers={"Content-Security-Policy": _POLICY, "Cache-Control": "no-cache"})

    return app


async def _stream(demo: Demo, closing: asyncio.Event) -> AsyncIterator[str]:
    """Send the whole changing part of the scene periodically; only the trail is sent incrementally."""
    trail_from = 0
    scene = demo.scene
    while not closing.is_set():
        if scene is not demo.scene:
            scene, trail_from = demo.scene, 0
        view = scene.live_view()
        trail = list(scene.trail)
        # The deque drops its oldest points; a browser that has received them keeps them.
        view["trail_from"] = trail_from
        view["trail"] = trail[trail_from:]
        trail_from = len(trail)
        yield f"data: {json.dumps(view, separators=(',', ':'))}\n\n"
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(closing.wait(), _PERIOD_S)


@contextlib.asynccontextmanager
async def serve(demo: Demo, port: int = 0) -> AsyncIterator[str]:
    """Serve the page while the context is open; yields its address. Port 0 chooses a free port.

    Raises `WrongUseError` for a port that is not available.
    """
    chosen = port or net.free_port()
    # Bound here, because uvicorn ends the whole process if it can't bind.
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((net.LOOPBACK, chosen))
    except OSError as error:
        listening.close()
        raise WrongUseError(
            f"the page can't be served on port {chosen} ({error.strerror}): choose another with --page-port, "
            "or omit the option to use any free port"
        ) from error
    closing = asyncio.Event()
    config = uvicorn.Config(
        make_app(demo, closing), host=net.LOOPBACK, port=chosen, log_level="warning", access_log=False, lifespan="off"
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
        yield f"http://{net.LOOPBACK}:{chosen}/"
    finally:
        # Ends the streams: uvicorn would cancel open ones with a warning.
        closing.set()
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)
