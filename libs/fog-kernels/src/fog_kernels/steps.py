"""Steps between the cells of a grid, as all searches take them: lengths, weights, and how a search ends.

Grid: 8-connected; a cell is traversable below 253 (inscribed); a diagonal needs both orthogonal cells traversable.
An edge costs its length times the mean weight of its two end cells, `weight = neutral + factor * cost`, so costs are
symmetric. Lengths are the integers 408 and 577 (577/408 is sqrt 2 within 2e-6), weights are rounded to integers: a
search is exact for this integer problem, and no float rounding can make it depend on the order of expansion.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import COST_WEIGHT, INSCRIBED, NEUTRAL_WEIGHT, PENALTY_MAX

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRAIGHT: Final = 408
DIAGONAL: Final = 577

FOUND: Final = 0
NOT_FOUND: Final = 1
TIMED_OUT: Final = 2
OVERFLOW: Final = 3
"""A cost exceeds the type of the array of costs."""
QUEUE_FULL: Final = 4
SEALED: Final = -1
"""In a bound of the way round: the cell lies in a dead end (`dead_ends`), and searches leave it out."""


def _weights(neutral: int, factor: float) -> NDArray[np.int32]:
    """Tabulate the weight of every cost; 0 marks impassable cells."""
    if neutral < 1 or factor < 0.0 or not math.isfinite(factor):
        raise ValueError(f"neutral must be at least 1 and factor at least 0, not {neutral} and {factor}")
    weight = np.zeros(256, np.int32)
    graded = neutral + factor * np.arange(INSCRIBED)
    if graded[-1] > 100_000:
        raise ValueError(f"neutral + factor * {PENALTY_MAX} must not exceed 100000")
    weight[:INSCRIBED] = np.rint(graded)
    weight.setflags(write=False)
    return weight


DEFAULT_WEIGHTS = _weights(NEUTRAL_WEIGHT, COST_WEIGHT)


def weights_of(neutral: int, factor: float) -> NDArray[np.int32]:
    """Return the weight of every cost (0..255); 0 marks impassable cells. Raises ValueError for a negative setting."""
    if neutral == NEUTRAL_WEIGHT and factor == COST_WEIGHT:
        return DEFAULT_WEIGHTS
    return _weights(neutral, factor)
