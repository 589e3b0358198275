"""Means with confidence intervals, and tests of paired differences. Pure.

Student's t (Gosset 1908), the paired t test, and the sign-flip test (Fisher 1935), which assumes no distribution.
"""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

_EXACT_UP_TO: Final = 14
"""With at most this many pairs every combination of signs is tried, beyond that random ones."""
_FLIPS: Final = 20_000
_STEPS: Final = 2_000


class Estimate(NamedTuple):
    """A mean of `n` values with half the width of its 95 % confidence interval; that is None below two values."""

    mean: float
    half: float | None
    n: int


class Paired(NamedTuple):
    """A mean difference, and how likely one so large is by chance: by the paired t test and the sign-flip test."""

    difference: Estimate
    p_t: float | None
    p_flip: float | None


def t_cdf(t: float, freedom: int) -> float:
    """Return the probability that Student's t with so many degrees of freedom is at most `t`."""
    # With t = sqrt(freedom) * tan(angle) the density is a power of the cosine.
    part = _cosine_integral(math.atan(abs(t) / math.sqrt(freedom)), freedom - 1)
    share = 0.5 * part / _cosine_integral(math.pi / 2, freedom - 1)
    return 0.5 + math.copysign(share, t)


def _cosine_integral(end: float, power: int) -> float:
    """Return the integral of cos^power from 0 to `end` by Simpson's rule."""
    values = np.cos(np.linspace(0.0, end, _STEPS + 1)) ** power
    weights = np.full(_STEPS + 1, 2.0)
    weights[1::2] = 4.0
    weights[[0, -1]] = 1.0
    return float((values * weights).sum() * end / _STEPS / 3.0)


@cache
def t_quantile(share: float, freedom: int) -> float:
    """Return the value that Student's t stays below with this probability (0.5 to 0.9999)."""
    low, high = 0.0, 1e4
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if t_cdf(middle, freedom) < share else (low, middle)
    return 0.5 * (low + high)


def estimate(values: Sequence[float]) -> Estimate:
    """Return the mean with its 95 % confidence interval; raises `ValueError` without a value."""
    if not values:
        raise ValueError("there is no mean of no values")
    mean, n = float(np.mean(values)), len(values)
    if n < 2:
        return Estimate(mean, None, n)
    return Estimate(mean, t_quantile(0.975, n - 1) * float(np.std(values, ddof=1)) / math.sqrt(n), n)


def compare(before: Sequence[float], after: Sequence[float]) -> Paired:
    """Return how much smaller `after` is than `before`, pair by pair."""
    differences = np.array(before) - np.array(after)
    found = estimate(differences.tolist())
    if found.n < 2:
        return Paired(found, None, None)
    error = float(np.std(differences, ddof=1)) / math.sqrt(found.n)
    if error == 0.0:
        p_t = 1.0 if found.mean == 0.0 else 0.0
    else:
        p_t = 2.0 * (1.0 - t_cdf(abs(found.mean) / error, found.n - 1))
    return Paired(found, p_t, _flip_test(differences))


def _flip_test(differences: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> float:
    """Return the share of all combinations of signs with a sum at least as far from 0; exact for few pairs."""
    n = len(differences)
    if n <= _EXACT_UP_TO:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=n)))
    else:
        signs = np.random.default_rng(1).choice((-1.0, 1.0), size=(_FLIPS, n))
        signs[0] = 1.0
    sums = np.abs(signs @ differences)
    return float(np.mean(sums >= abs(differences.sum()) - 1e-9))
