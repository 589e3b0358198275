"""Which areas are blocked, for how long others of their blocks lasted, by hour of the day, and what is stored. Pure.

Where few blocks of an hour were seen, the estimate leans on the area's at all hours, and that on a prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
from msgspec import Meta

from fog_contracts.costs import LETHAL
from fog_contracts.messages import Message, Stamp
from planner.waits.durations import AGES, Durations, mixture, survival

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import HazardArea
    from planner.waits.durations import Survival

PRIOR: Final = mixture(((0.65, 10.0), (0.35, 1800.0)))
"""Without any experience: shares of blocks, and how long these last on average (s): people, and things."""
PRIOR_BLOCKS: Final = 4.0
"""How many blocks of an area weigh as much as the prior ..."""
AREA_BLOCKS: Final = 15.0
"""... and how many of an hour as much as all hours of the area."""
LEARNED_BLOCKS: Final = 5.0
"""So many blocks of an area must have ended by themselves before its durations count as learned."""
_NEVER_S: Final = 300.0
"""An area whose blocks stood for longer than this in all, and none of which ended by itself, is not waited for."""
_SAVED_S: Final = 60.0
"""How often the age of a block that stands is stored."""


Hour = Annotated[str, Meta(pattern=r"^(1?[0-9]|2[0-3])$(?!\n)")]
Amount = Annotated[float, Meta(ge=0.0, le=1e12)]
Span = Annotated[int, Meta(ge=0, le=39)]


class StandingBlock(Message, frozen=True, kw_only=True):
    """A block that stands as it is stored: the hazard's `since`, its hour (UTC), its age (s) up to which it counts."""

    since: Stamp
    hour: Annotated[int, Meta(ge=0, le=23)]
    age: Amount


class BlockRecord(Message, frozen=True, kw_only=True):
    """The durations of an area's blocks as they are stored, by hour (UTC): (span, ended, spent) of those with any."""

    hours: dict[Hour, list[tuple[Span, Amount, Amount]]]
    standing: StandingBlock | None = None


@dataclass
class _Standing:
    """A block that stands; its age is `age` at `now` (s), and was counted up to `counted`."""

    since: float
    hour: int
    age: float
    now: float
    counted: float
    version: tuple[int, int]
    saved: float = -math.inf

    def age_at(self, now: float) -> float:
        return self.age + max(0.0, now - self.now)


class Blocks:
    """Follows which areas are blocked, and counts for how long."""

    def __init__(self) -> None:
        self._hours: dict[str, dict[int, Durations]] = {}
        self._standing: dict[str, _Standing] = {}
        self._stored: dict[str, StandingBlock] = {}
        """Blocks that stood when another process stored them, until their areas are heard of."""
        self._changed: set[str] = set()

    def on_hazard(self, area: HazardArea, at: Moment) -> None:
        """Follow an area: only what its sensors see counts, not what an operator declares, and no silence."""
        hazard, block = area.hazard, self._standing.get(area.hazard.area)
        version = (hazard.epoch, hazard.seq)
        if hazard.state == "blocked" and hazard.penalty >= LETHAL and hazard.override is None:
            if block is None:
                self._begin(hazard.area, hazard.since, version, at)
            else:
                block.version = version
        else:
            self._stored.pop(hazard.area, None)  # it ended while nobody looked: the part that was seen counts
            if block is not None:
                by_itself = hazard.state == "clear" and hazard.override is None and version != block.version
                self._count(hazard.area, block, at.now, ended=by_itself and area.confirmed)
                del self._standing[hazard.area]
        if hazard.area in self._standing or block is not None:
            self._changed.add(hazard.area)

    def _begin(self, area: str, since: float, version: tuple[int, int], at: Moment) -> None:
        """Note a block. It may have stood before, which only its stamp tells, or what another process has stored."""
        age = min(max(0.0, at.stamp - since), float(AGES[-1])) if since > 0.0 and at.synchronized else 0.0
        counted, hour = age, int((at.stamp - age) % 86_400 // 3600)
        if (stored := self._stored.pop(area, None)) is not None and stored.since == since:
            age, counted, hour = max(age, stored.age), stored.age, stored.hour
        self._standing[area] = _Standing(since, hour, age, at.now, counted, version)

    def _count(self, area: str, block: _Standing, now: float, *, ended: bool) -> None:
        age = block.age_at(now)
        hours = self._hours.setdefault(area, {})
        hours.setdefault(block.hour, Durations()).add(block.counted, age, ended=ended)
        block.counted = age

    def age(self, area: str, now: float) -> float | None:
        """Return for how long (s) an area has been blocked; None if it is not."""
        block = self._standing.get(area)
        return None if block is None else block.age_at(now)

    def survival(self, area: str, age: float, stamp: float, *, learned: bool) -> Survival | None:
        """Return how long a block of an area goes on that has this age; None if nobody may wait for it.

        That is an area that never cleared by itself, and with `learned` one of which too little is known.
        """
        hours = self._hours.get(area, {})
        whole = sum(hours.values(), Durations())
        ended = float(whole.ended.sum())
        if (learned and ended < LEARNED_BLOCKS) or (ended == 0.0 and max(whole.spent.sum(), age) > _NEVER_S):
            return None
        informed = whole.informed(PRIOR, PRIOR_BLOCKS)
        block = self._standing.get(area)
        hour = block.hour if block is not None else int(stamp % 86_400 // 3600)
        return survival(hours.get(hour, Durations()).informed(informed, AREA_BLOCKS), age)

    # --- Redis ------------------------------------------------------------------------------------------------------

    def to_store(self, now: float) -> dict[str, BlockRecord]:
        """Return the records of the areas that changed since the last call, or whose blocks are a minute older."""
        old = {area for area, block in self._standing.items() if now - block.saved >= _SAVED_S}
        due, self._changed = self._changed | old, set()
        return {area: self._record(area, now) for area in due}

    def store_again(self, areas: Iterable[str]) -> None:
        """Note that these could not be stored."""
        self._changed.update(areas)

    def _record(self, area: str, now: float) -> BlockRecord:
        standing = None
        if (block := self._standing.get(area)) is not None:
            self._count(area, block, now, ended=False)
            block.saved = now
            standing = StandingBlock(since=block.since, hour=block.hour, age=block.counted)
        hours = {
            str(hour): [
                (int(span), round(float(durations.ended[span]), 3), round(float(durations.spent[span]), 3))
                for span in np.flatnonzero(durations.spent + durations.ended)
            ]
            for hour, durations in self._hours.get(area, {}).items()
        }
        return BlockRecord(hours=hours, standing=standing)

    def restore(self, records: Mapping[str, BlockRecord], now: float) -> None:
        """Continue with what is stored, instead of what was counted here: another process has counted the same.

        A standby has followed the blocks that stand, too: each is as old as the older of both ages.
        """
        self._hours = {area: _hours(record) for area, record in records.items()}
        self._stored = {area: record.standing for area, record in records.items() if record.standing is not None}
        self._changed = set()
        for area, block in self._standing.items():
            stored = self._stored.pop(area, None)
            if stored is not None and stored.since == block.since:
                block.age += max(0.0, stored.age - block.age_at(now))
                block.counted = stored.age


def _hours(record: BlockRecord) -> dict[int, Durations]:
    found: dict[int, Durations] = {}
    for hour, spans in record.hours.items():
        durations = found[int(hour)] = Durations()
        for span, ended, spent in spans:
            durations.ended[span], durations.spent[span] = ended, spent
    return found
