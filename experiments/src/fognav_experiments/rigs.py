"""The system in one thread on an emulated clock: all real cores on one bus, with real encoders, decoders and parsers.

`processes` has what each process does around its core; this module has their surroundings: sensor nodes, base, lidar
and guardian as bytes on their lines, and an operator. Lockstep leaves out sockets, threads and the time of computation.
Robot and fog stand in one file, longer than others, since each step of the system is one of both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.commands import signed_command
from fog_contracts.cones import node_cones, sonar_cones
from fog_contracts.handlers import Moment, Publication
from fog_contracts.messages import CommandReply, NodeConfig
from fog_kernels.sonar import default_config
from fog_runtime.configuration.robot_file import RobotFile, default_robot
from fognav_experiments.computers import ComputerClock
from fognav_experiments.processes import (
    AgentProcess,
    AggregatorProcess,
    Fog,
    FogProcess,
    MapProcess,
    Measure,
    PlannerProcess,
    unmeasured,
)
from fognav_sim import devices
from fognav_sim.floor import Floor
from fognav_sim.hardware import STEP_S, Hardware
from fognav_sim.nodes import make_nodes
from fognav_sim.sensors import LidarPlace
from fognav_sim.world import World
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore
from robot_agent.agent.core import AgentCore
from robot_agent.agent.pose_persistence import start_pose
from robot_agent.config import agent_config
from robot_agent.guardian import link
from robot_agent.guardian.core import GuardianCore
from robot_agent.hardware import DockingDriver
from robot_agent.registry import make_base, make_lidar, profile

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from fog_contracts.messages import CommandKind, Pose, Zone
    from fog_contracts.robot import RobotSettings
    from fog_contracts.site import RobotSite
    from fog_runtime.configuration.site import LoadedSite
    from fognav_sim.emulators import BaseEmulator
    from fognav_sim.nodes import SensorNode
    from fognav_sim.sensors import Noise
    from robot_agent.config import AgentConfig

AGENT: Final = partial(AgentCore, find_profile=profile)
"""What drives a robot: it may be switched to all profiles that are installed."""
STAMP: Final = 1_700_000_000.0
"""The emulated wall clock at time zero: results must not depend on the date of a run."""
OPERATOR_KEY: Final = b"lockstep operator key, no secret"
BOOT: Final = "lockstep"
"""Id of the agent's run: always the same, so that a run repeats itself exactly."""
_INITIAL_WHEEL_TRAVEL_M: Final = (28.9, 0.04)
"""How far (m) the wheels have rolled before the start: a 16-bit encoder counter wraps during the drive."""
_PORT_BYTES: Final = 4096
"""What a serial port holds for a process that does not read it."""
_GUARDIAN_STEPS: Final = 2
_LIDAR_STEPS: Final = 2
_STREAM_STEPS: Final = 5
_IDLE_STREAM_STEPS: Final = 10
_MAP_STEPS: Final = 10
_CONTROL_AFTER_STEPS: Final = 2
"""How much later than the stream decisions begin: `CONTROL_AFTER_S` of the agent's service."""
FogProcessName = Literal["aggregator", "map-service", "planner"]
TICK_STEPS: Final = 10
"""Steps of 10 ms between two ticks of the cores."""


def moment(now: float) -> Moment:
    """Return a time (s) of the emulated clock as the readings of a process's two clocks."""
    return Moment(now, STAMP + now)


@dataclass(frozen=True, kw_only=True)
class Tuning:
    """What differs from the defaults: the nodes' pause between readings (ms), and the robot's highest speed (m/s)."""

    pause_ms: int | None = None
    speed_m_s: float | None = None

    def agent(self, config: AgentConfig) -> AgentConfig:
        """Return a robot's configuration with its highest speed."""
        if self.speed_m_s is None:
            return config
        limits = replace(config.motion.limits, v_max=self.speed_m_s)
        safety = replace(
            config.safety,
            speed_normal=self.speed_m_s,
            speed_degraded=min(config.safety.speed_degraded, self.speed_m_s),
        )
        return replace(config, motion=replace(config.motion, limits=limits), safety=safety)

    def tune(self, nodes: Iterable[SensorNode]) -> None:
        """Configure the nodes' pause."""
        if self.pause_ms is None:
            return
        for node in nodes:
            node.configure(msgspec.structs.replace(default_config(node.node), version=1, pause_ms=self.pause_ms))


class RobotRig:
    """Simulated hardware, guardian and agent of one robot, as its three processes connect them."""

    def __init__(  # noqa: PLR0913  # the parts of the system
        self,
        site: LoadedSite,
        robot: RobotSite,
        world: World,
        base_emulator: BaseEmulator,
        bus: Bus,
        seed: int,
        start: float,
        *,
        mounted: RobotFile | None = None,
        make_agent: Callable[[AgentConfig, int], AgentCore] = AGENT,
        measure: Measure = unmeasured,
    ) -> None:
        """Assemble the robot around its emulated base, `mounted` as its settings say (default: the thesis's robot)."""
        self.id = robot.id
        self._bus = bus
        self._measure = measure
        self.clock = ComputerClock()
        settings = (mounted or default_robot()).settings
        self._mounted = mounted or default_robot()
        driver, self._lidar_driver = make_base(self._mounted), make_lidar(self._mounted)
        lidar_emulator = devices.make_lidar(
            settings.lidar.driver, partial(world.lidar_at, LidarPlace.of(settings.lidar))
        )
        self.hardware = Hardware(
            world, base_emulator, lidar_emulator, start, initial_wheel_travel_m=_INITIAL_WHEEL_TRAVEL_M
        )
        self.guardian = GuardianCore(driver)
        self._boot = BOOT
        self._boots = 0
        self._new_agent: Callable[[], AgentCore] = lambda: make_agent(
            agent_config(
                robot.id,
                OPERATOR_KEY,
                driver.drive_train,
                self._lidar_driver.traits,
                robot,
                boot=self._boot,
                finds_dock=isinstance(driver, DockingDriver),
                settings=None if settings == plain_settings(settings) else settings,
            ),
            seed,
        )
        self.agent = self._new_agent()
        self._stored = start_pose(site.site.id, robot)
        self.agent.restore(self._stored)
        self.process = AgentProcess(self.agent, robot.id, bus, measure, self.clock)
        self._to_base = b""
        self._to_lidar = self._lidar_driver.begin(start)
        self._from_lidar = b""
        self._lidar_on = True
        self._steps = 0
        self._stream_steps = _STREAM_STEPS
        self._nonce = 0
        self.hung = False
        """Whether the agent hangs: the guardian does not, and what base and lidar send waits."""
        self.dead = False
        """Whether there is no agent: base and lidar are not read."""
        self._waiting: list[link.BaseFeedback] = []

    def kill(self) -> None:
        """Let the agent die, if there is one."""
        if self.dead:
            return
        self.dead = True
        self.process.stop()
        self._waiting, self._from_lidar = [], b""
        self._to_base += self.guardian.on_agent_lost(self.shown.now).data

    def start_again(self) -> None:
        """Start another agent, with what the dead one has stored, if none lives."""
        if not self.dead:
            return
        self.dead = False
        self._boots += 1
        self._boot = f"{BOOT}-{self._boots}"
        before = self.process
        self.agent = self._new_agent()
        self.agent.restore(self._stored)
        self.process = AgentProcess(self.agent, self.id, self._bus, self._measure, self.clock)
        self.process.link, self.process.observe = before.link, before.observe
        self.process.received_bytes = before.received_bytes
        self._to_lidar += self._lidar_driver.begin(self.shown.now)
        self._lidar_on = True

    @property
    def absent(self) -> bool:
        """Whether the agent does nothing: it hangs, or there is none."""
        return self.hung or self.dead

    @property
    def shown(self) -> Moment:
        """What the clocks of the robot's computer show."""
        return self.clock(moment(self.now))

    @property
    def now(self) -> float:
        """The emulated time, s."""
        return self.hardware.now

    def sense(self) -> None:
        """Simulate 10 ms, and pass to the agent what base and lidar sent meanwhile."""
        self._steps += 1
        self.hardware.receive(self._to_base, self._to_lidar)
        self._to_base = self._to_lidar = b""
        base, lidar = self.hardware.step(STEP_S)
        shown = self.shown.now
        self._run_guardian(base, shown)
        self._run_lidar(lidar, shown)

    def act(self) -> None:
        """Run the agent's loops that are due: as those of its process, all of them in the first step."""
        if self.absent:
            return
        at, step = moment(self.now), self._steps - 1
        self.process.deliver(at)
        if step % _MAP_STEPS == 0:
            self.process.fetch_map(at)
        since_first = step - _CONTROL_AFTER_STEPS
        if since_first >= 0 and since_first % round(self.agent.profile.control_period / STEP_S) == 0:
            self.process.control(at)
        if step % self._stream_steps == 0:
            command = link.decode_command(link.encode(self.process.stream(at)))
            self._stream_steps = _IDLE_STREAM_STEPS if self.agent.idle else _STREAM_STEPS
            with self._measure("guardian"):
                self._to_base += self.guardian.on_command(command, self.shown.now).data

    def _run_guardian(self, data: bytes, now: float) -> None:
        with self._measure("guardian"):
            output = self.guardian.on_bytes(data, now)
            received = list(output.feedback)
            self._to_base += output.data
            if self._steps % _GUARDIAN_STEPS == 0:
                output = self.guardian.tick(now)
                received += output.feedback
                self._to_base += output.data
        self._waiting += received
        if self.dead:
            self._waiting = []
        elif self._waiting and not self.hung:
            received, self._waiting = self._waiting, []
            with self._measure("localization"):
                for feedback in received:
                    self.agent.on_base(link.decode_feedback(link.encode(feedback)), now)

    def _run_lidar(self, data: bytes, now: float) -> None:
        self._from_lidar = (self._from_lidar + data)[-_PORT_BYTES:]
        if self._steps % _LIDAR_STEPS or self.absent:
            return
        if self.agent.lidar_on is not self._lidar_on:
            self._lidar_on, driver = self.agent.lidar_on, self._lidar_driver
            self._to_lidar += driver.begin(now) if self._lidar_on else driver.stop_command
        if not self._lidar_on:
            self._from_lidar = b""
            return
        with self._measure("lidar driver"):
            received = self._lidar_driver.receive(self._from_lidar, now)
        self._from_lidar = b""
        if received.samples is not None:
            with self._measure("safety and wheels"):
                self.agent.on_lidar_samples(received.samples, now)
        if received.scans:
            with self._measure("localization"):
                for scan in received.scans:
                    self.agent.on_scan(scan, now)
        self._to_lidar += received.data + self._lidar_driver.tick(now)

    def command(self, kind: CommandKind, pose: Pose | None = None) -> CommandReply:
        """Send an operator's signed command, `initial_pose` with a pose; return the reply."""
        self._nonce += 1
        command = signed_command(
            kind,
            robot=self.id,
            operator="lockstep",
            nonce=f"lockstep-{self._nonce:08d}",
            boot=self._boot,
            issued_at=self.shown.now,
            key=OPERATOR_KEY,
            pose=pose,
        )
        reply = self._bus.query(ch.ROBOT_COMMAND, command, CommandReply, moment(self.now), robot=self.id)
        if reply is None:
            return CommandReply(accepted=False, reason="the agent does not answer")
        return reply

    def store(self) -> None:
        """Store the agent's pose as its process does; call it now and then."""
        self._stored = self.agent.pose_to_store(self.shown.now) or self._stored


def plain_settings(settings: RobotSettings) -> RobotSettings:
    """Return the settings of a robot with the same drivers, and nothing else that is not as usual."""
    return default_robot(settings.base.driver, settings.lidar.driver).settings


def make_aggregator(site: LoadedSite, epoch: int) -> Aggregator:
    """Return the aggregator of a site, as it starts."""
    nodes, cones = site.site.nodes, node_cones(site.site.nodes, site.map)
    fusion = AreaFusion(
        site.site.definitions(), nodes, epoch=epoch, registry=find_rule, cones=cones, robots=site.site.robots,
        sonar_cones=sonar_cones(nodes, site.map),
    )  # fmt: skip
    return Aggregator(fusion)


def make_map(site: LoadedSite, epoch: int) -> MapCore:
    """Return the map-service of a site, as it starts; its zones are not loaded yet."""
    layers = make_layers(site.map, site.site.layers)
    return MapCore(site.site.id, site.map, epoch=epoch, layers=layers, definitions=site.site.definitions())


class FogRig(Fog):
    """The fog node of a site, with its sensor nodes."""

    def __init__(
        self, site: LoadedSite, world: World, bus: Bus, seed: int, start: float, *, measure: Measure = unmeasured
    ) -> None:
        super().__init__(
            make_aggregator(site, 1),
            make_map(site, 1),
            PlannerCore(epoch=1),
            bus,
            staging=site.site.staging,
            measure=measure,
        )
        self._bus = bus
        self._site = site
        self._measured_by = measure
        self._zones: dict[str, Zone] = {}
        self._world = world
        # The nodes were switched on at different times.
        self.nodes = make_nodes(site.site.nodes, seed, start, apart=0.013)
        self.start(moment(start))
        # From here on: what is retained at the start was there when the nodes were switched on.
        bus.subscribe({ch.NODE_CONFIG: self._on_node_config})

    def _on_node_config(self, ids: Mapping[str, str], config: NodeConfig, _at: Moment) -> tuple[()]:
        for node in self.nodes:
            if node.node.id == ids["node"]:
                node.configure(config)
        return ()

    def put_zone(self, zone: Zone, at: Moment) -> None:
        """Add or replace an operator's zone, and store it."""
        self._zones[zone.id] = zone
        self.map.put_zone(zone, at)

    def stop(self, process: FogProcessName) -> None:
        """Let a process die."""
        running: dict[FogProcessName, FogProcess] = {
            "aggregator": self.aggregator,
            "map-service": self.map,
            "planner": self.planner,
        }
        running[process].stop()

    def start_again(self, process: FogProcessName, at: Moment) -> None:
        """Start a process that has stopped: with what its store holds and what the broker retains."""
        match process:
            case "aggregator":
                hazards = self.aggregator.core.announced().values()
                core = make_aggregator(self._site, self.aggregator.core.epoch + 1)
                self.aggregator = AggregatorProcess(core, self._bus, self._measured_by, self.clock)
                self._bus.publish(core.restore([], hazards, self.clock(at)))
            case "map-service":
                epoch = self.map.core.costmap.version.epoch + 1
                self.map = MapProcess(make_map(self._site, epoch), self._bus, self._measured_by, self.clock)
                self.map.load_zones(self._zones.values(), at)
                self._bus.publish(self.aggregator.core.republish_all())  # what the broker has retained
            case "planner":
                ended = self.planner.core
                self.planner = PlannerProcess(
                    PlannerCore(epoch=ended.epoch + 1),
                    self._bus,
                    self._site.site.staging,
                    self._measured_by,
                    self.clock,
                )
                for robot, mission in ended.missions.active():
                    if mission.goal is not None:
                        self.planner.set_goal(robot, mission.goal, any_heading=mission.any_heading)
        self.deliver(at)

    def measure(self, now: float) -> None:
        """Let the nodes publish the readings that are due."""
        for node in self.nodes:
            readings = node.poll(self._world, now)
            if readings:
                ids = {"node": node.node.id}
                self._bus.publish(Publication(ch.NODE_READING, reading, ids) for reading in readings)


class System:
    """A site with its fog node, its sensor nodes and one robot, from time zero on."""

    def __init__(  # noqa: PLR0913  # the parts of the system
        self,
        site: LoadedSite,
        robot: RobotSite,
        seed: int,
        *,
        noise: Noise | None = None,
        mounted: RobotFile | None = None,
        bus: Bus | None = None,
        make_agent: Callable[[AgentConfig, int], AgentCore] = AGENT,
        measure: Measure = unmeasured,
        tuning: Tuning | None = None,
        floor: Floor | None = None,
    ) -> None:
        """Assemble the system; `mounted` names the robot's hardware.

        `floor`: the one that it drives on, if it is not exactly as the site's map says.
        """
        tuned = tuning or Tuning()
        self.bus = bus or Bus(site.site.id)
        emulator = devices.make_base((mounted or default_robot()).settings.base.driver)
        true_floor = floor or Floor(site.map.geometry, site.map.cells)
        self.world = World(true_floor, robot, seed, axle_m=emulator.axle_m, noise=noise)
        self.fog = FogRig(site, self.world, self.bus, seed, 0.0, measure=measure)
        self.robot = RobotRig(
            site, robot, self.world, emulator, self.bus, seed, 0.0,
            mounted=mounted, make_agent=lambda config, number: make_agent(tuned.agent(config), number),
            measure=measure,
        )  # fmt: skip
        tuned.tune(self.fog.nodes)
        self._steps = 0

    @property
    def now(self) -> float:
        """The emulated time, s."""
        return self.robot.now

    def step(self, inputs: Iterable[Publication] = ()) -> None:
        """Simulate 10 ms; publish further `inputs` after the nodes' readings."""
        self.robot.sense()
        at = moment(self.now)
        self.fog.measure(at.now)
        self.bus.publish(inputs)
        self.fog.deliver(at)
        self.robot.act()
        if self._steps % TICK_STEPS == 0:
            self.fog.tick(at)
            if not self.robot.absent:
                self.robot.process.tick(at)
                self.robot.store()
            self.fog.deliver(at)
        self._steps += 1
