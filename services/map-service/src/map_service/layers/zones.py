"""Operators' zones: no-go, penalty and speed limit, each while it is enabled and its time has come (`zone_times`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import LETHAL, penalty_cost
from fog_contracts.messages import Cause
from fog_contracts.shapes import shape_spans
from fog_kernels.spans import lower_speeds, raise_costs
from map_service.layers.base import CostLayer, LayerFactory, NoOptions
from map_service.zone_times import Progress, StoredState, ZoneTimes
from map_service.zone_validation import named_spans

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Moment, Publication
    from fog_contracts.messages import Zone
    from fog_contracts.raster import Spans
    from map_service.layers.base import Grid


def speed_layer_value(speed: float) -> int:
    """Return a speed limit (m/s) as a value of the speed layer (cm/s, rounded down, at least 1)."""
    return max(1, min(254, int(speed * 100.0 + 1e-6)))


@dataclass
class _ZoneEntry:
    zone: Zone
    spans: Spans
    cells: int
    times: ZoneTimes
    active: bool


class ZonesLayer(CostLayer):
    """Holds all zones; only active ones change costs."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._entries: dict[str, _ZoneEntry] = {}
        self._changed = False
        self._timed: list[_ZoneEntry] | None = None
        self._zones: list[Zone] | None = None
        self._active_ids: list[str] | None = None
        self._active: tuple[list[_ZoneEntry], NDArray[np.int64]] | None = None

    def put(self, zone: Zone, at: Moment, spans: Spans | None = None) -> None:
        """Add or replace a zone, whose cells may be given; raises `ShapeError` for an invalid shape."""
        self._put(zone, spans or shape_spans(zone.shape, self._geometry), ZoneTimes(zone), at)

    def remove(self, zone_id: str) -> None:
        """Remove a zone, if it exists."""
        old = self._entries.pop(zone_id, None)
        if old is not None:
            self._set_changed()
            if old.active:
                self._mark(old, "removed")

    def replace_all(self, zones: Iterable[Zone], at: Moment, stored: StoredState) -> None:
        """Replace all zones; those that are the same already keep their cells and times.

        For an invalid shape, raises `ShapeError`, which names the zone, and changes nothing.
        """
        prepared = [(z, self._known_spans(z, stored.spans) or named_spans(z, self._geometry)) for z in zones]
        kept = {zone.id for zone, _ in prepared}
        for name in [name for name in self._entries if name not in kept]:
            self.remove(name)
        for zone, cells in prepared:
            times = ZoneTimes(zone, stored.progress.get(zone.id), boot=stored.boot, now=at.now)
            self._put(zone, cells, times, at)

    def progress(self, boot: str, now: float) -> dict[str, Progress]:
        """Return, by id, what must be stored of the zones that begin or end."""
        return {name: entry.times.progress(boot, now) for name, entry in self._entries.items() if _is_timed(entry.zone)}

    def zones(self) -> list[Zone]:
        """Return all zones, active or not, by id; the same list as long as nothing changes."""
        if self._zones is None:
            self._zones = [self._entries[name].zone for name in sorted(self._entries)]
        return self._zones

    def active(self) -> list[str]:
        """Return the ids of the active zones; the same list as long as nothing changes."""
        if self._active_ids is None:
            self._active_ids = sorted(name for name, entry in self._entries.items() if entry.active)
        return self._active_ids

    def size(self, without: str) -> tuple[int, int]:
        """Return how many zones there are besides the one with this id, and how many cells they cover in sum."""
        others = [entry.cells for name, entry in self._entries.items() if name != without]
        return len(others), sum(others)

    def pop_changed(self) -> bool:
        """Return whether a zone was added, changed, removed, activated or ended since the last call."""
        changed, self._changed = self._changed, False
        return changed

    def tick(self, at: Moment) -> list[Publication]:
        """Activate and end zones by their times."""
        if self._timed is None:
            self._timed = [entry for entry in self._entries.values() if _is_timed(entry.zone)]
        for entry in self._timed:
            active = entry.times.is_active(at)
            if active != entry.active:
                entry.active = active
                self._set_changed()
                self._mark(entry, "active" if active else "inactive")
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the active zones."""
        for entry in self._active_in(window):
            zone = entry.zone
            if zone.kind == "BLOCKED":
                raise_costs(entry.spans, window.x, window.y, LETHAL, cost)
            elif zone.kind == "PENALTY" and zone.factor is not None:
                raise_costs(entry.spans, window.x, window.y, penalty_cost(zone.factor), cost)
            elif zone.kind == "SPEED_LIMIT" and zone.speed is not None:
                lower_speeds(entry.spans, window.x, window.y, speed_layer_value(zone.speed), speed)

    def _active_in(self, window: Window) -> list[_ZoneEntry]:
        """Return the active zones whose windows overlap this one."""
        if self._active is None:
            entries = [entry for entry in self._entries.values() if entry.active and not entry.spans.window.empty]
            self._active = entries, np.array([entry.spans.window for entry in entries], dtype=np.int64).reshape(-1, 4)
        entries, windows = self._active
        x, y, width, height = windows.T
        overlapping = (x < window.x + window.width) & (window.x < x + width)
        overlapping &= (y < window.y + window.height) & (window.y < y + height)
        return [entries[index] for index in np.flatnonzero(overlapping)]

    def _known_spans(self, zone: Zone, given: Mapping[str, Spans]) -> Spans | None:
        old = self._entries.get(zone.id)
        return old.spans if old is not None and old.zone.shape == zone.shape else given.get(zone.id)

    def _put(self, zone: Zone, spans: Spans, times: ZoneTimes, at: Moment) -> None:
        old = self._entries.get(zone.id)
        if old is not None and old.zone == zone:
            return
        entry = _ZoneEntry(zone, spans, spans.cells, times, times.is_active(at))
        self._entries[zone.id] = entry
        self._set_changed()
        if old is not None and old.active:
            self._mark(old, "active" if entry.active else "inactive")
        if entry.active:
            self._mark(entry, "active")

    def _set_changed(self) -> None:
        self._changed = True
        self._zones = self._active_ids = self._active = self._timed = None

    def _mark(self, entry: _ZoneEntry, state: str) -> None:
        self.mark_updated(entry.spans.window, Cause(kind="zone", id=entry.zone.id, state=state))


def _is_timed(zone: Zone) -> bool:
    """Whether time decides if the zone is in force."""
    return any(value is not None for value in (zone.starts_at, zone.expires_at, zone.ttl_s, zone.schedule))


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ZonesLayer(plan.geometry))
