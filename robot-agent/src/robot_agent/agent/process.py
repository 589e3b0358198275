"""The agent as a process: connects, restores the stored state, wires core and edges, and runs them."""

from __future__ import annotations

import asyncio
import secrets
from functools import partial
from typing import TYPE_CHECKING

from msgspec import to_builtins
from prometheus_client import REGISTRY

from fog_runtime import logs
from fog_runtime.configuration.robot_file import describe_robot
from fog_runtime.health import Health, reachable_address, serve_health
from fog_runtime.machine import run_in_real_time
from fog_runtime.process import release_startup_memory
from fog_runtime.transports.zenoh_edge import ZenohEdge, use_one_thread
from robot_agent import registry
from robot_agent.agent.edges.map_loader import MapLoader
from robot_agent.agent.edges.store import Store
from robot_agent.agent.recording.input_writer import open_core
from robot_agent.agent.service import Service
from robot_agent.agent.settings import remarks
from robot_agent.config import agent_config
from robot_agent.hardware import DockingDriver

if TYPE_CHECKING:
    from fog_runtime.clock import SystemClock
    from fog_runtime.configuration.robot_file import RobotFile
    from robot_agent.agent.edges.lidar_edge import Devices
    from robot_agent.agent.settings import Given, Settings

_log = logs.get("agent")


async def run(settings: Settings, robot: RobotFile, given: Given, clock: SystemClock, devices: Devices) -> None:
    """Localize, follow paths and gate the wheels until cancelled."""
    site, body, guardian, lidar = given.site, given.body, devices.guardian, devices.lidar
    _log.info("robot_settings", **describe_robot(robot, *registry.options(robot)))
    config = agent_config(
        settings.robot,
        given.operator_key,
        given.base.drive_train,
        lidar.traits,
        body,
        boot=secrets.token_hex(8),
        obstacle_ttl=settings.obstacle_memory_s,
        footprint=given.footprint,
        settings=robot.settings,
        finds_dock=isinstance(given.base, DockingDriver),
    )
    source = "radius of site.toml" if given.footprint is None else "footprint of robot.toml"
    inscribed = round(config.footprint.inscribed_radius, 3)
    sizes = {"radius": config.radius, "inscribed_radius": inscribed}
    _log.info("robot_body", source=source, **sizes, site=site, entry=to_builtins(body))
    for remark in remarks(robot, lidar.traits, config.footprint):
        _log.warning("robot_remark", remark=remark)
    use_one_thread()
    health = Health("map", "pose", "lidar", "base")
    async with ZenohEdge.open(
        connect=settings.zenoh_endpoints, clock=clock, role="robot-agent", id=settings.robot, site=site,
        credentials=given.credentials,
    ) as zenoh:  # fmt: skip
        with (
            open_core(config, settings.seed, settings.input_log) as core,
            serve_health(health, settings.http_host, settings.http_port, settings.port_file) as server,
        ):
            store = Store(settings.data_dir)
            address = partial(reachable_address, settings.http_host, server.port, settings.zenoh_endpoints)
            agent = Service(core, zenoh, store, clock, health, address)
            map_loader = MapLoader(core, zenoh, store, clock, site=site, phase=agent.phase)
            map_loader.begin()
            guardian.begin(agent.on_feedback, agent.on_base_lost)
            lidar.on_samples = core.on_lidar_samples
            agent.subscribe()
            REGISTRY.register(agent.collector)
            zenoh.declare_liveliness("robot-agent", settings.robot)
            # What the start has made stays: no later collection of garbage looks at it, and delays a wheel command.
            release_startup_memory()
            # After the start, which takes all the time that it gets.
            priority = settings.agent_realtime_priority if settings.speed == 1.0 else 0
            _log.info("started", priority=run_in_real_time(priority))
            async with asyncio.TaskGroup() as tasks:
                for task in devices.tasks:
                    tasks.create_task(_ended(task))
                tasks.create_task(agent.stream_loop(guardian, lidar), name="stream")
                tasks.create_task(agent.control_loop(), name="control")
                tasks.create_task(map_loader.run(body), name="map")
                tasks.create_task(agent.publish_loop(), name="publish")
                tasks.create_task(agent.housekeeping_loop(lidar, guardian), name="housekeeping")


async def _ended(task: asyncio.Task[None]) -> None:
    """Wait for a task: its error ends the others, and is cancelled with them."""
    await task
