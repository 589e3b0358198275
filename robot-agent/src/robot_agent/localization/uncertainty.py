"""Uncertainty of a pose, along and across the direction in which its position is least certain."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Uncertainty(NamedTuple):
    """Standard deviations of a pose: along and across its least certain direction (m), and of the heading (rad).

    In a corridor without features, `along` is the direction of the corridor. axis: that direction in `map`, a unit
    vector of either sign.
    """

    along: float
    across: float
    heading: float
    axis: tuple[float, float] = (1.0, 0.0)


def uncertainty(covariance: NDArray[np.float64]) -> Uncertainty:
    """Return the standard deviations of a covariance (3, 3) over (x, y, theta)."""
    (least, most), vectors = np.linalg.eigh(covariance[:2, :2])
    return Uncertainty(
        math.sqrt(max(0.0, most)),
        math.sqrt(max(0.0, least)),
        math.sqrt(max(0.0, covariance[2, 2])),
        (float(vectors[0, 1]), float(vectors[1, 1])),
    )
