"""How far the robot really drives for a metre that its wheels count.

A worn wheel, a carpet or a wrong setting makes the odometry count too far or too little by some percent, all the time.
Where scans see how far the robot is, that does no harm; along a plain corridor of 60 m it adds up to metres. So the
share is learned where it can be seen, from the distance between two poses that scans have observed in the direction
between them, and what is not known of it yet is part of the uncertainty along the corridor.

How well a way tells the share depends on how unsteadily the wheels count, which differs by a factor of more than ten
between robots. That is learned beside it, from how the single metres of these ways scatter.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_PRIOR_SIGMA: Final = 0.065
"""Recorded odometry was wrong by 2.9 and 2.5 % (Intel, CSAIL), wheels that were measured with a ruler by more: with
10 % a robot stands before it is 1.5 m wrong, wherever in a plain corridor it begins."""
_CHORD_MIN_M: Final = 2.0
_CHORD_MAX_M: Final = 10.0
"""Distance between the two poses from which on it says something, and after which the next one begins."""
_OBSERVED_M: Final = 0.06
"""Largest standard deviation (m) at the first of the two poses in the direction between them. Poses that claim no more
are off by half of it at most."""
_STRAIGHT_RAD: Final = 0.5
"""A way on which the robot turns by more says little: wheels slip in curves."""
_MAP_SIGMA_M: Final = 0.02
"""By how much (m) the map itself, or a match with it, is wrong at each of the two poses."""
_WANDER: Final = 0.004
"""By how much the share changes from one measurement to the next: another floor, a softer tyre."""
_GATE_SIGMAS: Final = 3.0
"""A measurement farther off is none: the wheels slipped, or the robot was carried."""
_NOISE: Final = 0.001
"""Variance (m2) of the counted distance per metre, beside the share: Intel's wheels were off by 3.6 cm after 1 m, by
7 cm after 4 m and by 11 cm after 8 m."""
_NOISE_STEPS: Final = 2.0
"""That figure counts as much as so many observed steps, ..."""
_NOISE_STEPS_MAX: Final = 40.0
"""... and what was observed before the present way as so many at most."""
_STEP_M: Final = 1.0
_FOLLOWED: Final = 2.0
"""The pose follows the wheels as well as the scans: over a metre half of the variance shows."""


class _Anchor(NamedTuple):
    """An observed pose in `map` with its covariance (3, 3)."""

    pose: Pose2
    covariance: NDArray[np.float64]


class _Reached(NamedTuple):
    """How far (m) a robot is from the anchor by its pose and by its wheels, and how much of it no scan has observed."""

    chord: float
    counted: float
    unseen: float


class OdometryScale:
    """Distance driven per distance that the wheels count, as a share with its standard deviation."""

    def __init__(self) -> None:
        self.value = 1.0
        self.sigma = _PRIOR_SIGMA
        self._before = (self.value, self.sigma**2)
        """Value and variance before the measurement in progress."""
        self._anchor: _Anchor | None = None
        self._counted = (0.0, 0.0)
        """How far (m) the wheels count from the anchor, before calibration."""
        self._farthest = 0.0
        self._best = math.inf
        """Variance, with the noise as it is by default, of the measurement in progress."""
        self._noise = (_NOISE_STEPS * _NOISE, _NOISE_STEPS)
        """Sum of the variances per metre over the steps of all ways before this one, and their number."""
        self._steps: list[tuple[float, float]] = []
        """Observed steps of this way: how far (m) the pose and the wheels came."""
        self._step_from: _Reached | None = None
        self._raw: Pose2 | None = None
        self._odom = Pose2(0.0, 0.0, 0.0)
        self._last: Pose2 | None = None
        """Calibrated odometry at the last observation."""
        self._most_left = self._most_right = 0.0
        """How far (rad) the robot has turned at most to either side, from any heading since the anchor."""

    @property
    def noise(self) -> float:
        """Variance (m2) of the counted distance per metre, beside the share."""
        total, number = self._noises()
        return total / number

    def calibrated(self, x: float, y: float, theta: float) -> Pose2:
        """Return the odometry's pose (m, rad) with its distances as long as they were driven."""
        raw, before = Pose2(x, y, theta), self._raw
        self._raw = raw
        if before is None:
            self._odom = raw
            return raw
        self._odom = Pose2(
            self._odom.x + self.value * (raw.x - before.x), self._odom.y + self.value * (raw.y - before.y), theta
        )
        turned = theta - before.theta
        self._most_left, self._most_right = max(0.0, self._most_left + turned), min(0.0, self._most_right + turned)
        return self._odom

    def forget_anchor(self) -> None:
        """Measure from another pose on: the robot is at another place than was believed."""
        self._anchor = None

    def observe(self, pose: Pose2, covariance: NDArray[np.float64], odom: Pose2, unseen: NDArray[np.float64]) -> None:
        """Learn from a pose in `map` that a scan confirmed, with its covariance (3, 3), at a calibrated odometry.

        unseen: (2,), m in `map`, the way since scans observed how far the robot is: of that part the pose says nothing.
        """
        anchor, last = self._anchor, self._last
        self._last = odom
        if anchor is None or last is None or self._most_left - self._most_right > _STRAIGHT_RAD:
            self._begin(pose, covariance, (math.cos(pose.theta), math.sin(pose.theta)))
            return
        # Calibrated distances of one way are not of one scale: it is learned meanwhile.
        counted_x, counted_y = self._counted
        self._counted = counted_x + (odom.x - last.x) / self.value, counted_y + (odom.y - last.y) / self.value
        counted = math.hypot(*self._counted)
        if counted < 0.5 * self._farthest:
            self._begin(pose, covariance, (math.cos(pose.theta), math.sin(pose.theta)))
            return
        self._farthest = max(self._farthest, counted)
        dx, dy = pose.x - anchor.pose.x, pose.y - anchor.pose.y
        chord = math.hypot(dx, dy)
        way = (dx / max(chord, 1e-9), dy / max(chord, 1e-9))
        reached = _Reached(chord, counted, abs(float(unseen[0] * way[0] + unseen[1] * way[1])))
        self._add_step(reached, _variance_along(covariance, way))
        self._measure(reached, sum(_excess_along(one, way) for one in (anchor.covariance, covariance)))
        if counted >= _CHORD_MAX_M:
            self._begin(pose, covariance, way)

    def _measure(self, reached: _Reached, excess: float) -> None:
        """Learn the share from the way so far, if it tells more than before; `excess` (m2) of both ends."""
        seen = reached.counted - reached.unseen / self.value
        if min(reached.chord, seen) < _CHORD_MIN_M:
            return
        ends = excess + 2.0 * _MAP_SIGMA_M**2
        usual = (ends + _NOISE * seen) / seen**2
        if usual < self._best:
            self._best = usual
            self._fuse((reached.chord - reached.unseen) / seen, (ends + self.noise * seen) / seen**2)

    def _add_step(self, reached: _Reached, variance: float) -> None:
        """Add a step to those of the way, if scans observe the pose (of this variance, m2) all along it."""
        begun = self._step_from
        if variance > _OBSERVED_M**2:
            self._step_from = None
        elif begun is None:
            self._step_from = reached
        elif reached.counted >= begun.counted + _STEP_M:
            if reached.unseen < begun.unseen + 0.5 * _STEP_M:
                self._steps.append((reached.chord - begun.chord, reached.counted - begun.counted))
            self._step_from = reached

    def _noises(self) -> tuple[float, float]:
        total, number = self._noise
        if len(self._steps) > 1:
            share = sum(driven for driven, _ in self._steps) / sum(counted for _, counted in self._steps)
            total += _FOLLOWED * sum((driven - share * counted) ** 2 / counted for driven, counted in self._steps)
            number += len(self._steps) - 1
        return total, number

    def _begin(self, pose: Pose2, covariance: NDArray[np.float64], way: tuple[float, float]) -> None:
        """Measure from this pose on, if scans observe it along the way (unit vector)."""
        self._before = self.value, self.sigma**2 + (_WANDER**2 if self._best < math.inf else 0.0)
        total, number = self._noises()
        kept = min(1.0, _NOISE_STEPS_MAX / number)
        self._noise = kept * total, kept * number
        self._steps, self._step_from = [], None
        self._farthest, self._best = 0.0, math.inf
        self._counted = (0.0, 0.0)
        self._most_left = self._most_right = 0.0
        self._anchor = None
        if _variance_along(covariance, way) <= _OBSERVED_M**2:
            self._anchor = _Anchor(pose, covariance)

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


def _excess_along(covariance: NDArray[np.float64], way: tuple[float, float]) -> float:
    """Return how much more variance (m2) a pose has along a way than observed ones."""
    return max(0.0, _variance_along(covariance, way) - _OBSERVED_M**2)
