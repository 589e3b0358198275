"""A scan is corrected for the motion during it, compared with the one before, and matched with the map."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from little_world import L_ROOMS, grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.hardware import LaserScan
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.odometry import OdometryBuffer
from robot_agent.localization.pose import Pose2
from robot_agent.localization.scans import DeskewedScan, deskew, follows, match_scan, spread

POST = (2.0, 1.0)
"""Position of the only visible object, in `odom`."""


def scan_of(ranges, angles=None, begin=0.0, end=0.18) -> LaserScan:
    count = len(ranges)
    return LaserScan(
        angles_rad=np.zeros(count) if angles is None else np.array(angles),
        ranges_m=np.array(ranges),
        quality=np.full(count, 40, np.uint8),
        started_at=begin,
        ended_at=end,
        repeats=1,
    )


def at_rest(*, since: float = 0.0) -> OdometryBuffer:
    buffer = OdometryBuffer()
    buffer.add(since, 0.0, 0.0, 0.0)
    buffer.add(since + 0.3, 0.0, 0.0, 0.0)
    return buffer


@given(v=st.floats(-0.3, 0.3), w=st.floats(-2.5, 2.5), x=st.floats(-0.1, 0.1), yaw=st.floats(-3.0, 3.0))
def test_every_sample_of_a_post_is_moved_to_the_post(v, w, x, yaw):
    config = LocalizationConfig(lidar_x=x, lidar_yaw=yaw)
    odometry = OdometryBuffer()
    pose = Pose2(0.0, 0.0, 0.3)
    ranges, angles = [], []
    for i in range(91):
        odometry.add(0.002 * i, *pose)
        if i % 10 == 0:
            lidar = pose.compose(Pose2(config.lidar_x, config.lidar_y, config.lidar_yaw))
            relative = Pose2(*POST, 0.0).relative_to(lidar)
            ranges.append(math.hypot(relative.x, relative.y))
            angles.append(math.atan2(relative.y, relative.x))
        theta = pose.theta + 0.002 * w  # not wrapped, as odometry is
        pose = Pose2(pose.x + 0.002 * v * math.cos(theta), pose.y + 0.002 * v * math.sin(theta), theta)
    deskewed = deskew(scan_of(ranges, angles, 0.0, 0.18), odometry, config)
    assert deskewed.odom.transform(deskewed.points) == pytest.approx(np.tile(POST, (10, 1)), abs=1e-6)


def test_samples_without_a_return_or_out_of_range_are_left_out():
    scan = scan_of([math.nan, 0.05, 1.0, 13.0, math.inf, 2.0])
    assert deskew(scan, at_rest(), LocalizationConfig()).points == pytest.approx(np.array([(1.0, 0.0), (2.0, 0.0)]))


def test_scan_from_before_the_odometry_is_refused():
    assert deskew(scan_of([1.0]), at_rest(since=0.2), LocalizationConfig()) is None
    assert deskew(scan_of([1.0]), OdometryBuffer(), LocalizationConfig()) is None


def test_beams_are_spread_over_the_whole_scan():
    points = np.arange(20.0).reshape(10, 2)
    assert spread(points, 4)[:, 0].tolist() == [0.0, 6.0, 12.0, 18.0]
    assert spread(points, 99) is points


def in_a_room(true: Pose2, odom: Pose2, rng: np.random.Generator) -> DeskewedScan:
    """A scan from a pose in a room of 8 x 5 m, when the wheels say `odom`."""
    angles = np.linspace(-math.pi, math.pi, 300, endpoint=False) + true.theta
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(angles) > 0, 8.0 - true.x, -true.x) / np.cos(angles)
        y = np.where(np.sin(angles) > 0, 5.0 - true.y, -true.y) / np.sin(angles)
    ranges = np.minimum(x, y) * rng.normal(1.0, 0.01, 300)
    points = np.column_stack((ranges * np.cos(angles - true.theta), ranges * np.sin(angles - true.theta)))
    return DeskewedScan(points[rng.random(300) > 0.3], odom, 0.0)


@given(
    x=st.floats(1.0, 7.0), y=st.floats(1.0, 4.0), heading=st.floats(-math.pi, math.pi), seed=st.integers(0, 2**32 - 1)
)
def test_scans_follow_each_other_as_the_wheels_say_and_not_if_the_robot_was_carried(x, y, heading, seed):
    rng, begin, step = np.random.default_rng(seed), Pose2(x, y, heading), Pose2(0.08, 0.0, 0.3)
    before = in_a_room(begin, Pose2(7.0, -3.0, 1.0), rng)
    odom = before.odom.compose(step)
    assert follows(in_a_room(begin.compose(step), odom, rng), before)
    assert not follows(in_a_room(begin.compose(Pose2(0.08, 0.0, 1.2)), odom, rng), before)
    empty = DeskewedScan(np.empty((0, 2)), odom, 0.0)
    assert not follows(empty, before)
    assert not follows(before, empty)


CONFIG = LocalizationConfig()
FIELDS = map_fields(*grid_of(L_ROOMS, 15.0, 12.0), CONFIG)
CORRIDOR = map_fields(*grid_of([(1.0, 1.0, 61.0, 3.0)], 62.0, 4.0), CONFIG)
TRUE = Pose2(12.0, 8.0, -2.0)
PRIOR = np.diag(np.square((0.2, 0.2, 0.1)))


def points_at(pose: Pose2, fields: MapFields) -> np.ndarray:
    angles = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    ranges = fields.ranges(pose.x, pose.y, angles + pose.theta, 8.0)
    hit = np.isfinite(ranges)
    return np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])))


@pytest.mark.parametrize("offset", [(0.15, -0.1, 0.05), (-0.12, 0.12, -0.06), (0.0, 0.2, 0.0)])
def test_estimate_beside_the_true_pose_is_moved_there(offset):
    given = Pose2(*(np.array(TRUE) + offset))
    pose, covariance = match_scan(FIELDS, given, PRIOR, points_at(TRUE, FIELDS))
    assert math.hypot(pose.x - TRUE.x, pose.y - TRUE.y) < 0.03
    assert abs(pose.theta - TRUE.theta) < math.radians(0.6)
    assert np.sqrt(np.diag(covariance)) == pytest.approx((0.035, 0.035, 0.012), rel=0.6)


@pytest.mark.parametrize("seed", range(4))
def test_match_moves_no_estimate_out_of_its_bound_however_uncertain_it_is(seed):
    """What lies beyond may be another place, which only the particles may decide for."""
    rng = np.random.default_rng(seed)
    points = points_at(TRUE, FIELDS)
    for _ in range(8):
        given = Pose2(*(np.array(TRUE) + rng.uniform(-1.0, 1.0, 3) * (1.5, 1.5, 1.0)))
        pose, _ = match_scan(FIELDS, given, 100.0 * np.eye(3), points)
        assert max(abs(pose.x - given.x), abs(pose.y - given.y)) <= 0.3 + 1e-9
        assert abs(math.remainder(pose.theta - given.theta, math.tau)) <= 0.15 + 1e-9


def test_along_a_plain_corridor_a_match_keeps_what_was_known_and_across_it_tells_more():
    given = Pose2(30.0, 2.1, 0.03)
    prior = np.diag(np.square((0.6, 0.3, 0.1)))
    pose, covariance = match_scan(CORRIDOR, given, prior, points_at(Pose2(31.0, 2.0, 0.0), CORRIDOR))
    assert pose.x == pytest.approx(given.x, abs=0.03)
    assert pose.y == pytest.approx(2.0, abs=0.055)
    assert math.sqrt(covariance[0, 0]) == pytest.approx(0.6, rel=0.05)
    assert math.sqrt(covariance[1, 1]) < 0.08
