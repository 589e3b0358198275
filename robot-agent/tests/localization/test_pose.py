"""Poses that are measured without the lidar, as from a fiducial marker whose place on the map is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_agent.localization.localizer import Localizer
from robot_agent.localization.pose import AbsoluteObservation, Pose2

PRIOR = np.diag(np.square((0.4, 0.4, 0.1)))
TRUE = Pose2(5.0, 2.0, 0.3)
STEP_M = 0.05


def marker_covariance(bearing: float) -> np.ndarray:
    """A camera knows the distance of a marker worse (0.15 m) than its bearing (0.02 m); rotated into `map`."""
    cos, sin = math.cos(bearing), math.sin(bearing)
    turned = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return turned @ np.diag(np.square((0.15, 0.02, 0.03))) @ turned.T


def localizer_at(estimate: np.ndarray) -> Localizer:
    """A localizer with the prior covariance around an estimate of the true pose, which then drives on by a step."""
    localizer = Localizer(seed=1)
    localizer.on_odometry(0.0, 0.0, 0.0, 0.0)
    localizer.initial_pose(*estimate, 0.4, 0.1)
    localizer.on_odometry(0.1, STEP_M, 0.0, 0.0)
    return localizer


def test_marker_seen_before_the_last_step_is_fused_by_its_covariance_at_the_odometry_of_its_stamp():
    estimate = np.array((5.3, 1.8, 0.35))
    covariance = marker_covariance(0.7)
    localizer = localizer_at(estimate)
    assert localizer.on_absolute_observation(AbsoluteObservation(TRUE, covariance, 0.0))
    information = np.linalg.inv(PRIOR) + np.linalg.inv(covariance)
    expected = np.linalg.solve(
        information, np.linalg.inv(PRIOR) @ estimate + np.linalg.inv(covariance) @ np.array(TRUE)
    )
    assert localizer.pose(0.0) == pytest.approx(tuple(expected), abs=1e-9)
    assert localizer.covariance() == pytest.approx(np.linalg.inv(information), abs=1e-9)
    assert localizer.pose(0.1) == pytest.approx(Pose2(*expected).compose(Pose2(STEP_M, 0.0, 0.0)), abs=1e-9)


def test_errors_of_fused_poses_are_as_large_as_their_covariance_says():
    """The normalized squared error of a consistent estimate of three numbers has the mean 3."""
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(200):
        covariance = marker_covariance(rng.uniform(-math.pi, math.pi))
        localizer = localizer_at(rng.multivariate_normal(np.array(TRUE), PRIOR))
        seen = rng.multivariate_normal(np.array(TRUE), covariance)
        assert localizer.on_absolute_observation(AbsoluteObservation(Pose2(*seen), covariance, 0.0))
        error = np.array(localizer.pose(0.0)) - np.array(TRUE)
        squares.append(error @ np.linalg.solve(localizer.covariance(), error))
    assert 2.3 < np.mean(squares) < 3.7


def test_marker_from_before_the_odometry_is_refused():
    localizer = localizer_at(np.array(TRUE))
    assert not localizer.on_absolute_observation(AbsoluteObservation(TRUE, marker_covariance(0.0), -5.0))


@pytest.mark.parametrize(
    "covariance", [np.eye(2), np.zeros((3, 3)), -np.eye(3), np.full((3, 3), math.nan), np.triu(np.ones((3, 3)))]
)
def test_covariance_that_is_none_is_refused(covariance):
    with pytest.raises(ValueError, match="covariance"):
        AbsoluteObservation(TRUE, covariance, 0.0)
