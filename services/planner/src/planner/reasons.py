"""Why a way is cut: the areas behind the cells of the costmap, and which of them, taken away, would open the way."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import LETHAL
from fog_contracts.geometry import GeometryError, normalized_polygon, rasterize
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import Cause, HazardArea, Zone
from fog_contracts.shapes import rasterize_shape
from fog_kernels.distance import squared_distance_capped

Grid = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Region:
    """A hazard or zone as cells: its own (`core`) and those that its inflation can reach (`reach`), in one window."""

    cause: Cause
    words: str
    window: Window
    core: Mask
    reach: Mask

    def blocks(self, cost: Grid) -> bool:
        """Whether cells of this region are lethal on the costmap."""
        return bool(np.any(cost[self.window.rows, self.window.columns][self.core] == LETHAL))

    def covers(self, column: int, row: int) -> bool:
        """Whether the cell is one of the region's own."""
        x, y = column - self.window.x, row - self.window.y
        return 0 <= x < self.window.width and 0 <= y < self.window.height and bool(self.core[y, x])

    def reaches(self, column: int, row: int) -> bool:
        """Whether the region's inflation can make the cell impassable or dear."""
        x, y = column - self.window.x, row - self.window.y
        return 0 <= x < self.window.width and 0 <= y < self.window.height and bool(self.reach[y, x])


def _region(cause: Cause, words: str, window: Window, mask: Mask, geometry: GridGeometry, reach: float) -> Region:
    cells = max(1, math.ceil(reach / geometry.resolution))
    grown = geometry.clip(window.grown(cells))
    core = np.zeros((grown.height, grown.width), dtype=np.bool_)
    x, y = window.x - grown.x, window.y - grown.y
    core[y : y + window.height, x : x + window.width] = mask
    near = squared_distance_capped(core, cells + 1) <= cells * cells
    return Region(cause, words, grown, core, near)


def hazard_region(told: HazardArea, geometry: GridGeometry, reach: float) -> Region | None:
    """Return a hazard's region with its inflation `reach` (m); None when it lies off the map or is no polygon."""
    try:
        window, mask = rasterize(normalized_polygon(told.polygon), geometry)
    except GeometryError:
        # The map-service refuses such an area too: it has no cells that could cut a way.
        return None
    if window.empty:
        return None
    name = told.hazard.area + (f" ({told.label})" if told.label else "")
    cause = Cause(kind="hazard", id=told.hazard.area, state=told.hazard.state)
    return _region(cause, f"hazard {name}, {told.hazard.state}", window, mask, geometry, reach)


def zone_region(zone: Zone, geometry: GridGeometry, reach: float) -> Region | None:
    """Return a BLOCKED zone's region; None for another kind, off the map, or for a shape that can't be used."""
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


def lifted(cost: Grid, floor: Grid, lift: Sequence[Region], keep: Sequence[Region]) -> Grid:
    """Return the costmap without the regions `lift`: `floor` (static, inflated) where none of `keep` reaches."""
    free = cost.copy()
    for region in lift:
        rows, columns = region.window.rows, region.window.columns
        free[rows, columns][region.reach] = floor[rows, columns][region.reach]
    for region in keep:
        rows, columns = region.window.rows, region.window.columns
        free[rows, columns][region.reach] = cost[rows, columns][region.reach]
    return free


def cutting(cost: Grid, floor: Grid, regions: Sequence[Region], opens: Callable[[Grid], bool]) -> list[Region]:
    """Return the regions that cut a way: each that alone would open it, else a smallest set that together would.

    `opens(costmap)` says whether there is a way. Empty when not even all of them together are the reason.
    """
    blocking = [region for region in regions if region.blocks(cost)]

    def without(lift: Sequence[Region]) -> bool:
        return opens(lifted(cost, floor, lift, [region for region in blocking if region not in lift]))

    alone = [region for region in blocking if without([region])]
    if alone or not blocking or not without(blocking):
        return alone
    needed = list(blocking)
    for region in blocking:
        fewer = [other for other in needed if other is not region]
        if without(fewer):
            needed = fewer
    return needed
