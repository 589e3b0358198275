"""Turning in place to one side, to the other and back, so that scans can tell where the robot is. Pure.

The angle is measured by the wheels. The robot ends with the heading that it had.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.localization.pose import wrap

if TYPE_CHECKING:
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.stop_field import Wheels

_HEADINGS: Final = (0.7, -0.7, 0.0)
"""Headings (rad) to turn to, one after another, relative to the first: scans count 0.2 rad apart, and a lidar with a
mask sees other walls."""
_REACHED_RAD: Final = 0.04
_RATE_RAD_S: Final = 0.4
_SLOWEST_RAD_S: Final = 0.08
_GAIN_PER_S: Final = 2.0


class Turning:
    """One such movement of a robot whose wheels are so far apart (m), and that may turn so fast (rad/s)."""

    def __init__(self, axle_m: float, rate_max: float) -> None:
        self._half = 0.5 * axle_m
        self._rate = min(_RATE_RAD_S, rate_max)
        self._first: float | None = None
        self._left: list[float] = []

    def begin(self, odom: Pose2 | None) -> None:
        """Begin at this pose in `odom`; None: there is no odometry, and no way to measure it."""
        self._first = None if odom is None else odom.theta
        self._left = list(_HEADINGS)

    def advance(self, odom: Pose2 | None) -> None:
        """Go on to the next heading when one is reached."""
        if self._left and abs(self._error(odom)) <= _REACHED_RAD:
            self._left.pop(0)

    def remaining(self, odom: Pose2 | None) -> float:
        """Return by how much (rad) the robot has to turn yet; 0 at the end, infinite if it can't be measured."""
        if odom is None or self._first is None:
            return math.inf
        between = sum(abs(after - before) for before, after in zip(self._left, self._left[1:], strict=False))
        return between + abs(self._error(odom))

    def wheels(self, odom: Pose2 | None) -> Wheels:
        """Return the wheel speeds, m/s."""
        error = self._error(odom)
        if error == 0.0:
            return 0.0, 0.0
        rate = math.copysign(min(self._rate, max(_SLOWEST_RAD_S, _GAIN_PER_S * abs(error))), error)
        return -rate * self._half, rate * self._half

    def _error(self, odom: Pose2 | None) -> float:
        """Return the angle (rad) to the present heading; 0 when there is none."""
        if odom is None or self._first is None or not self._left:
            return 0.0
        return wrap(self._first + self._left[0] - odom.theta)
