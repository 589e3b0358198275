"""The events of the running console-service, with a real broker, Redis and router, and the services behind it."""

import asyncio
import base64
import io
import json
import socket
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import httpx
import numpy as np
import pytest
from PIL import Image

from console_service.readers import MOST_OF_SESSION
from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.messages import NodeReading, RobotObstacles, RobotPose, RobotVitals, View
from fog_runtime.token_file import create_token, revoke_token

pytestmark = pytest.mark.live
ZONE = {"kind": "BLOCKED", "shape": {"type": "circle", "centre": [2.0, 3.0], "radius": 0.5}, "reason": "wet"}
WAIT_S = 60


class Page:
    """What a browser's page does with the events: it keeps the last state of each thing."""

    def __init__(self) -> None:
        self.things: dict[str, dict[str, object]] = {}
        self.tiles: dict[tuple[int, int], dict[str, object]] = {}
        self.got: list[str] = []
        self.last_id = ""
        self.hello: dict[str, object] = {}
        self.map: dict[str, object] = {}

    def take(self, event: str, data: dict[str, object], event_id: str | None) -> None:
        self.got.append(event)
        self.last_id = event_id or self.last_id
        if event == "hello":
            self.hello = data
        elif event == "map":
            self.map = data
        elif event == "costmap":
            self.tiles[data["column"], data["row"]] = data
        elif "value" in data:
            self.things.setdefault(event, {})[data["id"]] = data["value"]

    def cost(self, x: float, y: float) -> int:
        geometry = self.map["geometry"]
        column, row = int(x / geometry["resolution"]), int(y / geometry["resolution"])
        tile = self.tiles[column // 128 * 128, row // 128 * 128]
        cells = np.asarray(Image.open(io.BytesIO(base64.b64decode(tile["png"]))))[::-1]
        assert cells.shape == (tile["height"], tile["width"])
        return int(cells[row - tile["row"], column - tile["column"]])

    async def read(self, stream: AsyncIterator[str], until) -> None:
        """Read events until a condition holds."""
        fields: dict[str, str] = {}
        async with asyncio.timeout(WAIT_S):
            while not until():
                line = await anext(stream)
                if line:
                    name, _, value = line.partition(": ")
                    fields[name] = value
                elif fields:
                    self.take(fields["event"], json.loads(fields["data"]), fields.get("id"))
                    fields = {}


@asynccontextmanager
async def reading(url: str, headers: dict[str, str], page: Page, query: str = ""):
    """Connect a page to the events, from where it was; yield what reads on."""
    own = {"Last-Event-ID": page.last_id} if page.last_id else {}
    page.got = []
    async with (
        httpx.AsyncClient(timeout=WAIT_S) as client,
        client.stream("GET", f"{url}/api/v1/events{query}", headers={**headers, **own}) as answer,
    ):
        assert answer.status_code == 200, await answer.aread()
        assert answer.headers["content-type"].startswith("text/event-stream")
        lines = answer.aiter_lines()
        yield lambda until: page.read(lines, until)


@pytest.fixture
async def console(all_services, tokens):
    """Yield the URLs of the console and of the map-service, and a viewer's token."""
    if "console_service" not in all_services.processes:
        ports = {
            name: await all_services.ready(module)
            for name, module in (("AGGREGATOR", "hazard_aggregator"), ("MAP", "map_service"), ("PLANNER", "planner"))
        }
        all_services.start("console_service", **{f"FOGNAV_{name}_URL": url for name, url in ports.items()})
    return await all_services.ready("console_service"), await all_services.ready("map_service"), tokens["viewer"]


@pytest.mark.smoke
async def test_first_state_is_complete_and_a_zone_appears_with_its_cells_and_goes_again(console, tokens):
    url, map_url, viewer = console
    page = Page()
    async with reading(url, viewer, page) as read, httpx.AsyncClient(base_url=map_url) as client:
        await read(lambda: "ready" in page.got)
        assert page.got[0] == "hello"
        assert page.hello["fresh"] is True
        assert page.things["area"].keys() == {"hall"}
        assert page.things["node"]["n1"]["theta"] == pytest.approx(-1.5707963), "where it hangs, by the site"
        await read(lambda: len(page.tiles) == 2)
        assert page.cost(2.0, 3.0) < LETHAL
        made = await client.post("/api/v1/zones", json={**ZONE, "id": "wet"}, headers=tokens["operator"])
        assert made.status_code == 201
        await read(lambda: "wet" in page.things.get("zone", {}) and page.cost(2.0, 3.0) == LETHAL)
        assert page.things["zone"]["wet"]["active"] is True
        await read(lambda: "record" in page.got)
        await client.delete("/api/v1/zones/wet", headers=tokens["operator"])
        await read(lambda: page.things["zone"]["wet"] is None and page.cost(2.0, 3.0) < LETHAL)


async def test_who_comes_back_gets_only_what_changed_and_after_a_restart_begins_anew(all_services, console, tokens):
    url, map_url, viewer = console
    page = Page()
    async with reading(url, viewer, page) as read:
        await read(lambda: "ready" in page.got and len(page.tiles) == 2)
    async with httpx.AsyncClient(base_url=map_url) as client:
        await client.post("/api/v1/zones", json={**ZONE, "id": "later"}, headers=tokens["operator"])
    async with reading(url, viewer, page) as read:
        await read(lambda: "later" in page.things.get("zone", {}) and "ready" in page.got)
        assert page.hello["fresh"] is False
        assert page.got.count("costmap") <= 1
        assert "area" not in page.got
    all_services.kill("console_service")
    all_services.start("console_service", FOGNAV_AGGREGATOR_URL=await all_services.ready("hazard_aggregator"))
    async with reading(await all_services.ready("console_service"), viewer, page) as read:
        await read(lambda: "ready" in page.got)
        assert page.hello["fresh"] is True


async def test_hazard_of_a_node_and_a_robots_pose_reach_the_page(all_services, console):
    url, _, viewer = console
    page = Page()
    async with all_services.edges() as (mqtt, zenoh, connect), reading(url, viewer, page) as read:
        connect()
        await mqtt.wait_connected()
        await read(lambda: "ready" in page.got)
        begun = time.monotonic()

        def blocked() -> bool:
            return (page.things["area"]["hall"].get("hazard") or {}).get("state") == "blocked"

        async def publish() -> None:
            for seq in range(10_000):
                uptime_ms = round(1000 * (time.monotonic() - begun))
                near = NodeReading(
                    seq=seq, boot=1, uptime_ms=uptime_ms, range_m=[0.5, 0.5], status=["ok", "ok"], state="blocked"
                )
                await mqtt.publish(ch.NODE_READING, near, node="n1")
                pose = RobotPose(
                    x=1.0 + seq / 100, y=1.0, theta=0.0, covariance=[0.0] * 9, v=0.1, w=0.0, radius=0.2, height=0.3,
                    stamp=time.time(),
                )  # fmt: skip
                zenoh.publish(ch.ROBOT_POSE, pose, robot="r1")
                await asyncio.sleep(0.05)

        publishing = asyncio.create_task(publish())
        try:
            await read(lambda: blocked() and "r1" in page.things.get("pose", {}))
            first, began = page.got.count("pose"), time.monotonic()
            await read(lambda: page.got.count("pose") >= first + 20)
            assert time.monotonic() - began >= 20 * 0.08, "20 poses a second came, and 10 are told at most"
        finally:
            publishing.cancel()


async def test_area_is_told_as_clear_and_confirmed_only_while_aggregator_and_map_service_live(all_services, console):
    url, _, viewer = console
    page = Page()
    async with all_services.edges() as (mqtt, _, connect), reading(url, viewer, page) as read:
        connect()
        await mqtt.wait_connected()
        begun = time.monotonic()

        async def publish() -> None:
            for seq in range(10_000):
                uptime_ms = round(1000 * (time.monotonic() - begun))
                far = NodeReading(
                    seq=seq, boot=2, uptime_ms=uptime_ms, range_m=[2.5, 2.5], status=["ok", "ok"], state="clear"
                )
                await mqtt.publish(ch.NODE_READING, far, node="n1")
                await asyncio.sleep(0.1)

        def on_map() -> dict[str, object] | None:
            return page.things["area"]["hall"]["on_map"]

        publishing = asyncio.create_task(publish())
        try:
            await read(lambda: "ready" in page.got)
            await read(lambda: on_map() == {"state": "clear", "penalty": 0, "confirmed": True})
            all_services.kill("hazard_aggregator")
            await read(lambda: on_map() is not None and not on_map()["confirmed"])
            assert on_map()["state"] == "unknown"
            assert page.things["area"]["hall"]["hazard"]["state"] == "clear", "nothing else tells it"
            all_services.kill("map_service")
            await read(lambda: on_map() is None)
        finally:
            publishing.cancel()
            for module in ("hazard_aggregator", "map_service"):
                if module not in all_services.processes:
                    all_services.start(module)
                    await all_services.ready(module)


async def test_scan_of_a_robot_comes_to_who_asks_for_it_and_to_nobody_else(all_services, console):
    url, _, viewer = console
    asking, other = Page(), Page()
    async with (
        all_services.edges() as (_, zenoh, _connect),
        reading(url, viewer, asking, "?scan=r1") as read,
        reading(url, viewer, other) as read_other,
    ):
        reach = bytes([20 if sector < 45 else 0 for sector in range(180)])  # 1 m, in the first quarter

        async def publish() -> None:
            while True:
                view = View(x=2.0, y=3.0, reach=reach)
                zenoh.publish(ch.ROBOT_OBSTACLES, RobotObstacles(points=[], stamp=1.0, ttl=60.0, view=view), robot="r1")
                await asyncio.sleep(0.1)

        publishing = asyncio.create_task(publish())
        try:
            await read(lambda: "scan" in asking.got)
            await read_other(lambda: "obstacles" in other.got and other.got.count("time") >= 2)
        finally:
            publishing.cancel()
        points = asking.things["scan"]["r1"]["points"]
        assert len(points) == 45
        assert all(x > 2.0 and y > 3.0 and abs((x - 2.0) ** 2 + (y - 3.0) ** 2 - 1.0) < 0.01 for x, y in points)
        assert "scan" not in other.got


async def test_vitals_of_a_robot_are_events_and_the_last_ten_minutes_of_them_are_kept(all_services, console):
    url, _, viewer = console
    page = Page()
    async with all_services.edges() as (_, zenoh, _connect), reading(url, viewer, page) as read:

        async def publish() -> None:
            for number in range(10_000):
                vitals = RobotVitals(cpu={"agent": 4.0, "guardian": 1.0 + number}, wifi_dbm=-56.0)
                zenoh.publish(ch.ROBOT_VITALS, vitals, robot="r1")
                await asyncio.sleep(0.05)

        publishing = asyncio.create_task(publish())
        try:
            await read(lambda: page.got.count("vitals") >= 3)
        finally:
            publishing.cancel()
        last = page.things["vitals"]["r1"]
        assert (last["cpu"]["agent"], last["wifi_dbm"]) == (4.0, -56.0)
        async with httpx.AsyncClient(base_url=url) as client:
            kept = (await client.get("/api/v1/vitals/r1", headers=viewer)).json()
            assert last in kept
            assert 3 <= len(kept) <= 300
            assert sorted(each["stamp"] for each in kept) == [each["stamp"] for each in kept]
            assert (await client.get("/api/v1/vitals/r9", headers=viewer)).json() == []
            assert (await client.get("/api/v1/vitals/r1")).status_code == 401


async def test_one_login_has_eight_streams_and_a_revoked_token_ends_its_own(all_services, console):
    url = console[0]
    tokens = all_services.folder / "tokens.toml"
    before = tokens.read_text()
    token = create_token(tokens, "wall", "viewer")
    wall = {"Authorization": f"Bearer {token}"}
    try:
        async with AsyncExitStack() as stack:
            pages = [Page() for _ in range(MOST_OF_SESSION)]
            reads = [await stack.enter_async_context(reading(url, wall, page)) for page in pages]
            for page, read in zip(pages, reads, strict=True):
                await read(lambda page=page: "hello" in page.got)
            async with httpx.AsyncClient() as client:
                refused = await client.get(f"{url}/api/v1/events", headers=wall)
            assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
            revoke_token(tokens, "wall")
            for read in reads:
                with pytest.raises(StopAsyncIteration):
                    await read(lambda: False)
    finally:
        tokens.write_text(before)


@pytest.mark.parametrize("headers", [{}, {"Authorization": "Bearer nobody"}], ids=["none", "unknown"])
async def test_events_need_a_viewers_token(console, headers):
    async with httpx.AsyncClient() as client:
        answer = await client.get(f"{console[0]}/api/v1/events", headers=headers)
    assert (answer.status_code, answer.headers["content-type"]) == (401, "application/problem+json")


async def test_who_does_not_read_is_disconnected_and_holds_nobody_up(all_services, console):
    url, _, viewer = console
    host, _, port = url.removeprefix("http://").partition(":")
    deaf = socket.create_connection((host, int(port)))
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    request = f"GET /api/v1/events HTTP/1.1\r\nHost: {host}\r\nAuthorization: {viewer['Authorization']}\r\n\r\n"
    deaf.sendall(request.encode())
    page = Page()
    async with all_services.edges() as (_, zenoh, _connect), reading(url, viewer, page) as read:

        async def publish() -> None:
            points = [(float(n % 100), float(n)) for n in range(1500)]
            for n in range(100_000):
                obstacles = RobotObstacles(points=points, stamp=float(n), ttl=60.0)
                zenoh.publish(ch.ROBOT_OBSTACLES, obstacles, robot="r1")
                await asyncio.sleep(0.05)

        publishing = asyncio.create_task(publish())
        try:
            seen = 0
            async with httpx.AsyncClient(base_url=url) as client:
                while "fognav_console_readers_slow_total 1.0" not in (await client.get("/metrics")).text:
                    page.got = []
                    await read(lambda: "obstacles" in page.got)
                    seen += 1
        finally:
            publishing.cancel()
        assert seen > 10, "the other one read on"
    deaf.settimeout(WAIT_S)
    received = 0
    try:
        while data := deaf.recv(65536):
            received += len(data)
    except ConnectionResetError:
        pass
    assert received < 1024 * 1024, "bounded, whatever was sent meanwhile"
    deaf.close()
