"""The safety gate: the effect of each finding, and invariants of every reachable state."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.config import SafetyConfig
from robot_agent.safety import gate as gate_module
from robot_agent.safety.conditions import Level, SafetyInputs, collect_findings
from robot_agent.safety.gate import SafetyOutputs, SafetyState, limit_wheels, ramp_down, step

CONFIG = SafetyConfig()
DT = 0.05
HEALTHY = {
    "map_loaded": True,
    "map_age": 0.1,
    "localization": "good",
    "lidar_age": 0.02,
    "scan_age": 0.1,
    "base_age": 0.02,
}


def inputs(**changes) -> SafetyInputs:
    return SafetyInputs(**{**HEALTHY, **changes})


class Gate:
    def __init__(self) -> None:
        self.state = SafetyState()
        self.now = 100.0
        self.out: SafetyOutputs | None = None

    def run(self, seconds: float = DT, **changes) -> SafetyOutputs:
        for _ in range(max(1, round(seconds / DT))):
            self.now += DT
            self.state, self.out = step(self.state, inputs(**changes), self.now)
            changes.pop("request", None)
        assert self.out is not None
        return self.out

    def enabled(self) -> Gate:
        assert self.run(request="enable").refusal is None
        assert self.run(2.5).mode == "NORMAL"
        return self


def test_healthy_robot_stays_in_init_until_an_operator_enables_it():
    gate = Gate()
    out = gate.run(60.0)
    assert out.mode == "INIT"
    assert out.cap == 0.0
    assert out.reasons == ("waiting for an operator to enable",)


@pytest.mark.parametrize("changes", [{"map_age": 2.0}, {"map_gap": 2.0}, {"scan_age": 1.0}])
def test_mode_relaxes_after_two_seconds_without_findings(changes):
    gate = Gate().enabled()
    stopped = gate.run(DT, **changes).mode
    assert gate.run(1.5).mode == stopped
    assert gate.run(DT, **changes).mode == stopped
    assert gate.run(1.9).mode == stopped
    assert gate.run(0.2).mode == "NORMAL"


def test_mode_relaxes_to_the_worst_finding_of_the_last_two_seconds():
    gate = Gate().enabled()
    gate.run(DT, scan_age=1.0)
    gate.run(1.8, map_age=3.5)
    assert gate.run(0.3).mode == "HOLD"


def test_plan_from_before_a_missing_map_holds_the_robot_however_long_a_plan_may_be_silent():
    config, state, modes = replace(CONFIG, plan_late=60.0), Gate().enabled().state, []
    old, new = inputs(mission=True, plan_age=4.0), inputs(mission=True, plan_age=0.1)
    for tick, given_inputs in enumerate([inputs(map_age=4.0), *[inputs()] * 50, old, *[new] * 50], 4000):
        state, out = step(state, given_inputs, tick * DT, config)
        modes.append((out.mode, given_inputs))
    assert modes[0][0] == "HOLD"
    assert modes[50] == ("NORMAL", inputs())
    assert modes[51] == ("HOLD", old)
    assert modes[-1] == ("NORMAL", new)


LATE_STOPS = [
    ({"base_age": 0.31}, "no message from the guardian for 0.3 s"),
    (
        {"base_stopped": "no fresh command from the agent"},
        "the guardian holds the wheels: no fresh command from the agent",
    ),
    ({"lidar_age": 0.31}, "the lidar has been silent for 0.3 s"),
    ({"scan_age": 0.46}, "no complete scan of the lidar for 0.5 s"),
]


@pytest.mark.parametrize(("cause", "words"), LATE_STOPS)
def test_stops_that_only_a_late_computer_explains_are_no_fault_but_counted_and_told(cause, words):
    gate = Gate().enabled()
    for number in range(1, 6):
        out = gate.run(DT, **cause, late_age=0.5, late_by=0.42)
        assert (out.mode, out.stop, out.reasons) == (
            "PROTECTIVE_STOP", "immediate", (f"{words}; this computer was 0.4 s late",)
        )  # fmt: skip
        assert gate.run(1.9).mode == "PROTECTIVE_STOP"
        assert gate.run(0.3).mode == "NORMAL"
        assert (gate.state.late_stops, gate.state.stops) == (number, ())


@pytest.mark.parametrize("cause", [
    {"identical_scans": 3}, {"guardian_lost": "closed"}, {"base_stopped": "the base is on its charger"},
    {"lidar_age": 0.31, "identical_scans": 3},
])  # fmt: skip
def test_stop_for_another_cause_counts_however_late_the_computer_is(cause):
    gate = Gate().enabled()
    for _ in range(2):
        assert gate.run(DT, **cause, late_age=0.0, late_by=0.42).mode == "PROTECTIVE_STOP"
        assert gate.run(2.2).mode == "NORMAL"
    assert gate.run(DT, **cause, late_age=0.0, late_by=0.42).mode == "FAULT"
    assert gate.state.late_stops == 0


def test_stop_that_outlasts_the_delay_which_explains_it_counts_once():
    gate = Gate().enabled()
    for number in (1, 2):
        gate.run(DT, lidar_age=0.4, late_age=0.5, late_by=0.4)
        assert gate.run(3.0, lidar_age=0.9, late_age=0.51).mode == "PROTECTIVE_STOP"
        assert len(gate.state.stops) == number
        assert gate.run(2.2).mode == "NORMAL"
    gate.run(DT, lidar_age=0.4, late_age=0.5, late_by=0.4)
    assert gate.run(DT, lidar_age=0.9, late_age=0.51).mode == "FAULT"


def test_excused_stop_before_a_disable_excuses_and_counts_nothing_later():
    gate = Gate().enabled()
    gate.run(DT, lidar_age=0.4, late_age=0.1, late_by=0.4)
    gate.run(DT, request="disable")
    gate.run(2.2)
    gate.run(DT, request="enable")
    assert gate.run(DT, lidar_age=0.4).mode == "PROTECTIVE_STOP"
    assert (len(gate.state.stops), gate.state.late_stops) == (1, 1)


AGES = st.sampled_from([0.0, 0.2, 0.35, 0.5, 1.2, 2.0, 3.5, math.inf])
CHANGES = st.fixed_dictionaries(
    {},
    optional={
        "map_loaded": st.booleans(),
        "map_age": AGES,
        "map_gap": AGES,
        "localization": st.sampled_from(["good", "weak", "lost", "none"]),
        "lidar_age": AGES,
        "scan_age": AGES,
        "identical_scans": st.integers(1, 4),
        "empty_scans": st.integers(0, 3),
        "base_age": AGES,
        "guardian_lost": st.sampled_from([None, "gone"]),
        "base_fault": st.sampled_from([None, None, None, "serial"]),
        "base_stopped": st.sampled_from([None, None, "stale"]),
        "bumper": st.sampled_from([False, False, False, True]),
        "cliff": st.sampled_from([False, False, False, True]),
        "wheel_drop": st.sampled_from([False, False, False, True]),
        "mission": st.booleans(),
        "plan_age": AGES,
        "released_remaining": st.sampled_from([0.0, 3.0]),
        "path_problem": st.sampled_from([None, "goal blocked"]),
        "inside_blocked": st.sampled_from([None, None, "zone x"]),
        "caution": st.sampled_from([None, "unknown"]),
    },
)
EPISODE = st.tuples(
    CHANGES,
    st.sampled_from([None, None, "enable", "enable", "reset", "disable"]),
    st.sampled_from([1, 2, 10, 41]),
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(EPISODE, st.sampled_from([None, None, 0.0, 5.0])), max_size=10), st.floats(0.9, 1.1))
def test_step_that_changes_nothing_but_the_time_is_that_of_the_whole_gate(episodes, pace):
    whole, short, now, shortened = SafetyState(), SafetyState(), 100.0, 0
    healthy = ({}, "enable", 50, None), None
    for (changes, request, ticks, _), docked_for in [healthy, *episodes, healthy]:
        for tick in range(ticks):
            now += pace * DT
            given_inputs = inputs(**{**changes, "request": None if tick else request, "docked_for": docked_for})
            shortened += gate_module._goes_on(short, given_inputs, now, CONFIG) and not collect_findings(
                given_inputs, CONFIG
            )
            short, short_out = step(short, given_inputs, now)
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(gate_module, "_goes_on", lambda *_: False)
                whole, whole_out = step(whole, given_inputs, now)
            assert (short, short_out) == (whole, whole_out)
    assert shortened


@settings(max_examples=200, deadline=None)
@given(st.lists(EPISODE, max_size=10))
def test_invariants_of_every_reachable_state(episodes):  # noqa: C901  # one branch per invariant
    gate = Gate()
    wheels = (0.0, 0.0)
    levels: list[tuple[float, Level]] = []
    rank = {"NORMAL": 0, "DEGRADED": 1, "HOLD": 2, "PROTECTIVE_STOP": 3, "FAULT": 4}
    # The first episode enables a healthy robot, so that the others start from NORMAL.
    for changes, request, ticks, requested in [({}, "enable", 50, (0.3, 0.3)), *episodes]:
        for tick in range(ticks):
            current_request = request if tick == 0 else None
            given_inputs = inputs(**{**changes, "request": current_request})
            before = gate.state.mode
            was_enabled = gate.state.enabled
            gate.now += DT
            gate.state, out = step(gate.state, given_inputs, gate.now)
            findings = collect_findings(given_inputs, CONFIG)
            level = max((f.level for f in findings), default=Level.NORMAL)
            levels.append((gate.now, level))

            last = wheels
            wheels = limit_wheels(requested, wheels, out, DT, acceleration=2.5, wheel_speed=0.5)
            assert max(abs(wheels[0]), abs(wheels[1])) <= 0.5 + 1e-9
            assert abs(sum(wheels)) / 2 <= max(0.30, abs(sum(last)) / 2) + 1e-9
            assert out.cap <= 0.30
            if out.mode in {"INIT", "PROTECTIVE_STOP", "FAULT"}:
                assert wheels == (0.0, 0.0)
            if out.stop == "ramp":
                assert max(map(abs, wheels)) <= max(map(abs, last))
            # the mode is never less careful than what is found right now
            if out.mode in rank:
                assert rank[out.mode] >= min(level, 4)
                # ... nor than anything found in the last 2 s, unless an operator's enable or reset came between
                if before in rank:
                    recent = max(lv for when, lv in levels if gate.now - when < 2.0 - 1e-9)
                    if not (before == "INIT" or recent == Level.FAULT):
                        assert rank[out.mode] >= recent
            if before == "FAULT" and out.mode != "FAULT":
                assert current_request == "reset"
                assert out.refusal is None
                assert not (given_inputs.bumper)
                assert not (given_inputs.cliff)
                assert not (given_inputs.wheel_drop)
                assert out.mode == "INIT"
            if before == "INIT" and out.mode == "FAULT":
                assert level == Level.FAULT
            elif before == "INIT" and out.mode != "INIT":
                assert current_request == "enable"
                assert not was_enabled
                assert level < Level.PROTECTIVE_STOP
            if out.mode != "NORMAL":
                assert out.reasons
            if current_request == "enable" and out.refusal is not None:
                assert out.mode != "NORMAL"


def test_no_input_from_the_fog_raises_the_speed_cap():
    fog = {
        "map_loaded": [True, False],
        "map_age": [0.0, 2.0, 9.0],
        "map_gap": [0.0, 2.0],
        "mission": [True, False],
        "plan_age": [0.0, 2.0],
        "released_remaining": [0.0, 99.0],
        "path_problem": [None, "x"],
        "inside_blocked": [None, "x"],
        "caution": [None, "x"],
    }
    for values in itertools.product(*fog.values()):
        for own, allowed in (({}, 0.30), ({"localization": "weak"}, 0.15), ({"scan_age": 9.0}, 0.0)):
            gate = Gate().enabled()
            assert gate.run(DT, **{**dict(zip(fog, values, strict=True)), **own}).cap <= allowed


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_ramp_ends_within_half_a_second_and_keeps_the_arc(left, right):
    wheels = (left, right)
    for _ in range(10):
        after = ramp_down(wheels, DT, 0.5 / 0.5)
        assert math.isclose(after[0] * wheels[1], after[1] * wheels[0], abs_tol=1e-9)
        wheels = after
    assert wheels == (0.0, 0.0)


def test_nan_wheel_speeds_ramp_down_to_a_stop():
    gate = Gate().enabled()
    out = gate.run()
    wheels = (0.3, 0.3)
    for _ in range(10):
        wheels = limit_wheels((math.nan, 0.3), wheels, out, DT, acceleration=2.5, wheel_speed=0.5)
    assert wheels == (0.0, 0.0)
