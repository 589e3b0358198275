"""The way that the robot has just driven, to back up along it: what it came through was free. Frame: `odom`.

A correction of the pose in `map` moves no point of it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.pose import Pose2

LENGTH_M: Final = 0.6
"""Longer ago something may have come."""
_SPACING_M: Final = 0.02


class Trail:
    """The last places of the robot, the newest one last."""

    def __init__(self) -> None:
        self._places: list[tuple[float, float]] = []

    @property
    def length(self) -> float:
        """Metres of it."""
        return _SPACING_M * max(len(self._places) - 1, 0)

    def clear(self) -> None:
        """Forget it: the robot may have been moved by others."""
        self._places.clear()

    def add(self, pose: Pose2) -> None:
        """Record where the robot is; on its way back it takes up what it passes again."""
        places, here = self._places, (pose.x, pose.y)
        if not places:
            places.append(here)
        back = False
        while len(places) > 1 and math.dist(places[-2], here) < math.dist(places[-1], here):
            places.pop()
            back = True
        away = math.dist(places[-1], here)
        if back or away < _SPACING_M:
            return
        x, y = places[-1]
        for step in range(1, int(away / _SPACING_M) + 1):
            share = step * _SPACING_M / away
            places.append((x + share * (pose.x - x), y + share * (pose.y - y)))
        del places[: -round(LENGTH_M / _SPACING_M) - 1]

    def behind(self, pose: Pose2) -> NDArray[np.float64]:
        """Return its points (n, 2; m) in `base` of a robot at `pose`, the nearest one first."""
        if not self._places:
            return np.zeros((0, 2))
        return pose.inverse_transform(np.array(self._places[::-1]))
