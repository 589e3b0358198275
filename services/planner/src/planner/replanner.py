"""When a robot needs another path, and whether a path that was found replaces the current one. Pure.

A path that has become impassable is replaced at once. One that is passable is replaced only when another saves enough,
and moved to another way (not just straightened) only some time after the last such switch: hazards that come and go
move a robot at most once per `switch_dwell_s`, and ever more seldom while they continue.
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, Literal

from fog_contracts.costs import INSCRIBED, NEUTRAL_WEIGHT
from planner.heuristics import Detours
from planner.missions import Plan, ReplanReason
from planner.path_search import PathSearch
from planner.refusals import TIMEOUT

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import PlanCode, PointXY, RobotPose, Trace
    from fog_kernels.astar import Planner
    from fog_kernels.guides import Detour
    from planner.config import PlannerConfig
    from planner.heuristics import DeadEndsJob, GoalFields, Trip
    from planner.leases.corridors import Disc
    from planner.leases.standstills import Room
    from planner.missions import Mission, SwitchLimiter
    from planner.path_search import Covers, Route, SearchResult
    from planner.planning_map import Cell, CostChange, PlanningMap
    from planner.waits.choice import Judgement, Waits

_BACK_M: Final = 0.2
"""So much of its path a robot that stands aside is not released: it has not reached its goal."""
_ESCAPE_M: Final = 0.8
"""How far a robot on the way of another one may be from places beside that."""
_ROUND_M: Final = 15.0
"""So much longer (m) a path may be that makes room, before robots stand aside instead."""
_PAST_M: Final = 5.0
"""The same of one that leads past a robot on the same floor, before one of them waits instead."""
_UNHURRIED: Final[frozenset[ReplanReason]] = frozenset({"goal", "clearing"})
"""Why a path is searched on which nothing has come: nobody has to turn round or stop until it is found."""
_PROGRESS_WINDOW_M: Final = 5.0
"""How far ahead of its last progress a robot is searched on its path, so that a loop is not cut short."""


@dataclass(frozen=True)
class Effect:
    """A change of the map requires a replan; the robot meets it `distance` (m) along its path, if it does."""

    reason: ReplanReason
    distance: float = math.inf


def effect_of_change(
    mission: Mission, change: CostChange, planning_map: PlanningMap, config: PlannerConfig
) -> Effect | None:
    """Return why a change of the map requires a replan; None when it does not matter to the mission.

    A refused robot gets a path only where a cost fell.
    """
    plan = mission.plan
    if plan is None or mission.target is None:
        return None
    if plan.route is None:
        return Effect("refused") if change.any_decreased else None
    if plan.waits and change.any_decreased:
        return Effect("map")  # the path ends before what the robot waits for
    distance = distance_to_change(plan, plan.route, change, planning_map, config.corridor_half_width)
    if not math.isinf(distance):
        return Effect("map", distance)
    if change.any_decreased:
        robot = (mission.pose.x, mission.pose.y) if mission.pose else _point_at(plan.route, plan.progress)
        if may_save(plan, plan.route, change.window, planning_map, robot, config.min_saving):
            return Effect("clearing")
    return None


def distance_to_change(
    plan: Plan, route: Route, change: CostChange, planning_map: PlanningMap, half_width: float
) -> float:
    """Return how far (m) along its path a robot comes within `half_width` (m) of a changed cell; infinity if never."""
    window, near = change.near(half_width, planning_map.geometry)
    return route.distance_to(near, window, planning_map.geometry, plan.progress)


def may_save(
    plan: Plan, route: Route, window: Window, planning_map: PlanningMap, robot: PointXY, saving: float
) -> bool:
    """Whether a path through the window, if all its cells were free, could save the share `saving` of the cost."""
    geometry = planning_map.geometry
    end_x, end_y = route.corners[-1]
    distance = _cell_distance(geometry.cell(*robot), window) + _cell_distance(
        geometry.cell(float(end_x), float(end_y)), window
    )
    remaining = route.cost(planning_map.cost, geometry, plan.progress)
    return distance * NEUTRAL_WEIGHT < (1.0 - saving) * remaining


def reason_from_pose(plan: Plan, pose: RobotPose, config: PlannerConfig) -> ReplanReason | None:
    """Update the robot's progress; return why its pose requires a replan, None when it is on its path."""
    if plan.route is None:
        moved = math.hypot(pose.x - plan.planned_from[0], pose.y - plan.planned_from[1])
        return "refused" if moved > config.max_deviation else None
    along, deviation = plan.route.nearest(pose.x, pose.y, plan.progress, window=_PROGRESS_WINDOW_M)
    plan.progress = max(plan.progress, along)
    return "off_path" if deviation > config.max_deviation else None


def _cell_distance(cell: Cell, window: Window) -> float:
    """Return the distance (cells) from a cell to a window; 0 inside."""
    dx = max(window.x - cell[0], 0, cell[0] - window.x - window.width + 1)
    dy = max(window.y - cell[1], 0, cell[1] - window.y - window.height + 1)
    return math.hypot(dx, dy)


def _point_at(route: Route, along: float) -> PointXY:
    x, y = route.remaining(along)[0]
    return float(x), float(y)


def is_kept(plan: Plan, found: SearchResult, reason: ReplanReason, rest: float, config: PlannerConfig) -> bool:
    """Whether the current plan is kept: the same refusal, or a passable path that is not clearly worse.

    `rest`: its `remaining_cost`. A search that took too long says nothing about a path that is passable: the robot goes
    on.
    """
    if found.refusal is not None:
        if ran_out(found) and reason not in ("goal", "off_path") and not math.isinf(rest):
            return True
        before = plan.refusal
        if before is None or found.question is None:
            return before == found.refusal
        # The current refusal may be explained already.
        return (before.code, before.nearest) == (found.refusal.code, found.refusal.nearest)
    if plan.route is None or reason in ("goal", "off_path"):
        return False
    share = config.min_saving if reason == "clearing" else config.hysteresis
    return not math.isinf(rest) and found.cost >= (1.0 - share) * rest


def _may_be_reached(mission: Mission, planning_map: PlanningMap) -> bool:
    """Whether there may be a path to a goal: what is unreachable is so with more in the way, too, which takes 4 ms."""
    pose, target, geometry = mission.pose, mission.target, planning_map.geometry
    assert pose is not None
    assert target is not None
    start, goal = geometry.cell(pose.x, pose.y), geometry.cell(target.x, target.y)
    if not geometry.contains_cell(*start) or not geometry.contains_cell(*goal):
        return False
    # From a closed cell a robot is led out first, wherever to.
    return planning_map.cost[start[1], start[0]] >= INSCRIBED or planning_map.reachable(start, goal)


def ran_out(found: SearchResult) -> bool:
    """Whether a search took too long, so that there may be a path all the same."""
    return found.refusal is not None and found.refusal.code == TIMEOUT


def remaining_cost(plan: Plan | None, planning_map: PlanningMap) -> float:
    """Return the cost of the rest of a path; infinite without one, or when it is impassable."""
    if plan is None or plan.route is None:
        return math.inf
    return plan.route.cost(planning_map.cost, planning_map.geometry, plan.progress)


def is_other_way(plan: Plan, found: SearchResult, config: PlannerConfig) -> bool:
    """Whether a found path leads another way than the rest of the current one."""
    if plan.route is None or found.route is None:
        return False
    return found.route.differs_from(plan.route, plan.progress, config.max_deviation)


def must_wait(
    plan: Plan, found: SearchResult, switches: SwitchLimiter, now: float, rest: float, config: PlannerConfig
) -> bool:
    """Whether a better path has to wait, because it leads another way and the last switch was a moment ago.

    `rest`: the current one's `remaining_cost`.
    """
    if now >= switches.allowed_from(config) or math.isinf(rest):
        return False
    return is_other_way(plan, found, config)


AvoidReason = Literal["far_from_path", "no_cost_fell", "unreachable"]
"""Why no search was needed: a change is far from the path, none lowered a cost, or the goal can't be reached."""


class Replanner:
    """Owns the memory of the searches, and counts them."""

    def __init__(self, config: PlannerConfig, fields: GoalFields, waits: Waits) -> None:
        self._config = config
        self._fields = fields
        self._waits = waits
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

    def origins(self, missions: Iterable[Mission], geometry: GridGeometry) -> list[Cell]:
        """Return the cells where missions with a path began, as far as they lie on the map."""
        plans = [mission.plan for mission in missions]
        cells = [geometry.cell(*plan.origin) for plan in plans if plan is not None and plan.origin is not None]
        return [cell for cell in cells if geometry.contains_cell(*cell)]

    def replan(  # noqa: PLR0913  # what a search depends on
        self,
        mission: Mission,
        reason: ReplanReason,
        planning_map: PlanningMap,
        covers: Covers,
        now: float,
        waiting: Sequence[Mission] = (),
        avoid: Sequence[Disc] = (),
    ) -> None:
        """Search a path for a mission with a target and a pose, and keep or replace its plan.

        `waiting`: the missions that are searched next on this map. What they have in common is computed once. `avoid`:
        places of other robots, through which the path leads only if it can't lead round them.
        """
        pose, target = mission.pose, mission.target
        assert pose is not None
        assert target is not None
        danger = mission.danger
        traces, plan = mission.begin_replan(reason, now), mission.plan
        mission.release_now()
        leads_round = bool(avoid) and _may_be_reached(mission, planning_map)
        beside = self._find_beside(mission, planning_map.avoiding(avoid), covers) if leads_round else None
        found, planning_map = beside or (None, planning_map)
        rest = remaining_cost(plan, planning_map)
        found = found or self._find(mission, reason, planning_map, covers, waiting, danger, rest)
        self.plans[reason] = self.plans.get(reason, 0) + 1
        if found.refusal is not None:
            self.refusals[found.refusal.code] = self.refusals.get(found.refusal.code, 0) + 1
            if not found.searched:
                self.count_avoided("unreachable")
        mission.search_ran_out = ran_out(found)
        way = plan.route if plan is not None else None
        judged = self._waits.judge(way, mission.blocked, (pose.x, pose.y), found, planning_map)
        mission.blocked = judged
        if judged is not None and judged.waits:
            self._wait(mission, judged, traces)
            return
        if plan is not None and not plan.waits:
            if is_kept(plan, found, reason, rest, self._config):
                plan.question, plan.judged = found.question, judged or plan.judged
                return
            if reason not in ("goal", "off_path"):
                if must_wait(plan, found, mission.switches, now, rest, self._config):
                    mission.switches.deferred_until = mission.switches.allowed_from(self._config)
                    return
                if is_other_way(plan, found, self._config):
                    mission.switches.record(now)
        here = (pose.x, pose.y)
        origin = plan.origin if plan is not None else None
        mission.plan = Plan(
            self._next_id, found.route, found.refusal, traces, planned_from=here, question=found.question,
            origin=here if origin is None and found.route is not None else origin, judged=judged,
        )  # fmt: skip
        self._next_id += 1

    def _wait(self, mission: Mission, judged: Judgement, traces: list[Trace]) -> None:
        """Let a robot wait where it may turn to the way round; if it does already, tell only what has changed."""
        plan, pose = mission.plan, mission.pose
        assert plan is not None
        assert pose is not None
        if plan.judged is not None and plan.judged.stays(judged.place):
            hold = min(plan.judged.hold, plan.progress + judged.hold)  # less if the block has grown towards the robot
            plan.judged, plan.path_due = replace(plan.judged, choice=judged.choice, hold=hold), -math.inf
            plan.traces += [trace for trace in traces if trace not in plan.traces]
            return
        mission.plan = Plan(
            self._next_id, judged.route, None, traces, planned_from=(pose.x, pose.y), origin=plan.origin, judged=judged
        )  # fmt: skip
        self._next_id += 1

    def make_room(self, mission: Mission, room: Room, planning_map: PlanningMap, covers: Covers) -> Plan | None:
        """Return a plan that lets a robot and those whom it meets get on, if there is one; it may be refused."""
        pose, plan = mission.pose, mission.plan
        if pose is None or plan is None or plan.route is None:
            return None
        avoiding, start = planning_map.avoiding(room.avoid), (pose.x, pose.y)
        if room.kind == "aside":
            places = planning_map.avoiding(room.keep_off).cost
            route = self._beside(planning_map.geometry).aside(avoiding, covers, start, places, _BACK_M)
            waits_after = math.inf if route is None else route.last_corner
        else:
            found = self._find_beside(mission, avoiding, covers)
            longer = {"past": _PAST_M, "lane": _PAST_M, "detour": math.inf}.get(room.kind, _ROUND_M)
            route, waits_after = None if found is None else found[0].route, math.inf
            if route is not None and route.length > plan.route.length - plan.progress + longer:
                return None
        if route is None:
            return None
        self._next_id += 1
        number = self._next_id - 1
        return Plan(number, route, None, [], planned_from=start, origin=plan.origin, waits_after=waits_after)

    def _find_beside(
        self, mission: Mission, avoiding: PlanningMap, covers: Covers
    ) -> tuple[SearchResult, PlanningMap] | None:
        """Return a path on a map that has other robots on it, and that map; None without one."""
        pose, target, geometry = mission.pose, mission.target, avoiding.geometry
        assert pose is not None
        assert target is not None
        field = self._fields.guide(geometry.cell(target.x, target.y))
        found = self._beside(geometry).find(avoiding, covers, (pose.x, pose.y), (target.x, target.y), field)
        return None if found.route is None else (found, avoiding)

    def _beside(self, geometry: GridGeometry) -> PathSearch:
        """Return what searches beside other robots: a robot that stands on their way may be led off it."""
        if self._search is None or self._search.geometry != geometry:
            self._search = PathSearch(self._config, geometry, self._config.unguided_expansions)
        return beside_others(self._search)

    def _find(  # noqa: PLR0913  # what a search depends on
        self,
        mission: Mission,
        reason: ReplanReason,
        planning_map: PlanningMap,
        covers: Covers,
        waiting: Sequence[Mission],
        danger: float,
        rest: float,
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
        crowded = len(waiting) >= self._config.detour_searches
        shared = detour is None and crowded and self.detours.may_add(planning_map)
        origin = None if crowded or detour is not None else begun_at(mission.plan, danger)
        return self._search.find(
            planning_map,
            covers,
            (pose.x, pose.y),
            (target.x, target.y),
            self._fields.guide(goal),
            detour,
            partial(self._share, planning_map, self._search.planner, waiting) if shared else None,
            None if origin is None else self._fields.guide(geometry.cell(*origin)),
            self._fields.landmarks,
            # A way that is compared with the present one has its corners moved, too.
            thorough=reason in _UNHURRIED and not crowded,
            hurried=crowded and math.isinf(rest),
        )

    def _share(
        self, planning_map: PlanningMap, planner: Planner, waiting: Sequence[Mission], start: Cell, goal: Cell
    ) -> Detour | None:
        """Return a bound for the search from start to goal, computed for the waiting missions, too."""
        trips = [trip for other in waiting if (trip := _trip(other, planning_map.geometry)) is not None]
        self.detours.compute(planning_map, planner, [(start, goal), *trips])
        return self.detours.guide(start, goal)


def beside_others(search: PathSearch) -> PathSearch:
    """Return what searches on a map that has other robots on it, with the memory of `search`."""
    beside = copy(search)
    beside.escape_distance = _ESCAPE_M
    return beside


def begun_at(plan: Plan | None, danger: float) -> PointXY | None:
    """Return where a mission began, if the change of the map is nearer to its goal than its robot; else None.

    Then the field of that place guides a search from the goal. `danger`: how far (m) the robot is from the change along
    its path.
    """
    if plan is None or plan.route is None or math.isinf(danger):
        return None
    return plan.origin if 2.0 * danger > plan.route.length - plan.progress else None


def _trip(mission: Mission, geometry: GridGeometry) -> Trip | None:
    """Return the cells of a mission's robot and goal; None when one is unknown or off the map."""
    pose, target = mission.pose, mission.target
    if pose is None or target is None:
        return None
    start, goal = geometry.cell(pose.x, pose.y), geometry.cell(target.x, target.y)
    return (start, goal) if geometry.contains_cell(*start) and geometry.contains_cell(*goal) else None
