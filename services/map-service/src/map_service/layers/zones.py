"""Operators' zones: no-go, penalty and speed limit, each while it is enabled and its time has come.

A PENALTY of factor f makes a free cell as expensive as f cells of free floor, as far as costs go (252 makes it five).
Where something costs more already, the higher cost stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from fog_contracts.costs import COST_PER_FACTOR, LETHAL, PENALTY_MAX
from fog_contracts.messages import Cause
from map_service.layers.protocol import Touch, paint_figure
from map_service.shapes import rasterize_shape

if TYPE_CHECKING:
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import Zone
    from map_service.layers.protocol import Grid
    from map_service.shapes import Figure


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
    figure: Figure
    active: bool


class ZonesLayer:
    """Holds all zones; only active ones are painted."""

    def __init__(self, geometry: GridGeometry) -> None:
        self._geometry = geometry
        self._held: dict[str, _Held] = {}
        self._touched: list[Touch] = []

    def put(self, zone: Zone, stamp: float) -> None:
        """Add or replace a zone."""
        old = self._held.get(zone.id)
        if old is not None and old.zone == zone:
            return
        active = is_active(zone, stamp)
        held = _Held(zone, rasterize_shape(zone.shape, self._geometry), active)
        self._held[zone.id] = held
        if old is not None and old.active:
            self._touch(old, "active" if active else "inactive")
        if active:
            self._touch(held, "active")

    def remove(self, zone_id: str) -> bool:
        """Forget a zone; return whether there was one."""
        old = self._held.pop(zone_id, None)
        if old is not None and old.active:
            self._touch(old, "removed")
        return old is not None

    def zones(self) -> list[Zone]:
        """Return all zones, active or not, by id."""
        return [self._held[name].zone for name in sorted(self._held)]

    def active(self) -> list[str]:
        """Return the ids of the zones that are painted."""
        return sorted(name for name, held in self._held.items() if held.active)

    def tick(self, now: float, stamp: float) -> None:  # noqa: ARG002  # the protocol's
        """Let zones begin and end."""
        for held in self._held.values():
            active = is_active(held.zone, stamp)
            if active != held.active:
                held.active = active
                self._touch(held, "active" if active else "inactive")

    def touched(self) -> list[Touch]:
        """Return the windows of zones that changed."""
        touched, self._touched = self._touched, []
        return touched

    def paint(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the active zones."""
        for held in self._held.values():
            zone = held.zone
            if not held.active:
                continue
            if zone.kind == "BLOCKED":
                paint_figure(held.figure, window, cost, LETHAL)
            elif zone.kind == "PENALTY" and zone.factor is not None:
                paint_figure(held.figure, window, cost, penalty_cost(zone.factor))
            elif zone.kind == "SPEED_LIMIT" and zone.speed is not None:
                paint_figure(held.figure, window, speed, speed_value(zone.speed), speed=True)

    def _touch(self, held: _Held, state: str) -> None:
        self._touched.append(Touch(held.figure.window, Cause(kind="zone", id=held.zone.id, state=state)))
