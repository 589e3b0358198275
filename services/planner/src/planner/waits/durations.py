"""How long something lasts that lasted before, and whether to wait for its end or to go round. Pure.

Durations are kept as a piecewise constant rate of ending: for each span of ages the time that was spent in it, and how
many ended there. What nobody saw begin or end counts with the part that was seen (Friedman 1982, Piecewise exponential
models for survival data with covariates). With few of them an estimate leans on a prior: some pseudo-observations
(gamma prior of the rates). Who waits learns nothing but that it still lasts, so the best policy is to wait up to some
time and to go round then: the one whose expected delay is least (optimal stopping). Times are seconds.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

Floats = NDArray[np.float64]

AGES: Final[Floats] = np.concatenate(([0.0], 2.0 ** np.arange(0.0, 19.5, 0.5)))
"""Where the spans of ages begin (s): they grow by the square root of two from 1 s to 6 days; the last one is open."""
_WIDTHS: Final[Floats] = np.append(np.diff(AGES), math.inf)

_FORGET: Final = 500.0
"""After so many ends all count half: what lasts may be of another kind today."""


class Durations:
    """How long blocks lasted: for each span of `AGES`, how many ended in it, and the time (s) that all spent in it."""

    def __init__(self, ended: Floats | None = None, spent: Floats | None = None) -> None:
        self.ended = np.zeros(len(AGES)) if ended is None else ended
        self.spent = np.zeros(len(AGES)) if spent is None else spent

    def add(self, begin: float, end: float, *, ended: bool) -> None:
        """Count that a block stood from one age (s) to another, and whether it ended then by itself."""
        self.spent += np.clip(end - AGES, 0.0, _WIDTHS) - np.clip(begin - AGES, 0.0, _WIDTHS)
        if ended:
            self.ended[np.searchsorted(AGES, end, "right") - 1] += 1.0
        if self.ended.sum() > _FORGET:
            self.ended, self.spent = self.ended / 2.0, self.spent / 2.0

    def __add__(self, other: Durations) -> Durations:
        """Return both together."""
        return Durations(self.ended + other.ended, self.spent + other.spent)

    def informed(self, prior: Durations, blocks: float) -> Durations:
        """Return what one block is expected to add, if so many blocks like those of a prior (of one block) are added.

        The rate of ending in a span is (ended + prior's) / (spent + prior's).
        """
        rates = (self.ended + blocks * prior.ended) / (self.spent + blocks * prior.spent)
        gone = np.append(np.cumsum(rates[:-1] * _WIDTHS[:-1]), math.inf)
        stands = np.exp(-np.append(0.0, gone))
        ended = -np.diff(stands)
        # A span that nothing is expected to reach keeps its rate, whatever underflows.
        ended = np.maximum(ended, 1e-300)
        return Durations(ended, ended / rates)


def mixture(parts: Sequence[tuple[float, float]]) -> Durations:
    """Return what one block adds whose duration is exponential, drawn from parts: share and mean (s)."""
    ended, spent = np.zeros(len(AGES)), np.zeros(len(AGES))
    for share, mean in parts:
        stands = np.exp(-np.append(AGES, math.inf) / mean)
        ended += share * -np.diff(stands)
        spent += share * mean * -np.diff(stands)
    return Durations(np.maximum(ended, 1e-300), np.maximum(spent, 1e-300 * 1800.0))


class Survival(NamedTuple):
    """The probability that a block still stands after so many seconds from now, and where that bends or jumps (s)."""

    stands: Callable[[Floats], Floats]
    knots: Floats


def survival(durations: Durations, age: float) -> Survival:
    """Return how long a block of this age (s) is expected to stand, by what one block adds (`Durations.informed`)."""
    rates = durations.ended / durations.spent
    gone = np.append(0.0, np.cumsum(rates[:-1] * _WIDTHS[:-1]))

    def risk(ages: Floats) -> Floats:
        span = np.searchsorted(AGES, ages, "right") - 1
        found: Floats = gone[span] + (ages - AGES[span]) * rates[span]
        return found

    begun = float(risk(np.array([age]))[0])
    return Survival(lambda after: np.exp(begun - risk(age + after)), AGES[age < AGES] - age)


def until(rest: float) -> Survival:
    """Return the survival of a block whose end is known: `rest` seconds from now."""
    return Survival(lambda after: (after < rest).astype(np.float64), np.array((rest - 1e-3, rest)))


def all_of(blocks: Sequence[Survival]) -> Survival:
    """Return the survival of several blocks that must all end; they do so independently."""
    if len(blocks) == 1:
        return blocks[0]

    def stands(after: Floats) -> Floats:
        ended: Floats = np.prod([1.0 - block.stands(after) for block in blocks], axis=0)
        return 1.0 - ended

    return Survival(stands, np.concatenate([block.knots for block in blocks]))


_STEPS: Final[Floats] = np.concatenate((np.arange(1.0, 60.0, 0.5), 60.0 * 1.05 ** np.arange(0.0, 85.0)))
"""For how long (s) waiting is considered: up to an hour."""


class Policy(NamedTuple):
    """What is best before a block: to wait up to `limit` s from now, if that costs less than to go round.

    Both costs are expected delays (s) from when the robot is where the way round branches off.
    """

    limit: float
    waiting: float
    detour: float

    @property
    def waits(self) -> bool:
        """Whether to wait; also before what is expected to be gone when the robot comes: then both cost nothing."""
        return self.waiting < self.detour or self.detour == 0.0


def best_policy(block: Survival, detour: float, arrival: float = 0.0) -> Policy:
    """Return the best policy for a robot that is where the way round begins in `arrival` s: that takes `detour` s more.

    To wait until t costs the time that the block still stands up to then, and the way round if it stands at t.
    """
    knots = block.knots[(block.knots > arrival) & (block.knots < arrival + _STEPS[-1])]
    at = np.unique(np.concatenate(([arrival], arrival + _STEPS, knots)))
    stands = block.stands(at)
    waited = np.append(0.0, np.cumsum(0.5 * (stands[1:] + stands[:-1]) * np.diff(at)))
    costs = waited + stands * detour
    best = 1 + int(np.argmin(costs[1:]))
    return Policy(float(at[best]), float(costs[best]), float(costs[0]))
