"""The system in two halves for one thread and one emulated clock: all real cores, real encoders, decoders and parsers.

Each rig does what the edges of its processes do, in the same order and at the same periods, with messages as the bytes
of their channels. What it leaves out is what lockstep cannot have: sockets, threads and the time that computing takes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.commands import sign
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    CommandReply,
    HazardArea,
    MapDelta,
    MapHeartbeat,
    Message,
    PlanReply,
    RobotCommand,
    RobotGoal,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotState,
    ZoneSet,
)
from fognav_sim import devices
from fognav_sim.hardware import STEP_S, Hardware
from fognav_sim.node import SonarNode
from hazard_aggregator.core import Aggregator
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore
from robot_agent.agent.core import AgentCore, SavedPose, decide
from robot_agent.config import agent_config
from robot_agent.guardian import link
from robot_agent.guardian.core import GuardianCore
from robot_agent.registry import make_base, make_lidar

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Publication
    from fog_contracts.messages import CommandKind, MapSnapshot, PlanRequest
    from fog_contracts.site import RobotSite
    from fog_runtime.site import LoadedSite
    from fognav_sim.world import World

M = TypeVar("M", bound=Message)

STAMP: Final = 1_700_000_000.0
"""Where the emulated wall clock stands at time zero: runs must not depend on when they are made."""
_KEY: Final = b"lockstep operator key, no secret"
_ROLLED_M: Final = (28.9, 0.04)
"""The wheels have rolled before: a counter of 16 bits wraps on the way."""
_GUARDIAN_STEPS: Final = 2
_LIDAR_STEPS: Final = 2
_STREAM_STEPS: Final = 5
_BEAT_STEPS: Final = 10
_CONTROL_STEPS: Final = 20


def carry(channel: Channel, message: M) -> M:
    """Send a message over its channel: through its bytes, with every limit enforced."""
    return decode(channel, encode(channel, message), type(message))


class RobotRig:
    """Simulated hardware, guardian and agent of one robot, as its three processes connect them."""

    def __init__(
        self,
        site: LoadedSite,
        robot: RobotSite,
        world: World,
        seed: int,
        start: float,
        *,
        base: str = devices.DEFAULT_BASE,
        lidar: str = devices.DEFAULT_LIDAR,
    ) -> None:
        """Put the robot together; `base` and `lidar` name its drivers and their emulators."""
        self.id = robot.id
        self.world = world
        driver, self._scan = make_base(base), make_lidar(lidar)
        emulators = devices.make_base(base), devices.make_lidar(lidar, world.lidar)
        self.hardware = Hardware(world, *emulators, start, rolled=_ROLLED_M)
        self.guardian = GuardianCore(driver)
        config = agent_config(robot.id, _KEY, robot).with_hardware(driver.drive_train, self._scan.traits)
        self.agent = AgentCore(config, seed)
        begin = robot.start
        self.agent.restore(
            SavedPose(site=site.site.id, x=begin.x, y=begin.y, theta=begin.theta, sigma_xy=0.25, sigma_theta=0.15)
        )
        self._to_base = b""
        self._to_lidar = self._scan.begin(start)
        self._from_lidar = b""
        self._steps = 0
        self._nonce = 0
        self.state: RobotState | None = None
        self.pose: RobotPose | None = None

    @property
    def now(self) -> float:
        """The emulated time, s."""
        return self.hardware.now

    @property
    def moment(self) -> Moment:
        """The emulated time by both clocks."""
        return Moment(self.now, STAMP + self.now)

    def step(self, load: MapSnapshot | None) -> None:
        """Let 10 ms pass; `load` is the snapshot to be had, for when the agent needs one."""
        self._steps += 1
        self.hardware.receive(self._to_base, self._to_lidar)
        self._to_base = self._to_lidar = b""
        base, lidar = self.hardware.step(STEP_S)
        now = self.now
        if load is not None and self.agent.wants_snapshot(now):
            self.agent.load(load, now)
        self._guard(base, now)
        self._look(lidar, now)
        if self._steps % _CONTROL_STEPS == 0 and (job := self.agent.control_job(now)) is not None:
            self.agent.accept(decide(job))
        if self._steps % _STREAM_STEPS == 0:
            command = link.decode_command(link.encode(self.agent.stream(now, STAMP + now)))
            self._to_base += self.guardian.on_command(command, now).data

    def _guard(self, data: bytes, now: float) -> None:
        output = self.guardian.on_bytes(data, now)
        told = list(output.feedback)
        self._to_base += output.data
        if self._steps % _GUARDIAN_STEPS == 0:
            output = self.guardian.tick(now)
            told += output.feedback
            self._to_base += output.data
        for feedback in told:
            self.agent.on_base(link.decode_feedback(link.encode(feedback)), now)

    def _look(self, data: bytes, now: float) -> None:
        self._from_lidar += data
        if self._steps % _LIDAR_STEPS:
            return
        received = self._scan.receive(self._from_lidar, now)
        self._from_lidar = b""
        if received.samples:
            self.agent.on_lidar_nodes(now)
        for scan in received.scans:
            self.agent.on_scan(scan, now)
        self._to_lidar += received.data + self._scan.tick(now)

    def hear(self, channel: Channel, message: Message) -> None:
        """Hand a message of the fog to the agent."""
        self.agent.handlers()[channel]({"robot": self.id}, message, self.moment)

    def tell(self) -> tuple[RobotPose | None, RobotState | None, RobotObstacles | None]:
        """Return what the agent publishes in this step, of which there is one every 0.1 s: pose, state, obstacles."""
        if self._steps % _BEAT_STEPS:
            return None, None, None
        pose = state = obstacles = None
        for publication in self.agent.tick(self.moment):
            match publication.message:
                case RobotPose() as message:
                    pose = carry(publication.channel, message)
                case RobotState() as message:
                    state = carry(publication.channel, message)
                case RobotObstacles() as message:
                    obstacles = carry(publication.channel, message)
        self.pose = pose
        self.state = state or self.state
        return pose, state, obstacles

    def command(self, kind: CommandKind) -> CommandReply:
        """Give an operator's signed command."""
        self._nonce += 1
        unsigned = RobotCommand(
            kind=kind,
            robot=self.id,
            operator="lockstep",
            nonce=f"lockstep-{self._nonce:08d}",
            issued_at=STAMP + self.now,
        )
        command = carry(ch.ROBOT_COMMAND, sign(unsigned, _KEY))
        reply = self.agent.answerers()[ch.ROBOT_COMMAND]({"robot": self.id}, command, self.moment)
        assert isinstance(reply, CommandReply)
        return reply


class FogRig:
    """Sensor nodes, aggregator, map-service and planner, as their processes connect them."""

    def __init__(self, site: LoadedSite, world: World, seed: int, start: float) -> None:
        definitions = site.site.definitions()
        self.world = world
        # Each node was switched on at a time of its own.
        self.nodes = [
            SonarNode(node, boot=seed + index, start=start + 0.013 * (index % 8))
            for index, node in enumerate(site.site.nodes)
        ]
        self.aggregator = Aggregator(definitions, site.site.nodes, epoch=1, registry=find_rule)
        self.map = MapCore(
            site.site.id, site.map, epoch=1, layers=make_layers(site.map, site.site.layers), definitions=definitions
        )
        self.planner = PlannerCore(epoch=1)
        self.hazards: dict[str, HazardArea] = {}
        self._told: list[HazardArea] = []
        self._deltas: list[MapDelta] = []
        self._heartbeats: list[MapHeartbeat] = []
        self._zones: list[ZoneSet] = []
        self._steps = 0
        at = Moment(start, STAMP + start)
        self._publish_map(self.map.load_zones([], at))
        self._publish_map(self.map.on_broker(at, connected=True))
        self._publish_map(self.map.on_aggregator("lockstep", at, alive=True))
        for definition in definitions:
            self._map(ch.AREA_DEFINITION, {"area": definition.id}, definition, start)
        self.planner.load(self.snapshot, start)

    @property
    def snapshot(self) -> MapSnapshot:
        """The map-service's snapshot."""
        return self.map.costmap.snapshot()

    def step(self, now: float) -> None:
        """Let time pass up to `now`: nodes measure, and every 0.1 s aggregator, map-service and planner beat."""
        self._steps += 1
        stamp = STAMP + now
        for node in self.nodes:
            for reading in node.poll(self.world, now):
                self._aggregate(ch.NODE_READING, {"node": node.node.id}, reading, now)
        if self._steps % _BEAT_STEPS == 0:
            self._hazards(self.aggregator.tick(Moment(now, stamp)), now)
            self._publish_map(self.map.tick(Moment(now, stamp)))

    def inform_planner(self, now: float) -> None:
        """Give the planner the map's news; the robot gets the same right after."""
        planner = self.planner
        for channel, messages in (
            (ch.HAZARD, self._told),
            (ch.ZONES, self._zones),
            (ch.MAP_DELTA, self._deltas),
            (ch.MAP_HEARTBEAT, self._heartbeats),
        ):
            for message in messages:
                self._inform(channel, {}, message, now)
        if planner.wants_snapshot(now):
            planner.load(self.snapshot, now)
        for job in planner.field_jobs():
            job.run()
            planner.take_field(job)

    def hear(
        self, robot: str, told: tuple[RobotPose | None, RobotState | None, RobotObstacles | None], now: float
    ) -> None:
        """Take what a robot publishes."""
        pose, state, obstacles = told
        if pose is not None:
            self._aggregate(ch.ROBOT_POSE, {"robot": robot}, pose, now)
            self._map(ch.ROBOT_POSE, {"robot": robot}, pose, now)
            self._inform(ch.ROBOT_POSE, {"robot": robot}, pose, now)
        if state is not None:
            self._inform(ch.ROBOT_STATE, {"robot": robot}, state, now)
        if obstacles is not None:
            self._map(ch.ROBOT_OBSTACLES, {"robot": robot}, obstacles, now)

    def deliver(self, robot: RobotRig) -> list[RobotPath | RobotGoal]:
        """Bring the robot what the fog published since the last time; return its paths and goals."""
        self.inform_planner(robot.now)
        for told in self._told:
            robot.hear(ch.HAZARD, told)
        for zones in self._zones:
            robot.hear(ch.ZONES, zones)
        for delta in self._deltas:
            robot.hear(ch.MAP_DELTA, delta)
        for heartbeat in self._heartbeats:
            robot.hear(ch.MAP_HEARTBEAT, heartbeat)
        self._told, self._zones, self._deltas, self._heartbeats = [], [], [], []
        published: list[RobotPath | RobotGoal] = []
        for publication in self.planner.tick(robot.moment):
            message = publication.message
            if publication.ids["robot"] != robot.id or not isinstance(message, (RobotPath, RobotGoal)):
                continue
            taken = carry(publication.channel, message)
            robot.hear(publication.channel, taken)
            published.append(taken)
        return published

    def preview(self, request: PlanRequest, now: float) -> PlanReply:
        """Ask the planner for a path, without side effects."""
        reply = self.planner.answerers()[ch.PLANNER_PLAN]({}, request, Moment(now, STAMP + now))
        assert isinstance(reply, PlanReply)
        return reply

    def _inform(self, channel: Channel, ids: dict[str, str], message: Message, now: float) -> None:
        self.planner.handlers()[channel](ids, message, Moment(now, STAMP + now))

    def _aggregate(self, channel: Channel, ids: dict[str, str], message: Message, now: float) -> None:
        handler = self.aggregator.handlers()[channel]
        self._hazards(handler(ids, carry(channel, message), Moment(now, STAMP + now)), now)

    def _hazards(self, publications: Iterable[Publication], now: float) -> None:
        """Take what the aggregator publishes, with a store that answers at once."""
        for publication in (*publications, *self.aggregator.stored(self.aggregator.to_store())):
            if publication.channel in self.map.handlers():
                self._map(publication.channel, dict(publication.ids), publication.message, now)

    def _map(self, channel: Channel, ids: dict[str, str], message: Message | str, now: float) -> None:
        assert isinstance(message, Message)
        self._publish_map(self.map.handlers()[channel](ids, carry(channel, message), Moment(now, STAMP + now)))

    def _publish_map(self, publications: Iterable[Publication]) -> None:
        for message in (publication.message for publication in publications):
            if isinstance(message, MapDelta):
                self._deltas.append(carry(ch.MAP_DELTA, message))
            elif isinstance(message, MapHeartbeat):
                self._heartbeats.append(carry(ch.MAP_HEARTBEAT, message))
            elif isinstance(message, HazardArea):
                hazard = carry(ch.HAZARD, message)
                self._told.append(hazard)
                self.hazards[hazard.hazard.area] = hazard
            elif isinstance(message, ZoneSet):
                self._zones.append(carry(ch.ZONES, message))
