"""Hazards and zones as regions of the costmap: their cells, and the cells that they make impassable."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import FREE, LETHAL
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.messages import Cause, HazardArea, Zone
from fog_contracts.raster import rasterize
from fog_contracts.shapes import rasterize_shape
from fog_kernels.distance import squared_distance_capped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.raster import ShapeMask
    from planner.maps.planning_map import PlanningMap

Grid = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Source = HazardArea | Zone
"""The message that a region is made of."""


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
        if isinstance(self.source, HazardArea):
            return Cause(kind="hazard", id=self.source.hazard.area, state=self.source.hazard.state)
        return Cause(kind="zone", id=self.source.id, state="BLOCKED")

    @property
    def description(self) -> str:
        """The region in words."""
        if isinstance(self.source, HazardArea):
            name = self.source.hazard.area + (f" ({self.source.label})" if self.source.label else "")
            return f"hazard {name}, {self.source.hazard.state}"
        return f"no-go zone {self.source.id}" + (f" ({self.source.reason})"[:80] if self.source.reason else "")

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
