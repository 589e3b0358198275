"""The oracle sees each rule broken, and nothing where all is well; a world's file is its drive."""

from __future__ import annotations

import itertools
import math
import time
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.costs import LETHAL
from fog_contracts.handlers import Publication
from fog_contracts.messages import (
    AreaHazard,
    HazardArea,
    MapHeartbeat,
    PolygonShape,
    RobotPath,
    RobotPose,
    RobotState,
    SimObstacle,
    SimTruth,
    Zone,
    ZoneSet,
)
from fognav.__main__ import app
from fognav_experiments.hunt import oracle, play, runner
from fognav_experiments.hunt.draw import draw_world
from fognav_experiments.hunt.oracle import Figures, Violation
from fognav_experiments.hunt.play import Hunted, hunt, read_world, write_world
from fognav_experiments.hunt.runner import Task, drive, shrink
from fognav_experiments.hunt.world import HuntWorld, Mounting, Patch, Sensors, Watched, build, displacement, to_map
from fognav_experiments.lockstep import LockstepDrive
from fognav_experiments.rigs import STAMP, moment
from fognav_experiments.scenarios.description import (
    BadLine,
    ClockChange,
    DeadAgent,
    DeceivedNode,
    FrozenLidar,
    Hole,
    HungAgent,
    NoGoZone,
    Obstacle,
    Person,
    Push,
)

FIXED = (6, 10, 12, 13, 14, 18, 24)
"""Numbers of the worlds that are always driven: all floors, bases and lidars, and most kinds of events."""
pytestmark = pytest.mark.timeout(600)
SQUARE = [(2.0, -1.0), (4.0, -1.0), (4.0, 1.0), (2.0, 1.0)]
R1 = {"robot": "r1"}


class Drive:
    """A robot that drives along the x axis from 0 at 0.2 m/s, as its messages and the truth tell it."""

    def __init__(self, wrong_s=0.0):
        self.bus = Bus("test")
        self.oracle = oracle.Oracle(oracle.World(radius=0.17, wrong_s=wrong_s), STAMP)
        self.bus.subscribe(self.oracle.handlers())
        self.now = self.x = 0.0
        self.mode, self.version = "NORMAL", (1, 1)
        self.claimed_m, self.wrong_m, self.contacts = 0.05, 0.0, 0
        self.obstacles, self.codes = [], []

    def publish(self, channel, message, **ids):
        self.bus.publish([Publication(channel, message, ids)])
        self.bus.deliver(moment(self.now))

    def drive(self, seconds, speed=0.2, turn=0.0):
        """Drive on; `turn`: by how much the right wheel is faster, and the left one slower."""
        for _ in range(round(seconds * 10)):
            self.now = round(self.now + 0.1, 3)
            self.x += 0.1 * speed
            stamp = STAMP + self.now
            self.publish(ch.SIM_TRUTH, SimTruth(
                robot="r1", x=self.x, y=0.0, theta=0.0, left=speed - turn, right=speed + turn, distance=abs(self.x),
                clearance=0.5, min_clearance=0.5, contacts=self.contacts, obstacles=self.obstacles, stamp=stamp,
            ), **R1)  # fmt: skip
            variance = self.claimed_m**2
            pose = RobotPose(
                x=self.x + self.wrong_m, y=0.0, theta=0.0, covariance=[variance, 0, 0, 0, variance, 0, 0, 0, 0.01],
                v=speed, w=0.0, radius=0.17, height=0.3, stamp=stamp)  # fmt: skip
            state = RobotState(
                mode=self.mode, reasons=[], codes=self.codes, enabled=True, battery=None, goal_id=None,
                map_epoch=self.version[0], map_seq=self.version[1], plan_id=None, stamp=stamp)  # fmt: skip
            self.oracle.on_robot(
                [Publication(ch.ROBOT_POSE, pose, R1), Publication(ch.ROBOT_STATE, state, R1)], self.now
            )

    def hazard(self, state, seq=1, penalty=None):
        cost = penalty or (LETHAL if state == "blocked" else 0)
        hazard = AreaHazard(
            area="a", state=state, severity=0, penalty=cost, since=STAMP, seq=seq, epoch=1, cause="test")  # fmt: skip
        self.publish(ch.HAZARD, HazardArea(hazard=hazard, polygon=SQUARE), area="a")

    def zone(self, **effect):
        zone = Zone(id="z", shape=PolygonShape(points=SQUARE), **effect)
        self.oracle.on_acknowledged(zone, self.now)
        self.publish(ch.ZONES, ZoneSet(epoch=1, seq=2, zones=[zone], active=["z"]))

    def beat(self, epoch, seq):
        self.publish(ch.MAP_HEARTBEAT, MapHeartbeat(epoch=epoch, seq=seq, hash=1, sent=(1, 1.0)))


def blocked_zone(d):
    d.zone(kind="BLOCKED")
    d.version = (1, 2)
    d.drive(11)


def stopped_before_the_zone(d):
    d.zone(kind="BLOCKED")
    d.version = (1, 2)
    d.drive(8.5)
    d.drive(5, speed=0.0)


def blocked_area(d):
    d.hazard("blocked")
    d.drive(11)


def area_that_was_blocked_and_is_unknown(d):
    d.hazard("blocked")
    d.hazard("unknown", 2, penalty=LETHAL)
    d.drive(17, speed=0.14)


def limited(d):
    d.zone(kind="SPEED_LIMIT", speed=0.1)
    d.version = (1, 2)
    d.drive(17)


def unknown_area(d):
    d.hazard("unknown")
    d.drive(17)


def zone_just_drawn(d):
    d.drive(12)
    d.zone(kind="BLOCKED")
    d.version = (1, 2)
    d.drive(1)


def degraded(d):
    d.drive(2)
    d.mode = "DEGRADED"
    d.drive(2)


def slowed_down(d):
    d.drive(2)
    d.mode = "DEGRADED"
    d.drive(0.5)
    d.drive(3, speed=0.15)


def lost_fog(d):
    d.oracle.on_lost("fog", d.now)
    d.drive(5)


def short_gap(d):
    d.oracle.on_lost("fog", d.now)
    d.drive(3)
    d.oracle.on_restored("fog", d.now)
    d.drive(5)


def hung_agent(d):
    d.oracle.on_lost("agent", d.now)
    d.drive(1)


def wrong_pose(d):
    d.wrong_m = 0.8
    d.drive(4)


def honest_pose(d):
    d.wrong_m, d.claimed_m = 0.8, 0.5
    d.drive(4)


def lost_robot(d):
    d.wrong_m, d.claimed_m = 3.0, 5.0
    d.drive(4)


def older_map(d):
    d.beat(1, 7)
    d.beat(1, 6)


def newer_epoch(d):
    d.beat(1, 7)
    d.beat(2, 1)


def contact(d):
    d.drive(1)
    d.contacts = 1
    d.drive(1)


def driven_on_after_a_low_step(d):
    d.drive(1)
    d.obstacles = [SimObstacle(id="step", polygon=[(0.3, -1.0), (0.5, -1.0), (0.5, 1.0), (0.3, 1.0)], height=0.1)]
    contact(d)


def stopped_at_a_low_step(d):
    d.drive(1)
    d.obstacles = [SimObstacle(id="step", polygon=[(0.3, -1.0), (0.5, -1.0), (0.5, 1.0), (0.3, 1.0)], height=0.1)]
    d.contacts = 1
    d.drive(0.3)
    d.drive(2, speed=0.0)


def over_the_stairs(d):
    d.oracle.on_lost("floor", d.now)
    d.drive(1)


def fallen(d):
    d.drive(1)
    d.oracle.on_fallen(d.now)


def backing_off_from_the_stairs(d):
    d.mode = "FAULT"
    d.drive(1, speed=0.0)
    d.oracle.on_lost("floor", d.now)
    d.mode = "EGRESS"
    d.drive(1, speed=-0.1)
    d.mode = "FAULT"
    d.drive(2, speed=0.0)


def creeping_at_the_stairs(d):
    d.mode = "FAULT"
    d.drive(2, speed=0.0)
    d.oracle.on_lost("floor", d.now)
    d.drive(1, speed=0.1)


def creeping_though_nobody_enabled_it(d):
    d.mode = "INIT"
    d.drive(3, speed=0.1)


def fallen_in_a_fault(d):
    d.mode = "FAULT"
    d.drive(2, speed=0.0)
    d.oracle.on_fallen(d.now)


def turning_while_it_must_stand(d):
    d.mode = "HOLD"
    d.drive(2, speed=0.0)
    d.drive(1, speed=0.0, turn=0.1)


def turning_on_a_command(d):
    d.mode = "EGRESS"
    d.drive(2, speed=0.0, turn=0.1)
    d.mode = "INIT"
    d.drive(0.5, speed=0.0, turn=0.1)
    d.drive(2, speed=0.0)


def contact_beside_a_low_step(d):
    d.obstacles = [SimObstacle(id="step", polygon=[(0.0, 0.3), (0.6, 0.3), (0.6, 0.5), (0.0, 0.5)], height=0.1)]
    contact(d)


def repeated_turns(d):
    d.oracle.on_lost("new turns", d.now)
    d.drive(2)


def silent_base(d):
    d.oracle.on_lost("base", d.now)
    d.drive(1)


def map_called_old(d):
    d.mode, d.codes = "HOLD", ["map_old"]
    d.drive(32, speed=0.0)


def map_called_old_in_a_gap(d):
    d.oracle.on_lost("fog", d.now)
    map_called_old(d)


def unwritten(d):
    d.zone(kind="PENALTY", factor=2.0)
    d.drive(7)


def unwritten_but_slow(d):
    d.zone(kind="PENALTY", factor=2.0)
    d.drive(7, speed=0.1)


def unconfirmed(d):
    d.oracle.on_obstacle("a", d.now)
    d.drive(4, speed=0.0)


def cleared(d):
    d.oracle.on_obstacle("a", d.now)
    d.hazard("blocked")
    d.drive(4, speed=0.0)
    d.hazard("clear", 2)


def cleared_after_it_is_gone(d):
    d.oracle.on_obstacle("a", d.now)
    d.hazard("blocked")
    d.drive(4, speed=0.0)
    d.oracle.on_obstacle_gone("a")
    d.hazard("clear", 2)


def path(d, *points):
    d.publish(ch.ROBOT_PATH, RobotPath(
        plan_id=1, planner_epoch=1, goal_id="g", points=list(points), map_epoch=1, map_seq=1, released_length=5.0),
        **R1)  # fmt: skip


def barrier_ahead(d):
    path(d, (0.0, 0.0), (6.0, 0.0))
    d.drive(1)
    d.oracle.on_barrier(SQUARE, d.now)


def barrier_behind(d):
    path(d, (0.0, 0.0), (8.0, 0.0))
    d.drive(25)
    d.oracle.on_barrier(SQUARE, d.now)


def map_service_dies(d):
    d.oracle.on_lost("map-service", d.now)
    d.drive(5)


def obstacle_while_the_aggregator_is_away(d):
    d.oracle.on_lost("aggregator", d.now)
    d.oracle.on_obstacle("a", d.now)
    d.drive(4, speed=0.0)
    d.oracle.on_restored("aggregator", d.now)
    d.drive(1, speed=0.0)
    d.hazard("blocked")


@pytest.mark.parametrize(
    ("happens", "rules"),
    [
        (blocked_zone, ["blocked"]), (blocked_area, ["blocked"]),
        (area_that_was_blocked_and_is_unknown, ["blocked"]), (zone_just_drawn, []), (stopped_before_the_zone, []),
        (limited, ["speed"]), (unknown_area, ["speed"]), (degraded, ["speed"]), (slowed_down, []),
        (lost_fog, ["stop"]), (short_gap, []), (hung_agent, ["stop"]),
        (wrong_pose, ["pose"]), (honest_pose, []), (lost_robot, ["pose"]),
        (older_map, ["version"]), (newer_epoch, []), (contact, ["contact", "stop"]),
        (driven_on_after_a_low_step, ["stop"]), (stopped_at_a_low_step, []), (over_the_stairs, ["stop"]),
        (fallen, ["contact"]), (backing_off_from_the_stairs, []),
        (creeping_at_the_stairs, ["speed", "stop"]), (creeping_though_nobody_enabled_it, ["speed"]),
        (fallen_in_a_fault, ["contact"]), (turning_while_it_must_stand, ["speed"]), (turning_on_a_command, []),
        (contact_beside_a_low_step, ["contact", "stop"]), (repeated_turns, ["stop"]), (silent_base, ["stop"]),
        (map_called_old, ["late"]), (map_called_old_in_a_gap, []),
        (unwritten, ["write"]), (unwritten_but_slow, []),
        (unconfirmed, ["hazard"]), (cleared, ["cleared"]), (cleared_after_it_is_gone, []),
        (barrier_ahead, []), (barrier_behind, ["barrier"]), (map_service_dies, ["stop"]),
        (obstacle_while_the_aggregator_is_away, []),
    ],
)  # fmt: skip
def test_oracle_sees_a_rule_broken_once_and_nothing_where_all_is_well(happens, rules):
    drive = Drive()
    happens(drive)
    assert [violation.rule for violation in drive.oracle.violations] == rules, drive.oracle.violations


@pytest.mark.parametrize(("seconds", "rules"), [(0.2, []), (0.4, ["stop"])])
def test_oracle_lets_wheels_follow_a_command_with_a_wrong_bit_until_the_next_one(seconds, rules):
    drive = Drive(wrong_s=0.2)
    drive.oracle.on_lost("agent", drive.now)
    drive.drive(1, speed=0.0)
    drive.drive(seconds)
    drive.drive(1, speed=0.0)
    assert [violation.rule for violation in drive.oracle.violations] == rules


WORLD = HuntWorld(
    title="a short corridor with everything",
    size=(9.0, 3.0),
    free=[(0.5, 0.5, 8.5, 2.5), (4.0, 2.5, 5.0, 2.9)],
    start=(1.5, 1.5, 0.0),
    goal=(7.0, 1.5),
    warp_m=0.05,
    placed=[(0.5, 2.3, 1.0, 2.5)],
    watched=[Watched(id="a1", box=(3.0, 0.5, 5.0, 2.5), node=(4.0, 0.6, math.pi / 2), limit=1.6)],
    sensors=Sensors(
        recorded=True, patches=[Patch(x=8.5, y=1.0, radius=0.5, returned=0.2)], dead=[(2.0, 2.5)], scale=(1.02, 1.0),
        gain=(1.05, 1.0), wander=0.03, sonar_miss=0.1,
    ),
    events=[HungAgent(at_s=2.0, seconds=1.0), Person(at_s=4.0, line=[(6.0, 0.8), (6.0, 2.2)])],
    seconds=60.0,
)  # fmt: skip


def test_world_of_a_file_is_driven_again_to_the_bit(tmp_path):
    file = tmp_path / "world.json"
    file.write_bytes(write_world(WORLD))
    first = hunt(WORLD)
    assert read_world(file) == WORLD
    assert first.violations == []
    assert first.outcome == "reached", first.reason
    assert hunt(read_world(file)) == first


BOX = [(3.6, 0.6), (3.9, 0.6), (3.9, 2.4), (3.6, 2.4)]
PLAIN = msgspec.structs.replace(WORLD, warp_m=0.0, placed=[], sensors=Sensors(), events=[])


@pytest.mark.parametrize(
    ("event", "outcome", "mode"),
    [
        (Hole(at_s=1.0, polygon=BOX), "stopped", "FAULT (base: a cliff sensor sees no floor"),
        (Obstacle(at_s=1.0, polygon=BOX, height=0.1), "contact", ""),
        (Obstacle(at_s=1.0, polygon=BOX, height=0.1, soft=True), "contact", ""),
        (DeadAgent(at_s=5.0, seconds=3.0), "reached", "INIT"),
        (FrozenLidar(at_s=5.0, seconds=6.0), "reached", "PROTECTIVE_STOP (the lidar repeats itself"),
        (BadLine(at_s=5.0, device="base", seconds=2.0, stalled=True), "reached", "FAULT (base: the base has sent no"),
        (
            BadLine(at_s=5.0, device="lidar", seconds=1.0, lost=1.0),
            "reached",
            "PROTECTIVE_STOP (the lidar has been silent",
        ),
        (BadLine(at_s=2.0, device="base", seconds=40.0, lost=0.1), "stopped", "FAULT (base: the base has sent no"),
        (DeceivedNode(at_s=1.0, node="n-a1", lost=1.0), "reached", "DEGRADED (the state of the area a1 is unknown"),
        (DeceivedNode(at_s=1.0, node="n-a1", scale=0.0, offset=0.3), "refused", "HOLD (the planner finds no path"),
        (ClockChange(at_s=1.0, computer="robot", jump_s=-3600.0, rate=0.083, crystal=1e-4), "reached", ""),
        (ClockChange(at_s=1.0, computer="fog", jump_s=3600.0, rate=-0.083, crystal=1e-4), "reached", ""),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, msgspec.Struct) else "",
)
@pytest.mark.drive
def test_robot_meets_what_is_drawn_and_no_rule_is_broken(monkeypatch, event, outcome, mode):
    runs = []
    monkeypatch.setattr(
        play, "LockstepDrive", lambda *given, **more: runs.append(LockstepDrive(*given, **more)) or runs[0]
    )
    found = hunt(msgspec.structs.replace(PLAIN, events=[event]))
    assert (found.outcome, found.violations) == (outcome, [])
    told = [entry.description for entry in runs[0].events]
    assert (
        any(entry.startswith(f"robot: {mode}") for entry in told[told.index(f"event 0: {type(event).__name__}") :])
        or not mode
    )


def test_lidar_that_is_mounted_otherwise_and_a_roomba_with_quirks_lead_to_the_goal():
    mounting = Mounting(x=0.1, y=-0.05, yaw=2.0, mirrored=True, masks=[(2.0, 2.5), (-2.0, -1.8)])
    found = hunt(msgspec.structs.replace(PLAIN, mounting=mounting, quirks={"mode_offset": 1, "damaged": 9}))
    assert (found.outcome, found.violations) == ("reached", [])


def test_file_that_is_no_world_is_named(tmp_path):
    file = tmp_path / "world.json"
    file.write_text('{"title": "flood"}')
    with pytest.raises(ValueError, match=r"world\.json.*missing required field"):
        read_world(file)


def test_map_is_warped_as_the_oracle_takes_it_back():
    straight = msgspec.structs.replace(WORLD, warp_m=0.0)
    warped = msgspec.structs.replace(WORLD, warp_m=0.2)
    assert not (build(warped).map.cells == build(straight).map.cells).all()
    x, y = to_map(warped, 4.0, 1.5)
    dx, dy = displacement(warped, x, y)
    assert (x + dx, y + dy) == pytest.approx((4.0, 1.5), abs=1e-3)


def test_goal_inside_a_wall_is_refused():
    with pytest.raises(ValueError, match=r"its goal .* is not free"):
        build(msgspec.structs.replace(WORLD, goal=(0.2, 0.2)))


def test_obstacle_in_an_area_that_nothing_watches_is_refused():
    events = [Obstacle(polygon=SQUARE, area="a1")]
    build(msgspec.structs.replace(WORLD, events=events))
    with pytest.raises(ValueError, match="area a1, which is not watched"):
        build(msgspec.structs.replace(WORLD, events=events, watched=[]))


def test_no_go_zone_that_an_operator_draws_is_kept():
    corner = [(5.5, 0.5), (6.0, 0.5), (6.0, 1.2), (5.5, 1.2)]
    world = msgspec.structs.replace(WORLD, events=[NoGoZone(polygon=corner)], sensors=Sensors(), warp_m=0.0)
    found = hunt(world)
    assert (found.outcome, found.violations) == ("reached", [])


HUNT = Path(__file__).parents[1] / "hunt"
SITES = Path(__file__).parents[2] / "sites"


MINUTES = {
    "pose-corridor-on-a-map-4-cm-off",
    "pose-corridor-on-a-map-7-cm-off",
    "pose-corridor-with-wheels-10-percent-short",
}
"""Mended worlds that take a minute and more each."""


@pytest.mark.parametrize(
    "file",
    [
        pytest.param(file, marks=pytest.mark.long if file.stem in MINUTES else (), id=file.stem)
        for file in sorted((HUNT / "mended").glob("*.json"))
    ],
)
@pytest.mark.drive
def test_world_that_broke_a_rule_breaks_it_no_more(file):
    assert hunt(read_world(file), [SITES]).violations == []


@pytest.mark.xfail(reason="not mended yet: move its file to `mended` when it is", strict=True)
@pytest.mark.parametrize("file", sorted((HUNT / "found").glob("*.json")), ids=lambda file: file.stem)
@pytest.mark.long
def test_world_that_breaks_a_rule(file):
    assert hunt(read_world(file), [SITES]).violations == []


@pytest.mark.parametrize("number", FIXED)
@pytest.mark.drive
def test_worlds_of_a_fixed_seed_break_no_rule(number):
    found = drive(Task(seed=7, number=number, commit="", maps=[], folders=[], tries=0))
    assert not found.world, found.record.values


@pytest.mark.long
@pytest.mark.timeout(0)
def test_new_worlds_break_no_rule(tmp_path):
    records = list(runner.run(tmp_path, int(time.time()), 10.0, 1, "", [SITES], 20))
    assert [(record.seed, record.number, record.values) for record in records if record.rules] == []


def test_drawn_world_is_the_same_for_its_numbers_and_another_one_for_others():
    assert draw_world(3, 8) == draw_world(3, 8)
    assert draw_world(3, 8) != draw_world(3, 9)
    assert msgspec.json.decode(write_world(draw_world(3, 8)), type=HuntWorld) == draw_world(3, 8)


def test_shrunk_world_keeps_only_what_breaks_the_rule():
    kidnapped = Push(at_s=2.0, turn=0.3)
    world = msgspec.structs.replace(WORLD, events=[*WORLD.events, kidnapped], pillars=[(6.0, 1.0, 6.2, 1.2)])
    shrunk = shrink(world, lambda smaller: 2.0 if kidnapped in smaller.events and smaller.warp_m else None, 100)
    assert (shrunk.events, shrunk.warp_m) == ([kidnapped], WORLD.warp_m)
    assert (shrunk.sensors, shrunk.pillars, shrunk.placed, shrunk.watched) == (Sensors(), [], [], [])
    assert shrunk.free == WORLD.free[:1]


def test_hunt_goes_on_where_it_was_and_keeps_what_it_found(tmp_path, monkeypatch):
    blind = msgspec.structs.replace(WORLD, placed=[], sensors=Sensors(dead=[(-3.1, 3.1)]), seconds=5.0)
    monkeypatch.setattr(runner, "draw_world", lambda _seed, _number, _attempt: blind)
    monkeypatch.setattr(runner, "hunt", lambda world, _folders: broken(world))

    def broken(world):
        wall = Violation(rule="contact", at_s=1.0, x=2.0, y=1.5, values="drove into a wall")
        rules = [wall] if world.events else []
        return Hunted(
            title="t", outcome="contact", reason="", simulated_s=5.0, violations=rules, figures=Figures(poses=1)
        )

    first = list(itertools.islice(runner.run(tmp_path, 1, 60.0, 1, "abc", [], 30), 2))
    after = next(runner.run(tmp_path, 1, 60.0, 1, "abc", [], 30))
    assert [record.number for record in (*first, after)] == [1, 2, 3]
    assert [record.rules for record in runner.read_records(tmp_path)] == [["contact"]] * 3
    assert len(read_world(tmp_path / "found" / "contact-1-2.json").events) == 1
    assert "3 drives, 0.00 simulated hours" in runner.summary(runner.read_records(tmp_path))
    assert "broke a rule: contact 3" in runner.summary(runner.read_records(tmp_path))


# --- the command ---


CORRIDOR = HuntWorld(
    title="a short corridor", start=(1.5, 1.5, 0.0), goal=(5.0, 1.5), size=(7.0, 3.0), free=[(0.5, 0.5, 6.5, 2.5)],
    seconds=20.0,
)  # fmt: skip


def run(*arguments: object):
    return CliRunner().invoke(app, ["hunt", *map(str, arguments)])


def test_replay_tells_which_rule_was_broken_and_where(tmp_path):
    kind, unfair = tmp_path / "kind.json", tmp_path / "unfair.json"
    kind.write_bytes(write_world(CORRIDOR))
    wall = Obstacle(at_m=1.5, polygon=[(3.19, 0.5), (3.6, 0.5), (3.6, 2.5), (3.19, 2.5)])  # 2 cm before the robot
    unfair.write_bytes(write_world(msgspec.structs.replace(CORRIDOR, events=[wall])))
    assert run("--replay", kind).exit_code == 0
    told = run("--replay", kind, "--replay", unfair)
    assert told.exit_code == 1
    assert "kind.json: reached" in told.output
    assert "contact at" in told.output


def test_records_are_summed_up_without_a_drive(tmp_path):
    told = run("--minutes", 0, "--out", tmp_path)
    assert told.exit_code == 0
    assert "0 drives, 0.00 simulated hours" in told.output


def test_damaged_file_is_named(tmp_path):
    file = tmp_path / "world.json"
    file.write_text("{}")
    told = run("--replay", file)
    assert told.exit_code == 2
    assert "world.json" in told.output
