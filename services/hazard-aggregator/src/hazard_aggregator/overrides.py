"""Operators' overrides of areas: which are in force, and when each ends (ADR 16). Pure; time is an argument.

An override ends by the monotonic clock. A restart within one boot of the machine changes nothing about that. After
another boot, or on another machine, nobody knows how long nothing ran: a blocked area stays so for the time that was
left when it was last stored, from the first start on, and an area that was declared clear is measured again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from hazard_aggregator.areas import AreaOverride, Rest

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import AreaHazard
    from hazard_aggregator.fusion import AreaFusion


@dataclass(frozen=True)
class StoredOverrides:
    """The stored overrides, and by area the stored rests of their times; `boot` identifies this run of the clock."""

    overrides: Iterable[AreaOverride]
    rests: Mapping[str, Rest]
    boot: str


@dataclass(frozen=True)
class _Entry:
    override: AreaOverride
    deadline: float


class Overrides:
    """The overrides by area, applied to the areas of `fusion`; each change returns the hazards that it changes.

    Until the stored ones are known (`replace_all`), those that another aggregator's hazards name count where they block
    an area (`follow`).
    """

    def __init__(self, fusion: AreaFusion) -> None:
        self._fusion = fusion
        self._entries: dict[str, _Entry] = {}
        self._ended: dict[str, AreaOverride] = {}
        self._heard: dict[str, tuple[int, int]] = {}
        self._loaded = False

    # --- State ------------------------------------------------------------------------------------------------------

    def get(self, area: str) -> AreaOverride | None:
        """Return the override of an area that is in force."""
        entry = self._entries.get(area)
        return None if entry is None else entry.override

    def known(self, area: str) -> AreaOverride | None:
        """Return the stored override of an area: it is in force, or has ended and is not deleted yet."""
        return self.get(area) or self._ended.get(area)

    def all(self) -> list[AreaOverride]:
        """Return all overrides in force that are stored."""
        return [entry.override for entry in self._entries.values() if entry.override.version > 0]

    def ended(self) -> list[AreaOverride]:
        """Return the stored overrides that have ended, which are to be deleted."""
        return list(self._ended.values())

    def rest_s(self, area: str, now: float) -> float:
        """Return the time (s) that is left of an area's override; 0 without one."""
        entry = self._entries.get(area)
        return 0.0 if entry is None else max(0.0, entry.deadline - now)

    def rests(self, boot: str, now: float) -> dict[str, Rest]:
        """Return what must be stored of the times of all stored overrides; `boot` identifies this run of the clock."""
        return {
            name: Rest(
                version=entry.override.version, rest_s=self.rest_s(name, now), boot=boot, deadline=entry.deadline
            )
            for name, entry in self._entries.items()
            if entry.override.version > 0
        }

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def put(self, override: AreaOverride, at: Moment) -> list[AreaHazard]:
        """Put a stored override of this boot into force, instead of the area's former one."""
        return self._put(_Entry(override, override.deadline), at)

    def remove(self, area: str, at: Moment) -> list[AreaHazard]:
        """End an area's override: it is not stored any more."""
        self._ended.pop(area, None)
        if self._entries.pop(area, None) is None:
            return []
        return self._fusion.set_override(area, None, at.stamp)

    def replace_all(self, stored: StoredOverrides, at: Moment) -> list[AreaHazard]:
        """Put the stored overrides into force, and end all others; those that are known keep their times."""
        self._loaded = True
        found = {override.area: override for override in stored.overrides}
        changed = [h for area in [*self._entries, *self._ended] if area not in found for h in self.remove(area, at)]
        for override in found.values():
            known = self.known(override.area)
            if known is None or known.version != override.version:
                changed += self._put(_restored(override, stored, at.now), at)
        return [*changed, *self.tick(at)]

    def tick(self, at: Moment) -> list[AreaHazard]:
        """End the overrides whose time is over, and those of removed areas: one that is defined again is another."""
        over = [
            entry.override
            for area, entry in self._entries.items()
            if at.now >= entry.deadline or self._fusion.is_removed(area)
        ]
        changed: list[AreaHazard] = []
        for override in over:
            changed += self.remove(override.area, at)
            if override.version > 0:
                self._ended[override.area] = override
        return changed

    def follow_others(self) -> None:
        """Let another aggregator's hazards name the overrides from now on: it changes them."""
        self._loaded = False

    def follow(self, hazard: AreaHazard, at: Moment) -> list[AreaHazard]:
        """Take over the override of another aggregator's hazard, as long as the stored ones are not known.

        Only one that blocks the area: no area counts as clear by hearsay.
        """
        if self._loaded or (hazard.epoch, hazard.seq) < self._heard.get(hazard.area, (0, 0)):
            return []
        self._heard[hazard.area] = hazard.epoch, hazard.seq
        found = hazard.override
        if found is None or found.state != "blocked":
            return self.remove(hazard.area, at)
        deadline = at.now + found.ttl_s
        override = AreaOverride(
            area=hazard.area, state=found.state, author=found.author, reason=found.reason, ttl_s=found.ttl_s,
            set_at=found.set_at, boot="", deadline=deadline, version=0,
        )  # fmt: skip
        return self._put(_Entry(override, deadline), at)

    def _put(self, entry: _Entry, at: Moment) -> list[AreaHazard]:
        self._ended.pop(entry.override.area, None)
        self._entries[entry.override.area] = entry
        return self._fusion.set_override(entry.override.area, entry.override, at.stamp)


def _restored(override: AreaOverride, stored: StoredOverrides, now: float) -> _Entry:
    """Return a stored override with its deadline by this machine's clock."""
    if stored.boot and override.boot == stored.boot:
        return _Entry(override, override.deadline)
    if override.state == "clear":
        return _Entry(override, now)
    rest = stored.rests.get(override.area)
    if rest is None or rest.version != override.version:
        return _Entry(override, now + override.ttl_s)
    return _Entry(override, rest.deadline if stored.boot and rest.boot == stored.boot else now + rest.rest_s)
