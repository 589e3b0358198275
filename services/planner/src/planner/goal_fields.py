"""Distance fields that guide the search: computed once per goal on any thread, kept within a bound of memory.

With few goals each field has one cost per cell; with more, blocks of 2 x 2, 4 x 4, ... cells share one. Searches stay
exact and expand more cells, so every goal gets a field instead of some getting none.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_kernels.astar import Planner

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from fog_kernels.guides import GoalField
    from planner.planning_map import Cell, Grid

_FALLBACK_BITS: Final = 3
"""Blocks of 8 x 8 cells: a 64th of the memory of a field of single cells."""


class FieldScratch:
    """The memory in which fields are computed, one after another, on one thread; it exists only while it is used."""

    def __init__(self) -> None:
        self._planner: Planner | None = None

    def compute(self, bound: Grid, goal: Cell) -> GoalField:
        """Return the field of a goal (some 50 ms on 2000 x 1200 cells, without the GIL)."""
        height, width = bound.shape
        if self._planner is None or (self._planner.width, self._planner.height) != (width, height):
            self._planner = Planner(width, height)
        return self._planner.goal_field(bound, goal)

    def release(self) -> None:
        """Free the memory."""
        self._planner = None


class FieldJob:
    """The computation of one goal's field over the costs `bound`; `bits` is how coarse it is kept.

    With a `floor` a coarse field over those costs is computed, too: it remains when a cost falls below the bound.
    """

    thread = "field"

    def __init__(
        self, goal: Cell, bound: Grid, floor: Grid | None, bits: int, scratch: FieldScratch, *, last: bool
    ) -> None:
        self.goal = goal
        self.bound = bound
        self.field: GoalField | None = None
        """None until `run` returns."""
        self.fallback: GoalField | None = None
        self.outdated = False
        self._floor = floor
        self._bits = bits
        self._scratch = scratch
        self._last = last

    def run(self) -> None:
        """Compute the field, unless the bound has changed meanwhile."""
        if not self.outdated:
            self.field = coarsened(self._scratch.compute(self.bound, self.goal), self._bits)
            if self._floor is not None:
                self.fallback = coarsened(self._scratch.compute(self._floor, self.goal), _FALLBACK_BITS)
        if self._last:
            self._scratch.release()


def coarsened(field: GoalField, bits: int) -> GoalField:
    """Return a field of blocks of at least 2^bits cells a side."""
    while field.bits < bits:
        field = field.coarser()
    return field


class GoalFields:
    """The fields of the current goals, in `capacity` bytes at most; the least recently used are coarsened first.

    They are computed over the map's standing costs. When those rise, a field guides until its successor is ready; when
    one falls, a coarse field over the walls takes its place so long.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._floor: Grid = np.zeros((0, 0), dtype=np.uint8)
        self._bound: Grid = self._floor
        self._fields: OrderedDict[Cell, GoalField] = OrderedDict()
        self._fallbacks: dict[Cell, GoalField] = {}
        self._outdated: set[Cell] = set()
        """The goals whose fields are over lower costs than the bound."""
        self._running: dict[Cell, FieldJob] = {}
        self._scratch = FieldScratch()

    @property
    def bound(self) -> Grid:
        """The costs that the fields are computed on."""
        return self._bound

    @property
    def reference(self) -> GoalField | None:
        """A field of single cells; one is kept as long as it fits. None without one."""
        return next((field for field in self._fields.values() if field.bits == 0), None)

    def set_bounds(self, floor: Grid, bound: Grid) -> None:
        """Set the costs below which none falls (`floor`), and those below which none has fallen (`bound`).

        Another floor discards all fields, because they would mislead the search; so does a lower bound, but for the
        fallbacks.
        """
        if floor is self._floor and bound is self._bound:
            return
        for job in self._running.values():
            job.outdated = True
        self._running.clear()
        if floor is not self._floor:
            self._fields.clear()
            self._fallbacks.clear()
        elif not np.all(bound >= self._bound):
            self._fields.clear()
        self._outdated = set(self._fields)
        self._floor, self._bound = floor, bound

    def jobs(self, goals: Iterable[Cell]) -> list[FieldJob]:
        """Return the fields to compute for the current goals, each once; pass them to `add` when they have run."""
        current = dict.fromkeys(goals)
        missing = [
            goal
            for goal in current
            if (goal not in self._fields or goal in self._outdated)
            and goal not in self._running
            and self._has_paths(goal)
        ]
        if not missing:
            return []
        self._make_room(current)
        bits = self._bits(len(current))
        bound, scratch = self._bound, self._scratch
        floor = None if bound is self._floor else self._floor
        known = self.reference
        has_reference = known is not None and known.goal not in self._outdated
        fine = missing[0] if not has_reference and 2 * bound.size <= self._capacity else None
        jobs = [
            FieldJob(goal, bound, floor, 0 if goal == fine else bits, scratch, last=goal == missing[-1])
            for goal in missing
        ]
        self._running.update({job.goal: job for job in jobs})
        return jobs

    def _make_room(self, current: Collection[Cell]) -> None:
        """Drop fields of goals that have ended."""
        for goal in [goal for goal in self._fallbacks if goal not in current]:
            del self._fallbacks[goal]
        for goal in [goal for goal in self._fields if goal not in current]:
            if self.size + self._share(len(current)) > self._capacity:
                del self._fields[goal]

    def add(self, job: FieldJob) -> None:
        """Use a computed field from now on; one over an outdated bound is dropped."""
        if self._running.get(job.goal) is job:
            del self._running[job.goal]
        if job.field is None or job.bound is not self._bound:
            return
        self._fields[job.goal] = job.field
        self._fields.move_to_end(job.goal)
        self._outdated.discard(job.goal)
        if job.fallback is not None:
            self._fallbacks[job.goal] = job.fallback
        while self.size > self._capacity and self._fields:
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
        if field is None:
            return self._fallbacks.get(goal)
        self._fields.move_to_end(goal)
        return field

    @property
    def size(self) -> int:
        """The memory (bytes) of all fields."""
        return sum(field.size for field in (*self._fields.values(), *self._fallbacks.values()))

    @property
    def fields(self) -> Mapping[Cell, GoalField]:
        """A copy of the fields by goal, for another thread."""
        return {**self._fallbacks, **self._fields}

    def _has_paths(self, goal: Cell) -> bool:
        return bool(self._bound[goal[1], goal[0]] < INSCRIBED)

    def _share(self, goals: int) -> int:
        return 2 * self._bound.size >> 2 * self._bits(goals)

    def _bits(self, goals: int) -> int:
        """Return how coarse fields begin: at the finest that fits half of the goals; the others are coarsened."""
        bits = 0
        while goals * (2 * self._bound.size >> 2 * bits) > 2 * self._capacity and bits < 16:
            bits += 1
        return bits
