"""The sleep of a base whose robot rests: only one that can be woken again is put to sleep. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.guardian.revival import Attempt
from robot_agent.hardware import SleepingDriver

if TYPE_CHECKING:
    from robot_agent.hardware import BaseDriver

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
