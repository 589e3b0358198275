"""Serves the files of the built page: strict about what the page may load, and cached where a name has a hash."""

from __future__ import annotations

import asyncio
import gzip
import mimetypes
import re
from typing import TYPE_CHECKING, Final, NamedTuple

from starlette.responses import Response

from fog_runtime.http.problems import HttpProblem, problem

if TYPE_CHECKING:
    from pathlib import Path

    from starlette.types import Receive, Scope, Send

INDEX: Final = "index.html"
ASSETS: Final = "assets/"
"""Files below it have a hash of their content in their names, so that they never change."""
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; font-src 'self'; "
    "connect-src 'self'; worker-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""What the page may load: nothing but its own files, and no code that stands in the page itself."""
_HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
_COMPRESSED: Final = re.compile(r"\.(css|html|js|json|map|svg|txt|webmanifest)$")
NOT_BUILT: Final = """\
Fognav console: the page is not built here (yet). In a checkout `./fognav demo` and `./fognav up` build it once, in the
background, of npm's packages: try again in a minute. If it stays away, this says why:
    .venv/bin/python -m fognav.console_page
The commands (./fognav --help) and REST (/openapi.json, /api/v1/events) work without it.
"""


class _File(NamedTuple):
    state: tuple[int, int]
    data: bytes
    compressed: bytes | None


class PageFiles:
    """The page as an ASGI app: a path without a file name shows the page itself, which knows what it means."""

    def __init__(self, folder: Path) -> None:
        """Serve a folder, which need not exist: then a sentence says that the page is not built."""
        self._folder = folder.resolve()
        self._read: dict[Path, _File] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request for a file."""
        path = scope["path"].removeprefix(scope.get("root_path", "")).lstrip("/")
        if scope["type"] != "http":
            await send({"type": "websocket.close"})
            return
        if path.startswith("api/"):
            response: Response = problem(HttpProblem.NO_ROUTE, f"there is no route /{path}: /openapi.json lists them")
        elif scope["method"] not in ("GET", "HEAD"):
            response = problem(HttpProblem.METHOD_NOT_ALLOWED, "files can be read only", headers={"Allow": "GET, HEAD"})
        else:
            accepted = next((value for name, value in scope["headers"] if name == b"accept-encoding"), b"")
            response = await asyncio.to_thread(self._response, path, compress=b"gzip" in accepted)
        await response(scope, receive, send)

    def _response(self, path: str, *, compress: bool) -> Response:
        name = path if "." in path.rpartition("/")[2] else INDEX
        file = (self._folder / name).resolve()
        found = self._file(file) if file.is_relative_to(self._folder) else None
        if found is None:
            if name == INDEX:
                return Response(NOT_BUILT, media_type="text/plain", headers=_HEADERS)
            return problem(HttpProblem.NO_ROUTE, f"there is no file /{path}")
        kept = "public, max-age=31536000, immutable" if name.startswith(ASSETS) else "no-cache"
        headers = {**_HEADERS, "Cache-Control": kept, "Vary": "Accept-Encoding"}
        kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
        if compress and found.compressed is not None:
            return Response(found.compressed, headers={**headers, "Content-Encoding": "gzip"}, media_type=kind)
        return Response(found.data, headers=headers, media_type=kind)

    def _file(self, file: Path) -> _File | None:
        """Return a file as it is now; None if there is none."""
        try:
            status = file.stat()
            state = (status.st_mtime_ns, status.st_size)
            known = self._read.get(file)
            if known is None or known.state != state:
                data = file.read_bytes()
                known = _File(state, data, gzip.compress(data, 9) if _COMPRESSED.search(file.name) else None)
                self._read[file] = known
        except OSError:
            return None
        return known
