"""The points that the stop field gets: newest samples, moved by the odometry since each was taken."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_agent.agent.motion_guard import NearPoints
from robot_agent.config import LocalizationConfig
from robot_agent.footprint import Footprint
from robot_agent.hardware import LidarSamples
from robot_agent.localization.localizer import Localizer

CIRCLE = Footprint.circle(0.17)


def samples(*polar, at):
    angles, ranges = zip(*polar, strict=True)
    return LidarSamples(np.array(angles, np.float32), np.array(ranges, np.float32), at, at)


def driven(speed, until, turning=0.0):
    localizer = Localizer()
    for t in np.arange(0.0, until, 0.05):
        localizer.on_odometry(t, speed * t, 0.0, turning * t)
    return localizer


def test_sample_counts_before_its_scan_is_whole_and_moves_with_the_robot():
    near, localizer = NearPoints(LocalizationConfig(), 1.0, 0.5, CIRCLE), driven(0.3, 2.0)
    near.add(samples((0.0, 0.8), (math.pi / 2, 0.5), at=1.5))
    seen = near.seen_from(localizer, 1.9)
    assert seen == pytest.approx(np.array([(0.8 - 0.4 * 0.3, 0.0), (-0.12, 0.5)]), abs=1e-5)


def test_turn_of_the_robot_moves_the_points_around_it():
    near, localizer = NearPoints(LocalizationConfig(), 1.0, 0.5, CIRCLE), driven(0.0, 2.0, turning=1.0)
    near.add(samples((0.0, 0.5), at=1.5))
    assert near.seen_from(localizer, 1.9)[0] == pytest.approx((0.5 * math.cos(0.4), -0.5 * math.sin(0.4)), abs=1e-5)


def test_points_are_forgotten_after_the_memory_and_beyond_the_reach_never_kept():
    near, localizer = NearPoints(LocalizationConfig(), 1.0, 0.5, CIRCLE), driven(0.0, 3.0)
    near.add(samples((0.0, 0.5), (1.0, 1.2), (2.0, math.nan), at=1.0))
    assert len(near.seen_from(localizer, 1.0)) == 1
    assert len(near.seen_from(localizer, 1.49)) == 1
    assert len(near.seen_from(localizer, 1.51)) == 0
    near.add(samples((1.0, 1.2), at=1.6))
    assert len(near.seen_from(localizer, 1.6)) == 0


def test_after_a_rest_only_what_was_seen_within_the_memory_counts_and_for_no_longer():
    near, localizer = NearPoints(LocalizationConfig(), 1.0, 0.5, CIRCLE), driven(0.0, 6.0)
    for step in range(80):
        near.add(samples((0.0, 0.5), at=1.0 + 0.05 * step))
    assert len(near.seen_from(localizer, 4.98)) == 10
    assert len(near.seen_from(localizer, 5.23)) == 5


def test_lidar_off_the_centre_and_turned_is_placed_by_its_configuration():
    config = LocalizationConfig(lidar_x=0.1, lidar_y=-0.05, lidar_yaw=math.pi / 2)
    near, localizer = NearPoints(config, 1.0, 0.5, CIRCLE), driven(0.0, 1.0)
    near.add(samples((0.0, 0.4), at=0.5))
    assert near.seen_from(localizer, 0.5)[0] == pytest.approx((0.1, 0.35), abs=1e-6)


def test_times_between_first_and_last_sample_are_even():
    near, localizer = NearPoints(LocalizationConfig(), 1.0, 0.5, CIRCLE), driven(0.8, 2.0)
    near.add(LidarSamples(np.zeros(3, np.float32), np.full(3, 0.8, np.float32), 1.2, 1.4))
    assert near.seen_from(localizer, 1.4)[:, 0] == pytest.approx([0.64, 0.72, 0.8], abs=1e-5)


def test_nothing_is_seen_without_odometry_or_samples():
    near = NearPoints(LocalizationConfig(), 1.0, 0.5, CIRCLE)
    assert near.seen_from(driven(0.0, 1.0), 0.5).shape == (0, 2)
    near.add(samples((0.0, 0.4), at=0.5))
    assert near.seen_from(Localizer(), 0.5).shape == (0, 2)
    assert len(near.seen_from(driven(0.0, 1.0), 0.5)) == 1


FORWARD = LocalizationConfig(lidar_x=0.12)
"""At 0.12 m of a circle of 0.17 m: it sees nothing between the body's rim and 0.10 m before it."""


def stopped_before(reach, lidar=FORWARD, speed=0.2):
    """Drive at something `reach` m ahead of the axle, which is seen for 1 s, and stand since the second after it."""
    near, localizer = NearPoints(lidar, 1.0, 0.5, CIRCLE), Localizer()
    for t in np.arange(0.0, 5.0, 0.05):
        x = speed * min(t, 2.0)
        localizer.on_odometry(t, x, 0.0, 0.0)
        if (away := reach - x - lidar.lidar_x) >= 0.15:
            near.add(samples((0.0, away), at=t))
        near.seen_from(localizer, t)
    return near, localizer


def test_point_that_came_too_near_to_be_measured_stays():
    near, localizer = stopped_before(0.60)
    seen = near.seen_from(localizer, 4.9)
    assert len(seen) >= 1
    assert seen == pytest.approx(np.tile((0.2, 0.0), (len(seen), 1)), abs=1e-6)


def test_point_within_a_body_that_reaches_farther_than_the_lidar_is_blind_is_forgotten():
    near, localizer = stopped_before(0.52, LocalizationConfig())
    assert len(near.seen_from(localizer, 4.9)) == 0


def test_point_that_is_too_near_goes_when_beams_pass_it_and_not_by_single_ones_or_none():
    near, localizer = stopped_before(0.60)
    around = np.radians((-1.0, 0.0, 1.0))
    near.add(samples(*((angle, math.nan) for angle in around), at=4.9))
    near.add(samples((0.0, 2.0), at=4.9))
    near.add(samples(*((angle + 0.3, 2.0) for angle in around), at=4.9))
    near.add(samples(*((angle + math.pi, 2.0) for angle in around), at=4.9))
    assert len(near.seen_from(localizer, 4.9)) >= 1
    near.add(samples(*((angle, 2.0) for angle in around), at=4.9))
    assert len(near.seen_from(localizer, 4.9)) == 0


def test_point_that_the_robot_has_left_behind_counts_until_it_could_be_measured_again():
    near, localizer = stopped_before(0.60)
    for t in np.arange(5.0, 6.0, 0.05):
        localizer.on_odometry(t, 0.4 - 0.2 * (t - 5.0), 0.0, 0.0)
        near.seen_from(localizer, t)
        if 5.5 < t < 5.9:
            assert len(near.seen_from(localizer, t)) >= 1
    localizer.on_odometry(6.5, 0.2, 0.0, 0.0)
    assert len(near.seen_from(localizer, 6.5)) == 0


def test_wall_beside_a_robot_that_stands_there_for_long_is_kept_once():
    near, localizer = NearPoints(FORWARD, 1.0, 0.5, CIRCLE), driven(0.0, 60.0)
    rng = np.random.default_rng(1)
    for t in np.arange(0.0, 60.0, 0.05):
        near.add(samples(*((angle, 0.155 + 0.005 * rng.standard_normal()) for angle in (-0.1, 0.0, 0.1)), at=t))
        seen = near.seen_from(localizer, t)
    assert len(seen) < 60
