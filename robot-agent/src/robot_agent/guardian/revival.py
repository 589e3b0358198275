"""What to try on a base that does not answer: a pulse on the line that wakes it, then its other baud rates. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from robot_agent.hardware import Awakening, WakeLine

ATTEMPT_S: Final = 3.0
"""Time between two attempts: longer than a pulse and the base's answer to it, and so long that pulses are never taken
for a series, by which some bases change their baud rate."""


class Attempt(NamedTuple):
    """One attempt: a pulse on a control line, or another rate of the serial line."""

    line: WakeLine | None = None
    baud: int | None = None


class Revival:
    """The attempts on one base, in turn: each rate once, then the first one for good; a pulse at each."""

    def __init__(self, awakening: Awakening) -> None:
        self._awakening = awakening
        self._bauds = awakening.bauds
        self._due_at: float | None = None
        self._attempts = 0
        self.problem: str | None = None
        """Why there is no base, once every rate was tried."""

    def on_answer(self) -> None:
        """Keep the rate at which the base has answered, and start over when it falls silent."""
        if self._due_at is None and not self._attempts and len(self._bauds) == 1:
            return  # it has answered before, and nothing was tried since
        self._due_at = self.problem = None
        self._bauds = (self.baud,)
        self._attempts = 0

    @property
    def baud(self) -> int:
        """The rate that is tried now."""
        cycle = (*self._bauds, self._bauds[0])
        return cycle[min(self._attempts // self._per_baud, len(cycle) - 1)]

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
        if self._attempts >= self._per_baud * len(self._bauds):
            self.problem = self._sentence()
        if self.baud != before:
            return Attempt(baud=self.baud)
        return Attempt(line=self._awakening.line) if self._awakening.line is not None else None

    def _sentence(self) -> str:
        rates = " or ".join(str(baud) for baud in self._awakening.bauds)
        return f"the base does not answer at {rates} baud: {self._awakening.remedy}"
