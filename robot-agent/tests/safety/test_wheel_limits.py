"""The limits of the wheels by hand: caps, ramps and immediate stops, at their very values."""

from __future__ import annotations

import math

import pytest

from robot_agent.safety.gate import SafetyOutputs, limit_wheels, ramp_down


def limited(requested, last, *, cap=0.3, stop="none", dt=0.125, acceleration=2.0):
    outputs = SafetyOutputs(mode="NORMAL", reasons=(), cap=cap, stop=stop, changed=False, refusal=None)
    return limit_wheels(requested, last, outputs, dt, acceleration=acceleration, wheel_speed=0.5)


def test_immediate_stop_needs_no_ramp() -> None:
    assert limited((0.3, 0.3), (0.3, 0.2), stop="immediate") == (0.0, 0.0)


def test_ramp_slows_the_faster_wheel_of_a_base_of_0_5_m_s_by_1_m_s2_and_keeps_the_arc() -> None:
    assert limited((0.5, 0.5), (0.5, 0.25), stop="ramp", dt=0.25) == pytest.approx((0.25, 0.125))
    assert limited((0.5, 0.5), (-0.25, -0.5), stop="ramp", dt=0.25) == pytest.approx((-0.125, -0.25))
    assert limited((0.5, 0.5), (0.25, 0.125), stop="ramp", dt=0.25) == (0.0, 0.0)


@pytest.mark.parametrize("requested", [(math.nan, 0.3), (0.3, math.nan), (math.inf, 0.3), (0.3, -math.inf)])
def test_speed_that_is_no_number_ramps_down_like_a_hold(requested) -> None:
    assert limited(requested, (0.5, 0.25), dt=0.25) == pytest.approx((0.25, 0.125))


@pytest.mark.parametrize(
    ("requested", "cap", "expected"),
    [
        ((0.25, 0.35), 0.3, (0.25, 0.35)),
        ((0.4, 0.4), 0.3, (0.3, 0.3)),
        ((-0.4, -0.4), 0.3, (-0.3, -0.3)),
        ((0.3, 0.1), 0.1, (0.15, 0.05)),
        ((0.4, -0.4), 0.0, (0.4, -0.4)),
        ((0.6, -0.3), 0.3, (0.5, -0.25)),
        ((-0.3, 0.6), 0.3, (-0.25, 0.5)),
        ((1.0, 0.6), 0.8, (0.5, 0.3)),
    ],
)
def test_cap_holds_for_the_middle_of_the_axle_and_wheel_speed_for_each_wheel(requested, cap, expected) -> None:
    assert limited(requested, (0.0, 0.0), cap=cap, acceleration=100.0) == pytest.approx(expected)


def test_wheels_change_together_by_acceleration_at_most() -> None:
    assert limited((0.5, 0.25), (0.0, 0.0), cap=0.5) == pytest.approx((0.25, 0.125))
    assert limited((0.1, 0.5), (0.3, 0.0), cap=0.5) == pytest.approx((0.2, 0.25))
    assert limited((0.1, 0.0), (0.3, 0.5), cap=0.5) == pytest.approx((0.2, 0.25))
    assert limited((0.25, 0.125), (0.0, 0.0)) == (0.25, 0.125)
    assert limited((0.2, 0.125), (0.0, 0.0)) == (0.2, 0.125)


@pytest.mark.parametrize("dt", [0.0, -1.0])
def test_no_time_changes_no_wheel(dt) -> None:
    assert limited((0.3, 0.3), (0.1, 0.2), dt=dt) == pytest.approx((0.1, 0.2))
    assert ramp_down((0.1, 0.2), dt, 1.0) == pytest.approx((0.1, 0.2))


def test_speed_that_is_already_wanted_stays_without_time() -> None:
    assert limited((0.1, 0.2), (0.1, 0.2), dt=0.0) == (0.1, 0.2)


def test_wheels_at_rest_stay_there() -> None:
    assert ramp_down((0.0, 0.0), 0.05, 1.0) == (0.0, 0.0)
    assert ramp_down((0.0, 0.0), 0.0, 1.0) == (0.0, 0.0)
    assert ramp_down((1e-9, 0.0), 0.0, 1.0) == (0.0, 0.0)
    assert ramp_down((0.0, -2e-9), 0.0, 1.0) == pytest.approx((0.0, -2e-9), rel=1e-6)
