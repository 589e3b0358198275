"""Which hazards may be announced: dangers at once, reliefs only once they are stored. Pure; no I/O here.

A relief is a change that allows robots more than before. A slow or dead store must not delay a danger, and a crash must
not undo an announced relief: a `clear` that was announced but not stored would leave robots in an area that the
restarted aggregator announces as blocked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts.hazards import is_relief

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import AreaHazard


class Outbox:
    """Per area the newest hazard, whether it is stored, and the last announced one."""

    def __init__(self) -> None:
        self._announced: dict[str, AreaHazard] = {}
        self._unstored: dict[str, AreaHazard] = {}

    def offer(self, hazards: Iterable[AreaHazard]) -> list[AreaHazard]:
        """Add changed hazards, all of which must be stored; return those to announce at once."""
        to_announce: list[AreaHazard] = []
        for hazard in hazards:
            self._unstored[hazard.area] = hazard
            if not is_relief(hazard, self._announced.get(hazard.area)):
                self._announced[hazard.area] = hazard
                to_announce.append(hazard)
        return to_announce

    def unstored(self) -> list[AreaHazard]:
        """Return the hazards that must be stored, the newest of each area."""
        return list(self._unstored.values())

    def mark_stored(self, hazards: Iterable[AreaHazard]) -> list[AreaHazard]:
        """Record that these hazards are stored; return those to announce now, unless a newer one replaced them."""
        to_announce: list[AreaHazard] = []
        for hazard in hazards:
            if self._unstored.get(hazard.area) is not hazard:
                continue
            del self._unstored[hazard.area]
            if self._announced.get(hazard.area) is not hazard:
                self._announced[hazard.area] = hazard
                to_announce.append(hazard)
        return to_announce

    def announced(self) -> list[AreaHazard]:
        """Return the last announced hazard of every area, to republish after a reconnect."""
        return list(self._announced.values())

    def withheld(self) -> list[str]:
        """Return the areas whose newest hazard is announced only once it is stored."""
        return sorted(area for area, hazard in self._unstored.items() if self._announced.get(area) is not hazard)

    def set_epoch(self, epoch: int) -> None:
        """Give all hazards another epoch; those that are not stored yet must be stored with it."""
        for area, hazard in self._announced.items():
            renamed = self._announced[area] = structs.replace(hazard, epoch=epoch)
            if self._unstored.get(area) is hazard:
                self._unstored[area] = renamed
        for area, hazard in self._unstored.items():
            if hazard.epoch != epoch:
                self._unstored[area] = structs.replace(hazard, epoch=epoch)

    def forget(self, area: str) -> None:
        """Discard a removed area's hazards."""
        self._announced.pop(area, None)
        self._unstored.pop(area, None)
