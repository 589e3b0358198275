"""Doubt in a pose that scans fit: whether the robot may be at another place, which looks like this one."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.localization.fit import casts_doubt

if TYPE_CHECKING:
    from robot_agent.localization.fit import Fit
    from robot_agent.localization.pose import Pose2

_VERIFIED_AFTER_M: Final = 5.0
"""A pose in doubt is verified by a search of the whole map, or by fitting for so long a drive, ..."""
_VERIFIED_AGREEMENT: Final = 0.7
"""... with this share of agreeing beams at least: half of a scan fits many corridors."""
_SUDDEN_DROP: Final = 0.13
"""A pose is suspect when the share of agreeing beams falls by more than this below its level: a robot that was carried
to a place like its own sees walls where the map has none. A person who steps before the lidar takes about as much."""
_LEVEL_GAIN: Final = 0.3
"""Weight of the newest scan in that level."""
_ACCEPTED_AFTER_M: Final = 2.0
"""After so long a drive a lower share is the level: the place is crowded, or was changed. If that share verifies no
pose, the pose is in doubt from then on: a robot that was carried away sees as much at the wrong place."""


class Doubt:
    """What speaks against a pose, by the odometry since then.

    A pose is in doubt when scans showed what no right pose shows, or when it was found again. It is suspect when fewer
    beams agree than before: something unknown stands around the robot, or it was carried away.
    """

    def __init__(self) -> None:
        self._since: Pose2 | None = None
        """Odometry at which scans last cast doubt on the pose, or it was found again; None once it is verified."""
        self._level: float | None = None
        """Share of agreeing beams that is usual here; None before the first scan of a pose."""
        self._suspect_for_m: float | None = None
        """How far the robot has driven since the pose became suspect, in however small a room."""
        self._last: Pose2 | None = None

    @property
    def reason(self) -> str:
        """Why a pose that fits is not good; empty if it may be."""
        if self._since is not None:
            return "the pose was in doubt and fits again: other places may look like this one"
        if self._suspect_for_m is not None:
            return "suddenly fewer beams end at walls of the map: something stands before them, or the robot was moved"
        return ""

    @property
    def to_verify(self) -> bool:
        """Whether the whole map is to be searched for places that look like that of the pose."""
        return self._since is not None

    def begin(self, odom: Pose2) -> None:
        """Doubt a pose from now on, because it was lost or found again."""
        self._since = odom

    def verify(self) -> None:
        """End the doubt: no other place looks like this one."""
        self._since = None

    def restart(self) -> None:
        """Forget everything of another pose."""
        self._since = self._level = self._suspect_for_m = None

    def add(self, fit: Fit, odom: Pose2, *, jumped: bool, rivalled: bool = False) -> None:
        """Add the fit of the newest scan; `jumped`: whether it moved the estimate to another place.

        `rivalled`: whether a search left other places that explain the scans as well: then no drive verifies a pose.
        """
        if self._since is not None and rivalled:
            self._since = odom
        if jumped or casts_doubt(fit) or (self._since is not None and fit.agree < _VERIFIED_AGREEMENT):
            self._since = odom
        elif self._since is not None and _driven(self._since, odom) > _VERIFIED_AFTER_M:
            self._since = None
        if self._follow_level(fit.agree, 0.0 if self._last is None else _driven(self._last, odom)):
            self._since = odom
        self._last = odom

    def _follow_level(self, agree: float, step_m: float) -> bool:
        """Follow the level by the newest scan's share; return whether the level that is new now verifies no pose."""
        if self._level is None:
            self._level = agree
        elif agree >= self._level - _SUDDEN_DROP:
            self._suspect_for_m = None
            self._level += _LEVEL_GAIN * (agree - self._level)
        elif self._suspect_for_m is None:
            self._suspect_for_m = 0.0
        elif (further := self._suspect_for_m + step_m) > _ACCEPTED_AFTER_M:
            self._level, self._suspect_for_m = agree, None
            return agree < _VERIFIED_AGREEMENT
        else:
            self._suspect_for_m = further
        return False


def _driven(since: Pose2, odom: Pose2) -> float:
    step = odom.relative_to(since)
    return math.hypot(step.x, step.y)
