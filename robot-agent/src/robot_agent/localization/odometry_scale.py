"""How far the robot really drives for a metre that its wheels count.

A worn wheel, a carpet or a wrong setting makes the odometry count too far or too little by some percent, all the time.
Where scans see how far the robot is, that does no harm; along a plain corridor of 60 m it adds up to metres. So the
share is learned where it can be seen, from the distance between two poses that scans have observed in the direction
between them, and what is not known of it yet is part of the uncertainty along the corridor.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_PRIOR_SIGMA: Final = 0.05
"""Recorded odometry was wrong by 2.9 and 2.5 % (Intel, CSAIL), wheels that were measured with a ruler by more."""
_CHORD_MIN_M: Final = 2.0
_CHORD_MAX_M: Final = 10.0
"""Distance between the two poses from which on it says something, and after which the next one begins."""
_OBSERVED_M: Final = 0.06
"""Largest standard deviation (m) at the first of the two poses in the direction between them."""
_STRAIGHT_RAD: Final = 0.5
"""A way on which the robot turns by more says little: wheels slip in curves."""
_MAP_SIGMA_M: Final = 0.02
"""By how much (m) the map itself, or a match with it, is wrong at each of the two poses."""
_WANDER: Final = 0.004
"""By how much the share changes from one measurement to the next: another floor, a softer tyre."""
_GATE_SIGMAS: Final = 3.0
"""A measurement farther off is none: the wheels slipped, or the robot was carried."""


class _Anchor(NamedTuple):
    """An observed pose in `map`, the calibrated odometry there, and how far it drove until then (m)."""

    pose: Pose2
    odom: Pose2
    covariance: NDArray[np.float64]
    counted: float
    calibrated: float


class OdometryScale:
    """Distance driven per distance that the wheels count, as a share with its standard deviation."""

    def __init__(self) -> None:
        self.value = 1.0
        self.sigma = _PRIOR_SIGMA
        self._before = (self.value, self.sigma**2)
        """Value and variance before the measurement in progress."""
        self._anchor: _Anchor | None = None
        self._farthest = 0.0
        self._best = math.inf
        """Variance of the measurement in progress."""
        self._raw: Pose2 | None = None
        self._odom = Pose2(0.0, 0.0, 0.0)
        self._counted = self._calibrated = 0.0
        self._most_left = self._most_right = 0.0
        """How far (rad) the robot has turned at most to either side, from any heading since the anchor."""

    def calibrated(self, x: float, y: float, theta: float) -> Pose2:
        """Return the odometry's pose (m, rad) with its distances as long as they were driven."""
        raw, before = Pose2(x, y, theta), self._raw
        self._raw = raw
        if before is None:
            self._odom = raw
            return raw
        dx, dy = raw.x - before.x, raw.y - before.y
        self._odom = Pose2(self._odom.x + self.value * dx, self._odom.y + self.value * dy, theta)
        length = math.hypot(dx, dy)
        turned = theta - before.theta
        self._most_left, self._most_right = max(0.0, self._most_left + turned), min(0.0, self._most_right + turned)
        self._counted += length
        self._calibrated += self.value * length
        return self._odom

    def forget_anchor(self) -> None:
        """Measure from another pose on: the robot is at another place than was believed."""
        self._anchor = None

    def observe(self, pose: Pose2, covariance: NDArray[np.float64], odom: Pose2, unseen: NDArray[np.float64]) -> None:
        """Learn from a pose in `map` that a scan confirmed, with its covariance (3, 3), at a calibrated odometry.

        unseen: (2,), m in `map`, the way since scans observed how far the robot is: of that part the pose says nothing.
        """
        anchor = self._anchor
        dx, dy = (0.0, 0.0) if anchor is None else (pose.x - anchor.pose.x, pose.y - anchor.pose.y)
        chord, counted = math.hypot(dx, dy), 0.0 if anchor is None else _distance(odom, anchor.odom)
        if anchor is None or self._most_left - self._most_right > _STRAIGHT_RAD or counted < 0.5 * self._farthest:
            self._begin(pose, covariance, odom, (math.cos(pose.theta), math.sin(pose.theta)))
            return
        self._farthest = max(self._farthest, counted)
        way = (dx / max(chord, 1e-9), dy / max(chord, 1e-9))
        seen = counted - abs(float(unseen[0] * way[0] + unseen[1] * way[1]))
        if min(chord, seen) < _CHORD_MIN_M:
            return
        variance = sum(_variance_along(one, way) for one in (anchor.covariance, covariance))
        variance = (variance + 2.0 * _MAP_SIGMA_M**2) / seen**2
        if variance < self._best:
            self._best = variance
            # The calibration may have changed on the way.
            used = (self._calibrated - anchor.calibrated) / max(self._counted - anchor.counted, 1e-9)
            self._fuse(used * (1.0 + (chord - counted) / seen), variance)
        if counted >= _CHORD_MAX_M:
            self._begin(pose, covariance, odom, way)

    def _begin(self, pose: Pose2, covariance: NDArray[np.float64], odom: Pose2, way: tuple[float, float]) -> None:
        """Measure from this pose on, if scans observe it along the way (unit vector)."""
        self._before = self.value, self.sigma**2 + (_WANDER**2 if self._best < math.inf else 0.0)
        self._farthest, self._best = 0.0, math.inf
        self._most_left = self._most_right = 0.0
        self._anchor = None
        if _variance_along(covariance, way) <= _OBSERVED_M**2:
            self._anchor = _Anchor(pose, odom, covariance, self._counted, self._calibrated)

    def _fuse(self, measured: float, variance: float) -> None:
        value, prior = self._before
        if (measured - value) ** 2 > _GATE_SIGMAS**2 * (prior + variance):
            self._anchor = None
            return
        gain = prior / (prior + variance)
        self.value, self.sigma = value + gain * (measured - value), math.sqrt((1.0 - gain) * prior)


def _variance_along(covariance: NDArray[np.float64], way: tuple[float, float]) -> float:
    cos, sin = way
    return float(cos * cos * covariance[0, 0] + 2.0 * cos * sin * covariance[0, 1] + sin * sin * covariance[1, 1])


def _distance(one: Pose2, other: Pose2) -> float:
    return math.hypot(one.x - other.x, one.y - other.y)
