"""Hazard areas: the hazards that the aggregator publishes, as cost and speed limit.

Penalty 254 is lethal and gets inflated, a lower one is a graded cost. An unknown area limits the speed too. An area
whose hazard was not received yet is unknown, with the penalty of its own policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.costs import DEGRADED_SPEED
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.handlers import Publication, RefusedMessageError
from fog_contracts.messages import SEVERITY, AreaHazard, Cause, HazardArea
from fog_contracts.raster import rasterize
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost, write_speed_limit

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.channels import Channel
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Handler, Ids, Moment
    from fog_contracts.messages import AreaDefinition
    from fog_contracts.raster import ShapeMask
    from map_service.layers.base import Grid


@dataclass
class _Area:
    definition: AreaDefinition
    mask: ShapeMask
    effective: AreaHazard


class HazardsLayer(CostLayer):
    """Holds every area's definition and hazard, which may arrive in any order."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._areas: dict[str, _Area] = {}
        self._received: dict[str, AreaHazard] = {}
        self._aggregator_lost = False

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handlers of area definitions and hazards."""
        return {ch.AREA_DEFINITION: self._on_definition, ch.AREA_HAZARD: self._on_hazard}

    def _on_definition(self, _ids: Ids, definition: AreaDefinition, _at: Moment) -> list[Publication]:
        try:
            return self.define(definition)
        except GeometryError as error:
            raise RefusedMessageError(f"area {definition.id}: {error}") from error

    def define(self, definition: AreaDefinition) -> list[Publication]:
        """Add, change or remove an area; raises `GeometryError` when its polygon is invalid.

        A version older than the known one is ignored.
        """
        old = self._areas.get(definition.id)
        if old is not None and (definition == old.definition or definition.version < old.definition.version):
            return []
        if definition.removed:
            if old is None:
                return []
            del self._areas[definition.id]
            self.mark_updated(old.mask.window, Cause(kind="hazard", id=definition.id, state="removed"))
            cleared = structs.replace(
                old.effective,
                state="clear",
                severity=SEVERITY["clear"],
                penalty=0,
                cause="the area was removed",
                trace=None,
            )
            return [_hazard_publication(old.definition, cleared)]
        mask = rasterize(normalized_polygon(definition.polygon), self._geometry)
        area = _Area(definition, mask, self._effective(definition))
        self._areas[definition.id] = area
        cause = Cause(kind="hazard", id=definition.id, state=area.effective.state)
        if old is not None:
            self.mark_updated(old.mask.window, cause)
        self.mark_updated(mask.window, cause, area.effective.trace)
        return [_hazard_publication(definition, area.effective)]

    def _on_hazard(self, _ids: Ids, hazard: AreaHazard, _at: Moment) -> list[Publication]:
        """Apply an area's hazard.

        Duplicate and outdated ones of the same epoch are ignored; one of an older epoch is applied only if it raises
        the cost (a clock that went back must not hide a danger).
        """
        old = self._received.get(hazard.area)
        if old is not None:
            if hazard.epoch == old.epoch and hazard.seq <= old.seq:
                return []
            if hazard.epoch < old.epoch and hazard.penalty <= old.penalty:
                return []
        self._received[hazard.area] = hazard
        return self._refresh(hazard.area)

    def set_aggregator_lost(self, lost: bool) -> list[Publication]:  # noqa: FBT001  # a setter
        """Set whether the aggregator is lost; while it is, no area counts as clear."""
        if lost == self._aggregator_lost:
            return []
        self._aggregator_lost = lost
        return [publication for area in list(self._areas) for publication in self._refresh(area)]

    def publications(self) -> list[Publication]:
        """Return the publications of all areas with their hazards."""
        return [_hazard_publication(area.definition, area.effective) for area in self._areas.values()]

    def areas_without_hazard(self) -> list[str]:
        """Return the defined areas whose hazard was not received yet."""
        return sorted(set(self._areas) - set(self._received))

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the penalties, and the speed limit of unknown areas."""
        for area in self._areas.values():
            if area.effective.penalty > 0:
                write_cost(area.mask, window, cost, area.effective.penalty)
            if area.effective.state == "unknown":
                write_speed_limit(area.mask, window, speed, DEGRADED_SPEED)

    def _refresh(self, name: str) -> list[Publication]:
        area = self._areas.get(name)
        if area is None:
            return []
        before, area.effective = area.effective, self._effective(area.definition)
        if area.effective == before:
            return []
        if (before.penalty, before.state) != (area.effective.penalty, area.effective.state):
            cause = Cause(kind="hazard", id=name, state=area.effective.state)
            self.mark_updated(area.mask.window, cause, area.effective.trace)
        return [_hazard_publication(area.definition, area.effective)]

    def _effective(self, definition: AreaDefinition) -> AreaHazard:
        """Return the hazard in force: the received one, or unknown when there is none or the aggregator is lost."""
        received = self._received.get(definition.id)
        if received is not None and (not self._aggregator_lost or received.state != "clear"):
            return received
        return AreaHazard(
            area=definition.id,
            state="unknown",
            severity=SEVERITY["unknown"],
            penalty=definition.unknown.penalty,
            since=received.since if received else 0.0,
            seq=received.seq if received else 0,
            epoch=received.epoch if received else 0,
            cause="the hazard aggregator or the broker is not connected"
            if received
            else "no hazard received from the hazard aggregator yet",
        )


def _hazard_publication(definition: AreaDefinition, hazard: AreaHazard) -> Publication:
    described = HazardArea(hazard=hazard, polygon=definition.polygon, label=definition.label)
    return Publication(ch.HAZARD, described, {"area": hazard.area})


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: HazardsLayer(plan.geometry))
