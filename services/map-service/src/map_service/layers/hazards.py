"""Hazard areas: the hazards that the aggregator publishes, as cost and speed limit.

Penalty 254 is lethal and gets inflated, a lower one is a graded cost. An unknown area limits the speed too. A clear
area whose hazard no living aggregator confirms is unknown, with the penalty of its own policy, as is one whose hazard
was not received yet; what was blocked stays blocked. An area that an operator declared clear stays passable for as long
as that was meant to last, then it is what its nodes measured. Parts of a blocked area that its sensors show free are
slow instead of lethal, while the aggregator confirms that (`free_parts`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.costs import DEGRADED_SPEED, LETHAL
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.handlers import Fence, Publication, RefusedMessageError
from fog_contracts.messages import SEVERITY, AreaHazard, Cause, HazardArea, is_relief
from fog_contracts.shapes import rasterize
from map_service.aggregator_monitor import AggregatorMonitor
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost, write_speed_limit
from map_service.layers.free_parts import free_cells

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.channels import Channel
    from fog_contracts.grid import StaticMap, Window
    from fog_contracts.handlers import Handler, Ids, Moment
    from fog_contracts.messages import AggregatorHeartbeat, AreaDefinition
    from fog_contracts.shapes import ShapeMask
    from map_service.layers.base import Grid
    from map_service.layers.free_parts import Mask

_AGGREGATOR: Final = ch.AREA_HAZARD.publishers[0]


@dataclass
class _Area:
    definition: AreaDefinition
    mask: ShapeMask
    shown: AreaHazard
    """The hazard on the map."""
    accepted: AreaHazard | None = None
    """The last hazard that was confirmed or is no relief."""
    confirmed: bool = False
    declared_clear_at: float = 0.0
    """When the operator did so whose override was accepted last (`set_at`)."""
    declared_until: float = -math.inf
    """How long that override may count while no aggregator lives that would end it (s, monotonic)."""
    free: Mask | None = None
    """The cells of the mask's window that are free while the area is blocked; None: none."""
    defined_by: int = 0
    """The highest epoch of an aggregator that announced this definition."""


class HazardsLayer(CostLayer):
    """Holds every area's definition and hazard, which may arrive in any order."""

    def __init__(self, static: StaticMap) -> None:
        super().__init__()
        self._static, self._geometry = static, static.geometry
        self._areas: dict[str, _Area] = {}
        self._received: dict[str, AreaHazard] = {}
        self._removed: dict[str, HazardArea] = {}
        self._last_of_removed: dict[str, tuple[int, int]] = {}
        """Epoch and seq of the last hazard of each removed area: neither it nor one before it is another area's."""
        self._unlisted: set[str] = set()
        """Which of them were not said to be removed: a heartbeat did not list them, and may have come late."""
        self._lower: dict[str, AreaDefinition] = {}
        """Definitions by newer aggregators with versions below the known ones: they count if the sender is complete."""
        self._fence = Fence()
        self.aggregator = AggregatorMonitor()

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handlers of area definitions, hazards and the aggregator's heartbeat."""
        return {
            ch.AREA_DEFINITION: self._on_definition,
            ch.AREA_HAZARD: self._on_hazard,
            ch.AGGREGATOR_HEARTBEAT: self._on_heartbeat,
        }

    def tick(self, at: Moment) -> list[Publication]:
        """Let clear areas become unknown when the aggregator does not confirm them any more."""
        return self._refresh_all(at)

    def requests(self, at: Moment) -> list[Publication]:
        """Return the request to publish everything again, when something is missing and it is time to ask."""
        due = self.aggregator.request_due(at.now)
        return [Publication(ch.AGGREGATOR_REQUEST, ch.REPUBLISH)] if due else []

    def _on_definition(self, _ids: Ids, definition: AreaDefinition, at: Moment) -> list[Publication]:
        """Receive an area's definition; one with a lower version than the known one waits for its sender's heartbeat.

        It is outdated, unless a newer aggregator has the stored areas and no higher version among them: then Redis lost
        some, and versions began anew.
        """
        known = self._areas.get(definition.id)
        try:
            if known is not None and definition.version < known.definition.version:
                normalized_polygon(definition.polygon)
                if definition.epoch > known.defined_by:
                    self._lower[definition.id] = definition
                return []
            return self._announced(definition, at)
        except GeometryError as error:
            raise RefusedMessageError(f"area {definition.id}: {error}") from error

    def _announced(self, definition: AreaDefinition, at: Moment) -> list[Publication]:
        """Define an area as an aggregator announced it: who publishes it does not change it."""
        self._lower.pop(definition.id, None)
        publications = self.define(structs.replace(definition, epoch=0), at)
        if (area := self._areas.get(definition.id)) is not None:
            area.defined_by = max(area.defined_by, definition.epoch)
        return publications

    def define(self, definition: AreaDefinition, at: Moment) -> list[Publication]:
        """Add, change or remove an area; raises `GeometryError` when its polygon is invalid."""
        old = self._areas.get(definition.id)
        if old is not None and definition == old.definition:
            return []
        if definition.removed:
            self._unlisted.discard(definition.id)
            return self._remove(definition.id)
        mask = rasterize(normalized_polygon(definition.polygon), self._geometry)
        if old is None:
            area = _Area(definition, mask, _unknown(definition, None, at.stamp))
        else:
            area = replace(old, definition=definition, mask=mask)
        area.free = None
        self._areas[definition.id] = area
        self._removed.pop(definition.id, None)
        self._update(area, at)
        cause = Cause(kind="hazard", id=definition.id, state=area.shown.state)
        if old is not None:
            self.mark_updated(old.mask.window, cause)
        self.mark_updated(mask.window, cause, area.shown.trace)
        return [_publication(area)]

    def _on_hazard(self, ids: Ids, hazard: AreaHazard, at: Moment) -> list[Publication]:
        """Receive an area's hazard.

        Duplicate and outdated ones of the same epoch are ignored. Of an aggregator that was replaced by the one that
        the map believes only dangers count; the others raise `RefusedMessageError`.
        """
        if hazard.area != ids["area"]:
            raise RefusedMessageError(f"it is about another area, {hazard.area}")
        old = self._received.get(hazard.area)
        last_of_removed = self._last_of_removed.get(hazard.area, (0, 0))
        outdated = hazard.epoch == last_of_removed[0] and hazard.seq <= last_of_removed[1]
        if outdated and not (hazard.area in self._unlisted and self.aggregator.confirms(hazard, at.now)):
            return []
        if old is not None:
            if hazard.epoch == old.epoch and hazard.seq <= old.seq:
                return []
            if hazard.penalty <= old.penalty:
                self._fence.require_current(_AGGREGATOR, hazard.epoch)
        self._received[hazard.area] = hazard
        self.aggregator.on_hazard(hazard)
        return self._refresh(hazard.area, at)

    def _on_heartbeat(self, _ids: Ids, heartbeat: AggregatorHeartbeat, at: Moment) -> list[Publication]:
        self.aggregator.on_heartbeat(heartbeat, self._received, self._areas.keys(), at.now)
        self._fence.raise_to(_AGGREGATOR, self.aggregator.epoch or 0)
        changed: list[Publication] = []
        if (listed := self.aggregator.areas(at.now)) is not None:
            epoch = self.aggregator.epoch or 0
            # What a newer aggregator has defined, which is not believed yet, this one can't know.
            gone = [name for name, area in self._areas.items() if name not in listed and area.defined_by <= epoch]
            changed = [p for name in gone for p in self._remove(name)]
            self._unlisted.update(gone)
            own = [d for d in self._lower.values() if d.epoch == self.aggregator.epoch]
            changed += [p for definition in own for p in self._announced(definition, at)]
            self._received = {n: hazard for n, hazard in self._received.items() if n in listed or n in self._areas}
        return [*changed, *self._refresh_all(at)]

    # --- State ------------------------------------------------------------------------------------------------------

    def hazards(self) -> list[HazardArea]:
        """Return every area with its hazard."""
        return [_described(area) for area in self._areas.values()]

    def hazard(self, name: str) -> HazardArea:
        """Return an area with its hazard, a removed one as it was last published; raises `RefusedMessageError`."""
        if (area := self._areas.get(name)) is not None:
            return _described(area)
        if (removed := self._removed.get(name)) is not None:
            return removed
        raise RefusedMessageError(f"there is no area {name}")

    def publications(self) -> list[Publication]:
        """Return the publications of all areas with their hazards."""
        return [_publication(area) for area in self._areas.values()]

    def areas_without_hazard(self) -> list[str]:
        """Return the defined areas whose hazard was not received yet, or is a relief that is not confirmed yet."""
        return sorted(
            name for name, area in self._areas.items() if area.accepted is None or area.accepted != self._received[name]
        )

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the penalties, and the speed limit of unknown areas."""
        for area in self._areas.values():
            _write(area, area.shown, window, cost, speed)

    def with_changes(self, shown: Mapping[str, AreaHazard]) -> CostLayer:
        """Return a layer that shows these hazards instead of the areas' own, for a dry run; use it before a change."""
        return _ChangedHazards(self._areas, shown)

    def window(self, area: str) -> Window:
        """Return the window of a known area."""
        return self._areas[area].mask.window

    def unknown_penalty(self, area: str) -> int:
        """Return the penalty of a known area while it is unknown."""
        return self._areas[area].definition.unknown.penalty

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _remove(self, name: str) -> list[Publication]:
        area = self._areas.pop(name, None)
        self._lower.pop(name, None)
        if area is None:
            return []
        self.mark_updated(area.mask.window, Cause(kind="hazard", id=name, state="removed"))
        area.shown = structs.replace(
            area.shown,
            state="clear",
            severity=SEVERITY["clear"],
            penalty=0,
            cause="the area was removed",
            trace=None,
            free=[],
        )
        area.confirmed = False  # nobody watches it any more
        self._removed[name] = _described(area)
        if (last := self._received.pop(name, None)) is not None:
            self._last_of_removed[name] = last.epoch, last.seq
        return [_publication(area)]

    def _refresh_all(self, at: Moment) -> list[Publication]:
        return [publication for name in self._areas for publication in self._refresh(name, at)]

    def _refresh(self, name: str, at: Moment) -> list[Publication]:
        area = self._areas.get(name)
        if area is None:
            return []
        before, confirmed = area.shown, area.confirmed
        self._update(area, at)
        if (area.shown, area.confirmed) == (before, confirmed):
            return []
        if (before.penalty, before.state, before.free) != (area.shown.penalty, area.shown.state, area.shown.free):
            cause = Cause(kind="hazard", id=name, state=area.shown.state)
            self.mark_updated(area.mask.window, cause, area.shown.trace)
        return [_publication(area)]

    def _update(self, area: _Area, at: Moment) -> None:
        """Set the hazard on the map, and the cells of its free parts."""
        before = area.shown.free if area.free is not None else []
        self._update_shown(area, at)
        shown, width = area.shown, area.definition.free_width
        if not shown.free or width is None or shown.state != "blocked":
            area.free = None
        elif shown.free != before:
            area.free = free_cells(area.mask, shown.free, width, self._static)

    def _update_shown(self, area: _Area, at: Moment) -> None:
        """Show the accepted hazard, or unknown when nobody upholds that the area is clear."""
        received = self._received.get(area.definition.id)
        confirmed = received is not None and self.aggregator.confirms(received, at.now)
        if received is not None and (confirmed or not _may_relieve(received, area.shown)):
            area.accepted = received
            _note_declaration(area, received, at.now)
        elif received is not None and received.free:
            whole = structs.replace(received, free=[])
            if not _may_relieve(whole, area.shown):  # that it is blocked needs no confirmation, only its free parts do
                area.accepted = whole
        accepted = area.accepted
        upheld = accepted is not None and self.aggregator.upholds(area.definition.id, at.now)
        area.confirmed = confirmed or upheld
        declared_clear = accepted is not None and _declares_clear(accepted) and at.now >= area.declared_until
        if accepted is not None and (area.confirmed or not (accepted.state == "clear" or declared_clear)):
            area.shown = accepted if area.confirmed or not accepted.free else structs.replace(accepted, free=[])
            return
        unknown = _unknown(area.definition, received, at.stamp)
        if (area.shown.state, area.shown.cause) == (unknown.state, unknown.cause):
            unknown = structs.replace(unknown, since=area.shown.since)
        area.shown = unknown


class _ChangedHazards(CostLayer):
    """Areas as they would be."""

    def __init__(self, areas: Mapping[str, _Area], shown: Mapping[str, AreaHazard]) -> None:
        super().__init__()
        self._areas = areas
        self._shown = shown

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the areas' hazards as they would be."""
        for name, area in self._areas.items():
            _write(area, self._shown.get(name, area.shown), window, cost, speed)


def _write(area: _Area, hazard: AreaHazard, window: Window, cost: Grid, speed: Grid) -> None:
    if hazard.state == "blocked" and hazard.free and area.free is not None:
        write_cost(area.mask._replace(mask=area.mask.mask & ~area.free), window, cost, hazard.penalty)
        write_speed_limit(area.mask._replace(mask=area.free), window, speed, DEGRADED_SPEED)
    elif hazard.penalty > 0:
        write_cost(area.mask, window, cost, hazard.penalty)
    if hazard.state == "unknown":
        write_speed_limit(area.mask, window, speed, DEGRADED_SPEED)


def _declares_clear(hazard: AreaHazard) -> bool:
    return hazard.override is not None and hazard.override.state == "clear"


def _may_relieve(hazard: AreaHazard, shown: AreaHazard) -> bool:
    """Whether a hazard allows robots more than the one on the map, or than the area's nodes do."""
    return is_relief(hazard, shown) or _declares_clear(hazard)


def _note_declaration(area: _Area, hazard: AreaHazard, now: float) -> None:
    """Remember how long an operator's override may count that the area is clear, from when it was first accepted."""
    override = hazard.override
    if override is not None and override.state == "clear" and override.set_at != area.declared_clear_at:
        area.declared_clear_at, area.declared_until = override.set_at, now + override.ttl_s


def _unknown(definition: AreaDefinition, received: AreaHazard | None, stamp: float) -> AreaHazard:
    """Return the hazard of an area that nobody confirms to be clear, since `stamp`."""
    penalty = definition.unknown.penalty
    if received is not None and received.override is not None:
        penalty = max(penalty, received.override.measured_penalty)
    return AreaHazard(
        area=definition.id,
        state="unknown",
        severity=SEVERITY["unknown_after_blocked" if penalty >= LETHAL else "unknown"],
        penalty=penalty,
        since=stamp if received else 0.0,
        seq=received.seq if received else 0,
        epoch=received.epoch if received else 0,
        cause="the hazard aggregator does not confirm that the area is clear"
        if received
        else "no hazard received from the hazard aggregator yet",
    )


def _described(area: _Area) -> HazardArea:
    definition = area.definition
    return HazardArea(hazard=area.shown, polygon=definition.polygon, label=definition.label, confirmed=area.confirmed)


def _publication(area: _Area) -> Publication:
    return Publication(ch.HAZARD, _described(area), {"area": area.definition.id})


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: HazardsLayer(plan))
