"""Plans every robot's path on the master costmap, and replans when a change of the map matters.

Pure: inputs are values, time is an argument, no I/O and no background work. This module coordinates the others:

- a map delta (`planning_map`) that affects a path, or could shorten it, requests a replan (`replanner`);
- so do a new goal, a pose off the path and a new snapshot of the map (`missions`);
- `tick` searches a path for every robot that needs one (`replanner`, guided by `heuristics`), the most urgent one
  first (`missions`), keeps the current path unless the new one is clearly better, and publishes
  goals, paths and refusals;
- what may take long is a job for another thread: distance fields, reasons of refusals, answers to queries (`queries`).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.handlers import Fence, Publication
from fog_contracts.replica import MapError
from planner.config import PlannerConfig
from planner.dry_run import State, run
from planner.field_jobs import FieldJob, LandmarkJob
from planner.heuristics import DeadEndsJob, GoalFields
from planner.leases.corridor_leases import CorridorLeases
from planner.missions import Missions
from planner.planning_map import MapTracker, PreparedMap
from planner.queries import Answerer, ExplainJob, View
from planner.refusals import goal_out_of_reach
from planner.regions import BlockedRegions, cover
from planner.replanner import Replanner, effect_of_change, reason_from_pose
from planner.waits.choice import Waits
from planner.waits.pace import Paces, Times

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from typing import Any

    from fog_contracts.handlers import Handler, Ids, Moment, QueryHandler
    from fog_contracts.messages import (
        Arrival,
        DryRunReply,
        DryRunRequest,
        EgressRequest,
        HazardArea,
        MapDelta,
        MapHeartbeat,
        MapSnapshot,
        OutOfService,
        Place,
        PlaceSet,
        PlanReply,
        PlanRequest,
        Refusal,
        RobotGoal,
        RobotPose,
        RobotState,
        ZoneSet,
    )
    from planner.missions import Mission
    from planner.planning_map import CostChange, PlanningMap

    Job = DeadEndsJob | FieldJob | LandmarkJob | ExplainJob


DRIVING: Final = frozenset({"NORMAL", "DEGRADED", "HOLD", "EGRESS", "DOCK"})
"""Modes of a robot that drives its path, or soon will."""
BY_ITSELF: Final = frozenset({"EGRESS", "TELEOP"})
"""Modes of a robot that drives, and not by its path."""


class PlannerCore:
    """Goals, poses and map versions in; paths, refusals and ended goals out."""

    URGENT: Final = frozenset({ch.MAP_DELTA})
    """Channels whose messages call for an immediate `tick`."""

    def __init__(self, epoch: int = 0, config: PlannerConfig | None = None) -> None:
        """Prepare a planner that leads with this epoch, or with 0 stands by."""
        self.epoch = epoch
        self.fence = Fence()
        self._knows_missions = epoch > 0
        """Whether the missions are all that are stored, so that a robot's other goal is none any more."""
        self.config = config or PlannerConfig()
        self._map = MapTracker(
            self.config.inflation,
            grace_s=self.config.delta_grace_s,
            max_age_s=self.config.max_map_age_s,
            standing_s=self.config.standing_s,
            time_in_cost=self.config.time_in_cost,
        )
        self._regions = BlockedRegions()
        self._fields = GoalFields(self.config.goal_fields_bytes, self.config.landmark_bytes)
        self.missions = Missions()
        self.leases = CorridorLeases()
        self.places: Mapping[str, Place] | None = None
        """All places by id, as the map-service has them; None until it has told them."""
        self.waits, self.paces = Waits(self.config), Paces()
        self.replanner = Replanner(self.config, self._fields, self.waits)
        self.answerer = Answerer(self.config)
        """Used by the thread that runs jobs for "query" and answers queries."""
        self._served: set[str] = set()
        """The robots to which `publish` may release paths."""
        self._explaining: ExplainJob | None = None

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        """Return the handler of every channel that the planner subscribes to."""
        return self.fence.guarded(
            {
                ch.MAP_DELTA: self._on_delta,
                ch.MAP_HEARTBEAT: self._on_heartbeat,
                **self._regions.handlers(),
                ch.HAZARD: self._on_hazard,
                ch.ZONES: self._on_zones,
                ch.ROBOT_POSE: self._on_pose,
                ch.ROBOT_STATE: self._on_state,
                ch.PLACES: self._on_places,
            }
        )

    def _on_delta(self, _ids: Ids, delta: MapDelta, at: Moment) -> Sequence[Publication]:
        changes = self._map.on_delta(delta, at.now)
        planning_map = self._map.current
        if planning_map is None:
            return ()
        self._fields.set_bounds(planning_map.lower_bound, planning_map.standing)
        if any(change.any_decreased for change in changes):
            self.replanner.detours.clear()
        self.replanner.detours.revise(planning_map.cost)
        for change in changes:
            for _, mission in self.missions.active():
                self._apply_change(mission, change, planning_map)
        return ()

    def _apply_change(self, mission: Mission, change: CostChange, planning_map: PlanningMap) -> None:
        effect = effect_of_change(mission, change, planning_map, self.config)
        if effect is not None:
            mission.request_replan(effect.reason, change.traces, effect.distance)
        elif mission.plan is not None:
            self.replanner.count_avoided("no_cost_fell" if mission.plan.route is None else "far_from_path")

    def _on_hazard(self, ids: Ids, area: HazardArea, at: Moment) -> Sequence[Publication]:
        self.waits.blocks.on_hazard(area, at)
        return self._regions.on_hazard(ids, area, at)

    def _on_zones(self, ids: Ids, zones: ZoneSet, at: Moment) -> Sequence[Publication]:
        self._regions.handlers()[ch.ZONES](ids, zones, at)
        self.leases.set_places(self._regions.for_one_robot, at.now)
        return ()

    def _on_heartbeat(self, _ids: Ids, heartbeat: MapHeartbeat, at: Moment) -> Sequence[Publication]:
        self._map.on_heartbeat(heartbeat, at.now)
        return ()

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        mission = self.missions.of(ids["robot"])
        if not pose.localized:
            mission.pose = None
            return ()
        mission.pose, mission.pose_received = pose, at.now
        if mission.plan is not None and mission.replan is None:
            mission.replan = reason_from_pose(mission.plan, pose, self.config)
        self._learn_pace(ids["robot"], mission, at.now)
        self.leases.place(ids["robot"], pose.x, pose.y, at.now, pose.radius)
        return ()

    def _learn_pace(self, robot: str, mission: Mission, now: float) -> None:
        plan, planning_map = mission.plan, self._map.current
        if plan is None or plan.route is None or plan.ends_early or planning_map is None:
            self.paces.end(robot)
            return
        if plan.times is None:
            plan.times = Times.of(plan.route, self._map.limits, planning_map.geometry)
        self.paces.on_progress(robot, plan.plan_id, plan.times.at(plan.progress), now, drives=mission.drives)

    def arrival(self, robot: str) -> Arrival | None:
        """Return when a robot arrives, by its pace; None when it has no path, or waits. Any thread may ask."""
        plan, limits = self.missions.plan(robot), self._map.limits_on_grid
        if plan is None or plan.route is None or plan.ends_early or limits is None:
            return None
        times = Times.of(plan.route, *limits)
        return self.paces.arrival(robot, times.rest(plan.progress))

    def _on_state(self, ids: Ids, state: RobotState, at: Moment) -> Sequence[Publication]:
        mission = self.missions.of(ids["robot"])
        mission.on_state(state)
        able, strays = state.mode in DRIVING, mission.plans_itself or state.mode in BY_ITSELF
        plan, received = mission.plan, mission.received
        if plan is not None and plan.route is None and received == (self.epoch, plan.plan_id):
            received = None  # a refusal is no path
        self.leases.on_state(ids["robot"], received, at.now, able=able, strays=strays)
        if state.goal_reached and state.goal_id is not None:
            if mission.goal is not None and mission.goal.goal_id == state.goal_id:
                times = mission.plan.times if mission.plan is not None else None
                self.paces.end(ids["robot"], None if times is None else float(times.seconds[-1]))
            self.missions.reach(ids["robot"], state.goal_id)
        elif state.goal_id is not None and self._knows_missions:
            mission.end_unknown(state.goal_id)
        return ()

    def _on_places(self, _ids: Ids, places: PlaceSet, _at: Moment) -> Sequence[Publication]:
        self.places = places.places
        return ()

    # --- Leading and standing by: one of several planners leads, the others follow all inputs -----------------------

    def lead(self, epoch: int, *, knows_missions: bool) -> None:
        """Continue with this epoch and publish everything again; `knows_missions`: all stored ones are set."""
        self.epoch, self._knows_missions = epoch, knows_missions
        self.missions.publish_all_now()

    def stand_by(self) -> None:
        """Forget all missions, without a message to the robots: another planner leads."""
        self.epoch, self._knows_missions = 0, False
        self.missions.drop()
        self.leases.forget()

    # --- The map ----------------------------------------------------------------------------------------------------

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot is needed: deltas were lost, or there is no map yet."""
        return self._map.wants_snapshot(now)

    def load(self, snapshot: MapSnapshot | PreparedMap, now: float) -> None:
        """Load a snapshot of the map; raises `MapError` and changes nothing when it is damaged or outdated.

        One that `prepare_map` has prepared on another thread is loaded in 2 ms.
        """
        version = snapshot.decoded.version if isinstance(snapshot, PreparedMap) else snapshot
        if not self.fence.reaches(ch.MAP, version.epoch):
            raise MapError(f"the snapshot has epoch {version.epoch}, which no {ch.MAP} can have yet")
        loaded = self._map.load(snapshot, now)
        planning_map = self._map.current
        assert planning_map is not None
        self.fence.raise_to(ch.MAP, planning_map.version.epoch)
        self._fields.set_bounds(planning_map.lower_bound, planning_map.standing)
        self.replanner.detours.clear()
        for _, mission in self.missions.active():
            refused = mission.plan is not None and mission.plan.route is None
            mission.request_replan("epoch" if loaded.restarted else "refused" if refused else "map", loaded.traces)

    def check_goal(self, x: float, y: float) -> Refusal | None:
        """Return why a goal (m, frame `map`) can never be reached: off the map, in a wall or unknown space; else None.

        A goal inside a hazard or zone is accepted, because those end; until then its path is a refusal.
        """
        planning_map = self._map.current
        return None if planning_map is None else goal_out_of_reach(planning_map, (x, y))

    # --- Missions ---------------------------------------------------------------------------------------------------

    def set_goal(self, robot: str, goal: RobotGoal, *, any_heading: bool = False, priority: int = 0) -> None:
        """Give a robot a mission; the same goal again changes nothing. `any_heading`: ignore the goal's theta."""
        self.missions.set_goal(robot, goal, any_heading=any_heading)
        self.missions.of(robot).priority = priority

    def cancel(self, robot: str) -> None:
        """End a robot's mission; the next `tick` publishes that."""
        self.missions.of(robot).end()

    def set_service(self, robot: str, out: OutOfService | None) -> None:
        """Take a robot out of service, or put it back (None); the next `tick` publishes that.

        Whoever sets goals sees to it that it has none meanwhile.
        """
        self.missions.of(robot).set_service(out)
        if out is not None:
            self.leases.take_out(robot)

    # --- Planning and publishing -----------------------------------------------------------------------------------

    def tick(self, at: Moment) -> Sequence[Publication]:
        """Plan and publish. Call it ten times a second, and at once after an urgent message."""
        found = [publication for robot in self.plan(at) for publication in self.publish_for(robot, at)]
        return [*found, *self.publish(at)]

    def plan(self, at: Moment) -> Iterator[str]:
        """Search paths for the robots that need one, most urgent first; yield each robot when its search is done.

        Goals may be set and cancelled between two searches. A caller that stops early leaves the others for the next
        call. While the map or a robot's pose is outdated, nothing is released to the robot: it slows down by itself.
        """
        self._served = set()
        planning_map = self._map.current
        if planning_map is None or not self._map.is_fresh(at.now):
            return
        self._served = self.missions.located(at.now, self.config)
        covers = partial(cover, self._regions.sources)
        due = self.missions.to_replan(at.now, self.config)
        self.waits.look(at, self._regions.sources, self._regions.areas, self._map.limits)
        for number, (robot, mission, reason) in enumerate(due):
            if mission.target is not None and mission.pose is not None:
                waiting = [other for _, other, _ in due[number + 1 :]]
                avoid = self.leases.obstacles(robot, mission.beside)
                self.replanner.replan(mission, reason, planning_map, covers, at.now, waiting, avoid)
                yield robot

    def publish(self, at: Moment) -> Sequence[Publication]:
        """Return the goals, paths and refusals that are due; a goal that was set since `plan` has no path yet."""
        found = [publication for robot, _ in self.missions.items() for publication in self.publish_for(robot, at)]
        self._make_room(at)
        return found

    def publish_for(self, robot: str, at: Moment) -> Sequence[Publication]:
        """Return the goal, the path or refusal, and the release of one robot, as far as they are due."""
        mission, planning_map, ids = self.missions.of(robot), self._map.current, {"robot": robot}
        publications: list[Publication] = []
        if (goal := mission.due_goal(at, self.config, self.epoch)) is not None:
            publications.append(Publication(ch.ROBOT_GOAL, goal, ids))
        plan = mission.plan
        if plan is None or plan.route is None or mission.goal is None:
            self.leases.stop(robot)
        if planning_map is None or robot not in self._served or mission.path_is_outdated:
            return publications
        if plan is not None and plan.route is not None and mission.goal is not None:
            path_id, corners = (self.epoch, plan.plan_id), plan.route.corners
            self.leases.follow(robot, path_id, corners, mission.goal.goal_id, mission.priority)
            self.leases.advance(robot, plan.progress)
            if not plan.published or at.now >= mission.release_due:
                plan.lease = self.leases.release(robot, plan.wanted_length(self.config), at.now)
        if (path := mission.due_path(at, self.config, self.epoch, planning_map.version)) is not None:
            publications.append(Publication(ch.ROBOT_PATH, path, ids))
        if (release := mission.due_release(at, self.config, self.epoch, planning_map.version)) is not None:
            release = structs.replace(release, waits_for=self.leases.waits_for(robot))
            publications.append(Publication(ch.ROBOT_RELEASE, release, ids))
        return publications

    def _make_room(self, at: Moment) -> None:
        """Let robots that would stand face to face for ever make room for one another: one search at most."""
        for robot in self.leases.aside_ended():
            self.missions.of(robot).request_replan("goal", [])
        room, planning_map = self.leases.room_needed(at.now), self._map.current
        if room is None or planning_map is None or room.robot not in self._served:
            return
        mission = self.missions.of(room.robot)
        if mission.replan is not None or mission.target is None or mission.plan is None or mission.plan.waits:
            return
        plan = self.replanner.make_room(mission, room, planning_map, partial(cover, self._regions.sources))
        if plan is None or plan.route is None or not self.leases.standstills.accepts(room, plan.route.corners):
            return
        mission.plan = plan
        if room.kind in ("lane", "past"):
            mission.beside |= room.whom
        self.leases.take(room, (self.epoch, plan.plan_id), plan.route.corners)

    # --- Jobs: run on other threads ---------------------------------------------------------------------------------

    def jobs(self, at: Moment) -> list[Job]:
        """Return new background work, each piece once: run it on any thread, one for each `thread`, then `add` it."""
        self._map.settle(at.now)
        planning_map = self._map.current
        if planning_map is None:
            return []
        self._fields.set_bounds(planning_map.lower_bound, planning_map.standing)
        goals = list(self.missions.goal_cells(planning_map.geometry))
        origins = self.replanner.origins((mission for _, mission in self.missions.active()), planning_map.geometry)
        jobs: list[Job] = [*self.replanner.jobs(len(goals)), *self._fields.jobs(goals, origins)]
        jobs += self._fields.landmark_jobs()
        if self._explaining is None and (explain := self._explain_job(at, planning_map)) is not None:
            self._explaining = explain
            jobs.append(explain)
        return jobs

    def add(self, job: Job, now: float) -> bool:
        """Use the result of a job that has run; return whether it calls for an immediate `tick`."""
        if isinstance(job, DeadEndsJob):
            self.replanner.detours.add(job)
            return False
        if isinstance(job, LandmarkJob):
            self._fields.add_landmark(job)
            return False
        if isinstance(job, FieldJob):
            self._fields.add(job)
            if self._map.current is not None and self._fields.guide(job.goal) is not None:
                self.missions.search_again(job.goal, self._map.current.geometry)
            return False
        self._explaining = None
        plans = {robot: plan for robot, (plan, _) in job.questions.items()}
        return self.missions.explain(plans, job.answers, (job.view.planning_map.version, job.view.revision), now)

    def _explain_job(self, at: Moment, planning_map: PlanningMap) -> ExplainJob | None:
        """Return the job that explains the refusals whose reasons are unknown or may have changed."""
        known = planning_map.version, self._regions.revision
        questions = self.missions.unexplained(known, at.now, self.config)
        view = self.view() if questions else None
        return None if view is None else ExplainJob(view, questions, self.answerer)

    @property
    def fields_bytes(self) -> int:
        """The memory of all distance fields."""
        return self._fields.size

    # --- Queries: answered without side effects ---------------------------------------------------------------------

    def view(self) -> View | None:
        """Return what queries are answered on, by the thread of the `answerer`; None before the first map."""
        planning_map = self._map.copy()
        if planning_map is None:
            return None
        sources = self._regions.sources
        known, covers = self._fields, partial(cover, sources)
        return View(planning_map, sources, self._regions.revision, covers, known.fields, known.landmarks)

    def state(self, now: float) -> State | None:
        """Return what dry runs are computed on, by any thread; None before the first map."""
        view = self.view()
        if view is None:
            return None
        missions = dict(self.missions.items())
        located = {robot: mission for robot, mission in missions.items() if mission.pose is not None}
        avoid = {robot: self.leases.obstacles(robot, mission.beside) for robot, mission in located.items()}
        return State.of(view, self._map.layers(), self._map.limits.copy(), missions, avoid, now)

    def answers(self) -> Mapping[ch.Channel, Callable[[View | None, Any], PlanReply]]:
        """Return what answers each query on a view, to be called on the thread of the `answerer`."""
        return {ch.PLANNER_PLAN: self.answerer.plan, ch.PLANNER_EGRESS: self.answerer.egress}

    def query_handlers(self) -> Mapping[ch.Channel, QueryHandler]:
        """Return the handler of every query that the planner answers, where everything runs on one thread."""
        return {
            ch.PLANNER_PLAN: self._answer_plan,
            ch.PLANNER_EGRESS: self._answer_egress,
            ch.PLANNER_DRY_RUN: self._answer_dry_run,
        }

    def _answer_plan(self, _ids: Ids, request: PlanRequest, _at: Moment) -> PlanReply:
        return self.answerer.plan(self.view(), request)

    def _answer_dry_run(self, _ids: Ids, request: DryRunRequest, at: Moment) -> DryRunReply:
        return run(self.state(at.now), request, self.config)

    def _answer_egress(self, _ids: Ids, request: EgressRequest, _at: Moment) -> PlanReply:
        return self.answerer.egress(self.view(), request)
