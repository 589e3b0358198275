"""What to try on a base that does not answer: a pulse on the line that wakes it, then its other baud rates. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from robot_agent.hardware import Awakening, WakeLine

ATTEMPT_S: Final = 3.0
"""Time between two attempts: longer than a pulse and the base's answer to it, and so long that pulses are never taken
for a series, by which some bases change their baud rate."""
OTHERS_AFTER: Final = 9
"""Once every rate was tried, the first one is tried so many times before each of the others: who switches the base on
may do so later, and at any of them."""


class Attempt(NamedTuple):
    """One attempt: a pulse on a control line, or another rate of the serial line."""

    line: WakeLine | None = None
    baud: int | None = None


class Revival:
    """The attempts on one base, in turn: each rate once, then mostly the first one; a pulse at each."""

    def __init__(self, awakening: Awakening) -> None:
        self._awakening = awakening
        self._bauds = awakening.bauds
        self._due_at: float | None = None
        self._attempts = 0
        self.problem: str | None = None
        """Why there is no base, once every rate was tried, and the first one again."""

    def on_answer(self) -> None:
        """Keep the rate at which the base has answered, and start over with it when the base falls silent."""
        if self._due_at is None and not self._attempts:
            return  # it has answered before, and nothing was tried since
        answered = self.baud
        self._due_at = self.problem = None
        self._bauds = (answered, *(baud for baud in self._bauds if baud != answered))
        self._attempts = 0

    @property
    def baud(self) -> int:
        """The rate that is tried now."""
        first, *others = self._bauds
        tried = self._attempts // self._per_baud
        if not others:
            return first
        if tried < len(self._bauds):
            return self._bauds[tried]
        turn = (tried - len(self._bauds)) % (OTHERS_AFTER + len(others))
        return first if turn < OTHERS_AFTER else others[turn - OTHERS_AFTER]

    @property
    def _per_baud(self) -> int:
        return 2 if self._awakening.line is not None else 1

    def attempt(self, now: float) -> Attempt | None:
        """Return what to try now on a silent base; None to wait."""
        if self._due_at is None:
            self._due_at = now + ATTEMPT_S
        if now < self._due_at:
            return None
        self._due_at = now + ATTEMPT_S
        before = self.baud
        self._attempts += 1
        # Some bases are told to speak at the first rate, while another one is tried.
        rates = len(self._bauds) if len(self._bauds) == 1 else len(self._bauds) + 1
        if self._attempts >= self._per_baud * rates:
            self.problem = self._sentence()
        if self.baud != before:
            return Attempt(baud=self.baud)
        return Attempt(line=self._awakening.line) if self._awakening.line is not None else None

    def _sentence(self) -> str:
        rates = " or ".join(str(baud) for baud in self._awakening.bauds)
        return f"the base does not answer at {rates} baud: {self._awakening.remedy}"
