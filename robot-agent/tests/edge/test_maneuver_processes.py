"""What a robot does on an operator's word, by its real processes on ptys: back off from a bump, and look around."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from agent_rig import ROBOT, SITE, Robot, until
from guardian_rig import STOP_S, lateness
from little_world import grid_of
from locked_servers import locked_router

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(180)]

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


async def test_bumped_robot_backs_off_ten_centimetres_at_most_and_slowly_and_keeps_its_fault(tmp_path, router):
    async with Robot(tmp_path, router) as robot:
        await robot.localized()
        assert (await robot.fog.command("enable")).accepted
        robot.fog.send_robot_to_the_corner()
        await until(lambda: robot.body.pose[0] > 2.5, "it is on its way")
        robot.body.robot.world.bump_left = True
        await until(lambda: robot.fog.state.mode == "FAULT" and not robot.body.moving, "it has stopped")
        refused = await robot.fog.command("reset")
        assert "the cause is still there" in refused.reason
        rolled, late = Rolled(robot.body.robot), lateness()
        before, begun = len(robot.fog.states), (0.0, 0.0)
        assert (await robot.fog.command("back_off")).accepted
        while rolled.left - begun[0] >= -0.03:
            # An agent that is late for 0.2 s, on a busy machine, ends its way early: then it is ordered again.
            if robot.fog.state.mode == "FAULT" and not robot.body.moving:
                begun = rolled.left, rolled.right
                await robot.fog.command("back_off")
            await asyncio.sleep(0.05)
        robot.body.robot.world.bump_left = False
        await until(lambda: any(state.mode == "EGRESS" for state in robot.fog.states[before:]), "it says so")
        await until(lambda: robot.fog.state.mode == "FAULT" and not robot.body.moving, "it has backed off")
        # The stop may come as late as the robot's design allows, and on a busy machine later. It gets 0.09 m far in
        # lockstep; how far at least is left open here, because an agent that is late for 0.2 s ends its way early.
        for travel in (rolled.left - begun[0], rolled.right - begun[1]):
            assert -0.10 - 0.05 * (STOP_S + late.seconds()) <= travel < -0.03
        assert all(-0.051 <= speed <= 0.0 for speeds in rolled.speeds for speed in speeds), rolled.speeds
        assert any("bumper" in reason for reason in robot.fog.state.reasons)
        assert (await robot.fog.command("reset")).accepted
        waits = "waiting for an operator to enable"
        await until(lambda: robot.fog.state.mode == "INIT" and waits in robot.fog.state.reasons, "it waits in INIT")
        assert any(reason.startswith("the back-off ended: ") for reason in robot.fog.state.reasons)
        assert robot.error() < 0.15


async def test_robot_that_stands_where_two_rooms_look_alike_turns_in_place_until_it_knows_which(tmp_path, router):
    robot = Robot(tmp_path, router)
    robot.body.static, robot.body.geometry = grid_of(ALIKE, 11.0, 6.0)
    robot.body.solid = (robot.body.static == 254).astype(np.uint8)
    robot.body.pose = (7.5, 2.3, 2.0)
    async with robot:
        await until(lambda: robot.fog.state and len(robot.fog.state.places) >= 2, "it tells the places")
        assert "the pose is lost" in (await robot.fog.command("enable")).reason
        rolled = Rolled(robot.body.robot)
        turn = await robot.fog.command("turn")
        assert turn.accepted, turn
        await until(lambda: robot.body.moving, "it turns")
        await until(lambda: robot.fog.state.mode == "INIT" and not robot.body.moving, "the turn is over")
        assert all(left == pytest.approx(-right, abs=0.002) for left, right in rolled.speeds), rolled.speeds
        assert math.dist(robot.body.pose[:2], (7.5, 2.3)) < 0.03
        await until(lambda: robot.fog.state.places == [] and robot.fog.poses.get() is not None, "it knows its place")
        assert robot.error() < 0.15
        reply = await robot.fog.command("enable")
        assert reply.accepted, reply
