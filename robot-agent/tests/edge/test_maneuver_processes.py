"""What a robot does on an operator's command, by its real processes on ptys: back off from a bump, and look around."""

from __future__ import annotations

import asyncio
import math
import time

import numpy as np
import pytest
from agent_rig import ROBOT, SITE, Robot, is_by_delay, until
from guardian_rig import DEADLINE_S, STOP_S, lateness
from little_world import grid_of
from secured_servers import secured_router

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(180)]

TRIES = 5
"""So often a robot backs off or turns at most, if its computer's delay ends it."""

ALIKE = [(1, 1, 4.5, 4), (6, 1, 9.5, 4), (7.4, 4, 8.6, 4.3)]
"""Two rooms, the second with a niche that is so shallow that one scan does not tell them apart: six more do.

The site says that the robot starts in the first one, with a heading that fits no place there.
"""


@pytest.fixture(scope="module")
def router(tmp_path_factory):
    with secured_router(tmp_path_factory.mktemp("router"), SITE, robots=[ROBOT]) as running:
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


async def turned(robot) -> bool:
    """Let a robot turn in place; return whether it has made the turn, or ended it because it knows its place.

    On a busy machine its computer, or the watchdog, which starts a late guardian again, may end a turn before.
    """
    before = len(robot.fog.states)
    turn = await robot.fog.command("turn")
    assert turn.accepted, turn
    await until(lambda: any(state.mode == "EGRESS" for state in robot.fog.states[before:]), "it says so")
    await until(lambda: robot.fog.state.mode == "INIT" and not robot.body.moving, "the turn is over")
    ended = next(reason for reason in robot.fog.state.reasons if reason.startswith("the turn ended: "))
    if ended.startswith(("the turn ended: the robot knows where it is", "the turn ended: it is done")):
        return True
    assert is_by_delay(ended) or "the guardian" in ended, ended
    await until(lambda: is_ready(robot.fog.state), "it may turn again")
    return False


def is_ready(state) -> bool:
    """Whether nothing but its unknown place keeps a robot from being enabled."""
    others = ("the pose is ", "waiting for an operator to enable", "the turn ended: ")
    return all(reason.startswith(others) for reason in state.reasons)


async def test_robot_that_stands_where_two_rooms_look_alike_knows_after_one_turn_in_place_which_it_is_in(
    tmp_path, router
):
    robot = Robot(tmp_path, router)
    robot.body.static, robot.body.geometry = grid_of(ALIKE, 11.0, 6.0)
    robot.body.solid = (robot.body.static == 254).astype(np.uint8)
    robot.body.pose = (7.5, 2.3, 1.5)
    async with robot:
        await until(lambda: robot.fog.state and len(robot.fog.state.places) >= 2, "it tells the places")
        assert "the pose is lost" in (await robot.fog.command("enable")).reason
        rolled = Rolled(robot.body.robot)
        for _ in range(TRIES):
            if await turned(robot):
                break
        else:
            pytest.fail(f"each of {TRIES} turns ended early: {robot.fog.state}")
        assert all(left == pytest.approx(-right, abs=0.002) for left, right in rolled.speeds), rolled.speeds
        assert math.dist(robot.body.pose[:2], (7.5, 2.3)) < 0.03
        unknown = "the pose is "
        await until(lambda: not any(one.startswith(unknown) for one in robot.fog.state.reasons), "it knows its place")
        assert robot.fog.state.places == []
        assert robot.error() < 0.15
        reply = await robot.fog.command("enable")
        assert reply.accepted, reply
