"""Finds what blocks every path to a goal: the hazards and zones whose end would open one, obstacles, or walls.

All questions about one map are answered together: robots that stand in the same part of the floor, with goals in the
same part, share one answer. It takes some 10 ms with 300 zones on 2000 x 1200 cells if one of them cuts all off.
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
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import Window
    from fog_kernels.astar import Planner
    from planner.maps.planning_map import Cell, Grid, PlanningMap
    from planner.reasons.regions import Mask, Slices

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
    """Answers why start and goal are not connected on one map; `regions` that are not on it count for nothing."""

    def __init__(
        self, planning_map: PlanningMap, regions: Sequence[Region], planner: Callable[[], Planner], reach: float
    ) -> None:
        """Prepare for questions; `reach` (cells) is the inscribed radius.

        `planner` returns what searches on maps of this size: its memory is not needed where one region cuts all off.
        """
        self._map = planning_map
        self._regions = regions
        self._planner = planner
        self._reach = reach
        self._answers: dict[tuple[int, int], Cut] = {}
        self._on: dict[int, bool] = {}
        """By the number of a region, whether it is on; only those are looked at that matter."""
        self._joined: dict[int, list[set[int]]] = {}
        """By the number of a region, which components would be joined without it."""

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
        components = self._map.components
        labels = components.of(*start), components.of(*goal)
        # A region joins what it touches: of most floors' regions few touch both parts.
        touching = np.flatnonzero(components.both_in(self._windows, *labels)).tolist()
        alone = tuple(
            self._regions[number]
            for number in touching
            if self._is_on(number)
            and any(labels[0] in group and labels[1] in group for group in self._joined_without(number))
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
    def _windows(self) -> NDArray[np.int32]:
        """Each region's window with the cells around it: x, y, width and height."""
        windows = [self._map.geometry.clip(region.window.grown(1)) for region in self._regions]
        return np.array(windows, np.int32).reshape(-1, 4)

    def _is_on(self, number: int) -> bool:
        if number not in self._on:
            self._on[number] = self._regions[number].is_on(self._map)
        return self._on[number]

    def _on_in(self, window: Window) -> Iterator[tuple[Region, Slices, Slices]]:
        """Yield the regions in a window that are on, each with the cells that they share as indexes of both."""
        for number, region in enumerate(self._regions):
            if (shared := overlap(window, region.window)) is not None and self._is_on(number):
                yield region, *shared

    def _closings(self, window: Window) -> Grid:
        """Return how many regions make each cell of a window impassable, at most 255."""
        count = np.zeros((window.height, window.width), np.uint8)
        for region, inside, own in self._on_in(window):
            part = count[inside]
            part += region.closed[own] & (part < 255)
        return count

    def _openable(self, window: Window) -> Mask:
        """Return the impassable cells of a window that would be passable without any region.

        Neither walls nor obstacles close them.
        """
        margin = int(self._reach) + 1
        around = self._map.geometry.clip(window.grown(margin))
        place = around.rows, around.columns
        cost = self._map.cost[place]
        openable: Mask = (cost >= INSCRIBED) & (self._map.lower_bound[place] < INSCRIBED)
        obstacles = (cost == LETHAL) & (self._map.static[place] == FREE)
        for region, inside, own in self._on_in(around):
            obstacles[inside] &= ~region.cells[own]
        if obstacles.any():
            openable &= squared_distance_capped(obstacles, margin) > self._reach * self._reach + 1e-6
        x, y = window.x - around.x, window.y - around.y
        return openable[y : y + window.height, x : x + window.width]

    def _joined_without(self, number: int) -> list[set[int]]:
        """Return which components would be joined without the region of this number."""
        if number not in self._joined:
            self._joined[number] = self._find_joined(self._regions[number])
        return self._joined[number]

    def _find_joined(self, region: Region) -> list[set[int]]:
        window = self._map.geometry.clip(region.window.grown(1))
        opened = np.zeros((window.height, window.width), np.bool_)
        inside, _ = overlap(window, region.window) or (None, None)
        assert inside is not None
        opened[inside] = region.closed & (self._closings(region.window) == 1) & self._openable(region.window)
        if not opened.any():
            return []
        labels = self._map.components.labels(*window)
        passable = labels >= 0
        local = Components(np.where(passable | opened, FREE, LETHAL).astype(np.uint8))
        pairs = labels[passable].astype(np.int64) << 32
        pairs += local.labels(0, 0, window.width, window.height)[passable]
        groups: dict[int, set[int]] = {}
        for pair in np.unique(pairs).tolist():
            groups.setdefault(pair & 0xFFFFFFFF, set()).add(pair >> 32)
        return _merged(groups.values())

    def _joint(self, start: Cell, goal: Cell) -> list[Region]:
        """Return regions that all have to end for a path, none of them needlessly; empty if that opens none."""
        open_floor = (self._map.cost < INSCRIBED) | self._all_openable
        costmap = np.where(self._map.cost < INSCRIBED, FREE, PENALTY_MAX).astype(np.uint8)
        costmap[~open_floor] = LETHAL
        found = self._planner().plan(costmap, start, goal)
        crossed = [cell for cell in found.cells.tolist() if self._map.cost[cell[1], cell[0]] >= INSCRIBED]
        chosen = [
            region
            for number, region in enumerate(self._regions)
            if any(region.closes(*cell) for cell in crossed) and self._is_on(number)
        ]
        if len(chosen) > _MOST_REDUCED:
            return chosen
        for region in list(chosen):
            fewer = [other for other in chosen if other is not region]
            if fewer and self._connected_without(fewer, start, goal):
                chosen = fewer
        return chosen

    @cached_property
    def _all_openable(self) -> Mask:
        return self._openable(self._map.geometry.whole)

    @cached_property
    def _all_closings(self) -> Grid:
        return self._closings(self._map.geometry.whole)

    def _connected_without(self, regions: Iterable[Region], start: Cell, goal: Cell) -> bool:
        kept = self._all_closings.copy()
        for region in regions:
            kept[region.window.rows, region.window.columns] -= region.closed
        passable = (self._map.cost < INSCRIBED) | (self._all_openable & (kept == 0))
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
