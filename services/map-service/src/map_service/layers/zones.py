"""Operators' zones: no-go, penalty and speed limit, each while it is enabled and its time has come (`zone_times`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.costs import LETHAL, penalty_cost
from fog_contracts.messages import Cause
from fog_contracts.shapes import shape_spans
from fog_kernels.inflation import lower_speeds, raise_costs
from map_service.layers.base import CostLayer, LayerFactory, NoOptions
from map_service.zone_times import Progress, SetOfZones, SetSwitches, StoredState, ZoneTimes
from map_service.zones import PreparedZone, ZoneCatalog, ZoneEntry, named_spans

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Moment, Publication
    from fog_contracts.messages import Zone
    from fog_contracts.shapes import Spans
    from map_service.layers.base import Grid


def speed_layer_value(speed: float) -> int:
    """Return a speed limit (m/s) as a value of the speed layer (cm/s, rounded down, at least 1)."""
    return max(1, min(254, int(speed * 100.0 + 1e-6)))


class ZonesLayer(CostLayer):
    """Holds all zones; only active ones change costs."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self.catalog = ZoneCatalog()
        self.switches = SetSwitches()
        self._changed = False
        self._switched_cells = 0

    def put(self, zone: Zone, at: Moment, spans: Spans | None = None) -> None:
        """Add or replace a zone, whose cells may be given; raises `ShapeError` for an invalid shape."""
        self._put(zone, spans or shape_spans(zone.shape, self._geometry), ZoneTimes(zone), at)

    def remove(self, zone_id: str) -> None:
        """Remove a zone, if it exists."""
        old = self.catalog.remove(zone_id)
        if old is not None:
            self._changed = True
            if old.active:
                self._mark(old, "removed")

    def replace_all(self, zones: Iterable[Zone], at: Moment, stored: StoredState) -> None:
        """Replace all zones; those that are the same already keep their cells and times.

        For an invalid shape, raises `ShapeError`, which names the zone, and changes nothing.
        """
        prepared = [(z, self._known_spans(z, stored.spans) or named_spans(z, self._geometry)) for z in zones]
        kept = {zone.id for zone, _ in prepared}
        for name in self.catalog.ids():
            if name not in kept:
                self.remove(name)
        for zone, cells in prepared:
            times = ZoneTimes(zone, stored.progress.get(zone.id), boot=stored.boot, now=at.now)
            self._put(zone, cells, times, at)

    def put_sets(self, sets: Mapping[str, SetOfZones], at: Moment) -> None:
        """Replace the sets of zones, and put into force or end what they switch."""
        self.switches.replace_all(sets)
        self.tick(at)

    def pop_switched(self) -> int:
        """Return how many cells the windows of zones have that sets have switched since the last call."""
        cells, self._switched_cells = self._switched_cells, 0
        return cells

    def progress(self, boot: str, now: float) -> dict[str, Progress]:
        """Return, by id, what must be stored of the zones that begin or end."""
        return {entry.zone.id: entry.times.progress(boot, now) for entry in self.catalog.timed()}

    def over(self, seconds: float, now: float) -> list[Zone]:
        """Return the zones that have been over for so long (s)."""
        return [entry.zone for entry in self.catalog.timed() if entry.times.over_for(now) >= seconds]

    def pop_changed(self) -> bool:
        """Return whether a zone was added, changed, removed, activated or ended since the last call."""
        changed, self._changed = self._changed, False
        return changed

    def tick(self, at: Moment) -> list[Publication]:
        """Activate and end zones by their times and sets."""
        switched = self.switches.advance(at)
        entries = dict.fromkeys([*self.catalog.timed(), *(self.catalog.in_sets() if switched else ())])
        for entry in entries:
            active = self._is_active(entry.zone, entry.times, at)
            if active != entry.active:
                if switched and entry.zone.sets:
                    self._switched_cells += entry.spans.window.width * entry.spans.window.height
                self.catalog.set_active(entry, active)
                self._changed = True
                self._mark(entry, "active" if active else "inactive")
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the active zones."""
        _write([(entry.zone, entry.spans) for entry in self.catalog.active_in(window)], window, cost, speed)

    def with_changes(self, put: Sequence[PreparedZone], without: Collection[str]) -> CostLayer:
        """Return a layer that shows these zones in force, and none of the names in `without`, for a dry run.

        It reads this layer, and is to be used before that changes.
        """
        return _ChangedZones(self.catalog, put, without)

    def switched(self, sets: Mapping[str, bool], at: Moment) -> tuple[list[PreparedZone], list[str]]:
        """Return which zones would come into force, and which would end, if sets were switched, for a dry run.

        `sets`: by id, whether it would be on. A zone whose time has not come stays out of force.
        """
        off = (self.switches.off - sets.keys()) | {name for name, on in sets.items() if not on}
        begin: list[PreparedZone] = []
        end: list[str] = []
        for entry in self.catalog.in_sets():
            active = entry.times.is_active(at) and off.isdisjoint(entry.zone.sets)
            if active and not entry.active:
                begin.append(PreparedZone(entry.zone, entry.spans))
            elif entry.active and not active:
                end.append(entry.zone.id)
        return begin, end

    def _is_active(self, zone: Zone, times: ZoneTimes, at: Moment) -> bool:
        in_time = times.is_active(at)  # whatever its sets are: time goes on
        return in_time and self.switches.off.isdisjoint(zone.sets)

    def _known_spans(self, zone: Zone, given: Mapping[str, Spans]) -> Spans | None:
        old = self.catalog.get(zone.id)
        return old.spans if old is not None and old.zone.shape == zone.shape else given.get(zone.id)

    def _put(self, zone: Zone, spans: Spans, times: ZoneTimes, at: Moment) -> None:
        old = self.catalog.get(zone.id)
        if old is not None and old.zone == zone:
            return
        entry = ZoneEntry.of(zone, spans, times, active=self._is_active(zone, times, at))
        self.catalog.put(entry)
        self._changed = True
        if old is not None and old.active:
            self._mark(old, "active" if entry.active else "inactive")
        if entry.active:
            self._mark(entry, "active")

    def _mark(self, entry: ZoneEntry, state: str) -> None:
        self.mark_updated(entry.spans.window, Cause(kind="zone", id=entry.zone.id, state=state))


class _ChangedZones(CostLayer):
    """Zones as they would be."""

    def __init__(self, catalog: ZoneCatalog, put: Sequence[PreparedZone], without: Collection[str]) -> None:
        super().__init__()
        self._catalog = catalog
        self._put = put
        self._without = without

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the zones that would be in force."""
        kept = [e for e in self._catalog.active_in(window) if e.zone.id not in self._without]
        zones = [(entry.zone, entry.spans) for entry in kept]
        zones += [(zone, spans) for zone, spans in self._put if not spans.window.intersection(window).empty]
        _write(zones, window, cost, speed)


def _write(zones: Sequence[tuple[Zone, Spans]], window: Window, cost: Grid, speed: Grid) -> None:
    costs = [(spans, value) for zone, spans in zones if (value := _cost_of(zone)) is not None]
    raise_costs(costs, window.x, window.y, cost)
    limits = [(spans, speed_layer_value(limit)) for zone, spans in zones if (limit := zone.speed) is not None]
    lower_speeds(limits, window.x, window.y, speed)


def _cost_of(zone: Zone) -> int | None:
    """Return the cost of a zone's cells; None for a zone that has none."""
    if zone.kind == "BLOCKED":
        return LETHAL
    return penalty_cost(zone.factor) if zone.kind == "PENALTY" and zone.factor is not None else None


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ZonesLayer(plan.geometry))
