"""A console-service that says what a test wants: the real page over a stream of events as ADR 67 fixes it.

For what a running system does not do on demand: ten robots, hostile names, a server that falls silent or starts anew.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import io
import itertools
import json
import time
from typing import TYPE_CHECKING, Any

import numpy as np
import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.responses import StreamingResponse
from msgspec import to_builtins
from PIL import Image

from console_service.api import PAGE
from console_service.page_files import PageFiles
from fog_contracts.messages import AreaDefinition, AreaHazard, RobotPose, RobotState, WeeklySchedule, WeeklyTime
from fog_supervisor import net
from planner.schedules.api import ScheduleView
from planner.stops import GoalPose, MissionBody, StopBody

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from fog_runtime.configuration.site import LoadedSite

TILE = 128
TOKEN = "a-token"
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking"]
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
WIDE = {"viewport": {"width": 1440, "height": 900}}
VIEWS = ("map", "zones", "robots", "schedules", "sensors", "timeline")


def png(cells: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(cells[::-1])).save(buffer, "PNG")
    return buffer.getvalue()


def robot_state(mode: str = "NORMAL", **fields: Any) -> RobotState:
    about = {"goal_id": "g", "plan_id": 1, "battery": 0.7, "reasons": [], "enabled": True, "map_epoch": 1, "map_seq": 1}
    return RobotState(mode=mode, **{**about, **fields})


def robot_pose(x: float, y: float, theta: float) -> RobotPose:
    return RobotPose(
        x=x, y=y, theta=theta, covariance=[0.0] * 9, v=0.25, w=0.0, radius=0.17, height=0.1, stamp=time.time()
    )


def schedule(name: str, *, begin: float | None, **changed: object) -> dict[str, object]:
    """Return a mission by the clock as the planner lists it, whose next window begins at a time."""
    weekly = WeeklySchedule(time_zone="Asia/Tokyo", times=[WeeklyTime(days=["mon"], begin="08:00", end="09:00")])
    stops = [StopBody(place="a"), StopBody(pose=GoalPose(x=3.0, y=4.5)), StopBody(place="a", floor="upstairs")]
    mission = MissionBody(stops=stops, deadline_s=600.0)
    view = ScheduleView(
        id=name, robot="r2", mission=mission, weekly=weekly, author="ana", since=1.0, version="7", next=begin, waits="",
        waits_code="",
    )  # fmt: skip
    return {**to_builtins(view), **changed}


class ConsoleStream:
    """The compacted log of one site, its readers, and the requests that the page has made."""

    def __init__(self, site: LoadedSite) -> None:
        self.site = site
        self.run = "first"
        self.log: dict[tuple[str, str], tuple[int, str, Any]] = {}
        self.requests: list[tuple[str, Any]] = []
        self.answers: dict[str, tuple[int, Any]] = {}
        """What a request `METHOD path` is answered, with its status; any other one gets 200 and what commands get, or
        an empty list."""
        self.resumed_from: list[str | None] = []
        self.silent = False
        self.unready = False
        """Whether new readers are not told that the state of the time of connecting is complete."""
        self.role = "operator"
        self._revisions = itertools.count(1)
        self._readers: set[asyncio.Event] = set()
        self._cut = asyncio.Event()
        self._describe()

    def say(self, event: str, key: str, data: Any) -> None:
        self.log[event, key] = (next(self._revisions), event, data)
        for changed in self._readers:
            changed.set()

    def tell(self, event: str, key: str, value: Any) -> None:
        self.say(event, key, {"id": key, "value": to_builtins(value)})

    def robot(self, name: str, state: RobotState, goal: Any = None, **fields: Any) -> None:
        about = {"id": name, "configured": True, "state": state, "goal": goal, "plan": None}
        self.tell("robot", name, {**about, "out_of_service": None, "start": None, "dock": None, **fields})

    def asked(self, method: str) -> list[str]:
        """Return the requests of this method, without those of the session."""
        return [name for name, _ in self.requests if name.startswith(method) and not name.endswith("session")]

    def hazard(self, area: str, state: str, **fields: Any) -> None:
        found = next(each for each in self.site.site.areas if each.id == area)
        definition = AreaDefinition(id=area, label=found.label, polygon=found.polygon)
        hazard = AreaHazard(
            area=area, state=state, severity=0, penalty=0, since=time.time(), seq=1, epoch=1, cause="echo"
        )
        value = {"definition": definition, "hazard": hazard, "withheld": False, "override": None}
        self.tell("area", area, {**value, **fields})

    def cut(self) -> None:
        """End all connections, as a gateway that starts anew."""
        cut, self._cut = self._cut, asyncio.Event()
        cut.set()

    def _describe(self) -> None:
        geometry, cells, site = self.site.map.geometry, self.site.map.cells, self.site.site
        info = {"width": geometry.width, "height": geometry.height, "resolution": geometry.resolution}
        info |= {"origin_x": geometry.origin_x, "origin_y": geometry.origin_y}
        self.say("map", "", {"site": site.id, "geometry": info, "epoch": 1, "seq": 1})
        for row in range(0, geometry.height, TILE):
            for column in range(0, geometry.width, TILE):
                self.tile(column, row, cells[row : row + TILE, column : column + TILE])
        for name, place in site.places.items():
            self.tell("place", name, place)
        for area in site.areas:
            self.hazard(area.id, "clear")
        for node in site.nodes:
            health = {"state": "clear", "reason": "nothing near", "code": "", "online": True, "age_s": 0.1}
            health |= {"heard": time.time() - 0.1}
            self.tell("node", node.id, {**to_builtins(node), **health, "received": 1, "ignored": 0})

    def tile(self, column: int, row: int, cells: np.ndarray) -> None:
        size = {"column": column, "row": row, "width": cells.shape[1], "height": cells.shape[0]}
        image = base64.b64encode(png(cells)).decode()
        self.say("costmap", f"{column} {row}", {"epoch": 1, "seq": 1, **size, "png": image})

    async def events(self, resume: str | None) -> AsyncIterator[str]:
        run, _, number = (resume or "").partition("-")
        fresh = run != self.run
        seen, cut, changed = 0 if fresh else int(number), self._cut, asyncio.Event()
        self._readers.add(changed)
        ended = asyncio.create_task(cut.wait())
        try:
            yield _event("hello", {"run": self.run, "fresh": fresh, "site": self.site.site.id})
            ready, timed = False, 0.0
            while not cut.is_set():
                changed.clear()
                newer = sorted((entry for entry in self.log.values() if entry[0] > seen), key=lambda entry: entry[0])
                if newer and not self.silent:
                    seen = newer[-1][0]
                    yield "".join(_event(event, data, f"{self.run}-{number}") for number, event, data in newer)
                if not ready and not self.unready:
                    ready = True
                    yield _event("ready", {})
                if time.monotonic() - timed >= 1.0 and not self.silent:
                    timed = time.monotonic()
                    yield _event("time", {"stamp": time.time()})
                wait = asyncio.create_task(changed.wait())
                await asyncio.wait({wait, ended}, timeout=1.0, return_when=asyncio.FIRST_COMPLETED)
                wait.cancel()
                await asyncio.gather(wait, return_exceptions=True)
        finally:
            ended.cancel()
            await asyncio.gather(ended, return_exceptions=True)
            self._readers.discard(changed)

    def app(self) -> FastAPI:
        app = FastAPI(openapi_url=None)
        refused = {"type": "urn:fognav:token_missing", "title": "no token", "status": 401, "detail": "log in first"}

        @app.get("/api/v1/events")
        async def events(request: Request) -> Response:
            if "session" not in request.cookies:
                return Response(json.dumps(refused), 401)
            resume = request.headers.get("last-event-id")
            self.resumed_from.append(resume)
            return StreamingResponse(self.events(resume), media_type="text/event-stream")

        @app.get("/api/v1/map.png")
        async def plan() -> Response:
            greys = np.array([255, *[205] * 253, 0, 205], dtype=np.uint8)[self.site.map.cells]
            return Response(png(greys), media_type="image/png")

        @app.api_route("/api/v1/{path:path}", methods=["GET", "POST", "PUT", "PATCH", "DELETE"])
        async def rest(path: str, request: Request) -> Response:
            body = json.loads(await request.body() or "null")
            name = f"{request.method} {path}"
            self.requests.append((name, body))
            if path == "session" and name not in self.answers:
                return self._session(request, body, refused)
            outcome = {"accepted": True, "reason": "it does", "mode": "NORMAL"}
            status, answer = self.answers.get(name, (200, [] if request.method == "GET" else outcome))
            if isinstance(answer, bytes):
                return Response(answer, status, media_type="image/png")
            return Response(json.dumps(answer), status, media_type="application/json")

        app.mount("/", PageFiles(PAGE))
        return app

    def _session(self, request: Request, body: Any, refused: dict[str, Any]) -> Response:
        if request.method == "POST":
            if body["token"] != TOKEN:
                return Response(json.dumps({**refused, "type": "urn:fognav:token_unknown"}), 401)
            answer = Response("{}")
            answer.set_cookie("session", "1", httponly=True, samesite="strict")
            return answer
        if request.method == "DELETE":
            answer = Response(status_code=204)
            answer.delete_cookie("session")
            return answer
        if "session" not in request.cookies:
            return Response(json.dumps(refused), 401)
        return Response(json.dumps({"name": "ana", "role": self.role, "until": None}))


def _event(event: str, data: Any, number: str = "") -> str:
    identified = f"id: {number}\n" if number else ""
    return f"event: {event}\n{identified}data: {json.dumps(data)}\n\n"


@contextlib.asynccontextmanager
async def serve(stream: ConsoleStream) -> AsyncIterator[str]:
    """Serve the page over this stream; yields the address."""
    port = net.free_port()
    config = uvicorn.Config(stream.app(), host=net.LOOPBACK, port=port, log_level="error", lifespan="off")
    config.timeout_graceful_shutdown = 1
    server = uvicorn.Server(config)
    server.capture_signals = contextlib.nullcontext
    task = asyncio.create_task(server.serve())
    try:
        while not server.started:
            if task.done():
                task.result()
            await asyncio.sleep(0.02)
        yield f"http://{net.LOOPBACK}:{port}/"
    finally:
        stream.cut()
        server.should_exit = True
        await asyncio.gather(task, return_exceptions=True)
