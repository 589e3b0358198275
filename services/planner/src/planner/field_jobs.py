"""The computation of distance fields, on another thread than the core's. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_kernels.astar import Planner

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_kernels.guides import GoalField
    from fog_kernels.landmarks import Landmarks
    from fog_kernels.tiles import TilePatterns
    from planner.planning_map import Cell, Grid


class FieldScratch:
    """The memory in which fields are computed, one after another, on one thread; it exists only while it is used."""

    def __init__(self) -> None:
        self._planner: Planner | None = None

    def compute(self, bound: Grid, goal: Cell, patterns: TilePatterns, bits: int) -> GoalField:
        """Return the field of a goal, without the GIL (some 50 ms on 2000 x 1200 cells); see `Planner.goal_field`."""
        return self.planner(bound).goal_field(bound, goal, patterns, bits)

    def planner(self, bound: Grid) -> Planner:
        """Return what searches over these costs."""
        height, width = bound.shape
        if self._planner is None or (self._planner.width, self._planner.height) != (width, height):
            self._planner = Planner(width, height)
        return self._planner

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
        only_exact: bool = False,
    ) -> None:
        """`compute` returns the field of a goal over costs; `on_end` is called when the job has run.

        `only_exact`: a coarse field would be of no use.
        """
        self.goal = goal
        self.only_exact = only_exact
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


class LandmarkJob:
    """The search for another landmark over the costs below which none falls."""

    thread = "field"

    def __init__(self, landmarks: Landmarks, floor: Grid, scratch: FieldScratch) -> None:
        self.has_run = False
        self.landmarks, self._floor, self._scratch = landmarks, floor, scratch

    def run(self) -> None:
        """Add it, unless there are enough (some 90 ms on 2000 x 1200 cells)."""
        self.landmarks.add(self._floor, self._scratch.planner(self._floor).goal_field)
        if self.landmarks.is_complete:
            self._scratch.release()
        self.has_run = True
