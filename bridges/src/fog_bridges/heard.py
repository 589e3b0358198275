"""Which robots are there: a goal for one that is switched off would send it away once somebody switches it on."""

from __future__ import annotations

import math
from typing import Final

from fog_bridges.floor import WAITS

SILENT_S: Final = 5.0
"""A robot that tells no state for so long is not there; it tells one each second."""
SILENT: Final = f"the robot is silent: it has told no state for {SILENT_S:.0f} s, so it may be switched off"
"""Why such a robot gets no goal."""


class Heard:
    """When each robot told its state last, by a monotonic clock (s)."""

    def __init__(self) -> None:
        self._at: dict[str, float] = {}

    def hear(self, robot: str, now: float) -> None:
        """Take in that a robot tells its state."""
        self._at[robot] = now

    def forget(self, robot: str) -> None:
        """Drop a robot that is gone."""
        self._at.pop(robot, None)

    def silent_s(self, robot: str, now: float) -> float:
        """Return for how long a robot has told nothing (s); infinite if it never did."""
        return now - self._at.get(robot, -math.inf)

    def refusal(self, robot: str, now: float, *, waits: bool) -> str:
        """Return why a robot takes no goal, empty if it does; `waits`: an operator has to enable or reset it first."""
        if self.silent_s(robot, now) >= SILENT_S:
            return f"{SILENT}: send the goal again once it is back"
        return WAITS if waits else ""
