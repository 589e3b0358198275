"""Speeds grow within acceleration and jerk, never beyond what was asked; braking has the acceleration's limit only."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.motion.smoothing import Limits, approach

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
