"""Distance fields that guide the search: computed once per goal on any thread, kept within a bound of memory.

With few goals each field has one cost per cell; with more, blocks of 2 x 2, 4 x 4, ... cells share one. Searches stay
exact and expand more cells, so every goal gets a field instead of some getting none.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_kernels.astar import Planner

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from fog_kernels.guides import GoalField
    from planner.planning_map import Cell, Grid


class FieldScratch:
    """The memory in which fields are computed, one after another, on one thread; it exists only while it is used."""

    def __init__(self) -> None:
        self._planner: Planner | None = None

    def compute(self, lower_bound: Grid, goal: Cell) -> GoalField:
        """Return the field of a goal (some 50 ms on 2000 x 1200 cells, without the GIL)."""
        height, width = lower_bound.shape
        if self._planner is None or (self._planner.width, self._planner.height) != (width, height):
            self._planner = Planner(width, height)
        return self._planner.goal_field(lower_bound, goal)

    def release(self) -> None:
        """Free the memory."""
        self._planner = None


class FieldJob:
    """The computation of one goal's field over the lower-bound costmap; `bits` is how coarse it is kept."""

    thread = "field"

    def __init__(self, goal: Cell, lower_bound: Grid, bits: int, scratch: FieldScratch, *, last: bool) -> None:
        self.goal = goal
        self.lower_bound = lower_bound
        self.field: GoalField | None = None
        """None until `run` returns."""
        self.outdated = False
        self._bits = bits
        self._scratch = scratch
        self._last = last

    def run(self) -> None:
        """Compute the field, unless the lower bound has changed meanwhile."""
        if not self.outdated:
            field = self._scratch.compute(self.lower_bound, self.goal)
            while field.bits < self._bits:
                field = field.coarser()
            self.field = field
        if self._last:
            self._scratch.release()


class GoalFields:
    """The fields of the current goals, in `capacity` bytes at most; the least recently used are coarsened first."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._lower_bound: Grid = np.zeros((0, 0), dtype=np.uint8)
        self._fields: OrderedDict[Cell, GoalField] = OrderedDict()
        self._running: dict[Cell, FieldJob] = {}
        self._scratch = FieldScratch()

    @property
    def bound(self) -> Grid:
        """The costmap below which no cost falls: the fields are computed on it."""
        return self._lower_bound

    @property
    def reference(self) -> GoalField | None:
        """A field of single cells; one is kept as long as it fits. None without one."""
        return next((field for field in self._fields.values() if field.bits == 0), None)

    def set_lower_bound(self, lower_bound: Grid) -> None:
        """Set the lower bound; a new one discards all fields, because they would mislead the search."""
        if lower_bound is not self._lower_bound:
            self._lower_bound = lower_bound
            self._fields.clear()
            for job in self._running.values():
                job.outdated = True
            self._running.clear()

    def jobs(self, goals: Iterable[Cell]) -> list[FieldJob]:
        """Return the fields to compute for the current goals, each once; pass them to `add` when they have run."""
        current = dict.fromkeys(goals)
        missing = [
            goal for goal in current if goal not in self._fields and goal not in self._running and self._has_paths(goal)
        ]
        if not missing:
            return []
        for goal in [goal for goal in self._fields if goal not in current]:
            if self.size + self._share(len(current)) > self._capacity:
                del self._fields[goal]
        bits = self._bits(len(current))
        scratch, bound = self._scratch, self._lower_bound
        fine = missing[0] if self.reference is None and 2 * bound.size <= self._capacity else None
        jobs = [
            FieldJob(goal, bound, 0 if goal == fine else bits, scratch, last=goal == missing[-1]) for goal in missing
        ]
        self._running.update({job.goal: job for job in jobs})
        return jobs

    def add(self, job: FieldJob) -> None:
        """Use a computed field from now on; one over an outdated lower bound is dropped."""
        if self._running.get(job.goal) is job:
            del self._running[job.goal]
        if job.field is None or job.lower_bound is not self._lower_bound:
            return
        self._fields[job.goal] = job.field
        self._fields.move_to_end(job.goal)
        while self.size > self._capacity:
            largest = max(self._coarsenable(), key=lambda field: field.size)  # the first: the least recently used
            if max(largest.costs.shape) == 1:
                del self._fields[largest.goal]
            else:
                self._fields[largest.goal] = largest.coarser()

    def _coarsenable(self) -> list[GoalField]:
        """Return the fields that make room for others: all but the reference, if there are any."""
        reference = self.reference
        return [field for field in self._fields.values() if field is not reference] or list(self._fields.values())

    def guide(self, goal: Cell) -> GoalField | None:
        """Return the goal's field; None without one."""
        field = self._fields.get(goal)
        if field is not None:
            self._fields.move_to_end(goal)
        return field

    @property
    def size(self) -> int:
        """The memory (bytes) of all fields."""
        return sum(field.size for field in self._fields.values())

    @property
    def fields(self) -> Mapping[Cell, GoalField]:
        """A copy of the fields by goal, for another thread."""
        return dict(self._fields)

    def _has_paths(self, goal: Cell) -> bool:
        return bool(self._lower_bound[goal[1], goal[0]] < INSCRIBED)

    def _share(self, goals: int) -> int:
        return 2 * self._lower_bound.size >> 2 * self._bits(goals)

    def _bits(self, goals: int) -> int:
        """Return how coarse fields begin: at the finest that fits half of the goals; the others are coarsened."""
        bits = 0
        while goals * (2 * self._lower_bound.size >> 2 * bits) > 2 * self._capacity and bits < 16:
            bits += 1
        return bits
