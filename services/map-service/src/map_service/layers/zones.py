"""Operators' zones: no-go, penalty and speed limit, each while it is enabled and its time has come.

A PENALTY of factor f makes a free cell as expensive as f cells of free floor, as far as costs go (252 makes it five).
Where something costs more already, the higher cost stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fog_contracts.costs import COST_PER_FACTOR, LETHAL, PENALTY_MAX
from fog_contracts.messages import Cause
from fog_contracts.shapes import ShapeError, rasterize_shape
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost, write_speed_limit

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.geometry import ShapeMask
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Moment, Publication
    from fog_contracts.messages import Zone
    from map_service.layers.base import Grid


def penalty_cost(factor: float) -> int:
    """Return the cost (0..252) of a PENALTY zone of this factor (>= 1)."""
    return min(PENALTY_MAX, round(COST_PER_FACTOR * (factor - 1.0)))


def speed_value(speed: float) -> int:
    """Return a speed limit (m/s) as a value of the speed layer (cm/s, rounded down, at least 1)."""
    return max(1, min(254, int(speed * 100.0 + 1e-6)))


def is_active(zone: Zone, stamp: float) -> bool:
    """Whether a zone holds at a time: from `starts_at` on, until just before `expires_at`."""
    begun = zone.starts_at is None or zone.starts_at <= stamp
    over = zone.expires_at is not None and zone.expires_at <= stamp
    return zone.enabled and begun and not over


@dataclass
class _Held:
    zone: Zone
    mask: ShapeMask
    active: bool


class ZonesLayer(CostLayer):
    """Holds all zones; only active ones count."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._held: dict[str, _Held] = {}
        self._changed = False

    def put(self, zone: Zone, stamp: float) -> None:
        """Add or replace a zone; raises `ShapeError` for a shape that can't be used."""
        self._put(zone, rasterize_shape(zone.shape, self._geometry), stamp)

    def remove(self, zone_id: str) -> None:
        """Forget a zone, if there is one."""
        old = self._held.pop(zone_id, None)
        if old is not None:
            self._changed = True
            if old.active:
                self._mark(old, "removed")

    def replace_all(self, zones: Iterable[Zone], stamp: float) -> None:
        """Hold exactly these zones; raises `ShapeError`, which names it, and changes nothing for an unusable one."""
        masks: dict[str, tuple[Zone, ShapeMask]] = {}
        for zone in zones:
            try:
                masks[zone.id] = zone, rasterize_shape(zone.shape, self._geometry)
            except ShapeError as error:
                raise ShapeError(f"{zone.id}.shape.{error.field}", error.problem) from error
        for name in [name for name in self._held if name not in masks]:
            self.remove(name)
        for zone, mask in masks.values():
            self._put(zone, mask, stamp)

    def zones(self) -> list[Zone]:
        """Return all zones, active or not, by id."""
        return [self._held[name].zone for name in sorted(self._held)]

    def active(self) -> list[str]:
        """Return the ids of the zones that count."""
        return sorted(name for name, held in self._held.items() if held.active)

    def take_changed(self) -> bool:
        """Return whether a zone came, went, began or ended since this was last called."""
        changed, self._changed = self._changed, False
        return changed

    def tick(self, at: Moment) -> list[Publication]:
        """Let zones begin and end."""
        for held in self._held.values():
            active = is_active(held.zone, at.stamp)
            if active != held.active:
                held.active = active
                self._changed = True
                self._mark(held, "active" if active else "inactive")
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the active zones."""
        for held in self._held.values():
            zone = held.zone
            if not held.active:
                continue
            if zone.kind == "BLOCKED":
                write_cost(held.mask, window, cost, LETHAL)
            elif zone.kind == "PENALTY" and zone.factor is not None:
                write_cost(held.mask, window, cost, penalty_cost(zone.factor))
            elif zone.kind == "SPEED_LIMIT" and zone.speed is not None:
                write_speed_limit(held.mask, window, speed, speed_value(zone.speed))

    def _put(self, zone: Zone, mask: ShapeMask, stamp: float) -> None:
        old = self._held.get(zone.id)
        if old is not None and old.zone == zone:
            return
        held = _Held(zone, mask, is_active(zone, stamp))
        self._held[zone.id] = held
        self._changed = True
        if old is not None and old.active:
            self._mark(old, "active" if held.active else "inactive")
        if held.active:
            self._mark(held, "active")

    def _mark(self, held: _Held, state: str) -> None:
        self.mark_updated(held.mask.window, Cause(kind="zone", id=held.zone.id, state=state))


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ZonesLayer(plan.geometry))
