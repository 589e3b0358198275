"""Odometry against geometry, wraps, faults and recorded drives; and the last seconds of it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_kernels.scans import Mounting, placed
from robot_agent.hardware import DriveTrain, WheelOdometry
from robot_agent.localization.odometry import (
    EncoderFault,
    Motion,
    Odometry,
    OdometryBuffer,
    OdometryState,
    Reading,
    advance,
    integrate,
    wheel_travel,
)
from robot_agent.localization.pose import Pose2

TICK_M = math.pi * 0.072 / 508.8
ROOMBA = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5, travel_wrap_m=65_536 * TICK_M)


def wheels(left: int, right: int) -> WheelOdometry:
    """Return the reading of 16-bit counters at these ticks."""
    return WheelOdometry(left_m=(left & 0xFFFF) * TICK_M, right_m=(right & 0xFFFF) * TICK_M)


@given(st.integers(0, 0xFFFF), st.integers(-0x7FFF, 0x7FFF))
def test_travel_between_two_readings_is_right_over_any_wrap(old, step):
    new = (old + step) & 0xFFFF
    assert wheel_travel(new * TICK_M, old * TICK_M, ROOMBA.travel_wrap_m) == pytest.approx(step * TICK_M, abs=1e-9)


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_a_counter_that_never_wraps_gives_the_plain_difference(old, new):
    assert wheel_travel(new, old, math.inf) == new - old


def test_the_twist_is_that_of_a_differential_drive():
    assert ROOMBA.twist(0.3, 0.3) == (0.3, 0.0)
    assert ROOMBA.twist(-0.235 / 2, 0.235 / 2) == (0.0, pytest.approx(1.0))


def ticks(metres: float) -> int:
    return round(metres / TICK_M)


def drive(steps: list[tuple[float, float]], left: int = 65500, right: int = 65500) -> Odometry:
    odometry = Odometry(ROOMBA)
    odometry.update(wheels(left, right), 0.0)
    for number in range(1, 101):
        l_sum = sum(step[0] for step in steps) * number / 100
        r_sum = sum(step[1] for step in steps) * number / 100
        odometry.update(wheels(left + ticks(l_sum), right + ticks(r_sum)), number * 0.1)
    return odometry


def test_the_first_reading_is_no_motion():
    odometry = Odometry(ROOMBA)
    assert odometry.update(wheels(40000, 123), 5.0) == Motion(0.0, 0.0, 0.0, 0.0, 0.0)


def test_known_arcs_end_where_geometry_says():
    # Straight, 90 degrees right about a point 1.1175 m aside, 90 degrees left about 2 m, a quarter turn on the spot.
    quarter = math.pi / 2
    cases = [
        ((0.2262, 0.2262), (0.2262, 0.0, 0.0)),
        ((1.235 * quarter, 1.0 * quarter), (1.1175, -1.1175, -quarter)),
        ((1.8825 * quarter, 2.1175 * quarter), (2.0, 2.0, quarter)),
        ((-0.1175 * quarter, 0.1175 * quarter), (0.0, 0.0, quarter)),
    ]
    for step, pose in cases:
        assert drive([step]).pose == pytest.approx(pose, abs=2e-3)


@given(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5),
    st.integers(1, 20),
)  # fmt: skip
def test_arc_is_the_same_in_any_number_of_pieces(x, y, theta, left, right, pieces):
    whole = integrate(x, y, theta, left, right, 0.235)
    pose = (x, y, theta)
    for _ in range(pieces):
        pose = integrate(*pose, left / pieces, right / pieces, 0.235)
    assert pose == pytest.approx(whole, abs=1e-9)


def test_an_impossible_jump_is_a_fault_and_moves_nothing():
    odometry = Odometry(ROOMBA)
    odometry.update(wheels(100, 100), 0.0)
    odometry.update(wheels(110, 110), 0.015)
    pose = odometry.pose
    fault = odometry.update(wheels(30000, 110), 0.030)
    assert isinstance(fault, EncoderFault)
    assert "jumped" in str(fault)
    assert odometry.pose == pose
    assert odometry.faults == 1


def test_one_wild_reading_loses_no_motion():
    odometry = Odometry(ROOMBA)
    odometry.update(wheels(100, 100), 0.0)
    odometry.update(wheels(30000, 500), 0.015)
    motion = odometry.update(wheels(120, 120), 0.030)
    assert isinstance(motion, Motion)
    assert odometry.pose[0] == pytest.approx(20 * TICK_M)


def test_restarted_base_is_trusted_from_its_second_reading_without_the_jump():
    odometry = Odometry(ROOMBA)
    odometry.update(wheels(20000, 20000), 0.0)
    assert isinstance(odometry.update(wheels(0, 0), 3.0), EncoderFault)
    assert isinstance(odometry.update(wheels(10, 10), 3.015), Motion)
    assert odometry.pose[0] == pytest.approx(10 * TICK_M)


def test_gap_in_which_the_counter_could_wrap_is_a_fault():
    odometry = Odometry(ROOMBA)
    odometry.update(wheels(0, 0), 0.0)
    assert isinstance(odometry.update(wheels(0, 0), 60.0), EncoderFault)


def test_top_speed_with_late_frames_is_no_fault():
    odometry = Odometry(ROOMBA)
    position, now = 0.0, 0.0
    for number in range(400):
        position += 0.5 * 0.015
        now = 0.06 * (number // 4)  # the host wakes every fourth frame and reads all four at once
        odometry.update(wheels(ticks(position), ticks(position)), now)
    assert odometry.faults == 0
    assert odometry.pose[0] == pytest.approx(399 * 0.5 * 0.015, abs=1e-3)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "columns", "unit"),
    [
        ("2018_Summer_DataTest2.txt", (0, 5, 6, 10, 9, 3), math.pi / 180),
        ("2019_Fall_Corner_finding_data.txt", (0, 1, 2, 3, 4, 5), 1.0),
    ],
)
def test_recorded_drives_end_at_their_recorded_pose(data_dir, name, columns, unit):
    lines = Path(data_dir / "roomba" / name).read_text().splitlines()
    rows = [[float(line.split(",")[c]) for c in columns] for line in lines if line[:1].isdigit()]
    assert len(rows) > 1000
    # The owner counts y and heading to the right.
    heading = -rows[0][5] * unit
    state = OdometryState(x=rows[0][3] / 1000, y=-rows[0][4] / 1000, theta=heading)
    for at, left, right, x_mm, y_mm, angle in rows:
        travel = wheels(int(left), int(right))
        state, outcome = advance(state, Reading(travel.left_m, travel.right_m, at), ROOMBA)
        assert isinstance(outcome, Motion)
        assert math.hypot(state.x - x_mm / 1000, state.y + y_mm / 1000) < 0.002
        turned = state.theta + angle * unit
        assert abs(math.remainder(turned, math.tau)) < 0.002


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
