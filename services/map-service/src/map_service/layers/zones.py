"""Operators' zones: no-go, penalty and speed limit, each while it is enabled and between its start and expiry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fog_contracts.costs import LETHAL, penalty_cost
from fog_contracts.messages import Cause
from fog_contracts.shapes import ShapeError, rasterize_shape
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost, write_speed_limit

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Moment, Publication
    from fog_contracts.messages import Zone
    from fog_contracts.raster import ShapeMask
    from map_service.layers.base import Grid


def speed_layer_value(speed: float) -> int:
    """Return a speed limit (m/s) as a value of the speed layer (cm/s, rounded down, at least 1)."""
    return max(1, min(254, int(speed * 100.0 + 1e-6)))


def is_active(zone: Zone, stamp: float) -> bool:
    """Whether a zone is in force at a time (s since the epoch): from `starts_at` on, until before `expires_at`."""
    started = zone.starts_at is None or zone.starts_at <= stamp
    expired = zone.expires_at is not None and zone.expires_at <= stamp
    return zone.enabled and started and not expired


@dataclass
class _ZoneEntry:
    zone: Zone
    mask: ShapeMask
    active: bool


class ZonesLayer(CostLayer):
    """Holds all zones; only active ones change costs."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._entries: dict[str, _ZoneEntry] = {}
        self._changed = False

    def put(self, zone: Zone, stamp: float) -> None:
        """Add or replace a zone; raises `ShapeError` for an invalid shape."""
        self._put(zone, rasterize_shape(zone.shape, self._geometry), stamp)

    def remove(self, zone_id: str) -> None:
        """Remove a zone, if it exists."""
        old = self._entries.pop(zone_id, None)
        if old is not None:
            self._changed = True
            if old.active:
                self._mark(old, "removed")

    def replace_all(self, zones: Iterable[Zone], stamp: float) -> None:
        """Replace all zones; for an invalid one, raises `ShapeError`, which names it, and changes nothing."""
        masks: dict[str, tuple[Zone, ShapeMask]] = {}
        for zone in zones:
            try:
                masks[zone.id] = zone, rasterize_shape(zone.shape, self._geometry)
            except ShapeError as error:
                raise ShapeError(f"{zone.id}.shape.{error.field}", error.problem) from error
        for name in [name for name in self._entries if name not in masks]:
            self.remove(name)
        for zone, mask in masks.values():
            self._put(zone, mask, stamp)

    def zones(self) -> list[Zone]:
        """Return all zones, active or not, by id."""
        return [self._entries[name].zone for name in sorted(self._entries)]

    def active(self) -> list[str]:
        """Return the ids of the active zones."""
        return sorted(name for name, entry in self._entries.items() if entry.active)

    def pop_changed(self) -> bool:
        """Return whether a zone was added, changed, removed, activated or ended since the last call."""
        changed, self._changed = self._changed, False
        return changed

    def tick(self, at: Moment) -> list[Publication]:
        """Activate and end zones by their times."""
        for entry in self._entries.values():
            active = is_active(entry.zone, at.stamp)
            if active != entry.active:
                entry.active = active
                self._changed = True
                self._mark(entry, "active" if active else "inactive")
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the active zones."""
        for entry in self._entries.values():
            zone = entry.zone
            if not entry.active:
                continue
            if zone.kind == "BLOCKED":
                write_cost(entry.mask, window, cost, LETHAL)
            elif zone.kind == "PENALTY" and zone.factor is not None:
                write_cost(entry.mask, window, cost, penalty_cost(zone.factor))
            elif zone.kind == "SPEED_LIMIT" and zone.speed is not None:
                write_speed_limit(entry.mask, window, speed, speed_layer_value(zone.speed))

    def _put(self, zone: Zone, mask: ShapeMask, stamp: float) -> None:
        old = self._entries.get(zone.id)
        if old is not None and old.zone == zone:
            return
        entry = _ZoneEntry(zone, mask, is_active(zone, stamp))
        self._entries[zone.id] = entry
        self._changed = True
        if old is not None and old.active:
            self._mark(old, "active" if entry.active else "inactive")
        if entry.active:
            self._mark(entry, "active")

    def _mark(self, entry: _ZoneEntry, state: str) -> None:
        self.mark_updated(entry.mask.window, Cause(kind="zone", id=entry.zone.id, state=state))


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ZonesLayer(plan.geometry))
