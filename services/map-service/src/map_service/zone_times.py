"""When a zone is in force: its start, its end, its time to live, its weekly schedule (ADR 14) and its sets. Pure.

The clock on the wall may be wrong, and is set while the process runs. It only names moments for people: what it says
counts while the time is synchronized, and nothing ends by it alone. A zone that has started stays started, and ends
once as much time has passed by the monotonic clock as remained when its end became known; while the time is not known,
the zone is in force, which is the safe side. Only what was in force ends for good, and not before its start has come: a
clock that is wrong for a moment takes no zone from the future.

A zone is in force only while each set that it names is on, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Count, Id, Message, Sentence, WeeklySchedule, Zone
from fog_contracts.weekly import TimeZoneError, Windows

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.handlers import Moment
    from fog_contracts.shapes import Spans

_UNKNOWN_S: Final = 60.0
"""In a time zone that this machine does not know, a window lasts for so long, again and again: the safe side."""


class Progress(Message, frozen=True, kw_only=True):
    """What must survive a restart: whether this version of a zone has started or ended, and the time that remains.

    `rest_s` is what remained of its time to live, or until its end, when this was written; `deadline` is the same as a
    time of the monotonic clock of the boot `boot`, so that within a boot no restart prolongs it.
    """

    version: int
    started: bool
    ended: bool
    boot: str
    rest_s: float | None
    deadline: float | None


@dataclass(frozen=True, kw_only=True)
class StoredState:
    """What is known of stored zones besides themselves, by id: their cells, and their times as stored.

    `boot` identifies the run of this machine's clock.
    """

    spans: Mapping[str, Spans] = field(default_factory=dict)
    progress: Mapping[str, Progress] = field(default_factory=dict)
    boot: str = ""


class ZoneTimes:
    """Follows one version of a zone through time."""

    def __init__(self, zone: Zone, progress: Progress | None = None, *, boot: str = "", now: float = 0.0) -> None:
        self._zone = zone
        self._schedule = None if zone.schedule is None else ScheduleTimes(zone.schedule)
        self._started = self._ended = False
        self._deadline: float | None = None
        """When it ends at the earliest, by the monotonic clock; None while that is not known."""
        self._over_since = math.inf
        if progress is not None and progress.version == zone.version:
            self._restore(progress, boot, now)

    def is_active(self, at: Moment) -> bool:
        """Advance to `at`; return whether the zone is in force."""
        active = self._advance(at)
        over = self._zone.enabled and self._ended
        self._over_since = min(self._over_since, at.now) if over else math.inf
        return active

    def over_for(self, now: float) -> float:
        """Return for how long (s) the zone has been over after it was in force; negative: it is not.

        It counts from when that was noticed, by the monotonic clock. A zone whose time has passed without it is not
        over: a clock that is ahead says the same of zones to come.
        """
        return now - self._over_since

    def _advance(self, at: Moment) -> bool:
        if self._ended and at.synchronized and at.stamp < (self._zone.starts_at or -math.inf):
            self._started, self._ended, self._deadline = False, False, None  # a clock that was ahead had started it
        if not self._zone.enabled or self._ended:
            return False
        if not self._started and not self._start(at):
            return not at.synchronized
        if self._end(at):
            return False
        return self._schedule is None or self._schedule.includes(at)

    def progress(self, boot: str, now: float) -> Progress:
        """Return what is to be stored."""
        rest = None if self._deadline is None else max(0.0, self._deadline - now)
        return Progress(
            version=self._zone.version,
            started=self._started,
            ended=self._ended,
            boot=boot,
            rest_s=rest,
            deadline=self._deadline,
        )

    def _restore(self, progress: Progress, boot: str, now: float) -> None:
        self._started, self._ended = progress.started, progress.ended
        if boot and progress.boot == boot:
            self._deadline = progress.deadline
            if self._ended and self._deadline is not None:
                self._over_since = self._deadline
        elif self._zone.ttl_s is not None and progress.rest_s is not None:
            # Nobody knows how long the machine was off.
            self._deadline = now + progress.rest_s

    def _start(self, at: Moment) -> bool:
        """Start the zone if its time has come; return whether it has started."""
        starts_at = self._zone.starts_at
        begun = starts_at is None or (at.synchronized and starts_at <= at.stamp)
        self._started = begun and not self._is_past(at)
        if self._started and self._zone.ttl_s is not None:
            self._deadline = at.now + self._zone.ttl_s
        return self._started

    def _end(self, at: Moment) -> bool:
        """End the zone if its time has come; return whether it has ended."""
        if self._zone.ttl_s is not None:
            self._ended = self._deadline is not None and at.now >= self._deadline
        elif self._zone.expires_at is not None and at.synchronized:
            rest = self._zone.expires_at - at.stamp
            if self._deadline is None:
                self._deadline = at.now + max(0.0, rest)
            self._ended = rest <= 0.0 and at.now >= self._deadline
        return self._ended

    def _is_past(self, at: Moment) -> bool:
        """Whether the moment that was named as its end has passed."""
        end = self._zone.expires_at if self._zone.ttl_s is None else None
        return end is not None and at.synchronized and end <= at.stamp


class ScheduleTimes:
    """Follows a weekly schedule through time. While the time of day is not known, a window lasts."""

    def __init__(self, schedule: WeeklySchedule) -> None:
        self._windows = Windows(schedule)
        self._deadline = -math.inf
        """Until when the latest window lasts at least, by the monotonic clock."""

    def includes(self, at: Moment) -> bool:
        """Advance to `at`; return whether it is in a window."""
        if not at.synchronized:
            return True
        try:
            window = self._windows.latest(at.stamp)
        except TimeZoneError:
            end: float | None = at.stamp + _UNKNOWN_S
        else:
            end = window.end if window is not None and at.stamp < window.end else None
        if end is not None:
            self._deadline = max(self._deadline, at.now + end - at.stamp)
        return end is not None or at.now < self._deadline


# --- Sets of zones that are switched together, and sources that are muted ---------------------------------------------


class SetOfZones(Message, frozen=True, kw_only=True):
    """A set: it is on while it is enabled and, with a `schedule`, inside one of the schedule's windows."""

    id: Id
    name: Sentence = ""
    enabled: bool = True
    schedule: WeeklySchedule | None = None
    version: Count = 1


class MutedSource(Message, frozen=True, kw_only=True):
    """Whether an operator has muted a source of zones: then its messages are refused."""

    id: Id
    muted: bool
    version: Count = 1


class SetSwitches:
    """All sets, and which of them are off. A set that nobody knows counts as on, which is the safe side."""

    def __init__(self) -> None:
        self.sets: Mapping[str, SetOfZones] = {}
        """The sets by id; the same mapping until they change."""
        self.off: frozenset[str] = frozenset()
        self._times: dict[str, ScheduleTimes] = {}

    def replace_all(self, sets: Mapping[str, SetOfZones]) -> None:
        """Replace the sets; call `advance` then."""
        changed = {name for name, one in sets.items() if self.sets.get(name) != one}
        kept = {name: times for name, times in self._times.items() if name in sets and name not in changed}
        new = {name: ScheduleTimes(each) for name in changed if (each := sets[name].schedule) is not None}
        self.sets, self._times = sets, {**kept, **new}

    def advance(self, at: Moment) -> bool:
        """Switch the sets by their schedules; return whether one is on that was off before, or the other way round."""
        scheduled_off = {name for name, times in self._times.items() if not times.includes(at)}
        off = frozenset(name for name, one in self.sets.items() if not one.enabled or name in scheduled_off)
        changed, self.off = off != self.off, off
        return changed
