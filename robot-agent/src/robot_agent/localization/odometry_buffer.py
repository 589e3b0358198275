"""The last seconds of odometry: where the robot was in `odom` at any time in them, and how fast it moves."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

from fog_kernels.scans import Track
from robot_agent.localization.pose import Pose2

_HISTORY_S: Final = 3.0
_EXTRAPOLATION_S: Final = 0.15
_TWIST_OVER_S: Final = 0.15
_TWIST_MIN_S: Final = 0.03


class OdometryBuffer:
    """Poses in `odom` (m, rad; theta not wrapped) by the time (s) at which they arrived, at most 3 s of them."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, float, float, float]] = deque()
        self._twist: tuple[float, float] | None = None
        """The twist by this history; None until somebody asks for it."""
        self._asked: tuple[float, Pose2 | None] = (math.nan, None)
        """The time that was asked for last, and the pose then: a tick of the agent asks for the same moment often."""

    def add(self, timestamp: float, x: float, y: float, theta: float) -> None:
        """Append a pose; one that is not newer than the last is ignored."""
        if self._history and timestamp <= self._history[-1][0]:
            return
        self._history.append((timestamp, x, y, theta))
        self._twist, self._asked = None, (math.nan, None)
        while self._history[0][0] < timestamp - _HISTORY_S:
            self._history.popleft()

    def reaches_back_to(self, timestamp: float) -> bool:
        """Whether there is a pose at this time (s) or before."""
        return bool(self._history) and self._history[0][0] <= timestamp

    def latest(self) -> Pose2 | None:
        """Return the newest pose; None before the first."""
        return Pose2(*self._history[-1][1:]) if self._history else None

    def pose(self, timestamp: float) -> Pose2 | None:
        """Return the pose at a time (s), interpolated; extrapolated by at most 0.15 s. None before the first."""
        if timestamp != self._asked[0]:
            self._asked = timestamp, self._pose(timestamp)
        return self._asked[1]

    def _pose(self, timestamp: float) -> Pose2 | None:
        if not self._history:
            return None
        last = self._history[-1]
        if timestamp > last[0]:
            return self._extrapolated(min(timestamp - last[0], _EXTRAPOLATION_S))
        # Asked for many times a second and nearly always about a moment ago: from the newest pose backwards.
        after = last
        for before in reversed(self._history):
            if before[0] <= timestamp:
                return _interpolated(before, after, timestamp)
            after = before
        return Pose2(*after[1:])

    def track(self, since: float) -> Track:
        """Return the poses that tell where the robot was from a time (s) on, as `pose` does; there must be one."""
        return Track(np.array(self._since(since)), *self.twist(), _EXTRAPOLATION_S)

    def _since(self, timestamp: float) -> list[tuple[float, float, float, float]]:
        """Return the poses from the last one at or before this time (s) on; of times before the first, all."""
        since: list[tuple[float, float, float, float]] = []
        for entry in reversed(self._history):
            since.append(entry)
            if entry[0] <= timestamp:
                break
        since.reverse()
        return since

    def _extrapolated(self, late: float) -> Pose2:
        """Return the pose `late` seconds after the newest, at the measured twist."""
        _, x, y, theta = self._history[-1]
        v, w = self.twist()
        heading = theta + 0.5 * w * late
        return Pose2(x + v * late * math.cos(heading), y + v * late * math.sin(heading), theta + w * late)

    def twist(self) -> tuple[float, float]:
        """Return forward speed (m/s) and turning rate (rad/s) over the last 0.15 s or more; zeros without that.

        Delayed readings arrive together with almost no time between them, so the interval must not begin within such a
        burst.
        """
        if self._twist is None:
            self._twist = self._measured_twist()
        return self._twist

    def _measured_twist(self) -> tuple[float, float]:
        if len(self._history) < 2:
            return 0.0, 0.0
        timestamp, x, y, theta = self._history[-1]
        earlier = (entry for entry in reversed(self._history) if entry[0] <= timestamp - _TWIST_OVER_S)
        old = next(earlier, self._history[0])
        span = timestamp - old[0]
        if span < _TWIST_MIN_S:
            return 0.0, 0.0
        heading = 0.5 * (theta + old[3])
        forward = (x - old[1]) * math.cos(heading) + (y - old[2]) * math.sin(heading)
        return forward / span, (theta - old[3]) / span


def _interpolated(
    before: tuple[float, float, float, float], after: tuple[float, float, float, float], timestamp: float
) -> Pose2:
    span = after[0] - before[0]
    share = (timestamp - before[0]) / span if span > 0.0 else 0.0
    x, y, theta = (old + share * (new - old) for old, new in zip(before[1:], after[1:], strict=True))
    return Pose2(x, y, theta)
