"""What may be said when: dangers at once, relief only once it is stored. Pure; nothing here sends or stores.

A slow or dead store must not withhold a danger, and a crash must not bring back a danger's opposite: a `clear` that was
announced and then forgotten would leave robots in an area that the restarted aggregator calls blocked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import AreaHazard


def relieves(hazard: AreaHazard, announced: AreaHazard | None) -> bool:
    """Whether a hazard allows robots more than what was announced before (nothing announced allows nothing)."""
    if announced is None:
        return hazard.state == "clear"
    if hazard.penalty < announced.penalty:
        return True
    return hazard.state == "clear" and announced.state != "clear"


class Outbox:
    """Per area the newest hazard, whether it is stored, and what was announced last."""

    def __init__(self) -> None:
        self._announced: dict[str, AreaHazard] = {}
        self._unstored: dict[str, AreaHazard] = {}

    def offer(self, hazards: Iterable[AreaHazard]) -> list[AreaHazard]:
        """Take changed hazards; return those to announce at once. All of them wait to be stored."""
        now: list[AreaHazard] = []
        for hazard in hazards:
            self._unstored[hazard.area] = hazard
            if not relieves(hazard, self._announced.get(hazard.area)):
                self._announced[hazard.area] = hazard
                now.append(hazard)
        return now

    def unstored(self) -> list[AreaHazard]:
        """Return what has to be stored, the newest of each area."""
        return list(self._unstored.values())

    def stored(self, hazards: Iterable[AreaHazard]) -> list[AreaHazard]:
        """Take that these are stored now; return those that may be announced for it, unless a newer one came."""
        now: list[AreaHazard] = []
        for hazard in hazards:
            if self._unstored.get(hazard.area) is not hazard:
                continue
            del self._unstored[hazard.area]
            if self._announced.get(hazard.area) is not hazard:
                self._announced[hazard.area] = hazard
                now.append(hazard)
        return now

    def announced(self) -> list[AreaHazard]:
        """Return what was announced last of every area: what to say again after a reconnect."""
        return list(self._announced.values())

    def withheld(self) -> list[str]:
        """Return the areas whose newest hazard waits for the store."""
        return sorted(area for area, hazard in self._unstored.items() if self._announced.get(area) is not hazard)

    def forget(self, area: str) -> None:
        """Drop an area that was removed."""
        self._announced.pop(area, None)
        self._unstored.pop(area, None)
