"""Particles along the direction in which they are least certain: what scans do not observe there must not be lost.

In a plain corridor hundreds of updates follow one another of which none tells how far along it the robot is. Weighting
and drawing particles again and again then moves their mean at random, and takes a share of one in N of their variance
each time (genetic drift): after 100 m they claim a third of what the odometry may be wrong by, at a place that is
wrong by more. Here a scan's say on that direction is estimated by regression over all particles, which the noise of
the weights in other directions does not disturb, and the particles are moved to the mean and variance that follow.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

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
