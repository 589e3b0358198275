"""The scan match: it refines an estimate within its bound, and claims no more than scan and prior tell."""

from __future__ import annotations

import math

import numpy as np
import pytest
from little_world import L_ROOMS, grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.pose import Pose2
from robot_agent.localization.scan_match import match_scan

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
