"""Lockstep and the live services decide the same: one recorded drive goes through both wirings.

Lockstep drives a robot around a barrier; all external inputs (nodes, other robots, operators, base and lidar) are
recorded and passed to the services' own `Service` classes. These must make the same decisions: every publication of
every channel, every reply and every wheel command.
"""

from __future__ import annotations

import asyncio
import importlib.util
import inspect
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.commands import sign
from fog_contracts.handlers import Core, Publication
from fog_contracts.messages import (
    AreaHazard,
    CircleShape,
    CommandKind,
    CommandReply,
    EgressRequest,
    LoopHealth,
    MapDelta,
    PlanReply,
    PlanRequest,
    Pose,
    RectangleShape,
    RobotCommand,
    RobotGoal,
    RobotObstacles,
    RobotPose,
    RobotState,
    Zone,
    ZoneSet,
)
from fog_contracts.site import AreaSite
from fognav_experiments.rigs import BOOT, OPERATOR_KEY, System, moment
from fognav_sim.barrier import barrier_across
from hazard_aggregator.core import Aggregator
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule
from map_service.core import MapCore
from map_service.registry import make_layers
from planner.core import PlannerCore
from planner.robot_operator import CommandError
from planner.stops import Order
from robot_agent.agent.core import AgentCore
from robot_agent.agent.recording import input_log as log

if TYPE_CHECKING:
    from robot_agent.config import AgentConfig

HERE = Path(__file__).parent


def module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


live_services = module(HERE / "live_services.py")
usage = module(HERE / "channel_usage.py")

SEED = 3
STEPS = 1500
ENABLE, GOAL, BARRIER, EXTERNAL = 350, 400, 500, 620
QUERIES, ARRIVAL, ZONE_AROUND_ROBOT = 1000, 1100, 1250
COMMANDS: dict[int, CommandKind] = {ENABLE: "enable", 1320: "egress"}
GOAL_ID = "goal-of-the-drive"
EXTERNAL_CHANNELS = {ch.NODE_READING, ch.NODE_AVAILABILITY, ch.THESIS_AREA}
ROBOT_CHANNELS = {ch.ROBOT_POSE, ch.ROBOT_STATE, ch.ROBOT_OBSTACLES}
OTHER_ROBOT = "r2"
HARDWARE = (log.BaseReceived, log.LidarSamplesReceived, log.ScanReceived)
ZONE_SLOW = Zone(
    id="slow",
    kind="SPEED_LIMIT",
    speed=0.1,
    shape=RectangleShape(corner=(5.0, 5.5), opposite=(9.0, 7.5)),
    reason="visitors",
    version=1,
)
ZONE_WET = Zone(id="wet", kind="BLOCKED", shape=CircleShape(centre=(10.0, 6.4), radius=0.4), reason="mopped", version=1)
ZONES = {910: ZONE_SLOW, 920: ZONE_WET}
"""By the step in which they are drawn: the planner has planned by the first before it hears of the second."""
PLAN = PlanRequest(start=Pose(x=1.5, y=1.5, theta=0.0), goal=Pose(x=13.5, y=6.5, theta=0.0))
EGRESS = EgressRequest(robot="r1", pose=Pose(x=7.5, y=1.5, theta=0.0))


class RecordingBus(Bus):
    """Records every publication with its step; loses the first map version with a blocked area, and one hazard."""

    def __init__(self, site: str) -> None:
        super().__init__(site)
        self.step = 0
        self.published: list[tuple[int, Publication]] = []
        self.lost: int | None = None
        self.lost_hazard: AreaHazard | None = None

    def publish(self, publications: Any) -> None:
        for publication in publications:
            self.published.append((self.step, publication))
            if not self._loses(publication.message):
                super().publish([publication])

    def _loses(self, message: Any) -> bool:
        if isinstance(message, AreaHazard) and message.state == "clear" and self.lost_hazard is None:
            self.lost_hazard = message
            return True
        if not isinstance(message, MapDelta):
            return False
        if self.lost is None and any(cause.state == "blocked" for cause in message.causes):
            self.lost = message.seq
        return message.seq == self.lost


@dataclass
class Run:
    """A drive: the external inputs of each step, and the decisions."""

    bus: RecordingBus
    config: AgentConfig
    times: list[float] = field(default_factory=list)
    hardware: list[list[log.Entry]] = field(default_factory=list)
    replies: list[Any] = field(default_factory=list)
    wheels: list[Any] = field(default_factory=list)
    last_zone: Zone = ZONE_WET

    def external(self, step: int) -> list[Publication]:
        return [p for at, p in self.bus.published if at == step and is_external(p)]

    def decisions(self) -> dict[str, list[Any]]:
        """Return what the system published by itself, by channel: step, ids and content.

        Without what tells people and other systems: the service makes it of what the core has decided.
        """
        found: dict[str, list[Any]] = {}
        for step, publication in self.bus.published:
            if not is_external(publication) and publication.channel not in TOLD_BY_SERVICES:
                entry = step, dict(publication.ids), comparable(publication.message)
                found.setdefault(publication.channel.name, []).append(entry)
        return found


TOLD_BY_SERVICES = (ch.AGGREGATOR_ALERTS, ch.AGGREGATOR_AVAILABILITY, ch.HOME_ASSISTANT_AREA, ch.ROBOT_VITALS)


def is_external(publication: Publication) -> bool:
    from_other_robot = publication.channel in ROBOT_CHANNELS and publication.ids["robot"] == OTHER_ROBOT
    return publication.channel in EXTERNAL_CHANNELS or from_other_robot


def comparable(message: Any) -> Any:
    # The timing of its loops is not a decision.
    return msgspec.structs.replace(message, loop=LoopHealth()) if isinstance(message, RobotState) else message


def signed(kind: CommandKind, now: float) -> RobotCommand:
    unsigned = RobotCommand(kind=kind, robot="r1", operator="test", nonce=f"{kind:n<16}", boot=BOOT, issued_at=now)
    return sign(unsigned, OPERATOR_KEY)


def _elsewhere(stamp: float) -> RobotPose:
    """Return the pose of the other robot, which stands far from the path."""
    return RobotPose(x=7.5, y=0.85, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.5, stamp=stamp)


def external_messages(step: int, readings: list[Any]) -> list[Publication]:
    """Return a step's messages of another robot and of thesis nodes, invalid ones, and a reading delivered twice."""
    at = moment(step * 0.01)
    robot = {"robot": OTHER_ROBOT}
    found: list[Publication] = []
    if step % 100 == 50 and readings:
        found.append(Publication(ch.NODE_READING, readings[-1], {"node": "n1"}))
    if step == EXTERNAL:
        seen = RobotObstacles(points=[(4.0, 7.0), (4.05, 7.0)], stamp=at.stamp, ttl=3.0)
        found += [
            Publication(ch.ROBOT_POSE, _elsewhere(at.stamp), robot),
            Publication(ch.NODE_AVAILABILITY, "online", {"node": "n1"}),
            Publication(ch.NODE_AVAILABILITY, "perhaps", {"node": "n1"}),
            Publication(ch.THESIS_AREA, "blocked", {"number": "7"}),
            Publication(ch.ROBOT_OBSTACLES, seen, robot),
        ]
    if EXTERNAL <= step < EXTERNAL + 400 and step % 20 == 0:
        found.append(Publication(ch.THESIS_AREA, "clear", {"number": "2"}))
    if step >= EXTERNAL and step % 20 == 0:
        found.append(Publication(ch.ROBOT_POSE, _elsewhere(at.stamp), robot))
    if step == ARRIVAL:
        state = RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=0.5, goal_id=GOAL_ID, map_epoch=1, map_seq=1, plan_id=1,
            goal_reached=True, stamp=at.stamp,
        )  # fmt: skip
        found.append(Publication(ch.ROBOT_STATE, state, robot))
    return found


def site_with_two_areas() -> Any:
    """Return the ring site with one more area, which only a node of the thesis watches."""
    loaded = ring.ring_site()
    around_start = AreaSite(id="z2", label="West", polygon=[(0.5, 2.6), (2.5, 2.6), (2.5, 5.0), (0.5, 5.0)], number=2)
    return replace(loaded, site=msgspec.structs.replace(loaded.site, areas=[*loaded.site.areas, around_start]))


def drive_in_lockstep() -> Run:
    site = site_with_two_areas()
    entries: list[log.Entry] = []
    bus = RecordingBus(site.site.id)
    system = System(
        site, site.site.robots[0], SEED, bus=bus, make_agent=lambda c, s: log.LoggedAgent(c, s, entries.append)
    )
    started = entries[0]
    assert isinstance(started, log.Started)
    run = Run(bus, replace(started.config, operator_key=OPERATOR_KEY))
    readings: list[Any] = []
    bus.subscribe({ch.NODE_READING: lambda _ids, reading, _at: readings.append(reading) or ()})
    fog = system.fog
    for step in range(1, STEPS + 1):
        bus.step = step
        entries.clear()
        system.step(external_messages(step, readings))
        run.hardware.append([e for e in entries if isinstance(e, HARDWARE)])
        run.wheels += [entry.command for entry in entries if isinstance(entry, log.WheelsCommanded)]
        run.times.append(system.now)
        at = moment(system.now)
        if step in COMMANDS:
            command = signed(COMMANDS[step], at.now)
            run.replies.append(bus.query(ch.ROBOT_COMMAND, command, CommandReply, at, robot="r1"))
        if step == BARRIER:
            system.world.place(barrier_across(site.site.areas[0], site.site, site.map, SEED))
        if step == GOAL:
            for robot in ("r1", OTHER_ROBOT):
                fog.planner.set_goal(robot, goal(at.stamp), any_heading=True)
                fog.deliver(at)
        if step in ZONES:
            fog.map.put_zone(ZONES[step], at)
        if step == ZONE_AROUND_ROBOT:
            run.last_zone = zone_around(*system.world.pose[:2])
            fog.map.put_zone(run.last_zone, at)
        if step == QUERIES:
            run.replies.append(bus.query(ch.PLANNER_PLAN, PLAN, PlanReply, at))
            run.replies.append(bus.query(ch.PLANNER_EGRESS, EGRESS, PlanReply, at))
            run.replies.append(bus.query(ch.ZONES, None, ZoneSet, at))
        fog.deliver(at)
    return run


def zone_around(x: float, y: float) -> Zone:
    """Return a no-go zone around a robot at (x, y)."""
    shape = CircleShape(centre=(round(float(x), 2), round(float(y), 2)), radius=0.5)
    return Zone(id="here", kind="BLOCKED", shape=shape, reason="gas", version=1)


def goal(stamp: float) -> RobotGoal:
    pose = Pose(x=ring.GOAL.x, y=ring.GOAL.y, theta=0.0)
    return RobotGoal(goal_id=GOAL_ID, pose=pose, place=None, stamp=stamp)


def feed(live: Any, entries: list[log.Entry]) -> None:
    """Pass to the agent's service what base and lidar sent in a step."""
    for entry in entries:
        match entry:
            case log.BaseReceived():
                live.agent.on_feedback(entry.feedback, entry.now)
            case log.LidarSamplesReceived():
                live.agent_core.on_lidar_samples(entry.samples(), entry.now)
            case log.ScanReceived():
                live.agent.on_scan(entry.scan(), entry.now)


async def replay(live: Any, bus: RecordingBus, recorded: Run, step: int) -> None:
    """Give the live services what came from outside at a step of a recorded drive, at its time."""
    bus.step = step
    live.clock.time = recorded.times[step - 1]
    feed(live, recorded.hardware[step - 1])
    bus.publish(recorded.external(step))
    await live.run_until_idle()
    if step == 1:
        await live.begin_loops()
    else:
        await live.clock.wake(live.run_until_idle)


async def drive_live(recorded: Run) -> tuple[Run, Any]:
    asyncio.get_running_loop().set_default_executor(live_services.InlineExecutor())
    site = site_with_two_areas()
    bus = RecordingBus(site.site.id)
    run = Run(bus, recorded.config)
    live = live_services.LiveServices(site, recorded.config, SEED, bus)
    await live.start()
    for step, now in enumerate(recorded.times, 1):
        await replay(live, bus, recorded, step)
        if step in COMMANDS:
            command = signed(COMMANDS[step], now)
            run.replies.append(await live.run(live.query(ch.ROBOT_COMMAND, command, CommandReply, robot="r1")))
        if step == GOAL:
            pose = goal(0.0).pose
            assert pose is not None
            for robot in ("r1", OTHER_ROBOT):
                await live.run(live.planner.send(Order(robot, pose, "tester", any_heading=True)))
        if step in ZONES:
            await live.run(live.map.zones.create(ZONES[step], "tester"))
        if step == ZONE_AROUND_ROBOT:
            await live.run(live.map.zones.create(recorded.last_zone, "tester"))
        if step == QUERIES:
            run.replies.append(await live.run(live.query(ch.PLANNER_PLAN, PLAN, PlanReply)))
            run.replies.append(await live.run(live.query(ch.PLANNER_EGRESS, EGRESS, PlanReply)))
            run.replies.append(await live.run(live.query(ch.ZONES, None, ZoneSet)))
            with pytest.raises(CommandError, match="did not answer"):
                await live.run(live.planner.operator.send("disable", OTHER_ROBOT, "tester"))
        await live.run_until_idle()
    run.wheels = live.link.sent
    await live.stop()
    return run, live


@pytest.fixture(scope="module")
def lockstep() -> Run:
    return drive_in_lockstep()


@pytest.fixture(scope="module")
def live(lockstep: Run) -> tuple[Run, Any]:
    with pytest.MonkeyPatch.context() as patch:
        for module in (
            "planner.query_queue",
            "robot_agent.agent.edges.map_loader",
            "robot_agent.agent.service",
            "fog_runtime.concurrency",
        ):
            patch.setattr(f"{module}.ThreadPoolExecutor", live_services.InlineExecutor)
        patch.setattr("planner.tours.persistence.secrets.token_hex", lambda _: GOAL_ID)
        return asyncio.run(drive_live(lockstep))


def test_recorded_drive_contains_all_kinds_of_decisions(lockstep):
    decisions = lockstep.decisions()
    modes = {state.mode for _, _, state in decisions["robot_state"]}
    assert {"INIT", "NORMAL", "DEGRADED", "PROTECTIVE_STOP", "EGRESS"} <= modes
    assert {"clear", "blocked", "unknown"} <= {hazard.state for _, _, hazard in decisions["area_hazard"]}
    assert OTHER_ROBOT in {hazard.explained_by for _, _, hazard in decisions["area_hazard"]}
    assert len({path.plan_id for _, _, path in decisions["robot_path"]}) >= 3
    assert {delta.layer for _, _, delta in decisions["map_delta"]} == {"cost", "speed"}
    assert lockstep.bus.lost is not None
    assert lockstep.bus.lost_hazard is not None
    assert decisions["aggregator_request"]
    assert [accepted.accepted for accepted in lockstep.replies[:1]] == [True]


def test_live_services_publish_what_lockstep_publishes(lockstep, live):
    run, _ = live
    expected, found = lockstep.decisions(), run.decisions()
    assert found.keys() == expected.keys()
    for channel, decisions in expected.items():
        for live_decision, decision in zip(found[channel], decisions, strict=False):
            assert live_decision == decision, channel
        assert len(found[channel]) == len(decisions), channel


def test_live_services_reply_refuse_and_drive_as_in_lockstep(lockstep, live):
    run, _ = live
    assert run.replies == lockstep.replies
    assert run.bus.refused == lockstep.bus.refused
    assert len(run.bus.refused) == 1
    assert run.wheels == lockstep.wheels
    assert any(command.left and command.right for command in run.wheels)


# --- The channel table is the source of who publishes and who subscribes ---


def table_pairs(live: Any, kind: str, side: str) -> set[Any]:
    """Return the table's pairs of role and channel on one side, for the roles that run here.

    Here each service runs once and always leads: without `fog_runtime.leadership`, which announces the leader
    and asks who is present.
    """
    rows = [row for row in ch.CHANNELS.values() if row.kind == kind and row not in {ch.LEADER, ch.LIVE}]
    return {(role, row) for row in rows for role in getattr(row, side) if role in live.edges} - usage.NOT_YET


def of_kind(pairs: set[Any], kind: str) -> set[Any]:
    return {(role, channel) for role, channel in pairs if channel.kind == kind}


def names_of(pairs: set[Any]) -> list[str]:
    return sorted(f"{role}: {channel.name}" for role, channel in pairs)


OF_ZONE_SOURCES = {
    ("map-service", channel) for channel in (ch.ZONE_REQUEST, ch.ZONE_SET_SWITCH, ch.ZONE_SOURCE_PROBLEM)
}
"""Only for a site that has sources of zones: services/map-service/tests/test_zone_sources.py has one."""
OF_LIFTS = {("planner", ch.LIFT_STATE), ("planner", ch.LIFT_REQUEST)}
"""Only for a site that has lifts: services/tests/test_floors.py has two."""


def test_services_subscribe_to_exactly_the_channels_that_the_table_gives_them(live):
    _, services = live
    for kind in ("pub", "liveliness"):
        expected = table_pairs(services, kind, "subscribers") - OF_ZONE_SOURCES - OF_LIFTS
        assert names_of(of_kind(services.subscribed, kind)) == names_of(expected)


def test_services_publish_exactly_the_channels_that_the_table_gives_them(live):
    _, services = live
    expected = table_pairs(services, "pub", "publishers") - OF_ZONE_SOURCES - OF_LIFTS
    assert names_of(services.published) == names_of(expected)


def test_services_answer_exactly_the_queries_that_the_table_gives_them(live):
    _, services = live
    assert names_of(of_kind(services.served, "query")) == names_of(table_pairs(services, "query", "publishers"))
    # Only published channels with a latest message can be queried.
    assert all(c.durability == "latest" for _, c in services.served if c.kind == "pub")


def test_services_answer_every_query_of_their_cores(live):
    _, services = live
    cores_of = {
        "hazard-aggregator": services.aggregator.core,
        "map-service": services.map.core,
        "planner": services.planner_core,
        "robot-agent": services.agent_core,
    }
    assert all(isinstance(core, Core) for core in cores_of.values())
    expected = {(role, channel) for role, core in cores_of.items() for channel in core.query_handlers()}
    assert names_of(services.served) == names_of(expected)


def test_services_send_exactly_the_queries_that_the_table_gives_them(live):
    _, services = live
    by_request = {("map-service", ch.PLANNER_DRY_RUN)}  # only when somebody asks by REST, which does not run here
    expected = table_pairs(services, "query", "subscribers") - by_request
    assert names_of(services.queried) == names_of(expected)


def cores(loaded: Any, config: AgentConfig) -> dict[str, Any]:
    """Return everything with a table of handlers or query handlers, by name."""
    definitions, layers = loaded.site.definitions(), make_layers(loaded.map, loaded.site.layers)
    return {
        "aggregator": Aggregator(AreaFusion(definitions, loaded.site.nodes, 1, registry=find_rule)),
        "map": MapCore(loaded.site.id, loaded.map, 1, layers=layers, definitions=definitions),
        # The map combines its layers' handlers; their message types are those of the layers.
        **{f"map layer {type(layer).__name__}": layer for layer in layers},
        "planner": PlannerCore(1),
        "agent": AgentCore(config),
    }


def annotations(function: Any) -> list[str]:
    return [parameter.annotation for parameter in inspect.signature(function).parameters.values()]


def test_every_handler_takes_the_message_type_of_its_channel(lockstep):
    checked = 0
    for name, core in cores(site_with_two_areas(), lockstep.config).items():
        for channel, handler in core.handlers().items() if name != "map" else ():
            expected = "str" if channel.message is None else channel.message.__name__
            assert annotations(handler) == ["Ids", expected, "Moment"], f"{name}: {channel.name}"
            checked += 1
    assert checked > 20


def test_every_query_handler_takes_the_request_type_of_its_channel_and_gives_its_reply(lockstep):
    checked = 0
    for name, core in cores(site_with_two_areas(), lockstep.config).items():
        for channel, query_handler in core.query_handlers().items() if hasattr(core, "query_handlers") else ():
            request, reply = (channel.message, channel.reply) if channel.kind == "query" else (None, channel.message)
            expected = "None" if request is None else request.__name__
            assert annotations(query_handler) == ["Ids", expected, "Moment"], f"{name}: {channel.name}"
            assert reply is not None
            answered = inspect.signature(query_handler).return_annotation
            assert answered in {reply.__name__, f"Later[{reply.__name__}]"}, f"{name}: {channel.name}"
            checked += 1
    assert checked == 7
