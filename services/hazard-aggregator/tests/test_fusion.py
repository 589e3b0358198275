"""What readings make of areas: debounce, silence, contradiction, robots in the cone, fusion, restarts."""

import itertools
import math

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, RobotPose
from fog_contracts.site import NodeSite, Sonar
from hazard_aggregator.debounce import DebounceError, RuleFactory
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]
LIMIT = 1.2
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


class Rig:
    """A fusion with a clock that moves one node period per reading."""

    def __init__(self, *nodes: NodeSite, restored: list[AreaHazard] | None = None, **fields) -> None:
        self.core = AreaFusion([area(*(n.id for n in nodes), **fields)], nodes, 1, restored or [], registry=find_rule)
        self.now = 100.0
        self.seq = 0
        self.seen: list[AreaHazard] = []
        self.wait(0.0)

    def read(self, *ranges: float | None, state: str | None = None, node: str = "n1", times: int = 1) -> None:
        for _ in range(times):
            self.now += PERIOD
            self.seq += 1
            said = state or ("blocked" if any(r is not None and r < LIMIT for r in ranges) else "clear")
            reading = NodeReading(
                seq=self.seq,
                boot=1,
                uptime_ms=0,
                range_m=list(ranges),
                status=["no_echo" if r is None else "ok" for r in ranges],
                state=said,
            )
            self.seen += self.core.on_reading(node, reading, self.now, self.now + 1e6)

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while True:
            self.seen += self.core.tick(self.now, self.now + 1e6)
            if self.now >= end:
                return
            self.now = min(self.now + 0.1, end)

    @property
    def hazard(self) -> AreaHazard:
        return self.core.hazards()[0]


def test_an_area_starts_as_unknown_at_the_policys_penalty():
    rig = Rig(site("n1"))
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.seq, rig.hazard.epoch) == ("unknown", 200, 1, 1)


def test_the_fifth_blocked_reading_in_a_row_blocks_and_is_traced():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.seen.clear()
    rig.read(0.8, 3.0, times=4)
    assert rig.seen == []
    rig.read(0.8, 3.0)
    (hazard,) = rig.seen
    assert (hazard.state, hazard.penalty, hazard.severity) == ("blocked", 254, 3)
    assert hazard.trace is not None
    assert hazard.trace.confirmed - hazard.trace.first_reading == pytest.approx(4 * PERIOD)
    assert "0.80 m" in hazard.cause
    assert "n1" in hazard.cause


def test_four_blocked_readings_and_one_clear_change_nothing():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.seen.clear()
    for _ in range(3):
        rig.read(0.8, 3.0, times=4)
        rig.read(3.0, 3.0, times=5)
    assert rig.seen == []


def test_debounce_counts_are_the_areas_own():
    rig = Rig(site("n1"), debounce={"to_blocked": 2, "to_clear": 7})
    rig.read(0.8, 3.0, times=2)
    assert rig.hazard.state == "blocked"
    rig.read(3.0, 3.0, times=6)
    assert rig.hazard.state == "blocked"
    rig.read(3.0, 3.0)
    assert rig.hazard.state == "clear"


def test_duplicates_and_overtaken_readings_do_not_count():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.seq -= 3
    rig.read(0.8, 3.0, times=3)
    reading = NodeReading(seq=50, boot=1, uptime_ms=0, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked")
    for _ in range(20):
        rig.core.on_reading("n1", reading, rig.now, rig.now)
    assert rig.hazard.state == "clear"


def test_a_reading_of_an_earlier_boot_is_ignored_until_the_node_falls_silent():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)

    def old_boot(seq: int) -> None:
        late = NodeReading(seq=seq, boot=0, uptime_ms=0, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked")
        rig.core.on_reading("n1", late, rig.now, rig.now)

    for seq in range(10):
        old_boot(seq)
    assert rig.hazard.state == "clear"
    rig.wait(3.5)
    for seq in range(10, 15):
        old_boot(seq)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(("before", "penalty"), [((3.0, 3.0), 200), ((0.8, 3.0), 254)])
def test_silence_makes_unknown_and_keeps_what_was_blocked_impassable(before, penalty):
    rig = Rig(site("n1"))
    rig.read(*before, times=5)
    rig.wait(2.9)
    assert rig.hazard.state != "unknown"
    rig.wait(0.3)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", penalty)
    assert "silent" in rig.hazard.cause
    rig.wait(3600.0 / 100)
    assert rig.hazard.state == "unknown"


def test_only_a_row_of_clear_readings_ends_what_silence_kept():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    rig.wait(4.0)
    rig.read(3.0, 3.0, times=4)
    assert rig.hazard.penalty == 254
    rig.read(3.0, 3.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("clear", 0)


@pytest.mark.parametrize(
    ("ranges", "state", "words"),
    [
        ((0.8, 3.0), "clear", "says clear"),
        ((3.0, 3.0), "blocked", "says blocked"),
        ((0.001, 3.0), "blocked", "nearer than a sonar can measure"),
        ((3.0,), "clear", "reports 1 sonars"),
        ((3.0, 3.0), "unknown", "calls its own reading unknown"),
    ],
)
def test_a_node_whose_word_contradicts_its_ranges_is_not_believed(ranges, state, words):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.read(*ranges, state=state, times=5)
    assert rig.hazard.state == "unknown"
    assert words in rig.hazard.cause


def test_at_the_limit_itself_the_nodes_word_holds():
    rig = Rig(site("n1"))
    rig.read(LIMIT - 0.005, 3.0, state="clear", times=5)
    assert rig.hazard.state == "clear"
    rig.read(LIMIT + 0.005, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "blocked"
    rig.read(LIMIT - 0.005, 0.4, state="clear", times=5)
    assert rig.hazard.state == "unknown"


def test_no_echo_clears_only_where_calibration_saw_nothing_in_range():
    free = Rig(site("n1", no_echo_is_clear=True))
    free.read(None, None, state="clear", times=5)
    assert free.hazard.state == "clear"
    walled = Rig(site("n1", no_echo_is_clear=False))
    walled.read(None, None, state="clear", times=20)
    assert walled.hazard.state == "unknown"
    assert "opposite wall" in walled.hazard.cause


def test_flapping_readings_become_unknown_not_clear():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    for _ in range(40):
        rig.read(0.8, 3.0)
        rig.wait(0.0)
        rig.read(3.0, 3.0)
        rig.wait(0.0)
    assert rig.hazard.state == "unknown"
    assert "contradict" in rig.hazard.cause
    assert len(rig.seen) <= 4


def test_an_offline_node_is_not_trusted_and_is_again_once_heard():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.seen += rig.core.on_availability("n1", online=False, now=rig.now, stamp=rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


# --- Robots in the cone ---------------------------------------------------------------------------------------------


def drive_by(rig: Rig, robot: RobotPose, ranges: tuple[float, float], times: int = 20) -> None:
    for _ in range(times):
        rig.core.on_pose("r1", robot, rig.now)
        rig.read(*ranges)
        rig.wait(0.0)


def test_a_robot_in_the_cone_at_the_measured_range_counts_neither_way():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    drive_by(rig, pose(1.0, 0.5), (0.83, 3.0), times=60)
    assert (rig.hazard.state, rig.hazard.explained_by) == ("clear", "r1")
    rig.read(3.0, 3.0, times=5)
    assert (rig.hazard.state, rig.hazard.explained_by) == ("clear", None)


def test_a_robot_does_not_clear_a_blocked_area_either():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    drive_by(rig, pose(1.0, 0.5), (0.83, 3.0), times=60)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(
    ("robot", "ranges"),
    [
        (pose(1.0, 0.5), (0.45, 3.0)),  # a person before the robot
        (pose(1.0, 1.3), (0.83, 3.0)),  # the robot beside the cone
        (pose(1.0, 0.5, height=0.2), (0.83, 3.0)),  # a robot lower than the node
        (pose(1.0, 0.5, localized=False), (0.83, 3.0)),  # a robot that does not know where it is
        (pose(-1.0, 0.5), (0.83, 3.0)),  # a robot behind the node
    ],
)
def test_an_echo_that_no_robot_explains_blocks(robot, ranges):
    rig = Rig(site("n1"))
    drive_by(rig, robot, ranges, times=5)
    assert rig.hazard.state == "blocked"


def test_a_pose_older_than_a_second_explains_nothing():
    rig = Rig(site("n1"))
    rig.core.on_pose("r1", pose(1.0, 0.5), rig.now)
    rig.now += 1.01
    rig.read(0.83, 3.0, times=5)
    assert rig.hazard.state == "blocked"


def test_a_person_in_the_other_sonar_counts_although_a_robot_explains_the_first():
    rig = Rig(site("n1"))
    drive_by(rig, pose(1.0, 0.47), (0.83, 0.4), times=5)
    assert rig.hazard.state == "blocked"


@given(st.floats(-math.pi, math.pi), st.floats(0.3, 1.3), st.floats(-0.6, 0.6))
@settings(max_examples=60, deadline=None)
def test_explaining_does_not_depend_on_how_the_site_is_turned(turn, distance, bearing):
    def outcome(theta: float) -> str:
        x, y = distance * math.cos(theta + bearing), distance * math.sin(theta + bearing)
        node = NodeSite(id="n1", area="hall", x=0.0, y=0.0, theta=theta, sonars=[Sonar(range_limit=1.25)])
        core = AreaFusion([area("n1")], [node], 1, registry=find_rule)
        core.on_pose("r1", pose(x, y), 0.0)
        for seq in range(5):
            echo = NodeReading(
                seq=seq, boot=1, uptime_ms=0, range_m=[max(distance - 0.17, 0.05)], status=["ok"], state="blocked"
            )
            core.on_reading("n1", echo, 0.0, 0.0)
        return core.hazards()[0].state

    edge = abs(abs(bearing) - math.asin(0.17 / distance) - math.radians(7.5))
    if edge > 1e-6:
        assert outcome(0.0) == outcome(turn)


# --- Several nodes --------------------------------------------------------------------------------------------------


def test_one_blocked_node_blocks_and_all_must_agree_to_clear():
    rig = Rig(site("n1"), site("n2"))
    rig.read(3.0, 3.0, node="n1", times=5)
    assert rig.hazard.state == "unknown"
    rig.read(3.0, 3.0, node="n2", times=5)
    assert rig.hazard.state == "clear"
    rig.read(0.8, 3.0, node="n2", times=5)
    assert rig.hazard.state == "blocked"
    assert rig.hazard.nodes == {"n1": "clear", "n2": "blocked"}


def test_a_silent_node_beside_a_clear_one_makes_the_area_unknown():
    rig = Rig(site("n1"), site("n2"))
    for node in ("n1", "n2"):
        rig.read(3.0, 3.0, node=node, times=5)
    for _ in range(40):
        rig.read(3.0, 3.0, node="n1")
        rig.wait(0.0)
    assert rig.hazard.state == "unknown"
    assert "n2" in rig.hazard.cause


def test_a_blocked_area_stays_impassable_when_its_blocked_node_dies_and_the_other_sees_nothing():
    rig = Rig(site("n1"), site("n2"))
    rig.read(3.0, 3.0, node="n1", times=5)
    rig.read(0.8, 3.0, node="n2", times=5)
    for _ in range(40):
        rig.read(3.0, 3.0, node="n1")
        rig.wait(0.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


# --- Restart, change of areas, the thesis's nodes -------------------------------------------------------------------


def test_an_aggregator_that_was_held_up_hears_what_has_arrived_before_it_calls_a_node_silent():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.now += 5.0
    assert rig.core.tick(rig.now, rig.now) == []
    rig.read(3.0, 3.0)
    rig.wait(0.5)
    assert rig.hazard.state == "clear"


def test_an_aggregator_that_is_always_held_up_still_calls_a_silent_node_silent():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    for _ in range(2):
        rig.now += 5.0
        rig.core.tick(rig.now, rig.now)
    assert rig.hazard.state == "unknown"


def stored(state: str, penalty: int) -> AreaHazard:
    return AreaHazard(area="hall", state=state, severity=3, penalty=penalty, since=1.0, seq=9, epoch=0, cause="")


def test_a_restart_keeps_a_blocked_area_blocked_until_silence_makes_it_unknown_and_impassable():
    rig = Rig(site("n1"), restored=[stored("blocked", 254)])
    assert (rig.hazard.state, rig.hazard.penalty, rig.hazard.epoch) == ("blocked", 254, 1)
    rig.wait(3.2)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


def test_no_area_is_clear_after_a_restart_before_readings_say_so():
    rig = Rig(site("n1"), restored=[stored("clear", 0)])
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_a_reading_before_the_first_tick_does_not_break_a_restored_state():
    core = AreaFusion([area("n1")], [site("n1")], 2, [stored("blocked", 254)], registry=find_rule)
    reading = NodeReading(seq=1, boot=1, uptime_ms=0, range_m=[3.0, 3.0], status=["ok", "ok"], state="clear")
    core.on_reading("n1", reading, 1000.0, 0.0)
    core.tick(1000.1, 0.1)
    assert core.hazards()[0].state == "blocked"


def test_a_late_memory_makes_an_unjudged_area_impassable_and_leaves_a_judged_one_alone():
    rig = Rig(site("n1"))
    rig.seen += rig.core.recall([stored("blocked", 254)], rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    judged = Rig(site("n1"))
    judged.read(3.0, 3.0, times=5)
    assert judged.core.recall([stored("blocked", 254)], judged.now) == []
    assert judged.hazard.state == "clear"


def test_a_changed_policy_changes_the_hazard_at_once_and_removal_leaves_a_tombstone():
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


def test_the_thesiss_nodes_still_count():
    core = AreaFusion([area()], [], 1, registry=find_rule)
    core.tick(0.0, 0.0)
    for i in range(5):
        changed = core.on_thesis_state(7, "blocked", i / 10, i / 10)
    assert [h.state for h in changed] == ["blocked"]
    for i in range(5):
        core.on_thesis_state(8, "clear", i / 10, i / 10)
    assert core.hazards()[0].state == "blocked"


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"rule": "majority"}, r"area hall: debounce\.rule: .*'majority' \(known: .*consecutive"),
        ({"rule": "consecutive", "to_blocke": 3}, r"area hall: debounce\.to_blocke: .*known: to_blocked, to_clear"),
        ({"to_blocked": 0}, r"area hall: debounce\.to_blocked: Expected `int` >= 1"),
        ({"to_clear": "five"}, r"area hall: debounce\.to_clear: Expected `int`"),
        ({"rule": 7}, r"area hall: debounce\.rule"),
    ],
)
def test_a_debounce_rule_that_cannot_be_used_is_refused_by_area_field_and_what_there_is(choice, words):
    with pytest.raises(DebounceError, match=words):
        Rig(site("n1"), debounce=choice)
    with pytest.raises(DebounceError, match=words):
        AreaFusion([area(debounce=choice)], [], 1, registry=find_rule)


class Patient:
    """Settles what readings have said for `seconds` on end."""

    class Options(msgspec.Struct):
        seconds: float

    def __init__(self, options: Options) -> None:
        self.seconds, self.state, self.since = options.seconds, None, 0.0

    def feed(self, state: str, at: float) -> str | None:
        if state != self.state:
            self.state, self.since = state, at
        return state if at - self.since >= self.seconds else None

    def reset(self) -> None:
        self.state = None


def test_a_rule_may_judge_by_time():
    definition = area("n1", debounce={"seconds": 1.0})
    factory = RuleFactory(options=Patient.Options, make=Patient)
    fusion = AreaFusion(
        [definition], [site("n1")], 1, registry={"patient": factory}.__getitem__, default_rule="patient"
    )
    for seq, now in enumerate((100.0, 100.5, 100.99, 101.0)):
        assert fusion.hazards() == [] or fusion.hazards()[0].state == "unknown"
        reading = NodeReading(seq=seq, boot=1, uptime_ms=0, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked")
        fusion.on_reading("n1", reading, now, now)
    assert fusion.hazards()[0].state == "blocked"


# --- Invariants -----------------------------------------------------------------------------------------------------

EVENT = st.sampled_from(["clear", "blocked", "no_echo", "lie", "wait", "offline", "duplicate"])


@given(st.lists(EVENT, max_size=120))
@settings(max_examples=150, deadline=None)
def test_nothing_but_a_row_of_clear_readings_ever_clears_a_blocked_area(events):
    rig = Rig(site("n1", no_echo_is_clear=False))
    rig.read(0.8, 3.0, times=5)
    row = 0
    for event in events:
        if event == "clear":
            rig.read(3.0, 3.0)
            row += 1
        elif event == "blocked":
            rig.read(0.8, 3.0)
            row = 0
        elif event == "no_echo":
            rig.read(None, 3.0, state="unknown")
            row = 0
        elif event == "lie":
            rig.read(0.8, 3.0, state="clear")
            row = 0
        elif event == "wait":
            rig.wait(3.5)
            row = 0
        elif event == "offline":
            rig.seen += rig.core.on_availability("n1", online=False, now=rig.now, stamp=rig.now)
        else:
            rig.seq -= 1
            rig.read(3.0, 3.0)
        if row >= 5:
            break
        assert rig.hazard.penalty == 254
    seqs = [h.seq for h in rig.seen]
    assert seqs == sorted(set(seqs))
    assert all((a.state, a.penalty, a.cause) != (b.state, b.penalty, b.cause) for a, b in itertools.pairwise(rig.seen))
