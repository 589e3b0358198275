"""What scans do not observe, as along a plain corridor: the particles there, and how far the wheels really go.

In a plain corridor hundreds of updates follow one another of which none tells how far along it the robot is. Weighting
and drawing particles again and again then moves their mean at random, and takes a share of one in N of their variance
each time (genetic drift): after 100 m they claim a third of what the odometry may be wrong by, at a place that is
wrong by more. Here a scan's say on that direction is estimated by regression over all particles, which the noise of
the weights in other directions does not disturb, and the particles are moved to the mean and variance that follow.

A worn wheel, a carpet or a wrong setting makes the odometry count too far or too little by some percent, all the time.
Where scans see how far the robot is, that does no harm; along a plain corridor of 60 m it adds up to metres. So the
share is learned where it can be seen (`OdometryScale`), from the distance between two poses that scans have observed in
the direction between them, and what is not known of it yet is part of the uncertainty along the corridor. How well a
way tells the share depends on how unsteadily the wheels count, which differs by a factor of more than ten between
robots. That is learned beside it, from how the single metres of these ways scatter.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

ALONG_LEAST_M: Final = 0.15
"""A smaller deviation needs no care: scans have observed it."""
_ACROSS_MOST_M: Final = 0.3
_GAP_SIGMAS: Final = 0.5
_GAP_M: Final = 1.0
"""Neighbours on the line that lie so many of all particles' deviations and metres apart belong to two clouds, ... In
plain corridors of 100 m a single cloud falls into clumps 0.5 to almost 1 m apart; in longer ones even farther."""
_CLOUDS_SHARE: Final = 0.85
"""... but are several places only if the clouds' means hold more than this share of the variance: the halves of a
normal cloud hold 0.64, and a few stray particles beside it add to that."""
_LIGHT: Final = 0.1
"""A particle of less than this share of the average weight does not fill a gap."""
_SIGNIFICANT: Final = 3.0
"""A term of the regression counts from so many of its standard errors on."""
_STRONG: Final = 0.5
"""A scan that leaves less than this share of the variance, or moves the mean by more than a deviation, sees a feature:
the weights tell more of it than a quadratic function does."""
_REACH_SIGMAS: Final = 2.0
_SHIFT_M: Final = 0.5
"""Distance between two shifts at most: half of what is looked at around each."""
_TINY: Final = 1e-9


class Along(NamedTuple):
    """A direction in `map` (unit vector), and the particles' mean (m) and variance (m2) along it."""

    direction: tuple[float, float]
    mean: float
    variance: float


def least_certain(x: NDArray[np.float32], y: NDArray[np.float32], weights: NDArray[np.float64]) -> Along | None:
    """Return mean and variance of particles (n; m, weights of sum 1) along their least certain direction.

    None if they are certain enough in every direction, uncertain in all, or in clouds with gaps between them along that
    direction: in the last two cases they are at several places, of which the mean is none.
    """
    mean_x, mean_y = float(weights @ x), float(weights @ y)
    off_x, off_y = x - mean_x, y - mean_y
    xx, xy, yy = float(weights @ (off_x * off_x)), float(weights @ (off_x * off_y)), float(weights @ (off_y * off_y))
    middle, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    if middle + half < ALONG_LEAST_M**2 or middle - half > _ACROSS_MOST_M**2:
        return None
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    cos, sin = math.cos(angle), math.sin(angle)
    if _in_several_clouds(cos * off_x + sin * off_y, weights):
        return None
    return Along((cos, sin), cos * mean_x + sin * mean_y, middle + half)


def observed(
    before: Along,
    particles: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
    weights: NDArray[np.float64],
    log_likelihoods: NDArray[np.float64],
    credit: float = 1.0,
) -> Along | None:
    """Return the mean and variance along the direction of `before` that a scan leaves.

    particles: x, y (m) and theta (rad), each (n); weights: before the scan; log_likelihoods: (n) of the scan. credit:
    share of what the scan tells of that direction that counts. None if it sees that direction so well that the weighted
    particles tell it best.
    """
    x, y, theta = (np.asarray(values, np.float64) for values in particles)
    cos, sin = before.direction
    turns = np.remainder(theta - theta[0] + math.pi, 2.0 * math.pi)
    scaled = [_standardized(values, weights) for values in (cos * x + sin * y, cos * y - sin * x, turns)]
    gradient, curvature = _along_terms(np.column_stack(scaled), weights, log_likelihoods)
    share = 1.0 / max(1.0 + credit * curvature, _TINY)
    shift = share * credit * gradient
    if not _STRONG <= share <= 1.0 / _STRONG or abs(shift) > 1.0:
        return None
    variance = share * before.variance
    return Along(before.direction, before.mean + shift * math.sqrt(before.variance), variance)


def moved_to(
    wanted: Along, x: NDArray[np.float32], y: NDArray[np.float32], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return particles x, y (n; m), shifted and stretched along one direction to the mean and variance wanted there."""
    cos, sin = wanted.direction
    along = cos * x.astype(np.float64) + sin * y
    mean = float(weights @ along)
    variance = float(weights @ np.square(along - mean))
    stretch = math.sqrt(wanted.variance / variance) if variance > _TINY else 1.0
    change = wanted.mean - mean + (stretch - 1.0) * (along - mean)
    return (x + cos * change).astype(np.float32), (y + sin * change).astype(np.float32)


def shifts_along(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return offsets (n, 2; m) along the least certain direction of a covariance (3, 3), two deviations either way."""
    variances, vectors = np.linalg.eigh(covariance[:2, :2])
    sigma = math.sqrt(max(0.0, float(variances[1])))
    if sigma < ALONG_LEAST_M:
        return np.zeros((1, 2))
    reach = _REACH_SIGMAS * sigma
    offsets = np.linspace(-reach, reach, 1 + 2 * math.ceil(reach / _SHIFT_M))
    return np.asarray(np.outer(offsets, vectors[:, 1]))


def _in_several_clouds(along: NDArray[np.float32], weights: NDArray[np.float64]) -> bool:
    """Whether gaps divide places (n; m) on a line, with weights of sum 1, into clouds narrow for their distance."""
    heavy = np.flatnonzero(weights * len(weights) >= _LIGHT)
    order = heavy[np.argsort(along[heavy])]
    places, shares = along[order].astype(np.float64), weights[order] / weights[order].sum()
    places -= shares @ places
    variance = float(shares @ np.square(places))
    least = max(_GAP_M, _GAP_SIGMAS * math.sqrt(variance))
    number = np.concatenate(([0], np.cumsum(np.diff(places) > least)))
    means = np.bincount(number, shares * places) / np.bincount(number, shares)
    return float(shares @ np.square(means[number])) > _CLOUDS_SHARE * variance


def _standardized(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    off = values - weights @ values
    return np.asarray(off / max(math.sqrt(float(weights @ (off * off))), _TINY))


def _along_terms(
    scaled: NDArray[np.float64], weights: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[float, float]:
    """Fit values (n) by a quadratic function of standardized coordinates (n, 3), the direction itself first.

    Return the information that they hold on the first one, as slope and negative curvature there; 0 for what may be
    chance.
    """
    along, across, heading = scaled.T
    basis = np.column_stack(
        (
            along,
            0.5 * along * along,
            np.ones(len(along)),
            across,
            heading,
            across * across,
            heading * heading,
            across * heading,
            along * across,
            along * heading,
        )
    )
    # The ridge only matters where coordinates have no spread at all.
    normal = basis.T @ (basis * weights[:, None]) + _TINY * np.eye(basis.shape[1])
    inverse = np.linalg.inv(normal)
    terms = inverse @ (basis.T @ (weights * values))
    residual = values - basis @ terms
    scatter = float(weights @ (residual * residual)) * float(weights @ weights)
    errors = np.sqrt(np.maximum(np.diag(inverse)[:2] * scatter, 0.0))
    slope, curvature = (
        float(term) if abs(term) > _SIGNIFICANT * error else 0.0 for term, error in zip(terms[:2], errors, strict=True)
    )
    return slope, -curvature


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
