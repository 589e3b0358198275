"""Distance fields that guide the search: computed once per goal on any thread, kept within a bound of memory.

Fields share the patterns of their tiles (`fog_kernels.tiles`), so that many goals have the exact cost of every cell.
Where goals have too little in common for the memory, blocks of 2 x 2, 4 x 4, ... cells share one cost. Searches stay
exact and expand more cells, so every goal gets a field instead of some getting none.
"""

from __future__ import annotations

from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_kernels.astar import Planner
from fog_kernels.tiles import TilePatterns

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

    from fog_kernels.guides import GoalField
    from planner.maps.planning_map import Cell, Grid

_PATTERN_SHARE: Final = 0.5
"""How much of the memory patterns may take; the rest is for what each field has for itself."""


class FieldScratch:
    """The memory in which fields are computed, one after another, on one thread; it exists only while it is used."""

    def __init__(self) -> None:
        self._planner: Planner | None = None

    def compute(self, bound: Grid, goal: Cell, patterns: TilePatterns, bits: int) -> GoalField:
        """Return the field of a goal, without the GIL (some 50 ms on 2000 x 1200 cells); see `Planner.goal_field`."""
        height, width = bound.shape
        if self._planner is None or (self._planner.width, self._planner.height) != (width, height):
            self._planner = Planner(width, height)
        return self._planner.goal_field(bound, goal, patterns, bits)

    def release(self) -> None:
        """Free the memory."""
        self._planner = None


class FieldJob:
    """The computation of one goal's field over the costs `bound`.

    With a `floor` a field over those costs is computed, too: it remains when a cost falls below the bound.
    """

    thread = "field"

    def __init__(
        self,
        goal: Cell,
        bound: Grid,
        floor: Grid | None,
        compute: Callable[[Grid, Cell], GoalField],
        *,
        on_end: Callable[[], object] | None = None,
    ) -> None:
        """`compute` returns the field of a goal over costs; `on_end` is called when the job has run."""
        self.goal = goal
        self.bound = bound
        self.field: GoalField | None = None
        """None until `run` returns."""
        self.fallback: GoalField | None = None
        self.outdated = False
        self._floor = floor
        self._compute = compute
        self._on_end = on_end

    def run(self) -> None:
        """Compute the field, unless the bound has changed meanwhile."""
        if not self.outdated:
            self.field = self._compute(self.bound, self.goal)
            if self._floor is not None:
                self.fallback = self._compute(self._floor, self.goal)
        if self._on_end is not None:
            self._on_end()


class GoalFields:
    """The fields of the current goals, in `capacity` bytes at most; the least recently used are coarsened first.

    They are computed over the map's standing costs. When those rise, a field guides until its successor is ready; when
    one falls, a field over the walls takes its place so long.
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
        self._patterns = self._no_patterns()

    def _no_patterns(self) -> TilePatterns:
        return TilePatterns(round(self._capacity * _PATTERN_SHARE))

    @property
    def bound(self) -> Grid:
        """The costs that the fields are computed on."""
        return self._bound

    @property
    def exact(self) -> dict[Cell, GoalField]:
        """The exact fields over the bound, by goal."""
        return {goal: field for goal, field in self._fields.items() if field.exact and goal not in self._outdated}

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
        if not self._fields and not self._fallbacks:
            self._patterns = self._no_patterns()
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
        compute = partial(self._scratch.compute, patterns=self._patterns, bits=bits)
        floor = None if self._bound is self._floor else self._floor
        end = self._scratch.release
        jobs = [
            FieldJob(goal, self._bound, floor, compute, on_end=end if goal == missing[-1] else None) for goal in missing
        ]
        self._running.update({job.goal: job for job in jobs})
        return jobs

    def _make_room(self, current: Collection[Cell]) -> None:
        """Drop fields of goals that have ended, and patterns that no field has any more."""
        for goal in [goal for goal in self._fallbacks if goal not in current]:
            del self._fallbacks[goal]
        for goal in [goal for goal in self._fields if goal not in current]:
            if self._patterns.crowded or self.size + self._share(len(current)) > self._capacity:
                del self._fields[goal]
        fields = [*self._fields.values(), *self._fallbacks.values()]
        if self._running or not self._patterns.worth_compacting(fields):
            return
        self._patterns, compacted = self._patterns.compacted(fields)
        self._fields = OrderedDict(zip(self._fields, compacted, strict=False))
        self._fallbacks = dict(zip(self._fallbacks, compacted[len(self._fields) :], strict=True))

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
            if max(largest.lowest.shape) == 1:
                del self._fields[largest.goal]
            else:
                self._fields[largest.goal] = largest.coarser()

    def _coarsenable(self) -> list[GoalField]:
        """Return the fields that make room for others: those of blocks, or else exact ones."""
        return [field for field in self._fields.values() if not field.exact] or list(self._fields.values())

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
        own = sum(field.size for field in (*self._fields.values(), *self._fallbacks.values()))
        return own + self._patterns.size

    @property
    def fields(self) -> Mapping[Cell, GoalField]:
        """A copy of the fields by goal, for another thread."""
        return {**self._fallbacks, **self._fields}

    def _has_paths(self, goal: Cell) -> bool:
        return bool(self._bound[goal[1], goal[0]] < INSCRIBED)

    def _share(self, goals: int) -> int:
        return 4 * self._bound.size >> 2 * self._bits(goals)

    def _bits(self, goals: int) -> int:
        """Return how coarse fields without patterns begin: at the finest that fits half of the goals."""
        bits, room = 0, self._capacity * (1.0 - _PATTERN_SHARE)
        while goals * (4 * self._bound.size >> 2 * bits) > 2 * room and bits < 16:
            bits += 1
        return bits
