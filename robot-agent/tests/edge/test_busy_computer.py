"""A burst of foreign load at normal priority on all cores: the robot may stop meanwhile, but it ends in no fault.

FOGNAV_BURST_S sets the length of each burst (s).
"""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from agent_rig import ROBOT, SITE, Robot, until
from secured_servers import secured_router

from fog_runtime.machine import run_in_real_time
from fog_supervisor import child

BURST_S = float(os.environ.get("FOGNAV_BURST_S", "4"))
_DEVICES = 20
"""Priority of base and lidar, which are threads of this process: a busy computer does not delay real ones."""
_LOOP = "import os\nos.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nos.nice({})\nwhile True:\n    pass"

pytestmark = [pytest.mark.live, pytest.mark.reaction, pytest.mark.timeout(150 + 2 * BURST_S)]


@pytest.fixture
def router(tmp_path_factory):
    with secured_router(tmp_path_factory.mktemp("router"), SITE, robots=[ROBOT]) as running:
        yield running


@contextmanager
def busy_cores():
    """Run an endless loop per core; yield its processes."""
    # Who may not give the devices priority over the loops must take it from the loops.
    nice = 0 if run_in_real_time(_DEVICES).startswith("SCHED_RR") else 10
    loops = [subprocess.Popen(child.command(sys.executable, "-c", _LOOP.format(nice))) for _ in os.sched_getaffinity(0)]
    try:
        yield loops
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()
        for thread in Path("/proc/self/task").iterdir():
            with suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread.name), os.SCHED_OTHER, os.sched_param(0))


@pytest.mark.parametrize("priorities", ["allowed", "refused"])
async def test_burst_of_load_on_all_cores_ends_in_no_fault(tmp_path, router, monkeypatch, priorities):
    if priorities == "refused":
        monkeypatch.setenv("FOGNAV_REALTIME_PRIORITY", "0")
        monkeypatch.setenv("FOGNAV_AGENT_REALTIME_PRIORITY", "0")
    async with Robot(tmp_path, router) as robot:
        await robot.localized()
        reply = await robot.fog.command("enable")
        assert reply.accepted, reply
        await until(lambda: robot.fog.state.mode == "NORMAL", "the robot is in NORMAL")
        robot.fog.send_robot_to_the_corner()
        await until(lambda: robot.body.moving, "it drives")
        begun = len(robot.fog.states)
        with busy_cores() as loops:
            await asyncio.sleep(BURST_S)
            assert [loop.poll() for loop in loops] == [None] * len(loops)
        await until(lambda: robot.fog.state.mode == "NORMAL" and robot.fog.state.enabled, "it is in NORMAL afterwards")
        during = robot.fog.states[begun:]
        assert "FAULT" not in {state.mode for state in during}, [state.reasons for state in during]
