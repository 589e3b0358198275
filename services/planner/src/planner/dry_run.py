"""What a change of zones or areas would do to robots' paths, and which places it cuts off; where a goal leads. Pure.

The change comes as the cells that it would change (`MapPatch`). They are put on a copy of the map, on which each robot
is treated as after a real change: by the same rules whether a search is needed, by the same search, and by the same
rules whether its result replaces the current path (`replanner`). What depends on when a change comes is left out: that
a switch to another way may have to wait, that a robot may wait for the end of what closes its way, that robots which
meet make room for one another, and that a large change reaches the map in portions.
"""

from __future__ import annotations

import copy
import math
import zlib
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import structs

from fog_contracts.costs import INSCRIBED
from fog_contracts.grid import Window
from fog_contracts.messages import (
    DryRunOutcome,
    DryRunReply,
    GoalOutcome,
    HazardArea,
    PathOutcome,
    ReachOutcome,
    RobotOutcome,
    Zone,
)
from fog_contracts.replica import unpack
from planner.path_search import find_egress
from planner.planning_map import CostChange, body_reach, under_body, with_time
from planner.queries import Answerer, View
from planner.refusals import no_map
from planner.regions import Regions, cover, is_closing
from planner.replanner import begun_at, beside_others, effect_of_change, is_kept, remaining_cost
from planner.waits.pace import Times

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from fog_contracts.messages import Cause, DryRunRequest, Layer, MapPatch, PointXY, Refusal, RobotPose
    from planner.config import PlannerConfig
    from planner.leases.corridors import Disc
    from planner.missions import Mission
    from planner.path_search import PathSearch, Route, SearchResult
    from planner.planning_map import Cell, Grid, PlanningMap
    from planner.regions import Source

KNOWN_S: Final = 60.0
"""A robot whose last pose is older is left out: nobody knows where it is."""
NAMED_PLACES: Final = 50
"""Most other places that are named for one place; the rest is counted."""


class StaleError(Exception):
    """The map has other cells than the change was computed for."""


@dataclass(frozen=True)
class State:
    """What the core knows at one moment, unchanged by later messages: the map-service's layers, and the robots."""

    view: View
    layers: Mapping[Layer, Grid]
    limits: Grid
    """The speed limit (cm/s, 0: none) for a robot in each cell."""
    missions: Mapping[str, Mission]
    avoid: Mapping[str, Sequence[Disc]]
    """The places of other robots that a new path of each robot should avoid."""

    @classmethod
    def of(
        cls,
        view: View,
        layers: Mapping[Layer, Grid],
        limits: Grid,
        missions: Mapping[str, Mission],
        avoid: Mapping[str, Sequence[Disc]],
        now: float,
    ) -> State:
        """Return the state with copies of the missions of robots whose pose is known at `now` (s, monotonic)."""
        located = {
            robot: _copied(mission)
            for robot, mission in missions.items()
            if mission.pose is not None and now - mission.pose_received <= KNOWN_S
        }
        return cls(view, layers, limits, located, avoid)


def _copied(mission: Mission) -> Mission:
    """Return a copy of what a search needs of a mission, and changes."""
    return replace(mission, plan=None if mission.plan is None else copy.copy(mission.plan), traces=[])


class DryRun:
    """One change on a copy of the map: `prepare`, then `steps`, which may run on any thread, then `outcome`."""

    def __init__(self, state: State, request: DryRunRequest, config: PlannerConfig) -> None:
        self._state = state
        self._request = request
        self._config = config
        self._answerer = Answerer(config)
        self._regions = Regions(config.inflation)
        self._robots: list[RobotOutcome] = []
        self._reach: tuple[list[ReachOutcome], list[ReachOutcome]] = ([], [])
        self._finished: set[str] = set()
        self._after = state.view
        self._limits = state.limits
        self._changes: list[CostChange] = []

    def prepare(self) -> None:
        """Put the change on the copy, and compare what can be reached; raises `StaleError`."""
        before = self._state.view.planning_map
        cost, layers = before.cost.copy(), {layer: cells.copy() for layer, cells in self._state.layers.items()}
        windows, reach = [], body_reach(self._config.inflation, before.geometry)
        for patch in self._request.patches:
            window, cells = _cells_of(patch, layers[patch.layer], before)
            layers[patch.layer][window.rows, window.columns] = cells
            windows.append(before.geometry.clip(window.grown(reach)) if patch.layer == "speed" else window)
        limits = under_body(layers["speed"], reach)
        for window in windows:
            place = window.rows, window.columns
            old, new = cost[place].copy(), layers["cost"][place]
            cost[place] = new = with_time(new, limits[place]) if self._config.time_in_cost else new
            self._changes.append(CostChange(window, new != old, new < old, []))
        sources = _sources_after(self._state.view.sources, self._request)
        after = replace(before, cost=cost, standing=_standing_after(before, cost))
        known = self._state.view
        guides = (known.fields, known.landmarks) if after.standing is before.standing else ({}, None)
        self._after = View(after, sources, -1, partial(cover, sources), *guides)
        self._limits = limits
        self._reach = self._compare_reach(before, after)

    @property
    def steps(self) -> list[Callable[[], None]]:
        """What is to be done for each robot; each takes no longer than one search."""
        return [partial(self._add, robot, mission) for robot, mission in self._state.missions.items()]

    def outcome(self) -> DryRunReply:
        """Return what was found; robots whose steps did not run are named."""
        version = self._state.view.planning_map.version
        return DryRunReply(
            outcome=DryRunOutcome(
                map_epoch=version.epoch,
                map_seq=version.seq,
                robots=self._robots,
                cut_off=self._reach[0],
                connected=self._reach[1],
                unfinished=sorted(set(self._state.missions) - self._finished),
            )
        )

    # --- Robots -----------------------------------------------------------------------------------------------------

    def _add(self, robot: str, mission: Mission) -> None:
        self._finished.add(robot)
        pose = mission.pose
        assert pose is not None
        outcome = RobotOutcome(robot=robot) if mission.target is None else self._path_after(robot, mission, pose)
        goal = None if mission.target is None else (mission.target.x, mission.target.y)
        outcome = structs.replace(outcome, at=(pose.x, pose.y), goal=goal)
        inside = self._closing(pose)
        if inside is not None:
            start = (pose.x, pose.y)
            found = find_egress(
                self._after.planning_map,
                self._regions.on(self._after.planning_map, self._after.sources),
                start,
                self._config,
                self._answerer.search(self._after).planner,
            )
            way_out = _outcome(found.route, found.refusal, self._limits, self._after.planning_map)
            outcome = structs.replace(outcome, inside=inside, way_out=way_out)
        if mission.target is not None or inside is not None:
            self._robots.append(outcome)

    def _path_after(self, robot: str, mission: Mission, pose: RobotPose) -> RobotOutcome:
        before_map, after_map = self._state.view.planning_map, self._after.planning_map
        plan, target = mission.plan, mission.target
        assert target is not None
        before = None
        if plan is not None:
            before = _outcome(plan.route, plan.refusal, self._state.limits, before_map, plan.progress)
        effects = [effect_of_change(mission, change, after_map, self._config) for change in self._changes]
        reasons = [effect.reason for effect in effects if effect is not None]
        if plan is not None and not reasons:
            after = _outcome(plan.route, plan.refusal, self._limits, after_map, plan.progress)
            return _compared(robot, before, after, replanned=False)
        danger = min((effect.distance for effect in effects if effect is not None), default=math.inf)
        search = self._answerer.search(self._after)
        found, after_map = _found(
            self._after,
            search,
            (pose.x, pose.y),
            (target.x, target.y),
            self._state.avoid[robot],
            begun_at(plan, danger),
        )
        reason = "map" if "map" in reasons else reasons[0] if reasons else "goal"
        rest = remaining_cost(plan, after_map)
        if plan is not None and not plan.waits and is_kept(plan, found, reason, rest, self._config):
            after = _outcome(plan.route, self._explained(found) or plan.refusal, self._limits, after_map, plan.progress)
            return _compared(robot, before, after, replanned=False)
        after = _outcome(found.route, self._explained(found), self._limits, after_map)
        return _compared(robot, before, after, replanned=True)

    def _explained(self, found: SearchResult) -> Refusal | None:
        explained = None if found.question is None else self._answerer.explain(self._after, found.question)
        return explained or found.refusal

    def _closing(self, pose: RobotPose) -> list[Cause] | None:
        """Return what would close a robot's cell that is not closed now; None if nothing would."""
        before, after = self._state.view.planning_map, self._after.planning_map
        column, row = before.geometry.cell(pose.x, pose.y)
        if not before.geometry.contains_cell(column, row):
            return None
        if before.cost[row, column] >= INSCRIBED or after.cost[row, column] < INSCRIBED:
            return None
        regions = self._regions.on(after, self._after.sources)
        return [region.cause for region in regions if region.closes(column, row)][:16]

    # --- Places -----------------------------------------------------------------------------------------------------

    def _compare_reach(self, before: PlanningMap, after: PlanningMap) -> tuple[list[ReachOutcome], list[ReachOutcome]]:
        """Return which places the change cuts off, and which it connects."""
        views = (self._state.view, self._after)
        targets = [self._labels_of_targets(planning_map) for planning_map in (before, after)]
        robots = [self._labels_of_robots(view) for view in views]
        return self._lost(targets[0], targets[1], robots[0], robots[1]), self._lost(
            targets[1], targets[0], robots[1], robots[0]
        )

    def _labels_of_targets(self, planning_map: PlanningMap) -> NDArray[np.int64]:
        cells = [planning_map.geometry.cell(*target.at) for target in self._request.targets]
        return np.array([planning_map.components.of(*cell) for cell in cells], np.int64)

    def _labels_of_robots(self, view: View) -> NDArray[np.int64]:
        """Return the part of the floor in which each robot's search would begin; -1 for none."""
        planning_map, search = view.planning_map, self._answerer.search(view)
        labels = []
        for mission in self._state.missions.values():
            assert mission.pose is not None
            cell: Cell | None = planning_map.geometry.cell(mission.pose.x, mission.pose.y)
            if cell is not None and planning_map.geometry.contains_cell(*cell):
                cell = search.free_start(planning_map, view.covers, cell)
            labels.append(-1 if cell is None else planning_map.components.of(*cell))
        return np.array(labels, np.int64)

    def _lost(
        self,
        targets_before: NDArray[np.int64],
        targets_after: NDArray[np.int64],
        robots_before: NDArray[np.int64],
        robots_after: NDArray[np.int64],
    ) -> list[ReachOutcome]:
        robots = list(self._state.missions)
        names = [target.id if target.kind == "place" else f"dock:{target.id}" for target in self._request.targets]
        found = []
        for number, target in enumerate(self._request.targets):
            label, now = targets_before[number], targets_after[number]
            if label < 0:
                continue
            cut_robots = (robots_before == label) & ((robots_after != now) | (now < 0))
            cut_places = (targets_before == label) & ((targets_after != now) | (now < 0))
            cut_places[number] = False
            if not (cut_robots.any() or cut_places.any() or now < 0):
                continue
            others = [names[other] for other in np.flatnonzero(cut_places).tolist()]
            found.append(
                ReachOutcome(
                    kind=target.kind,
                    id=target.id,
                    closed=bool(now < 0),
                    robots=[robots[index] for index in np.flatnonzero(cut_robots).tolist()],
                    places=others[:NAMED_PLACES],
                    more=max(0, len(others) - NAMED_PLACES),
                )
            )
        return found


def run(state: State | None, request: DryRunRequest, config: PlannerConfig) -> DryRunReply:
    """Return the outcome of a change, computed at once; None as state: there is no map yet."""
    if state is None:
        return DryRunReply(refusal=no_map())
    dry_run = DryRun(state, request, config)
    try:
        dry_run.prepare()
    except StaleError:
        return DryRunReply(stale=True)
    for step in dry_run.steps:
        step()
    return dry_run.outcome()


def _found(  # what a search depends on
    view: View, search: PathSearch, at: PointXY, goal: PointXY, avoid: Sequence[Disc], origin: PointXY | None = None
) -> tuple[SearchResult, PlanningMap]:
    """Search as the planner does, by the same guides: of ways that cost the same it must find the same one."""
    geometry, known = view.planning_map.geometry, view.planning_map
    field = view.fields.get(geometry.cell(*goal))
    if avoid:
        beside = known.avoiding(avoid)
        if (found := beside_others(search).find(beside, view.covers, at, goal, field)).route is not None:
            return found, beside
    begun = None if origin is None else view.fields.get(geometry.cell(*origin))
    return search.find(known, view.covers, at, goal, field, origin=begun, landmarks=view.landmarks), known


def goal_outcome(state: State, robot: str, goal: PointXY, config: PlannerConfig) -> GoalOutcome:
    """Return the path that a robot with a known pose would get to a goal (m, frame `map`)."""
    view, mission = state.view, state.missions[robot]
    pose = mission.pose
    assert pose is not None
    answerer = Answerer(config)
    found, _ = _found(view, answerer.search(view), (pose.x, pose.y), goal, state.avoid[robot])
    explained = None if found.question is None else answerer.explain(view, found.question)
    version = view.planning_map.version
    return GoalOutcome(
        robot=robot,
        map_epoch=version.epoch,
        map_seq=version.seq,
        path=_outcome(found.route, explained or found.refusal, state.limits, view.planning_map),
        points=[] if found.route is None else found.route.corner_points,
    )


def seconds_along(route: Route, along: float, limits: Grid, planning_map: PlanningMap) -> float:
    """Return how long (s) a robot takes for a route from `along` (m) on, at the usual speed or the limits' (cm/s).

    Turns in place are not counted.
    """
    return float(Times.of(route, limits, planning_map.geometry, along).seconds[-1])


def _outcome(
    route: Route | None, refusal: Refusal | None, limits: Grid, planning_map: PlanningMap, along: float = 0.0
) -> PathOutcome:
    if route is None:
        return PathOutcome(refusal=refusal)
    length = max(0.0, route.length - along)
    return PathOutcome(length_m=round(length, 3), seconds=round(seconds_along(route, along, limits, planning_map), 2))


def _compared(robot: str, before: PathOutcome | None, after: PathOutcome, *, replanned: bool) -> RobotOutcome:
    both = before is not None and before.refusal is None and after.refusal is None
    return RobotOutcome(
        robot=robot,
        before=before,
        after=after,
        replanned=replanned,
        extra_m=round(after.length_m - before.length_m, 3) if both and before is not None else None,
        extra_s=round(after.seconds - before.seconds, 2) if both and before is not None else None,
    )


def _cells_of(patch: MapPatch, grid: Grid, planning_map: PlanningMap) -> tuple[Window, Grid]:
    """Return a patch's window and cells; raises `StaleError` when the map has other cells than it was made for."""
    window = Window(patch.x, patch.y, patch.w, patch.h)
    if planning_map.geometry.clip(window) != window:
        raise StaleError
    old = np.ascontiguousarray(grid[window.rows, window.columns])
    if zlib.crc32(old.data) != patch.base:
        raise StaleError
    return window, unpack(patch.packing, patch.cells, (patch.h, patch.w), "a patch")


def _standing_after(before: PlanningMap, cost: Grid) -> Grid:
    """Return the standing costs, lowered where traversable cells become cheaper; the same array if nowhere."""
    fell = (cost < before.standing) & (cost < INSCRIBED)
    return np.where(fell, cost, before.standing).astype(np.uint8) if fell.any() else before.standing


def _sources_after(sources: Sequence[Source], request: DryRunRequest) -> tuple[Source, ...]:
    """Return the hazards and zones that make cells lethal after the change."""
    zones = {zone.id for zone in request.zones} | set(request.removed)
    areas = {hazard.hazard.area for hazard in request.hazards}
    kept = [
        source
        for source in sources
        if not (source.hazard.area in areas if isinstance(source, HazardArea) else source.id in zones)
    ]
    hazards = sorted(
        [source for source in (*kept, *request.hazards) if isinstance(source, HazardArea) and is_closing(source)],
        key=lambda source: source.hazard.area,
    )
    closing = sorted(
        [source for source in (*kept, *request.zones) if isinstance(source, Zone) and source.kind == "BLOCKED"],
        key=lambda zone: zone.id,
    )
    return (*hazards, *closing)
