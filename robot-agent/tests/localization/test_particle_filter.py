"""The particle filter: it refines a given pose, follows the odometry, corrects it, and repeats with its seed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from little_world import L_ROOMS, grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.localization.deskew import DeskewedScan
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.particle_filter import ParticleFilter
from robot_agent.localization.pose import Pose2

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
    one.add(scan_at(true, odom), FIELDS, recover=False)
    for _ in range(20):
        true = true.compose(Pose2(0.3, 0.0, 0.0))
        odom = odom.compose(Pose2(0.3, 0.0, drift))
        one.add(scan_at(true, odom), FIELDS, recover=False)
    return one, true, odom


def test_given_pose_is_refined_by_the_first_scan():
    one = ParticleFilter(CONFIG, 1)
    one.start(Pose2(3.3, 1.8, 0.2), ORIGIN, 0.4, 0.3)
    one.add(scan_at(START, ORIGIN), FIELDS, recover=False)
    found = one.pose(ORIGIN)
    assert math.hypot(found.x - START.x, found.y - START.y) < 0.06
    assert abs(found.theta) < 0.03
    assert one.sigmas() == pytest.approx((0.08 * math.sqrt(2.0), 0.04))


def test_scan_with_too_few_points_leaves_the_given_pose():
    one = ParticleFilter(CONFIG, 1)
    one.start(START, ORIGIN, 0.4, 0.3)
    one.add(DeskewedScan(np.ones((3, 2)), ORIGIN, 0.0), FIELDS, recover=False)
    assert one.pose(ORIGIN) == START
    one.add(scan_at(START, ORIGIN), FIELDS, recover=False)
    assert one.sigmas()[0] < 0.2


def test_between_updates_the_pose_follows_the_odometry():
    one = ParticleFilter(CONFIG, 1)
    assert one.pose(ORIGIN) is None
    one.place(START, Pose2(9.0, 9.0, 1.0), 0.1, 0.05)
    step = Pose2(0.2, -0.1, 0.3)
    assert one.pose(Pose2(9.0, 9.0, 1.0).compose(step)) == pytest.approx(START.compose(step))
    one.forget()
    assert not one.has_pose


def test_standing_robot_is_not_updated():
    one = ParticleFilter(CONFIG, 1)
    one.place(START, ORIGIN, 0.1, 0.05)
    before, covariance = one.pose(ORIGIN), one.covariance
    one.add(scan_at(START, Pose2(0.1, 0.0, 0.1)), FIELDS, recover=False)
    assert one.pose(ORIGIN) == before
    assert one.covariance is covariance


def test_scans_correct_odometry_that_drifts():
    one, true, odom = driven(2, drift=0.02)
    found = one.pose(odom)
    assert math.hypot(found.x - true.x, found.y - true.y) < 0.1
    assert math.hypot(*np.subtract(START.compose(odom)[:2], true[:2])) > 0.8  # error of the odometry alone


def test_number_of_particles_shrinks_with_their_spread_and_the_seed_repeats_everything():
    one, _, odom = driven(2, drift=0.0)
    assert CONFIG.particles_min <= one.size < CONFIG.particles_start
    again, _, _ = driven(2, drift=0.0)
    other, _, _ = driven(3, drift=0.0)
    assert again.pose(odom) == one.pose(odom)
    assert other.pose(odom) != one.pose(odom)


def test_random_particles_are_added_only_when_allowed_and_the_fit_declines():
    spreads = []
    for recover in (False, True):
        one, _, odom = driven(2, drift=0.0)
        for _ in range(6):
            odom = odom.compose(Pose2(0.3, 0.0, 0.0))
            one.add(scan_at(Pose2(12.0, 8.0, -2.0), odom), FIELDS, recover=recover)
        spreads.append(float(np.ptp(one._x)))
    assert spreads[1] > spreads[0] + 3.0
