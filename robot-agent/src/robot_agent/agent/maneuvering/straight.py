"""Straight ahead or back by a short way, measured by the wheels: off the dock, from a bump, or to look around. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.stop_field import Wheels

ROLL_MAX_M: Final = 0.05
"""How far a robot may still roll the other way after it was told to stop: what it needs from 0.3 m/s."""


class Straight:
    """One such movement: how far (m, negative: back) and how fast (m/s)."""

    def __init__(self, distance: float, speed: float) -> None:
        self._distance = abs(distance)
        self._sign = math.copysign(1.0, distance)
        self._speed = speed
        self._begun_at: Pose2 | None = None
        self._rolled = 0.0

    def begin(self, odom: Pose2 | None) -> None:
        """Begin at this pose in `odom`; None: there is no odometry, and no way to measure it."""
        self._begun_at, self._rolled = odom, 0.0

    def advance(self, odom: Pose2 | None) -> None:
        """Let the way count from where the robot turns round, if it still rolls the other way when it begins."""
        if odom is None or self._begun_at is None:
            return
        rolled = -self._sign * odom.relative_to(self._begun_at).x
        if 0.0 < rolled <= ROLL_MAX_M - self._rolled:
            self._begun_at, self._rolled = odom, self._rolled + rolled

    def remaining(self, odom: Pose2 | None) -> float:
        """Return the way (m) that is left; infinite if it can't be measured."""
        if odom is None or self._begun_at is None:
            return math.inf
        return self._distance - self._sign * odom.relative_to(self._begun_at).x

    @property
    def wheels(self) -> Wheels:
        """The wheel speeds, m/s."""
        speed = self._sign * self._speed
        return speed, speed
