"""Finds what blocks every path to a goal: the hazards and zones whose end would open one, obstacles, or walls.

All questions about one map are answered together: robots that stand in the same part of the floor, with goals in the
same part, share one answer. It takes some 30 ms with 300 zones on 2000 x 1200 cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from fog_contracts.costs import FREE, INSCRIBED, LETHAL, PENALTY_MAX
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from planner.reasons.regions import Region, overlap

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from fog_kernels.astar import Planner
    from planner.maps.planning_map import Cell, Grid, PlanningMap
    from planner.reasons.regions import Mask

_MOST_REDUCED: Final = 8
"""A set of more regions is named as it was found: reducing it takes one more look at the whole map for each."""


@dataclass(frozen=True)
class Cut:
    """Why no path leads from one part of the floor to another.

    `regions`: each of them alone, or with `jointly` all together, would have to end; empty for walls and obstacles.
    """

    kind: Literal["regions", "walls", "obstacles"]
    regions: tuple[Region, ...] = ()
    jointly: bool = False


class Cuts:
    """Answers why start and goal are not connected on one map; `regions` are those that are on."""

    def __init__(self, planning_map: PlanningMap, regions: Sequence[Region], planner: Planner, reach: float) -> None:
        """Prepare for questions; `planner` searches on maps of this size, `reach` (cells) is the inscribed radius."""
        self._map = planning_map
        self._regions = regions
        self._planner = planner
        self._reach = reach
        self._answers: dict[tuple[int, int], Cut] = {}

    def between(self, start: Cell, goal: Cell) -> Cut:
        """Return what cuts two traversable cells off from each other."""
        components = self._map.components
        key = components.of(*start), components.of(*goal)
        if key not in self._answers:
            self._answers[key] = self._find(start, goal)
        return self._answers[key]

    def _find(self, start: Cell, goal: Cell) -> Cut:
        if not self._floor.connected(start, goal):
            return Cut("walls")
        labels = self._map.components.of(*start), self._map.components.of(*goal)
        alone = tuple(
            region
            for region, groups in zip(self._regions, self._joined_without, strict=True)
            if any(labels[0] in group and labels[1] in group for group in groups)
        )
        if alone:
            return Cut("regions", alone)
        together = self._joint(start, goal)
        return Cut("regions", tuple(together), jointly=True) if together else Cut("obstacles")

    # --- The map without some regions --------------------------------------------------------------------------------

    @cached_property
    def _floor(self) -> Components:
        """The static floor: without hazards, zones and obstacles."""
        return Components(self._map.lower_bound)

    @cached_property
    def _count(self) -> Grid:
        """How many regions make a cell impassable, at most 255."""
        count = np.zeros(self._map.geometry.shape, np.uint8)
        for region in self._regions:
            part = count[region.window.rows, region.window.columns]
            part += region.closed & (part < 255)
        return count

    @cached_property
    def _openable(self) -> Mask:
        """The impassable cells that would be passable without any region: neither walls nor obstacles close them."""
        cost, lower_bound = self._map.cost, self._map.lower_bound
        obstacles = (cost == LETHAL) & (self._map.static == FREE)
        for region in self._regions:
            obstacles[region.window.rows, region.window.columns] &= ~region.cells
        openable = (cost >= INSCRIBED) & (lower_bound < INSCRIBED)
        if obstacles.any():
            squares = squared_distance_capped(obstacles, int(self._reach) + 1)
            openable &= squares > self._reach * self._reach + 1e-6
        return openable

    @cached_property
    def _joined_without(self) -> list[list[set[int]]]:
        """For each region, which components would be joined without it."""
        return [self._joined(region) for region in self._regions]

    def _joined(self, region: Region) -> list[set[int]]:
        window = self._map.geometry.clip(region.window.grown(1))
        opened = np.zeros((window.height, window.width), np.bool_)
        inside, _ = overlap(window, region.window) or (None, None)
        assert inside is not None
        rows, columns = region.window.rows, region.window.columns
        opened[inside] = region.closed & (self._count[rows, columns] == 1) & self._openable[rows, columns]
        if not opened.any():
            return []
        labels = self._map.components.labels(*window)
        passable = labels >= 0
        around = labels[passable].astype(np.int64)
        if around.size == 0 or np.all(around == around[0]):
            return []
        local = Components(np.where(passable | opened, FREE, LETHAL).astype(np.uint8))
        pairs = (around << 32) + local.labels(0, 0, window.width, window.height)[passable]
        groups: dict[int, set[int]] = {}
        for pair in np.unique(pairs).tolist():
            groups.setdefault(pair & 0xFFFFFFFF, set()).add(pair >> 32)
        return _merged(groups.values())

    def _joint(self, start: Cell, goal: Cell) -> list[Region]:
        """Return regions that all have to end for a path, none of them needlessly; empty if that opens none."""
        open_floor = (self._map.cost < INSCRIBED) | self._openable
        costmap = np.where(self._map.cost < INSCRIBED, FREE, PENALTY_MAX).astype(np.uint8)
        costmap[~open_floor] = LETHAL
        found = self._planner.plan(costmap, start, goal)
        crossed = [cell for cell in found.cells.tolist() if self._map.cost[cell[1], cell[0]] >= INSCRIBED]
        chosen = [region for region in self._regions if any(region.closes(*cell) for cell in crossed)]
        if len(chosen) <= _MOST_REDUCED:
            for region in list(chosen):
                fewer = [other for other in chosen if other is not region]
                if fewer and self._connected_without(fewer, start, goal):
                    chosen = fewer
        return chosen

    def _connected_without(self, regions: Iterable[Region], start: Cell, goal: Cell) -> bool:
        kept = self._count.copy()
        for region in regions:
            kept[region.window.rows, region.window.columns] -= region.closed
        passable = (self._map.cost < INSCRIBED) | (self._openable & (kept == 0))
        return Components(np.where(passable, FREE, LETHAL).astype(np.uint8)).connected(start, goal)


def _merged(groups: Iterable[set[int]]) -> list[set[int]]:
    """Join the sets that share an element; sets of one element are left out."""
    merged: list[set[int]] = []
    for group in groups:
        touching = [other for other in merged if other & group]
        merged = [other for other in merged if not other & group]
        merged.append(group.union(*touching))
    return [group for group in merged if len(group) > 1]


def remove_regions(planning_map: PlanningMap, removed: Sequence[Region], kept: Sequence[Region], margin: int) -> Grid:
    """Return the costmap without some regions.

    Their cells and those within `margin` cells get the lower bound, except the cells that `kept` regions close.
    """
    geometry, cost, lower_bound = planning_map.geometry, planning_map.cost, planning_map.lower_bound
    result = cost.copy()
    for region in removed:
        window = geometry.clip(region.window.grown(margin))
        own = np.zeros((window.height, window.width), np.bool_)
        inside, _ = overlap(window, region.window) or (None, None)
        assert inside is not None
        own[inside] = region.cells
        influenced = squared_distance_capped(own, margin + 1) <= margin * margin
        result[window.rows, window.columns][influenced] = lower_bound[window.rows, window.columns][influenced]
    for region in kept:
        result[region.window.rows, region.window.columns][region.closed] = cost[
            region.window.rows, region.window.columns
        ][region.closed]
    return result
