"""The robot's agent: `python -m robot_agent`, configured by FOGNAV_* variables. Safe to kill and start at any time.

It drives through the guardian, which stops the wheels when the agent is gone. The watchdog
(`robot_agent.guardian.watchdog`) starts the guardian.

Loading the agent takes about a second, numba and the kernels most of it, and so does the lidar until its first scan. So
this module imports little, reads all settings and begins the scan; then it loads `robot_agent.agent.service`, which
connects and wires. It is loaded on a thread: where kernels are compiled for minutes, a signal ends the process as soon.
"""

from __future__ import annotations

import asyncio
import os
from functools import partial
from typing import TYPE_CHECKING

from fog_runtime import logs, machine, process
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import load_robot
from fog_runtime.configuration.settings import describe, load
from robot_agent import registry
from robot_agent.agent.berths import read_berths
from robot_agent.agent.edges.guardian_client import GuardianClient
from robot_agent.agent.edges.lidar_edge import Devices, LidarEdge
from robot_agent.agent.settings import Settings, read_given, read_port
from robot_agent.device_signature import LineCheck

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from fog_runtime.configuration.robot_file import RobotFile
    from robot_agent.agent.settings import Given

    Run = Callable[[Settings, RobotFile, Given, SystemClock, Devices], Awaitable[None]]

_log = logs.get("agent")


async def main() -> None:
    """Begin the lidar's scan, load the rest of the agent, and run it until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("robot-agent", settings.log_level, settings.log_format)
    berths = read_berths(settings.floors_file, settings.data_dir)
    if berths is not None:
        settings = berths.settings(settings)
    _log.info("settings_loaded", **describe(settings))
    robot, clock = load_robot(os.environ), SystemClock(settings.speed)
    port, name = read_port(robot), robot.settings.lidar.driver
    given = read_given(settings, robot, berths)
    driver = await process.load_aside(partial(registry.make_lidar, robot))
    check = partial(LineCheck, port, name, registry.signatures())
    guardian, lidar = GuardianClient(settings.guardian_socket, clock), LidarEdge(port, driver, clock, check=check)
    tasks = [asyncio.create_task(edge.run()) for edge in (guardian, lidar)]
    try:
        run = await process.load_aside(_load_agent)
        await run(settings, robot, given, clock, Devices(guardian, lidar, tasks))
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _load_agent() -> Run:
    """Load the kernels, while the lidar starts."""
    from robot_agent.agent.service import run  # noqa: PLC0415  # as said above

    return run


if __name__ == "__main__":
    machine.ignore_terminal_stops()
    process.run(main)
