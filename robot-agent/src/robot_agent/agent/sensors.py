"""What the robot's own parts last told: the base through the guardian, and the lidar."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from robot_agent.guardian.link import BaseFeedback

_NEVER: Final = -math.inf


class BaseSource:
    """The newest feedback, and since when (s, monotonic) there is none."""

    def __init__(self) -> None:
        self.feedback: BaseFeedback | None = None
        self.lost: str | None = None
        """Why the link to the guardian is broken, in words; None while it holds."""
        self._at = _NEVER

    def on_feedback(self, feedback: BaseFeedback, now: float) -> None:
        """Take feedback that arrived at `now`."""
        self.feedback, self._at, self.lost = feedback, now, None

    def on_lost(self, reason: str) -> None:
        """Take that the link broke."""
        self.lost = reason

    def age(self, now: float) -> float:
        """Return how old (s) the feedback is; infinite when there never was any."""
        return now - self._at


class LidarSource:
    """When (s, monotonic) the lidar last sent anything, and a whole scan."""

    def __init__(self) -> None:
        self.identical_scans = 1
        """How many scans in a row are the same to the last bit: a live head never gives two equal ones."""
        self._node_at = _NEVER
        self._scan_at = _NEVER

    def on_nodes(self, now: float) -> None:
        """Take that anything arrived."""
        self._node_at = now

    def on_scan(self, repeats: int, now: float) -> None:
        """Take that a whole scan arrived, as the `repeats`-th equal one in a row."""
        self._scan_at = self._node_at = now
        self.identical_scans = repeats

    def node_age(self, now: float) -> float:
        """Return for how long (s) nothing has arrived."""
        return now - self._node_at

    def scan_age(self, now: float) -> float:
        """Return for how long (s) no whole scan has arrived."""
        return now - self._scan_at
