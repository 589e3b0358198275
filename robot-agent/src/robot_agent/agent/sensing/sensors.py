"""The newest input from base (through the guardian) and lidar, and its age."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.hardware import ASLEEP

if TYPE_CHECKING:
    from robot_agent.guardian.link import BaseFeedback

_NEVER: Final = -math.inf


class BaseSource:
    """The newest feedback and its age (s, monotonic)."""

    def __init__(self) -> None:
        self.feedback: BaseFeedback | None = None
        self.lost: str | None = None
        """Why the link to the guardian is broken; None while it is connected."""
        self._feedback_at = _NEVER
        self._docked_at: float | None = None

    def on_feedback(self, feedback: BaseFeedback, now: float) -> None:
        """Store feedback that arrived at `now`."""
        self.feedback, self._feedback_at, self.lost = feedback, now, None
        if not feedback.status.docked:
            self._docked_at = None
        elif self._docked_at is None:
            self._docked_at = now

    def on_lost(self, reason: str) -> None:
        """Record that the link broke."""
        self.lost = reason

    @property
    def ready(self) -> bool:
        """Whether the guardian does not keep the base at rest."""
        return self.feedback is not None and self.feedback.stopped is None

    @property
    def asleep(self) -> bool:
        """Whether the base sleeps: it does not notice if it is pushed."""
        return self.feedback is not None and self.feedback.stopped == ASLEEP

    def age(self, now: float) -> float:
        """Return the age (s) of the feedback; infinite without any."""
        return now - self._feedback_at

    def docked_for(self, now: float) -> float | None:
        """Return for how long (s) the robot has been on its dock; None off it."""
        return None if self._docked_at is None else now - self._docked_at


class LidarSource:
    """When (s, monotonic) the last samples and the last whole scan arrived."""

    def __init__(self) -> None:
        self.identical_scans = 1
        """1, and 1 more for each scan in a row that equals an earlier one: a working lidar never repeats a scan."""
        self._samples_at = _NEVER
        self._scan_at = _NEVER

    def on_samples(self, now: float) -> None:
        """Record that samples arrived."""
        self._samples_at = now

    def on_scan(self, repeats: int, now: float) -> None:
        """Record that a whole scan arrived; `repeats` as in `LaserScan`."""
        self._scan_at = self._samples_at = now
        self.identical_scans = repeats

    def samples_age(self, now: float) -> float:
        """Return the time (s) since samples last arrived."""
        return now - self._samples_at

    def scan_age(self, now: float) -> float:
        """Return the time (s) since a whole scan last arrived."""
        return now - self._scan_at
