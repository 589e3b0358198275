"""Distance fields that guide the search: computed once per goal on any thread, used once they are available."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_kernels.astar import Planner

if TYPE_CHECKING:
    from collections.abc import Iterable

    from planner.planning_map import Cell, Grid


class FieldJob:
    """The exact distance to one goal over the lower-bound costmap."""

    def __init__(self, goal: Cell, lower_bound: Grid) -> None:
        self.goal = goal
        self.lower_bound = lower_bound
        self.planner: Planner | None = None
        """The search that the field guides; None until `run` returns."""

    def run(self) -> None:
        """Compute the field (some 50 ms on 2000 x 1200 cells, without the GIL)."""
        height, width = self.lower_bound.shape
        planner = Planner(width, height)
        planner.set_goal_field(self.lower_bound, self.goal)
        self.planner = planner


class GoalFields:
    """The fields of at most `capacity` goals; the least recently used ones are dropped."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._lower_bound: Grid = np.zeros((0, 0), dtype=np.uint8)
        self._guides: OrderedDict[Cell, Planner] = OrderedDict()
        self._running: dict[Cell, FieldJob] = {}

    def set_lower_bound(self, lower_bound: Grid) -> None:
        """Set the lower bound; a new one discards all fields, because they would mislead the search."""
        if lower_bound is not self._lower_bound:
            self._lower_bound = lower_bound
            self._guides.clear()
            self._running.clear()

    def jobs(self, goals: Iterable[Cell]) -> list[FieldJob]:
        """Return the fields to compute for the current goals, each once; pass them to `add` when they have run.

        With more goals than the capacity, the first ones get a field.
        """
        jobs = []
        for goal in list(dict.fromkeys(goals))[: self._capacity]:
            if goal in self._guides or goal in self._running or self._lower_bound[goal[1], goal[0]] >= INSCRIBED:
                continue
            self._running[goal] = FieldJob(goal, self._lower_bound)
            jobs.append(self._running[goal])
        return jobs

    def add(self, job: FieldJob) -> None:
        """Use a computed field from now on; one over an outdated lower bound is dropped."""
        if self._running.get(job.goal) is job:
            del self._running[job.goal]
        if job.planner is None or job.lower_bound is not self._lower_bound:
            return
        self._guides[job.goal] = job.planner
        self._guides.move_to_end(job.goal)
        while len(self._guides) > self._capacity:
            self._guides.popitem(last=False)

    def guide(self, goal: Cell) -> Planner | None:
        """Return the search that the goal's field guides; None without a field."""
        guide = self._guides.get(goal)
        if guide is not None:
            self._guides.move_to_end(goal)
        return guide
