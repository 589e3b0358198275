"""Robots as devices of Home Assistant: the running bridge, with a real broker, router and console behind it."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import os
import re
import time
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import msgspec
import numpy as np
import pytest
from manual_clock import ManualClock
from PIL import Image

from console_service.core import ConsoleCore
from fog_bridges.floor import WAITS, Request
from fog_bridges.heard import SILENT
from fog_bridges.home_assistant import HomeAssistant, activity, discovery, report
from fog_bridges.picture import Picture
from fog_bridges.service import STOPS_AT_ONCE, HomeAssistantBridge
from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Moment
from fog_contracts.messages import RobotState
from fog_contracts.messages.basics import SENTENCE_MAX
from fog_contracts.replica import MasterMap, decode_map
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_edge import MqttEdge


class Home:
    """Home Assistant, as far as MQTT goes: what it was told last on each topic."""

    def __init__(self) -> None:
        self.told: dict[tuple[str, str], str] = {}

    def of(self, channel: ch.Channel, robot: str = "r1") -> str:
        return self.told.get((channel.name, robot), "")

    def report(self) -> dict[str, object]:
        return json.loads(self.of(ch.ROBOT_REPORT) or "{}")


HOSTILE = "<script>alert(1)</script>{{ states }}\u202e\u2028\x85".ljust(SENTENCE_MAX, "x")


@asynccontextmanager
async def robot_state(zenoh):
    """Publish a robot that waits, with a hostile reason."""
    state = RobotState(
        mode="HOLD", reasons=[HOSTILE] * 2, enabled=False, battery=0.63, goal_id=None,
        map_epoch=0, map_seq=0, plan_id=None, awaits_operator=True,
    )  # fmt: skip

    async def publish() -> None:
        while True:
            zenoh.publish(ch.ROBOT_STATE, msgspec.structs.replace(state, stamp=time.time()), robot="r1")
            await asyncio.sleep(0.2)

    publishing = asyncio.create_task(publish())
    yield
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)


@asynccontextmanager
async def home_of(fog):
    """Connect with Home Assistant's own user and rights."""
    own = Credentials.read(fog.security.credentials("home-assistant"))
    mqtt = MqttEdge(fog.mosquitto.url, "home-assistant", SystemClock(), site="test", credentials=own)
    home = Home()
    channels = (ch.HOME_ASSISTANT_ROBOT, ch.ROBOT_REPORT, ch.ROBOT_REFUSAL, ch.MAP_PICTURE, ch.MAP_PICTURE_PLACE,
                ch.BRIDGE_AVAILABILITY)  # fmt: skip
    for channel in channels:

        def take(ids, text, channel=channel) -> None:
            home.told[channel.name, ids.get("robot", ids.get("robot_device", "").removeprefix("robot_"))] = text

        mqtt.on(channel, take)
    running = asyncio.create_task(mqtt.run())
    await mqtt.wait_connected()
    yield home, mqtt
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


@pytest.fixture
async def bridge(all_services, tokens, tmp_path):
    """Run console-service and bridge over the services; yield the fog."""
    ports = {
        name: await all_services.ready(module)
        for name, module in (("AGGREGATOR", "hazard_aggregator"), ("MAP", "map_service"), ("PLANNER", "planner"))
    }
    all_services.start("console_service", **{f"FOGNAV_{name}_URL": url for name, url in ports.items()})
    token = tmp_path / "bridge.token"
    token.write_text(tokens["operator"]["Authorization"].removeprefix("Bearer "))
    all_services.start(
        "fog_bridges",
        FOGNAV_ADAPTERS="home-assistant",
        FOGNAV_CONSOLE_URL=await all_services.ready("console_service"),
        FOGNAV_TOKEN_FILE=str(token),
        FOGNAV_CREDENTIALS_FILE=str(all_services.security.credentials("bridge")),
    )
    await all_services.ready("fog_bridges")
    yield all_services
    for module in ("fog_bridges", "console_service"):
        all_services.kill(module)


PYTHON = os.environ.get("FOGNAV_HOME_ASSISTANT", "")
PEER = Path(__file__).parents[2] / "tests" / "support" / "home_assistant.py"


class HomeItself:
    """Home Assistant's own integration, in a process of its Python (`tests/support/home_assistant.py`)."""

    @classmethod
    @asynccontextmanager
    async def of(cls, fog, folder: Path):
        own, at = Credentials.read(fog.security.credentials("home-assistant")), urlsplit(fog.mosquitto.url)
        broker = {
            "broker": at.hostname, "port": at.port, "username": own.user, "password": own.passwords["mqtt"],
            **({"certificate": own.authority} if at.scheme == "mqtts" else {}),
        }  # fmt: skip
        command = (PYTHON, str(PEER), str(folder), json.dumps(broker))
        process = await asyncio.create_subprocess_exec(
            *command, stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE, limit=1 << 22
        )
        try:
            yield cls(process)
        finally:
            process.kill()
            await process.wait()

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    async def ask(self, question: str):
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{question}\n".encode())
        return json.loads(await self._process.stdout.readline())

    async def wait(self, entity: str, part: str) -> dict[str, list]:
        """Wait until an entity's state has this part; return those of all."""
        deadline = time.monotonic() + 60.0
        while part not in (found := await self.ask("states")).get(entity, [""])[0]:
            assert time.monotonic() < deadline, (entity, part, found, await self.ask("log"))
            await asyncio.sleep(0.2)
        return found


@pytest.mark.live
@pytest.mark.skipif(
    not PYTHON,
    reason="needs Home Assistant: uv venv --python 3.13 H, uv pip install --python H homeassistant paho-mqtt, "
    "FOGNAV_HOME_ASSISTANT=H/bin/python",
)
async def test_home_assistant_itself_shows_all_of_a_robot_and_its_services_reach_the_floor(bridge, tmp_path, until):
    async with bridge.edges() as (_, zenoh, _connect), HomeItself.of(bridge, tmp_path) as home:
        async with robot_state(zenoh):
            await home.wait("sensor.r1_battery", "63")
            found = await home.wait("image.r1_map", "20")  # the time of the picture
            expected = {
                "vacuum.r1": "idle", "sensor.r1_mode": "HOLD", "sensor.r1_why_it_stands": f"{HOSTILE}; {HOSTILE}"[:255],
                "binary_sensor.r1_charging": "off", "binary_sensor.r1_problem": "off",
                "binary_sensor.r1_waits_for_an_operator": "on", "select.r1_goal": "no goal",
            }  # fmt: skip
            assert {entity: found[entity][0] for entity in expected} == expected
            assert {
                "button.r1_stop",
                "button.r1_end_the_mission",
                "sensor.r1_refused_order",
                "image.r1_map",
            } <= found.keys()
            assert len(found["image.r1_map"][1]["calibration_points"]) == 3
            for call, order in (
                ('button press {"entity_id": "button.r1_stop"}', "stop"),
                ('vacuum return_to_base {"entity_id": "vacuum.r1"}', "return_to_base"),
                ('select select_option {"entity_id": "select.r1_goal", "option": "no goal"}', "goal no goal"),
            ):
                await home.ask(f"call {call}")
                said = re.compile(rf'"order": ?"{order}"')
                await until(lambda said=said: said.search(bridge.log("fog_bridges")), f"the floor is asked: {order}")
                if order == "stop":  # the robot of this test does not answer
                    await home.wait("sensor.r1_refused_order", "r1")
        await home.wait("vacuum.r1", "error")  # the robot has fallen silent
        await home.wait("binary_sensor.r1_problem", "on")
        assert await home.ask("log") == []
        bridge.kill("console_service")
        await home.wait("vacuum.r1", "unavailable")
        bridge.start("console_service")


@pytest.mark.live
async def test_robot_is_a_device_with_state_map_and_orders_and_refusals_are_told(bridge, tokens, until):
    async with bridge.edges() as (_, zenoh, _connect), home_of(bridge) as (home, mqtt):
        async with robot_state(zenoh):
            await until(lambda: home.report().get("mode") == "HOLD", "it is heard", lambda: str(home.report()))
            assert home.report()["battery"] == 63
            await until(lambda: home.of(ch.HOME_ASSISTANT_ROBOT), "its device is known", lambda: str(home.told.keys()))
            assert home.report()["why"] == f"{HOSTILE}; {HOSTILE}"[:255]
            assert home.report()["waits_for_operator"] == "ON"
            device = json.loads(home.of(ch.HOME_ASSISTANT_ROBOT))
            assert device["availability_topic"] == "fog/v1/test/bridge/availability"
            assert home.of(ch.BRIDGE_AVAILABILITY, "") == "online"
            topics = {part["command_topic"] for part in device["cmps"].values() if "command_topic" in part}
            assert topics == {"fog/v1/test/robots/r1/order"}
            await until(lambda: home.of(ch.MAP_PICTURE_PLACE, ""), "the map is there")
            with Image.open(io.BytesIO(base64.b64decode(home.of(ch.MAP_PICTURE, "")))) as picture:
                assert picture.size == (160, 120)
            corner = json.loads(home.of(ch.MAP_PICTURE_PLACE, ""))["calibration_points"][0]
            assert corner == {"vacuum": {"x": 0.0, "y": 6.0}, "map": {"x": 0, "y": 0}}
            for order, words in (
                ("stop", "r1"),  # the robot of this test does not answer
                ("goal moon", "is no command"),
                ("enable", "is no command"),
            ):
                home.told.pop((ch.ROBOT_REFUSAL.name, "r1"), None)
                await mqtt.publish(ch.ROBOT_ORDER, order, robot="r1")
                await until(lambda words=words: words in home.of(ch.ROBOT_REFUSAL), f"{order} is refused: {words}")
        await until(lambda: home.report()["problem"] == "ON", "it is silent", lambda: str(home.report()))
        async with httpx.AsyncClient(headers=tokens["viewer"]) as person:
            trail = (await person.get(f"{await bridge.ready('map_service')}/api/v1/audit")).json()
        assert "anna/home-assistant" in {entry["who"] for entry in trail}, trail
        bridge.kill("console_service")
        await until(lambda: home.of(ch.BRIDGE_AVAILABILITY, "") == "offline", "nobody knows the floor's state")
        bridge.start("console_service")


def view(**state: object) -> dict[str, object]:
    return {"state": {"mode": "NORMAL", "reasons": [], "battery": 0.5, **state}, "goal": None}


@pytest.mark.parametrize(
    ("state", "under_way", "said"),
    [
        ({}, False, "idle"), ({"mode": "FAULT", "docked": True}, True, "error"), ({"docked": True}, False, "docked"),
        ({"mode": "DOCK"}, False, "returning"), ({"mode": "NORMAL"}, True, "cleaning"),
        ({"mode": "HOLD"}, True, "paused"), ({"mode": "NORMAL", "goal_reached": True}, True, "idle"),
    ],
)  # fmt: skip
def test_state_has_home_assistants_word(state, under_way, said):
    assert activity(state, under_way=under_way) == said


BEGIN, END = ("hello", {"fresh": True}), ("ready", {})


def told(core: HomeAssistant, now: float, *events: tuple[str, dict[str, object]]) -> list[dict[str, object]]:
    """Return the reports of robots that are published after events at one time (s), oldest first."""
    found = [publication for name, data in events for publication in core.on_event(name, data, now)]
    return [json.loads(each.message) for each in [*found, *core.tick(now)] if each.channel is ch.ROBOT_REPORT]


def r1(**state: object) -> tuple[str, dict[str, object]]:
    """What is told of a robot with a mission."""
    return "robot", {"id": "r1", "value": {**view(**state), "goal": {"goal_id": "g1", "place": "b"}}}


def test_orders_become_requests_of_operators_and_nothing_enables():
    core = HomeAssistant("lab")
    told(core, 0.0, BEGIN, ("place", {"id": "b", "value": {}}), END, r1(stamp=1.0))
    ask = partial(core.on_command, now=0.0)
    assert ask("r1", "stop") == Request("POST", "/api/v1/robots/r1/stop")
    assert ask("r1", "goal b") == Request("PUT", "/api/v1/robots/r1/goal", {"place": "b"})
    for waiting in ({"enabled": False}, {"enabled": True, "awaits_operator": True}):
        told(core, 0.0, r1(**waiting))
        assert ask("r1", "goal b") == WAITS, "it would drive off at the next enable"
    assert ask("r1", "goal no goal") == ask("r1", "cancel")
    assert ask("r1", "return_to_base").body == {"kind": "dock"}
    for robot, text in (("r1", "enable"), ("r1", "reset"), ("r1", "goal ../x"), ("r2", "stop"), ("r1", "")):
        assert isinstance(ask(robot, text), str), text


def test_robot_that_tells_nothing_for_5_s_has_a_problem_until_it_is_heard_again_and_takes_no_goal():
    core = HomeAssistant("lab")
    (first,) = told(core, 0.0, BEGIN, ("place", {"id": "b", "value": {}}), r1(stamp=1.0), END)
    assert (first["state"], first["problem"]) == ("cleaning", "OFF"), "it is not silent before it could be heard"
    assert "silent" in core.on_command("r1", "goal b", 0.1), "its last state may be long ago"
    told(core, 1.0, r1(stamp=2.0))
    assert isinstance(core.on_command("r1", "goal b", 5.9), Request)
    assert told(core, 5.9, r1(stamp=2.0)) == [], "the same state told again is no sign of life"
    (silent,) = told(core, 6.0)
    found = {name: silent[name] for name in ("state", "mode", "problem", "why", "battery", "goal")}
    assert found == {
        "state": "error", "mode": "unknown", "problem": "ON", "why": SILENT, "battery": 50, "goal": "b",
    }  # fmt: skip
    assert core.on_command("r1", "goal b", 6.0).startswith(SILENT)
    assert core.on_command("r1", "stop", 6.0) == Request("POST", "/api/v1/robots/r1/stop")
    assert told(core, 7.0) == [], "once is enough"
    (back,) = told(core, 60.0, r1(stamp=60.0))
    assert (back["state"], back["problem"], back["why"]) == ("cleaning", "OFF", "nothing keeps it")


def test_nobody_is_called_silent_while_the_floor_is_lost_and_who_was_silent_stays_so_until_heard():
    core = HomeAssistant("lab")
    told(core, 0.0, BEGIN, ("place", {"id": "b", "value": {}}), r1(stamp=1.0), END, r1(stamp=2.0))
    core.on_lost()
    assert told(core, 100.0) == []
    assert "floor" in core.on_command("r1", "goal b", 100.0)
    assert told(core, 101.0, ("hello", {"fresh": False}), END) == []
    assert told(core, 105.9) == []
    assert [each["problem"] for each in told(core, 106.0)] == ["ON"]
    core.on_lost()
    assert told(core, 200.0, BEGIN, ("place", {"id": "b", "value": {}}), r1(stamp=2.0), END) == []
    assert [each["problem"] for each in told(core, 201.0, r1(stamp=201.0))] == ["OFF"]


def devices(core: HomeAssistant, *events: tuple[str, dict[str, object]], now: float = 0.0) -> list[tuple[str, bool]]:
    """Return whose descriptions are published (True) and deleted (False) after events at one time (s)."""
    found = [publication for name, data in events for publication in core.on_event(name, data, now)]
    found += core.tick(now)
    return [
        (each.ids["robot_device"], each.message is not None)
        for each in found
        if each.channel is ch.HOME_ASSISTANT_ROBOT
    ]


def test_robot_that_is_gone_is_forgotten_and_one_that_a_new_run_has_not_told_of_yet_is_not():
    core = HomeAssistant("lab")
    robots = [("robot", {"id": name, "value": view()}) for name in ("r1", "r2")]
    assert devices(core, BEGIN, *robots, END) == [("robot_r1", True), ("robot_r2", True)]
    assert devices(core, *robots, BEGIN, *robots, END) == []
    assert devices(core, ("robot", {"id": "r2", "value": None})) == [("robot_r2", False)]
    assert devices(core, BEGIN, END) == [], "another run of the console does not know it yet"
    assert devices(core, now=599.0) == []
    assert devices(core, now=600.0) == [("robot_r1", False)]
    assert devices(core, now=601.0) == []


def test_device_that_an_earlier_run_has_left_of_a_robot_that_the_site_has_no_more_is_deleted():
    core = HomeAssistant("lab")
    for robot in ("r1", "r9"):
        core.on_kept(robot)
    assert devices(core, BEGIN, ("robot", {"id": "r1", "value": view()}), END) == [("robot_r1", True)]
    core.on_kept("r1")
    assert devices(core, now=600.0) == [("robot_r9", False)]


class Slow:
    """A broker's connection and a floor whose robot r2 answers no command until it is `released`."""

    connected = True

    def __init__(self) -> None:
        self.order, self.released, self.hangs = None, asyncio.Event(), False
        self.sent: list[tuple[str, str]] = []
        self.told: list[tuple[str, str]] = []

    def on(self, channel, handler) -> None:
        self.order = handler if channel is ch.ROBOT_ORDER else self.order

    def on_connect(self, _callback) -> None: ...
    def publish_nowait(self, *_, **__) -> None: ...

    async def run(self) -> None:
        await asyncio.Event().wait()

    async def publish(self, _channel, text, robot) -> None:
        self.told.append((robot, text))

    async def send(self, request: Request) -> str:
        self.sent.append((request.method, request.path.removeprefix("/api/v1/robots/")))
        if self.hangs or request.path.endswith("commands"):
            await self.released.wait()
        return "it has no mission" if request.method == "DELETE" else ""


@pytest.fixture
async def slow():
    """A running adapter, its slow floor with the robots r1 and r2, and its clock."""
    floor, clock = Slow(), ManualClock()
    adapter = HomeAssistantBridge(HomeAssistant("lab"), floor, clock)
    for name, data in (("hello", {"fresh": True}), ("place", {"id": "b", "value": {}}), ("ready", {}),
                       *(("robot", {"id": robot, "value": view()}) for robot in ("r1", "r2"))):  # fmt: skip
        adapter.on_event(name, data)
    running = asyncio.create_task(adapter.run(floor, SystemClock()))
    await asyncio.sleep(0)
    yield floor, clock
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


async def test_stop_waits_for_no_other_order_ends_the_mission_and_no_earlier_order_sends_the_robot_again(slow):
    floor, _ = slow
    for robot, text in (("r2", "return_to_base"), ("r1", "goal b"), ("r1", "stop")):
        floor.order({"robot": robot}, text)
    await asyncio.sleep(0.05)
    assert sorted(floor.sent) == [("DELETE", "r1/goal"), ("POST", "r1/stop"), ("POST", "r2/commands")]
    assert floor.told == [("r1", "")]
    floor.released.set()
    floor.order({"robot": "r1"}, "goal b")
    await asyncio.sleep(0.05)
    assert floor.sent[3:] == [("PUT", "r1/goal")], "the one that was given after the stop"
    stopped = "'goal b' was not carried out: robot r1 was stopped meanwhile"
    assert floor.told[1:] == [("r2", ""), ("r1", stopped), ("r1", "")]


async def test_order_that_has_waited_for_long_is_refused(slow):
    floor, clock = slow
    for robot in ("r2", "r1"):
        floor.order({"robot": robot}, "return_to_base")
    await asyncio.sleep(0.05)
    clock.advance(11.0)
    floor.released.set()
    await asyncio.sleep(0.05)
    assert floor.sent == [("POST", "r2/commands")]
    assert floor.told == [("r2", ""), ("r1", "'return_to_base' has waited for 11 s: send it again")]


async def test_flood_of_orders_fills_neither_the_memory_nor_the_broker(slow):
    floor, _ = slow
    floor.hangs = True
    for number in range(1000):
        for robot in ("r1", f"other-{number}"):
            floor.order({"robot": robot}, "stop")
    await asyncio.sleep(0.05)
    assert floor.sent == [("POST", "r1/stop")] * STOPS_AT_ONCE
    assert floor.told == [], "the broker would keep a topic for each name"


EVERY = {"p", "name", "unique_id", "state_topic"}
KEYS = {
    "vacuum": EVERY | {"supported_features", "command_topic", "payload_stop", "payload_return_to_base"},
    "sensor": EVERY | {"device_class", "unit_of_measurement", "value_template"},
    "binary_sensor": EVERY | {"device_class", "value_template"},
    "select": EVERY | {"options", "command_topic", "command_template", "value_template"},
    "button": EVERY - {"state_topic"} | {"command_topic", "payload_press"},
    "image": EVERY - {"state_topic"} | {"image_topic", "image_encoding", "content_type", "json_attributes_topic"},
}
"""Of the keys that Home Assistant knows, those that we use (home-assistant/core 2026.2.3, `components/mqtt/*.py` and
`abbreviations.py`). Others it leaves out without a word."""


def test_description_of_a_robot_has_keys_only_that_home_assistant_knows():
    found = json.loads(discovery("lab", "r1", ["b"]))
    assert found.keys() == {"dev", "o", "cmps", "availability_topic"}
    assert found["dev"].keys() <= {"ids", "name", "mf", "mdl"}
    for component in found["cmps"].values():
        assert component.keys() <= KEYS[component["p"]], component
        assert set(component.get("supported_features", ())) <= {"start", "pause", "stop", "return_home", "locate"}


def test_broker_that_lost_everything_is_told_again():
    core = HomeAssistant("lab")
    events = BEGIN, ("robot", {"id": "r1", "value": view()}), END
    first = [each for name, data in events for each in core.on_event(name, data, 0.0)]
    assert len(first) == 2
    assert list(core.everything()) == first


def test_words_of_a_robot_and_many_places_keep_the_limits_of_their_topics():
    long = view(reasons=["x" * 500] * 8)
    assert len(report(long, ())) <= ch.ROBOT_REPORT.limit
    assert len(json.loads(report(long, ()))["why"]) == 255
    assert len(discovery("s" * 32, "r" * 32, [f"place-{n:026}" for n in range(100)])) <= ch.HOME_ASSISTANT_ROBOT.limit


def events_of(core: ConsoleCore) -> list[tuple[str, dict[str, object]]]:
    """Return what a reader is told that has just come, tiles and map, encoding what waits for that."""
    while jobs := core.tile_jobs(100):
        for job in jobs:
            job.run()
            core.add_tile(job)
    told = [(each.key[0], json.loads(each.data)) for each in reversed(list(core.log.after(0)))]
    return [BEGIN, *told, END]


def unknown_share(picture: Picture) -> float:
    """Return the share of a picture's pixels that have the grey of the unknown."""
    drawn = picture.draw()
    assert drawn is not None
    with Image.open(io.BytesIO(base64.b64decode(drawn[0]))) as image:
        pixels = np.asarray(image.convert("RGB"))
    return float(np.mean((abs(pixels.astype(int) - 205) < 8).all(axis=2)))


def test_picture_of_a_bridge_that_starts_later_has_the_whole_map_and_so_has_one_after_another_map():
    at, core, along = Moment(1.0, 1.0), ConsoleCore("test", "r"), Picture()
    for epoch, (width, height) in enumerate([(300, 200), (260, 400)], 1):
        free = np.zeros((height, width), np.uint8)
        master = MasterMap("test", GridGeometry(width, height, 0.05, 0.0, 0.0), free, free, epoch)
        core.load(decode_map(master.snapshot()), 0.0)
        events_of(core)
        for delta in master.write([("cost", Window(0, 0, 1, 1), np.full((1, 1), 254, np.uint8))], [], []):
            core.handlers()[ch.MAP_DELTA]({}, delta, at)  # raises the version of the map, and changes one tile of many
        found = events_of(core)
        names = [name for name, _ in found]
        assert names.index("costmap") < names.index("map"), "tiles are told first: what this test is about"
        for picture in (Picture(), along):
            for name, data in found:
                picture.on_event(name, data)
            assert unknown_share(picture) == 0.0
