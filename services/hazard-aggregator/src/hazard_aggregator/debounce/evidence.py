"""Wald's sequential probability ratio test of each sonar: clear evidence needs two readings, doubtful evidence waits.

Each reading of a sonar adds the logarithm of how much likelier it is with an obstacle than without one. The sum is
compared with the bounds of Wald (Sequential Tests of Statistical Hypotheses, 1945), which follow from the allowed
probabilities of error. From a decision on, the sum starts again at zero, and only evidence against the decision counts
(Page, Continuous Inspection Schemes, 1954): evidence for it in stock would delay the next change.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Final

from msgspec import Meta, Struct

from hazard_aggregator.debounce import RuleFactory, SonarSample

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState
    from hazard_aggregator.debounce import Observation

Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]

NOISE_M: Final = 0.03
"""Two echoes of one thing at rest differ by at most this (m)."""
SPEED_MPS: Final = 1.3
"""How fast (m/s) a thing comes nearer or goes away: 0.15 m, as in the firmware's filter, in a node's cycle of 0.12 s.

What a node measures again at once, after 50 to 60 ms, has moved by less: the interval of the readings counts.
"""
STILL_ECHOES: Final = 0.5
MOVING_ECHOES: Final = 0.4
"""Shares of an obstacle's echoes that have the range of the one before, and that differ by no more than it can move."""
DOUBTFUL_SHARE: Final = 0.1
"""Share of readings of a free area with an echo just within the limit: the calibrated distance is no sharp edge."""
_LEAST: Final = 0.1
"""False echoes within a range that could hold none of them, at least."""
_FEWEST: Final = 1.5
_MOST: Final = 3.0
"""A learned rate of false echoes counts as no less and no more than lets so many clear echoes suffice to block: never
one, and always three in a row that agree. With the default options that is 0.002 and 0.035; beyond, the rule would
miss obstacles that swallow a part of the echoes (at 0.22 half of those that echo in 60 % of the readings)."""
REPEATS: Final = 2
"""So many times in a row a node's filter may report an old range again (the firmware's `kMaxHeld`)."""


class Options(Struct, frozen=True, kw_only=True):
    """How likely echoes are, and how often a decision may be wrong.

    `echo_rate`: share of readings in which a sonar hears an obstacle; `false_echo_rate`: share in which it hears
    something in a free area, unless its calibration has shown that. `fognav bench debounce` learns both from a
    recording. `false_alarm` and `missed`: the
    allowed probabilities to find a free area blocked and a blocked one clear, per decision. An echo less than
    `doubtful_m` (m) nearer than the limit is doubtful. `to_unknown` unknown readings in a row confirm `unknown`.
    """

    echo_rate: Probability = 0.6
    false_echo_rate: Probability = 0.01
    false_alarm: Probability = 2e-4
    missed: Probability = 0.001
    doubtful_m: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.05
    to_unknown: Annotated[int, Meta(ge=1, le=1000)] = 5

    def __post_init__(self) -> None:
        if self.echo_rate <= self.false_echo_rate:
            raise ValueError(
                f"echo_rate {self.echo_rate} must exceed false_echo_rate {self.false_echo_rate}: echoes would show that"
                " nothing is there"
            )
        if self.false_alarm + self.missed >= 1.0:
            raise ValueError(
                f"false_alarm {self.false_alarm} and missed {self.missed} must sum to less than 1: each reading would"
                " decide at once"
            )


def learned_rates(options: Options) -> tuple[float, float]:
    """Return what a learned rate of false echoes counts as, at least and at most."""
    to_blocked = _to_blocked(options)
    rarest, likeliest = (options.echo_rate * math.exp(-to_blocked / echoes) for echoes in (_FEWEST, _MOST))
    return rarest, likeliest


def _to_blocked(options: Options) -> float:
    return math.log((1.0 - options.missed) / options.false_alarm)


class _SonarTest:
    """The test of one sonar: `decision` is its latest, `_evidence` the log likelihood ratio since then."""

    def __init__(self, options: Options) -> None:
        self.decision: AreaState | None = None
        self._options = options
        self._evidence = 0.0
        self._echo: tuple[float, float] | None = None  # range (m) and time (s) of the latest echo within the limit
        self._repeats = 0
        self._to_blocked = _to_blocked(options)
        self._rarest, self._likeliest = learned_rates(options)
        self._to_clear = math.log(options.missed / (1.0 - options.false_alarm))
        self._silence = math.log((1.0 - options.echo_rate) / (1.0 - options.false_echo_rate))

    def update(self, sample: SonarSample, now: float) -> None:
        """Add what one reading of the sonar shows, and decide if that suffices."""
        if sample.state == "blocked":
            # A blocked area is cleared by readings in a row: an echo discards what spoke for a free one.
            self._evidence = max(0.0, self._evidence) + self._echo_evidence(sample, now)
        elif sample.state == "clear":
            self._evidence += self._silence
            self._echo = None
        elif self._evidence < 0.0:  # a relief needs more evidence for it than missing
            self._evidence = min(0.0, self._evidence - self._silence)
        if self.decision == "clear":
            self._evidence = max(0.0, self._evidence)
        elif self.decision == "blocked":
            self._evidence = min(0.0, self._evidence)
        if self._evidence >= self._to_blocked:
            self.decision, self._evidence = "blocked", 0.0
        elif self._evidence <= self._to_clear:
            self.decision, self._evidence = "clear", 0.0

    def _false_echo_rate(self, sample: SonarSample) -> float:
        """Return how often a sonar hears something in a free area: as it was calibrated, or else by the option.

        What a missing echo says does not follow it: one may not make the area blocked sooner for being unreliable.
        """
        learned, options = sample.false_echo_rate, self._options
        if learned is None:
            return options.false_echo_rate
        return min(max(learned, self._rarest), self._likeliest)

    def _echo_evidence(self, sample: SonarSample, now: float) -> float:
        """Return the evidence of an echo within the limit.

        Echoes of one thing agree in range, false ones agree by chance. A range that is repeated to the millimetre may
        be an old one that the node's filter reports again: it counts when it comes too often for that.
        """
        options, before, false_echo_rate = self._options, self._echo, self._false_echo_rate(sample)
        odds = options.echo_rate / false_echo_rate
        if sample.range_m is None or sample.limit_m is None:
            return math.log(odds)
        self._echo = sample.range_m, now
        if sample.limit_m - sample.range_m < options.doubtful_m:
            return max(0.0, math.log(options.echo_rate / max(false_echo_rate, DOUBTFUL_SHARE)))
        if before is None:
            self._repeats = 0
            return math.log(odds)
        if sample.range_m == before[0] and self._repeats < REPEATS:
            self._repeats += 1
            return 0.0
        self._repeats = 0
        return max(0.0, math.log(odds * _agreement(sample.range_m - before[0], now - before[1], sample.limit_m)))


def _agreement(difference: float, interval: float, limit: float) -> float:
    """Return how much likelier two echoes differ so much (m) if they are of one thing than by chance.

    `interval` (s) is the time between them; false echoes come from everywhere within the `limit` (m).
    """
    reach = NOISE_M + SPEED_MPS * max(0.0, interval)
    still = min(1.0, 2.0 * NOISE_M / limit)
    within = min(1.0, 2.0 * reach / limit)
    if abs(difference) <= NOISE_M:
        return (STILL_ECHOES + MOVING_ECHOES * NOISE_M / reach) / still
    if abs(difference) <= reach:
        return MOVING_ECHOES * (1.0 - NOISE_M / reach) / max(within - still, _LEAST)
    return (1.0 - STILL_ECHOES - MOVING_ECHOES) / max(1.0 - within, _LEAST)


class Evidence:
    """The tests of a node's sonars: blocked if one of them says so, clear if all do.

    A sonar whose echo a robot explains does not take part in that reading; the state of a sensor that is no sonar is
    tested like one echo without a range. A decision is confirmed by each reading that shows the same.
    """

    def __init__(self, options: Options) -> None:
        self._options = options
        self._tests: list[_SonarTest] = []
        self._unknown = 0

    def update(self, seen: Observation, now: float) -> AreaState | None:
        """Add one reading to the tests of its sonars; return their decision if this reading shows the same."""
        sonars = seen.sonars or (SonarSample(seen.state),)
        if len(sonars) != len(self._tests):
            self._tests = [_SonarTest(self._options) for _ in sonars]
        for test, sample in zip(self._tests, sonars, strict=True):
            if not sample.explained:
                test.update(sample, now)
        if seen.state == "unknown":
            self._unknown = min(self._unknown + 1, self._options.to_unknown)
            if self._unknown < self._options.to_unknown:
                return None
            self._tests = []
            return "unknown"
        self._unknown = 0
        decisions = [test.decision for test in self._tests]
        decided = "blocked" if "blocked" in decisions else "clear" if set(decisions) == {"clear"} else None
        return seen.state if decided == seen.state else None

    def reset(self) -> None:
        """Forget all evidence and decisions."""
        self._tests = []
        self._unknown = 0


RULE = RuleFactory(options=Options, make=Evidence)
