"""Wait or go round: what a robot does before a block, what that costs, and what is known of blocks after restarts."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from msgspec import json, structs
from ring_map import RIGHT, UPPER, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    AreaHazard,
    AreaState,
    CircleShape,
    CorridorShape,
    HazardArea,
    HazardOverride,
    MapDelta,
    PolygonShape,
    RectangleShape,
    RobotPath,
    Shape,
    Zone,
    ZoneSet,
)
from planner.config import PlannerConfig, WaitMode
from planner.core import PlannerCore
from planner.path_search import Route
from planner.waits.blocks import PRIOR, PRIOR_BLOCKS, BlockRecord, Blocks
from planner.waits.durations import AGES, Durations, Survival, all_of, best_policy, survival, until


def via(path: RobotPath) -> str:
    return "lower" if min(y for _, y in path.points) < 2.0 else "upper"


STEM = ((8.0, 2.0, 18.0, 10.0), (0.0, 7.0, 6.0, 12.0), (0.0, 0.0, 6.0, 5.0))
"""Walls: a corridor that leads from the left into the ring."""


class Drive:
    """A core with one robot, whose area `a` is in the upper corridor."""

    def __init__(self, wait: WaitMode = "always", at: tuple[float, float] = (5.0, 11.0), walls=None, to=RIGHT) -> None:
        self.map = RingMap() if walls is None else RingMap(walls=walls)
        self.core = PlannerCore(epoch=7, config=PlannerConfig(wait=wait))
        self.now, self.at, self.seq = 100.0, at, 1
        self.core.load(self.map.master.snapshot(), self.now)
        self.path: RobotPath | None = None
        self.published = 0
        self.speed = 0.0
        """How fast (m/s) the robot drives what is released."""
        self.core.set_goal("r1", goal(*to))
        self.step(0.2)

    @property
    def moment(self) -> Moment:
        return Moment(self.now, self.now + 1e9)

    def step(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            self.deliver(ch.MAP_HEARTBEAT, self.map.master.heartbeat(self.now))
            self.deliver(ch.ROBOT_POSE, pose(*self.at), robot="r1")
            for publication in self.core.tick(self.moment):
                if isinstance(publication.message, RobotPath):
                    self.path, self.published = publication.message, self.published + 1
            if self.speed and self.path is not None:
                route = Route(np.array(self.path.points), 0.05)
                along = min(route.nearest(*self.at)[0] + 0.1 * self.speed, self.path.released_length)
                x, y = route.remaining(along)[0]
                self.at = float(x), float(y)

    def deliver(self, channel, message, **ids) -> None:
        self.core.handlers()[channel](ids, message, self.moment)

    def hazard(self, state: AreaState, deltas: list[MapDelta], box=UPPER) -> None:
        self.seq += 1
        self.map.areas.setdefault("a", box)
        area = self.map.hazard_area("a", state)
        hazard = structs.replace(area.hazard, seq=self.seq, since=self.moment.stamp)
        if state == "clear":
            del self.map.areas["a"]
        for delta in deltas:
            self.deliver(ch.MAP_DELTA, delta)
        self.deliver(ch.HAZARD, structs.replace(area, hazard=hazard), area="a")

    def block(self, box=UPPER) -> None:
        self.hazard("blocked", self.map.put("a", box), box)
        self.step(0.1)

    def zone(self, shape: Shape, rest: float | None) -> None:
        """Put a no-go zone in force that ends in `rest` s."""
        deltas = self.map.put("z", UPPER)
        zone = Zone(id="z", kind="BLOCKED", shape=shape, expires_at=None if rest is None else self.moment.stamp + rest)
        self.deliver(ch.ZONES, ZoneSet(epoch=1, seq=1, zones=[zone], active=["z"]))
        for delta in deltas:
            self.deliver(ch.MAP_DELTA, delta)
        self.step(0.1)

    def clear(self) -> None:
        box = self.map.areas["a"]
        deltas = self.map.clear("a")
        self.hazard("clear", deltas, box)
        self.step(0.1)

    @property
    def way(self):
        assert self.path is not None
        return self.path.blocked_way


def test_robot_waits_before_what_has_just_come_goes_round_when_it_stays_and_says_why():
    drive = Drive()
    drive.block()
    assert drive.way.choice == "wait"
    assert drive.way.expected_s < drive.way.detour_s
    assert "in the way for 0 s: hazard a, blocked; waits" in drive.way.reason
    assert max(x for x, _ in drive.path.points) < UPPER[0], "the path ends before the block"
    assert drive.path.released_length < sum(map(math.dist, drive.path.points, drive.path.points[1:])) - 0.1
    waited = 0.0
    while drive.way.choice == "wait":
        drive.step(0.5)
        waited += 0.5
        assert waited < 60.0
    assert waited > 5.0
    assert via(drive.path) == "lower"
    assert drive.way.limit_s is None
    assert drive.path.released_length == pytest.approx(drive.core.config.release_length), "it may drive on"
    assert "goes round" in drive.way.reason


def test_robot_that_waits_goes_on_with_the_first_tick_after_the_block_has_ended():
    drive = Drive()
    drive.block()
    drive.step(4.0)
    assert drive.way.choice == "wait"
    drive.clear()
    assert drive.path.blocked_way is None
    assert via(drive.path) == "upper"
    assert drive.path.points[-1] == pytest.approx(RIGHT)


def test_robot_drives_to_where_the_way_round_branches_off_and_no_further():
    drive = Drive(at=(1.0, 6.0), walls=STEM, to=(16.0, 11.0))
    assert via(drive.path) == "upper"
    drive.block((12.0, 10.0, 13.0, 12.0))
    assert drive.way.choice == "wait"
    released = np.interp(drive.path.released_length, *_along(drive.path))
    assert 4.0 < released < 7.0, "where the corridor opens, not in the upper one"


def _along(path: RobotPath):
    points = np.array(path.points)
    return np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))), points[:, 0]


@pytest.mark.parametrize("wait", ["off", "learned"])
def test_robot_goes_round_at_once_where_nothing_was_learned_or_waiting_is_off(wait):
    drive = Drive(wait)
    drive.block()
    assert via(drive.path) == "lower"
    assert drive.path.blocked_way is None


def test_robot_waits_where_short_blocks_were_learned_and_goes_round_where_all_were_long():
    for seconds, choice in ((4.0, "wait"), (900.0, "detour")):
        drive = Drive("learned")
        for _ in range(30):
            drive.hazard("blocked", [])
            drive.now += seconds
            drive.hazard("clear", [])
        drive.block()
        assert drive.way.choice == choice


def test_nobody_waits_where_no_block_has_ever_ended_by_itself():
    drive = Drive()
    drive.hazard("blocked", [])
    drive.now += 400.0
    drive.hazard("unknown", [])
    drive.map.areas.clear()
    drive.block()
    assert drive.path.blocked_way is None
    assert via(drive.path) == "lower"


def test_robot_that_waits_stays_and_may_drive_less_when_the_block_grows_towards_it():
    drive = Drive(at=(8.1, 11.0))
    drive.block()
    assert drive.way.choice == "wait"
    plan_id, released = drive.path.plan_id, drive.path.released_length
    drive.block((UPPER[0] - 0.4, *UPPER[1:]))
    assert drive.way is not None
    assert drive.way.choice == "wait"
    assert drive.path.plan_id == plan_id
    assert drive.path.released_length < released


def test_zone_is_waited_for_when_its_end_is_known_and_near():
    left, bottom, right, top = UPPER
    ring = [(left, bottom), (right, bottom), (right, top), (left, top)]
    shapes = [
        RectangleShape(corner=(left, bottom), opposite=(right, top)),
        PolygonShape(points=ring),
        CircleShape(centre=(10.0, 11.0), radius=1.0),
        CorridorShape(line=[(10.0, bottom), (10.0, top)], width=2.0),
    ]
    for shape, (rest, choice) in itertools.product(shapes, ((8.0, "wait"), (None, None), (500.0, "detour"))):
        drive = Drive("learned")
        drive.zone(shape, rest)
        assert (None if drive.way is None else drive.way.choice) == choice


@pytest.mark.parametrize("rest", [6.0, 25.0])
def test_robot_waits_until_a_zone_is_gone_that_ends_on_its_way_there_or_while_it_stands(rest):
    drive = Drive("learned", at=(1.0, 6.0), walls=STEM, to=(16.0, 11.0))
    drive.speed = drive.core.config.cruise_speed
    drive.zone(RectangleShape(corner=UPPER[:2], opposite=UPPER[2:]), rest)
    end = drive.now - 0.1 + rest
    while drive.now < end + 2.0:
        assert drive.way.choice == "wait", f"{end - drive.now:.1f} s before the end"
        drive.step(0.1)
    drive.deliver(ch.ZONES, ZoneSet(epoch=1, seq=2, zones=[], active=[]))
    for delta in drive.map.clear("z"):
        drive.deliver(ch.MAP_DELTA, delta)
    drive.step(0.1)
    assert drive.path.blocked_way is None
    assert via(drive.path) == "upper"


def test_zone_that_stays_in_force_beyond_its_end_is_not_waited_for_any_more():
    drive = Drive("learned")
    drive.zone(RectangleShape(corner=UPPER[:2], opposite=UPPER[2:]), 4.0)
    assert drive.way.choice == "wait"
    drive.step(12.0)
    assert via(drive.path) == "lower"


@pytest.mark.parametrize("area", [True, False])
def test_outlines_of_zones_are_not_looked_at_that_lie_elsewhere_or_where_nothing_may_end(monkeypatch, area):
    looked_at = []
    monkeypatch.setattr("planner.waits.choice.shape_contains", lambda *asked: looked_at.append(asked))
    drive = Drive()
    x = 30.0 if area else UPPER[0]  # of a ring around the block that does not reach it
    ring = [(x, 9.0), (x + 5.0, 9.0), (x + 5.0, 13.0), (x + 4.9, 9.1)]
    zones = [Zone(id=f"z{k}", kind="BLOCKED", shape=PolygonShape(points=ring), expires_at=None) for k in range(300)]
    drive.deliver(ch.ZONES, ZoneSet(epoch=1, seq=1, zones=zones, active=[zone.id for zone in zones]))
    if area:
        drive.block()
    else:
        for delta in drive.map.put("obstacle", UPPER):
            drive.deliver(ch.MAP_DELTA, delta)
        drive.step(0.1)
    assert not looked_at
    assert (drive.way is not None and drive.way.choice == "wait") == area


def test_what_a_lidar_sees_outside_of_every_area_is_not_waited_for():
    drive = Drive()
    for delta in drive.map.put("obstacle", UPPER):
        drive.deliver(ch.MAP_DELTA, delta)
    drive.step(0.1)
    assert drive.path.blocked_way is None
    assert via(drive.path) == "lower"


# --- what waiting costs ---

EVENTS = 1000


def lognormal(*parts: tuple[float, float, float]):
    """Durations of blocks: shares, medians (s) and widths of lognormal distributions."""

    def draw(rng: np.random.Generator) -> float:
        _share, median, width = parts[rng.choice(len(parts), p=[part[0] for part in parts])]
        return float(median * math.exp(width * rng.normal()))

    logs = np.linspace(-8.0, 14.0, 4000)
    beyond = np.array(
        [sum(s * 0.5 * math.erfc((log - math.log(m)) / w / math.sqrt(2.0)) for s, m, w in parts) for log in logs]
    )

    def stands(ages):
        return np.interp(np.log(np.maximum(ages, 1e-3)), logs, beyond)

    return draw, stands


PERSON, BOX = (8.0, 0.6), (900.0, 1.0)
KINDS = {
    "short (a person, 8 s)": lognormal((1.0, *PERSON)),
    "long (a box, 15 min)": lognormal((1.0, *BOX)),
    "half of each": lognormal((0.5, *PERSON), (0.5, *BOX)),
    "mostly people": lognormal((0.8, *PERSON), (0.2, *BOX)),
    "people, doors, boxes": lognormal((0.4, 5.0, 0.4), (0.4, 40.0, 0.5), (0.2, *BOX)),
}
THRESHOLDS = np.concatenate(([0.0], np.geomspace(1.0, 600.0, 40), [3600.0]))
"""Always going round, going round after a fixed time, and (as good as) always waiting."""
GRID = np.concatenate((np.arange(0.0, 120.0, 0.25), np.geomspace(120.0, 3600.0, 200)))


def simulate(kind: str, log: Durations, seed: int) -> tuple[float, float, np.ndarray]:
    """Return the expected delays (s) of the policy that learns, of the one that knows, and of fixed thresholds.

    Each of `EVENTS` blocks is met at another age, with another way round (8 to 90 s). All block durations are learned.
    """
    draw, stands = KINDS[kind]
    rng = np.random.default_rng(seed)
    ours, best, fixed = 0.0, 0.0, np.zeros(len(THRESHOLDS))
    for _ in range(EVENTS):
        duration, detour = draw(rng), float(rng.uniform(8.0, 90.0))
        age = min(float(rng.exponential(4.0)), 0.95 * duration)
        at_age = float(stands(np.array([age]))[0])
        left = stands(age + GRID) / at_age
        waited = np.append(0.0, np.cumsum(0.5 * (left[1:] + left[:-1]) * np.diff(GRID)))
        expected = waited + left * detour  # of waiting for so long
        policy = best_policy(survival(log.informed(PRIOR, PRIOR_BLOCKS), age), detour)
        ours += np.interp(policy.limit if policy.waits else 0.0, GRID, expected)
        best += expected.min()
        fixed += np.interp(THRESHOLDS, GRID, expected)
        log.add(0.0, duration, ended=True)
    return ours / EVENTS, best / EVENTS, fixed / EVENTS


@pytest.mark.parametrize("kind", KINDS)
def test_delay_is_as_good_as_the_best_fixed_policy_and_within_5_percent_of_the_one_that_knows(kind):
    """The table of docs/benchmarks.md: run with -s to print it."""
    log = Durations()
    cold, known_cold, _ = simulate(kind, log, 1)
    ours, known, fixed = simulate(kind, log, 2)
    print(f"\n| {kind} | {fixed[-1]:.1f} | {fixed[0]:.1f} | {fixed.min():.1f} | {known:.1f} | {ours:.1f} "  # noqa: T201  # because the table is made of it
          f"({100 * (ours / known - 1):.1f} %) | {100 * (cold / known_cold - 1):.1f} % |")  # fmt: skip
    assert cold <= 1.05 * known_cold, "while it learns from nothing"
    assert ours <= 1.05 * known
    assert ours <= 1.01 * fixed.min()


def test_best_policy_is_never_beaten_by_another_threshold():
    rng = np.random.default_rng(3)
    for _ in range(50):
        log = Durations()
        for duration in rng.lognormal(rng.uniform(0.5, 5.0), 1.0, 10):
            log.add(0.0, float(duration), ended=True)
        block = survival(log.informed(PRIOR, PRIOR_BLOCKS), float(rng.uniform(0.0, 60.0)))
        detour = float(rng.uniform(5.0, 120.0))
        policy = best_policy(block, detour)
        grid = np.arange(0.0, 3000.0, 0.05)
        left = block.stands(grid)
        costs = np.append(0.0, np.cumsum(0.025 * (left[1:] + left[:-1]))) + left * detour
        assert min(policy.waiting, policy.detour) == pytest.approx(costs.min(), rel=0.01, abs=0.2)


def test_several_blocks_stand_until_the_last_has_ended_and_known_ends_are_exact():
    both = all_of([until(5.0), until(9.0)])
    assert both.stands(np.array([4.9, 5.1, 8.9, 9.1])).tolist() == [1.0, 1.0, 1.0, 0.0]
    assert best_policy(until(9.0), 20.0).waiting == pytest.approx(9.0, abs=0.01)
    assert best_policy(until(9.0), 20.0, arrival=6.0).waiting == pytest.approx(3.0, abs=0.01)
    halves = Survival(lambda after: np.full(np.shape(after), 0.5), np.zeros(0))
    assert all_of([halves, halves]).stands(np.array([1.0])) == pytest.approx(0.75)


def test_part_of_a_block_that_nobody_saw_begin_or_end_counts_for_what_was_seen():
    log = Durations()
    log.add(3.0, 20.0, ended=False)
    assert (log.ended.sum(), log.spent.sum()) == (0.0, pytest.approx(17.0))
    assert log.spent[AGES < 2.0].sum() == 0.0
    log.add(0.0, 5.0, ended=True)
    assert log.ended[np.searchsorted(AGES, 5.0) - 1] == 1.0


# --- restarts ---


def test_block_that_a_standby_followed_keeps_its_age_when_it_goes_on_with_what_is_stored():
    ring = RingMap()
    ring.areas["a"] = UPPER
    leader, standby = Blocks(), Blocks()
    for blocks in (leader, standby):
        blocks.on_hazard(ring.hazard_area("a"), Moment(0.0, 1e9))
    stored = leader.to_store(600.0)
    standby.restore(stored, 605.0)
    assert standby.age("a", 610.0) == pytest.approx(610.0)
    standby.to_store(610.0)
    assert sum(standby._hours["a"].values(), Durations()).spent.sum() == pytest.approx(610.0, abs=0.1)
    late = Blocks()
    late.on_hazard(ring.hazard_area("a"), Moment(590.0, 1e9))
    late.restore(stored, 605.0)
    assert late.age("a", 610.0) == pytest.approx(605.0), "the leader has seen it for longer"


class BlocksOverRestarts(RuleBasedStateMachine):
    """Areas become blocked, clear, overridden and silent while planners come, go, and store now and then.

    The model: what was seen of each block. It may be counted late, never twice, and an end only if it was seen.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now, self.seq = 1000.0, 0
        self.blocks = Blocks()
        self.stored: dict[str, BlockRecord] = {}
        self.since: float | None = None
        self.state = "clear"
        self.seen_s, self.ended = 0.0, 0
        self.kept = (0.0, 0)
        self.running = True
        self.tell()

    def tell(self) -> None:
        self.seq += 1
        override = None
        if self.state == "overridden":
            override = HazardOverride(
                state="blocked", author="a", reason="r", set_at=0.0, ttl_s=60.0, measured="clear", measured_penalty=0
            )
        shown: AreaState = {"clear": "clear", "unknown": "unknown"}.get(self.state, "blocked")  # type: ignore[assignment]  # because the keys are not literal
        hazard = AreaHazard(
            area="a", state=shown, severity=0, penalty=0 if shown == "clear" else 254, since=self.since or 0.0,
            seq=self.seq, epoch=1, cause="", override=override,
        )  # fmt: skip
        if self.running:
            self.blocks.on_hazard(HazardArea(hazard=hazard, polygon=[(0, 0), (1, 0), (1, 1)]), self.moment)

    @property
    def moment(self) -> Moment:
        return Moment(self.now - 1000.0, self.now)

    @rule(seconds=st.floats(0.1, 100.0))
    def wait(self, seconds):
        self.now += seconds
        if self.running and self.state == "blocked":
            self.seen_s += seconds

    @rule(state=st.sampled_from(["blocked", "clear", "overridden", "unknown"]))
    def change(self, state):
        if state == self.state:
            return
        if self.state == "blocked" and state == "clear" and self.running:
            self.ended += 1
        self.state = state
        self.since = self.now if state == "blocked" else None
        self.tell()

    @precondition(lambda self: self.running)
    @rule()
    def store(self):
        self.blocks.store_again(["a"])
        records = self.blocks.to_store(self.moment.now)
        self.stored |= {area: json.decode(json.encode(record), type=BlockRecord) for area, record in records.items()}
        self.kept = self.seen_s, self.ended

    @precondition(lambda self: self.running)
    @rule()
    def kill(self):
        self.running = False
        standing = self.stored["a"].standing if "a" in self.stored else None
        self.gap_from = None
        if standing is not None and standing.since == self.since:
            self.gap_from = self.kept[0]
        self.seen_s, self.ended = self.kept
        self.killed_at = self.now

    @precondition(lambda self: not self.running)
    @rule(hazard_first=st.booleans())
    def start(self, hazard_first):
        self.blocks, self.running = Blocks(), True
        standing = self.stored["a"].standing if "a" in self.stored else None
        if hazard_first:
            self.tell()
        self.blocks.restore(self.stored, self.moment.now)
        if not hazard_first:
            self.tell()
        if self.state == "blocked" and standing is not None and standing.since == self.since:
            self.seen_s += self.now - (self.since + standing.age)  # it stood all the time: its stamp says so

    @invariant()
    def counts_what_was_seen(self):
        if not self.running:
            return
        self.blocks.store_again(["a"])
        self.blocks.to_store(self.moment.now)
        counted = sum(self.blocks._hours.get("a", {}).values(), Durations())
        assert counted.ended.sum() == self.ended
        assert counted.spent.sum() == pytest.approx(self.seen_s, abs=0.05 + 1e-3 * self.seen_s)


TestBlocksOverRestarts = BlocksOverRestarts.TestCase
TestBlocksOverRestarts.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
