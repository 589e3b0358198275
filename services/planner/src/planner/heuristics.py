"""The heuristics of A*: distance fields of goals, and bounds of the ways round closed parts of the floor. Pure.

Each is computed once, for all robots that search a path to the same goal or behind the same closure.

Fields share the patterns of their tiles (`fog_kernels.tiles`), so that many goals have the exact cost of every cell.
Where goals have too little in common for the memory, blocks of 2 x 2, 4 x 4, ... cells share one cost. Searches stay
exact and expand more cells, so every goal gets a field instead of some getting none.

When a shared corridor closes, the goal fields of all robots lead into it, and every search floods the same part of the
floor before it turns round. So the first search that takes long is interrupted, and one search of that part gives a
bound that guides it and all the others (`fog_kernels.detour`).
"""

from __future__ import annotations

from collections import OrderedDict
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED, NEUTRAL_WEIGHT
from fog_kernels.dead_ends import DeadEnds
from fog_kernels.detour import Shadow, compare_levels
from fog_kernels.landmarks import Landmarks
from fog_kernels.steps import DEFAULT_WEIGHTS, STRAIGHT
from fog_kernels.tiles import TilePatterns
from planner.field_jobs import FieldJob, FieldScratch, LandmarkJob

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from fog_contracts.replica import Version
    from fog_kernels.astar import Planner
    from fog_kernels.guides import Detour, GoalField
    from planner.planning_map import Cell, Grid, PlanningMap

    Labels = NDArray[np.int32]

_PATTERN_SHARE: Final = 0.5
"""How much of the memory patterns may take; the rest is for what each field has for itself."""


class GoalFields:
    """The fields of the current goals, in `capacity` bytes at most; the least recently used are coarsened first.

    They are computed over the map's standing costs. When those rise, a field guides until its successor is ready; when
    one falls, a field over the walls takes its place so long.
    """

    def __init__(self, capacity: int, landmark_capacity: int = 0) -> None:
        """`landmark_capacity`: the memory (bytes) of the landmarks' fields besides; 0: there are none."""
        self._capacity = capacity
        self._landmark_capacity = landmark_capacity
        self.landmarks: Landmarks | None = None
        """They guide searches to goals without fields."""
        self._adds_landmark = False
        self._floor: Grid = np.zeros((0, 0), dtype=np.uint8)
        self._bound: Grid = self._floor
        self._fields: OrderedDict[Cell, GoalField] = OrderedDict()
        self._fallbacks: dict[Cell, GoalField] = {}
        self._outdated: set[Cell] = set()
        """The goals whose fields are over lower costs than the bound."""
        self._running: dict[Cell, FieldJob] = {}
        self._scratch = FieldScratch()
        self._has_room_for_origins = True
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
            height, width = floor.shape
            self.landmarks = Landmarks(width, height, self._landmark_capacity) if self._landmark_capacity else None
        elif not np.all(bound >= self._bound):
            self._fields.clear()
        if not self._fields and not self._fallbacks:
            self._patterns = self._no_patterns()
        self._outdated = set(self._fields)
        self._floor, self._bound = floor, bound

    def jobs(self, goals: Iterable[Cell], origins: Iterable[Cell] = ()) -> list[FieldJob]:
        """Return the fields to compute for the current goals, each once; pass them to `add` when they have run.

        Once all goals have theirs, `origins`, where missions began, get fields in the memory that is left.
        """
        current = dict.fromkeys(goals)
        missing = self._missing(current)
        if not missing:
            return self._origin_jobs(origins)
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

    def _missing(self, cells: Iterable[Cell]) -> list[Cell]:
        return [
            cell
            for cell in cells
            if (cell not in self._fields or cell in self._outdated)
            and cell not in self._running
            and self._has_paths(cell)
        ]

    def _origin_jobs(self, origins: Iterable[Cell]) -> list[FieldJob]:
        """Return one job at most, so that a new goal never waits for long."""
        if self._running or self._patterns.crowded or not self._has_room_for_origins:
            return []
        compute = partial(self._scratch.compute, patterns=self._patterns, bits=self._bits(1))
        jobs = [
            FieldJob(cell, self._bound, None, compute, on_end=self._scratch.release, only_exact=True)
            for cell in self._missing(dict.fromkeys(origins))[:1]
        ]
        self._running.update({job.goal: job for job in jobs})
        return jobs

    def landmark_jobs(self) -> list[LandmarkJob]:
        """Return the search for another landmark, while no goal waits for its field; pass it to `add_landmark`."""
        if self.landmarks is None or self.landmarks.is_complete or self._running or self._adds_landmark:
            return []
        self._adds_landmark = True
        return [LandmarkJob(self.landmarks, self._floor, self._scratch)]

    def add_landmark(self, job: LandmarkJob) -> None:
        """Let the next landmark be searched, on another floor, too; after a job that failed, none on its floor."""
        self._adds_landmark = False
        if not job.has_run:
            job.landmarks.is_complete = True

    def _make_room(self, current: Collection[Cell]) -> None:
        """Drop fields of goals that have ended, and patterns that no field has any more."""
        self._has_room_for_origins = True
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
        if job.only_exact and not job.field.exact:
            self._has_room_for_origins = False
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


_KEPT: Final = 2
"""How many bounds are kept: each takes up to 4 bytes for every cell of the map."""
_ATTEMPTS: Final = 2
"""How many are computed at most for one version of the map, because each takes as long as a few searches."""
_CANDIDATES: Final = 64
"""Among the border costs of so many goals those that fit the others best are chosen."""
_SPARE_CELLS: Final = 4_000_000
"""On larger maps no memory is kept for the next bound: 4 bytes for each cell."""
_WORTHWHILE: Final = 2 * STRAIGHT * NEUTRAL_WEIGHT
"""By how much each bound must gain, on average, to begin anew with another goal's costs: a step over a free cell."""

Trip = tuple["Cell", "Cell"]
"""Start and goal of a search."""


class DeadEndsJob:
    """The search for the dead ends of the costs `bound`, and with `makes_memory` the memory for a first bound."""

    thread = "field"

    def __init__(self, bound: Grid, *, makes_memory: bool = False) -> None:
        self.bound = bound
        self.found: DeadEnds | None = None
        """None until `run` returns."""
        self.memory: Labels | None = None
        self._makes_memory = makes_memory

    def run(self) -> None:
        """Find them, without the GIL (some 10 ms on 2000 x 1200 cells)."""
        self.found = DeadEnds(self.bound, DEFAULT_WEIGHTS)
        if self._makes_memory:
            self.memory = np.full(self.bound.size, 0, np.int32)  # np.zeros would leave the work to the first closure


class _Memory:
    """Labels for one more shadow, used again and again.

    The system fetches and zeroes fresh memory when it is first used, which can take longer than the search itself.
    """

    def __init__(self) -> None:
        self._spare: Labels | None = None
        self._is_clean = True

    @property
    def is_missing(self) -> bool:
        return self._spare is None

    def take(self, size: int) -> Labels:
        """Return zeros."""
        spare, self._spare = self._spare, None
        if spare is None or spare.size != size:
            return np.zeros(size, np.int32)
        if not self._is_clean:
            spare.fill(0)
        return spare

    def give(self, labels: Labels, *, is_clean: bool = False) -> None:
        """Take labels back that nothing refers to any more."""
        if labels.size <= _SPARE_CELLS:
            self._spare, self._is_clean = labels, is_clean

    def clean(self) -> None:
        """Do now what would cost the next closure time."""
        if self._spare is not None and not self._is_clean:
            self._spare.fill(0)
            self._is_clean = True


class Detours:
    """The bounds that hold on the current map, newest first."""

    def __init__(self, fields: GoalFields) -> None:
        self._fields = fields
        self._found: DeadEndsJob | None = None
        self._asked: Grid | None = None
        """The costs whose dead ends were last searched."""
        self._known: list[Detour] = []
        self._memory = _Memory()
        self._version: Version | None = None
        self._attempts = 0
        self._reference_goal: Cell | None = None
        self.computed = 0
        """Number of bounds computed."""

    def clear(self) -> None:
        """Forget all bounds, because a cost fell or the map is another one."""
        self._keep([])
        self._memory.clean()  # paths that get shorter are less urgent than the next closure

    def revise(self, costmap: Grid) -> None:
        """Forget what does not hold any more on a costmap whose costs have only risen."""
        self._keep([known for known in self._known if known.holds(costmap)])

    def _keep(self, kept: list[Detour]) -> None:
        for known in self._known:
            if not any(known is other for other in kept):
                self._memory.give(known.costs.reshape(-1))
        self._known = kept

    def jobs(self) -> list[DeadEndsJob]:
        """Return the search for the dead ends of another bound, once; pass it to `add` when it has run."""
        bound = self._fields.bound
        if bound is self._asked:
            return []
        self._asked = bound
        makes_memory = self._memory.is_missing and not self._known and bound.size <= _SPARE_CELLS
        return [DeadEndsJob(bound, makes_memory=makes_memory)]

    def add(self, job: DeadEndsJob) -> None:
        """Use the dead ends from now on; those of an outdated bound are dropped."""
        if job.memory is not None:
            self._memory.give(job.memory, is_clean=True)
            job.memory = None
        if job.bound is self._fields.bound:
            self._found = job

    @property
    def dead_ends(self) -> DeadEnds | None:
        """The dead ends of the fields' bound; None until they are found."""
        return self._found.found if self._found is not None and self._found.bound is self._fields.bound else None

    def guide(self, start: Cell, goal: Cell) -> Detour | None:
        """Return the bound for a search from a closed part to a goal outside of it; None without one.

        A way that stays inside the part need not cross its border, which the bound supposes.
        """
        return next((known for known in self._known if known.covers(start) and known.outside(goal)), None)

    def may_add(self, planning_map: PlanningMap) -> bool:
        """Whether another bound may be computed for this version of the map."""
        if self._version != planning_map.version:
            self._version, self._attempts = planning_map.version, 0
        return self._attempts < _ATTEMPTS

    def compute(self, planning_map: PlanningMap, planner: Planner, trips: Sequence[Trip]) -> None:
        """Compute the bound for the searches that are due, if it may be added; the first of them needs it most.

        `planner` gives the weights, and lends its memory. Takes some 40 ns for each cell of the closed part.
        """
        exact, first = self._fields.exact, trips[0][1]
        reference = next((exact[known] for known in (self._reference_goal, first, *exact) if known in exact), None)
        if not self.may_add(planning_map) or reference is None:
            return
        self._attempts += 1
        labels = self._memory.take(planning_map.cost.size)
        shadow = self._shadow(planning_map, planner, reference, trips, labels)
        goals = [goal for start, goal in trips if shadow.contains(start) and not shadow.contains(goal)]
        better = _better([reference, *(exact[goal] for goal in (first, *goals) if goal in exact)], shadow.border)
        if better is not None:
            reference = better
            labels.fill(0)
            shadow = self._shadow(planning_map, planner, reference, trips, labels)
        detour = shadow.detour(np.maximum(reference.costs(shadow.border), 0))
        if detour is None:
            self._memory.give(labels)
            return
        self._reference_goal = reference.goal
        self._keep([detour, *self._known][:_KEPT])
        self.computed += 1

    def _shadow(
        self, planning_map: PlanningMap, planner: Planner, reference: GoalField, trips: Sequence[Trip], labels: Labels
    ) -> Shadow:
        bound = self._fields.bound
        starts, goals = zip(*trips, strict=True)
        return Shadow(planning_map.cost, bound, reference, starts, planner, self.dead_ends, goals, labels)


def _better(fields: Sequence[GoalField], border: NDArray[np.int32]) -> GoalField | None:
    """Return the field that the bounds should begin with instead of the first one; None if that serves them well.

    The second field is that of a goal whose cheapest way from the shadow costs c. So a way to a border cell b costs at
    least c - second(b); beginning with field r, the bound for goal i is not below

        c + min over b of (r(b) - second(b)) + min over b of (i(b) - r(b)).

    The field with the highest sum over all goals is chosen.
    """
    if len(fields) < 3 or len(border) == 0:  # the reference and the goal that was searched, but no other
        return None
    fields = [*fields[:2], *fields[2 :: (len(fields) - 2) // _CANDIDATES + 1]]
    costs: NDArray[np.int64] = np.stack([field.costs(border) for field in fields])
    costs = np.ascontiguousarray(costs[:, np.all(costs >= 0, axis=0)])
    if costs.size == 0:
        return None
    gains = compare_levels(costs, own=1)
    best = int(np.argmax(gains))
    return fields[best] if gains[best] - gains[0] > _WORTHWHILE * len(fields) else None
