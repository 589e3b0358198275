from __future__ import annotations

import math

import pytest

from robot_agent.agent.path.wheel_control import WheelControl
from robot_agent.config import agent_config
from robot_agent.hardware import DriveTrain, LidarTraits
from robot_agent.motion.local_planner import Decision
from robot_agent.safety.gate import SafetyOutputs

CONFIG = agent_config(
    "r1", b"k" * 32, DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5),
    LidarTraits(range_min_m=0.15, range_max_m=12.0, scan_period_s=0.18),
    boot="b1",
)  # fmt: skip
DT = 0.05


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


def test_guard_has_the_last_word_on_decisions_and_ramps(driving):
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
