"""The gate at the very moments at which a limit is reached, and with the values that it has before any input."""

from __future__ import annotations

import math

import pytest

from robot_agent.config import SafetyConfig
from robot_agent.safety.conditions import Finding, Level, SafetyInputs, collect_findings
from robot_agent.safety.gate import SafetyState, step

HEALTHY = {
    "map_loaded": True, "map_age": 0.1, "localization": "good", "lidar_age": 0.02, "scan_age": 0.1, "base_age": 0.02,
    "mission": True, "plan_age": 0.125, "released_remaining": 5.0,
}  # fmt: skip


def run(*steps: tuple[float, dict]) -> list:
    """Enable a robot that has been healthy before t = 100, then run the steps; return their outputs."""
    state, outputs = SafetyState(), []
    before = [(97.0 + 0.25 * number, {"request": "enable"} if number == 0 else {}) for number in range(12)]
    for now, changes in (*before, *steps):
        state, out = step(state, SafetyInputs(**{**HEALTHY, **changes}), now)
        outputs.append(out)
    assert outputs[11].mode == "NORMAL"
    return outputs[12:]


def test_agent_that_has_heard_nothing_yet_knows_nothing_good() -> None:
    nothing = SafetyInputs(
        map_loaded=False, map_age=math.inf, map_gap=0.0, localization="none", localization_detail="",
        lidar_age=math.inf, scan_age=math.inf, identical_scans=1, base_age=math.inf, guardian_lost=None,
        base_fault=None, base_stopped=None, bumper=False, cliff=False, wheel_drop=False, mission=False, plan_age=0.0,
        released_remaining=0.0, path_problem=None, inside_blocked=None, caution=None, request=None,
    )  # fmt: skip
    assert SafetyInputs() == nothing
    state = SafetyState()
    assert (state.mode, state.enabled, state.stops, state.latched) == ("INIT", False, (), ())
    assert state.last_demanded == (-math.inf,) * 5
    assert (state.map_held_at, state.stopped_since) == (-math.inf, math.inf)
    assert (state.reasons, state.last_reasons) == (("just started",), ())


def test_robot_that_lost_its_map_needs_a_newer_plan_than_the_map_it_got_then() -> None:
    outputs = run((100.0, {"map_loaded": False}), (102.5, {"plan_age": 2.5}), (102.75, {"plan_age": 2.5}))
    assert [out.mode for out in outputs] == ["HOLD", "HOLD", "HOLD"]
    assert outputs[1].reasons[0] == "waiting for a plan on the fresh map"


@pytest.mark.parametrize(("plan_age", "waits"), [(1.0, True), (1.0625, True), (0.9375, False)])
def test_plan_of_the_moment_at_which_the_map_was_still_missing_is_not_newer(plan_age: float, *, waits: bool) -> None:
    out = run((100.0, {"map_gap": 2.0}), (101.0, {"plan_age": plan_age}))[-1]
    assert ("waiting for a plan on the fresh map" in out.reasons) == waits


def test_silent_planner_is_one_finding_whatever_path_is_left() -> None:
    def findings(released: float) -> list[Finding]:
        return collect_findings(
            SafetyInputs(**{**HEALTHY, "plan_age": 2.0, "released_remaining": released}), SafetyConfig()
        )

    assert [finding.level for finding in findings(0.15)] == [Level.HOLD]
    assert [finding.level for finding in findings(0.1500001)] == [Level.DEGRADED]


# --- durations, at their very moments ---


def test_mode_is_relaxed_at_2_s_and_not_before() -> None:
    late, relaxed = run((100.0, {"caution": "slow"}), (101.9375, {}), (102.0, {}))[1:]
    assert (late.mode, relaxed.mode) == ("DEGRADED", "NORMAL")
    assert late.reasons == ("over, waiting until healthy for 2 s: slow",)
    assert relaxed.reasons == ()


def test_hold_needs_an_operator_at_60_s_and_not_before() -> None:
    blocked = {"path_problem": "blocked"}
    before, at = run((100.0, blocked), (159.9375, blocked), (160.0, blocked))[1:]
    assert before.reasons == ("blocked",)
    assert at.reasons[1].startswith("stopped for more than 60 s, an operator must enable again (blocked)")


@pytest.mark.parametrize(("third", "mode"), [(159.9375, "FAULT"), (160.0, "PROTECTIVE_STOP")])
def test_protective_stop_counts_for_60_s_and_not_at_60_s(third: float, mode: str) -> None:
    silent = {"lidar_age": 9.0}
    steps = [(100.0, silent), (102.5, {}), (130.0, silent), (132.5, {}), (159.0, {}), (third, silent)]
    assert run(*steps)[-1].mode == mode


def test_reason_of_a_stop_is_told_on_after_a_lesser_one_came_and_went() -> None:
    out = run((100.0, {"lidar_age": 0.5}), (100.5, {"caution": "slow"}), (101.0, {}))[-1]
    assert out.mode == "PROTECTIVE_STOP"
    assert out.reasons == ("over, waiting until healthy for 2 s: the lidar has been silent for 0.5 s",)


def test_stop_in_a_zone_after_a_long_hold_stays_a_stop_and_is_enabled_without_either_cause() -> None:
    blocked, inside = {"path_problem": "blocked"}, {"inside_blocked": "the zone x"}
    steps = [(100.0, blocked), (160.0, blocked), (161.0, {**blocked, **inside}), (164.0, blocked)]
    stopped, refused = run(*steps, (164.5, {**blocked, "request": "enable"}))[-2:]
    assert stopped.mode == "PROTECTIVE_STOP"
    assert refused.refusal == "the cause is still there: blocked"
    assert run(*steps, (164.5, {"request": "enable"}))[-1].refusal is None


def test_reset_changes_the_mode() -> None:
    out = run((100.0, {"bumper": True}), (101.0, {"request": "reset"}), (102.0, {}))
    assert [(each.mode, each.changed) for each in out] == [("FAULT", True), ("INIT", True), ("INIT", False)]
