"""Places: those of `site.toml`, as operators have changed them since. Pure.

A stored place hides the one of the same id in `site.toml`, also when it is stored as removed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import field

from fog_contracts.costs import is_traversable
from fog_contracts.grid import Window
from fog_contracts.messages import PLACES_MAX, Count, Id, Place
from fog_contracts.shapes import shape_contains

if TYPE_CHECKING:
    from collections.abc import Mapping

    from map_service.core import MapCore


class StoredPlace(Place, frozen=True, kw_only=True):
    """A place as an operator has put it, or removed it."""

    id: Id
    removed: bool = False
    version: Count = 1


class PlaceView(Place, frozen=True, kw_only=True):
    """A place with its version (0: as in `site.toml`), and what an operator should know of where it is."""

    version: int = 0
    warnings: list[str] = field(default_factory=list)


class PlaceError(ValueError):
    """A place is invalid: `field` is the path of the field, the message names the problem and the remedy."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


def combined(initial: Mapping[str, Place], stored: Mapping[str, StoredPlace]) -> dict[str, Place]:
    """Return the places that there are, by id and in its order."""
    found = {name: place for name, place in initial.items() if name not in stored}
    found |= {
        name: Place(x=one.x, y=one.y, theta=one.theta, label=one.label, public=one.public)
        for name, one in stored.items()
        if not one.removed
    }
    return dict(sorted(found.items()))


def check_place(name: str, place: Place, core: MapCore) -> None:
    """Raise `PlaceError` for a place off the map, in a wall or unknown space, or that is one too many."""
    geometry = core.costmap.geometry
    column, row = geometry.cell(place.x, place.y)
    where = f"({place.x:.2f}, {place.y:.2f})"
    if not geometry.contains_cell(column, row):
        left, bottom, right, top = geometry.bounds
        extent = f"from ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}) m"
        raise PlaceError("x", f"{where} lies off the map, which reaches {extent}: move it onto the map")
    if not is_traversable(int(core.costmap.static[row, column])):
        raise PlaceError("x", f"{where} lies in a wall, or where the map knows nothing: move it to a free cell")
    if name not in core.places and len(core.places) >= PLACES_MAX:
        raise PlaceError("", f"there are {PLACES_MAX} places already, which is the limit: remove one")


def warnings_of(place: Place, core: MapCore) -> list[str]:
    """Return in which zones in force a place lies that keep robots out of it."""
    column, row = core.costmap.geometry.cell(place.x, place.y)
    zones = [entry.zone for entry in core.zones.active_in(Window(column, row, 1, 1))]
    return [
        f"it lies in zone {zone.id}, which is blocked: no robot gets there while the zone is in force"
        for zone in zones
        if zone.kind == "BLOCKED" and shape_contains(zone.shape, place.x, place.y)
    ]
