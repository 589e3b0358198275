"""Decides every robot's way: plans on the master costmap, and plans again when a change of the map matters.

Pure: inputs are values, time is an argument, nothing here waits or computes in the background. `now` is monotonic
seconds, `stamp` seconds as in messages.
"""

import heapq
import math
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fog_contracts.channels import MAP_HEARTBEAT, ROBOT_GOAL, ROBOT_PATH, ROBOT_STATE
from fog_contracts.costs import DEFAULT_INFLATION, INSCRIBED, LETHAL, UNKNOWN, Inflation
from fog_contracts.follower import MapFollower
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import (
    PLAN_CODES,
    Cause,
    EgressRequest,
    HazardArea,
    MapDelta,
    MapHeartbeat,
    MapSnapshot,
    PlanCode,
    PlanReply,
    PlanRequest,
    PointXY,
    Pose,
    Refusal,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
    Trace,
    ZoneSet,
)
from fog_contracts.replica import Applied
from fog_kernels.astar import Planner, line_cost, nearest_traversable
from fog_kernels.inflation import inflate, inflation_table
from planner.reasons import Region, cutting, hazard_region, lifted, zone_region
from planner.route import Floats, Route

Grid = NDArray[np.uint8]
Why = Literal["goal", "map", "epoch", "strayed", "clearing", "refused"]
"""Why a robot's way is planned again; `map` is a change within the swept corridor of its remaining path."""


@dataclass(frozen=True)
class PlannerConfig:
    """Lengths in m, times in s. The inflation is the map-service's; it only makes the search faster."""

    inflation: Inflation = DEFAULT_INFLATION
    corridor: float = 0.72
    """Half the width that counts as touched: the robot's radius and the inflation band."""
    saving: float = 0.10
    """A cheaper way elsewhere is taken when it saves this share of the remaining cost."""
    hysteresis: float = 0.03
    """A way that is still passable is kept unless another saves this share, so that no robot dithers between two."""
    stray: float = 1.0
    escape: float = 0.5
    """How far a robot inside the inscribed band may be from the nearest cell where it could be."""
    spacing: float = 0.10
    release: float = 15.0
    """How much of the path ahead of the robot it may drive without hearing from the planner again."""
    republish_s: float = ROBOT_PATH.period_s
    goal_republish_s: float = ROBOT_GOAL.period_s
    robot_silent_s: float = ROBOT_STATE.max_age_s
    """Nothing is planned for a robot whose last pose is older: it is away, and hears nothing either."""
    map_age_s: float = MAP_HEARTBEAT.max_age_s
    gap_s: float = 0.5
    """How long a heartbeat may run ahead of the deltas before the map is fetched whole."""
    max_expansions: int = 50_000_000
    goal_fields: int = 8
    """Goals for which a distance field is kept (20 to 30 MB each on 2000 x 1200 cells)."""
    egress_cells: int = 40_000
    """Cells (100 m2 at 5 cm) that a search for a way out of a blocked area looks at."""


@dataclass
class _Plan:
    """The way in force, or the refusal; `at` is how far along (m) the robot is."""

    plan_id: int
    route: Route | None
    refusal: Refusal | None
    why: Why
    traces: list[Trace]
    at: float = 0.0
    planned_from: PointXY = (0.0, 0.0)


@dataclass
class _Robot:
    pose: RobotPose | None = None
    pose_at: float = -math.inf
    goal: RobotGoal | None = None
    any_heading: bool = False
    plan: _Plan | None = None
    dirty: Why | None = None
    traces: list[Trace] = field(default_factory=list)
    path_due: float = -math.inf
    goal_due: float = math.inf


class FieldJob:
    """The exact distance to one goal over the static map: computed once per goal, on any thread."""

    def __init__(self, goal: tuple[int, int], floor: Grid, floor_version: int) -> None:
        self.goal = goal
        self.floor_version = floor_version
        self._floor = floor
        self.planner: Planner | None = None

    def run(self) -> None:
        """Compute it (some 50 ms on 2000 x 1200 cells, without the GIL)."""
        height, width = self._floor.shape
        planner = Planner(width, height)
        planner.set_goal_field(self._floor, self.goal)
        self.planner = planner


@dataclass(frozen=True)
class _Found:
    route: Route | None
    cost: float
    refusal: Refusal | None


class PlannerCore:
    """Goals, poses and map versions in; paths, refusals and ended goals out."""

    def __init__(self, epoch: int, config: PlannerConfig | None = None) -> None:
        self.epoch = epoch
        self.config = config or PlannerConfig()
        self._map = MapFollower(grace_s=self.config.gap_s)
        self._robots: dict[str, _Robot] = {}
        self._hazards: dict[str, HazardArea] = {}
        self._zones: ZoneSet | None = None
        self._regions: list[Region] | None = None
        self._floor: Grid = np.zeros((0, 0), dtype=np.uint8)
        self._floor_version = 0
        self._before: Grid = self._floor
        self._planner: Planner | None = None
        self._guided: OrderedDict[tuple[int, int], Planner] = OrderedDict()
        self._wanted: dict[tuple[int, int], FieldJob | None] = {}
        self._next_id = 1
        self.plans: dict[Why, int] = {}
        """How many times a way was computed, by reason."""
        self.refusals: dict[PlanCode, int] = {}
        """How many of them ended in a refusal, by code."""

    # --- The map ----------------------------------------------------------------------------------------------------

    def wants_snapshot(self, now: float) -> bool:
        """Whether deltas were lost, or there is no map yet."""
        return self._map.wants_snapshot(now)

    @property
    def geometry(self) -> GridGeometry | None:
        """The map's geometry; None before the first snapshot."""
        return self._map.geometry

    def load(self, snapshot: MapSnapshot, now: float) -> None:
        """Take a snapshot; raises `MapError` and changes nothing when it is damaged or outdated."""
        known, shape = self._map.version, self._map.geometry
        applied = self._map.on_snapshot(snapshot, now)
        geometry = self._map.geometry
        assert geometry is not None
        self._set_floor(geometry)
        if shape != geometry:
            self._planner = Planner(geometry.width, geometry.height)
            self._regions = None
        self._before = self._map.cost.copy()
        same_history = known is not None and known.epoch == snapshot.epoch
        for robot in self._robots.values():
            if robot.goal and robot.goal.pose:
                robot.dirty = robot.dirty or ("map" if same_history else "epoch")
                robot.traces += applied.traces

    def _set_floor(self, geometry: GridGeometry) -> None:
        """Take what costs can never fall below: the inflated static map (or less, should the master be lower)."""
        table = inflation_table(geometry.resolution, self.config.inflation)
        floor = np.minimum(inflate(np.ascontiguousarray(self._map.static), table), self._map.cost)
        if not np.array_equal(floor, self._floor):
            self._lower_floor(floor)

    def _lower_floor(self, floor: Grid) -> None:
        """Use another floor: fields over the old one would mislead the search."""
        self._floor = floor
        self._floor_version += 1
        self._guided.clear()
        self._wanted = dict.fromkeys(self._goal_cells())

    def on_delta(self, delta: MapDelta, now: float) -> None:
        """Take a delta; robots whose way it touches, or whom it may serve with a better one, are planned again."""
        applied = self._map.on_delta(delta, now)
        if applied is not None:
            self._changed(applied)

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Compare with the map-service's version; deltas that stay away make a snapshot necessary."""
        self._map.on_heartbeat(heartbeat, now)

    def _changed(self, applied: Applied) -> None:
        geometry = self._map.geometry
        assert geometry is not None
        cost = self._map.cost
        for layer, window in applied.windows:
            if layer != "cost":
                continue
            old, new = self._before[window.rows, window.columns], cost[window.rows, window.columns]
            floor = self._floor[window.rows, window.columns]
            if np.any((new < floor) & (new < INSCRIBED)):
                lower = self._floor.copy()
                lower[window.rows, window.columns] = np.minimum(floor, new)
                self._lower_floor(lower)
            changed, fell = old != new, new < old
            if changed.any():
                for robot in self._robots.values():
                    self._judge(robot, changed, fell, window, applied.traces)
            self._before[window.rows, window.columns] = new

    def _judge(
        self, robot: _Robot, changed: NDArray[np.bool_], fell: NDArray[np.bool_], window: Window, traces: list[Trace]
    ) -> None:
        """Mark a robot whose way must be planned again after a change in the window."""
        geometry, plan = self._map.geometry, robot.plan
        assert geometry is not None
        if plan is None or robot.goal is None or robot.goal.pose is None:
            return
        why: Why | None = None
        if plan.route is None:
            why = "refused"
        elif plan.route.touched(changed, window, geometry, self.config.corridor, plan.at):
            why = "map"
        elif fell.any() and self._may_save(robot, plan, plan.route, window):
            why = "clearing"
        if why is None:
            return
        if robot.dirty is None or why == "map":
            robot.dirty = why
        robot.traces += [trace for trace in traces if trace not in robot.traces]

    def _may_save(self, robot: _Robot, plan: _Plan, route: Route, window: Window) -> bool:
        """Whether a way through the window could save the set share, if everything on it were free."""
        geometry, planner = self._map.geometry, self._planner
        assert geometry is not None
        assert planner is not None
        x, y = self._place(robot, route, plan)
        end_x, end_y = route.corners[-1]
        column, row = geometry.cell(x, y)
        end_column, end_row = geometry.cell(float(end_x), float(end_y))

        def away(column: int, row: int) -> float:
            dx = max(window.x - column, 0, column - window.x - window.width + 1)
            dy = max(window.y - row, 0, row - window.y - window.height + 1)
            return math.hypot(dx, dy)

        least = (away(column, row) + away(end_column, end_row)) * planner.neutral
        remaining = route.cost(self._map.cost, geometry, plan.at)
        return least < (1.0 - self.config.saving) * remaining

    @staticmethod
    def _place(robot: _Robot, route: Route, plan: _Plan) -> PointXY:
        if robot.pose is not None:
            return robot.pose.x, robot.pose.y
        x, y = route.rest(plan.at)[0]
        return float(x), float(y)

    # --- Goals and robots -------------------------------------------------------------------------------------------

    def check_goal(self, x: float, y: float) -> Refusal | None:
        """Return why a goal can never be reached: off the map, in a wall or where nobody has looked; else None.

        Hazards and zones come and go: a goal inside one is taken, and refused by its path as long as that lasts.
        """
        geometry = self._map.geometry
        if geometry is None:
            return None
        column, row = geometry.cell(x, y)
        if not geometry.contains_cell(column, row):
            return self._refusal(204, f"the goal ({x:.2f}, {y:.2f}) lies outside the map {_extent(geometry)}")
        if self._floor[row, column] < INSCRIBED:
            return None
        near = nearest_traversable(self._floor, (column, row), round(5.0 / geometry.resolution))
        nearest = geometry.centre(*near) if near else None
        what = {LETHAL: "in a wall", UNKNOWN: "where the map is unknown"}.get(
            int(self._map.static[row, column]), "too near a wall for the robot"
        )
        return self._refusal(206, f"the goal ({x:.2f}, {y:.2f}) lies {what}{_nearest(nearest)}", nearest=nearest)

    def set_goal(self, robot: str, goal: RobotGoal, *, any_heading: bool = False) -> None:
        """Give a robot a mission; the same goal again changes nothing. `any_heading`: the goal's theta is no wish."""
        known = self._robots.setdefault(robot, _Robot())
        if goal.pose is None:
            self.cancel(robot)
            return
        if known.goal and known.goal.goal_id == goal.goal_id and known.goal.pose == goal.pose:
            return
        known.goal, known.any_heading = goal, any_heading
        known.plan, known.dirty, known.traces = None, "goal", []
        known.goal_due = -math.inf
        self._want_field(goal.pose)

    def cancel(self, robot: str) -> None:
        """End a robot's mission; the next `tick` says so to the robot."""
        known = self._robots.get(robot)
        if known is None or known.goal is None or known.goal.pose is None:
            return
        known.goal = structs.replace(known.goal, pose=None)
        known.plan, known.dirty, known.traces = None, None, []
        known.goal_due = -math.inf

    def goal(self, robot: str) -> RobotGoal | None:
        """Return the robot's mission, if it has one."""
        known = self._robots.get(robot)
        return known.goal if known and known.goal and known.goal.pose else None

    def on_pose(self, robot: str, pose: RobotPose, now: float) -> None:
        """Take a robot's pose; one that strayed from its path is planned again."""
        known = self._robots.setdefault(robot, _Robot())
        if not pose.localized:
            known.pose = None
            return
        known.pose, known.pose_at = pose, now
        plan = known.plan
        if plan is None or known.dirty is not None:
            return
        if plan.route is None:
            if math.hypot(pose.x - plan.planned_from[0], pose.y - plan.planned_from[1]) > self.config.stray:
                known.dirty = "refused"
            return
        along, away = plan.route.nearest(pose.x, pose.y, plan.at, window=5.0)
        plan.at = max(plan.at, along)
        if away > self.config.stray:
            known.dirty = "strayed"

    def on_state(self, robot: str, state: RobotState, now: float) -> None:  # noqa: ARG002  # every input has its time
        """Take a robot's state: a goal that it reached is over."""
        goal = self.goal(robot)
        if goal and state.goal_reached and state.goal_id == goal.goal_id:
            self.cancel(robot)

    def on_hazard(self, told: HazardArea) -> None:
        """Take a reason behind cells, for refusals in words."""
        self._hazards[told.hazard.area] = told
        self._regions = None

    def on_zones(self, zones: ZoneSet) -> None:
        """Take the zones behind cells, for refusals in words."""
        self._zones = zones
        self._regions = None

    def _blocking_regions(self) -> list[Region]:
        """Hazards and zones that have lethal cells right now."""
        geometry = self._map.geometry
        assert geometry is not None
        if self._regions is None:
            reach = self.config.inflation.inflation_radius + 2 * geometry.resolution
            hazards = (hazard_region(told, geometry, reach) for _, told in sorted(self._hazards.items()))
            zones = (zone_region(zone, geometry, reach) for zone in (self._zones.zones if self._zones else []))
            self._regions = [region for region in (*hazards, *zones) if region is not None]
        return [region for region in self._regions if region.blocks(self._map.cost)]

    # --- Distance fields: computed elsewhere, used when they are there -----------------------------------------------

    def _goal_cells(self) -> Iterable[tuple[int, int]]:
        geometry = self._map.geometry
        if geometry is None:
            return
        for robot in self._robots.values():
            if robot.goal and robot.goal.pose:
                cell = geometry.cell(robot.goal.pose.x, robot.goal.pose.y)
                if geometry.contains_cell(*cell):
                    yield cell

    def _want_field(self, pose: Pose) -> None:
        geometry = self._map.geometry
        if geometry is None:
            return
        cell = geometry.cell(pose.x, pose.y)
        if geometry.contains_cell(*cell) and cell not in self._guided:
            self._wanted.setdefault(cell, None)

    def field_jobs(self) -> list[FieldJob]:
        """Return distance fields to be computed, each once: run them on any thread, then hand them to `take_field`."""
        wanted = [goal for goal in self._goal_cells() if self._wanted.get(goal, self) is None]
        self._wanted = {goal: job for goal, job in self._wanted.items() if job is not None}
        jobs = []
        for goal in list(dict.fromkeys(wanted))[: self.config.goal_fields]:
            if self._floor[goal[1], goal[0]] < INSCRIBED:
                job = FieldJob(goal, self._floor, self._floor_version)
                self._wanted[goal] = job
                jobs.append(job)
        return jobs

    def take_field(self, job: FieldJob) -> None:
        """Use a computed field from now on; one over a floor that no longer holds is dropped."""
        if self._wanted.get(job.goal) is job:
            del self._wanted[job.goal]
        if job.planner is None or job.floor_version != self._floor_version:
            return
        self._guided[job.goal] = job.planner
        self._guided.move_to_end(job.goal)
        while len(self._guided) > self.config.goal_fields:
            self._guided.popitem(last=False)

    # --- What goes out ----------------------------------------------------------------------------------------------

    def tick(self, now: float, stamp: float) -> list[tuple[str, RobotPath | RobotGoal]]:
        """Plan what must be planned and return what is to be published; call at 10 Hz and after every delta.

        While the map is stale nothing is released: the robots hear nothing and slow down by themselves.
        """
        out: list[tuple[str, RobotPath | RobotGoal]] = []
        fresh_map = self._map_fresh(now)
        for name, robot in self._robots.items():
            if robot.goal is None:
                continue
            if now >= robot.goal_due:
                out.append((name, structs.replace(robot.goal, stamp=stamp)))
                robot.goal_due = now + self.config.goal_republish_s
            pose = robot.pose
            if pose is None or now - robot.pose_at > self.config.robot_silent_s or not fresh_map:
                continue
            if robot.goal.pose is None:
                continue
            if robot.dirty is not None or robot.plan is None:
                self._replan(robot, robot.goal.pose, pose, stamp)
                robot.path_due = -math.inf
            if now >= robot.path_due and robot.plan is not None:
                out.append((name, self._path(robot, robot.plan, stamp)))
                robot.path_due = now + self.config.republish_s
        return out

    def _map_fresh(self, now: float) -> bool:
        return not self._map.wants_snapshot(now) and self._map.age(now) <= self.config.map_age_s

    def _path(self, robot: _Robot, plan: _Plan, stamp: float) -> RobotPath:
        version = self._map.version
        assert version is not None
        assert robot.goal is not None
        route, goal = plan.route, robot.goal.pose
        released = min(route.length, plan.at + self.config.release) if route else 0.0
        points = [(round(float(x), 4), round(float(y), 4)) for x, y in route.points] if route else []
        return RobotPath(
            plan_id=plan.plan_id,
            planner_epoch=self.epoch,
            goal_id=robot.goal.goal_id,
            points=points,
            map_epoch=version.epoch,
            map_seq=version.seq,
            released_length=released,
            goal_theta=None if robot.any_heading or goal is None else goal.theta,
            refusal=plan.refusal,
            traces=plan.traces,
            stamp=stamp,
        )

    def _replan(self, robot: _Robot, goal: Pose, pose: RobotPose, stamp: float) -> None:
        geometry = self._map.geometry
        assert geometry is not None
        why: Why = robot.dirty or "goal"
        traces = [structs.replace(trace, plan_published=stamp) for trace in robot.traces]
        robot.dirty, robot.traces = None, []
        found = self._find(self._map.cost, (pose.x, pose.y), (goal.x, goal.y))
        self._count(why, found)
        old = robot.plan
        if old is not None and self._is_kept(old, found, why, geometry):
            return
        robot.plan = _Plan(self._next_id, found.route, found.refusal, why, traces, planned_from=(pose.x, pose.y))
        self._next_id += 1

    def _count(self, why: Why, found: _Found) -> None:
        self.plans[why] = self.plans.get(why, 0) + 1
        if found.refusal is not None:
            self.refusals[found.refusal.code] = self.refusals.get(found.refusal.code, 0) + 1

    def _is_kept(self, old: _Plan, found: _Found, why: Why, geometry: GridGeometry) -> bool:
        """Whether the plan in force stays: the same refusal, or a way that nothing beats clearly."""
        if found.refusal is not None:
            return old.refusal == found.refusal
        if old.route is None or why in ("goal", "strayed"):
            return False
        remaining = old.route.cost(self._map.cost, geometry, old.at)
        share = self.config.saving if why == "clearing" else self.config.hysteresis
        return not math.isinf(remaining) and found.cost >= (1.0 - share) * remaining

    # --- Finding a way ----------------------------------------------------------------------------------------------

    def plan(self, request: PlanRequest) -> PlanReply:
        """Answer a question for a way, without side effects."""
        version = self._map.version
        if version is None:
            return PlanReply(refusal=self._refusal(207, "the planner has no map yet; ask again when it is ready"))
        start, goal = request.start, request.goal
        found = self._find(self._map.cost, (start.x, start.y), (goal.x, goal.y))
        return self._reply(found)

    def _reply(self, found: _Found) -> PlanReply:
        version = self._map.version
        assert version is not None
        route = found.route
        return PlanReply(
            points=[(float(x), float(y)) for x, y in route.points] if route else [],
            length=route.length if route else 0.0,
            cost=found.cost if route else 0.0,
            map_epoch=version.epoch,
            map_seq=version.seq,
            refusal=found.refusal,
        )

    def _find(self, cost: Grid, start: PointXY, goal: PointXY) -> _Found:
        geometry, planner = self._map.geometry, self._planner
        assert geometry is not None
        assert planner is not None
        begin, end = geometry.cell(*start), geometry.cell(*goal)
        if not geometry.contains_cell(*begin):
            reason = f"the robot at ({start[0]:.2f}, {start[1]:.2f}) is outside the map {_extent(geometry)}"
            return _Found(None, math.inf, self._refusal(203, reason))
        refusal = self.check_goal(*goal)
        if refusal is not None:
            return _Found(None, math.inf, refusal)
        free = self._free_start(cost, begin)
        if free is None:
            return _Found(None, math.inf, self._start_refusal(begin, start))
        if cost[end[1], end[0]] >= INSCRIBED:
            return _Found(None, math.inf, self._goal_refusal(cost, free, end, goal))
        guided = self._guided.get(end)
        if guided is not None:
            self._guided.move_to_end(end)
        result = (guided or planner).plan(cost, free, end, self.config.max_expansions)
        if result.timed_out:
            reason = f"no way was found within {self.config.max_expansions} steps of the search"
            return _Found(None, math.inf, self._refusal(207, reason))
        if not result.found:
            return _Found(None, math.inf, self._cut_refusal(cost, free, end))
        corners = planner.shortcut(cost, result.cells)
        route = Route(self._metres(cost, corners, start, goal, escaping=free != begin), self.config.spacing,
                      escape=int(free != begin))  # fmt: skip
        return _Found(route, route.cost(cost, geometry), None)

    def _metres(self, cost: Grid, corners: Floats, start: PointXY, goal: PointXY, *, escaping: bool) -> Floats:
        """Corners (columns, rows) as points in metres that begin at the robot and end at the goal exactly.

        Where the line between the exact point and the next corner would touch an impassable cell, the middle of the
        point's cell stays: at most 4 cm away.
        """
        geometry = self._map.geometry
        assert geometry is not None
        origin = np.array((geometry.origin_x, geometry.origin_y))
        cells = corners.astype(np.float64)
        exact = [(np.array(point) - origin) / geometry.resolution - 0.5 for point in (start, goal)]
        if len(cells) == 1:
            cells = np.concatenate((cells, cells))
        if not math.isinf(_line(cost, cells[-2], exact[1])):
            cells[-1] = exact[1]
        if escaping:
            cells = np.concatenate((exact[0][None, :], cells))
        elif not math.isinf(_line(cost, exact[0], cells[1])):
            cells[0] = exact[0]
        points: Floats = (cells + 0.5) * geometry.resolution + origin
        return points

    def _free_start(self, cost: Grid, begin: tuple[int, int]) -> tuple[int, int] | None:
        """Return the start's cell, or the nearest one where a robot may be; None when it is in a hazard, zone or wall.

        The way there may lead over the inscribed band and what lidars saw, never through a wall or a blocked region.
        """
        geometry = self._map.geometry
        assert geometry is not None
        column, row = begin
        if cost[row, column] < INSCRIBED:
            return begin
        blocking = self._blocking_regions()
        if any(region.covers(column, row) for region in blocking):
            return None
        free = nearest_traversable(cost, begin, math.floor(self.config.escape / geometry.resolution))
        if free is None:
            return None
        steps = 2 * max(abs(free[0] - column), abs(free[1] - row))
        for step in range(1, steps + 1):
            x = round(column + (free[0] - column) * step / steps)
            y = round(row + (free[1] - row) * step / steps)
            if self._map.static[y, x] != 0 or any(region.covers(x, y) for region in blocking):
                return None
        return free

    # --- Refusals ---------------------------------------------------------------------------------------------------

    @staticmethod
    def _refusal(code: PlanCode, reason: str, causes: Iterable[Cause] = (), nearest: PointXY | None = None) -> Refusal:
        sentence = f"{PLAN_CODES[code]}: {reason}"
        return Refusal(code=code, reason=sentence[:500], causes=list(causes)[:16], nearest=nearest)

    def _start_refusal(self, begin: tuple[int, int], start: PointXY) -> Refusal:
        inside = [region for region in self._blocking_regions() if region.reaches(*begin)]
        where = f"the robot at ({start[0]:.2f}, {start[1]:.2f}) stands "
        if inside:
            words = "inside or at the edge of " + _listed([region.words for region in inside])
            return self._refusal(205, where + words, [region.cause for region in inside])
        return self._refusal(205, f"{where}where the map has a wall, an obstacle or nothing known")

    def _goal_refusal(self, cost: Grid, free: tuple[int, int], end: tuple[int, int], goal: PointXY) -> Refusal:
        inside = [region for region in self._blocking_regions() if region.reaches(*end)]
        nearest = self._nearest(cost, free, end)
        where = f"the goal ({goal[0]:.2f}, {goal[1]:.2f}) lies "
        if inside:
            words = "inside or at the edge of " + _listed([region.words for region in inside])
            return self._refusal(206, where + words + _nearest(nearest), [region.cause for region in inside], nearest)
        words = "on or beside an obstacle that a robot sees"
        return self._refusal(206, where + words + _nearest(nearest), [_OBSTACLE], nearest)

    def _cut_refusal(self, cost: Grid, free: tuple[int, int], end: tuple[int, int]) -> Refusal:
        planner = self._planner
        assert planner is not None

        def opens(costmap: Grid) -> bool:
            return planner.nearest_reachable(costmap, free, end) == end

        nearest = self._nearest(cost, free, end)
        regions = cutting(cost, self._floor, self._blocking_regions(), opens)
        if regions:
            joint = len(regions) > 1 and not opens(lifted(cost, self._floor, regions[:1], regions[1:]))
            words = ("only together open: " if joint else "") + _listed([region.words for region in regions])
            reason = f"no way is left: it is cut by {words}{_nearest(nearest)}"
            return self._refusal(208, reason, [region.cause for region in regions], nearest)
        if opens(self._floor):
            reason = f"no way is left: obstacles that robots see cut it{_nearest(nearest)}"
            return self._refusal(208, reason, [_OBSTACLE], nearest)
        cause = Cause(kind="map", id="static", state="occupied")
        reason = f"no way leads there: walls or unknown space lie between{_nearest(nearest)}"
        return self._refusal(208, reason, [cause], nearest)

    def _nearest(self, cost: Grid, free: tuple[int, int], end: tuple[int, int]) -> PointXY | None:
        geometry, planner = self._map.geometry, self._planner
        assert geometry is not None
        assert planner is not None
        x, y = geometry.centre(*planner.nearest_reachable(cost, free, end))
        return round(x, 3), round(y, 3)

    # --- The way out ------------------------------------------------------------------------------------------------

    def egress(self, request: EgressRequest) -> PlanReply:
        """Answer a robot inside a blocked area with the cheapest way to where it may be again.

        Inside the areas that reach over the robot the static map's costs count; everything else stays in force.
        """
        geometry = self._map.geometry
        if geometry is None:
            return PlanReply(refusal=self._refusal(207, "the planner has no map yet; ask again when it is ready"))
        cost = self._map.cost
        start = (request.pose.x, request.pose.y)
        begin = geometry.cell(*start)
        if not geometry.contains_cell(*begin):
            reason = f"the robot at ({start[0]:.2f}, {start[1]:.2f}) is outside the map {_extent(geometry)}"
            return self._reply(_Found(None, math.inf, self._refusal(203, reason)))
        blocking = self._blocking_regions()
        over = [region for region in blocking if region.reaches(*begin)]
        free = lifted(cost, self._floor, over, [region for region in blocking if region not in over])
        cells = self._way_out(free, cost, begin)
        if cells is None:
            return self._reply(_Found(None, math.inf, self._start_refusal(begin, start)))
        corners = (np.array(cells, dtype=np.float64) + 0.5) * geometry.resolution
        corners += (geometry.origin_x, geometry.origin_y)
        route = Route(corners, self.config.spacing, escape=len(corners) - 1)
        return self._reply(_Found(route, 0.0, None))

    def _way_out(self, free: Grid, cost: Grid, begin: tuple[int, int]) -> list[tuple[int, int]] | None:
        """Dijkstra over `free` from a cell to the first one that is traversable on `cost` (Dijkstra 1959)."""
        height, width = cost.shape
        done: dict[tuple[int, int], tuple[int, int]] = {}
        queue: list[tuple[float, tuple[int, int], tuple[int, int]]] = [(0.0, begin, begin)]
        while queue and len(done) < self.config.egress_cells:
            spent, cell, came = heapq.heappop(queue)
            if cell in done:
                continue
            done[cell] = came
            x, y = cell
            if cost[y, x] < INSCRIBED:
                way = [cell]
                while way[-1] != begin:
                    way.append(done[way[-1]])
                return way[::-1]
            for dx, dy in _AROUND:
                column, row = x + dx, y + dy
                if not (0 <= column < width and 0 <= row < height) or (column, row) in done:
                    continue
                if max(free[row, column], free[y, column], free[row, x]) >= INSCRIBED:
                    continue
                step = math.hypot(dx, dy) * (50.0 + 0.8 * float(free[row, column]))
                heapq.heappush(queue, (spent + step, (column, row), cell))
        return None


_AROUND: Final = tuple((dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy)
_OBSTACLE: Final = Cause(kind="obstacle", id="lidar", state="seen")


def _line(cost: Grid, a: Floats, b: Floats) -> float:
    return line_cost(cost, float(a[0]), float(a[1]), float(b[0]), float(b[1]))


def _extent(geometry: GridGeometry) -> str:
    left, bottom, right, top = geometry.bounds
    return f"({left:.1f} to {right:.1f}, {bottom:.1f} to {top:.1f})"


def _nearest(point: PointXY | None) -> str:
    return "" if point is None else f"; the nearest point that can be reached is ({point[0]:.2f}, {point[1]:.2f})"


def _listed(words: list[str]) -> str:
    return ", ".join(words[:4]) + (f" and {len(words) - 4} more" if len(words) > 4 else "")
