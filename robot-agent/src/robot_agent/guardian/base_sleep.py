"""The sleep of a base whose robot rests: only one that can be woken again is put to sleep. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from robot_agent.guardian.revival import Attempt
from robot_agent.hardware import SleepingDriver

if TYPE_CHECKING:
    from robot_agent.hardware import BaseDriver


class BaseSleep:
    """Whether one base is asleep."""

    def __init__(self, driver: BaseDriver) -> None:
        self._driver = driver
        self.asleep = False

    def begin(self) -> bytes:
        """Put it to sleep, if it can be woken again by a line; return the bytes for it."""
        if not isinstance(self._driver, SleepingDriver) or self._driver.awakening.line is None:
            return b""
        self.asleep = True
        return self._driver.sleep()

    def end(self) -> Attempt:
        """Wake it; return the pulse for that. Afterwards it is started as ever."""
        self.asleep = False
        return Attempt(line=self._driver.awakening.line)
