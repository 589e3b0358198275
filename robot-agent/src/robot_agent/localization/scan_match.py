"""Scan matching: the pose near an estimate at which a scan fits the map best, and how certain the scan makes it.

Method: correlative matching (Olson 2009) reduced to a hill climb around the estimate, whose Gaussian is the prior; the
covariance is that of the prior and of the curvature of the scan's likelihood together. Directions that the scan does
not observe have no curvature, so the prior alone decides there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.scans import climb
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.map_fields import MapFields

_INFORMATION: Final = 40.0
"""Logarithm of the likelihood ratio between a pose that all beams fit and one that none fits. The beams of one scan are
not independent: their errors come from the same wall, map cell and moment."""
_STEPS: Final = np.array([(0.05, 0.05, 0.02), (0.025, 0.025, 0.01), (0.012, 0.012, 0.005), (0.006, 0.006, 0.0025)])
_CLIMBS_MAX: Final = 12
"""Moves with each size of step."""
_BOUND: Final = np.array((0.3, 0.3, 0.15))
"""A match moves no estimate farther (m, m, rad): what lies beyond may be another place."""
_CURVATURE_STEP: Final = (0.06, 0.06, 0.025)
_LEAST_SIGMAS: Final = (0.02, 0.02, 0.007)
"""No pose is more certain than this (m, m, rad): half a cell of the map, and what the map's own errors allow."""
_SHIFTS: Final = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.float64)
_SECOND_ORDER: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_QUADRATIC: Final = np.linalg.pinv(
    np.column_stack((np.ones(len(_SHIFTS)), _SHIFTS, *(_SHIFTS[:, i] * _SHIFTS[:, j] for i, j in _SECOND_ORDER)))
)
"""From values at the shifts to the coefficients of the quadratic function that fits them best."""


class Match(NamedTuple):
    """The best pose in `map`, and its covariance (3, 3) over (x, y, theta)."""

    pose: Pose2
    covariance: NDArray[np.float64]


def match_scan(fields: MapFields, pose: Pose2, covariance: NDArray[np.float64], points: NDArray[np.float64]) -> Match:
    """Refine an estimate with its covariance (3, 3) by a scan's points (n, 2; m, frame `base`)."""
    prior = covariance + np.diag(np.square(_LEAST_SIGMAS))
    information = np.linalg.inv(prior)

    g = fields.geometry
    best = climb(
        points,
        pose,
        information,
        fields.sharp,
        g.resolution,
        (g.origin_x, g.origin_y),
        _INFORMATION,
        _STEPS,
        _BOUND,
        _CLIMBS_MAX,
    )
    x, y, theta = (float(value) for value in np.array(pose) + best)
    matched = Pose2(x, y, wrap(theta))
    fit = fields.scores(np.array(matched) + _SHIFTS * _CURVATURE_STEP, points, fields.sharp)
    return Match(matched, _posterior_covariance(_INFORMATION * fit, information))


def _posterior_covariance(values: NDArray[np.float64], prior: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance from log-likelihoods at the shifts around the maximum, and the prior's information."""
    curvature = np.zeros((3, 3))
    for (i, j), coefficient in zip(_SECOND_ORDER, (_QUADRATIC @ values)[4:], strict=True):
        curvature[i, j] = curvature[j, i] = -coefficient * (2.0 if i == j else 1.0)
    steps = np.array(_CURVATURE_STEP)
    observed = curvature / np.outer(steps, steps)
    eigenvalues, vectors = np.linalg.eigh(observed)
    observed = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
    covariance = np.linalg.inv(observed + prior) + np.diag(np.square(_LEAST_SIGMAS))
    return np.asarray(0.5 * (covariance + covariance.T))
