"""When the guardian's heartbeats are due, and when the watchdog gives a guardian without any up as hung. Pure.

The watchdog uses this too, so it imports almost nothing.
"""

from __future__ import annotations

import math
from typing import Final

SHORTEST_S: Final = 0.07
"""No two heartbeats are nearer to one another: they share the guardian's wake-ups for base and agent."""
LONGEST_S: Final = 0.105
"""The longest pause that the guardian leaves between two, however commands and frames wake it: a little more than that
between two commands to a robot that stands, so that these alone wake its guardian."""
LATENESS_S: Final = 0.095
"""Real seconds by which the machine may delay a heartbeat or the watchdog.

Programs of normal priority get 50 ms of each second before any with a real-time priority, by the kernel's own rule.
"""


def silence_limit(speed: float) -> float:
    """Return the real seconds without a heartbeat after which the guardian is killed: 0.2 at speed 1.

    speed: simulated over wall time. It shortens the pauses, but no delay of the machine.
    """
    return LONGEST_S / speed + LATENESS_S


class Heartbeats:
    """The times of one guardian's heartbeats; `now` is s of its clock."""

    def __init__(self) -> None:
        self._sent_at = -math.inf

    def wait(self, longest: float, now: float) -> float:
        """Return how long (s) the guardian may wait for events: `longest`, or until a heartbeat has to be sent."""
        return max(0.0, min(longest, self._sent_at + LONGEST_S - now))

    def is_due(self, now: float) -> bool:
        """Return whether to send one now; if so, it counts as sent."""
        if now - self._sent_at < SHORTEST_S:
            return False
        self._sent_at = now
        return True
