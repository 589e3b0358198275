"""Which scheduled mission is due, and which robot has been idle for long enough. Pure.

A mission is given once in each window of its weekly schedule: at the window's begin, or as soon within it as the robot
is free. A robot is never taken from another mission, nor from its visitor. Who writes a schedule starts nothing by
that: it counts from the next window on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.weekly import Window, Windows
    from planner.stops import ScheduledMission

SCHEDULES_MAX: Final = 100
_CLOCK_STEP_S: Final = 60.0
"""What was done later than now, by more than this, was done by a clock that was ahead."""


class Due(NamedTuple):
    """The window whose mission is to be given now or, if it is `over`, was missed."""

    window: Window
    over: bool


def is_dated(schedule: ScheduledMission, stamp: float) -> bool:
    """Whether the time at which it was written is known: not if the clock was not set then, or ahead."""
    return 0.0 < schedule.since <= stamp + _CLOCK_STEP_S


def due(schedule: ScheduledMission, windows: Windows, stamp: float) -> Due | None:
    """Return for which window something is to be done at `stamp`, None if nothing is; raises `TimeZoneError`."""
    if not schedule.enabled or (window := windows.latest(stamp)) is None or window.begin < schedule.since:
        return None
    last, over = schedule.last, stamp >= window.end
    if not is_dated(schedule, stamp) or not window.is_one:
        return None
    # What was given ahead of its time, by a clock that was ahead, counts for nothing, but is not missed either.
    counts = last is not None and (last.at <= stamp + _CLOCK_STEP_S or (over and last.begin > window.begin))
    if counts and last is not None and last.begin >= window.begin:
        return None
    return Due(window, over)


LONGEST_PAUSE_S: Final = 3600.0
"""No pause between two attempts at sending an idle robot to where it stays gets longer by itself."""


_MOST_DOUBLED: Final = 12
"""After so many attempts the pause is as long as it gets: a second has become more than an hour."""


class IdleTimes:
    """For how long robots have been idle. `now` is s of a monotonic clock."""

    def __init__(self, after_s: Mapping[str, float]) -> None:
        """`after_s`: by robot, after how long something is to be done about it."""
        self._after_s = after_s
        self._since: dict[str, float] = {}
        self._tries: dict[str, int] = {}

    def is_due(self, robot: str, now: float, *, idle: bool, afresh: bool) -> bool:
        """Note whether a robot is idle; return whether it is for long enough, after which its time begins anew.

        Each time twice as long as before, up to an hour, until it is told that the attempts count `afresh`: because
        one has succeeded, or because the robot has been elsewhere since.
        """
        if afresh:
            self._tries.pop(robot, None)
        after = self._after_s.get(robot)
        if after is None or not idle:
            self._since.pop(robot, None)
            return False
        tries = self._tries.get(robot, 0)
        if now - self._since.setdefault(robot, now) < max(after, min(after * 2.0**tries, LONGEST_PAUSE_S)):
            return False
        self._since[robot], self._tries[robot] = now, min(tries + 1, _MOST_DOUBLED)
        return True

    def clear(self) -> None:
        """Begin anew for all robots."""
        self._since.clear()
        self._tries.clear()
