"""Plans every robot's path on the master costmap, and replans when a change of the map matters.

Pure: inputs are values, time is an argument, no I/O and no background work. This module coordinates the others:

- a map delta (`planning_map`) that affects a path, or could shorten it, requests a replan (`path_monitor`);
- so do a new goal, a pose off the path and a new snapshot of the map (`mission`);
- `tick` searches a path for every robot that needs one (`path_search`, guided by `goal_fields`), keeps the current path
  unless the new one is clearly better (`replan_policy`), and publishes goals, paths and refusals (`refusals`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication
from fog_contracts.messages import PlanReply
from planner.blocked_regions import BlockedRegions
from planner.config import PlannerConfig
from planner.egress import find_egress
from planner.goal_fields import FieldJob, GoalFields
from planner.mission import Mission, Plan, ReplanReason
from planner.path_monitor import reason_from_change, reason_from_pose
from planner.path_search import PathSearch, SearchResult
from planner.planning_map import MapTracker
from planner.refusals import goal_out_of_reach, no_map
from planner.replan_policy import is_kept

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Handler, Ids, Moment, QueryHandler
    from fog_contracts.messages import (
        EgressRequest,
        MapDelta,
        MapHeartbeat,
        MapSnapshot,
        PlanCode,
        PlanRequest,
        PointXY,
        Pose,
        Refusal,
        RobotGoal,
        RobotPose,
        RobotState,
    )
    from planner.planning_map import Cell, PlanningMap


class PlannerCore:
    """Goals, poses and map versions in; paths, refusals and ended goals out."""

    URGENT: Final = frozenset({ch.MAP_DELTA})
    """Channels whose messages call for an immediate `tick`."""

    def __init__(self, epoch: int, config: PlannerConfig | None = None) -> None:
        self.epoch = epoch
        self.config = config or PlannerConfig()
        self._map = MapTracker(
            self.config.inflation, grace_s=self.config.delta_grace_s, max_age_s=self.config.max_map_age_s
        )
        self._regions = BlockedRegions(self.config.inflation.inflation_radius)
        self._fields = GoalFields(self.config.max_goal_fields)
        self._search: tuple[GridGeometry, PathSearch] | None = None
        self._missions: dict[str, Mission] = {}
        self._served: set[str] = set()
        """The robots to which `publish` may release paths."""
        self._reached: list[tuple[str, str]] = []
        self._next_id = 1
        self.plans: dict[ReplanReason, int] = {}
        """Number of path searches, by reason."""
        self.refusals: dict[PlanCode, int] = {}
        """Number of path searches that ended in a refusal, by code."""

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handler of every channel that the planner subscribes to."""
        return {
            ch.MAP_DELTA: self._on_delta,
            ch.MAP_HEARTBEAT: self._on_heartbeat,
            **self._regions.handlers(),
            ch.ROBOT_POSE: self._on_pose,
            ch.ROBOT_STATE: self._on_state,
        }

    def _on_delta(self, _ids: Ids, delta: MapDelta, at: Moment) -> Sequence[Publication]:
        changes = self._map.on_delta(delta, at.now)
        planning_map = self._map.current
        if planning_map is None:
            return ()
        self._fields.set_lower_bound(planning_map.lower_bound)
        for change in changes:
            for mission in self._missions.values():
                reason = reason_from_change(mission, change, planning_map, self.config)
                if reason is not None:
                    mission.request_replan(reason, change.traces)
        return ()

    def _on_heartbeat(self, _ids: Ids, heartbeat: MapHeartbeat, at: Moment) -> Sequence[Publication]:
        self._map.on_heartbeat(heartbeat, at.now)
        return ()

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        mission = self._mission(ids["robot"])
        if not pose.localized:
            mission.pose = None
            return ()
        mission.pose, mission.pose_received = pose, at.now
        if mission.plan is not None and mission.replan is None:
            mission.replan = reason_from_pose(mission.plan, pose, self.config)
        return ()

    def _on_state(self, ids: Ids, state: RobotState, _at: Moment) -> Sequence[Publication]:
        robot = ids["robot"]
        goal = self.goal(robot)
        if goal is not None and state.goal_reached and state.goal_id == goal.goal_id:
            self.cancel(robot)
            self._reached.append((robot, goal.goal_id))
        return ()

    # --- The map ----------------------------------------------------------------------------------------------------

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot is needed: deltas were lost, or there is no map yet."""
        return self._map.wants_snapshot(now)

    def load(self, snapshot: MapSnapshot, now: float) -> None:
        """Load a snapshot of the map; raises `MapError` and changes nothing when it is damaged or outdated."""
        loaded = self._map.load(snapshot, now)
        planning_map = self._map.current
        assert planning_map is not None
        self._fields.set_lower_bound(planning_map.lower_bound)
        for mission in self._missions.values():
            if mission.target is not None:
                reason: ReplanReason = "epoch" if loaded.restarted else "map"
                mission.replan = mission.replan or reason
                mission.traces += loaded.traces

    # --- Missions ---------------------------------------------------------------------------------------------------

    def check_goal(self, x: float, y: float) -> Refusal | None:
        """Return why a goal (m, frame `map`) can never be reached: off the map, in a wall or unknown space; else None.

        A goal inside a hazard or zone is accepted, because those end; until then its path is a refusal.
        """
        planning_map = self._map.current
        return None if planning_map is None else goal_out_of_reach(planning_map, (x, y))

    def set_goal(self, robot: str, goal: RobotGoal, *, any_heading: bool = False) -> None:
        """Give a robot a mission; the same goal again changes nothing. `any_heading`: ignore the goal's theta."""
        if goal.pose is None:
            self.cancel(robot)
        else:
            self._mission(robot).begin(goal, any_heading=any_heading)

    def cancel(self, robot: str) -> None:
        """End a robot's mission; the next `tick` publishes that."""
        self._mission(robot).end()

    def goal(self, robot: str) -> RobotGoal | None:
        """Return the robot's mission, if it has one."""
        mission = self._missions.get(robot)
        return mission.goal if mission and mission.target else None

    def pop_reached(self) -> list[tuple[str, str]]:
        """Return (robot, goal id) of the goals that were reached since the last call."""
        reached, self._reached = self._reached, []
        return reached

    def _mission(self, robot: str) -> Mission:
        return self._missions.setdefault(robot, Mission())

    # --- Planning and publishing -----------------------------------------------------------------------------------

    def tick(self, at: Moment) -> Sequence[Publication]:
        """Run `plan`, then `publish`. Call it ten times a second, and at once after an urgent message."""
        self.plan(at)
        return self.publish(at)

    def plan(self, at: Moment) -> None:
        """Search paths for the robots that need one; goals may be set and cancelled between this and `publish`.

        While the map or a robot's pose is outdated, nothing is released to the robot: it slows down by itself.
        """
        self._served = set()
        planning_map = self._map.current
        if planning_map is None or not self._map.is_fresh(at.now):
            return
        for robot, mission in self._missions.items():
            pose, target = mission.pose, mission.target
            if target is None or pose is None or at.now - mission.pose_received > self.config.max_pose_age_s:
                continue
            if mission.replan is not None or mission.plan is None:
                self._replan(mission, target, pose, planning_map)
            self._served.add(robot)

    def publish(self, at: Moment) -> Sequence[Publication]:
        """Return the goals, paths and refusals that are due; a goal that was set since `plan` has no path yet."""
        publications: list[Publication] = []
        planning_map = self._map.current
        for robot, mission in self._missions.items():
            ids = {"robot": robot}
            if (goal := mission.due_goal(at, self.config)) is not None:
                publications.append(Publication(ch.ROBOT_GOAL, goal, ids))
            if planning_map is None or robot not in self._served:
                continue
            if (path := mission.due_path(at, self.config, self.epoch, planning_map.version)) is not None:
                publications.append(Publication(ch.ROBOT_PATH, path, ids))
        return publications

    def _replan(self, mission: Mission, target: Pose, pose: RobotPose, planning_map: PlanningMap) -> None:
        reason, traces = mission.replan or "goal", mission.traces
        mission.replan, mission.traces = None, []
        mission.publish_path_now()
        found = self._find(planning_map, (pose.x, pose.y), (target.x, target.y))
        self.plans[reason] = self.plans.get(reason, 0) + 1
        if found.refusal is not None:
            self.refusals[found.refusal.code] = self.refusals.get(found.refusal.code, 0) + 1
        if mission.plan is not None and is_kept(mission.plan, found, reason, planning_map, self.config):
            return
        mission.plan = Plan(self._next_id, found.route, found.refusal, traces, planned_from=(pose.x, pose.y))
        self._next_id += 1

    def _find(self, planning_map: PlanningMap, start: PointXY, goal: PointXY) -> SearchResult:
        if self._search is None or self._search[0] != planning_map.geometry:
            self._search = planning_map.geometry, PathSearch(self.config, planning_map.geometry, self._fields)
        return self._search[1].find(planning_map, self._regions.blocking(planning_map), start, goal)

    # --- Distance fields: computed on other threads -----------------------------------------------------------------

    def field_jobs(self) -> list[FieldJob]:
        """Return the distance fields to compute, each once: run them on any thread, then pass them to `add_field`."""
        planning_map = self._map.current
        return [] if planning_map is None else self._fields.jobs(self._goal_cells(planning_map.geometry))

    def add_field(self, job: FieldJob) -> None:
        """Use a computed field from now on; one over an outdated lower bound is dropped."""
        self._fields.add(job)

    def _goal_cells(self, geometry: GridGeometry) -> Iterator[Cell]:
        for mission in self._missions.values():
            if mission.target is not None:
                cell = geometry.cell(mission.target.x, mission.target.y)
                if geometry.contains_cell(*cell):
                    yield cell

    # --- Queries: answered without side effects ---------------------------------------------------------------------

    def query_handlers(self) -> Mapping[ch.Channel, QueryHandler]:
        """Return the handler of every query that the planner answers."""
        return {ch.PLANNER_PLAN: self._answer_plan, ch.PLANNER_EGRESS: self._answer_egress}

    def _answer_plan(self, _ids: Ids, request: PlanRequest, _at: Moment) -> PlanReply:
        planning_map = self._map.current
        if planning_map is None:
            return PlanReply(refusal=no_map())
        start, goal = request.start, request.goal
        return _reply(self._find(planning_map, (start.x, start.y), (goal.x, goal.y)), planning_map)

    def _answer_egress(self, _ids: Ids, request: EgressRequest, _at: Moment) -> PlanReply:
        planning_map = self._map.current
        if planning_map is None:
            return PlanReply(refusal=no_map())
        blocking = self._regions.blocking(planning_map)
        start = (request.pose.x, request.pose.y)
        return _reply(find_egress(planning_map, blocking, start, self.config), planning_map)


def _reply(found: SearchResult, planning_map: PlanningMap) -> PlanReply:
    route = found.route
    return PlanReply(
        points=[(float(x), float(y)) for x, y in route.points] if route else [],
        length=route.length if route else 0.0,
        cost=found.cost if route else 0.0,
        map_epoch=planning_map.version.epoch,
        map_seq=planning_map.version.seq,
        refusal=found.refusal,
    )
