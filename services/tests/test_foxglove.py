"""Foxglove looks on at a floor through the console's address; whoever is slow, or no viewer, slows nobody."""

import asyncio
import base64
import json
import os
import shutil
from contextlib import asynccontextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st
from starlette.routing import WebSocketRoute
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from fog_bridges.floor import REFUSED
from fog_bridges.foxglove import messages, viewers
from fog_bridges.foxglove.protocol import ProtocolError, Schema, parsed
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import CircleShape, RobotObstacles, RobotPath, RobotPose, View, Zone
from fog_runtime.health import Health
from fog_runtime.http import Tokens, make_app, serve_here
from fog_runtime.token_file import create_token, revoke_token
from fog_supervisor import net

PEER = "FOGNAV_FOXGLOVE_PEER"
POSE = RobotPose(x=2.0, y=1.0, theta=np.pi / 2, covariance=[0.01] * 9, v=0.0, w=0.0, radius=0.17, height=0.2, stamp=5.5)
TEXT = Schema("text", "jsonschema", b"{}")


@given(st.one_of(st.binary(max_size=200), st.text(max_size=200), st.from_regex(r'\{"op":"[a-zA-Z]+".*\}')))
def test_message_that_is_none_is_refused_by_one_kind_of_error(message):
    with suppress(ProtocolError):
        parsed(message)


# --- Messages, read by Google's protobuf ------------------------------------------------------------------------------


def read(payload: bytes, schema: bytes, name: str) -> Any:
    """Return a message as its own schema says."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(payload)


def shown(kind: str, payload: bytes) -> Any:
    schema = getattr(messages.fox, kind).get_schema()
    return read(payload, schema.data, schema.name)


def test_costmap_has_each_cell_at_its_place():
    cost = np.array([[0, 10, 254], [255, 253, 0]], np.uint8)
    grid = shown("Grid", messages.costmap(cost, GridGeometry(3, 2, 0.05, -1.0, 2.0), 7.25))
    assert (grid.frame_id, grid.column_count, grid.row_stride, grid.cell_stride) == ("map", 3, 3, 1)
    assert np.frombuffer(grid.data, np.uint8).reshape(2, 3).tolist() == cost.tolist()
    assert (grid.pose.position.x, grid.pose.position.y, grid.cell_size.x) == (-1.0, 2.0, 0.05)
    assert (grid.timestamp.seconds, grid.timestamp.nanos) == (7, 250_000_000)
    assert [(field.name, field.offset, field.type) for field in grid.fields] == [("cost", 0, 1)]


def test_robot_s_path_scan_and_place_are_on_the_map():
    transform = shown("FrameTransform", messages.transform(POSE, "r-1"))
    assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "r-1")
    assert (transform.translation.x, transform.rotation.z) == (2.0, pytest.approx(np.sqrt(0.5)))
    path = RobotPath(
        plan_id=1, planner_epoch=1, goal_id="g", points=[(0.0, 0.0), (1.0, 0.0), (1.0, 2.0)], map_epoch=1, map_seq=1,
        released_length=3.0,
    )  # fmt: skip
    poses = shown("PosesInFrame", messages.path(path, 1.0)).poses
    assert [(pose.position.x, pose.position.y) for pose in poses] == path.points
    assert [round(2 * np.arcsin(pose.orientation.z), 3) for pose in poses] == [0.0, 1.571, 1.571]
    assert not shown("PosesInFrame", messages.path(RobotPath(**{**json_of(path), "points": []}), 1.0)).poses
    view = View(x=2.0, y=1.0, reach=bytes([20, 0] * 90))
    scan = shown("LaserScan", messages.scan(RobotObstacles(points=[], stamp=1.0, ttl=1.0, view=view)))
    assert (len(scan.ranges), scan.ranges[0], scan.ranges[1]) == (180, 1.0, np.inf)
    step = (scan.end_angle - scan.start_angle) / 179
    assert (step, scan.start_angle) == (pytest.approx(np.radians(2.0)), pytest.approx(np.radians(1.0)))


def json_of(path: RobotPath) -> dict[str, Any]:
    return {name: getattr(path, name) for name in path.__struct_fields__}


def test_zones_are_drawn_with_words_in_place_of_all_before():
    zone = Zone(id="wet", kind="BLOCKED", shape=CircleShape(centre=(1.0, 1.0), radius=0.5), reason="mopped")
    scene = shown("SceneUpdate", messages.zones([zone], GridGeometry(60, 60, 0.05, 0.0, 0.0), 1.0))
    assert [deletion.type for deletion in scene.deletions] == [1], "all"
    (entity,) = scene.entities
    assert (entity.id, entity.texts[0].text) == ("wet", "wet: mopped")
    points = [point for line in entity.lines for point in line.points]
    assert points
    assert all(abs((point.x - 1.0) ** 2 + (point.y - 1.0) ** 2 - 0.25) < 0.09 for point in points)


# --- Viewers, by a WebSocket client that is not ours ------------------------------------------------------------------


class Served:
    """Viewers behind a server, and whose tokens the floor knows."""

    def __init__(self, port_file: Path) -> None:
        self.roles: dict[str, str | None] = {"looks": "viewer", "visits": "guest", "rules": "admin", "away": None}
        self.viewers = viewers.Viewers("Fognav test", lambda: {"site": "test", "map.seq": 3})
        self.viewers.floor = SimpleNamespace(role_of=self.role_of)  # type: ignore[assignment]  # what is used of it
        self._port_file = port_file

    async def role_of(self, token: str) -> str | None:
        return self.roles.get(token, "")

    def post(self, topic: str, text: bytes, stamp: float) -> None:
        self.viewers.post(topic, "json", TEXT, lambda: text, stamp)

    def look(
        self, query: str = "", token: str = "looks", subprotocol: str = "foxglove.websocket.v1", queue: int = 16
    ) -> connect:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        address = f"ws://127.0.0.1:{net.read_port(self._port_file)}{viewers.ROUTE}{query}"
        return connect(
            address,
            additional_headers=headers,
            subprotocols=[subprotocol],
            max_size=None,
            max_queue=queue,
            close_timeout=1,
        )


@asynccontextmanager
async def served_viewers(tmp_path):
    served = Served(tmp_path / "port")
    app = make_app("test", Health(), Tokens())
    app.router.routes.append(WebSocketRoute(viewers.ROUTE, served.viewers.serve))
    app.state.sockets = True
    serving = asyncio.create_task(serve_here(app, port_file=tmp_path / "port"))
    try:
        async with asyncio.timeout(30.0):
            while net.read_port(tmp_path / "port") is None:  # noqa: ASYNC110  # of a server
                await asyncio.sleep(0.01)
        yield served
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def told(viewer: ClientConnection, op: str) -> dict[str, Any]:
    """Return the next message of a kind."""
    async with asyncio.timeout(30.0):
        while True:
            if isinstance(text := await viewer.recv(), str) and (found := json.loads(text))["op"] == op:
                return found


async def subscribed(viewer: ClientConnection, topic: str, number: int) -> None:
    channels = (await told(viewer, "advertise"))["channels"]
    channel = next(each["id"] for each in channels if each["topic"] == topic)
    await viewer.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": number, "channelId": channel}]}))


async def message(viewer: ClientConnection) -> tuple[int, float, bytes]:
    """Return subscription, time and content of the next message."""
    async with asyncio.timeout(30.0):
        while not isinstance(data := await viewer.recv(), bytes):
            pass
    assert data[0] == 1
    return int.from_bytes(data[1:5], "little"), int.from_bytes(data[5:13], "little") / 1e9, data[13:]


@pytest.mark.parametrize(
    ("query", "token", "status", "words"),
    [
        ("", "", 401, "?token=TOKEN"),
        ("", "nobody's", 401, "token is unknown"),
        ("?token=\u20ac", "", 401, "token is unknown"),
        ("", "visits", 403, "has the role guest"),
        ("?token=rules", "", 403, "fognav token create foxglove --role viewer"),
        ("", "away", 503, "the console does not say"),
    ],
)
async def test_nobody_looks_on_without_a_role(tmp_path, query, token, status, words):
    async with served_viewers(tmp_path) as served:
        with pytest.raises(InvalidStatus) as refused:
            await served.look(query, token)
        answer = refused.value.response
        assert (answer.status_code, words in json.loads(answer.body)["detail"]) == (status, True), answer.body


async def test_late_viewer_gets_the_latest_message_of_what_it_wants_and_reads_parameters(tmp_path):
    async with served_viewers(tmp_path) as served:
        for text in (b"1", b"2"):
            served.post("/state", text, 1.5)
        served.post("/other", b"3", 1.5)
        async with served.look("?token=looks", "", "foxglove.sdk.v1") as viewer:
            assert (await told(viewer, "serverInfo"))["capabilities"] == ["parameters"]
            await subscribed(viewer, "/state", 7)
            assert await message(viewer) == (7, 1.5, b"2")
            served.post("/state", b"4", 2.0)
            assert await message(viewer) == (7, 2.0, b"4")
            served.post("/new", b"5", 2.0)
            await subscribed(viewer, "/new", 8)
            assert await message(viewer) == (8, 2.0, b"5")
            await viewer.send(json.dumps({"op": "getParameters", "parameterNames": ["map.seq", "none"], "id": "q"}))
            answer = await told(viewer, "parameterValues")
            assert (answer["id"], answer["parameters"]) == ("q", [{"name": "map.seq", "value": 3}])
        served.roles = {}
        with pytest.raises(InvalidStatus):
            await served.look()


async def test_viewer_that_does_not_read_gets_the_latest_state_only_and_slows_nobody(tmp_path):
    """Each message is a megabyte that can't be compressed: more than sockets keep."""
    noise = os.urandom(1_000_000)
    async with served_viewers(tmp_path) as served:
        served.post("/costmap", noise, 0.0)
        async with served.look(queue=1) as slow, served.look() as quick:
            for viewer in (slow, quick):
                await subscribed(viewer, "/costmap", 1)
            await message(quick)
            for number in range(1, 41):
                served.post("/costmap", noise, float(number))
                assert (await message(quick))[1] == number
            times = [(await message(slow))[1]]
            while times[-1] < 40.0:
                times.append((await message(slow))[1])
            assert len(times) < 20, "the others were dropped"


async def test_nonsense_is_counted_and_told_and_ends_nothing(tmp_path):
    counted = REFUSED.labels("foxglove", "malformed")
    before, number = counted._value.get(), int(os.environ.get("FOGNAV_NONSENSE", "300"))
    async with served_viewers(tmp_path) as served, served.look() as viewer:
        for each in range(number):
            await viewer.send([b"\x01\x02", "{", '{"op": "setParameters"}', "[" * 1000][each % 4])
            assert "Send subscribe" in (await told(viewer, "status"))["message"]
        await viewer.send('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}')
        assert "no channel 99" in (await told(viewer, "status"))["message"]
        await viewer.send('{"op": "getParameters"}')
        assert len((await told(viewer, "parameterValues"))["parameters"]) == 2
    assert counted._value.get() - before == number + 1


async def test_viewer_that_asks_on_and_on_without_reading_is_disconnected(tmp_path):
    async def ask_on(viewer: ClientConnection) -> None:
        while True:
            await viewer.send('{"op": "getParameters"}')
            await asyncio.sleep(0)

    async with served_viewers(tmp_path) as served, served.look(queue=1) as viewer:
        large = os.urandom(30_000).hex()
        served.viewers._parameters = lambda: {"large": large}
        asking = asyncio.create_task(ask_on(viewer))
        await left(served)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)


async def left(served: Served) -> None:
    """Wait until nobody looks on."""
    async with asyncio.timeout(60.0):
        while served.viewers._places:  # noqa: ASYNC110  # of a server
            await asyncio.sleep(0.01)


async def test_viewer_whose_token_is_revoked_is_disconnected(tmp_path, monkeypatch):
    monkeypatch.setattr(viewers, "ADMITTED_S", 0.05)
    async with served_viewers(tmp_path) as served, served.look() as viewer:
        served.roles["looks"] = None  # the console does not answer: nothing changes
        await viewer.send('{"op": "getParameters"}')
        await told(viewer, "parameterValues")
        del served.roles["looks"]
        with pytest.raises(ConnectionClosed) as closed:
            await told(viewer, "status")
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "the token was revoked")


async def test_only_so_many_look_on_at_the_same_time(tmp_path):
    async with served_viewers(tmp_path) as served:
        found = [await served.look() for _ in range(viewers.VIEWERS)]
        with pytest.raises(InvalidStatus) as refused:
            await served.look()
        assert refused.value.response.status_code == 503
        await asyncio.gather(*(viewer.close() for viewer in found))
        await left(served)
        await (await served.look()).close()


# --- With real services, through the console --------------------------------------------------------------------------


@pytest.fixture
async def floor(all_services):
    """Run the bridge, and the console-service before it; yield the fog and the console's address."""
    port = net.free_port()
    tokens_file = all_services.folder / "tokens.toml"
    urls = {
        f"FOGNAV_{name}_URL": await all_services.ready(module)
        for name, module in (("AGGREGATOR", "hazard_aggregator"), ("MAP", "map_service"), ("PLANNER", "planner"))
    }
    all_services.start("console_service", **urls, FOGNAV_BRIDGE_URL=f"http://127.0.0.1:{port}")
    console = await all_services.ready("console_service")
    token = all_services.folder / "foxglove-token"
    token.write_text(create_token(tokens_file, "bridge-foxglove", "operator"))
    all_services.start(
        "fog_bridges",
        FOGNAV_ADAPTERS="foxglove",
        FOGNAV_CONSOLE_URL=console,
        FOGNAV_HTTP_PORT=str(port),
        FOGNAV_TOKEN_FILE=str(token),
        FOGNAV_CREDENTIALS_FILE=str(all_services.security.credentials("bridge")),
    )
    yield all_services, console, tokens_file
    for module in ("fog_bridges", "console_service"):
        all_services.kill(module)
    revoke_token(tokens_file, "bridge-foxglove")


@pytest.mark.live
@pytest.mark.smoke
async def test_floor_is_shown_through_the_console_to_viewers_only(floor, tokens):
    fog, console, _ = floor
    address = f"ws{console.removeprefix('http')}{viewers.ROUTE}"
    look = partial(connect, address, subprotocols=["foxglove.sdk.v1"], max_size=None)
    with pytest.raises(InvalidStatus) as away:
        await look(additional_headers=tokens["viewer"])
    await fog.ready("fog_bridges")
    assert away.value.response.status_code in (401, 502)
    for headers, status in (({}, 401), ({"Authorization": "Bearer nobody"}, 401)):
        with pytest.raises(InvalidStatus) as refused:
            await look(additional_headers=headers)
        assert refused.value.response.status_code == status
    async with httpx.AsyncClient() as client:
        assert (await client.get(console + viewers.ROUTE)).status_code == 404
    async with look(additional_headers=tokens["viewer"]) as viewer:
        await subscribed(viewer, "/costmap", 1)
        grid = shown("Grid", (await message(viewer))[2])
        assert (grid.column_count, len(grid.data)) == (160, 160 * 120)


@pytest.mark.live
async def test_foxglove_s_own_client_sees_zones_and_costmap(floor, tokens):
    if PEER not in os.environ or shutil.which("node") is None:
        pytest.skip(f"install Node, `npm install @foxglove/ws-protocol@0.8.0 ws`, and name the folder in {PEER}")
    fog, console, _ = floor
    await fog.ready("fog_bridges")
    zone = {"id": "wet", "kind": "BLOCKED", "shape": {"type": "circle", "centre": [6.0, 2.0], "radius": 0.3}}
    async with httpx.AsyncClient(base_url=await fog.ready("map_service")) as client:
        assert (await client.post("/api/v1/zones", json=zone, headers=tokens["operator"])).is_success
    peer = await asyncio.create_subprocess_exec(
        "node", str(Path(__file__).with_name("foxglove_peer.js")), f"ws{console.removeprefix('http')}{viewers.ROUTE}",
        tokens["viewer"]["Authorization"].removeprefix("Bearer "), "/costmap", "/zones",
        env={**os.environ, "NODE_PATH": str(Path(os.environ[PEER]) / "node_modules")}, stdout=asyncio.subprocess.PIPE,
        limit=2**24,
    )  # fmt: skip
    seen: dict[str, Any] = {}
    try:
        async with asyncio.timeout(60.0):
            while not ({"/costmap", "parameters"} <= seen.keys() and "wet" in seen.get("/zones", {})):
                line = json.loads(await peer.stdout.readline())
                seen |= {key: line[key] for key in ("name", "parameters") if key in line}
                if "topic" in line:
                    payload, schema = base64.b64decode(line["payload"]), base64.b64decode(line["schema"])
                    found = read(payload, schema, line["schemaName"])
                    named = {entity.id: entity for entity in found.entities} if line["topic"] == "/zones" else found
                    seen[line["topic"]] = named
    finally:
        peer.kill()
        await peer.wait()
    assert (seen["name"], seen["parameters"]) == ("Fognav test", [{"name": "site", "value": "test"}])
    assert seen["/costmap"].column_count == 160
    assert seen["/zones"]["wet"].metadata[0].value == "BLOCKED"
