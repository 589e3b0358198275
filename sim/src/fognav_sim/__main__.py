"""The simulator: `python -m fognav_sim`, configured by FOGNAV_* environment variables.

It provides the devices RUN_DIR/base and RUN_DIR/lidar, publishes as every sensor node of the site, and publishes the
ground truth.
"""

import asyncio
import os
from functools import partial
from pathlib import Path
from typing import Literal

from fog_contracts.site import RobotSite
from fog_runtime import logs, process
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import load_robot
from fog_runtime.configuration.settings import CommonSettings, SettingsError, describe, load
from fog_runtime.configuration.site import LoadedSite, load_site
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.health import Health, serve_health
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav_sim import devices
from fognav_sim.floor import Floor
from fognav_sim.hardware import Hardware
from fognav_sim.live import LiveWorld, VirtualNode, run_nodes
from fognav_sim.nodes import make_nodes
from fognav_sim.sensors import LidarPlace
from fognav_sim.world import World


class Settings(CommonSettings, frozen=True, kw_only=True):
    """FOGNAV_RUN_DIR: folder of the devices `base` and `lidar`; FOGNAV_TRUTH_LOG: file for the ground truth.

    The robot's hardware, and the lidar's place on it, are those of its robot file
    (`fog_runtime.configuration.robot_file`).
    """

    run_dir: Path
    robot: str = ""
    """Id of the robot in `site.toml`; empty: the first."""
    nodes: Literal["auto", "firmware", "model"] = "auto"
    """What the sensor nodes run: the firmware's core, compiled for this computer, or a model of it in Python.
    `auto`: the firmware where its sources and a C++ compiler are."""
    seed: int = 1
    truth_log: Path | None = None
    node_credentials_dir: Path | None = None
    """Folder with the credentials of each sensor node, `NODE.toml`; without it the nodes are nobody."""

    def credentials_of(self, node: str) -> Credentials | None:
        """Read the credentials of a sensor node, None if its board alone has them; raises `CredentialsError`."""
        if self.node_credentials_dir is None:
            return NOBODY
        file = self.node_credentials_dir / f"{node}.toml"
        return Credentials.read(file) if file.exists() else None


_log = logs.get("sim")
_INITIAL_WHEEL_TRAVEL_M = (28.4, 0.5)
"""How far (m) the wheels have rolled before the start: soon after it, a 16-bit encoder counter wraps."""


def _find_robot(loaded: LoadedSite, robot_id: str) -> RobotSite:
    robots = {robot.id: robot for robot in loaded.site.robots}
    if not robots:
        raise SettingsError(f"{loaded.directory}/site.toml has no [[robots]]: add one with its start")
    if robot_id and robot_id not in robots:
        raise SettingsError(f"FOGNAV_ROBOT: the site has no robot {robot_id!r}, only {', '.join(robots)}")
    return robots[robot_id] if robot_id else loaded.site.robots[0]


async def main() -> None:
    """Simulate until cancelled."""
    settings = load(Settings, environ=os.environ)
    logs.configure("sim", settings.log_level, settings.log_format)
    _log.info("settings_loaded", **describe(settings))
    loaded = load_site(settings.site_dir)
    robot = _find_robot(loaded, settings.robot)
    clock = SystemClock(settings.speed)
    mounted = load_robot(os.environ).settings
    base = devices.make_base(mounted.base.driver)
    place = LidarPlace.of(mounted.lidar)
    floor = Floor(loaded.map.geometry, loaded.map.cells)
    world = World(floor, robot, settings.seed, axle_m=base.axle_m)
    lidar = devices.make_lidar(mounted.lidar.driver, partial(world.lidar_at, place))
    hardware = Hardware(world, base, lidar, clock.now(), initial_wheel_travel_m=_INITIAL_WHEEL_TRAVEL_M)
    boot = int(clock.stamp())
    health = Health("devices", "zenoh")
    site = settings.site or loaded.site.id
    with LiveWorld(hardware, clock, settings.run_dir, settings.truth_log) as live_world:
        health.set("devices", ok=True)
        async with ZenohEdge.open(
            connect=settings.zenoh_endpoints, clock=clock, role="sim", id=robot.id, site=site,
            credentials=settings.credentials(),
        ) as edge:  # fmt: skip
            live_world.serve(edge, robot.id)
            with serve_health(health, settings.http_host, settings.http_port, settings.port_file):
                async with asyncio.TaskGroup() as tasks:
                    tasks.create_task(live_world.run(), name="world")
                    tasks.create_task(live_world.publish_truth(edge, robot.id), name="truth")
                    found = ((node.id, settings.credentials_of(node.id)) for node in loaded.site.nodes)
                    own = {node: credentials for node, credentials in found if credentials is not None}
                    simulated = [node for node in loaded.site.nodes if node.id in own]
                    if real := [node.id for node in loaded.site.nodes if node.id not in own]:
                        _log.warning("nodes_left_to_their_boards", nodes=real)
                    nodes = [
                        VirtualNode(each, live_world, settings.mqtt_url, clock, site, own[each.node.id])
                        for each in make_nodes(simulated, boot, clock.now(), settings.nodes)
                    ]
                    tasks.create_task(run_nodes(nodes, clock), name="nodes")
                    while True:
                        connected = edge.connected
                        health.set("zenoh", ok=connected, detail="" if connected else "no router: is it running?")
                        await asyncio.sleep(clock.real(1.0))


if __name__ == "__main__":
    process.run(main)
