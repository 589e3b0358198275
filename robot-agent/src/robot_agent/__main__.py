"""The robot's agent: `python -m robot_agent`, configured by FOGNAV_* variables. Safe to kill and start at any time.

It drives through the guardian, which stops the wheels when the agent is gone. The watchdog
(`robot_agent.guardian.watchdog`) starts the guardian.

Loading the agent takes about a second, numba and the kernels most of it, and so does the lidar until its first scan. So
this module imports little and begins the scan; then it loads `robot_agent.agent.process`, which connects and wires.
"""

from __future__ import annotations

import os
from contextlib import nullcontext
from functools import partial

from fog_runtime import logs, process
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import load_robot
from fog_runtime.configuration.settings import describe, load
from fog_runtime.machine import signals
from fog_runtime.machine.memory import loading
from robot_agent import registry
from robot_agent.agent.edges.guardian_client import connect_early
from robot_agent.agent.edges.lidar_start import LidarParts, lidar_start
from robot_agent.agent.settings import Settings, read_port
from robot_agent.device_signature import LineCheck

_log = logs.get("agent")


async def main() -> None:
    """Begin the lidar's scan, load the rest of the agent, and run it until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("robot-agent", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    robot, clock = load_robot(os.environ), SystemClock(settings.speed)
    port, name, signatures = read_port(robot), robot.settings.lidar.driver, registry.signatures()
    serial = signatures[name].serial if name in signatures else None
    check = partial(LineCheck, port, name, signatures)
    with lidar_start(port, serial, check, clock) as start:
        with loading(_has_compiled):
            driver = registry.make_lidar(robot)
            if start is not None:
                start.begin(driver)
            link = connect_early(settings.guardian_socket)
            from robot_agent.agent.process import run  # noqa: PLC0415  # loads the kernels, while the lidar starts
        with link.socket if link else nullcontext():
            await run(settings, robot, clock, LidarParts(port, driver, check, start), link)


def _has_compiled() -> bool:
    """Whether kernels were compiled, which leaves 100 MB of garbage, instead of loaded."""
    from fog_kernels.warm import cache_misses  # noqa: PLC0415  # loads numba

    return cache_misses() > 0


if __name__ == "__main__":
    signals.ignore_terminal_stops()
    process.run(main)
