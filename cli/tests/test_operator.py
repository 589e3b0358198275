import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable

import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, CommandReply, HazardArea, RobotCommand, RobotState
from fog_runtime.clock import SystemClock
from fog_runtime.site import load_site
from fog_runtime.zenoh_edge import ZenohEdge
from fognav import checkout
from fognav.demo.operator import Operator
from fognav.demo.scene import Scene
from fognav.stack import ROUTER, Stack, StackConfig

pytestmark = pytest.mark.live
TIMEOUT_S = 15.0
SPEED = 10.0
"""The operator's seconds pass ten times as fast."""
ASKS = "waiting for an operator to enable"


async def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, f"{TIMEOUT_S:.0f} s passed before {what}"
        await asyncio.sleep(0.01)


class Floor:
    """An operator, and what a robot and the nodes tell him over a real router."""

    def __init__(self, robot: ZenohEdge, operator: Operator, scene: Scene) -> None:
        self._robot = robot
        self.operator = operator
        self.scene = scene
        self.asked: list[str] = []
        self.reply = CommandReply(accepted=True, reason="")
        robot.serve(ch.ROBOT_COMMAND, self._on_command, robot="r1")

    def _on_command(self, _ids: dict[str, str], command: RobotCommand) -> CommandReply:
        self.asked.append(command.kind)
        return self.reply

    @property
    def told(self) -> list[str]:
        return [text for _, text in self.scene.events]

    async def robot_says(self, mode: str, *reasons: str, goal: str | None = None) -> None:
        """Tell it, again and again until it is heard: nobody says when a subscription has reached the router."""
        state = RobotState(
            mode=mode, reasons=list(reasons), enabled=mode != "INIT", battery=None, goal_id=goal, map_epoch=1,
            map_seq=1, plan_id=None,
        )  # fmt: skip
        deadline = time.monotonic() + TIMEOUT_S
        while self.scene.state is None or (self.scene.state.mode, self.scene.state.reasons) != (mode, [*reasons]):
            assert time.monotonic() < deadline, f"{mode} was not heard"
            self._robot.publish(ch.ROBOT_STATE, state, robot="r1")
            await asyncio.sleep(0.02)

    async def area_is(self, area: str, state: str, cause: str) -> None:
        hazard = AreaHazard(area=area, state=state, severity=0, penalty=0, since=1.0, seq=1, epoch=1, cause=cause)
        told = HazardArea(hazard=hazard, polygon=[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
        deadline = time.monotonic() + TIMEOUT_S
        while area not in self.scene.hazards or self.scene.hazards[area].hazard.state != state:
            assert time.monotonic() < deadline, f"{area} was not heard"
            self._robot.publish(ch.HAZARD, told, area=area)
            await asyncio.sleep(0.02)


@pytest.fixture
async def floor() -> AsyncIterator[Floor]:
    site = load_site(checkout.root() / "sites" / "estig")
    clock = SystemClock(SPEED)
    async with Stack(StackConfig(site_dir=site.directory, robot="r1")) as stack, contextlib.AsyncExitStack() as ends:
        stack.supervisor.start(ROUTER)
        await stack.supervisor.wait_ready([ROUTER], TIMEOUT_S)

        async def edge(name: str) -> ZenohEdge:
            opened = ZenohEdge.open(
                connect=[stack.zenoh_endpoint], clock=clock, role="test", id=name, site=site.site.id
            )
            return await ends.enter_async_context(opened)

        scene = Scene(site, "r1", 1, SPEED)
        made = Floor(await edge("robot"), Operator(await edge("operator"), stack, scene, clock), scene)
        enabling = asyncio.create_task(made.operator.keep_enabled())
        yield made
        enabling.cancel()
        await asyncio.gather(enabling, return_exceptions=True)


async def test_a_robot_that_starts_as_it_should_makes_a_calm_story(floor: Floor) -> None:
    floor.operator.held_back = True
    await floor.area_is("z1", "unknown", "not heard yet")
    await floor.robot_says("INIT", "no message from the guardian for as long as the agent runs", ASKS)
    await floor.area_is("z1", "clear", "node n1: 5 in a row")
    await floor.robot_says("INIT", "the pose is not known yet: checking the saved pose", ASKS)
    await floor.robot_says("INIT", ASKS)
    floor.operator.held_back = False
    await until(lambda: bool(floor.asked), "it is enabled")
    await floor.robot_says("NORMAL")
    assert [text for text in floor.told if text != "operator: enable again"] == [
        "robot: INIT, it has just started, looks for where it is, and stands until somebody enables it",
        "operator: enable",
        "robot: NORMAL",
    ]


async def test_nobody_enables_a_robot_that_is_held_back_however_long_it_asks(floor: Floor) -> None:
    floor.operator.held_back = True
    await floor.robot_says("INIT", ASKS)
    await until(lambda: floor.operator.ready_s > 20.0, "20 s passed on its clock")
    assert floor.asked == []


async def test_what_keeps_a_robot_from_being_enabled_is_told_when_it_does_not_pass(floor: Floor) -> None:
    floor.reply = CommandReply(accepted=False, reason="the cause is still there: the lidar has been silent for 9.0 s")
    await floor.robot_says("INIT", "the lidar has been silent for 1.0 s", ASKS)
    assert floor.operator.ready_s == 0.0
    await until(lambda: len(floor.asked) >= 2, "it is asked all the same")
    complaints = [text for text in floor.told if text.startswith("operator: ")]
    assert complaints == ["operator: enable: the robot refuses, " + floor.reply.reason]  # told once


async def test_trouble_that_comes_later_is_told_with_its_reasons(floor: Floor) -> None:
    await floor.area_is("z1", "clear", "node n1: 5 in a row")
    await floor.area_is("z1", "unknown", "node n1 is silent")
    await floor.area_is("z2", "blocked", "node n2: something at 0.20 m")
    await floor.robot_says("NORMAL")
    await floor.robot_says("PROTECTIVE_STOP", "the lidar has been silent for 0.4 s")
    await floor.robot_says("INIT", "no message from the guardian for as long as the agent runs", ASKS)
    assert [text for text in floor.told if not text.startswith("operator")] == [
        "area z1: unknown (node n1 is silent)",
        "area z2: blocked (node n2: something at 0.20 m)",
        "robot: NORMAL",
        "robot: PROTECTIVE_STOP (the lidar has been silent for 0.4 s)",
        f"robot: INIT (no message from the guardian for as long as the agent runs; {ASKS})",
    ]
