"""Two floors with servers, planners and routers of their own, one robot and one lift: the robot is on one of them."""

from __future__ import annotations

import asyncio
import json
import math
import os
import time
from contextlib import AsyncExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import programs
import pytest
from redis.asyncio import Redis

from fog_contracts import channels as ch
from fog_contracts.commands import CommandGate
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.handover import next_berth
from fog_contracts.messages import (
    Berth,
    CommandReply,
    LiftState,
    Reason,
    RobotCommand,
    RobotGoal,
    RobotPose,
    RobotState,
)
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import save_map
from fog_runtime.transports.zenoh_edge import ZenohEdge

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

pytestmark = pytest.mark.live

KEY = "ab" * 32
MACHINE = '[base]\ndriver = "roomba600"\n[lidar]\ndriver = "rplidar-a1"\n[body]\nradius_m = 0.17\n'
SITE = """
id = "{id}"
map = "map.yaml"
robots = [
    {{ id = "r1", start = {{ x = 1.0, y = 1.0, theta = 0.0 }}, radius = 0.17 }},
    {{ id = "r2", start = {{ x = 1.0, y = 1.0, theta = 0.0 }}, radius = 0.17 }},
    {{ id = "r3", start = {{ x = 1.0, y = 1.0, theta = 0.0 }}, radius = 0.17 }},
    {{ id = "r5", start = {{ x = 1.0, y = 1.0, theta = 0.0 }}, radius = 0.17 }},
    {{ id = "r4", start = {{ x = 3.0, y = 1.5, theta = 0.0 }}, radius = 0.17 }},
]
[places.desk]
x = {desk}
y = 5.0
[[lifts]]
id = "north"
cabin = {{ x = 6.8, y = 2.0, theta = 3.1 }}
wait = {{ x = 4.0, y = 2.0, theta = 0.0 }}
floors = ["ground", "upstairs"]
"""


def room_with_cabin() -> StaticMap:
    """Return a room of 8 x 6 m with a cabin in its corner, whose door is 1.2 m wide."""
    cells = np.zeros((120, 160), dtype=np.uint8)
    for rows, columns in (((0, 1), (0, 160)), ((119, 120), (0, 160)), ((0, 120), (0, 1)), ((0, 120), (159, 160)),
                          ((60, 62), (114, 160)), ((0, 28), (114, 116)), ((52, 62), (114, 116))):  # fmt: skip
        cells[slice(*rows), slice(*columns)] = 254
    return StaticMap(GridGeometry(160, 120, 0.05, 0.0, 0.0), cells)


@pytest.fixture(scope="module")
def floors(tmp_path_factory: pytest.TempPathFactory, open_fog: Any) -> dict[str, Any]:
    """Return two fogs in which a map-service runs; nothing connects them."""
    made: dict[str, Any] = {}
    for name, desk in (("ground", 2.0), ("upstairs", 3.0)):
        fog = made[name] = open_fog(tmp_path_factory.mktemp(name))
        (fog.site / "site.toml").write_text(SITE.format(id=name, desk=desk))
        save_map(fog.site / "map", room_with_cabin())
        (fog.folder / "operator.key").write_text(KEY)
        fog.environment["FOGNAV_OPERATOR_KEY_FILE"] = str(fog.folder / "operator.key")
        fog.start("map_service")
    return made


@pytest.fixture(scope="module")
def names() -> Iterator[str]:
    """Return ids of robots, one for each test."""
    return iter(("r1", "r2", "r3", "r5"))


class Machine:
    """The real processes of a simulated robot; an agent that ends is started again, as its service manager does."""

    name = "r4"

    def __init__(self, floors: dict[str, Any], folder: Path) -> None:
        self.folder = folder
        wires = folder / "sim"
        wires.mkdir()
        (folder / "robot.toml").write_text(MACHINE)
        lines = ['first = "ground"\n']
        for name, fog in floors.items():
            lines += [
                f'[floors.{name}]\nzenoh_connect = "{fog.router.endpoint}"\nsite_dir = "{fog.site}"\n',
                f'operator_key = "{fog.folder / "operator.key"}"\n',
            ]
        (folder / "known.toml").write_text("".join(lines))
        self.environment = {
            **os.environ, "FOGNAV_ROBOT_FILE": str(folder / "robot.toml"), "FOGNAV_ROBOT": self.name,
            "FOGNAV_BASE_PORT": str(wires / "base"), "FOGNAV_LIDAR_PORT": str(wires / "lidar"),
            "FOGNAV_GUARDIAN_SOCKET": str(folder / "guardian.sock"), "FOGNAV_DATA_DIR": str(folder / "robot"),
            "FOGNAV_RUN_DIR": str(wires), "FOGNAV_NODES": "model", "FOGNAV_TRUTH_LOG": str(folder / "truth.jsonl"),
            "FOGNAV_SITE_DIR": str(floors["ground"].site), "FOGNAV_ZENOH_CONNECT": floors["ground"].router.endpoint,
            "FOGNAV_MQTT_URL": floors["ground"].mosquitto.url,
        }  # fmt: skip
        self.starts = 0

    async def live(self) -> None:
        """Run them until cancelled."""
        running = [self.start("fognav_sim")]
        while not (self.folder / "sim" / "lidar").exists():  # noqa: ASYNC110  # a file tells nobody that it is there
            await asyncio.sleep(0.05)
        running.append(self.start("robot_agent.guardian.watchdog"))
        try:
            while True:
                self.starts += 1
                agent = self.start("robot_agent", FOGNAV_FLOORS_FILE=str(self.folder / "known.toml"))
                running.append(agent)
                while agent.poll() is None:  # noqa: ASYNC110  # a process tells nobody of its end
                    await asyncio.sleep(0.1)
                running.pop()
        finally:
            for program in reversed(running):
                program.terminate()
                program.wait(10.0)

    def start(self, module: str, **more: str) -> programs.Program:
        return programs.start(module, {**self.environment, **more}, self.folder / f"{module}.log")

    def truth(self) -> dict[str, Any]:
        """Return where it really is, and how often it has touched something."""
        return json.loads((self.folder / "truth.jsonl").read_text().splitlines()[-2])


class Robot:
    """A robot that is at its goal as soon as it has one, and whose agent starts anew on another floor."""

    def __init__(self, name: str, floors: dict[str, Any]) -> None:
        self.name, self.floors = name, floors
        self.berth, self.run = Berth(floor="ground"), 0
        self.deaf = False
        """Whether it refuses to be handed over."""
        self.at = (1.0, 1.0)
        self.goal: RobotGoal | None = None
        self.goals: list[tuple[str, str, tuple[float, float]]] = []

    @property
    def boot(self) -> str:
        return f"run-{self.run}"

    async def live(self) -> None:
        """Run its agent again and again, each on the floor that its record names."""
        while True:
            self.run += 1
            self.goal = None
            fog, gate = self.floors[self.berth.floor], CommandGate(self.name, bytes.fromhex(KEY), self.boot)
            async with edge(fog, self.berth.floor) as zenoh:
                before = self.berth
                zenoh.subscribe(ch.ROBOT_GOAL, RobotGoal, lambda _ids, goal: self.on_goal(goal), robot=self.name)
                zenoh.serve(
                    ch.ROBOT_COMMAND, lambda _ids, command, gate=gate: self.answer(gate, command), robot=self.name
                )
                while self.berth == before:
                    zenoh.publish(ch.ROBOT_POSE, self.pose(), robot=self.name)
                    zenoh.publish(ch.ROBOT_STATE, self.state(), robot=self.name)
                    await asyncio.sleep(0.1)

    def on_goal(self, goal: RobotGoal) -> None:
        self.goal = goal
        if goal.pose is not None:
            self.at = (goal.pose.x, goal.pose.y)
            told = (self.berth.floor, goal.goal_id, self.at)
            if told not in self.goals:
                self.goals.append(told)

    def answer(self, gate: CommandGate, command: RobotCommand) -> CommandReply:
        refusal = gate.refusal(command, time.monotonic())
        if refusal is not None or command.given is None or self.deaf:
            return CommandReply(accepted=False, reason=refusal or "deaf")
        after = next_berth(self.berth, command.given)
        if isinstance(after, Reason):
            return CommandReply.refused(after)
        self.berth = after
        return CommandReply(accepted=True, reason="it leaves")

    def pose(self) -> RobotPose:
        x, y = self.at
        return RobotPose(
            x=x, y=y, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=time.time()
        )

    def state(self) -> RobotState:
        has = self.goal is not None and self.goal.pose is not None
        return RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, map_epoch=0, map_seq=0, plan_id=None,
            goal_id=self.goal.goal_id if has and self.goal else None, goal_reached=has, boot=self.boot,
            clock=time.monotonic(), berth=self.berth, floors=list(self.floors), carries_missions=True,
        )  # fmt: skip


@asynccontextmanager
async def edge(fog: Any, site: str) -> AsyncIterator[ZenohEdge]:
    async with ZenohEdge.open(
        connect=[fog.router.endpoint], clock=SystemClock(), role="robot-agent", id="test", site=site
    ) as zenoh:
        yield zenoh


class Building:
    """The floors with their planners, the robot and the lift, and what is told of them."""

    def __init__(self, floors: dict[str, Any], robot: Robot | Machine, tokens: dict[str, dict[str, str]]) -> None:
        self.floors, self.robot, self.tokens = floors, robot, tokens
        self.lift: list[LiftState] = []

    async def call(self, floor: str, method: str, path: str, **body: Any) -> httpx.Response:
        async with httpx.AsyncClient(base_url=await self.floors[floor].ready("planner"), timeout=60.0) as client:
            return await client.request(
                method, f"/api/v1/robots/{self.robot.name}{path}", headers=self.tokens["operator"], **body
            )

    async def send_up(self, path: str = "/floor", body: Any = None) -> None:
        """Order the ride once the planner has heard of the robot."""
        body = body or {"floor": "upstairs", "place": "desk"}
        for _ in range(600):
            answer = await self.call("ground", "PUT", path, json=body)
            if answer.status_code != 504:
                break
            await asyncio.sleep(0.1)
        assert answer.status_code in {200, 201}, answer.text

    async def records(self) -> dict[str, tuple[str, int, bool] | None]:
        """Return what each floor has stored of the robot: its floor, epoch, and whether it is still in the lift."""
        found: dict[str, tuple[str, int, bool] | None] = {}
        for name, fog in self.floors.items():
            async with Redis(**fog.servers.redis_options()) as redis:
                data = await redis.hget(f"fog:{name}:berths", self.robot.name)
            told = None if data is None else json.loads(data)
            found[name] = told and (told["floor"], told["epoch"], told["came_by"] is not None)
        holders = [name for name, told in found.items() if (told[0] == name if told else name == "ground")]
        assert len(holders) <= 1, found
        return found


@pytest.fixture
async def building(
    request: pytest.FixtureRequest,
    floors: dict[str, Any],
    names: Iterator[str],
    tmp_path: Path,
    tokens: dict[str, dict[str, str]],
) -> AsyncIterator[Building]:
    lines = [f'[floors.{name}]\nzenoh_connect = "{fog.router.endpoint}"\n' for name, fog in floors.items()]
    (tmp_path / "floors.toml").write_text("".join(lines))
    environment = {
        **floors["ground"].environment, "FOGNAV_LIFT": "north", "FOGNAV_FLOORS_FILE": str(tmp_path / "floors.toml"),
        "FOGNAV_DATA_DIR": str(tmp_path),
    }  # fmt: skip
    for fog in floors.values():
        fog.start("planner")
    lift = programs.start("fognav_sim.lift", environment, tmp_path / "lift.log")
    robot = Machine(floors, tmp_path) if hasattr(request, "param") else Robot(next(names), floors)
    made = Building(floors, robot, tokens)
    async with AsyncExitStack() as stack:
        for name, fog in floors.items():
            zenoh = await stack.enter_async_context(edge(fog, name))
            if name == "upstairs":
                zenoh.subscribe(ch.LIFT_STATE, LiftState, lambda _ids, state: made.lift.append(state))
        living = asyncio.create_task(robot.live())
        try:
            yield made
        finally:
            living.cancel()
            await asyncio.gather(living, return_exceptions=True)
            lift.kill()
            lift.wait()
            for fog in floors.values():
                if "planner" in fog.processes:
                    fog.kill("planner")


async def test_robot_rides_to_a_place_of_another_floor_and_only_that_floor_has_it(building: Building, until) -> None:
    robot = building.robot
    await building.send_up()
    await until(lambda: len(robot.goals) == 3, "its three goals", lambda: f"{robot.goals} {building.lift[-1:]}")
    assert [(floor, at) for floor, _, at in robot.goals] == [
        ("ground", (4.0, 2.0)), ("ground", (6.8, 2.0)), ("upstairs", (3.0, 5.0)),
    ]  # fmt: skip
    await until(lambda: building.lift[-1].session_id == "", "the lift is free")
    assert await building.records() == {"ground": ("upstairs", 1, True), "upstairs": ("upstairs", 1, False)}
    refused = await building.call("ground", "PUT", "/goal", json={"place": "desk"})
    assert refused.status_code == 409
    assert "it has left for upstairs" in refused.json()["detail"]
    refused = await building.call("ground", "DELETE", "/goal")
    assert (refused.status_code, "cancel it there" in refused.json()["detail"]) == (409, True)
    back = await building.call("ground", "DELETE", "/out-of-service")
    assert back.status_code == 409, "nobody can say that it is here while it is there"


async def test_a_planner_that_dies_between_record_and_robot_hands_it_over_all_the_same(building, until) -> None:
    robot, ground = building.robot, building.floors["ground"]
    robot.deaf = True
    await building.send_up()

    async def has_left() -> bool:
        return (await building.records())["ground"] is not None

    deadline = time.monotonic() + 60.0
    while not await has_left():
        assert time.monotonic() < deadline, ground.log("planner")
        await asyncio.sleep(0.1)
    ground.kill("planner")
    robot.deaf = False
    ground.start("planner")
    await until(lambda: robot.berth.floor == "upstairs", "the robot is handed over", lambda: ground.log("planner"))
    await until(lambda: len(robot.goals) == 3, "its goal upstairs", lambda: str(robot.goals))
    await until(lambda: building.lift[-1].session_id == "", "the lift is free")
    assert (await building.records())["upstairs"][:2] == ("upstairs", 1)


async def test_robot_waits_in_the_lift_for_a_floor_whose_planner_is_down_and_gets_its_goal_once(building, until):
    robot, upstairs = building.robot, building.floors["upstairs"]
    await building.floors["upstairs"].ready("planner")
    upstairs.kill("planner")
    await building.send_up()
    await until(lambda: robot.berth.floor == "upstairs", "the robot has left", lambda: str(robot.goals))
    await until(lambda: building.lift[-1].serves(f"{robot.name}/1", "upstairs"), "the lift is there")
    assert (await building.records())["upstairs"] is None
    upstairs.start("planner")
    await until(lambda: len(robot.goals) == 3, "its goal upstairs", lambda: upstairs.log("planner"))
    await until(lambda: building.lift[-1].session_id == "", "the lift is free")
    upstairs.kill("planner")
    upstairs.start("planner")
    await upstairs.ready("planner")
    assert (await building.call("upstairs", "GET", "/goal")).status_code == 404
    assert len({goal for _, goal, _ in robot.goals}) == 3


async def test_mission_goes_on_upstairs_and_back_again_although_both_planners_die(building, until) -> None:
    robot, floors = building.robot, building.floors
    stops = [
        {"pose": {"x": 2.0, "y": 1.0}}, {"floor": "upstairs", "place": "desk"},
        {"floor": "upstairs", "pose": {"x": 1.0, "y": 5.0}}, {"floor": "ground", "place": "desk"},
    ]  # fmt: skip
    await building.send_up("/mission", {"stops": stops})
    for count, name in ((3, "ground"), (4, "upstairs")):
        await until(lambda count=count: len(robot.goals) >= count, "its next goals", lambda: str(robot.goals))
        floors[name].kill("planner")
        floors[name].start("planner")
    await until(lambda: len(robot.goals) == 8, "its last goal", lambda: f"{robot.goals} {building.lift[-1:]}")
    wait, cabin = (4.0, 2.0), (6.8, 2.0)
    assert [(floor, at) for floor, _, at in robot.goals] == [
        ("ground", (2.0, 1.0)), ("ground", wait), ("ground", cabin), ("upstairs", (3.0, 5.0)), ("upstairs", (1.0, 5.0)),
        ("upstairs", wait), ("upstairs", cabin), ("ground", (2.0, 5.0)),
    ]  # fmt: skip
    assert len({goal.rpartition("-")[0] for _, goal, _ in robot.goals}) == 1, "one mission"
    await until(lambda: building.lift[-1].session_id == "", "the lift is free")
    assert (await building.records())["ground"] == ("ground", 2, False)


@pytest.mark.drive
@pytest.mark.timeout(600)
@pytest.mark.parametrize("building", ["real"], indirect=True)
async def test_simulated_robot_drives_to_a_place_upstairs_by_the_lift_without_being_enabled_again(building, until):
    machine = building.robot
    for _ in range(600):
        answer = await building.call("ground", "POST", "/commands", json={"kind": "enable"})
        if answer.status_code == 200:
            break
        await asyncio.sleep(0.2)
    assert answer.status_code == 200, answer.text
    await building.send_up()
    deadline = time.monotonic() + 300.0
    view: dict[str, Any] = {}
    while math.dist((machine.truth()["x"], machine.truth()["y"]), (3.0, 5.0)) > 0.2:
        view = (await building.call("upstairs", "GET", "")).json()
        assert time.monotonic() < deadline, (machine.truth(), view, building.lift[-1:])
        await asyncio.sleep(0.5)
    await until(lambda: building.lift[-1].session_id == "", "the lift is free")
    assert await building.records() == {"ground": ("upstairs", 1, True), "upstairs": ("upstairs", 1, False)}
    assert machine.starts == 2
    assert machine.truth()["contacts"] == 0
