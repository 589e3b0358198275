"""Serves the page of a robot's own computer: its scan and state live, a pad to drive it by hand, and its bring-up.

Each page is a client of the agent of its own. What it says is passed on as it comes, and nothing is said that it did
not say: the agent's dead man's switch stops the robot when the link to the page breaks. A link that is slow does not
lengthen it: a page that drives is told the time, and a speed that echoes an old one is passed on as a stop.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import secrets
import socket
import time
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import uvicorn
from fastapi import FastAPI, Response, WebSocket, WebSocketDisconnect
from fastapi.responses import FileResponse

from fognav.output import WrongUseError, print_line
from fognav.robot_page.bringup import BringupView, Mount
from fognav.robot_page.view import LocalRobotErrors, RobotView
from robot_agent.agent.hand_driving import HandBack, HandReply, HandRequest, ResetFault, Steer, TakeOver
from robot_agent.local_client import LocalRobot, LocalRobotError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_STATIC: Final = Path(__file__).parent / "static"
_FILES: Final = {"": "index.html", **{name: name for name in ("page.js", "bringup.js", "page.css")}}
_POLICY: Final = "default-src 'none'; connect-src 'self'; style-src 'self'; script-src 'self'; img-src 'self'"
_REFUSED: Final = 4401
_PAGES_MAX: Final = 4
_LOOPBACK: Final = frozenset({"127.0.0.1", "::1"})

_TICK_S: Final = 0.05
_LATE_S: Final = 0.3
"""A speed counts as a stop if it echoes what the page was told longer ago."""


class _PageSteer(Steer, frozen=True, tag="steer", kw_only=True):
    """A speed that a page wants; `tick` is the newest that it was told (ms of the server's monotonic clock)."""

    tick: int


_requests = msgspec.json.Decoder(TakeOver | HandBack | ResetFault | _PageSteer | Mount)


def make_app(path: Path, token: str, view: Callable[[], RobotView] = RobotView) -> FastAPI:
    """Return the page's application for the agent at this socket; who has no `token` sees and drives nothing.

    view: makes what each page sees.
    """
    app = FastAPI(title="Fognav robot", docs_url=None, redoc_url=None, openapi_url=None)
    open_pages: set[WebSocket] = set()

    @app.websocket("/live")
    async def live(page: WebSocket) -> None:
        await page.accept()
        known = hmac.compare_digest(page.query_params.get("token", "").encode(), token.encode())
        if not known or len(open_pages) >= _PAGES_MAX:
            reason = "too many pages are open" if known else "open the address that the command printed"
            await page.close(_REFUSED, reason)
            return
        open_pages.add(page)
        try:
            await _Session(page, path, view()).run()
        finally:
            open_pages.discard(page)

    @app.get("/{name:path}")
    async def static(name: str) -> Response:
        file = _FILES.get(name)
        if file is None:
            return Response(f"there is no page {name}", status_code=404, media_type="text/plain")
        headers = {"Content-Security-Policy": _POLICY, "Cache-Control": "no-cache", "Referrer-Policy": "no-referrer"}
        return FileResponse(_STATIC / file, headers=headers)

    return app


class _Session:
    """One page, and its link to the agent."""

    def __init__(self, page: WebSocket, path: Path, view: RobotView) -> None:
        self._page = page
        self._path = path
        self._view = view
        self._replies: list[HandReply] = []
        self._asked: deque[HandRequest] = deque()
        self._mine = self._by_hand = self._late = False
        self._news = asyncio.Event()
        self._error = ""

    async def run(self) -> None:
        """Pass on what either says, until one ends."""
        try:
            robot = LocalRobot(self._path)
        except LocalRobotError as error:
            if isinstance(self._view, BringupView):
                self._view.problem = str(error)
            await self._page.send_json({**self._view.as_json(), "error": str(error)})
            await self._page.close()
            return
        loop = asyncio.get_running_loop()
        with robot:
            loop.add_reader(robot.fileno(), self._on_readable, robot)
            showing = asyncio.create_task(self._show())
            hearing = asyncio.create_task(self._hear(robot))
            try:
                await asyncio.wait({showing, hearing}, return_when=asyncio.FIRST_COMPLETED)
            finally:
                loop.remove_reader(robot.fileno())
                for task in (showing, hearing):
                    task.cancel()
                ended = await asyncio.gather(showing, hearing, return_exceptions=True)
            for each in ended:
                if isinstance(each, Exception) and not isinstance(each, WebSocketDisconnect):
                    raise each  # the server logs it

    def _on_readable(self, robot: LocalRobot) -> None:
        try:
            for what in robot.poll():
                if isinstance(what, HandReply):
                    self._replies.append(what)
                    self._on_reply(what)
                    self._news.set()
                elif self._view.take(what):
                    ended, self._by_hand = self._by_hand, self._view.state.get("mode") == "TELEOP"
                    self._mine = self._mine and (self._by_hand or not ended)
                    self._news.set()
        except LocalRobotError as error:
            asyncio.get_running_loop().remove_reader(robot.fileno())
            self._error = str(error)
            self._news.set()

    def _on_reply(self, reply: HandReply) -> None:
        """Note whether it is this page that drives: the agent answers in turn, and tells all pages the same mode."""
        match self._asked.popleft() if self._asked else None:
            case TakeOver():
                self._mine = reply.accepted
            case HandBack():
                self._mine = False

    async def _show(self) -> None:
        """Send the newest whenever there is any; a slow page gets fewer, never older ones.

        A page that drives is told the time in between.
        """
        while not self._error:
            try:
                await asyncio.wait_for(self._news.wait(), _TICK_S if self._mine else None)
            except TimeoutError:
                await self._page.send_json({"tick": _now_ms()})
                continue
            self._news.clear()
            replies, self._replies = self._replies, []
            told = {"mine": self._mine, "replies": [msgspec.to_builtins(reply) for reply in replies]}
            await self._page.send_json({**self._view.as_json(), **told, "tick": _now_ms()})
        await self._page.send_json({"error": self._error})

    def _steer(self, robot: LocalRobot, request: _PageSteer) -> None:
        """Pass a speed on; one that is late is a stop."""
        age = 0.001 * (_now_ms() - request.tick)
        late = not 0.0 <= age <= _LATE_S and (request.v, request.w) != (0.0, 0.0)
        robot.send(Steer(v=0.0, w=0.0) if late else Steer(v=request.v, w=request.w))
        if late and not self._late and self._mine:
            reason = f"the link to the page is slow ({age:.1f} s): the robot stands until it is faster"
            self._replies.append(HandReply(accepted=False, reason=reason))
            self._news.set()
        self._late = late

    async def _hear(self, robot: LocalRobot) -> None:
        with contextlib.suppress(WebSocketDisconnect, LocalRobotError):
            while True:
                try:
                    request = _requests.decode(await self._page.receive_text())
                except msgspec.DecodeError as error:
                    await self._page.send_json({"error": f"the page sent what is no request: {error}"})
                    return
                if isinstance(request, _PageSteer):
                    self._steer(robot, request)
                elif not isinstance(request, Mount):
                    robot.send(request)
                    if isinstance(request, TakeOver | HandBack | ResetFault):
                        self._asked.append(request)
                elif isinstance(self._view, BringupView):
                    written = await asyncio.to_thread(self._view.write, request)
                    self._replies.append(written)  # only now: while it was written, the list was sent
                    self._news.set()


def _now_ms() -> int:
    return time.monotonic_ns() // 1_000_000


async def serve(path: Path, hosts: Sequence[str], port: int, view: Callable[[], RobotView] | None = None) -> None:
    """Serve the page at these addresses until cancelled; prints where it is. Raises `WrongUseError`.

    view: makes what each page sees; without one it only drives, for which there must be an agent.
    """
    if view is None:
        with LocalRobotErrors():
            LocalRobot(path).close()
    token = secrets.token_urlsafe(12)
    listening = [_listen(host, port) for host in hosts]
    for host, bound in zip(hosts, listening, strict=True):
        shown = f"[{host}]" if ":" in host else host
        print_line(f"the robot's page: http://{shown}:{bound.getsockname()[1]}/?token={token}")
    if any(host not in _LOOPBACK for host in hosts):
        print_line("whoever has this address drives the robot, and the link is not encrypted: use a network you trust")
    config = uvicorn.Config(
        make_app(path, token, view or RobotView), log_level="warning", access_log=False, lifespan="off",
        ws_max_size=4096, ws_max_queue=8, ws_ping_interval=5.0, ws_ping_timeout=10.0, timeout_graceful_shutdown=1,
    )  # fmt: skip
    server = uvicorn.Server(config)
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign,assignment]  # the command's are its own
    task = asyncio.create_task(server.serve(listening))
    try:
        await asyncio.shield(task)
    finally:
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # named: asyncio then sets TCP_NODELAY
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
        listening.listen()  # before its address is printed: whoever opens it at once waits, and is not refused
    except OSError as error:
        listening.close()
        raise WrongUseError(
            f"the page can't be served on {host}, port {port} ({error.strerror}): choose another by --bind or --port"
        ) from error
    return listening
