"""The particle filter: it refines a given pose, follows the odometry, corrects it, and repeats with its seed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from little_world import L_ROOMS, grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.particle_filter import ParticleFilter
from robot_agent.localization.pose import Pose2
from robot_agent.localization.scans import DeskewedScan

CONFIG = LocalizationConfig()
FIELDS = map_fields(*grid_of(L_ROOMS, 15.0, 12.0), CONFIG)
START = Pose2(3.0, 2.0, 0.0)
ORIGIN = Pose2(0.0, 0.0, 0.0)


def scan_at(pose: Pose2, odom: Pose2, at: float = 0.0) -> DeskewedScan:
    angles = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    ranges = FIELDS.ranges(pose.x, pose.y, angles + pose.theta, 12.0)
    hit = np.isfinite(ranges)
    return DeskewedScan(
        np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit]))), odom, at
    )


def driven(seed: int, *, drift: float) -> tuple[ParticleFilter, Pose2, Pose2]:
    """A filter after 6 m with odometry that drifts; the true pose and the odometry's."""
    one = ParticleFilter(CONFIG, seed)
    one.start(START, ORIGIN, 0.1, 0.05)
    true, odom = START, ORIGIN
    one.add(scan_at(true, odom), FIELDS)
    for _ in range(20):
        true = true.compose(Pose2(0.3, 0.0, 0.0))
        odom = odom.compose(Pose2(0.3, 0.0, drift))
        one.add(scan_at(true, odom), FIELDS)
    return one, true, odom


def test_scan_with_too_few_points_leaves_the_given_pose():
    one = ParticleFilter(CONFIG, 1)
    one.start(START, ORIGIN, 0.4, 0.3)
    one.add(DeskewedScan(np.ones((3, 2)), ORIGIN, 0.0), FIELDS)
    assert one.pose(ORIGIN) == START
    one.add(scan_at(START, ORIGIN), FIELDS)
    assert one.uncertainty.along < 0.2


@pytest.mark.parametrize(
    ("step", "updated"),
    [
        (Pose2(0.09, 0.0, 0.0), False),
        (Pose2(0.11, 0.0, 0.0), True),
        (Pose2(0.0, 0.0, 0.09), False),
        (Pose2(0.0, 0.0, -0.11), True),
    ],
)
def test_scan_corrects_the_pose_after_0_1_m_or_0_1_rad_and_not_before(step, updated):
    one = ParticleFilter(CONFIG, 1)
    one.start(START, ORIGIN, 0.1, 0.05)
    one.add(scan_at(START, ORIGIN), FIELDS)
    before = one.covariance.copy()
    one.add(scan_at(START.compose(step), step), FIELDS)
    assert (one.covariance != before).any() == updated


def test_standing_robot_is_not_updated():
    one = ParticleFilter(CONFIG, 1)
    one.start(START, ORIGIN, 0.1, 0.05)
    one.add(scan_at(START, ORIGIN), FIELDS)
    before, covariance = one.pose(ORIGIN), one.covariance
    one.add(scan_at(START, Pose2(0.05, 0.0, 0.05)), FIELDS)
    assert one.pose(ORIGIN) == before
    assert one.covariance is covariance


def test_scans_correct_odometry_that_drifts():
    one, true, odom = driven(2, drift=0.02)
    found = one.pose(odom)
    assert math.hypot(found.x - true.x, found.y - true.y) < 0.1
    assert math.hypot(*np.subtract(START.compose(odom)[:2], true[:2])) > 0.8  # error of the odometry alone


CORRIDOR = map_fields(*grid_of([(1, 1, 41, 3)], 42.0, 4.0), CONFIG)
MIDDLE = Pose2(20.0, 2.0, 0.0)


def corridor_scan(pose: Pose2, odom: Pose2) -> DeskewedScan:
    """Return a scan in a plain corridor whose ends are beyond the lidar's range."""
    angles = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    ranges = CORRIDOR.ranges(pose.x, pose.y, angles + pose.theta, 8.0)
    hit = np.isfinite(ranges)
    points = np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])))
    return DeskewedScan(points, odom, 0.0)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 1.0])
def test_pose_given_in_a_plain_corridor_stays_as_uncertain_along_it_as_it_was_given(sigma):
    one = ParticleFilter(CONFIG, 1)
    one.start(MIDDLE, ORIGIN, sigma, 0.2)
    one.add(corridor_scan(MIDDLE, ORIGIN), CORRIDOR)
    assert one.uncertainty.along > 0.9 * sigma
    assert one.uncertainty.across < 0.1
    assert abs(one.pose(ORIGIN).x - MIDDLE.x) < 0.15 * sigma + 0.05  # nothing was observed that could move it


def test_uncertainty_along_a_plain_corridor_grows_as_the_odometry_and_covers_its_error():
    one = ParticleFilter(CONFIG, 1)
    true = Pose2(10.0, 2.0, 0.0)
    one.start(true, ORIGIN, 0.05, 0.02)
    odom = ORIGIN
    one.add(corridor_scan(true, odom), CORRIDOR)
    for _ in range(100):
        true, odom = true.compose(Pose2(0.2, 0.0, 0.0)), odom.compose(Pose2(0.208, 0.0, 0.001))  # 4 % too long
        one.add(corridor_scan(true, odom), CORRIDOR, scale_sigma=0.05)
    found = one.pose(odom)
    assert abs(found.y - true.y) < 0.1
    assert one.uncertainty.across < 0.1
    assert 0.3 < abs(found.x - true.x) < 3.0 * one.uncertainty.along


def test_widened_estimate_finds_a_robot_that_moved_without_its_odometry():
    one = ParticleFilter(CONFIG, 1)
    one.start(START, ORIGIN, 0.05, 0.03)
    one.add(scan_at(START, ORIGIN), FIELDS)
    moved = START.compose(Pose2(0.9, 0.0, 0.2))
    one.widen(ORIGIN, 0.9, 0.3)
    assert one.uncertainty.along > 0.9
    one.add(scan_at(moved, ORIGIN), FIELDS)
    found = one.pose(ORIGIN)
    assert math.hypot(found.x - moved.x, found.y - moved.y) < 0.08


def test_motion_in_one_step_or_many_spreads_the_particles_alike():
    spreads = []
    for pieces in (1, 10):
        one = ParticleFilter(LocalizationConfig(alphas=(0.05, 0.05, 0.05, 0.05)), 3)
        one.start(START, ORIGIN, 1e-6, 1e-6)
        step = Pose2(0.96 / pieces, 0.0, 0.0)
        odom = ORIGIN
        for _ in range(pieces):
            before, odom = odom, odom.compose(step).compose(Pose2(0.0, 0.0, 0.3 / pieces))
            one._anchor = before
            one._move(odom, 10 / pieces)
        spreads.append((np.std(one._x), np.std(one._y), np.std(one._theta)))
    assert spreads[0] == pytest.approx(spreads[1], rel=0.3)  # 3 times as wide without the steps


def test_particles_without_noise_end_where_the_odometry_does():
    config = LocalizationConfig(alphas=(0.0, 0.0, 0.0, 0.0))
    for step in (Pose2(1.0, 0.4, 1.2), Pose2(-0.5, 0.05, 0.1), Pose2(0.0, 0.0, 2.0), Pose2(0.3, 0.0, -3.0)):
        one = ParticleFilter(config, 1)
        one.start(START, ORIGIN, 0.0, 0.0)
        one._move(step, 7.0)
        end = START.compose(step)
        assert (one._x[0], one._y[0]) == pytest.approx((end.x, end.y), abs=1e-3)
        assert math.remainder(one._theta[0] - end.theta, 2 * math.pi) == pytest.approx(0.0, abs=1e-3)


def test_absolute_observation_is_fused_by_its_covariance_or_replaces_what_it_contradicts():
    one = ParticleFilter(CONFIG, 1)
    sure = np.diag([1e-4, 1e-4, 1e-4])
    assert not one.observe(START, sure, ORIGIN)
    assert one.pose(ORIGIN) == pytest.approx(START)
    one.start(START, ORIGIN, 0.3, 0.1)
    assert one.observe(Pose2(3.2, 2.0, 0.05), np.diag([0.09, 0.09, 0.01]), ORIGIN)
    assert one.pose(ORIGIN) == pytest.approx((3.1, 2.0, 0.025))
    assert one.covariance[0, 0] == pytest.approx(0.045)
    assert not one.observe(Pose2(9.0, 2.0, 0.0), sure, ORIGIN)
    assert one.pose(ORIGIN).x == pytest.approx(9.0)


def at_two_places(share_of_other: float, rng: np.random.Generator) -> ParticleFilter:
    """A filter whose estimate is at one of two clouds, 3 m apart; the other cloud has this share of the weight."""
    one = ParticleFilter(CONFIG, 1)
    one.start(START, ORIGIN, 0.1, 0.05)
    poses = np.array(START) + rng.standard_normal((1000, 3)) * (0.05, 0.05, 0.02)
    poses[500:, 0] += 3.0
    one._set_particles(poses)
    one._weights = np.repeat((1.0 - share_of_other, share_of_other), 500) / 500.0
    return one


def test_estimate_stays_with_its_place_while_another_one_weighs_about_as_much():
    rng = np.random.default_rng(1)
    shares = rng.uniform(0.42, 0.58, 20)
    assert np.count_nonzero(np.diff(shares > 0.5)) > 5, "the heaviest place must change again and again"
    for share in shares:
        assert at_two_places(share, rng)._cluster(one_cloud=False).x == pytest.approx(START.x, abs=0.05)


@pytest.mark.parametrize(("share", "place"), [(0.59, START.x), (0.61, START.x + 3.0)])
def test_estimate_moves_to_another_place_that_weighs_one_and_a_half_times_as_much(share, place):
    one = at_two_places(share, np.random.default_rng(2))
    assert one._cluster(one_cloud=False).x == pytest.approx(place, abs=0.05)
