"""Hazards and zones as regions of the costmap: their cells, and the cells that they make impassable. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fog_contracts import channels as ch
from fog_contracts.costs import FREE, LETHAL
from fog_contracts.geometry import GeometryError, contains_point, normalized_polygon
from fog_contracts.messages import Cause, HazardArea, Zone
from fog_contracts.shapes import rasterize, rasterize_shape, shape_contains
from fog_kernels.distance import squared_distance_capped

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import ZoneKind, ZoneSet
    from fog_contracts.shapes import ShapeMask
    from planner.planning_map import PlanningMap

Grid = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Source = HazardArea | Zone
"""The message that a region is made of."""


def cause_of(source: Source) -> Cause:
    """Return a hazard or zone as the cause of what happens to a robot."""
    if isinstance(source, HazardArea):
        return Cause(kind="hazard", id=source.hazard.area, state=source.hazard.state)
    return Cause(kind="zone", id=source.id, state="BLOCKED")


def name_of(source: Source) -> str:
    """Return a hazard or zone in words."""
    if isinstance(source, HazardArea):
        name = source.hazard.area + (f" ({source.label})" if source.label else "")
        return f"hazard {name}, {source.hazard.state}"
    return f"no-go zone {source.id}" + (f" ({source.reason})"[:80] if source.reason else "")


@dataclass(frozen=True, eq=False)
class Region:
    """A hazard or zone as masks over a window: its own cells, and those that it makes impassable (`closed`)."""

    source: Source
    window: Window
    cells: Mask
    closed: Mask

    @property
    def cause(self) -> Cause:
        """The region as the cause of a refusal."""
        return cause_of(self.source)

    @property
    def description(self) -> str:
        """The region in words."""
        return name_of(self.source)

    def closes(self, column: int, row: int) -> bool:
        """Whether the region makes this cell impassable."""
        x, y = column - self.window.x, row - self.window.y
        return 0 <= x < self.window.width and 0 <= y < self.window.height and bool(self.closed[y, x])

    def is_on(self, planning_map: PlanningMap) -> bool:
        """Whether the region is on this map: all its cells are lethal, and not only because of walls.

        The cells of its border are not looked at: a rounding error there decides nothing.
        """
        rows, columns = self.window.rows, self.window.columns
        inner = self.cells.copy()
        inner[1:] &= self.cells[:-1]
        inner[:-1] &= self.cells[1:]
        inner[:, 1:] &= self.cells[:, :-1]
        inner[:, :-1] &= self.cells[:, 1:]
        looked_at = inner if inner.any() else self.cells
        if not np.all(planning_map.cost[rows, columns][looked_at] == LETHAL):
            return False
        return bool(np.any(planning_map.static[rows, columns][looked_at] == FREE))


def region_of(source: Source, geometry: GridGeometry, inflation: Inflation) -> Region | None:
    """Return the region of a hazard or zone; None off the map, or for an invalid shape."""
    try:
        window, mask = _rasterized(source, geometry)
    except GeometryError:
        # The map-service refuses such a shape too: it has no cells on the costmap.
        return None
    if window.empty:
        return None
    reach = math.floor(inflation.inscribed_radius / geometry.resolution + 1e-9)
    grown = geometry.clip(window.grown(reach))
    cells = np.zeros((grown.height, grown.width), dtype=np.bool_)
    x, y = window.x - grown.x, window.y - grown.y
    cells[y : y + window.height, x : x + window.width] = mask
    within = (inflation.inscribed_radius / geometry.resolution) ** 2 + 1e-6
    return Region(source, grown, cells, squared_distance_capped(cells, reach + 1) <= within)


def _rasterized(source: Source, geometry: GridGeometry) -> ShapeMask:
    if isinstance(source, HazardArea):
        return rasterize(normalized_polygon(source.polygon), geometry)
    return rasterize_shape(source.shape, geometry)


class Regions:
    """The regions of one map, made of the newest hazards and zones.

    A shape is rasterized when it is new, not again when others change. One thread may use it.
    """

    def __init__(self, inflation: Inflation) -> None:
        self._inflation = inflation
        self._geometry: GridGeometry | None = None
        self._known: list[tuple[Source, Region | None]] = []

    def on(self, planning_map: PlanningMap, sources: Sequence[Source]) -> list[Region]:
        """Return the regions that are on, in the order of their sources, which all make their cells lethal.

        A source may be newer or older than the map: a region counts only while the map shows its cells.
        """
        return [region for region in self.of(planning_map.geometry, sources) if region.is_on(planning_map)]

    def of(self, geometry: GridGeometry, sources: Sequence[Source]) -> list[Region]:
        """Return the regions of all sources that have cells, in their order, whether they are on or not."""
        if self._geometry != geometry:
            self._geometry, self._known = geometry, []
        known = {id(source): (source, region) for source, region in self._known}
        self._known = [
            known.get(id(source)) or (source, region_of(source, geometry, self._inflation)) for source in sources
        ]
        return [region for _, region in self._known if region is not None]


Slices = tuple[slice, slice]


def overlap(a: Window, b: Window) -> tuple[Slices, Slices] | None:
    """Return the cells that two windows share as (rows, columns) of arrays over either; None if they share none."""
    both = a.intersection(b)
    if both.empty:
        return None

    def inside(window: Window) -> Slices:
        x, y = both.x - window.x, both.y - window.y
        return slice(y, y + both.height), slice(x, x + both.width)

    return inside(a), inside(b)


def is_closing(hazard: HazardArea) -> bool:
    """Whether a hazard makes its area impassable."""
    return hazard.hazard.penalty == LETHAL


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
        return {ch.HAZARD: self.on_hazard, ch.ZONES: self._on_zones}

    @property
    def sources(self) -> tuple[Source, ...]:
        """The hazards and zones that make cells lethal; the same until one changes.

        The map-service says which zones are in force: it decides by clocks and a history that nobody else has.
        """
        if self._sources is None:
            hazards = (self._hazards[area] for area in sorted(self._hazards))
            closing = [hazard for hazard in hazards if is_closing(hazard)]
            self._sources = (*closing, *(_in_force(self._zones, "BLOCKED") if self._zones else ()))
        return self._sources

    @property
    def for_one_robot(self) -> list[Zone]:
        """The zones in force that are kept for one robot at a time."""
        return _in_force(self._zones, "RELEASE") if self._zones else []

    @property
    def areas(self) -> list[HazardArea]:
        """All areas, closed or not."""
        return list(self._hazards.values())

    def on_hazard(self, _ids: Ids, hazard: HazardArea, _at: Moment) -> Sequence[Publication]:
        """Handle an area with its hazard."""
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


def _in_force(zones: ZoneSet, kind: ZoneKind) -> list[Zone]:
    """Return the zones of a kind that are in force."""
    active = frozenset(zones.active)
    return [zone for zone in zones.zones if zone.kind == kind and zone.id in active]


def cover(sources: Sequence[Source], x: float, y: float, margin: float) -> bool:
    """Whether a point (m, frame `map`) lies in one of the hazards or zones, or within about `margin` (m) of it."""
    offsets = [(0.0, 0.0)] + [(margin * math.cos(a), margin * math.sin(a)) for a in (0.8, 2.4, 3.9, 5.5)]
    return any(_contains(source, x + dx, y + dy) for source in sources for dx, dy in offsets)


def _contains(source: Source, x: float, y: float) -> bool:
    if isinstance(source, HazardArea):
        return contains_point(source.polygon, x, y)
    return shape_contains(source.shape, x, y)
