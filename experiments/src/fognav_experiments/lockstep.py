"""One drive with every real core in one process, on an emulated clock: faster than real time, repeatable by its seed.

Real are aggregator, map-service, planner, agent and guardian, every message as the bytes of its channel, and base and
lidar as bytes at their lines' rate through the robot's own parsers. Left out are brokers, sockets, threads, and the
time that computation and networks take (`stages_ms` therefore contains waiting times only).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.geometry import distance_to_polygon
from fog_contracts.messages import PlanRequest, RobotGoal, SimObstacle
from fog_contracts.stages import SPANS, durations_ms
from fog_runtime.site import LoadedSite, load_site
from fognav_experiments.rigs import STAMP, TICK_STEPS, FogRig, System, moment
from fognav_sim.devices import DEFAULT_BASE, DEFAULT_LIDAR
from fognav_sim.drive.evaluation import DriveEvaluation, DriveOutcome, OutcomeKind
from fognav_sim.drive.hazard import draw_hazard, draw_trigger
from fognav_sim.drive.operator import OperatorPolicy
from fognav_sim.hardware import STEP_S
from fognav_sim.scenario import Event, Scenario, ScenarioError, barrier_across
from fognav_sim.world import Noise, World

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Ids, Moment, Publication
    from fog_contracts.messages import AreaState, HazardArea, Pose, RobotPath, RobotPose, RobotState, Trace
    from fog_contracts.site import AreaSite, Place

WARM_UP_S: Final = 12.0
"""Time within which all areas must be known, the robot localized and enabled."""
TRACK_M: Final = 0.25
"""Spacing of the recorded track."""
OPERATOR_STEPS: Final = 50
"""Steps of 10 ms between two decisions of the operator."""
_CLEAR_STEPS: Final = 200
"""Steps of 10 ms after which all areas are known to be clear."""
TRUTH_STEPS: Final = 10
"""Steps of 10 ms between two evaluations, the period of the simulator's ground truth."""


class DriveEvent(msgspec.Struct, frozen=True, kw_only=True):
    """An event of a drive, with the time (s) and the distance driven (m) since the goal was given."""

    time_s: float
    distance_m: float
    description: str


class LockstepResult(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a drive, by the simulator's ground truth; lengths in m, times in s of the emulated clock.

    `operator_commands` counts the accepted commands, the first enable included. `crossed` lists the areas that the
    robot really entered, `hazard_clearance_m` is the smallest distance from its rim to the barrier, `stages_ms` the
    durations of the hazard's stages, `track` the true positions every 0.25 m.
    """

    outcome: OutcomeKind
    reason: str
    seed: int
    distance_m: float
    time_s: float
    min_clearance_m: float
    contacts: int
    planned_m: float
    replans: int
    hazard_area: str | None
    hazard_at_m: float | None
    hazard_clearance_m: float | None
    crossed: list[str]
    stages_ms: dict[str, float]
    pose_error_m: float
    operator_commands: int
    events: list[DriveEvent]
    track: list[tuple[float, float]]


class _Drive:
    """One drive: system, scenario and the records of it."""

    def __init__(  # noqa: PLR0913  # the parts of a drive
        self,
        site: LoadedSite,
        start: Pose,
        goal: RobotGoal,
        seed: int,
        noise: Noise | None,
        *,
        base: str = DEFAULT_BASE,
        lidar: str = DEFAULT_LIDAR,
    ) -> None:
        robot = msgspec.structs.replace(site.site.robots[0], start=start)
        self.site, self.goal, self.seed = site, goal, seed
        self.system = System(site, robot, seed, noise=noise, base=base, lidar=lidar)
        self.world = self.system.world
        self.robot = self.system.robot
        self.scenario = Scenario((), start=0.0)
        self.events: list[DriveEvent] = []
        self.track: list[tuple[float, float]] = []
        self.planned_m = 0.0
        self.path: RobotPath | None = None
        self.pose: RobotPose | None = None
        self.state: RobotState | None = None
        self.hazards: dict[str, AreaState] = {}
        self.barrier: SimObstacle | None = None
        self.barrier_since: float | None = None
        self.hazard_clearance = math.inf
        self.pose_error = 0.0
        self.traces: list[Trace] = []
        self.commands = 0
        self.started_at = 0.0
        self.start_distance_m = 0.0
        self.operator = OperatorPolicy(self.now)
        self.evaluation: DriveEvaluation | None = None
        self._steps = 0
        self._mode = ""
        self._crossed = 0
        self.system.bus.subscribe(
            {
                ch.HAZARD: self._on_hazard,
                ch.ROBOT_PATH: self._on_path,
                ch.ROBOT_POSE: self._on_pose,
                ch.ROBOT_STATE: self._on_state,
            }
        )

    @property
    def now(self) -> float:
        """The emulated time, s."""
        return self.robot.now

    @property
    def driven(self) -> float:
        """Distance driven since the goal was given, m."""
        return self.world.distance - self.start_distance_m

    def log_event(self, description: str) -> None:
        """Record an event."""
        time_s, distance_m = round(self.now - self.started_at, 2), round(self.driven, 2)
        self.events.append(DriveEvent(time_s=time_s, distance_m=distance_m, description=description))

    def step(self) -> None:
        """Simulate 10 ms."""
        self._steps += 1
        for occurrence in self.scenario.step(self.world, self.now):
            self.barrier_since = self.now
            self.log_event(occurrence.name)
        self.system.step()
        if refused := self.system.bus.refused:
            raise RuntimeError(f"the system refused messages of its own: {'; '.join(refused)}")
        self.traces += self.robot.agent.finished_traces()
        self._record()

    def _on_hazard(self, ids: Ids, message: HazardArea, at: Moment) -> Sequence[Publication]:
        del at
        area, hazard = ids["area"], message.hazard
        if self.hazards.get(area) != hazard.state:
            self.hazards[area] = hazard.state
            self.log_event(f"area {area}: {hazard.state} ({hazard.cause})")
        return ()

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        del ids, at
        self.pose = pose
        return ()

    def _on_state(self, ids: Ids, state: RobotState, at: Moment) -> Sequence[Publication]:
        del ids, at
        self.state = state
        return ()

    def _on_path(self, ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        del ids
        known, self.path = self.path, path
        if self.evaluation is not None:
            self.evaluation.on_path(path, at.now)
        if known is None or known.plan_id != path.plan_id:
            self._on_plan(path)
        return ()

    def _on_plan(self, path: RobotPath) -> None:
        if path.refusal is not None:
            self.log_event(f"no path: {path.refusal.reason}")
            return
        length = sum(math.dist(a, b) for a, b in zip(path.points, path.points[1:], strict=False))
        self.planned_m = self.planned_m or length
        self.log_event(f"plan {path.plan_id}: {length:.1f} m")

    def _record(self) -> None:
        x, y, _ = self.world.pose
        if not self.track or math.dist(self.track[-1], (x, y)) >= TRACK_M:
            self.track.append((round(float(x), 3), round(float(y), 3)))
            pose = self.pose
            if pose is not None and pose.localized:
                self.pose_error = max(self.pose_error, math.hypot(pose.x - x, pose.y - y))
        if self.barrier is not None and self.barrier_since is not None:
            gap = distance_to_polygon(self.barrier.polygon, x, y) - self.world.robot.radius
            self.hazard_clearance = min(self.hazard_clearance, gap)
        state = self.state
        if state is not None:
            self.operator.on_state(state, self.now)
            if state.mode != self._mode:
                self._mode = state.mode
                self.log_event(f"robot: {state.mode} ({'; '.join(state.reasons[:2])})")
        if self._steps % OPERATOR_STEPS == 0:
            self._operate()
        if self.evaluation is not None and self._steps % TRUTH_STEPS == 0:
            self._evaluate(self.evaluation)

    def _operate(self) -> None:
        command = self.operator.command_due(self.now)
        if command is not None and self.robot.command(command).accepted:
            self.commands += 1
            self.log_event(f"operator: {command}")

    def _evaluate(self, evaluation: DriveEvaluation) -> None:
        evaluation.on_truth(self.world.truth(STAMP + self.now))
        if self.state is not None:
            evaluation.on_state(self.state, self.now)
        for area in evaluation.route_areas[self._crossed :]:
            self.log_event(f"enters {area}")
        self._crossed = len(evaluation.route_areas)

    def start(self, timeout_s: float) -> None:
        """Start the drive to the goal."""
        assert self.goal.pose is not None
        self.started_at, self.start_distance_m = self.now, self.world.distance
        self.evaluation = DriveEvaluation(
            goal=(self.goal.pose.x, self.goal.pose.y),
            goal_id=self.goal.goal_id,
            areas=self.site.site.areas,
            started_at=self.now,
            timeout_s=timeout_s,
        )
        self._evaluate(self.evaluation)

    def warm_up(self) -> str | None:
        """Run until the robot is ready to drive; return None, or the reason if it does not become ready."""
        until = self.now + WARM_UP_S
        while self.now < until:
            self.step()
            state = self.state
            areas_known = "unknown" not in self.hazards.values()
            if state is not None and state.mode == "NORMAL" and areas_known:
                return None
        unknown = [area for area, state in self.hazards.items() if state == "unknown"]
        reasons = self.state.reasons if self.state else []
        return f"not ready after {WARM_UP_S:.0f} s: {'; '.join(reasons)}; unknown areas: {unknown}"

    def result(self, outcome: DriveOutcome, area: str | None) -> LockstepResult:
        """Return the result of the drive."""
        evaluation = self.evaluation
        hazard_event = next((event for event in self.events if event.description.startswith("barrier appears")), None)
        return LockstepResult(
            outcome=outcome.kind,
            reason=outcome.reason,
            seed=self.seed,
            distance_m=round(self.driven, 3),
            time_s=round(self.now - self.started_at, 2),
            min_clearance_m=round(self.world.truth(0.0).min_clearance, 3),
            contacts=self.world.contacts,
            planned_m=round(self.planned_m, 2),
            replans=max(0, evaluation.plans - 1) if evaluation is not None else 0,
            hazard_area=area,
            hazard_at_m=hazard_event.distance_m if hazard_event else None,
            hazard_clearance_m=round(self.hazard_clearance, 3) if hazard_event else None,
            crossed=list(dict.fromkeys(evaluation.route_areas)) if evaluation is not None else [],
            stages_ms=durations_ms(next((t for t in self.traces if t.area == area), None), SPANS),
            pose_error_m=round(self.pose_error, 3),
            operator_commands=self.commands,
            events=self.events,
            track=self.track,
        )


def run_lockstep(  # noqa: PLR0913  # the options of a run
    site: LoadedSite,
    start: Pose,
    goal: Place,
    seed: int,
    hazard_area: str | None = None,
    *,
    hazard_at_m: float | None = None,
    timeout_s: float = 900.0,
    noise: Noise | None = None,
    watched: bool = True,
    base: str = DEFAULT_BASE,
    lidar: str = DEFAULT_LIDAR,
) -> LockstepResult:
    """Drive the site's first robot from `start` to `goal`; the result is the same for the same arguments.

    With `hazard_area` a barrier appears in that area after `hazard_at_m` metres (default: drawn from 3 to 8 by the
    seed), never within 3 m of the robot. Without `watched` the site has neither areas nor nodes: the robot's own lidar
    must find the barrier. `base` and `lidar` name the robot's hardware. Raises `ScenarioError` for an unknown area or
    one that no barrier can close, `ValueError` for a start inside an obstacle.
    """
    pose = msgspec.convert(
        {"x": goal.x, "y": goal.y, "theta": goal.theta if goal.theta is not None else 0.0}, type(start)
    )
    mission = RobotGoal(goal_id="lockstep-1", pose=pose)
    unwatched = msgspec.structs.replace(site.site, areas=[], nodes=[])
    drive = _Drive(
        site if watched else dataclasses.replace(site, site=unwatched),
        start,
        mission,
        seed,
        noise,
        base=base,
        lidar=lidar,
    )
    barrier = None
    if hazard_area is not None:
        barrier = barrier_across(_area(site, hazard_area), site.site, site.map, seed)
    problem = drive.warm_up()
    drive.start(timeout_s)
    if problem is not None:
        return drive.result(DriveOutcome("stopped", problem), hazard_area)
    if barrier is not None:
        drive.barrier = barrier
        trigger_m = hazard_at_m if hazard_at_m is not None else draw_trigger(seed)
        event = Event(name=f"barrier appears in {hazard_area}", place=(barrier,), at_distance=trigger_m)
        drive.scenario = Scenario([event], start=drive.now, distance=drive.world.distance)
    drive.system.fog.planner.set_goal(drive.robot.id, mission, any_heading=goal.theta is None)
    evaluation = drive.evaluation
    assert evaluation is not None
    while (outcome := evaluation.outcome(drive.now)) is None:
        drive.step()
    return drive.result(outcome, hazard_area)


def _area(site: LoadedSite, area_id: str) -> AreaSite:
    for area in site.site.areas:
        if area.id == area_id:
            return area
    raise ScenarioError(f"the site has no area {area_id!r}; it has: {', '.join(a.id for a in site.site.areas)}")


def _free_path(site: LoadedSite, start: Pose, goal: Place, seed: int) -> list[tuple[float, float]]:
    """Return the path on the empty floor, without driving it."""
    mission = RobotGoal(goal_id="preview", pose=msgspec.structs.replace(start, x=goal.x, y=goal.y))
    robot = msgspec.structs.replace(site.site.robots[0], start=start)
    fog = FogRig(site, World(site.map.geometry, site.map.cells, robot, seed), Bus(site.site.id), seed, start=0.0)
    now = 0.0
    for step in range(_CLEAR_STEPS):
        now = (step + 1) * STEP_S
        fog.measure(now)
        fog.deliver(moment(now))
        if step % TICK_STEPS == 0:
            fog.tick(moment(now))
    assert mission.pose is not None
    reply = fog.preview(PlanRequest(start=start, goal=mission.pose), now)
    if reply.refusal is not None:
        raise ScenarioError(f"there is no path even without a hazard: {reply.refusal.reason}")
    return list(reply.points)


def main() -> None:
    """Run one drive from the command line and print its result as JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m fognav_experiments.lockstep",
        description=__doc__,
        epilog="example: python -m fognav_experiments.lockstep --site sites/estig --seed 1",
    )
    parser.add_argument("--site", type=Path, required=True, help="folder of the site")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", help="place to start from (default: the demo's)")
    parser.add_argument("--goal", help="place to drive to (default: the demo's)")
    parser.add_argument("--area", help="area that becomes blocked (default: one of the demo's on the path)")
    parser.add_argument("--no-hazard", action="store_true")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds of the emulated clock")
    parser.add_argument("--track", action="store_true", help="include the true track in the result")
    arguments = parser.parse_args()
    site = load_site(arguments.site)
    demo = site.site.demo
    names = arguments.start or (demo and demo.start), arguments.goal or (demo and demo.goal)
    for name in names:
        if name not in site.site.places:
            parser.error(f"no place {name!r}; the site has: {', '.join(site.site.places)}")
    origin, goal = (site.site.places[str(name)] for name in names)
    robot = site.site.robots[0].start
    start = msgspec.structs.replace(
        robot, x=origin.x, y=origin.y, theta=origin.theta if origin.theta is not None else robot.theta
    )
    area, trigger_m = arguments.area, None
    try:
        if arguments.no_hazard:
            area = None
        elif area is None:
            hazard = draw_hazard(
                site.site,
                _free_path(site, start, goal, arguments.seed),
                arguments.seed,
                lambda blocked: barrier_across(blocked, site.site, site.map, arguments.seed),
            )
            area, trigger_m = hazard.area.id, hazard.trigger_m
        result = run_lockstep(
            site, start, goal, arguments.seed, area, hazard_at_m=trigger_m, timeout_s=arguments.timeout
        )
    except ScenarioError as error:
        parser.error(str(error))
    printed = msgspec.to_builtins(result)
    if not arguments.track:
        del printed["track"]
    sys.stdout.write(json.dumps(printed, indent=2) + "\n")
    raise SystemExit(0 if result.outcome == "reached" else 1)


if __name__ == "__main__":
    main()
