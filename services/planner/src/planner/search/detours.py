"""Bounds of the ways round closed parts of the floor: computed once, for all robots that search a path behind them.

When a shared corridor closes, the goal fields of all robots lead into it, and every search floods the same part of the
floor before it turns round. So the first search that takes long is interrupted, and one search of that part gives a
bound that guides it and all the others (`fog_kernels.detour`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import NEUTRAL_WEIGHT
from fog_kernels.dead_ends import DeadEnds
from fog_kernels.detour import Shadow, compare_levels
from fog_kernels.steps import DEFAULT_WEIGHTS, STRAIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.replica import Version
    from fog_kernels.astar import Planner
    from fog_kernels.guides import Detour, GoalField
    from planner.maps.planning_map import Cell, Grid, PlanningMap
    from planner.search.goal_fields import GoalFields

    Labels = NDArray[np.int32]

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
