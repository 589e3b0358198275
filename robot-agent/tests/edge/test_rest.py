"""The whole robot rests and is woken: real processes, an emulated lidar that is told to stop and to scan."""

from __future__ import annotations

import pytest
from agent_rig import ROBOT, SITE, Robot, until
from secured_servers import secured_router

pytestmark = [pytest.mark.live, pytest.mark.timeout(150)]

POWER = """
[base]
driver = "roomba600"
[lidar]
driver = "rplidar-a1"
[power]
rest_after_s = 6.0
"""


async def test_idle_robot_rests_stays_ready_and_drives_after_its_enable_without_a_stop(tmp_path):
    (tmp_path / "robot.toml").write_text(POWER)
    with secured_router(tmp_path / "router", SITE, robots=[ROBOT]) as router:
        async with Robot(tmp_path, router, FOGNAV_ROBOT_FILE=str(tmp_path / "robot.toml")) as robot:
            await robot.localized()
            resting = "at rest to save power, without its lidar: a goal or an operator's command wakes it"
            await until(lambda: resting in robot.fog.state.reasons, "it rests")
            assert robot.body.scanner.outgoing(0.0) == b""
            assert robot.agent.get("/readyz")[0] == 200
            begun = len(robot.fog.states)
            reply = await robot.fog.command("enable")
            assert reply.accepted, reply
            await until(lambda: robot.fog.state.mode == "NORMAL", "it is awake")
            assert {state.mode for state in robot.fog.states[begun:]} <= {"INIT", "HOLD", "NORMAL", "DEGRADED"}
            robot.fog.send_robot_to_the_corner()
            await until(lambda: robot.body.pose[0] > 2.3, "it drives")
