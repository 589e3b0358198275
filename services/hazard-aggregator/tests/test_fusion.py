"""From readings to area states: debounce, silence, contradictions, fusion, restarts."""

import itertools

import msgspec
import pytest
from fusion_rig import PERIOD, SQUARE, Rig, area, measured, site
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, SonarStatus, UnknownPolicy
from hazard_aggregator.debounce import DebounceError, Observation, RuleFactory
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule


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
