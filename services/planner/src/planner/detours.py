"""Bounds of the ways round closed parts of the floor: computed once, for all robots that search a path behind them.

When a shared corridor closes, the goal fields of all robots lead into it, and every search floods the same part of the
floor before it turns round. The first such search pays for it; then one more search of that part gives a bound that
guides all the others (`fog_kernels.detour`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels.detour import Shadow
from fog_kernels.guides import border_costs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.replica import Version
    from fog_kernels.astar import Planner
    from fog_kernels.guides import Detour, GoalField
    from planner.goal_fields import GoalFields
    from planner.planning_map import Cell, PlanningMap

_KEPT: Final = 2
"""How many bounds are kept: each takes 2 bytes for every cell of the map."""
_ATTEMPTS: Final = 2
"""How many are computed at most for one version of the map, because each takes as long as a few searches."""
_CANDIDATES: Final = 16
"""Among the border costs of so many goals those that fit the others best are chosen."""

Trip = tuple["Cell", "Cell"]
"""Start and goal of a search."""


class Detours:
    """The bounds that hold on the current map, newest first."""

    def __init__(self, fields: GoalFields) -> None:
        self._fields = fields
        self._known: list[Detour] = []
        self._version: Version | None = None
        self._attempts = 0
        self.computed = 0
        """Number of bounds computed."""

    def clear(self) -> None:
        """Forget all bounds, because a cost fell or the map is another one; while costs only rise they hold."""
        self._known.clear()

    def guide(self, start: Cell, goal: Cell) -> Detour | None:
        """Return the bound for a search; None without one."""
        return next((known for known in self._known if known.covers(start) and not known.covers(goal)), None)

    def compute(
        self, planning_map: PlanningMap, planner: Planner, cells: NDArray[np.int32], trips: Sequence[Trip]
    ) -> None:
        """Compute the bound for the searches that are due, unless there have been enough for this version of the map.

        `planner` gives the weights; `cells` is the path of the search before them, whose way out the others should
        share. Takes some 60 ns for each cell of the closed part.
        """
        if self._version != planning_map.version:
            self._version, self._attempts = planning_map.version, 0
        reference = self._fields.reference
        if self._attempts >= _ATTEMPTS or reference is None:
            return
        self._attempts += 1
        starts = [(int(cells[0, 0]), int(cells[0, 1])), *(start for start, _ in trips)]
        shadow = Shadow(planning_map.cost, self._fields.bound, reference, starts, planner)
        behind = [(start, goal) for start, goal in trips if shadow.contains(start) and not shadow.contains(goal)]
        fields = [field for _, goal in behind if (field := self._fields.guide(goal)) is not None]
        way_out = shadow.exit_of(cells)
        if not fields or way_out is None:
            return
        detour = shadow.detour(_levels(fields, shadow.border, way_out))
        if detour is not None:
            self._known = [detour, *self._known][:_KEPT]
            self.computed += 1


def _levels(fields: Sequence[GoalField], border: NDArray[np.int32], way_out: int) -> NDArray[np.int64]:
    """Return the border costs of the goal that serves the others best.

    A bound is tight for a goal whose costs differ from them at the way out by no more than elsewhere; the excess is
    what is lost.
    """
    costs: NDArray[np.int64] = np.stack([border_costs(field, border) for field in fields])
    reached = np.all(costs >= 0, axis=0)
    if not reached[way_out]:
        return np.zeros(len(border), np.int64)
    candidates = range(0, len(fields), -(-len(fields) // _CANDIDATES))
    losses = []
    for candidate in candidates:
        differences = costs - costs[candidate]
        losses.append(float(np.sum(differences[:, way_out] - differences[:, reached].min(axis=1))))
    chosen: NDArray[np.int64] = costs[candidates[int(np.argmin(losses))]]
    chosen[~reached] = chosen.max()
    return chosen
