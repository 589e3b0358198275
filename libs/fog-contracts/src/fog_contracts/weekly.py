"""The windows of a weekly schedule as moments, whatever the time zone and its changes of the clock. Pure."""

from __future__ import annotations

import math
from bisect import bisect_right
from datetime import UTC, date, datetime, time, timedelta
from typing import TYPE_CHECKING, Final, NamedTuple
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from fog_contracts.messages import WEEKDAYS

if TYPE_CHECKING:
    from fog_contracts.messages import WeeklySchedule

_VALID_DAYS: Final = 7
"""For the moments of so many days the windows are computed at a time."""
_AROUND_DAYS: Final = 10
"""How many days before and after those the windows reach: a week, and what time zones and late ends add."""


class TimeZoneError(ValueError):
    """This machine does not know a time zone, or not at that moment."""


_WEEK_S: Final = 7 * 86_400.0


class Window(NamedTuple):
    """A window: s since the epoch."""

    begin: float
    end: float

    @property
    def is_one(self) -> bool:
        """Whether it begins and ends: not if its schedule leaves no gap in a week."""
        return self.end - self.begin < _WEEK_S


class Windows:
    """The windows of a weekly schedule, computed for some days at a time. Those that touch are one."""

    def __init__(self, schedule: WeeklySchedule) -> None:
        self._schedule = schedule
        self._valid = (math.inf, -math.inf)
        self._windows: list[Window] = []

    def latest(self, stamp: float) -> Window | None:
        """Return the latest window that has begun by a moment, over or not, of the last week; None without one.

        Raises `TimeZoneError`.
        """
        index = self._after(stamp) - 1
        return self._windows[index] if index >= 0 else None

    def following(self, stamp: float) -> Window | None:
        """Return the first window that begins after a moment, within the next week; raises `TimeZoneError`."""
        index = self._after(stamp)
        return self._windows[index] if index < len(self._windows) else None

    def _after(self, stamp: float) -> int:
        if not self._valid[0] <= stamp < self._valid[1]:
            try:
                self._compute(stamp)
            except (ZoneInfoNotFoundError, ValueError, OverflowError, OSError) as error:
                raise TimeZoneError(f"time zone {self._schedule.time_zone}: {error}") from error
        return bisect_right(self._windows, stamp, key=lambda window: window.begin)

    def _compute(self, stamp: float) -> None:
        zone = ZoneInfo(self._schedule.time_zone)
        today = datetime.fromtimestamp(stamp, tz=zone).date()
        days = [today + timedelta(days=offset) for offset in range(-_AROUND_DAYS, _VALID_DAYS + _AROUND_DAYS)]
        windows = sorted(
            window_of(day, span.begin, span.end, zone)
            for day in days
            for span in self._schedule.times
            if WEEKDAYS[day.weekday()] in span.days
        )
        self._windows = []
        for begin, end in windows:
            if self._windows and begin <= self._windows[-1].end:
                self._windows[-1] = Window(self._windows[-1].begin, max(self._windows[-1].end, end))
            else:
                self._windows.append(Window(begin, end))
        # Whatever the offset from UTC, this moment is not later than `stamp`.
        begin_of = datetime.combine(today - timedelta(days=1), time(), tzinfo=UTC).timestamp()
        self._valid = begin_of, begin_of + 86_400.0 * _VALID_DAYS


def window_of(day: date, begin: str, end: str, zone: ZoneInfo) -> Window:
    """Return a window that begins on a day (local time, "HH:MM"), as moments; an end not later is of the next day.

    A local time that occurs twice (clocks set back) is the earlier one for the begin and the later one for the end; of
    one that does not occur (clocks set forward), likewise the earlier and the later reading: a window is rather too
    long than too short.
    """
    first, last = time.fromisoformat(begin), time.fromisoformat(end)
    end_day = day if last > first else day + timedelta(days=1)
    begins, ends = (
        [datetime.combine(on, at.replace(fold=fold), tzinfo=zone).timestamp() for fold in (0, 1)]
        for on, at in ((day, first), (end_day, last))
    )
    return Window(min(begins), max(ends))


def is_time_zone(name: str) -> bool:
    """Whether this machine knows a time zone (such as Europe/Lisbon)."""
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        return False
    return True
