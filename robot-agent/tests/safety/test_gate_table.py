"""Every condition (`gate_rows`) in every mode: which mode follows, when it is left, and who must act."""

from __future__ import annotations

import itertools
import math
import re
from pathlib import Path

import pytest
from gate_rows import CAP, RANK, ROWS, STOP, TO, Gate, inputs

from fog_contracts.messages import ReasonCode
from robot_agent.bases.diffdrive.driver import DiffDriveFault
from robot_agent.bases.roomba600.driver import RoombaFault
from robot_agent.config import SafetyConfig
from robot_agent.guardian.base import FaultCode
from robot_agent.safety.conditions import CONDITIONS, Finding, Level, collect_findings
from robot_agent.safety.gate import MODE_OF, SafetyState, step
from robot_agent.safety.maneuver import RULES


def test_every_row_of_the_table_is_listed_here():
    covered = set()
    for row in ROWS:
        covered |= {i for i, c in enumerate(CONDITIONS) if c.holds(inputs(**row.holds), SafetyConfig())}
    covered |= {i for i, c in enumerate(CONDITIONS) if c.holds(inputs(map_loaded=False), SafetyConfig())}
    assert covered == set(range(len(CONDITIONS)))


def test_safety_document_lists_every_identifier_once_and_each_condition_with_its_mode():
    text = (Path(__file__).parents[3] / "docs" / "safety.md").read_text("utf-8")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| `")]
    listed = [name for row in rows for name in re.findall("`([a-z_]+)`", row[0])]
    assert sorted(listed) == sorted(ReasonCode)
    modes = {row[0].strip("| `"): row[1] for row in rows}
    expected = {c.code: MODE_OF[c.level] + (", operator" if c.operator else "") for c in CONDITIONS}
    assert {code: modes[code] for code in expected} == expected


def test_safety_document_names_each_fault_of_the_guardian_and_of_the_bases():
    text = (Path(__file__).parents[3] / "docs" / "safety.md").read_text("utf-8")
    section = text.partition("## Guardian and watchdog")[2].partition("\n- ")[0]
    for code in (*FaultCode, *RoombaFault, *DiffDriveFault):
        assert f"`{code}`" in section


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
@pytest.mark.parametrize("before", ["INIT", "NORMAL", "DEGRADED", "HOLD", "PROTECTIVE_STOP", "FAULT"])
def test_mode_after_a_condition_begins_and_after_it_ends(before, row):
    holds, mode, operator, words = row.holds, row.mode, row.left == "operator", row.words
    gate = Gate(before)
    out = gate.run(**holds)
    stays = before == "FAULT" or (before == "INIT" and mode != "FAULT") or RANK.get(before, 0) > RANK[mode]
    after = before if stays else mode
    assert out.mode == after
    assert out.changed == (after != before)
    assert (out.cap, out.stop) == (CAP[after], STOP[after])
    assert any(words in reason for reason in out.reasons)
    # The condition ends: the mode relaxes after 2 s, unless an operator must act.
    assert gate.run(1.9).mode == after
    relaxed = gate.run(0.3).mode
    if after == "FAULT":
        assert relaxed == "FAULT"
        assert gate.run(request="reset").mode == "INIT"
    elif before == "INIT":
        assert relaxed == "INIT"
    elif operator:
        assert relaxed == "PROTECTIVE_STOP"
        assert any(reason.endswith("(an operator must enable again)") for reason in gate.out.reasons)
        assert gate.run(request="enable").refusal is None
        assert gate.run(2.2).mode == "NORMAL"
    else:
        assert relaxed == "NORMAL"


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_condition_holds_beyond_its_limit_and_not_at_it(row):
    gate = Gate()
    assert gate.run(**(row.not_yet or {})).mode == "NORMAL"
    assert gate.run(**row.holds).mode == row.mode


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
def test_enable_is_refused_by_conditions_that_stop_at_once_and_by_no_other(row):
    gate = Gate("INIT")
    out = gate.run(request="enable", **row.holds)
    if RANK[row.mode] >= 3:
        assert out.mode == ("FAULT" if row.mode == "FAULT" else "INIT")
        assert out.refusal.code == "cause_remains"
        assert row.words in out.refusal
        assert set(out.refusal.causes) <= {reason.code for reason in out.reasons}
    else:
        assert out.refusal is None
        assert out.mode == row.mode


def test_missing_map_holds_and_refuses_an_enable():
    gate = Gate()
    out = gate.run(map_loaded=False)
    assert (out.mode, out.reasons) == ("HOLD", ("no map was received yet",))
    gate = Gate("INIT")
    assert gate.run(request="enable", map_loaded=False).refusal == "the cause is still there: no map was received yet"


def test_findings_come_with_level_and_operator_in_order_of_the_table():
    found = collect_findings(inputs(bumper=True, localization="lost", map_gap=2.0), SafetyConfig())
    assert found == [
        Finding(Level.FAULT, "the bumper is pressed"),
        Finding(Level.PROTECTIVE_STOP, "the pose is lost", operator=True),
        Finding(Level.HOLD, "changes of the map have been missing for 2.0 s", about_map=True),
    ]
    out = Gate().run(caution="slow here", map_gap=2.0, lidar_age=1.0)
    assert [reason.code for reason in out.reasons] == ["lidar_silent", "map_gap", "area_unknown"]


@pytest.mark.parametrize("field", ["lidar_age", "scan_age", "base_age", "map_age", "map_gap", "plan_age"])
def test_age_that_is_no_number_counts_as_too_old(field):
    assert RANK[Gate().run(**{field: math.nan}).mode] >= (1 if field == "plan_age" else 2)


# --- requests in every mode ---


@pytest.mark.parametrize("before", ["INIT", "NORMAL", "DEGRADED", "HOLD", "PROTECTIVE_STOP", "FAULT"])
def test_disable_leads_to_init_from_every_mode_but_fault(before):
    out = Gate(before).run(request="disable")
    assert out.refusal is None
    assert out.mode == ("FAULT" if before == "FAULT" else "INIT")
    assert out.cap == 0.0


@pytest.mark.parametrize("before", ["INIT", "NORMAL", "DEGRADED", "HOLD", "PROTECTIVE_STOP"])
def test_reset_without_a_fault_is_refused_and_changes_nothing(before):
    gate = Gate(before)
    out = gate.run(request="reset", **(TO[before] or {}))
    assert out.mode == before
    assert out.refusal.code == "no_fault"


def test_reset_of_a_fault_needs_its_cause_gone_and_leads_to_init():
    gate = Gate("FAULT")
    latched = gate.run(request="enable").refusal
    assert latched == "a fault is latched, reset it first: the bumper is pressed"
    assert (latched.code, latched.causes) == ("fault_latched", ("bumper",))
    refused = gate.run(request="reset", bumper=True, cliff=True).refusal
    assert refused == "the cause is still there: the bumper is pressed; a cliff sensor sees no floor"
    assert (refused.code, refused.causes) == ("cause_remains", ("bumper", "cliff"))
    assert gate.run(1.0).reasons == ("the bumper is pressed",)
    assert gate.run(cliff=True).reasons == ("the bumper is pressed", "a cliff sensor sees no floor")
    accepted = gate.run(request="reset", base_fault="the bumper is pressed (left)")
    assert (accepted.mode, accepted.refusal) == ("INIT", None)
    assert gate.run(5.0).reasons == ("waiting for an operator to enable",)


@pytest.mark.parametrize("fault", [{"bumper": True}, {"cliff": True}, {"wheel_drop": True}, {"base_fault": "x"}])
def test_fault_before_the_first_enable_is_latched_and_an_enable_says_that_it_needs_a_reset(fault):
    gate = Gate("INIT")
    assert gate.run(**fault).mode == "FAULT"
    assert gate.run(60.0, **fault).mode == "FAULT"
    assert gate.run(60.0).mode == "FAULT"
    assert gate.run(request="enable").refusal.code == "fault_latched"
    assert gate.run(request="disable").mode == "FAULT"
    accepted = gate.run(request="reset")
    assert (accepted.mode, accepted.refusal) == ("INIT", None)
    assert gate.run(60.0).mode == "INIT"
    assert gate.run(request="enable").refusal is None


def test_fault_whose_reset_the_guardian_has_not_carried_out_yet_is_not_latched_anew():
    gate = Gate("INIT")
    assert gate.run(base_fault="blocked").mode == "FAULT"
    assert gate.run(request="reset", base_fault="blocked").mode == "INIT"
    out = gate.run(5.0, base_fault="blocked")
    assert (out.mode, out.reasons) == ("INIT", ("base: blocked", "waiting for an operator to enable"))
    assert gate.run(request="enable", base_fault="blocked").refusal == "the cause is still there: base: blocked"
    assert gate.run().mode == "INIT"
    assert gate.run(base_fault="blocked").mode == "FAULT", "the guardian has latched it again after the reset"


def test_other_fault_after_a_reset_is_latched_even_before_the_guardian_has_carried_it_out():
    for later in ({"base_fault": "silent"}, {"base_fault": "blocked", "cliff": True}):
        gate = Gate("FAULT")
        assert gate.run(request="reset", base_fault="blocked").mode == "INIT"
        assert gate.run(**later).mode == "FAULT"


def test_silence_of_a_base_that_has_not_moved_is_no_fault_of_a_robot_that_is_not_enabled():
    silent = {"base_fault": "silent", "base_fault_passing": True}
    gate = Gate("INIT")
    assert gate.run(5.0, **silent).mode == "INIT"
    assert gate.run(request="enable", **silent).refusal == "the cause is still there: base: silent"
    assert gate.run(cliff=True, **silent).mode == "FAULT"
    assert gate.state.latched == (Finding(Level.FAULT, "a cliff sensor sees no floor"),)
    assert Gate("NORMAL").run(**silent).mode == "FAULT"


def test_bumper_that_the_dock_presses_is_no_fault():
    assert Gate("INIT").run(5.0, bumper=True, docked_for=0.0).mode == "INIT"
    assert Gate("NORMAL").run(5.0, bumper=True, docked_for=0.0, mission=False).mode == "HOLD"


def test_enabled_again_after_a_reset_the_old_fault_counts_no_more():
    gate = Gate("FAULT")
    gate.run(request="reset")
    out = gate.run(request="enable")
    assert (out.refusal, out.mode) == (None, "PROTECTIVE_STOP")  # healthy for 2 s first
    assert gate.run(2.0).mode == "NORMAL"


# --- driving by hand ---


def mode_by_hand(*rows) -> str:
    """Return the mode of a robot that is driven by hand, while these conditions hold."""
    names = {row.name for row in rows}
    if "bumper" in names and any("docked_for" in row.holds for row in rows):
        return "INIT" if any(row.name != "bumper" and row.by_hand == "ends" for row in rows) else "TELEOP"
    if "at rest" in names and all(row.by_hand != "ends" or row.name in OF_REST for row in rows):
        return "waits"  # for its lidar: it rests
    if any(row.mode == "FAULT" for row in rows):
        return "FAULT"
    return "INIT" if any(row.by_hand == "ends" for row in rows) else "TELEOP"


OF_REST = {"lidar silent", "scan lost", "scans repeat", "scans are empty", "wheels held", "wheels held on the dock"}


def pairs_of_conditions():
    """Yield each condition alone, and each two that can hold at once."""
    for one, other in itertools.combinations_with_replacement(ROWS, 2):
        if all(other.holds.get(name, value) == value for name, value in one.holds.items()):
            yield one, other


def test_driving_by_hand_heeds_base_and_lidar_alone_and_never_leads_to_a_drive_by_itself():
    tried = 0
    for one, other in pairs_of_conditions():
        expected, gate = mode_by_hand(one, other), Gate("TELEOP")
        out = gate.run(**one.holds, **{name: v for name, v in other.holds.items() if name not in one.holds})
        mode = "INIT" if expected == "waits" else expected
        case = f"{one.name}, {other.name}: {out.reasons}"
        assert (out.mode, out.cap, out.stop) == (mode, CAP[mode], STOP[mode]), case
        assert (gate.state.maneuver is not None) == (expected in {"TELEOP", "waits"}), case
        if expected == "INIT":
            assert any(reason.startswith("driving by hand ended: ") for reason in out.reasons), case
        # The conditions end: whoever drove drives on, or the robot waits for an operator.
        assert gate.run(5.0).mode == ("TELEOP" if expected == "waits" else mode), case
        assert not gate.state.enabled, case
        tried += 1
    assert tried > 400


@pytest.mark.parametrize("row", ROWS, ids=[row.name for row in ROWS])
@pytest.mark.parametrize("before", ["INIT", "NORMAL", "DEGRADED", "HOLD", "PROTECTIVE_STOP", "FAULT"])
def test_take_over_in_every_mode_is_refused_by_conditions_that_would_end_it_and_by_no_other(before, row):
    gate = Gate(before)
    out = gate.run(request="teleop", **row.holds)
    if before == "FAULT":
        assert (out.mode, out.refusal.code) == ("FAULT", "fault_latched")
    elif row.by_hand in {"ends", "not begun"}:
        assert out.refusal.code == ("on_dock" if "docked_for" in row.holds else "must_not_move")
        assert "docked_for" in row.holds or row.words in out.refusal
        assert out.mode != "TELEOP"
        assert gate.state.maneuver is None
    else:
        assert (out.refusal, out.mode) == (None, "INIT" if row.by_hand == "waits" else "TELEOP")
        assert not gate.state.enabled


@pytest.mark.parametrize(
    ("request_", "code"),
    [("enable", "maneuver_runs"), ("reset", "no_fault"), *[(kind, "maneuver_runs") for kind in RULES]],
)
def test_request_while_the_robot_is_driven_by_hand_is_refused_and_changes_nothing(request_, code):
    gate = Gate("TELEOP")
    out = gate.run(request=request_)
    assert (out.mode, out.refusal.code) == ("TELEOP", code)
    assert gate.run(1.0).mode == "TELEOP"


@pytest.mark.parametrize("ends", [{"request": "disable"}, {"hand_over": "it was handed back"}])
def test_robot_that_is_handed_back_waits_in_init_for_an_enable_whatever_it_did_before(ends):
    gate = Gate("TELEOP")
    assert not gate.out.mission_may_drive
    out = gate.run(**ends)
    assert (out.mode, out.stop, out.cap) == ("INIT", "immediate", 0.0)
    assert gate.run(60.0).mode == "INIT"
    assert gate.run(request="enable").refusal is None
    assert gate.run(2.2).mode == "NORMAL"


# --- durations ---


def test_hold_of_sixty_seconds_needs_an_operator_and_a_shorter_one_does_not():
    gate = Gate()
    gate.run(57.8, path_problem="x")
    assert gate.run(2.1).mode == "NORMAL"
    gate.run(59.9, path_problem="x")
    assert not any("operator" in reason for reason in gate.out.reasons)
    gate.run(0.2, path_problem="x")
    held = "stopped for more than 60 s, an operator must enable again (x)"
    assert gate.out.reasons == ("x", f"{held} (an operator must enable again)")
    assert gate.run(30.0).mode == "HOLD"
    assert gate.run(request="enable", path_problem="x").refusal == "the cause is still there: x"
    assert gate.run(request="enable").refusal is None
    assert gate.run(2.1).mode == "NORMAL"


def test_sixty_seconds_begin_anew_after_driving():
    gate = Gate()
    for _ in range(3):
        gate.run(40.0, path_problem="x")
        assert gate.run(2.1).mode == "NORMAL"
        gate.run(1.0)
    assert gate.state.latched == ()


def test_third_protective_stop_in_sixty_seconds_is_a_fault_and_the_time_slides():
    gate = Gate()
    for pause in (29.5, 31.0, 29.0):
        assert gate.run(lidar_age=9.0).mode == "PROTECTIVE_STOP"
        assert gate.run(pause).mode == "NORMAL"
    assert gate.run(lidar_age=9.0).mode == "PROTECTIVE_STOP"
    assert gate.run(2.2).mode == "NORMAL"
    out = gate.run(lidar_age=9.0)
    assert out.mode == "FAULT"
    assert out.reasons[0].startswith("3 protective stops within 60 s, the last because: the lidar has been silent")


def test_longer_protective_stop_counts_once():
    gate = Gate()
    assert gate.run(40.0, lidar_age=9.0).mode == "PROTECTIVE_STOP"
    assert gate.run(2.2).mode == "NORMAL"
    assert len(gate.state.stops) == 1


def test_hold_for_the_map_waits_for_a_plan_that_is_newer_than_the_map():
    gate = Gate()
    gate.run(1.0, map_gap=2.0)
    assert gate.run(plan_age=0.06).reasons[0] == "waiting for a plan on the fresh map"
    assert gate.run(5.0, plan_age=1.4 + 5.0).mode == "HOLD"
    assert gate.run(2.1, plan_age=0.0).mode == "NORMAL"
    gate.run(1.0, map_gap=2.0)
    assert gate.run(2.1, mission=False, plan_age=100.0).mode == "NORMAL"


def test_reason_of_the_last_escalation_is_told_until_the_mode_relaxes():
    gate = Gate()
    gate.run(lidar_age=0.5)
    assert gate.run(1.0).reasons == ("over, waiting until healthy for 2 s: the lidar has been silent for 0.5 s",)
    gate.run(0.5, localization="weak")
    assert gate.out.reasons == ("the pose is uncertain",)
    assert gate.run(0.6).mode == "DEGRADED"


def test_second_condition_for_an_operator_is_not_added_to_a_stop_that_waits_for_one():
    gate = Gate()
    gate.run(inside_blocked="the zone x")
    gate.run(inside_blocked="the zone x", localization="lost")
    assert [finding.reason for finding in gate.state.latched] == ["the robot is in the zone x"]


def test_disable_forgets_latches_and_stops():
    gate = Gate()
    gate.run(inside_blocked="the zone x")
    gate.run(request="disable")
    assert (gate.state.latched, gate.state.stops, gate.state.enabled) == ((), (), False)
    assert gate.run(request="enable").refusal is None


def at_moments(*steps: tuple[float, dict]) -> list:
    """Enable a robot that has been healthy before t = 100, then run the steps at exact times; return their outputs."""
    state, outputs = SafetyState(), []
    before = [(97.0 + 0.25 * number, {"request": "enable"} if number == 0 else {}) for number in range(12)]
    for now, changes in (*before, *steps):
        state, out = step(state, inputs(**{"plan_age": 0.125, **changes}), now)
        outputs.append(out)
    assert outputs[11].mode == "NORMAL"
    return outputs[12:]


@pytest.mark.parametrize(("plan_age", "waits"), [(1.0, True), (1.0625, True), (0.9375, False)])
def test_plan_of_the_moment_at_which_the_map_was_still_missing_is_not_newer(plan_age: float, *, waits: bool) -> None:
    out = at_moments((100.0, {"map_gap": 2.0}), (101.0, {"plan_age": plan_age}))[-1]
    assert ("waiting for a plan on the fresh map" in out.reasons) == waits


def test_mode_is_relaxed_at_2_s_and_not_before() -> None:
    late, relaxed = at_moments((100.0, {"caution": "slow"}), (101.9375, {}), (102.0, {}))[1:]
    assert (late.mode, relaxed.mode) == ("DEGRADED", "NORMAL")
    assert late.reasons == ("over, waiting until healthy for 2 s: slow",)
    assert relaxed.reasons == ()


def test_hold_needs_an_operator_at_60_s_and_not_before() -> None:
    blocked = {"path_problem": "blocked"}
    before, at = at_moments((100.0, blocked), (159.9375, blocked), (160.0, blocked))[1:]
    assert before.reasons == ("blocked",)
    assert at.reasons[1].startswith("stopped for more than 60 s, an operator must enable again (blocked)")


@pytest.mark.parametrize(("third", "mode"), [(159.9375, "FAULT"), (160.0, "PROTECTIVE_STOP")])
def test_protective_stop_counts_for_60_s_and_not_at_60_s(third: float, mode: str) -> None:
    silent = {"lidar_age": 9.0}
    steps = [(100.0, silent), (102.5, {}), (130.0, silent), (132.5, {}), (159.0, {}), (third, silent)]
    assert at_moments(*steps)[-1].mode == mode


def test_stop_in_a_zone_after_a_long_hold_stays_a_stop_and_is_enabled_without_either_cause() -> None:
    blocked, inside = {"path_problem": "blocked"}, {"inside_blocked": "the zone x"}
    steps = [(100.0, blocked), (160.0, blocked), (161.0, {**blocked, **inside}), (164.0, blocked)]
    stopped, refused = at_moments(*steps, (164.5, {**blocked, "request": "enable"}))[-2:]
    assert stopped.mode == "PROTECTIVE_STOP"
    assert refused.refusal == "the cause is still there: blocked"
    assert at_moments(*steps, (164.5, {"request": "enable"}))[-1].refusal is None


RESTING = {"resting": "at rest", "lidar_age": 700.0, "scan_age": 700.0, "identical_scans": 3, "empty_scans": 9}


def test_resting_robot_holds_without_a_stop_and_needs_no_operator_afterwards():
    gate = Gate()
    out = gate.run(100.0, **RESTING)
    assert (out.mode, out.reasons, gate.state.latched, gate.state.stops) == ("HOLD", ("at rest",), (), ())
    assert gate.run(2.1).mode == "NORMAL"
    assert Gate("INIT").run(request="enable", **RESTING).refusal is None


def test_silent_lidar_of_a_robot_that_does_not_rest_is_a_stop():
    assert Gate().run(**{**RESTING, "resting": None}).mode == "PROTECTIVE_STOP"
