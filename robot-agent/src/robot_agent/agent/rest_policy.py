"""When an idle robot rests, with its lidar's motor at a standstill, and when it is woken. Pure.

A robot is idle while it stands, follows no mission and searches no pose. A command of an operator, a new goal or a
maneuver wakes it; it is awake again after some whole scans, so that the head's spin-up is no failure of the lidar.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from robot_agent.safety.conditions import Localization, Request

SCANS_TO_WAKE: Final = 3
"""So many whole scans show that the head rotates evenly."""
WAKE_TIMEOUT_S: Final = 8.0
"""A lidar that has not woken after this long counts as silent."""
IDLE_SCANS: Final = 3
"""An idle robot that knows where it is looks at one of so many whole scans: two a second."""


class IdleScans:
    """Which whole scans count. An idle robot only looks for whether its pose still holds, after it was carried, say."""

    def __init__(self) -> None:
        self._skipped = 0

    def counts(self, *, idle: bool, status: Localization) -> bool:
        """Return whether to localize by the newest scan: by all of them, unless an idle robot knows where it is."""
        if idle and status == "good" and self._skipped < IDLE_SCANS - 1:
            self._skipped += 1
            return False
        self._skipped = 0
        return True


class RestPolicy:
    """The rest of one robot; `now` is s of its monotonic clock."""

    def __init__(self, rest_after: float) -> None:
        """Let it rest after so many seconds of idleness; 0: never."""
        self._rest_after = rest_after or math.inf
        self._idle_since = math.nan
        self._goal_id: str | None = None
        self._woken = False
        self._waking_since: float | None = None
        self._scans = 0
        self.lidar_on = True
        """Whether the lidar's motor has to turn."""

    def wake(self) -> None:
        """Wake the robot, or begin its idle time anew."""
        self._woken = True

    def on_request(self, request: Request) -> None:
        """Wake the robot for an operator's request, but not to stop it."""
        if request != "disable":
            self.wake()

    def on_scan(self) -> None:
        """Count a whole scan."""
        self._scans += 1

    def update(self, *, busy: bool, goal_id: str | None, now: float, base_ready: bool = True) -> None:
        """Decide anew; `busy`: the robot is not idle, `goal_id`: of its mission, `base_ready`: its base would drive."""
        if busy or self._woken or goal_id != self._goal_id or math.isnan(self._idle_since):
            self._idle_since = now
        self._woken, self._goal_id = False, goal_id
        idle = now - self._idle_since
        if not self.lidar_on:
            if idle == 0.0:
                self.lidar_on, self._waking_since, self._scans = True, now, 0
        elif self._waking_since is not None:
            awake = self._scans >= SCANS_TO_WAKE and base_ready
            if awake or now - self._waking_since > WAKE_TIMEOUT_S:
                self._waking_since = None
        elif idle >= self._rest_after:
            self.lidar_on = False

    @property
    def reason(self) -> str | None:
        """Why there are no scans now; None while the robot is awake."""
        if not self.lidar_on:
            return "at rest to save power, without its lidar: a goal or an operator's command wakes it"
        return None if self._waking_since is None else "waking up: its lidar starts"
