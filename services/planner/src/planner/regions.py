"""Hazards and zones as regions of the costmap, and which of them block all paths to a goal."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import LETHAL
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import Cause, HazardArea, Zone
from fog_contracts.raster import rasterize
from fog_contracts.shapes import rasterize_shape
from fog_kernels.distance import squared_distance_capped

Grid = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Region:
    """A hazard or zone as masks over a window: its own cells, and those that its inflation can reach (`inflated`)."""

    cause: Cause
    description: str
    window: Window
    cells: Mask
    inflated: Mask

    def blocks(self, cost: Grid) -> bool:
        """Whether cells of this region are lethal on the costmap."""
        return bool(np.any(cost[self.window.rows, self.window.columns][self.cells] == LETHAL))

    def covers(self, column: int, row: int) -> bool:
        """Whether the cell is one of the region's own."""
        x, y = column - self.window.x, row - self.window.y
        return 0 <= x < self.window.width and 0 <= y < self.window.height and bool(self.cells[y, x])

    def influences(self, column: int, row: int) -> bool:
        """Whether the region or its inflation can raise the cell's cost."""
        x, y = column - self.window.x, row - self.window.y
        return 0 <= x < self.window.width and 0 <= y < self.window.height and bool(self.inflated[y, x])


def _region(cause: Cause, description: str, window: Window, mask: Mask, geometry: GridGeometry, reach: float) -> Region:
    cells = max(1, math.ceil(reach / geometry.resolution))
    grown = geometry.clip(window.grown(cells))
    own = np.zeros((grown.height, grown.width), dtype=np.bool_)
    x, y = window.x - grown.x, window.y - grown.y
    own[y : y + window.height, x : x + window.width] = mask
    inflated = squared_distance_capped(own, cells + 1) <= cells * cells
    return Region(cause, description, grown, own, inflated)


def hazard_region(area: HazardArea, geometry: GridGeometry, reach: float) -> Region | None:
    """Return a hazard's region with its inflation `reach` (m); None off the map, or for an invalid polygon."""
    try:
        window, mask = rasterize(normalized_polygon(area.polygon), geometry)
    except GeometryError:
        # The map-service refuses such an area too: it has no cells on the costmap.
        return None
    if window.empty:
        return None
    name = area.hazard.area + (f" ({area.label})" if area.label else "")
    cause = Cause(kind="hazard", id=area.hazard.area, state=area.hazard.state)
    return _region(cause, f"hazard {name}, {area.hazard.state}", window, mask, geometry, reach)


def zone_region(zone: Zone, geometry: GridGeometry, reach: float) -> Region | None:
    """Return a BLOCKED zone's region; None for another kind, off the map, or for an invalid shape."""
    if zone.kind != "BLOCKED":
        return None
    try:
        window, mask = rasterize_shape(zone.shape, geometry)
    except GeometryError:
        return None
    if window.empty:
        return None
    reason = f" ({zone.reason})"[:80] if zone.reason else ""
    cause = Cause(kind="zone", id=zone.id, state="BLOCKED")
    return _region(cause, f"no-go zone {zone.id}{reason}", window, mask, geometry, reach)


def remove_regions(cost: Grid, lower_bound: Grid, removed: Sequence[Region], kept: Sequence[Region]) -> Grid:
    """Return the costmap without some regions: their cells get the lower bound, except those that `kept` influence."""
    result = cost.copy()
    for region in removed:
        rows, columns = region.window.rows, region.window.columns
        result[rows, columns][region.inflated] = lower_bound[rows, columns][region.inflated]
    for region in kept:
        rows, columns = region.window.rows, region.window.columns
        result[rows, columns][region.inflated] = cost[rows, columns][region.inflated]
    return result


def decisive_regions(
    cost: Grid, lower_bound: Grid, regions: Sequence[Region], has_path: Callable[[Grid], bool]
) -> list[Region]:
    """Return the regions that block all paths: those of which removing one suffices, else a minimal set to remove.

    `has_path(costmap)` returns whether there is a path. Empty when removing all regions gives no path either.
    """
    blocking = [region for region in regions if region.blocks(cost)]

    def has_path_without(removed: Sequence[Region]) -> bool:
        kept = [region for region in blocking if region not in removed]
        return has_path(remove_regions(cost, lower_bound, removed, kept))

    sufficient = [region for region in blocking if has_path_without([region])]
    if sufficient or not blocking or not has_path_without(blocking):
        return sufficient
    minimal = list(blocking)
    for region in blocking:
        fewer = [other for other in minimal if other is not region]
        if has_path_without(fewer):
            minimal = fewer
    return minimal
