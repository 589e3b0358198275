"""Searches paths on the costmap, in metres: to a goal, and out of a blocked area. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import FREE, INSCRIBED, LETHAL
from fog_contracts.geometry import lengths_along, sampled
from fog_contracts.messages import PlanRefusal
from fog_kernels.astar import Planner, nearest_traversable
from fog_kernels.course import last_beside
from fog_kernels.lines import cost_from, first_inside, leaves, line_cost, nearest_between
from planner.refusals import (
    TIMEOUT,
    goal_occupied,
    goal_out_of_reach,
    nearest_reachable,
    no_path,
    refuse,
    remove_regions,
    start_occupied,
    start_outside,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import PointXY, Refusal
    from fog_kernels.astar import PlanResult
    from fog_kernels.guides import Detour, GoalField
    from fog_kernels.landmarks import Landmarks
    from planner.config import PlannerConfig
    from planner.planning_map import Cell, Grid, PlanningMap
    from planner.regions import Region

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Route:
    """Corners (n, 2) joined by straight lines; the first `escape_lines` lines lead out of impassable cells."""

    corners: Floats
    spacing: float
    escape_lines: int = 0

    @cached_property
    def points(self) -> Floats:
        """The polyline (n, 2), sampled at most `spacing` apart; every corner is a sample."""
        return sampled(self.corners, self.spacing)

    @cached_property
    def corner_points(self) -> list[PointXY]:
        """The corners as they are published; whoever samples them at the same spacing gets `points`, bit for bit."""
        return [(x, y) for x, y in self.corners.tolist()]

    @property
    def length(self) -> float:
        """Length in m."""
        return float(self._corner_along[-1])

    @property
    def last_corner(self) -> float:
        """How far along (m) the last line begins."""
        return float(self._corner_along[-2])

    def nearest(self, x: float, y: float, after: float = 0.0, window: float = math.inf) -> tuple[float, float]:
        """Return how far along (m) the point nearest to (x, y) is, and its distance.

        Only `after - 0.5 .. after + window` along is searched, so that a route that passes a place twice is not cut
        short.
        """
        lengths = self._corner_along
        found = nearest_between(self.corners, lengths, after - 0.5, after + window, x, y)
        if math.isinf(found[1]):
            found = nearest_between(self.corners, lengths, -math.inf, math.inf, x, y)
        if math.isinf(found[1]):  # all corners are one point
            return 0.0, math.hypot(self.corners[0, 0] - x, self.corners[0, 1] - y)
        return found

    def last_beside(self, points: Floats, reach: float) -> int:
        """Return the last of some points (n, 2; m) up to which all are within `reach` (m) of the route, in turn."""
        return last_beside(points, self.corners, self._corner_along, reach, (0.5, 2.0))

    @cached_property
    def _corner_along(self) -> Floats:
        return lengths_along(self.corners)

    def remaining(self, along: float) -> Floats:
        """Return the polyline from `along` (m) to the end: a point there, then the corners that follow."""
        lengths = self._corner_along
        after = int(np.searchsorted(lengths, along, side="right"))
        if after == 0 or after == len(lengths):
            return self.corners[max(0, after - 1) :]
        before, behind = self.corners[after - 1], self.corners[after]
        share = (along - lengths[after - 1]) / (lengths[after] - lengths[after - 1])
        return np.concatenate(((before + share * (behind - before))[None, :], self.corners[after:]))

    def cost(self, costmap: Grid, geometry: GridGeometry, along: float = 0.0) -> float:
        """Return the cost of the route from `along` on, as the kernels integrate it; infinite when it is impassable.

        Escape lines are left out, because they lead through impassable cells on purpose.
        """
        lengths = self._corner_along
        begin = max(along, float(lengths[self.escape_lines]))
        grid = geometry.origin_x, geometry.origin_y, geometry.resolution
        return cost_from(costmap, self.corners, lengths, begin, grid)

    def distance_to(self, mask: NDArray[np.bool_], window: Window, geometry: GridGeometry, along: float) -> float:
        """Return how far (m) beyond `along` the route first enters the cells of a mask over a window; else infinity."""
        grid = geometry.origin_x, geometry.origin_y, geometry.resolution
        begin = along - geometry.resolution
        first = first_inside(self.corners, self._corner_along, self.spacing, begin, grid, (window.x, window.y), mask)
        return max(0.0, first - along)

    def differs_from(self, other: Route, along: float, reach: float) -> bool:
        """Whether this route leaves the rest of another, from `along` (m) on, by more than `reach` (m) somewhere."""
        return leaves(self.corners, other.remaining(along), reach, max(reach, self.spacing))


@dataclass(frozen=True)
class Question:
    """What a refusal leaves open: which hazards or zones close the start, the goal, or every path between them."""

    kind: Literal["start", "goal", "path"]
    start: PointXY
    goal: PointXY
    start_cell: Cell
    """For a goal or path: the traversable cell where the search began."""
    goal_cell: Cell


@dataclass(frozen=True)
class SearchResult:
    """A route, or a refusal.

    `question`: what the refusal does not tell yet; None when it is complete. `searched`: whether A* found out.
    """

    route: Route | None
    count_cost: Callable[[], float]
    refusal: Refusal | None
    question: Question | None = None
    searched: bool = True

    @cached_property
    def cost(self) -> float:
        """The route's cost, as the kernels integrate it on the costs of when it is first asked for; inf without one."""
        return self.count_cost()


def refused(refusal: Refusal, question: Question | None = None, *, searched: bool = False) -> SearchResult:
    """Return the result of a search without a path."""
    return SearchResult(None, partial(float, math.inf), refusal, question, searched)


Covers = Callable[[float, float, float], bool]
"""Whether a point (m, frame `map`) lies in a blocked hazard or zone, or within a margin (m) of it."""

Share = Callable[["Cell", "Cell"], "Detour | None"]
"""Returns a bound for a search between two cells that others can use, too; None without one."""


class PathSearch:
    """Searches paths on maps of one geometry; owns the memory that A* needs."""

    def __init__(self, config: PlannerConfig, geometry: GridGeometry, unguided_expansions: int | None = None) -> None:
        """`unguided_expansions`: how many cells a search without a field may expand; by default as many as others."""
        self._config = config
        self._most_unguided = min(unguided_expansions or config.max_expansions, config.max_expansions)
        self.escape_distance = config.escape_distance
        """How far (m) a start on an impassable cell may be from the nearest traversable one."""
        self.geometry = geometry
        self.planner = Planner(geometry.width, geometry.height)

    def find(  # noqa: PLR0913  # what guides a search
        self,
        planning_map: PlanningMap,
        covers: Covers,
        start: PointXY,
        goal: PointXY,
        field: GoalField | None = None,
        detour: Detour | None = None,
        share: Share | None = None,
        origin: GoalField | None = None,
        landmarks: Landmarks | None = None,
        *,
        hurried: bool = False,
        thorough: bool = False,
    ) -> SearchResult:
        """Return the cheapest path between two points (m, frame `map`), or why there is none.

        `field` is that of the goal's cell, if there is one, `detour` a bound that holds for start and goal; without
        one, `share` is asked for it when the search is long. With `origin`, the field of where the robot came from by a
        cheapest path, the search runs from the goal to the start instead: it is short where costs have risen near the
        goal. `landmarks` guide a search without a field. `hurried`: leave the path's corners on the grid's path, which
        saves a millisecond and costs some percent more. `thorough`: search a second path by `field` or `landmarks`,
        which may be cheaper in straight lines. Refusals name no hazard and no zone: the `question` can be answered
        later.
        """
        geometry = self.geometry
        first, last = geometry.cell(*start), geometry.cell(*goal)
        impossible = None if geometry.contains_cell(*first) else start_outside(geometry, start)
        impossible = impossible or goal_out_of_reach(planning_map, goal)
        if impossible is not None:
            return refused(impossible)
        free = self.free_start(planning_map, covers, first)
        if free is None:
            return refused(start_occupied(start), Question("start", start, goal, first, last))
        if planning_map.cost[last[1], last[0]] >= INSCRIBED:
            nearest = nearest_reachable(planning_map, free, last)
            return refused(goal_occupied(goal, nearest), Question("goal", start, goal, free, last))
        back = None if origin is None else origin.toward(free)
        if back is None:
            found = self._search(planning_map, free, last, field, detour, share, landmarks)
        else:
            found = self._search(planning_map, last, free, back)
            found = None if found is None else replace(found, cells=np.ascontiguousarray(found.cells[::-1]))
        if found is None or found.timed_out:
            most = self._most(field)
            return self._without_path(planning_map, Question("path", start, goal, free, last), found, most)
        if thorough and back is None and (field is not None or landmarks is not None):
            most = self._config.second_expansions
            corners = self.planner.straightened(planning_map.cost, found.cells, most, field, landmarks)
        else:
            corners = self.planner.shortcut(planning_map.cost, found.cells, relax=not hurried)
        points = self._points(planning_map.cost, corners, start, goal, escaping=free != first)
        route = Route(points, self._config.point_spacing, escape_lines=int(free != first))
        return SearchResult(route, partial(route.cost, planning_map.cost, geometry), None)

    def _most(self, field: GoalField | None) -> int:
        """Return how many cells a search may expand."""
        return self._config.max_expansions if field is not None else self._most_unguided

    def _without_path(
        self, planning_map: PlanningMap, question: Question, found: PlanResult | None, most: int
    ) -> SearchResult:
        if found is not None:
            reason = f"no path was found within {most} expanded cells"
            return refused(refuse(TIMEOUT, PlanRefusal.SEARCH_TOO_LONG, reason), searched=True)
        return refused(no_path(nearest_reachable(planning_map, question.start_cell, question.goal_cell)), question)

    def _search(  # noqa: PLR0913  # what guides a search
        self,
        planning_map: PlanningMap,
        start: Cell,
        goal: Cell,
        field: GoalField | None,
        detour: Detour | None = None,
        share: Share | None = None,
        landmarks: Landmarks | None = None,
    ) -> PlanResult | None:
        """Search a path between two traversable cells; None if they are not connected.

        Most searches are short, so a few cells are expanded first; then it is worth to ask whether there is a path, and
        for a bound.
        """
        if planning_map.has_components and not planning_map.reachable(start, goal):
            return None
        most, quick = self._most(field), self._config.quick_expansions
        if quick < most and (share is not None or not planning_map.has_components):
            found = self.planner.plan(planning_map.cost, start, goal, quick, field, detour, landmarks)
            if not found.timed_out:
                return found if found.found else None
            if not planning_map.reachable(start, goal):
                return None
            detour = share(start, goal) if share is not None else detour
        found = self.planner.plan(planning_map.cost, start, goal, most, field, detour, landmarks)
        return found if found.found or found.timed_out else None

    def _points(self, cost: Grid, corners: Floats, start: PointXY, goal: PointXY, *, escaping: bool) -> Floats:
        """Return corners ((n, 2), columns and rows) as points (m) that start at the robot and end at the goal exactly.

        Where the line between the exact point and the next corner crosses an impassable cell, the centre of the point's
        cell is used: at most 4 cm away.
        """
        geometry = self.geometry
        cells = corners.astype(np.float64)
        exact_start, exact_goal = geometry.grid_coordinates(np.array((start, goal)))
        if len(cells) == 1:
            cells = np.concatenate((cells, cells))
        if _is_passable(cost, cells[-2], exact_goal):
            cells[-1] = exact_goal
        if escaping:
            cells = np.concatenate((exact_start[None, :], cells))
        elif _is_passable(cost, exact_start, cells[1]):
            cells[0] = exact_start
        return geometry.centres(cells)

    def aside(
        self, planning_map: PlanningMap, covers: Covers, start: PointXY, places: Grid, back: float
    ) -> Route | None:
        """Return the cheapest path to a cell that is traversable on `places`, and `back` (m) from there; None: no path.

        No robot drives the last part: until it has another path, its goal is elsewhere.
        """
        geometry = self.geometry
        first = geometry.cell(*start)
        free = self.free_start(planning_map, covers, first) if geometry.contains_cell(*first) else None
        cells = None if free is None else self.planner.exit_path(planning_map.cost, places, free)
        if cells is None or len(cells) < 2:
            return None
        corners = geometry.centres(self.planner.shortcut(planning_map.cost, cells))
        end, before = corners[-1], corners[-2]
        if math.dist(before, end) < 0.5 * back:
            return None  # too short to be told from its end
        behind = end + (before - end) * min(1.0, back / math.dist(before, end))
        points = np.concatenate((np.array((start,)), corners if free != first else corners[1:], behind[None, :]))
        return Route(points, self._config.point_spacing, escape_lines=int(free != first))

    def free_start(self, planning_map: PlanningMap, covers: Covers, start: Cell) -> Cell | None:
        """Return the start's cell, or the nearest one where a robot may be; None when it is in a hazard, zone or wall.

        The line to it may cross inscribed cells and lidar obstacles, but no wall and no blocked region.
        """
        column, row = start
        if planning_map.cost[row, column] < INSCRIBED:
            return start
        if self._is_closed(planning_map, covers, start):
            return None
        reach = math.floor(self.escape_distance / self.geometry.resolution)
        free = nearest_traversable(planning_map.cost, start, reach)
        if free is None:
            return None
        steps = 2 * max(abs(free[0] - column), abs(free[1] - row))
        for step in range(1, steps + 1):
            x = round(column + (free[0] - column) * step / steps)
            y = round(row + (free[1] - row) * step / steps)
            if planning_map.static[y, x] != FREE or self._is_closed(planning_map, covers, (x, y)):
                return None
        return free

    def _is_closed(self, planning_map: PlanningMap, covers: Covers, cell: Cell) -> bool:
        """Whether a cell belongs to a blocked hazard or zone: only lethal cells do."""
        if planning_map.cost[cell[1], cell[0]] != LETHAL:
            return False
        return covers(*self.geometry.centre(*cell), self.geometry.resolution * math.sqrt(0.5))


def _is_passable(cost: Grid, a: Floats, b: Floats) -> bool:
    return not math.isinf(line_cost(cost, float(a[0]), float(a[1]), float(b[0]), float(b[1])))


def find_egress(
    planning_map: PlanningMap, regions: Sequence[Region], start: PointXY, config: PlannerConfig, planner: Planner
) -> SearchResult:
    """Return the cheapest path from a point (m, frame `map`) to a traversable cell, however far it is.

    Inside the regions that close the robot's cell, and in their inflation, the static map's costs apply; elsewhere the
    costmap's. `regions` are those that are on, `planner` searches on maps of this size.
    """
    geometry = planning_map.geometry
    cell = geometry.cell(*start)
    if not geometry.contains_cell(*cell):
        return refused(start_outside(geometry, start))
    around_robot = [region for region in regions if region.closes(*cell)]
    others = [region for region in regions if region not in around_robot]
    margin = math.ceil(config.inflation.inflation_radius / geometry.resolution) + 2
    free = remove_regions(planning_map, around_robot, others, margin)
    begin = _traversable(free, planning_map, cell, config)
    cells = None if begin is None else planner.exit_path(free, planning_map.cost, begin)
    if cells is None:
        return refused(start_occupied(start, around_robot))
    corners = geometry.centres(cells)
    return SearchResult(Route(corners, config.point_spacing, escape_lines=len(corners) - 1), partial(float, 0.0), None)


def _traversable(free: Grid, planning_map: PlanningMap, cell: Cell, config: PlannerConfig) -> Cell | None:
    """Return the robot's cell, or, if it is too near to a wall or obstacle, the nearest one where a robot may be."""
    if free[cell[1], cell[0]] < INSCRIBED:
        return cell
    if planning_map.static[cell[1], cell[0]] != FREE:
        return None
    reach = math.floor(config.inflation.inscribed_radius / planning_map.geometry.resolution) + 1
    return nearest_traversable(free, cell, reach)
