import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable

import pytest

from fog_contracts import channels as ch
from fog_contracts.messages import (
    AreaHazard,
    CommandReply,
    HazardArea,
    Reason,
    ReasonCode,
    RefusalCode,
    RobotCommand,
    RobotState,
)
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.site import load_site
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav import checkout
from fognav.demo.operator import Operator
from fognav.demo.scene import Scene
from fognav.programs import ROUTER
from fognav.stack import Stack, StackConfig

pytestmark = pytest.mark.live
TIMEOUT_S = 60.0
SPEED = 10.0
"""The operator's clock runs ten times as fast."""
WAITING = Reason(ReasonCode.NOT_ENABLED, "waiting for an operator to enable")
NO_GUARDIAN = Reason(ReasonCode.GUARDIAN_SILENT, "no message from the guardian for as long as the agent runs")
BUMPED = Reason(ReasonCode.BASE_FAULT, "base: the bumper is pressed")


async def until(condition: Callable[[], bool], description: str) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, f"{TIMEOUT_S:.0f} s passed before {description}"
        await asyncio.sleep(0.01)


class RouterRig:
    """An operator connected by a real router to a simulated robot and aggregator."""

    def __init__(self, robot: ZenohEdge, operator: Operator, scene: Scene) -> None:
        self._robot = robot
        self.operator = operator
        self.scene = scene
        self.commands: list[str] = []
        self.reply = CommandReply(accepted=True, reason="")
        robot.serve(ch.ROBOT_COMMAND, self._on_command, robot="r1")

    def _on_command(self, _ids: dict[str, str], command: RobotCommand) -> CommandReply:
        self.commands.append(command.kind)
        return self.reply

    @property
    def event_texts(self) -> list[str]:
        return [text for _, text in self.scene.events]

    async def publish_state(self, mode: str, *why: Reason, goal: str | None = None) -> None:
        """Publish a robot state until the operator has received it: subscriptions reach the router with a delay."""
        reasons = [str(reason) for reason in why]
        state = RobotState(
            mode=mode, reasons=reasons, codes=[reason.code for reason in why],
            enabled=mode != "INIT", battery=None, goal_id=goal, map_epoch=1,
            map_seq=1, plan_id=None,
        )  # fmt: skip
        deadline = time.monotonic() + TIMEOUT_S
        while self.scene.state is None or (self.scene.state.mode, self.scene.state.reasons) != (mode, reasons):
            assert time.monotonic() < deadline, f"{mode} was not received"
            self._robot.publish(ch.ROBOT_STATE, state, robot="r1")
            await asyncio.sleep(0.02)

    async def publish_hazard(self, area: str, state: str, cause: str) -> None:
        hazard = AreaHazard(area=area, state=state, severity=0, penalty=0, since=1.0, seq=1, epoch=1, cause=cause)
        message = HazardArea(hazard=hazard, polygon=[(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
        deadline = time.monotonic() + TIMEOUT_S
        while area not in self.scene.hazards or self.scene.hazards[area].hazard.state != state:
            assert time.monotonic() < deadline, f"{area} was not received"
            self._robot.publish(ch.HAZARD, message, area=area)
            await asyncio.sleep(0.02)


@pytest.fixture
async def rig() -> AsyncIterator[RouterRig]:
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
        made = RouterRig(await edge("robot"), Operator(await edge("operator"), stack, scene, clock), scene)
        enabling = asyncio.create_task(made.operator.keep_enabled())
        yield made
        enabling.cancel()
        await asyncio.gather(enabling, return_exceptions=True)


async def test_normal_start_of_a_robot_gives_three_events(rig: RouterRig) -> None:
    rig.operator.enabling_paused = True
    await rig.publish_hazard("z1", "unknown", "not heard yet")
    await rig.publish_state("INIT", NO_GUARDIAN, WAITING)
    await rig.publish_hazard("z1", "clear", "node n1: 5 in a row")
    pose = Reason(ReasonCode.POSE_UNKNOWN, "the pose is not known yet: checking the saved pose")
    await rig.publish_state("INIT", pose, WAITING)
    await rig.publish_state("INIT", WAITING)
    rig.operator.enabling_paused = False
    await until(lambda: "operator: enable" in rig.event_texts, "it is enabled")
    await rig.publish_state("NORMAL")
    assert [text for text in rig.event_texts if text != "operator: enable again"] == [
        "robot: INIT (just started: it localizes, then waits to be enabled)",
        "operator: enable",
        "robot: NORMAL",
    ]


async def test_robot_is_not_enabled_while_enabling_is_paused(rig: RouterRig) -> None:
    rig.operator.enabling_paused = True
    await rig.publish_state("INIT", WAITING)
    await until(lambda: rig.operator.ready_s > 20.0, "20 s passed on its clock")
    assert rig.commands == []


async def test_robot_that_somebody_has_stopped_waits_for_them_and_one_that_was_reset_does_not(rig: RouterRig) -> None:
    await rig.publish_state("NORMAL")
    await rig.publish_state("INIT", WAITING)
    await until(lambda: any("somebody has stopped" in text for text in rig.event_texts), "it is noticed")
    await asyncio.sleep(1.0)  # ten seconds of the operator's clock
    assert rig.commands == []
    await rig.publish_state("NORMAL")
    await rig.publish_state("FAULT", BUMPED)
    await until(lambda: "reset" in rig.commands, "it is reset")
    await rig.publish_state("INIT", WAITING)
    await until(lambda: "enable" in rig.commands, "it is enabled")


async def test_refused_enable_is_reported_once_with_its_reason(rig: RouterRig) -> None:
    silent = Reason(ReasonCode.LIDAR_SILENT, "the lidar has been silent for 9.0 s")
    remains = Reason(RefusalCode.CAUSE_REMAINS, f"the cause is still there: {silent}", [silent.code])
    rig.reply = CommandReply.refused(remains)
    await rig.publish_state("INIT", silent, WAITING)
    assert rig.operator.ready_s == 0.0
    await until(lambda: len(rig.commands) >= 2, "the command was sent twice")
    refusals = [text for text in rig.event_texts if text.startswith("operator: ")]
    assert refusals == ["operator: enable: refused by the robot, " + rig.reply.reason]


async def test_later_hazards_and_stops_are_reported_with_their_reasons(rig: RouterRig) -> None:
    await rig.publish_hazard("z1", "clear", "node n1: 5 in a row")
    await rig.publish_hazard("z1", "unknown", "node n1 is silent")
    await rig.publish_hazard("z2", "blocked", "node n2: something at 0.20 m")
    await rig.publish_state("NORMAL")
    silent = Reason(ReasonCode.LIDAR_SILENT, "the lidar has been silent for 0.4 s")
    await rig.publish_state("PROTECTIVE_STOP", silent)
    await rig.publish_state("INIT", NO_GUARDIAN, WAITING)
    assert [text for text in rig.event_texts if not text.startswith("operator")] == [
        "area z1: unknown (node n1 is silent)",
        "area z2: blocked (node n2: something at 0.20 m)",
        "robot: NORMAL",
        "robot: PROTECTIVE_STOP (the lidar has been silent for 0.4 s)",
        f"robot: INIT (no message from the guardian for as long as the agent runs; {WAITING})",
    ]


async def test_events_tell_when_a_reset_has_ended_the_reason_that_they_told(rig: RouterRig) -> None:
    """A reset is carried out a moment after the mode is INIT: until then the base still says why it stands."""
    rig.operator.enabling_paused = True
    await rig.publish_state("FAULT", BUMPED)
    await rig.publish_state("INIT", BUMPED, WAITING)
    await rig.publish_state("INIT", WAITING)
    await rig.publish_state("INIT", Reason(ReasonCode.MAP_LATE, "the map is 1.2 s old"), WAITING)
    told = [text for text in rig.event_texts if text.startswith("robot: INIT")]
    assert told == [f"robot: INIT (base: the bumper is pressed; {WAITING})", f"robot: INIT ({WAITING})"]
