"""How the share by which wheels count too far is learned, from poses that scans have observed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_agent.localization.pose import Pose2
from robot_agent.localization.unobserved import OdometryScale

SEEN = np.diag([0.02**2, 0.02**2, 1e-4])
NOTHING_UNSEEN = np.zeros(2)


def driven(scale, steps, *, error, turn=0.0, begin=0.0, unseen_from=math.inf):
    """Drive steps of 0.1 m with wheels that count too far by a share; return the true pose."""
    true, raw = Pose2(begin, 0.0, 0.0), Pose2(begin * (1.0 + error), 0.0, 0.0)
    last = None
    for number in range(steps):
        true = true.compose(Pose2(0.1, 0.0, turn))
        raw = raw.compose(Pose2(0.1 * (1.0 + error), 0.0, turn))
        odom = scale.calibrated(*raw)
        unseen = np.array((max(0.0, 0.1 * number - unseen_from), 0.0))
        # Where no scan sees how far the robot is, the pose is what the odometry says.
        pose = true if not unseen[0] else last[0].compose(odom.relative_to(last[1]))
        last = pose, odom
        scale.observe(pose, SEEN, odom, unseen)
    return true


@pytest.mark.parametrize("error", [-0.1, -0.02, 0.0, 0.05, 0.1])
def test_ten_observed_metres_tell_how_far_the_wheels_count_too_far(error):
    scale = OdometryScale()
    driven(scale, 100, error=error)
    assert scale.value == pytest.approx(1.0 / (1.0 + error), abs=0.01)
    assert scale.sigma < 0.01


def test_calibrated_distances_are_as_long_as_the_driven_ones():
    scale = OdometryScale()
    true = driven(scale, 100, error=0.05)
    before = scale.calibrated(true.x * 1.05, 0.0, 0.0)
    after = scale.calibrated(true.x * 1.05 + 10.5, 0.0, 0.0)
    assert after.x - before.x == pytest.approx(10.0, abs=0.1)


def test_curves_tell_nothing_since_wheels_slip_there():
    scale = OdometryScale()
    driven(scale, 100, error=0.05, turn=0.08)
    assert (scale.value, scale.sigma) == (1.0, OdometryScale().sigma)


def test_way_on_which_no_scan_saw_how_far_the_robot_is_tells_nothing():
    scale = OdometryScale()
    driven(scale, 300, error=0.05, unseen_from=8.0)
    assert scale.value == pytest.approx(1.0 / 1.05, abs=0.015)


def test_robot_that_was_carried_does_not_spoil_what_was_learned():
    scale = OdometryScale()
    driven(scale, 100, error=0.05)
    learned = scale.value
    scale.forget_anchor()
    driven(scale, 30, error=0.05, begin=40.0)
    assert scale.value == pytest.approx(learned, abs=0.01)


def driven_unsteadily(scale, noise, *, steps=95, seed=0):
    """Drive with wheels that count 2 % too far, and besides that at random, by a variance (m2) per metre.

    Poses are as a filter's: each scan, right to 1 cm, mends a tenth of what the wheels have made wrong.
    """
    rng, off, raw = np.random.default_rng(seed), 0.0, 0.0
    for number in range(steps):
        random = math.sqrt(0.1 * noise) * rng.standard_normal()
        raw += 0.1 * 1.02 + random
        off = 0.9 * (off + random)
        seen = 0.1 * (number + 1) + off + 0.01 * rng.standard_normal()
        scale.observe(Pose2(seen, 0.0, 0.0), SEEN, scale.calibrated(raw, 0.0, 0.0), NOTHING_UNSEEN)


@pytest.mark.parametrize("noise", [0.0005, 0.001])
def test_wheels_that_count_unsteadily_leave_the_share_as_uncertain_as_it_is(noise):
    squares = []
    for seed in range(60):
        scale = OdometryScale()
        driven_unsteadily(scale, noise, seed=seed)
        squares.append(((scale.value - 1.0 / 1.02) / scale.sigma) ** 2)
    assert 0.4 < np.mean(squares) < 1.5
    assert np.mean(np.less_equal(squares, 4.0)) > 0.85


def test_steadiness_of_the_wheels_is_learned_from_observed_metres():
    steady, unsteady = OdometryScale(), OdometryScale()
    driven(steady, 400, error=0.02)
    driven_unsteadily(unsteady, 0.002, steps=400)
    assert steady.noise < 0.0002
    assert unsteady.noise > 0.001


def test_blind_way_tells_nothing_of_how_steady_the_wheels_are():
    scale = OdometryScale()
    driven(scale, 20, error=0.0)
    before = scale.noise
    driven(scale, 300, error=0.0, unseen_from=0.0)
    assert scale.noise == pytest.approx(before, rel=0.4)
