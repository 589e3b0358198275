"""The newest hazards and zones, the reasons behind the costmap's lethal cells."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import contains_point
from fog_contracts.messages import HazardArea
from fog_contracts.shapes import shape_contains

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import Zone, ZoneSet
    from planner.reasons.regions import Source


class BlockedRegions:
    """All published hazards and zones; nothing is rasterized here, because that takes long for many zones."""

    def __init__(self) -> None:
        self._hazards: dict[str, HazardArea] = {}
        self._zones: ZoneSet | None = None
        self._sources: tuple[Source, ...] | None = None
        self.revision = 0
        """Grows with every change."""

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handlers of hazards and zones."""
        return {ch.HAZARD: self._on_hazard, ch.ZONES: self._on_zones}

    @property
    def sources(self) -> tuple[Source, ...]:
        """The hazards and zones that make cells lethal; the same until one changes.

        The map-service says which zones are in force: it decides by clocks and a history that nobody else has.
        """
        if self._sources is None:
            hazards = (self._hazards[area] for area in sorted(self._hazards))
            closing = [hazard for hazard in hazards if hazard.hazard.penalty == LETHAL]
            self._sources = (*closing, *(_no_go_zones(self._zones) if self._zones else ()))
        return self._sources

    def _on_hazard(self, _ids: Ids, hazard: HazardArea, _at: Moment) -> Sequence[Publication]:
        if self._hazards.get(hazard.hazard.area) != hazard:
            self._hazards[hazard.hazard.area] = hazard
            self._change()
        return ()

    def _on_zones(self, _ids: Ids, zones: ZoneSet, _at: Moment) -> Sequence[Publication]:
        if self._zones is None or (self._zones.zones, self._zones.active) != (zones.zones, zones.active):
            # Zones that did not change stay the same objects, so that they are not rasterized again.
            known = {zone.id: zone for zone in self._zones.zones} if self._zones else {}
            kept = [known[zone.id] if known.get(zone.id) == zone else zone for zone in zones.zones]
            self._zones = structs.replace(zones, zones=kept)
            self._change()
        return ()

    def _change(self) -> None:
        self._sources = None
        self.revision += 1


def _no_go_zones(zones: ZoneSet) -> list[Zone]:
    """Return the no-go zones in force."""
    active = frozenset(zones.active)
    return [zone for zone in zones.zones if zone.kind == "BLOCKED" and zone.id in active]


def cover(sources: Sequence[Source], x: float, y: float, margin: float) -> bool:
    """Whether a point (m, frame `map`) lies in one of the hazards or zones, or within about `margin` (m) of it."""
    offsets = [(0.0, 0.0)] + [(margin * math.cos(a), margin * math.sin(a)) for a in (0.8, 2.4, 3.9, 5.5)]
    return any(_contains(source, x + dx, y + dy) for source in sources for dx, dy in offsets)


def _contains(source: Source, x: float, y: float) -> bool:
    if isinstance(source, HazardArea):
        return contains_point(source.polygon, x, y)
    return shape_contains(source.shape, x, y)
