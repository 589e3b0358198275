"""Serving an app on a socket until the process ends."""

import asyncio
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import uvicorn
from fastapi import FastAPI

from fog_runtime import logs
from fog_runtime.files import write_port_file

_log = logs.get("http")


class _Server(uvicorn.Server):
    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone: `fog_runtime.process` handles them."""
        yield


async def serve(app: FastAPI, host: str = "127.0.0.1", port: int = 0, port_file: Path | None = None) -> None:
    """Serve until cancelled; the port (0: any free one) is logged as `listening` and written to `port_file`.

    Open requests get 2 s to end. Raises `OSError` when the port is taken.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=128) as listener:
        chosen = int(listener.getsockname()[1])
        config = uvicorn.Config(
            app, log_config=None, access_log=False, lifespan="off", timeout_graceful_shutdown=2, server_header=False
        )
        server = _Server(config)
        task = asyncio.create_task(server.serve(sockets=[listener]), name=f"http {chosen}")
        try:
            _log.info("listening", url=f"http://{host}:{chosen}", port=chosen)
            write_port_file(port_file, chosen)
            await asyncio.shield(task)
        finally:
            server.should_exit = True
            await asyncio.gather(task, return_exceptions=True)
