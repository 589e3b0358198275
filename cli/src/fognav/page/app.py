"""Serves the page, the map as a picture, and the scene as a stream of events, on the loopback address."""

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
from fog_runtime.maps import StaticMap
from fog_supervisor import net
from fognav.demo.run import Demo
from fognav.output import WrongUseError

_STATIC: Final = Path(__file__).parent / "static"
_PERIOD_S: Final = 0.15
_FILES: Final = {"": "index.html", "app.js": "app.js", "style.css": "style.css"}
_POLICY: Final = "default-src 'self'; img-src 'self' data:; style-src 'self'; script-src 'self'"


def map_png(static: StaticMap) -> bytes:
    """Draw the map as a PNG with one channel that says what a cell is: 0 free, 1 occupied, 2 unknown; row 0 on top.

    The page gives it its colours, so that it fits a light and a dark page.
    """
    kinds = np.ones(static.cells.shape, dtype=np.uint8)
    kinds[static.cells == FREE] = 0
    kinds[static.cells == UNKNOWN] = 2
    buffer = io.BytesIO()
    Image.fromarray(np.flipud(kinds)).save(buffer, "PNG")
    return buffer.getvalue()


def make_app(demo: Demo, closing: asyncio.Event) -> FastAPI:
    """Return the page's application; it shows whatever attempt the demo is at, until `closing` is set."""
    app = FastAPI(title="Fognav demo", docs_url=None, redoc_url=None, openapi_url=None)
    picture = map_png(demo.site.map)

    @app.get("/map.png")
    async def map_picture() -> Response:
        return Response(picture, media_type="image/png")

    @app.get("/scene.json")
    async def still() -> dict[str, object]:
        return demo.scene.still()

    @app.get("/events")
    async def events() -> StreamingResponse:
        return StreamingResponse(
            _stream(demo, closing), media_type="text/event-stream", headers={"Cache-Control": "no-store"}
        )

    @app.get("/{name:path}")
    async def static(name: str) -> Response:
        file = _FILES.get(name)
        if file is None:
            return Response(f"there is no {name} here", status_code=404, media_type="text/plain")
        return FileResponse(_STATIC / file, headers={"Content-Security-Policy": _POLICY, "Cache-Control": "no-cache"})

    return app


async def _stream(demo: Demo, closing: asyncio.Event) -> AsyncIterator[str]:
    """Send the whole moving scene again and again: a browser that lost some needs no history."""
    trail_from = 0
    scene = demo.scene
    while not closing.is_set():
        if scene is not demo.scene:
            scene, trail_from = demo.scene, 0
        moving = scene.moving()
        trail = list(scene.trail)
        # The deque forgets its oldest points; a browser that has seen them keeps them.
        moving["trail_from"] = trail_from
        moving["trail"] = trail[trail_from:]
        trail_from = len(trail)
        yield f"data: {json.dumps(moving, separators=(',', ':'))}\n\n"
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(closing.wait(), _PERIOD_S)


@contextlib.asynccontextmanager
async def serve(demo: Demo, port: int = 0) -> AsyncIterator[str]:
    """Serve the page beside the body; yields its address. Port 0 takes a free one.

    Raises `WrongUseError` for a port that can't be had.
    """
    chosen = port or net.free_port()
    # Bound here: uvicorn would end the whole process when it can't.
    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((net.LOOPBACK, chosen))
    except OSError as error:
        listening.close()
        raise WrongUseError(
            f"the page can't be served on port {chosen} ({error.strerror}): choose another with --page-port, "
            "or leave it out for any that is free"
        ) from error
    closing = asyncio.Event()
    config = uvicorn.Config(
        make_app(demo, closing), host=net.LOOPBACK, port=chosen, log_level="warning", access_log=False, lifespan="off"
    )
    config.timeout_graceful_shutdown = 2
    server = uvicorn.Server(config)
    # The command handles its signals itself.
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]  # a context manager too
    task = asyncio.create_task(server.serve([listening]))
    try:
        while not server.started:
            if task.done():
                task.result()
                raise OSError(f"the server of the page on port {chosen} ended before it had begun")
            await asyncio.sleep(0.02)
        yield f"http://{net.LOOPBACK}:{chosen}/"
    finally:
        # A stream that ends by itself; uvicorn would cancel one that goes on, and complain.
        closing.set()
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)
