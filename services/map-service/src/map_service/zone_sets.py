"""Sets of zones that are switched together: a zone is in force only while each set that it names is on. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.messages import Count, Id, Message, Sentence, WeeklySchedule
from map_service.zone_times import ScheduleTimes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.handlers import Moment


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
