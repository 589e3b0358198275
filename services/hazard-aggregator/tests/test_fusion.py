"""From readings to area states: debounce, silence, contradictions, robots in the cone, fusion, restarts."""

import itertools
import math
from collections import deque
from collections.abc import Sequence

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.messages import (
    AreaDefinition,
    AreaHazard,
    CircleShape,
    NodeReading,
    Pose,
    Reported,
    RobotPose,
    SonarStatus,
    UnknownPolicy,
)
from fog_contracts.site import NodeSite, RobotSite, Sonar
from hazard_aggregator.debounce import DebounceError, Observation, RuleFactory
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.readings import FORGOTTEN_S, ReadingOrder, Taken
from hazard_aggregator.registry import find_rule

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
LIMIT = 1.2
START = Pose(x=0.0, y=0.0, theta=0.0)
PERIOD = 0.1


def area(*nodes: str, **fields) -> AreaDefinition:
    return AreaDefinition(id="hall", polygon=SQUARE, nodes=list(nodes), number=7, **fields)


def site(name: str, height: float = 0.3, *, no_echo_is_clear: bool = True) -> NodeSite:
    sonars = [Sonar(angle=a, range_limit=LIMIT, no_echo_is_clear=no_echo_is_clear) for a in (0.0, 0.1)]
    return NodeSite(id=name, area="hall", x=0.0, y=0.5, theta=0.0, height=height, sonars=sonars)


def pose(x: float, y: float, *, height: float = 0.35, localized: bool = True) -> RobotPose:
    return RobotPose(
        x=x,
        y=y,
        theta=0.0,
        covariance=[0.0] * 9,
        v=0.0,
        w=0.0,
        radius=0.17,
        height=height,
        stamp=0.0,
        localized=localized,
    )


def reading_at(seq: int, uptime_s: float) -> NodeReading:
    return NodeReading(seq=seq, boot=1, uptime_ms=round(1000 * uptime_s), range_m=[3.0], status=["ok"], state="clear")


class Rig:
    """A fusion with a clock that moves one node period per reading."""

    def __init__(
        self, *nodes: NodeSite, restored: list[AreaHazard] | None = None, robots: Sequence[RobotSite] = (), **fields
    ) -> None:
        self.core = AreaFusion(
            [area(*(n.id for n in nodes), **fields)],
            nodes,
            1,
            restored or [],
            registry=find_rule,
            default_rule="consecutive",
            robots=robots,
        )
        self.now = 100.0
        self.seq = 0
        self.changes: list[AreaHazard] = []
        self.wait(0.0)

    def read(
        self,
        *ranges: float | None,
        state: str | None = None,
        node: str = "n1",
        times: int = 1,
        status: list[SonarStatus] | None = None,
    ) -> None:
        for _ in range(times):
            self.now += PERIOD
            self.seq += 1
            reported = state or ("blocked" if any(r is not None and r < LIMIT for r in ranges) else "clear")
            reading = NodeReading(
                seq=self.seq,
                boot=1,
                uptime_ms=round(1000 * self.now),
                range_m=list(ranges),
                status=status or ["no_echo" if r is None else "ok" for r in ranges],
                state=reported,
            )
            self.changes += self.core.on_reading(node, reading, self.now, self.now + 1e6)

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while True:
            self.changes += self.core.tick(self.now, self.now + 1e6)
            if self.now >= end:
                return
            self.now = min(self.now + 0.1, end)

    @property
    def hazard(self) -> AreaHazard:
        return self.core.hazards()[0]


def test_area_starts_as_unknown_with_the_penalty_of_its_policy():
    rig = Rig(site("n1"))
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.seq, rig.hazard.epoch) == ("unknown", 200, 1, 1)


@pytest.mark.parametrize("other", [3.0, None])
def test_sonar_that_is_stuck_makes_its_area_unknown_with_the_reason_and_it_comes_back_by_itself(other):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"
    beside: SonarStatus = "no_echo" if other is None else "ok"
    rig.read(other, None, status=[beside, "stuck"], state="unknown", times=5)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    assert "stuck" in rig.hazard.cause or other is None
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_stuck_sonar_never_clears_a_blocked_area_and_the_other_one_still_blocks():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    rig.read(3.0, None, status=["ok", "stuck"], state="unknown", times=20)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    rig.read(0.8, None, status=["ok", "stuck"], state="blocked", times=5)
    assert rig.hazard.state == "blocked"


def test_node_that_reports_clear_with_a_stuck_sonar_contradicts_itself():
    rig = Rig(site("n1"))
    rig.read(3.0, None, status=["ok", "stuck"], state="clear", times=5)
    assert rig.hazard.state == "unknown"
    assert "the node reports clear, but sonar 1 shows: the echo line is stuck" in rig.hazard.cause


def test_fifth_consecutive_blocked_reading_blocks_the_area_and_begins_a_trace():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.changes.clear()
    rig.read(0.8, 3.0, times=4)
    assert rig.changes == []
    rig.read(0.8, 3.0)
    (hazard,) = rig.changes
    assert (hazard.state, hazard.penalty, hazard.severity) == ("blocked", 254, 3)
    assert hazard.trace is not None
    assert hazard.trace.confirmed - hazard.trace.first_reading == pytest.approx(4 * PERIOD)
    assert "0.80 m" in hazard.cause
    assert "n1" in hazard.cause


def test_four_blocked_readings_between_clear_ones_change_nothing():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.changes.clear()
    for _ in range(3):
        rig.read(0.8, 3.0, times=4)
        rig.read(3.0, 3.0, times=5)
    assert rig.changes == []


def test_each_area_uses_its_own_debounce_counts():
    rig = Rig(site("n1"), debounce={"to_blocked": 2, "to_clear": 7})
    rig.read(0.8, 3.0, times=2)
    assert rig.hazard.state == "blocked"
    rig.read(3.0, 3.0, times=6)
    assert rig.hazard.state == "blocked"
    rig.read(3.0, 3.0)
    assert rig.hazard.state == "clear"


def test_duplicate_and_outdated_readings_are_ignored():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.seq -= 3
    rig.read(0.8, 3.0, times=3)
    reading = NodeReading(seq=50, boot=1, uptime_ms=10**6, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked")
    for _ in range(20):
        rig.core.on_reading("n1", reading, rig.now, rig.now)
    assert rig.hazard.state == "clear"
    assert rig.core.pop_rejections() == [("n1", "outdated")] * 2 + [("n1", "duplicate")] + [("n1", "duplicate")] * 19


def test_reading_of_an_earlier_boot_is_ignored_until_the_node_is_silent():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)

    def read_from_boot(boot: int, seq: int) -> None:
        rig.now += PERIOD
        late = NodeReading(
            seq=seq, boot=boot, uptime_ms=100 * seq, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked"
        )
        rig.core.on_reading("n1", late, rig.now, rig.now)

    read_from_boot(9, 0)
    rig.core.pop_rejections()
    rig.read(3.0, 3.0)
    assert rig.core.pop_rejections() == [("n1", "earlier_boot")]
    for seq in range(1, 5):
        read_from_boot(9, seq)
    assert rig.hazard.state == "blocked", "boots are random: one that was never heard is new, whatever its number"
    rig.wait(FORGOTTEN_S + 0.5)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_node_that_counts_from_zero_again_is_heard_after_thirty_seconds():
    rig = Rig(site("n1"))
    rig.seq = 6000
    rig.read(3.0, 3.0, times=5)
    rig.seq = -1
    rig.read(0.8, 3.0, times=299)
    assert rig.hazard.state == "clear"
    assert set(rig.core.pop_rejections()) == {("n1", "outdated")}
    rig.read(0.8, 3.0, times=7)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize("boot", [1, 2])
def test_old_burst_in_any_order_is_not_fresh_after_a_silence(boot):
    order = ReadingOrder()
    for i in range(60):
        order.place(measured(100 + i, uptime_ms=10_000 + 100 * i), 10.0 + i / 10)
    if boot == 2:
        order.place(msgspec.structs.replace(measured(0, uptime_ms=0), boot=2), 16.0)
    late = [order.place(measured(100 + i, uptime_ms=10_000 + 100 * i), 26.0) for i in (3, 7, 4, 5, 6)]
    assert set(late) == {"outdated" if boot == 1 else "earlier_boot"}


def test_seq_of_32_bits_may_wrap():
    rig = Rig(site("n1"))
    rig.seq = 2**32 - 3
    rig.read(3.0, 3.0, times=2)
    rig.seq = -1
    rig.read(3.0, 3.0, times=3)
    assert rig.core.pop_rejections() == []
    assert rig.hazard.state == "clear"


def test_uptime_may_begin_anew():
    order = ReadingOrder()
    for i in range(40):
        uptime = 2**32 - 1000 + 100 * i
        placed = order.place(measured(i, uptime_ms=uptime % 2**32), 500.0 + i / 10)
        assert placed == (pytest.approx(500.0 + i / 10, abs=0.01), True)


def measured(seq: int, *, uptime_ms: int, state: str = "clear") -> NodeReading:
    distance = 0.8 if state == "blocked" else 3.0
    return NodeReading(seq=seq, boot=1, uptime_ms=uptime_ms, range_m=[distance, 3.0], status=["ok", "ok"], state=state)


def test_burst_of_delayed_readings_is_not_taken_for_fresh_ones():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    taken = rig.now
    rig.wait(20.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    for i in range(1, 160):  # the queue of a frozen broker: sixteen seconds, the last four of which are missing
        reading = measured(rig.seq + i, uptime_ms=round(1000 * (taken + i * PERIOD)))
        rig.changes += rig.core.on_reading("n1", reading, rig.now, rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    assert set(rig.core.pop_rejections()) == {("n1", "late")}


def test_silence_counts_from_when_a_reading_was_taken():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.now += 2.0
    reading = measured(rig.seq + 1, uptime_ms=round(1000 * (rig.now - 1.9)))
    rig.core.on_reading("n1", reading, rig.now, rig.now)
    rig.wait(0.9)
    assert rig.hazard.state == "clear"
    rig.wait(0.5)
    assert rig.hazard.state == "unknown"


def test_readings_closer_together_than_a_node_can_measure_count_as_one():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    start = round(1000 * rig.now)
    for i in range(1, 20):
        rig.core.on_reading("n1", measured(rig.seq + i, uptime_ms=start + 100 + i, state="blocked"), rig.now, rig.now)
    assert rig.hazard.state == "clear"
    assert rig.core.pop_rejections() == [("n1", "too_soon")] * 18


@pytest.mark.parametrize(("before", "penalty"), [((3.0, 3.0), 200), ((0.8, 3.0), 254)])
def test_silent_node_makes_its_area_unknown_and_a_blocked_area_stays_impassable(before, penalty):
    rig = Rig(site("n1"))
    rig.read(*before, times=5)
    rig.wait(2.9)
    assert rig.hazard.state != "unknown"
    rig.wait(0.3)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", penalty)
    assert "silent" in rig.hazard.cause
    rig.wait(3600.0 / 100)
    assert rig.hazard.state == "unknown"


@pytest.mark.parametrize("limits", [(1.0, 3.0), (3.0, 1.0)])
def test_each_area_is_unknown_after_the_silence_that_its_own_policy_allows(limits):
    """The node is the same: what one area takes for a silence is none in the other."""
    areas = [
        AreaDefinition(
            id=f"a{limit:g}", polygon=SQUARE, nodes=["n1"], number=i, unknown=UnknownPolicy(silent_after_s=limit)
        )
        for i, limit in enumerate(limits, 1)
    ]
    core = AreaFusion(areas, [site("n1")], 1, registry=find_rule, default_rule="consecutive")
    for i in range(5):
        core.on_reading("n1", measured(i, uptime_ms=100 * i), 100.0 + i / 10, 0.0)
    last, unknown = 100.4, {}
    for tick in range(1, 40):
        now = last + tick / 10
        for hazard in core.tick(now, now):
            if tick > 1:  # the first call evaluates
                unknown[hazard.area] = (hazard.state, now - last, hazard.cause)
    assert {area: state for area, (state, _, _) in unknown.items()} == {"a1": "unknown", "a3": "unknown"}
    assert unknown["a1"][1] == pytest.approx(1.0, abs=0.11)
    assert unknown["a3"][1] == pytest.approx(3.0, abs=0.11)
    assert "silent for more than 1 s" in unknown["a1"][2]
    assert "silent for more than 3 s" in unknown["a3"][2]


@pytest.mark.parametrize(
    ("ranges", "state", "cause"),
    [
        ((0.8, 3.0), "clear", "reports clear"),
        ((3.0, 3.0), "blocked", "reports blocked"),
        ((0.001, 3.0), "blocked", "nearer than a sonar can measure"),
        ((3.0,), "clear", "reports 1 sonars"),
        ((3.0, 3.0), "unknown", "the node reports unknown"),
    ],
)
def test_reading_whose_state_contradicts_its_ranges_is_unknown(ranges, state, cause):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.read(*ranges, state=state, times=5)
    assert rig.hazard.state == "unknown"
    assert cause in rig.hazard.cause


def test_range_within_rounding_of_the_limit_takes_the_nodes_reported_state():
    rig = Rig(site("n1"))
    rig.read(LIMIT - 0.005, 3.0, state="clear", times=5)
    assert rig.hazard.state == "clear"
    rig.read(LIMIT + 0.005, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "blocked"
    rig.read(LIMIT - 0.005, 0.4, state="clear", times=5)
    assert rig.hazard.state == "unknown"


def test_node_that_stays_blocked_a_little_beyond_the_limit_is_believed_but_not_farther():
    rig = Rig(site("n1"))
    rig.read(LIMIT + 0.045, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "blocked"
    rig.read(LIMIT + 0.07, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "unknown"


def test_no_echo_is_clear_only_where_calibration_found_nothing_in_range():
    free = Rig(site("n1", no_echo_is_clear=True))
    free.read(None, 3.0, state="clear", times=5)
    assert free.hazard.state == "clear"
    walled = Rig(site("n1", no_echo_is_clear=False))
    walled.read(None, 3.0, state="clear", times=20)
    assert walled.hazard.state == "unknown"
    assert "opposite wall" in walled.hazard.cause


@pytest.mark.parametrize("reported", ["clear", "unknown"])
def test_silence_of_all_its_sonars_clears_nothing_since_dead_and_covered_ones_are_silent_too(reported):
    rig = Rig(site("n1", no_echo_is_clear=True))
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"
    rig.read(None, None, state=reported, times=20)
    assert rig.hazard.state == "unknown"
    assert "dead or covered" in rig.hazard.cause or reported == "unknown"


@pytest.mark.parametrize("reported", ["clear", "unknown"])
def test_echo_from_behind_the_wall_clears_nothing(reported):
    """Wall at 2.1 m: what is flush to it, slants or is soft sends the sound on a detour, and the echo comes late."""
    sonars = [Sonar(angle=angle, range_limit=1.8, range_max=2.4) for angle in (0.0, 0.1)]
    rig = Rig(msgspec.structs.replace(site("n1"), sonars=sonars))
    rig.read(2.1, 2.38, state="clear", times=5)
    assert rig.hazard.state == "clear"
    rig.read(3.3, 2.1, state=reported, times=20)
    assert rig.hazard.state == "unknown"
    assert "none from beyond 2.40 m" in rig.hazard.cause or reported == "unknown"
    rig.read(3.3, 0.8, state="blocked", times=5)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(("ranges", "state"), [((0.8, 3.0), "blocked"), ((3.0, 3.0), "clear")])
def test_missing_echoes_between_readings_do_not_restart_the_count(ranges, state):
    rig = Rig(site("n1", no_echo_is_clear=False))
    rig.read(*((3.0, 3.0) if state == "blocked" else (0.8, 3.0)), times=5)
    for _ in range(4):
        rig.read(*ranges, times=2)
        rig.read(None, 3.0, state="unknown")
    assert rig.hazard.state == state


def test_missing_echoes_as_frequent_as_clear_readings_clear_nothing():
    rig = Rig(site("n1", no_echo_is_clear=False))
    rig.read(0.8, 3.0, times=5)
    for _ in range(100):
        rig.read(3.0, 3.0)
        rig.read(None, 3.0, state="unknown")
        rig.wait(0.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


def test_trace_begins_with_the_first_of_the_readings_that_block_an_area():
    rig = Rig(site("n1", no_echo_is_clear=False))
    rig.read(3.0, 3.0, times=5)
    rig.read(0.8, 3.0, times=2)
    rig.read(None, 3.0, state="unknown")
    rig.read(0.8, 3.0, times=3)
    assert rig.hazard.trace.confirmed - rig.hazard.trace.first_reading == pytest.approx(5 * PERIOD)


def test_flapping_readings_make_the_area_unknown():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    for _ in range(40):
        rig.read(0.8, 3.0)
        rig.wait(0.0)
        rig.read(3.0, 3.0)
        rig.wait(0.0)
    assert rig.hazard.state == "unknown"
    assert "contradict" in rig.hazard.cause
    assert len(rig.changes) <= 4


def test_offline_node_is_unknown_until_new_readings_arrive():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.changes += rig.core.on_availability("n1", online=False, now=rig.now, stamp=rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


@pytest.mark.parametrize("period", [0.1, 1.0])
@pytest.mark.parametrize("slew", [0.0, 0.5, 5.0, 100.0, -0.5, -5.0, -100.0])
@pytest.mark.parametrize("ppm", [500, 1_000, 83_333])
def test_readings_count_while_a_nodes_clock_is_slewed_and_afterwards(ppm, slew, period):
    order, uptime, taken = ReadingOrder(), 1000.0, []
    # A slew of nothing: an oscillator that is slow for good.
    lasts = abs(slew) / (1e-6 * ppm) if slew else 20_000.0
    for seq in range(round(min(lasts + 200.0, 20_000.0) / period)):
        now = seq * period
        slewed = 100.0 < now <= 100.0 + lasts
        uptime += period * (1.0 + math.copysign(1e-6 * ppm, slew or -1.0) * slewed)
        taken.append(order.place(reading_at(seq, uptime), 5000.0 + now))
    assert all(isinstance(one, Taken) and one.counts for one in taken)


@pytest.mark.parametrize("ppm", [1_000, 83_333])
def test_slewed_clock_is_followed_though_the_radio_holds_back_readings_now_and_then(ppm):
    order, uptime, arrived, refused = ReadingOrder(), 1000.0, 0.0, 0
    for seq in range(60_000):
        now = 0.1 * seq
        uptime += 0.1 * (1.0 - 1e-6 * ppm * (100.0 < now < 100.0 + 5e6 / ppm))
        arrived = max(arrived, now + max(0.0, 0.4 - now % 10.0))  # every 10 s one waits for 0.4 s, and others behind it
        refused += not isinstance(order.place(reading_at(seq, uptime), 5000.0 + arrived), Taken)
    assert refused == 0


def test_readings_that_the_network_holds_back_for_seconds_do_not_count():
    order = ReadingOrder()
    for seq in range(600):
        assert isinstance(order.place(reading_at(seq, 0.1 * seq), 0.1 * seq), Taken)
    held = [order.place(reading_at(seq, 0.1 * seq), 70.0) for seq in range(600, 700)]
    assert held[:60] == ["late"] * 60
    assert isinstance(held[-1], Taken)
    assert held[-1].at > 69.0


# --- Robots in the cone ---------------------------------------------------------------------------------------------


def read_beside_robot(rig: Rig, robot: RobotPose, ranges: tuple[float, float], times: int = 20) -> None:
    for _ in range(times):
        rig.core.on_pose("r1", robot, rig.now)
        rig.read(*ranges)
        rig.wait(0.0)


@pytest.mark.parametrize("height", [0.3, 0.45])  # above a robot of 0.35 m the cone comes down to it from 0.76 m on
def test_echo_of_a_robot_in_the_cone_does_not_block_a_clear_area(height):
    rig = Rig(site("n1", height))
    rig.read(3.0, 3.0, times=5)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=60)
    assert (rig.hazard.state, rig.hazard.explained_by) == ("clear", "r1")
    rig.read(3.0, 3.0, times=5)
    assert (rig.hazard.state, rig.hazard.explained_by) == ("clear", None)


def test_echo_of_a_robot_of_others_does_not_block_a_clear_area_and_no_other_report_explains_one():
    for kind, robot in (("robot", "tb4"), ("obstacle", "tb4"), ("robot", "r1")):
        rig = Rig(site("n1"), robots=[RobotSite(id="r1", start=START, radius=0.17)])
        told = Reported(kind=kind, shape=CircleShape(centre=(1.0, 0.5), radius=0.17), ttl=3.0)
        rig.read(3.0, 3.0, times=5)
        for _ in range(60):
            rig.core.on_reported(robot, told, rig.now)
            rig.read(0.83, 3.0)
            rig.wait(0.0)
        expected = ("clear", "tb4") if (kind, robot) == ("robot", "tb4") else ("blocked", None)
        assert (rig.hazard.state, rig.hazard.explained_by) == expected


def test_echo_of_a_robot_in_the_cone_does_not_clear_a_blocked_area():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=60)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(
    ("robot", "ranges"),
    [
        (pose(1.0, 0.5), (0.45, 3.0)),  # a person in front of the robot
        (pose(1.0, 1.3), (0.83, 3.0)),  # the robot beside the cone
        (pose(1.0, 0.5, localized=False), (0.83, 3.0)),  # a robot that is not localized
        (pose(-1.0, 0.5), (0.83, 3.0)),  # a robot behind the node
    ],
)
def test_echo_that_no_robot_explains_blocks(robot, ranges):
    rig = Rig(site("n1"))
    read_beside_robot(rig, robot, ranges, times=5)
    assert rig.hazard.state == "blocked"


def test_pose_older_than_three_seconds_explains_no_echo():
    rig = Rig(site("n1"))
    rig.core.on_pose("r1", pose(1.0, 0.5), rig.now)
    rig.now += 3.01
    rig.read(0.83, 3.0, times=5)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(
    ("robot", "of_the_site"),
    [
        (pose(1.0, 0.5, height=0.35), RobotSite(id="r1", start=START, height=0.1, radius=0.17)),  # below the cone
        (msgspec.structs.replace(pose(1.0, 0.5), radius=0.9), RobotSite(id="r1", start=START, radius=0.17)),
    ],
)
def test_echo_is_explained_by_a_robots_body_of_the_site_not_by_the_one_that_it_claims(robot, of_the_site):
    rig = Rig(site("n1"), robots=[of_the_site])
    rig.read(3.0, 3.0, times=5)
    read_beside_robot(rig, robot, (robot.x - robot.radius, 3.0), times=5)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize("heard", [1.0, 0.5])
def test_robot_that_says_that_it_stands_where_an_echo_comes_from_keeps_an_area_clear_for_seconds_only(heard):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    clear = 0
    for turn in range(250):
        # Something stands there from now on that swallows a part of the echoes.
        read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0) if heard == 1.0 or turn % 2 == 0 else (3.0, 3.0), times=1)
        clear += rig.hazard.state == "clear"
    assert clear * PERIOD <= 10.0
    assert rig.hazard.state == "unknown"
    report = rig.core.node_reports(rig.now)[0]
    assert report.state == "unknown"  # which is an alert after a while
    assert report.reason.code == "robot_stays"
    read_beside_robot(rig, pose(-3.0, 0.5), (0.83, 3.0), times=5)
    assert rig.hazard.state == "blocked"


def drive_by(rig: Rig, delay: float, *, box: bool = False, since: float = -1.0) -> list[str]:
    """Drive across the beam at 0.3 m/s; each pose takes `delay` (s) from y = `since` (m) on. Return the states."""
    on_the_way: list[tuple[float, RobotPose]] = []
    first = rig.now
    for _ in range(100):
        y = -1.0 + 0.3 * (rig.now - first)
        moving = msgspec.structs.replace(pose(1.0, y), theta=math.pi / 2, v=0.3, clock=rig.now + 5000.0)
        on_the_way.append((rig.now + (delay if y >= since else 0.0), moving))
        while on_the_way and on_the_way[0][0] <= rig.now:
            rig.core.on_pose("r1", on_the_way.pop(0)[1], rig.now)
        seen = 0.83 if abs(y - 0.5) < 0.3 else 0.9 if box else 3.0
        rig.read(seen, 3.0)
        rig.wait(0.0)
    return [hazard.state for hazard in rig.changes]


@pytest.mark.parametrize("delay", [0.3, 0.5, 0.7, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("since", [-0.9, 0.0, 0.25, 0.5])
def test_robot_whose_poses_come_late_does_not_block_the_corridor_that_it_passes(delay, since):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    with_and_without_explanation = ["clear", "clear", "clear"]
    assert drive_by(rig, delay, since=since) == ["unknown", *with_and_without_explanation]


def test_block_of_which_late_poses_explain_all_is_taken_back():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    before = msgspec.structs.replace(pose(1.0, -2.0), clock=rig.now + 5000.0)
    rig.core.on_pose("r1", before, rig.now)
    rig.wait(3.5)  # the network holds back what the robot says
    began = rig.now
    rig.read(0.83, 3.0, times=5)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)
    rig.wait(0.1)
    for moment in (began - 0.1, began + 0.2, began + 0.4, rig.now):
        rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, 0.5), clock=moment + 5000.0), rig.now)
    rig.wait(0.1)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    assert rig.hazard.cause == "node n1: it saw the robot r1, whose pose came late"
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_robot_that_stands_in_a_cone_is_not_shut_in_because_the_network_held_its_poses_back():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    held: deque[RobotPose] = deque()

    def stand(seconds: float, arriving: int) -> None:
        for _ in range(round(seconds / PERIOD)):
            held.append(msgspec.structs.replace(pose(1.0, 0.5), clock=rig.now + 5000.0))
            for _ in range(min(arriving, len(held))):
                rig.core.on_pose("r1", held.popleft(), rig.now)
            rig.read(0.83, 3.0)
            rig.wait(0.0)

    stand(9.0, arriving=1)
    assert rig.hazard.state == "unknown"  # for it sees nothing else
    stand(3.6, arriving=0)
    assert rig.hazard.state == "blocked"
    stand(3.0, arriving=3)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)


@pytest.mark.parametrize(("others", "penalty"), [((), 200), ((0.4,), 254)])
def test_robot_that_nobody_heard_for_long_is_not_shut_in_by_its_own_echoes_alone(others, penalty):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=5)
    rig.read(0.83, 3.0, times=200)  # the network is away, and the robot stands
    for other in others:
        rig.read(other, 3.0)  # somebody passed meanwhile
    rig.read(0.83, 3.0, times=200)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=30)
    rig.wait(0.1)
    assert rig.hazard.penalty == penalty


def test_robot_that_says_late_again_and_again_that_it_stood_there_unblocks_an_area_a_few_times_only():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)

    def say(x: float, moment: float) -> None:
        rig.core.on_pose("r1", msgspec.structs.replace(pose(x, 0.5), clock=moment + 5000.0), rig.now)

    say(-3.0, rig.now)
    rig.changes.clear()
    before, passable = rig.now, 0
    for _ in range(300):
        rig.read(0.83, 3.0)  # a box
        rig.now += 0.02
        for x, moment in ((1.0, before + 0.002), (1.0, rig.now - 0.002), (-3.0, rig.now - 0.001)):
            say(x, moment)
        before = rig.now
        rig.wait(0.0)
        passable += rig.hazard.penalty < 254
    assert passable * PERIOD <= 3.0
    assert rig.hazard.state == "blocked"
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_block_that_late_poses_explain_in_part_stays():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, -2.0), clock=rig.now + 5000.0), rig.now)
    rig.wait(3.5)
    rig.read(0.4, 3.0)  # somebody before the robot, once
    began = rig.now
    rig.read(0.83, 3.0, times=5)
    rig.wait(0.1)
    for moment in (began - 0.2, began, rig.now):
        rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, 0.5), clock=moment + 5000.0), rig.now)
    rig.wait(0.5)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)


def test_box_that_one_node_saw_stays_impassable_when_late_poses_explain_another_nodes_block():
    rig = Rig(site("n1"), site("n2"))
    for node in ("n1", "n2"):
        rig.read(3.0, 3.0, node=node, times=5)
    rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, -2.0), clock=rig.now + 5000.0), rig.now)
    rig.wait(3.5)
    rig.read(0.4, 3.0, node="n2", times=5)  # a box, and the node is never heard again
    began = rig.now
    for _ in range(19):
        rig.read(0.83, 3.0, node="n1", times=2)
        rig.wait(0.1)
    assert rig.hazard.state == "blocked"
    for moment in (began - 0.2, began, began + 1.5, rig.now):
        rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, 0.5), clock=moment + 5000.0), rig.now)
    rig.wait(0.1)
    assert rig.hazard.nodes == {"n1": "unknown", "n2": "unknown"}
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


@pytest.mark.parametrize("delay", [0.0, 0.7, 2.0])
def test_box_in_a_corridor_stays_blocked_while_a_robot_passes_it(delay):
    rig = Rig(site("n1"))
    rig.read(0.9, 3.0, times=5)
    rig.changes.clear()
    assert "clear" not in drive_by(rig, delay, box=True)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)


def test_unexplained_echo_of_one_sonar_blocks_although_a_robot_explains_the_other():
    rig = Rig(site("n1"))
    read_beside_robot(rig, pose(1.0, 0.47), (0.83, 0.4), times=5)
    assert rig.hazard.state == "blocked"


@given(st.floats(-math.pi, math.pi), st.floats(0.3, 1.3), st.floats(-0.6, 0.6))
@settings(max_examples=60, deadline=None)
def test_explained_echoes_do_not_depend_on_the_sites_rotation(rotation, distance, bearing):
    def outcome(theta: float) -> str:
        x, y = distance * math.cos(theta + bearing), distance * math.sin(theta + bearing)
        node = NodeSite(id="n1", area="hall", x=0.0, y=0.0, theta=theta, sonars=[Sonar(range_limit=1.25)])
        core = AreaFusion([area("n1")], [node], 1, registry=find_rule, default_rule="consecutive")
        core.on_pose("r1", pose(x, y), 0.0)
        for seq in range(5):
            echo = NodeReading(
                seq=seq,
                boot=1,
                uptime_ms=100 * seq,
                range_m=[max(distance - 0.17, 0.05)],
                status=["ok"],
                state="blocked",
            )
            core.on_reading("n1", echo, 0.0, 0.0)
        return core.hazards()[0].state

    edge = abs(abs(bearing) - math.asin(0.17 / distance) - math.radians(7.5))
    if edge > 1e-6:
        assert outcome(0.0) == outcome(rotation)


# --- Several nodes --------------------------------------------------------------------------------------------------


def test_one_blocked_node_blocks_an_area_and_only_all_nodes_clear_it():
    rig = Rig(site("n1"), site("n2"))
    rig.read(3.0, 3.0, node="n1", times=5)
    assert rig.hazard.state == "unknown"
    rig.read(3.0, 3.0, node="n2", times=5)
    assert rig.hazard.state == "clear"
    rig.read(0.8, 3.0, node="n2", times=5)
    assert rig.hazard.state == "blocked"
    assert rig.hazard.nodes == {"n1": "clear", "n2": "blocked"}


def test_silent_node_beside_a_clear_one_makes_the_area_unknown():
    rig = Rig(site("n1"), site("n2"))
    for node in ("n1", "n2"):
        rig.read(3.0, 3.0, node=node, times=5)
    for _ in range(40):
        rig.read(3.0, 3.0, node="n1")
        rig.wait(0.0)
    assert rig.hazard.state == "unknown"
    assert "n2" in rig.hazard.cause


def test_blocked_area_stays_impassable_when_its_blocked_node_is_silent_and_the_other_clear():
    rig = Rig(site("n1"), site("n2"))
    rig.read(3.0, 3.0, node="n1", times=5)
    rig.read(0.8, 3.0, node="n2", times=5)
    for _ in range(40):
        rig.read(3.0, 3.0, node="n1")
        rig.wait(0.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


# --- Restart, change of areas, the thesis's nodes -------------------------------------------------------------------


def test_stalled_aggregator_handles_waiting_readings_before_it_declares_a_node_silent():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.now += 5.0
    assert rig.core.tick(rig.now, rig.now) == []
    rig.read(3.0, 3.0)
    rig.wait(0.5)
    assert rig.hazard.state == "clear"


def test_aggregator_that_stalls_at_every_tick_still_detects_a_silent_node():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    for _ in range(2):
        rig.now += 5.0
        rig.core.tick(rig.now, rig.now)
    assert rig.hazard.state == "unknown"


def stored(state: str, penalty: int) -> AreaHazard:
    return AreaHazard(area="hall", state=state, severity=3, penalty=penalty, since=1.0, seq=9, epoch=0, cause="")


def test_blocked_area_stays_blocked_after_a_restart_until_silence_makes_it_unknown_and_impassable():
    rig = Rig(site("n1"), restored=[stored("blocked", 254)])
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.epoch) == ("blocked", 254, 1)
    rig.wait(3.2)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


def test_clear_area_is_unknown_after_a_restart_until_readings_confirm_clear():
    rig = Rig(site("n1"), restored=[stored("clear", 0)])
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


@pytest.mark.parametrize(("state", "penalty"), [("blocked", 254), ("unknown", 254), ("unknown", 200)])
def test_hazard_keeps_its_since_across_a_restart(state, penalty):
    rig = Rig(site("n1"), restored=[stored(state, penalty)])
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.since) == (state, penalty, 1.0)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.since > 1.0


def test_reading_before_the_first_tick_leaves_the_restored_state():
    core = AreaFusion(
        [area("n1")], [site("n1")], 2, [stored("blocked", 254)], registry=find_rule, default_rule="consecutive"
    )
    reading = NodeReading(seq=1, boot=1, uptime_ms=0, range_m=[3.0, 3.0], status=["ok", "ok"], state="clear")
    core.on_reading("n1", reading, 1000.0, 0.0)
    core.tick(1000.1, 0.1)
    assert core.hazards()[0].state == "blocked"


def test_late_restore_makes_an_unconfirmed_area_impassable_and_leaves_a_confirmed_one():
    rig = Rig(site("n1"))
    rig.changes += rig.core.restore([stored("blocked", 254)], rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    confirmed = Rig(site("n1"))
    confirmed.read(3.0, 3.0, times=5)
    assert confirmed.core.restore([stored("blocked", 254)], confirmed.now) == []
    assert confirmed.hazard.state == "clear"


def test_changed_policy_changes_the_hazard_at_once_and_a_removed_area_stays_listed_as_removed():
    rig = Rig(site("n1"))
    definition = rig.core.definitions()[0]
    changed = rig.core.put_area(_with_penalty(definition, 50), rig.now)
    assert [h.penalty for h in changed] == [50]
    assert rig.core.put_area(AreaDefinition(id="hall", polygon=SQUARE, removed=True), rig.now) == []
    assert rig.core.hazards() == []
    assert [d.removed for d in rig.core.definitions()] == [True]
    again = rig.core.put_area(definition, rig.now)
    assert again[0].seq > changed[0].seq


def _with_penalty(definition: AreaDefinition, penalty: int) -> AreaDefinition:
    return AreaDefinition(
        id=definition.id,
        polygon=definition.polygon,
        nodes=definition.nodes,
        number=definition.number,
        unknown=type(definition.unknown)(penalty=penalty),
    )


def test_thesis_nodes_block_their_area():
    core = AreaFusion([area()], [], 1, registry=find_rule, default_rule="consecutive")
    core.tick(0.0, 0.0)
    for i in range(5):
        changed = core.on_thesis_state(7, "blocked", i / 10, i / 10)
    assert [h.state for h in changed] == ["blocked"]
    for i in range(5):
        core.on_thesis_state(8, "clear", i / 10, i / 10)
    assert core.hazards()[0].state == "blocked"


def test_stray_thesis_message_holds_an_area_for_a_minute_only():
    rig = Rig(site("n1"))
    rig.changes += rig.core.on_thesis_state(7, "clear", rig.now, rig.now)
    for _ in range(630):
        rig.read(3.0, 3.0)
        rig.wait(0.0)
        if rig.now < 159.0:
            assert rig.hazard.state == "unknown"
    assert rig.hazard.state == "clear"
    assert list(rig.hazard.nodes) == ["n1"]


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"rule": "majority"}, r"area hall: debounce\.rule: .*'majority' \(known: .*consecutive"),
        ({"rule": "consecutive", "to_blocke": 3}, r"area hall: debounce\.to_blocke: .*known: to_blocked, to_clear"),
        ({"to_blocked": 0}, r"area hall: debounce\.to_blocked: Expected `int` >= 1"),
        ({"to_clear": "five"}, r"area hall: debounce\.to_clear: Expected `int`"),
        ({"rule": 7}, r"area hall: debounce\.rule"),
    ],
)
def test_invalid_debounce_settings_are_refused_naming_area_field_and_known_values(choice, message):
    with pytest.raises(DebounceError, match=message):
        Rig(site("n1"), debounce=choice)
    with pytest.raises(DebounceError, match=message):
        AreaFusion([area(debounce=choice)], [], 1, registry=find_rule, default_rule="consecutive")


class Sustained:
    """Confirms a state that readings have shown for `seconds` without a break."""

    class Options(msgspec.Struct):
        seconds: float

    def __init__(self, options: Options) -> None:
        self.seconds, self.state, self.since = options.seconds, None, 0.0

    def update(self, seen: Observation, now: float) -> str | None:
        if seen.state != self.state:
            self.state, self.since = seen.state, now
        return seen.state if now - self.since >= self.seconds else None

    def reset(self) -> None:
        self.state = None


def test_debounce_rule_can_use_the_time_of_readings():
    definition = area("n1", debounce={"seconds": 1.0})
    factory = RuleFactory(options=Sustained.Options, make=Sustained)
    fusion = AreaFusion(
        [definition], [site("n1")], 1, registry={"sustained": factory}.__getitem__, default_rule="sustained"
    )
    for seq, now in enumerate((100.0, 100.5, 100.9, 101.01)):
        assert fusion.hazards() == [] or fusion.hazards()[0].state == "unknown"
        fusion.on_reading("n1", measured(seq, uptime_ms=round(1000 * now), state="blocked"), now, now)
    assert fusion.hazards()[0].state == "blocked"


# --- Invariants -----------------------------------------------------------------------------------------------------

EVENT = st.sampled_from(["clear", "blocked", "no_echo", "contradiction", "wait", "offline", "duplicate"])


@given(st.lists(EVENT, max_size=120))
@settings(max_examples=150, deadline=None)
def test_only_consecutive_clear_readings_clear_a_blocked_area(events):
    rig = Rig(site("n1", no_echo_is_clear=False))
    rig.read(0.8, 3.0, times=5)
    clear_in_a_row = 0
    for event in events:
        if event == "clear":
            rig.read(3.0, 3.0)
            clear_in_a_row += 1
        elif event == "blocked":
            rig.read(0.8, 3.0)
            clear_in_a_row = 0
        elif event == "no_echo":
            rig.read(None, 3.0, state="unknown")
            clear_in_a_row = max(0, clear_in_a_row - 1)
        elif event == "contradiction":
            rig.read(0.8, 3.0, state="clear")
            clear_in_a_row = max(0, clear_in_a_row - 1)
        elif event == "wait":
            rig.wait(3.5)
            clear_in_a_row = 0
        elif event == "offline":
            rig.changes += rig.core.on_availability("n1", online=False, now=rig.now, stamp=rig.now)
        else:
            rig.seq -= 1
            rig.read(3.0, 3.0)
        if clear_in_a_row >= 5:
            break
        assert rig.hazard.penalty == 254
    seqs = [h.seq for h in rig.changes]
    assert seqs == sorted(set(seqs))
    assert all(
        (a.state, a.penalty, a.cause) != (b.state, b.penalty, b.cause) for a, b in itertools.pairwise(rig.changes)
    )
