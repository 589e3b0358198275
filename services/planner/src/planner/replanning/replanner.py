"""Searches a mission's path and decides whether it replaces the current one."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Literal

from planner.replanning.mission import Plan
from planner.replanning.replan_policy import is_kept, is_other_way, must_wait, ran_out
from planner.search.detours import Detours
from planner.search.path_search import PathSearch

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import PlanCode
    from fog_kernels.astar import Planner
    from fog_kernels.guides import Detour
    from planner.config import PlannerConfig
    from planner.maps.planning_map import Cell, PlanningMap
    from planner.replanning.mission import Mission, ReplanReason
    from planner.search.detours import DeadEndsJob, Trip
    from planner.search.goal_fields import GoalFields
    from planner.search.path_search import Covers, SearchResult

AvoidReason = Literal["far_from_path", "no_cost_fell", "unreachable"]
"""Why no search was needed: a change is far from the path, none lowered a cost, or the goal can't be reached."""


class Replanner:
    """Owns the memory of the searches, and counts them."""

    def __init__(self, config: PlannerConfig, fields: GoalFields) -> None:
        self._config = config
        self._fields = fields
        self._search: PathSearch | None = None
        self.detours = Detours(fields)
        self._next_id = 1
        self.plans: dict[ReplanReason, int] = {}
        """Number of replans, by reason."""
        self.refusals: dict[PlanCode, int] = {}
        """Number of replans that ended in a refusal, by code."""
        self.avoided: dict[AvoidReason, int] = {}
        """Number of searches that were not needed, by reason."""

    def count_avoided(self, reason: AvoidReason) -> None:
        """Count a search that was not needed."""
        self.avoided[reason] = self.avoided.get(reason, 0) + 1

    def jobs(self, robots: int) -> list[DeadEndsJob]:
        """Return the background work for so many robots with a goal: few of them have nothing to share."""
        return self.detours.jobs() if robots > self._config.detour_searches else []

    def replan(
        self,
        mission: Mission,
        reason: ReplanReason,
        planning_map: PlanningMap,
        covers: Covers,
        now: float,
        waiting: Sequence[Mission] = (),
    ) -> None:
        """Search a path for a mission with a target and a pose, and keep or replace its plan.

        `waiting`: the missions that are searched next on this map. What they have in common is computed once.
        """
        pose, target = mission.pose, mission.target
        assert pose is not None
        assert target is not None
        traces = mission.begin_replan(reason, now)
        mission.release_now()
        found = self._find(mission, planning_map, covers, waiting)
        self.plans[reason] = self.plans.get(reason, 0) + 1
        if found.refusal is not None:
            self.refusals[found.refusal.code] = self.refusals.get(found.refusal.code, 0) + 1
            if not found.searched:
                self.count_avoided("unreachable")
        mission.search_ran_out = ran_out(found)
        plan = mission.plan
        if plan is not None:
            if is_kept(plan, found, reason, planning_map, self._config):
                plan.question = found.question
                return
            if reason not in ("goal", "off_path"):
                if must_wait(plan, found, mission.switches, now, planning_map, self._config):
                    mission.switches.deferred_until = mission.switches.allowed_from(self._config)
                    return
                if is_other_way(plan, found, self._config):
                    mission.switches.record(now)
        mission.plan = Plan(
            self._next_id, found.route, found.refusal, traces, planned_from=(pose.x, pose.y), question=found.question
        )
        self._next_id += 1

    def _find(
        self, mission: Mission, planning_map: PlanningMap, covers: Covers, waiting: Sequence[Mission]
    ) -> SearchResult:
        pose, target = mission.pose, mission.target
        assert pose is not None
        assert target is not None
        geometry = planning_map.geometry
        if self._search is None or self._search.geometry != geometry:
            self._search = PathSearch(self._config, geometry, self._config.unguided_expansions)
        goal = geometry.cell(target.x, target.y)
        trip = _trip(mission, geometry)
        detour = None if trip is None else self.detours.guide(*trip)
        shared = detour is None and len(waiting) >= self._config.detour_searches and self.detours.may_add(planning_map)
        return self._search.find(
            planning_map,
            covers,
            (pose.x, pose.y),
            (target.x, target.y),
            self._fields.guide(goal),
            detour,
            partial(self._share, planning_map, self._search.planner, waiting) if shared else None,
        )

    def _share(
        self, planning_map: PlanningMap, planner: Planner, waiting: Sequence[Mission], start: Cell, goal: Cell
    ) -> Detour | None:
        """Return a bound for the search from start to goal, computed for the waiting missions, too."""
        trips = [trip for other in waiting if (trip := _trip(other, planning_map.geometry)) is not None]
        self.detours.compute(planning_map, planner, [(start, goal), *trips])
        return self.detours.guide(start, goal)


def _trip(mission: Mission, geometry: GridGeometry) -> Trip | None:
    """Return the cells of a mission's robot and goal; None when one is unknown or off the map."""
    pose, target = mission.pose, mission.target
    if pose is None or target is None:
        return None
    start, goal = geometry.cell(pose.x, pose.y), geometry.cell(target.x, target.y)
    return (start, goal) if geometry.contains_cell(*start) and geometry.contains_cell(*goal) else None
