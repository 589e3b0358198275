"""The edge of the simulator: real time, ptys, sensor nodes over MQTT, ground truth and commands over zenoh."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final, Protocol, Self

import msgspec
import numpy as np
from prometheus_client import Gauge

from fog_contracts import channels as ch
from fog_contracts.costs import FREE
from fog_contracts.geometry import GeometryError
from fog_contracts.messages import CommandReply, NodeConfig, Pose, Reason, SimCommand, SimObstacle, SimRefusal
from fog_contracts.site import RobotSite
from fog_runtime import logs
from fog_runtime.clock import Ticker
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.transports.mqtt_edge import MqttEdge, Will
from fognav_sim.floor import Floor
from fognav_sim.hardware import STEP_S
from fognav_sim.pty_port import PtyPort
from fognav_sim.world import World

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from types import TracebackType

    from fog_contracts.geometry import Point
    from fog_runtime.clock import Clock
    from fog_runtime.configuration.site import LoadedSite
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from fognav_sim.hardware import Hardware
    from fognav_sim.nodes import SensorNode

LOG_S: Final = 0.01
CATCH_UP_S: Final = 0.25
"""A simulation that is further behind than this skips the time; its sustained speed then drops."""
_SPEED_OVER_S: Final = 5.0
PERSON_RADIUS_M: Final = 0.25
_MITE_M: Final = 0.01
_MITE_AXLE_M: Final = 0.235

_log = logs.get("sim")
_SUSTAINED = Gauge("fognav_sim_sustained_speed", "Simulated seconds per wall second, over the last 5 s")


class SpeedMeter:
    """Measures simulated time over wall time, in a window of 5 s of wall time."""

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque()

    def update(self, wall: float, simulated: float) -> float:
        """Record how much has been simulated by now (s); return the speed."""
        self._samples.append((wall, simulated))
        while wall - self._samples[0][0] > _SPEED_OVER_S and len(self._samples) > 2:
            self._samples.popleft()
        passed = wall - self._samples[0][0]
        return (simulated - self._samples[0][1]) / passed if passed > 0 else 0.0


class TruthLog:
    """Ground truth as lines of JSON, 100 per simulated second; unbuffered, for tests that read them after a kill."""

    def __init__(self, path: Path | None) -> None:
        self._file = None if path is None else path.open("ab", buffering=0)
        self._next = 0.0

    def write(self, hardware: Hardware, wheels: tuple[float, float], now: float) -> None:
        """Write a line if one is due. `wheels` are the wheel speeds last commanded (m/s)."""
        if self._file is None or now < self._next:
            return
        self._next = now + LOG_S
        world = hardware.world
        x, y, theta = world.pose
        line = {
            "t_mono": time.monotonic(),
            "now": now,
            "x": x,
            "y": y,
            "theta": theta,
            "left": wheels[0],
            "right": wheels[1],
            "contacts": world.contacts,
            "clearance": world.clearance(),
            "distance": world.distance,
        }
        self._file.write(msgspec.json.encode(line) + b"\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class LiveWorld:
    """The world simulated in real time, with base and lidar on ptys; sensor nodes measure it, commands change it."""

    def __init__(self, hardware: Hardware, clock: Clock, run_dir: Path, truth_log: Path | None) -> None:
        self.world = hardware.world
        self._clock = clock
        self._hardware = hardware
        self._stack = ExitStack()
        self._base = self._stack.enter_context(PtyPort(run_dir / "base"))
        self._lidar = self._stack.enter_context(PtyPort(run_dir / "lidar"))
        self._truth_log = TruthLog(truth_log)
        self._stack.callback(self._truth_log.close)
        self.sustained_speed = clock.speed
        self.lidar_silent = False
        self.silent_nodes: frozenset[str] = frozenset()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def now(self) -> float:
        """The time up to which the world has been simulated (s of the clock)."""
        return self._hardware.now

    async def run(self) -> None:
        """Simulate in steps of 10 ms in real time, until cancelled."""
        meter = SpeedMeter()
        simulated = 0.0
        async for now in Ticker(self._clock, STEP_S):
            behind = now - self._hardware.now
            if behind > CATCH_UP_S:
                _log.warning("behind", skipped_s=round(behind, 3))
                self._hardware.now = now - STEP_S
            while self._hardware.now + STEP_S <= now:
                self._step()
                simulated += STEP_S
            self.sustained_speed = meter.update(time.monotonic(), simulated)
            _SUSTAINED.set(self.sustained_speed)

    def _step(self) -> None:
        hardware = self._hardware
        hardware.receive(self._base.read(), self._lidar.read())
        to_host, scan = hardware.step()
        if to_host:
            self._base.write(to_host)
        if scan and not self.lidar_silent:
            self._lidar.write(scan)
        self._truth_log.write(hardware, hardware.base.wheel_speeds_m_s, hardware.now)

    def serve(self, edge: ZenohEdge, robot: str) -> None:
        """Serve commands that change the world."""
        edge.serve(ch.SIM_COMMAND, lambda _, command: self._on_command(command), robot=robot)

    def _on_command(self, command: SimCommand) -> CommandReply:
        missing = [name for name in command.remove if not self.world.remove(name)]
        try:
            for obstacle in command.place:
                self.world.place(obstacle)
                _log.info("placed", id=obstacle.id)
            if command.kidnap is not None:
                self.world.kidnap(command.kidnap)
        except (GeometryError, ValueError) as error:
            return CommandReply.refused(Reason(SimRefusal.MISFIT, str(error)))
        if command.lidar_silent is not None:
            self.lidar_silent = command.lidar_silent
        if command.nodes_silent is not None:
            self.silent_nodes = frozenset(command.nodes_silent)
        if missing:
            sentence = f"no such obstacle to remove: {', '.join(missing)}"
            return CommandReply.refused(Reason(SimRefusal.NO_OBSTACLE, sentence))
        return CommandReply(accepted=True, reason="")

    async def publish_truth(self, edge: ZenohEdge, robot: str) -> None:
        """Publish the ground truth ten times a second, until cancelled."""
        async for _ in Ticker(self._clock, ch.SIM_TRUTH.period_s):
            truth = self.world.truth(self._clock.stamp(), self.sustained_speed)
            edge.publish(ch.SIM_TRUTH, truth, robot=robot)


class MeasuredFloor(Protocol):
    """What virtual nodes measure: a world at a time (s), and who of them is silenced."""

    world: World
    silent_nodes: frozenset[str]

    @property
    def now(self) -> float:
        """The time up to which the world has been simulated (s of the clock)."""


class StillFloor:
    """A floor on which nothing moves: what virtual nodes measure to try a site before it is built."""

    def __init__(
        self, loaded: LoadedSite, persons: Sequence[Point], clock: Clock, *, world: type[World] = World
    ) -> None:
        """Put persons on the site's floor, a `world`; raises `ValueError` for one that does not stand on it."""
        self._clock = clock
        self.silent_nodes: frozenset[str] = frozenset()
        # A world has a robot: here one that lies below every sensor's cone.
        x, y = loaded.map.geometry.centre(*np.argwhere(loaded.map.cells == FREE)[0][::-1].tolist())
        mite = RobotSite(id="mite", start=Pose(x=x, y=y, theta=0.0), radius=_MITE_M, height=_MITE_M)
        self.world = world(Floor(loaded.map.geometry, loaded.map.cells), mite, seed=1, axle_m=_MITE_AXLE_M)
        for index, (x, y) in enumerate(persons):
            if not loaded.map.geometry.contains(x, y):
                raise ValueError(f"{x:g},{y:g} is not on the map")
            angles = np.linspace(0.0, math.tau, 16, endpoint=False)
            ring = [(x + PERSON_RADIUS_M * math.cos(a), y + PERSON_RADIUS_M * math.sin(a)) for a in angles]
            try:
                self.world.place(SimObstacle(id=f"person-{index + 1}", polygon=ring, height=1.7))
            except (GeometryError, ValueError) as error:
                raise ValueError(f"{x:g},{y:g}: {error}") from error

    @property
    def now(self) -> float:
        """The time at which the floor is measured (s)."""
        return self._clock.now()


class VirtualNode:
    """A simulated sensor node with its own MQTT connection, as a real one has."""

    def __init__(  # what it is, where it is, and how it reaches its broker
        self,
        sonars: SensorNode,
        floor: MeasuredFloor,
        url: str,
        clock: Clock,
        site: str,
        credentials: Credentials = NOBODY,
    ) -> None:
        self._sonars = sonars
        self._world = floor
        self._clock = clock
        self._id = sonars.node.id
        will = Will(ch.NODE_AVAILABILITY, ch.OFFLINE, {"node": self._id})
        # As a board: a broker that serves several floors disconnects one of two clients with the same id.
        client = f"node-{site}-{self._id}"
        self._mqtt = MqttEdge(url, client, clock, site=site, will=will, credentials=credentials)
        self._mqtt.on(ch.NODE_CONFIG, self._on_config, NodeConfig)
        self._mqtt.on(ch.NODE_COMMAND, self._on_command)
        self._problem: str | None = None
        self._heard = False
        self._mqtt.on_connect(self._announce)

    async def connect(self) -> None:
        """Stay connected until cancelled."""
        await self._mqtt.run()

    async def _announce(self) -> None:
        await self._mqtt.publish(ch.NODE_AVAILABILITY, ch.ONLINE, node=self._id)

    def _on_config(self, ids: Mapping[str, str], config: NodeConfig) -> None:
        if ids["node"] == self._id and not self._sonars.configure(config):
            _log.warning("config_ignored", node=self._id, reason="its number of sonars does not match")

    def _on_command(self, ids: Mapping[str, str], command: str) -> None:
        if ids["node"] == self._id:
            self._problem = self._sonars.command(command) or ""

    async def measure(self) -> None:
        """Publish the readings that are due."""
        # A node that is not connected, or silenced by a scenario, measures but does not publish.
        heard = self._mqtt.connected and self._id not in self._world.silent_nodes
        if heard and not self._heard:
            self._sonars.on_connected()
        self._heard = heard
        for reading in self._sonars.poll(self._world.world, self._world.now):
            if heard:
                await self._mqtt.publish(ch.NODE_READING, reading, node=self._id)
        if (calibration := self._sonars.take_calibration()) is not None:
            await self._mqtt.publish(ch.NODE_CALIBRATION, calibration, node=self._id)
        if self._problem is not None:
            problem, self._problem = self._problem, None
            await self._mqtt.publish(ch.NODE_PROBLEM, problem, node=self._id)


async def run_nodes(nodes: list[VirtualNode], clock: Clock, step_s: float = STEP_S) -> None:
    """Let all nodes measure and publish, until cancelled; each runs its code up to the present every `step_s` (s)."""
    async with asyncio.TaskGroup() as tasks:
        for node in nodes:
            tasks.create_task(node.connect())
        async for _ in Ticker(clock, step_s):
            for node in nodes:
                await node.measure()
