"""From decisions to wheel commands, 20 a second: smooth, and fresh or at rest."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.agent.wheel_control import Limits, WheelControl, approach
from robot_agent.config import agent_config
from robot_agent.hardware import DriveTrain, LidarTraits
from robot_agent.motion.local_planner import Decision
from robot_agent.safety.gate import SafetyOutputs

DT = 0.05
LIMITS = Limits(acceleration=1.0, jerk=5.0)
speeds = st.floats(-0.5, 0.5)


@given(st.lists(st.tuples(speeds, st.integers(1, 12)), min_size=1, max_size=8))
def test_growth_is_limited_in_acceleration_and_jerk_and_never_overshoots(wishes):
    speed = rate = 0.0
    for wanted, steps in wishes:
        for _ in range(steps):
            before, rate_before = speed, rate
            speed, rate = approach(speed, wanted, rate, DT, LIMITS)
            change = speed - before
            assert abs(change) <= LIMITS.acceleration * DT + 1e-12
            assert min(before, wanted, 0.0) - 1e-12 <= speed <= max(before, wanted, 0.0) + 1e-12
            if abs(speed) > abs(before):
                assert abs(change) <= (max(abs(rate_before), 0.0) + LIMITS.jerk * DT) * DT + 1e-12


@given(speeds, speeds)
def test_every_speed_is_reached(begin, wanted):
    speed, rate = begin, 0.0
    for _ in range(60):
        speed, rate = approach(speed, wanted, rate, DT, LIMITS)
    assert speed == wanted


@given(st.floats(0.05, 0.5), st.floats(0.0, 1.0), st.floats(-1.0, 1.0))
def test_braking_begins_at_once_whatever_the_rate_before(speed, share, rate):
    slower, _ = approach(speed, share * speed, rate, DT, LIMITS)
    assert slower == pytest.approx(max(speed - LIMITS.acceleration * DT, share * speed))


def test_reversal_passes_through_standstill():
    assert approach(0.02, -0.3, 0.0, DT, LIMITS) == (0.0, 0.0)
    speed, rate = approach(0.0, -0.3, 0.0, DT, LIMITS)
    assert (speed, rate) == (pytest.approx(-LIMITS.jerk * DT**2), pytest.approx(-LIMITS.jerk * DT))


def test_start_from_rest_rises_and_levels_off_gently():
    speed, rate, track = 0.0, 0.0, [0.0]
    while speed < 0.3:
        speed, rate = approach(speed, 0.3, rate, DT, LIMITS)
        track.append(speed)
        assert len(track) < 16, f"0.3 m/s are not reached: {track}"
    steps = [after - before for before, after in pairwise(track)]
    assert steps[0] == pytest.approx(LIMITS.jerk * DT**2)
    assert max(steps) > 3.0 * steps[0]
    assert steps[-1] < max(steps)


CONFIG = agent_config(
    "r1", b"k" * 32, DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5),
    LidarTraits(range_min_m=0.15, range_max_m=12.0, scan_period_s=0.18),
    boot="b1",
)  # fmt: skip


def outputs(stop="none", cap=0.3):
    return SafetyOutputs(mode="NORMAL", reasons=(), cap=cap, stop=stop, changed=False, refusal=None)


def free(wheels, _now):
    return wheels


def decision(made_at=0.0, left=0.2, right=0.3):
    return Decision(plan_id=1, planner_epoch=1, made_at=made_at, left=left, right=right)


@pytest.fixture
def driving():
    control = WheelControl(CONFIG)
    for step in range(20):
        control.decision = decision(step * DT)
        control.command(outputs(), free, step * DT)
    assert control.speeds == pytest.approx((0.2, 0.3))
    return control


def test_commands_are_numbered_and_approach_the_decision_within_acceleration_and_jerk(driving):
    control, motion = WheelControl(CONFIG), CONFIG.motion
    control.decision = decision()
    first, second = control.command(outputs(), free, 0.0), control.command(outputs(), free, DT)
    assert (first.seq, first.left, first.right) == (1, 0.0, 0.0)
    assert second.seq == 2
    assert 0.5 * (second.left + second.right) == pytest.approx(motion.jerk_v * DT**2)
    assert (second.right - second.left) / motion.limits.axle == pytest.approx(motion.jerk_w * DT**2)
    assert driving.following


def test_robot_that_the_guard_slowed_down_starts_gently_again(driving):
    driving.decision = decision(1.0)
    driving.command(outputs(), lambda _wheels, _now: (0.0, 0.0), 1.0)
    command = driving.command(outputs(), free, 1.05)
    assert 0.5 * (command.left + command.right) == pytest.approx(CONFIG.motion.jerk_v * DT**2)


@pytest.mark.parametrize(
    ("stale", "stop"), [(False, "ramp"), (True, "none"), (True, "ramp")], ids=["held", "stale", "both"]
)
def test_hold_and_stale_decision_ramp_the_wheels_to_rest(driving, stale, stop):
    driving.decision = decision(0.0 - CONFIG.decision_max_age if stale else 1.0)
    before, now = driving.speeds, 20 * DT
    driving.command(outputs(stop), free, now)
    assert 0.0 < driving.speeds[1] < before[1]
    assert driving.speeds[0] / driving.speeds[1] == pytest.approx(before[0] / before[1])
    assert not driving.following
    while not driving.at_rest:
        now += DT
        assert now <= 20 * DT + CONFIG.safety.ramp, f"the wheels have not come to rest: {driving.speeds}"
        driving.command(outputs(stop), free, now)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("side", ["left", "right"])
def test_decision_whose_speed_is_no_number_never_moves_a_wheel(driving, side, wrong):
    standing, useless = WheelControl(CONFIG), decision(1.0, **{side: wrong})
    for step in range(10):
        standing.decision = driving.decision = useless
        before, now = driving.speeds, 1.0 + step * DT
        assert standing.command(outputs(), free, now).right == 0.0
        driving.command(outputs(), free, now)
        assert driving.speeds[1] < before[1] or driving.at_rest
        assert not driving.following
    assert standing.at_rest
    assert driving.at_rest


def test_protective_stop_sets_zero_speed_immediately(driving):
    driving.decision = decision(1.0)
    driving.command(outputs("immediate", cap=0.0), free, 1.0)
    assert driving.at_rest
    assert not driving.following


def test_speed_step_after_a_long_pause_is_limited():
    control = WheelControl(CONFIG)
    control.command(outputs(), free, 0.0)
    control.decision = decision(100.0, left=0.5, right=0.5)
    command = control.command(outputs(cap=0.5), free, 100.0)
    assert command.left <= CONFIG.motion.limits.acc_v * 0.2 + 1e-9


def test_reset_is_passed_on_once():
    control = WheelControl(CONFIG)
    control.pass_reset()
    assert [control.command(outputs(), free, step * DT).reset for step in range(3)] == [True, False, False]


def test_guard_limits_decisions_and_ramps_last(driving):
    driving.decision = decision(1.0)
    asked = []

    def half(wheels, now):
        asked.append((wheels, now))
        return wheels[0] / 2, wheels[1] / 2

    command = driving.command(outputs(), half, 1.0)
    assert (command.left, command.right) == driving.speeds == pytest.approx((0.1, 0.15))
    ramped = driving.command(outputs("ramp"), half, 1.05)
    assert asked[1][0][1] < 0.15
    assert ramped.right == asked[1][0][1] / 2
