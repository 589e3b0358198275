"""Odometry of the last seconds: interpolation, extrapolation with a bound, speed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_kernels.scans import Mounting, placed
from robot_agent.localization.odometry_buffer import OdometryBuffer
from robot_agent.localization.pose import Pose2


def driven(v: float, w: float, *, until: float = 1.0) -> OdometryBuffer:
    """Odometry at 50 Hz of a robot that drives from (0, 0, 0) with these speeds."""
    buffer = OdometryBuffer()
    for at in np.arange(0.0, until + 1e-9, 0.02):
        x, y = (v * at, 0.0) if w == 0.0 else (v / w * math.sin(w * at), v / w * (1.0 - math.cos(w * at)))
        buffer.add(float(at), x, y, w * at)
    return buffer


@given(v=st.floats(-0.3, 0.3), w=st.floats(-2.0, 2.0).filter(lambda w: abs(w) > 0.01), at=st.floats(0.0, 1.0))
def test_pose_between_two_readings_lies_on_the_arc(v, w, at):
    pose = driven(v, w).pose(at)
    assert pose == pytest.approx((v / w * math.sin(w * at), v / w * (1.0 - math.cos(w * at)), w * at), abs=1e-4)


@given(
    times=st.lists(st.floats(0.0, 2.0), min_size=1, max_size=30),
    asked=st.lists(st.floats(-1.0, 4.0), min_size=1, max_size=10),
    seed=st.integers(0, 99),
)
def test_what_the_lidar_sees_is_placed_by_the_pose_of_its_time(times, asked, seed):
    rng = np.random.default_rng(seed)
    buffer = OdometryBuffer()
    for at in sorted(times):
        buffer.add(at, *rng.normal(size=3))
    ahead = Pose2(1.0, 0.0, 0.0)
    for at in asked:
        seen = placed(np.zeros(1), np.ones(1), at, at, buffer.track(at), Mounting(0.0, 0.0, 0.0), 0.0, 2.0)
        assert seen.points[0] == pytest.approx(buffer.pose(at).compose(ahead)[:2], abs=1e-9)


def test_twist_is_that_of_the_last_readings():
    assert driven(0.25, 0.8).twist() == pytest.approx((0.25, 0.8), abs=1e-3)
    assert driven(-0.1, 0.0).twist() == pytest.approx((-0.1, 0.0), abs=1e-6)


def test_pose_is_extrapolated_by_015_s_and_no_further():
    buffer = driven(0.3, 0.0)
    assert buffer.pose(1.1).x == pytest.approx(0.33)
    assert buffer.pose(9.0).x == buffer.pose(1.15).x == pytest.approx(0.345)


def test_the_newest_pose_is_that_of_the_last_reading_and_does_not_forget_the_pose_that_was_asked_for():
    buffer = driven(0.3, 0.5)
    asked = buffer.pose(1.1)
    assert buffer.latest() == driven(0.3, 0.5).pose(1.0)
    assert buffer.pose(1.1) is asked
    assert OdometryBuffer().latest() is None


def test_a_new_reading_changes_pose_and_twist_of_a_moment_that_was_asked_for_before():
    buffer = driven(0.3, 0.0)
    assert buffer.pose(1.1).x == pytest.approx(0.33)
    assert buffer.twist() == pytest.approx((0.3, 0.0))
    buffer.add(1.1, 0.3, 0.0, 0.0)
    assert buffer.pose(1.1).x == pytest.approx(0.3)
    assert buffer.twist()[0] < 0.25


def test_history_ends_after_three_seconds():
    buffer = driven(0.3, 0.0, until=8.0)
    assert buffer.reaches_back_to(5.1)
    assert not buffer.reaches_back_to(4.9)
    assert buffer.pose(1.0).x == pytest.approx(0.3 * 5.0, abs=0.01)


def test_reading_that_is_not_newer_is_ignored():
    buffer = driven(0.3, 0.0)
    before = buffer.latest()
    buffer.add(1.0, 9.0, 9.0, 9.0)
    buffer.add(0.5, 9.0, 9.0, 9.0)
    assert buffer.latest() == before


def test_empty_buffer_has_no_pose_and_zero_twist():
    buffer = OdometryBuffer()
    assert buffer.pose(1.0) is None
    assert buffer.latest() is None
    assert buffer.twist() == (0.0, 0.0)
    assert not buffer.reaches_back_to(1.0)
