"""Refusals: what blocks every path to a goal, Nav2's code and a sentence for it, and the nearest reachable point. Pure.

All questions about one map are answered together: robots that stand in the same part of the floor, with goals in the
same part, share one answer. It takes some 10 ms with 300 zones on 2000 x 1200 cells if one of them cuts all off.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from fog_contracts.costs import FREE, INSCRIBED, LETHAL, PENALTY_MAX, UNKNOWN
from fog_contracts.messages import PLAN_CODES, Cause, PlanCode, PlanRefusal, PointXY, Refusal
from fog_kernels.astar import nearest_traversable
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from planner.regions import Region, overlap

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry, Window
    from fog_kernels.astar import Planner
    from planner.planning_map import Cell, Grid, PlanningMap
    from planner.regions import Mask, Slices

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
        # A step along a diagonal needs the cells on both of its sides.
        before, after = found.cells[:-1], found.cells[1:]
        beside = (np.column_stack((one[:, 0], other[:, 1])) for one, other in ((before, after), (after, before)))
        cells = np.vstack((found.cells, *beside))
        crossed = cells[self._map.cost[cells[:, 1], cells[:, 0]] >= INSCRIBED].tolist()
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


_OBSTACLE: Final = Cause(kind="obstacle", id="lidar", state="seen")
_WALL: Final = Cause(kind="map", id="static", state="occupied")
TIMEOUT: Final[PlanCode] = 207
_NEAR_GOAL_M: Final = 5.0
"""How far from a goal in a wall a reachable point is searched."""


def refuse(
    code: PlanCode, kind: PlanRefusal, reason: str, causes: Iterable[Cause] = (), nearest: PointXY | None = None
) -> Refusal:
    """Return a refusal, its sentence and causes cut to the message's limits; `nearest` in m, frame `map`."""
    sentence = f"{PLAN_CODES[code]}: {reason}"
    return Refusal(code=code, kind=kind, reason=sentence[:500], causes=list(causes)[:16], nearest=nearest)


def no_map() -> Refusal:
    """Refuse because no map was received yet."""
    return refuse(TIMEOUT, PlanRefusal.NO_MAP, "the planner has no map yet: try again when it is ready")


def busy(reason: str) -> Refusal:
    """Refuse because too many queries are waiting."""
    return refuse(TIMEOUT, PlanRefusal.TOO_MANY_QUERIES, reason)


def start_outside(geometry: GridGeometry, start: PointXY) -> Refusal:
    """Refuse because the robot stands off the map."""
    reason = f"the robot at {_point(start)} is outside the map {_extent(geometry)}"
    return refuse(203, PlanRefusal.START_OFF_MAP, reason)


def start_occupied(start: PointXY, inside: Sequence[Region] | None = None) -> Refusal:
    """Refuse because the robot stands on an impassable cell, and no free one is near.

    `inside`: the regions that close its cell; None while they are not known.
    """
    where = f"the robot at {_point(start)} stands "
    if inside:
        reason = f"{where}inside or at the edge of {_listed(inside)}"
        return refuse(205, PlanRefusal.START_CLOSED, reason, _causes(inside))
    if inside is None:
        return refuse(205, PlanRefusal.START_CLOSED, f"{where}in a closed place")
    return refuse(205, PlanRefusal.START_OBSTRUCTED, f"{where}on a wall, an obstacle or unknown space")


def goal_out_of_reach(planning_map: PlanningMap, goal: PointXY) -> Refusal | None:
    """Return why a goal can never be reached: off the map, in a wall or in unknown space; else None.

    A goal inside a hazard or zone is accepted, because those end; until then its path is a refusal.
    """
    geometry, lower_bound = planning_map.geometry, planning_map.lower_bound
    column, row = geometry.cell(*goal)
    if not geometry.contains_cell(column, row):
        reason = f"the goal {_point(goal)} lies outside the map {_extent(geometry)}"
        return refuse(204, PlanRefusal.GOAL_OFF_MAP, reason)
    if lower_bound[row, column] < INSCRIBED:
        return None
    near = nearest_traversable(lower_bound, (column, row), round(_NEAR_GOAL_M / geometry.resolution))
    nearest = geometry.centre(*near) if near else None
    kind, where = {
        LETHAL: (PlanRefusal.GOAL_IN_WALL, "in a wall"),
        UNKNOWN: (PlanRefusal.GOAL_UNKNOWN, "in unknown space"),
    }.get(int(planning_map.static[row, column]), (PlanRefusal.GOAL_NEAR_WALL, "too near a wall for the robot"))
    return refuse(206, kind, f"the goal {_point(goal)} lies {where}{_nearest_clause(nearest)}", nearest=nearest)


def goal_occupied(goal: PointXY, nearest: PointXY | None, inside: Sequence[Region] | None = None) -> Refusal:
    """Refuse because a hazard, a zone or an obstacle closes the goal's cell.

    `inside`: the regions that close it; None while they are not known.
    """
    kind = PlanRefusal.GOAL_CLOSED
    if inside is None:
        where = "in a place that is closed now"
    elif inside:
        where = f"inside or at the edge of {_listed(inside)}"
    else:
        kind, where = PlanRefusal.GOAL_OBSTRUCTED, "on or beside an obstacle that a robot sees"
    causes = [] if inside is None else _causes(inside) or [_OBSTACLE]
    return refuse(206, kind, f"the goal {_point(goal)} lies {where}{_nearest_clause(nearest)}", causes, nearest)


def no_path(nearest: PointXY, cut: Cut | None = None) -> Refusal:
    """Refuse because every path to the goal is blocked; `cut` tells by what, None while that is not known."""
    if cut is None:
        return refuse(208, PlanRefusal.CUT_OFF, f"every path is blocked{_nearest_clause(nearest)}", (), nearest)
    if cut.kind == "walls":
        reason = f"no path leads there: walls or unknown space lie between{_nearest_clause(nearest)}"
        return refuse(208, PlanRefusal.CUT_BY_WALLS, reason, [_WALL], nearest)
    if cut.kind == "obstacles":
        reason = f"every path is blocked by obstacles that robots see{_nearest_clause(nearest)}"
        return refuse(208, PlanRefusal.CUT_BY_OBSTACLES, reason, [_OBSTACLE], nearest)
    joint = ", which must all end" if cut.jointly and len(cut.regions) > 1 else ""
    reason = f"every path is blocked by {_listed(cut.regions)}{joint}{_nearest_clause(nearest)}"
    return refuse(208, PlanRefusal.CUT_BY_PLACES, reason, _causes(cut.regions), nearest)


def nearest_reachable(planning_map: PlanningMap, start: Cell, goal: Cell) -> PointXY:
    """Return the point (m) nearest to the goal that can be reached from a traversable cell."""
    components = planning_map.components
    x, y = planning_map.geometry.centre(*components.nearest(components.of(*start), goal))
    return round(x, 3), round(y, 3)


def _point(point: PointXY) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})"


def _extent(geometry: GridGeometry) -> str:
    left, bottom, right, top = geometry.bounds
    return f"({left:.1f} to {right:.1f}, {bottom:.1f} to {top:.1f})"


def _nearest_clause(point: PointXY | None) -> str:
    return "" if point is None else f"; the nearest reachable point is {_point(point)}"


def _causes(regions: Sequence[Region]) -> list[Cause]:
    return [region.cause for region in regions]


def _listed(regions: Sequence[Region]) -> str:
    names = [region.description for region in regions]
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
