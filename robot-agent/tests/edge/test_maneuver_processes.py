"""What a robot does on an operator's word, by its real processes on ptys: back off from a bump, and look around."""

from __future__ import annotations

import asyncio
import math
import time

import numpy as np
import pytest
from agent_rig import ROBOT, SITE, Robot, is_by_delay, until
from guardian_rig import DEADLINE_S, STOP_S, lateness
from little_world import grid_of
from locked_servers import locked_router

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(180)]

TRIES = 5
"""So often a robot backs off at most, if its computer's delay ends it, or turns, until it knows its place."""

DECISION_S = 5.0
"""So long a robot that has turned may search before it is told to turn again (s)."""

ALIKE = [(1, 1, 4.5, 4), (6, 1, 9.5, 4), (7.6, 4, 8.4, 4.3)]
"""Two rooms, the second with a niche that is so shallow that one scan does not tell them apart.

The site says that the robot starts in the first one, with another heading.
"""


@pytest.fixture(scope="module")
def router(tmp_path_factory):
    with locked_router(tmp_path_factory.mktemp("router"), SITE, robots=[ROBOT]) as running:
        yield running


class Rolled:
    """What the wheels of a base did since this was made: how far (m) they rolled, and every pair of speeds (m/s)."""

    def __init__(self, base) -> None:
        self.left = self.right = 0.0
        self.speeds: set[tuple[float, float]] = set()
        self._base, self._add = base, base.add_wheel_travel
        base.add_wheel_travel = self._on_travel

    def _on_travel(self, left: float, right: float) -> None:
        self.left, self.right = self.left + left, self.right + right
        self.speeds.add(self._base.wheel_speeds_m_s)
        self._add(left, right)


async def back_off(robot) -> tuple[float, str]:
    """Let a bumped robot back off and reset it; return how far it got (m) and why it ended.

    The stop may come as late as the robot's design allows, and on a busy machine later.
    """
    fog, world = robot.fog, robot.body.robot.world
    rolled, late, before = Rolled(robot.body.robot), lateness(), len(fog.states)
    reply = await fog.command("back_off")
    assert reply.accepted, reply
    await until(lambda: any(state.mode == "EGRESS" for state in fog.states[before:]), "it says so")
    await until(lambda: rolled.left < -0.03 or fog.state.mode == "FAULT", "it backs off, or stops")
    world.bump_left = False
    await until(lambda: fog.state.mode == "FAULT" and not robot.body.moving, "it has backed off")
    for travel in (rolled.left, rolled.right):
        assert -0.10 - 0.05 * (STOP_S + late.seconds()) <= travel <= 0.0
    assert all(-0.051 <= speed <= 0.0 for speeds in rolled.speeds for speed in speeds), rolled.speeds
    assert any("bumper" in reason for reason in fog.state.reasons)
    end = time.monotonic() + DEADLINE_S
    while not (reply := await fog.command("reset")).accepted:
        assert "the cause is still there" in reply.reason
        assert time.monotonic() < end, f"the bumper is free, but no reset is accepted: {reply}"
        await asyncio.sleep(0.05)
    waits = "waiting for an operator to enable"
    await until(lambda: fog.state.mode == "INIT" and fog.state.reasons[1:] == [waits], "only an enable is missing")
    ended = fog.state.reasons[0]
    assert ended.startswith("the back-off ended: ")
    return -rolled.left, ended


async def test_bumped_robot_backs_off_ten_centimetres_at_most_and_slowly_and_keeps_its_fault(tmp_path, router):
    async with Robot(tmp_path, router) as robot:
        await robot.localized()
        robot.fog.send_robot_to_the_corner()
        far = 0.0
        for _ in range(TRIES):
            assert (await robot.fog.command("enable")).accepted
            await until(lambda: robot.body.pose[0] > 2.5 and robot.body.moving, "it is on its way")
            robot.body.robot.world.bump_left = True
            await until(lambda: robot.fog.state.mode == "FAULT" and not robot.body.moving, "it has stopped")
            refused = await robot.fog.command("reset")
            assert "the cause is still there" in refused.reason
            far, reason = await back_off(robot)
            # It gets 0.09 m far in lockstep. An agent that is late, on a busy machine, ends its way early.
            if far > 0.03:
                break
            assert is_by_delay(reason), reason
        assert far > 0.03, f"each of {TRIES} ended early, the last one because {reason}"
        assert robot.error() < 0.15


async def enabled(robot):
    """Enable a robot that stands, and return whether it finds out where it is; else it has to turn again."""
    end = time.monotonic() + DECISION_S
    while not (reply := await robot.fog.command("enable")).accepted:
        assert "the pose is" in reply.reason, reply
        if time.monotonic() > end:
            return False
        await asyncio.sleep(0.1)
    return True


async def test_robot_that_stands_where_two_rooms_look_alike_turns_in_place_until_it_knows_which(tmp_path, router):
    robot = Robot(tmp_path, router)
    robot.body.static, robot.body.geometry = grid_of(ALIKE, 11.0, 6.0)
    robot.body.solid = (robot.body.static == 254).astype(np.uint8)
    robot.body.pose = (7.5, 2.3, 2.0)
    async with robot:
        await until(lambda: robot.fog.state and len(robot.fog.state.places) >= 2, "it tells the places")
        assert "the pose is lost" in (await robot.fog.command("enable")).reason
        rolled = Rolled(robot.body.robot)
        for _ in range(TRIES):
            turn = await robot.fog.command("turn")
            assert turn.accepted, turn
            await until(lambda: robot.body.moving, "it turns")
            await until(lambda: robot.fog.state.mode == "INIT" and not robot.body.moving, "the turn is over")
            if knows := await enabled(robot):
                break
        assert knows, robot.fog.state
        assert all(left == pytest.approx(-right, abs=0.002) for left, right in rolled.speeds), rolled.speeds
        assert math.dist(robot.body.pose[:2], (7.5, 2.3)) < 0.03
        await until(lambda: robot.fog.state.places == [], "no place is left to tell")
        assert robot.error() < 0.15
