"""How a base is woken: what to try on one that does not answer, and the sleep of one whose robot rests. Pure.

On a base that does not answer: a pulse on the line that wakes it, then its other baud rates. Only a base that can be
woken again is put to sleep.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.hardware import SleepingDriver

if TYPE_CHECKING:
    from robot_agent.hardware import Awakening, BaseDriver, WakeLine

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


SETTLE_S: Final = 1.0
"""After the command frames of before may still arrive."""
ASK_S: Final = 0.5
"""Period of asking a sleeping base: its button or its schedule may have woken it, and let it drive."""
AGAIN_S: Final = 60.0
"""One that did not stay asleep is left awake for so long."""
_FIRST_QUESTIONS: Final = 4
"""One that is woken by questions may lose the first ones while it starts."""
_SLEEPS: Final = 2
"""So many sleeps in a row must end by first questions: one may have ended by a button just then."""


class BaseSleep:
    """The sleep of one base; `now` is s of a monotonic clock."""

    def __init__(self, driver: BaseDriver) -> None:
        self._driver = driver
        self.asleep = False
        self._begun_at = self._awake_until = -math.inf
        self._asked = 0
        self._ended_at_once = 0
        """How many sleeps in a row have ended by one of the first questions."""

    def begin(self, now: float) -> bytes:
        """Put it to sleep, if it can be woken again by a line; return the bytes for it."""
        if not isinstance(self._driver, SleepingDriver) or self._driver.awakening.line is None:
            return b""
        if now < self._awake_until:
            return b""
        self.asleep, self._begun_at, self._asked = True, now, 0
        return self._driver.sleep()

    def end(self) -> Attempt:
        """Wake it; return the pulse for that. Afterwards it is started as ever."""
        self.asleep = False
        return Attempt(line=self._driver.awakening.line)

    def ask(self, now: float) -> bool:
        """Return whether to wake it as if it heard, which stops it and lets it answer if it does.

        One that seems to be woken by the questions is asked no more.
        """
        if self._ended_at_once >= _SLEEPS or now < self._begun_at + SETTLE_S + self._asked * ASK_S:
            return False
        self._asked += 1
        return True

    def on_frame(self, now: float) -> bool:
        """Note that it has sent a frame; return whether it is awake: by button, schedule or question, or all along."""
        if now < self._begun_at + SETTLE_S:
            return False
        if self._ended_at_once < _SLEEPS:
            self._ended_at_once = self._ended_at_once + 1 if 1 <= self._asked <= _FIRST_QUESTIONS else 0
        self.asleep, self._awake_until = False, now + AGAIN_S
        return True
