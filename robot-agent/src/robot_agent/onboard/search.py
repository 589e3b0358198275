"""Search of a path on the robot's own costmap: A* from scratch, with the same kernel as the fog's planner."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_contracts.messages import Refusal
from fog_kernels.astar import Planner, nearest_traversable
from fog_kernels.lines import line_cost

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import PlanCode, PointXY, RobotGoal

    Grid = NDArray[np.uint8]

_ESCAPE_M: Final = 0.5
"""How far from the robot its path may begin, when it stands where its centre should not be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """The result of a search by `planner`: corner points (m, frame `map`), or why there is no path."""

    planner: Planner
    goal: RobotGoal
    points: list[PointXY]
    refusal: Refusal | None = None

    @property
    def length(self) -> float:
        """Length of the path, m."""
        return sum(math.dist(a, b) for a, b in zip(self.points, self.points[1:], strict=False))


@dataclass(frozen=True, slots=True, kw_only=True)
class Search:
    """A search that is due; `run` may be called on any thread, while nobody writes the costmap."""

    planner: Planner
    cost: Grid
    geometry: GridGeometry
    start: PointXY
    goal: RobotGoal

    def run(self) -> Found:
        """Return the cheapest path, or a refusal."""
        assert self.goal.pose is not None
        geometry, goal = self.geometry, (self.goal.pose.x, self.goal.pose.y)
        first, last = geometry.cell(*self.start), geometry.cell(*goal)
        if not geometry.contains_cell(*first):
            return self._refused(203, "the robot is off its map")
        if not geometry.contains_cell(*last):
            return self._refused(204, "the goal is off the map")
        free = nearest_traversable(self.cost, first, math.floor(_ESCAPE_M / geometry.resolution))
        if free is None:
            return self._refused(205, f"nothing is free within {_ESCAPE_M} m of the robot")
        if self.cost[last[1], last[0]] >= INSCRIBED:
            return self._refused(206, "the goal is occupied")
        found = self.planner.plan(self.cost, free, last)
        if not found.found:
            return self._refused(208, "no path leads to the goal on the robot's own map")
        return Found(planner=self.planner, goal=self.goal, points=self._points(found.cells, goal))

    def _points(self, cells: NDArray[np.int32], goal: PointXY) -> list[PointXY]:
        """Return the corners of a path by cells, from the robot to the goal exactly where the lines are free."""
        corners = self.planner.shortcut(self.cost, cells) if len(cells) > 1 else np.repeat(cells, 2, axis=0)
        ends = self.geometry.grid_coordinates(np.array((self.start, goal)))
        points = self.geometry.centres(corners)
        for end, inner, exact in ((0, 1, self.start), (-1, -2, goal)):
            x, y = ends[end]
            next_x, next_y = corners[inner]
            if not math.isinf(line_cost(self.cost, float(x), float(y), float(next_x), float(next_y))):
                points[end] = exact
        return [(float(x), float(y)) for x, y in points]

    def _refused(self, code: PlanCode, reason: str) -> Found:
        return Found(planner=self.planner, goal=self.goal, points=[], refusal=Refusal(code=code, reason=reason))
