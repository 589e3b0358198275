"""Two floors with servers and services of their own, one of which has the other in its list of floors."""

import asyncio
import time
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import httpx
import msgspec
import pytest
from msgspec.structs import replace
from starlette.requests import Request

from console_service.core import ConsoleCore
from console_service.floors import AWAY_S, FloorStop, FloorView, Hub, OwnFloor, Peer, read_peers
from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import CommandReply, Pose, RobotGoal, RobotPath, RobotRelease, RobotState
from fog_contracts.site import RobotSite
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.settings import SettingsError
from fog_runtime.health import Health
from fog_runtime.token_file import create_token, revoke_token
from fog_runtime.transports.zenoh_edge import ZenohEdge

live = pytest.mark.live
SERVICES = {"hazard_aggregator": "AGGREGATOR_URL", "map_service": "MAP_URL", "planner": "PLANNER_URL"}
DRIVING = RobotState(
    mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=None, map_epoch=1, map_seq=0, plan_id=None,
)  # fmt: skip


@dataclass
class Robot:
    """What a robot says, and whether it answers; `stopped_at` are the times at which it was stopped (s, monotonic)."""

    answers: bool = True
    stopped_at: list[float] = field(default_factory=list)
    stopped_by: list[str] = field(default_factory=list)

    @asynccontextmanager
    async def on(self, edge: ZenohEdge, robot: str):
        """Let it be on a floor."""

        def stop(_ids, command):
            self.stopped_at.append(time.monotonic())
            self.stopped_by.append(command.operator)
            return CommandReply(accepted=True, reason="stopped")

        async def publish():
            while True:
                edge.publish(ch.ROBOT_STATE, replace(DRIVING, enabled=not self.stopped_at), robot=robot)
                await asyncio.sleep(0.1)

        if self.answers:
            edge.serve(ch.ROBOT_COMMAND, stop, robot=robot)
        publishing = asyncio.create_task(publish())
        try:
            yield
        finally:
            publishing.cancel()
            with suppress(asyncio.CancelledError):
                await publishing


async def start_console(floor, **environment):
    urls = {f"FOGNAV_{SERVICES[module]}": await floor.ready(module) for module in SERVICES}
    floor.start("console_service", **urls, **environment)


@pytest.fixture
async def floors(fog, tmp_path_factory, proxy_of, tokens):
    """Yield two floors, each with a robot that drives: `test`, whose console knows `upstairs` through a proxy."""
    async with AsyncExitStack() as stack:
        servers = type(fog.servers)(tmp_path_factory.mktemp("servers"), secured=False)
        stack.callback(servers.close)
        upstairs = type(fog)(tmp_path_factory.mktemp("upstairs"), servers)
        stack.callback(upstairs.close)
        site = upstairs.site / "site.toml"
        site.write_text(site.read_text().replace('id = "test"', 'id = "upstairs"'))
        # Before its services read the tokens: one that is made later is unknown to some of them for a while.
        token = create_token(upstairs.folder / "tokens.toml", "floor test", "viewer")
        for each in (fog, upstairs):
            for module in SERVICES:
                each.start(module)
        await start_console(upstairs)
        port = int((await upstairs.ready("console_service")).rpartition(":")[2])
        proxy = proxy_of(SimpleNamespace(port=port))
        address = f"http://127.0.0.1:{await proxy.start()}"
        (fog.folder / "upstairs.toml").write_text(f'user = "floor test"\ntoken = "{token}"\n')
        listed = fog.folder / "floors.toml"
        listed.write_text(f'[floors.upstairs]\naddress = "{address}"\ncredentials = "upstairs.toml"\n')
        await start_console(fog, FOGNAV_FLOORS_FILE=str(listed))
        client = await stack.enter_async_context(
            httpx.AsyncClient(base_url=await fog.ready("console_service"), headers=tokens["viewer"], timeout=60.0)
        )
        _, here, _ = await stack.enter_async_context(fog.edges())
        there = await stack.enter_async_context(
            ZenohEdge.open(
                connect=[servers.router.endpoint], clock=SystemClock(), role="test", id="test", site="upstairs"
            )
        )
        yield SimpleNamespace(here=here, there=there, client=client, proxy=proxy, upstairs=upstairs, hub=fog)


async def listed(floors, condition):
    """Return the entry of the other floor once it fulfils a condition."""
    async with asyncio.timeout(60):
        while True:
            answer = await floors.client.get("/api/v1/floors")
            assert answer.status_code == 200, answer.text
            this, other = answer.json()
            assert (this["id"], this["reachable"], other["id"]) == ("test", True, "upstairs")
            if condition(other):
                return other
            await asyncio.sleep(0.1)


def drives(entry):
    """Whether a floor is known to have a robot that drives, and services that are ready."""
    floor = entry["floor"]
    return entry["reachable"] and [r["enabled"] for r in floor["robots"]] == [True] and floor["not_ready"] == {}


@live
@pytest.mark.smoke
async def test_one_press_stops_the_robots_of_both_floors_and_each_floor_says_so(floors):
    here, there = Robot(), Robot()
    async with here.on(floors.here, "r1"), there.on(floors.there, "r1"):
        other = await listed(floors, drives)
        assert (other["floor"]["stopped"], other["age_s"] <= 3.0) == (False, True)
        async with asyncio.timeout(60):
            while [each["id"] for each in (await floors.client.get("/api/v1/robots")).json()] != ["r1"]:  # noqa: ASYNC110  # another process hears it
                await asyncio.sleep(0.1)
        answer = await floors.client.post("/api/v1/floors/stop", json={})
        assert answer.status_code == 200, answer.text
        told = [(each["id"], each["acknowledged"], each["detail"]) for each in answer.json()]
        assert told == [("test", True, ""), ("upstairs", True, "")]
        assert (here.stopped_by, there.stopped_by) == (["vera"], ["floor test/vera"])
        await listed(floors, lambda entry: entry["floor"]["stopped"])
        answer = await floors.client.post("/api/v1/floors/stop", json={"floors": ["cellar"]})
        assert (answer.status_code, answer.json()["type"]) == (404, "urn:fognav:no_floor")


@live
async def test_floor_that_is_cut_off_is_named_keeps_its_age_and_comes_back_by_itself(floors):
    here, there = Robot(), Robot()
    async with here.on(floors.here, "r1"), there.on(floors.there, "r1"):
        before = await listed(floors, drives)
        floors.proxy.cut()
        lost = await listed(floors, lambda entry: not entry["reachable"] and entry["age_s"] > 3.0)
        assert (lost["trouble"], lost["heard"] >= before["heard"]) == ("silent", True)
        assert drives({**lost, "reachable": True}), "what was known of it is shown, with its age"
        stops = {each["id"]: each for each in (await floors.client.post("/api/v1/floors/stop", json={})).json()}
        assert (stops["test"]["acknowledged"], stops["upstairs"]["acknowledged"]) == (True, False)
        assert "press again" in stops["upstairs"]["detail"]
        floors.proxy.heal()
        back = await listed(floors, lambda entry: entry["reachable"] and entry["age_s"] <= 3.0)
        assert (back["trouble"], len(here.stopped_at)) == ("", 1)
        # The console that has the list is away: the other floor notices nothing, and is stopped at its own address.
        floors.hub.kill("console_service")
        async with httpx.AsyncClient(base_url=await floors.upstairs.ready("console_service")) as client:
            async with asyncio.timeout(60):  # without a token it takes 10 s until it knows that there is no other robot
                while not (answer := await client.post("/api/v1/floors/here/stop")).json()["acknowledged"]:
                    assert "may not know all robots" in answer.json()["detail"]
                    await asyncio.sleep(1.0)
        assert answer.status_code == 200
        assert there.stopped_at


@live
async def test_robot_that_does_not_answer_and_a_token_that_is_revoked_are_named_and_the_stop_arrives(floors):
    async with Robot(answers=False).on(floors.there, "r1"):
        await listed(floors, drives)
        (stop,) = (await floors.client.post("/api/v1/floors/stop", json={"floors": ["upstairs"]})).json()
        assert (stop["acknowledged"], [each["stopped"] for each in stop["robots"]]) == (False, [False])
        assert "r1" in stop["detail"]
        assert "on the spot" in stop["detail"]
        revoke_token(floors.upstairs.folder / "tokens.toml", "floor test")
        refused = await listed(floors, lambda entry: entry["trouble"] == "refused")
        assert "fognav token create" in refused["detail"]
        (stop,) = (await floors.client.post("/api/v1/floors/stop", json={"floors": ["upstairs"]})).json()
        assert "r1" in stop["detail"], "a stop needs no token"


@live
async def test_floor_whose_planner_is_away_acknowledges_no_stop(floors):
    await listed(floors, lambda entry: entry["reachable"])
    floors.upstairs.kill("planner")
    (stop,) = (await floors.client.post("/api/v1/floors/stop", json={"floors": ["upstairs"]})).json()
    assert stop["acknowledged"] is False
    assert "planner" in stop["detail"]
    assert "on the spot" in stop["detail"]


class Planner:
    """The way to a planner that knows robots, and lists them for those who may read; `stopped` are their ids."""

    def __init__(self, robots: list[str] | None) -> None:
        self.robots = robots
        self.stopped: list[str] = []
        self.asked = 0
        self.first_stop = asyncio.Event()

    async def readiness(self) -> dict[str, str]:
        self.asked += 1
        await asyncio.sleep(0)
        return {}

    async def send(self, service, request, target, _body):
        made = httpx.Request(request.method, f"http://{service}{target.decode()}")
        if request.method == "GET":
            await self.first_stop.wait()  # a known robot's stop never waits for the list
            if self.robots is None:
                return httpx.Response(401, json={"detail": "who are you?"}, request=made)
            return httpx.Response(200, json=[{"id": robot, "pose": None} for robot in self.robots], request=made)
        self.stopped.append(target.decode().split("/")[-2])
        self.first_stop.set()
        return httpx.Response(200, json={"accepted": True}, request=made)


@pytest.mark.parametrize(
    ("robots", "connected", "stopped", "remedy"),
    [
        (["r1", "r9"], True, ["r1", "r9"], ""), (["r1", "r9"], False, ["r1", "r9"], ""),
        (None, True, ["r1"], "less than 10 s ago"), (None, False, ["r1"], "not connected to zenoh"),
    ],
)  # fmt: skip
async def test_stop_is_acknowledged_only_by_who_knows_all_robots_and_known_ones_never_wait(
    robots, connected, stopped, remedy
):
    site = RobotSite(id="r1", start=Pose(x=1.0, y=1.0, theta=0.0), radius=0.17, height=0.1)
    health, planner = Health("zenoh"), Planner(robots)
    health.set("zenoh", ok=connected)
    floor = OwnFloor(ConsoleCore("lab", "r", robots=[site]), planner, health, time.monotonic)
    stop = await floor.stop(Request({"type": "http", "method": "POST", "headers": []}))
    assert (planner.stopped, [each.id for each in stop.robots]) == (stopped, stopped)
    assert (stop.acknowledged, remedy in stop.detail) == (not remedy, True)
    assert not remedy or "press again" in stop.detail


async def test_services_are_asked_once_a_second_however_many_floors_ask():
    times, planner = [], Planner([])
    floor = OwnFloor(ConsoleCore("lab", "r"), planner, Health("zenoh"), lambda: times[-1])
    for now, asked in ((100.0, 1), (100.9, 1), (101.0, 2)):
        times.append(now)
        await asyncio.gather(*(floor.view() for _ in range(50)))
        assert planner.asked == asked


@pytest.mark.parametrize("dead", [0, 1])
async def test_floor_with_two_machines_is_seen_and_stopped_at_once_though_one_of_them_is_dead(dead):
    view = FloorView(site="up", not_ready={}, robots=[], blocked=[], unknown=[], stopped=False)

    async def answer(reader, writer):
        asked = (await reader.readuntil(b"\r\n\r\n")).split()[0]
        said = view if asked == b"GET" else FloorStop(id="up", acknowledged=True, robots=[])
        body = msgspec.json.encode(said)
        writer.write(b"HTTP/1.1 200 OK\r\nConnection: close\r\nContent-Length: %d\r\n\r\n" % len(body) + body)
        writer.close()

    async def say_nothing(reader, writer):
        await reader.read()
        writer.close()

    async with AsyncExitStack() as stack:
        addresses = []
        for number in (0, 1):
            server = await asyncio.start_server(say_nothing if number == dead else answer, "127.0.0.1")
            await stack.enter_async_context(server)
            addresses.append(f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}")
        hub = Hub([Peer("up", tuple(addresses), "secret", None)], SystemClock())
        running = asyncio.create_task(hub.run())
        stack.callback(running.cancel)
        begun = time.monotonic()
        assert (await hub.stop("up", "anna")).acknowledged
        assert time.monotonic() - begun < 1.0
        async with asyncio.timeout(10.0):
            while True:
                if hub.entries()[0].reachable:
                    break
                await asyncio.sleep(0.05)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


@pytest.mark.parametrize("mode", ["EGRESS", "DOCK", "TELEOP"])
async def test_floor_is_not_stopped_while_a_robot_moves_that_is_not_enabled(mode):
    core = ConsoleCore("lab", "r", robots=[])
    floor = OwnFloor(core, Planner([]), Health("zenoh"), time.monotonic)
    for each, stopped in (("HOLD", True), (mode, False), ("FAULT", True)):
        said = replace(DRIVING, mode=each, enabled=False)
        core.handlers()[ch.ROBOT_STATE]({"robot": "r1"}, said, Moment(time.monotonic(), time.time()))
        assert (await floor.view()).stopped is stopped, each


GOAL = RobotGoal(goal_id="g", pose=Pose(x=1.0, y=1.0, theta=0.0))
PATH = RobotPath(
    plan_id=1,
    planner_epoch=1,
    goal_id="g",
    points=[(0.0, 0.0), (1.0, 1.0)],
    released_length=1.0,
    map_epoch=1,
    map_seq=0,
)
RELEASE = RobotRelease(plan_id=1, planner_epoch=1, released_length=1.0, map_epoch=1, map_seq=0)


@pytest.mark.parametrize(
    ("channel", "message"), [(ch.ROBOT_GOAL, GOAL), (ch.ROBOT_PATH, PATH), (ch.ROBOT_RELEASE, RELEASE)]
)
@pytest.mark.parametrize("is_of_site", [True, False])
async def test_robot_that_is_off_becomes_away_and_stays_listed_while_the_planner_goes_on_about_it(
    channel, message, is_of_site
):
    site = RobotSite(id="r1", start=Pose(x=1.0, y=1.0, theta=0.0), radius=0.17, height=0.1)
    core = ConsoleCore("lab", "r", robots=[site] if is_of_site else [])
    core.handlers()[ch.ROBOT_STATE]({"robot": "r1"}, DRIVING, Moment(100.0, 1e9))
    now = 100.0
    for now in (100.0 + step for step in range(1, 1001)):
        core.handlers()[channel]({"robot": "r1"}, message, Moment(now, 1e9 + now))
        core.tick(Moment(now, 1e9 + now))
    (robot,), _ = core.floor(now)
    assert (robot.id, robot.age_s) == ("r1", 1000.0)
    assert robot.age_s > AWAY_S
    core.handlers()[ch.ROBOT_STATE]({"robot": "r1"}, DRIVING, Moment(now, 1e9 + now))
    assert core.floor(now)[0][0].age_s == 0.0, "it is heard again"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[floors.up]\naddress = "https://up.local:8004"\ncredentials = "none.toml"', "have no token"),
        ('[floors.up]\naddress = "http://up.local:8004"\ncredentials = "own.toml"', "not encrypted"),
        ('[floors.up]\naddress = "https://up.local:80o4"\ncredentials = "own.toml"', "Correct its port"),
        ('[floors.up]\naddress = "up.local"\ncredentials = "own.toml"', "floors.toml"),
        ("[floors", "not valid TOML"),
    ],
)
def test_list_of_floors_that_can_t_be_used_is_refused_with_the_reason(tmp_path, text, said):
    (tmp_path / "own.toml").write_text('user = "campus"\ntoken = "secret"')
    (tmp_path / "none.toml").write_text('user = "campus"')
    (tmp_path / "floors.toml").write_text(text)
    with pytest.raises(SettingsError, match=said):
        read_peers(tmp_path / "floors.toml", "here")


def test_list_of_a_floor_in_containers_is_empty_until_somebody_writes_it():
    assert read_peers(Path(__file__).parents[3] / "deploy" / "floors" / "floors.toml", "here") == []


def test_all_machines_may_have_the_same_list_and_each_leaves_itself_out(tmp_path):
    (tmp_path / "own.toml").write_text('user = "campus"\ntoken = "secret"')
    entry = 'address = "https://{0}.local:8004/"\ncredentials = "own.toml"\n'
    (tmp_path / "floors.toml").write_text("".join(f"[floors.{each}]\n{entry.format(each)}" for each in ("up", "here")))
    assert [(peer.id, peer.addresses) for peer in read_peers(tmp_path / "floors.toml", "here")] == [
        ("up", ("https://up.local:8004",))
    ]
