"""The robot's agent: `python -m robot_agent`, configured by FOGNAV_* variables. Safe to kill and start at any time.

It drives through the guardian, which stops the wheels when the agent is gone. The watchdog
(`robot_agent.guardian.watchdog`) starts the guardian.
"""

from __future__ import annotations

import asyncio
import os
import secrets
from functools import partial

from prometheus_client import REGISTRY

from fog_runtime import logs, process
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import describe_robot, load_robot
from fog_runtime.configuration.settings import describe, load
from fog_runtime.health import Health, serve_health
from fog_runtime.machine import signals
from fog_runtime.machine.memory import release_startup_memory
from fog_runtime.machine.own_address import reachable_address
from fog_runtime.transports.zenoh_edge import ZenohEdge, use_one_thread
from robot_agent import registry
from robot_agent.agent.edges.guardian_client import GuardianClient
from robot_agent.agent.edges.lidar_edge import LidarEdge
from robot_agent.agent.edges.map_loader import MapLoader
from robot_agent.agent.edges.store import Store
from robot_agent.agent.recording.input_writer import open_core
from robot_agent.agent.service import Service
from robot_agent.agent.settings import Settings, read_footprint, read_operator_key, read_port, read_site
from robot_agent.config import agent_config
from robot_agent.device_signature import LineCheck
from robot_agent.guardian.protection import run_in_real_time
from robot_agent.hardware import DockingDriver

_log = logs.get("agent")


async def main() -> None:
    """Connect, restore the stored state, then localize, follow paths and gate the wheels until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("robot-agent", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    site, body = read_site(settings)
    key = read_operator_key(settings.operator_key_file)
    robot = load_robot(os.environ)
    base, lidar_driver = registry.make_base(robot), registry.make_lidar(robot)
    _log.info("robot_settings", **describe_robot(robot, *registry.options(robot)))
    config = agent_config(
        settings.robot,
        key,
        base.drive_train,
        lidar_driver.traits,
        body,
        boot=secrets.token_hex(8),
        obstacle_ttl=settings.obstacle_memory_s,
        footprint=read_footprint(robot),
        settings=robot.settings,
        finds_dock=isinstance(base, DockingDriver),
    )
    port = read_port(robot)
    use_one_thread()
    clock = SystemClock(settings.speed)
    health = Health("map", "pose", "lidar", "base")
    async with ZenohEdge.open(
        connect=settings.zenoh_endpoints, clock=clock, role="robot-agent", id=settings.robot, site=site,
        credentials=settings.credentials(),
    ) as zenoh:  # fmt: skip
        with (
            open_core(config, settings.seed, settings.input_log) as core,
            serve_health(health, settings.http_host, settings.http_port, settings.port_file) as server,
        ):
            store = Store(settings.data_dir)
            address = partial(reachable_address, settings.http_host, server.port, settings.zenoh_endpoints)
            agent = Service(core, zenoh, store, clock, health, address)
            map_loader = MapLoader(core, zenoh, store, clock, site=site, phase=agent.phase)
            guardian = GuardianClient(settings.guardian_socket, clock, agent.on_feedback, agent.on_base_lost)
            lidar = LidarEdge(
                port,
                lidar_driver,
                clock,
                core.on_lidar_samples,
                check=partial(LineCheck, port, robot.settings.lidar.driver, registry.signatures()),
            )
            agent.subscribe()
            REGISTRY.register(agent.collector)
            zenoh.declare_liveliness("robot-agent", settings.robot)
            # What the start has made stays: no later collection of garbage looks at it, and delays a wheel command.
            release_startup_memory()
            # After the start, which takes all the time that it gets.
            priority = settings.agent_realtime_priority if settings.speed == 1.0 else 0
            _log.info("started", priority=run_in_real_time(priority))
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(guardian.run(), name="base")
                tasks.create_task(lidar.run(), name="lidar")
                tasks.create_task(agent.stream_loop(guardian, lidar), name="stream")
                tasks.create_task(agent.control_loop(), name="control")
                tasks.create_task(map_loader.run(body), name="map")
                tasks.create_task(agent.publish_loop(), name="publish")
                tasks.create_task(agent.housekeeping_loop(lidar, guardian), name="housekeeping")


if __name__ == "__main__":
    signals.ignore_terminal_stops()
    process.run(main)
