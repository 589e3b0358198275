"""The hazards and zones behind the costmap's cells, as regions, so that refusals can name them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts import channels as ch
from planner.regions import Region, hazard_region, zone_region

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import HazardArea, ZoneSet
    from planner.planning_map import PlanningMap


class BlockedRegions:
    """All published hazards and zones; `inflation_radius` (m) is how far their costs reach."""

    def __init__(self, inflation_radius: float) -> None:
        self._inflation_radius = inflation_radius
        self._hazards: dict[str, HazardArea] = {}
        self._zones: ZoneSet | None = None
        self._regions: tuple[GridGeometry, list[Region]] | None = None

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handlers of hazards and zones."""
        return {ch.HAZARD: self._on_hazard, ch.ZONES: self._on_zones}

    def blocking(self, planning_map: PlanningMap) -> list[Region]:
        """Return the regions that have lethal cells on the map."""
        geometry = planning_map.geometry
        if self._regions is None or self._regions[0] != geometry:
            self._regions = (geometry, self._rasterized(geometry))
        return [region for region in self._regions[1] if region.blocks(planning_map.cost)]

    def _rasterized(self, geometry: GridGeometry) -> list[Region]:
        reach = self._inflation_radius + 2 * geometry.resolution
        hazards = (hazard_region(hazard, geometry, reach) for _, hazard in sorted(self._hazards.items()))
        zones = (zone_region(zone, geometry, reach) for zone in (self._zones.zones if self._zones else []))
        return [region for region in (*hazards, *zones) if region is not None]

    def _on_hazard(self, _ids: Ids, hazard: HazardArea, _at: Moment) -> Sequence[Publication]:
        self._hazards[hazard.hazard.area] = hazard
        self._regions = None
        return ()

    def _on_zones(self, _ids: Ids, zones: ZoneSet, _at: Moment) -> Sequence[Publication]:
        self._zones = zones
        self._regions = None
        return ()
