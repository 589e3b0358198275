"""One drive with every real core in one process, on an emulated clock: faster than real time, repeatable by its seed.

Real are aggregator, map-service, planner, agent and guardian, every message as the bytes of its channel, and base and
lidar as bytes at their lines' rate through the robot's own parsers. Left out are brokers, sockets, threads, and the
time that computation and networks take (`stages_ms` therefore contains waiting times only).
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts import channels as ch
from fog_contracts.commands import PROFILE_OF
from fog_contracts.geometry import distance_to_polygon
from fog_contracts.handlers import Publication
from fog_contracts.messages import RobotGoal
from fog_contracts.site import Site
from fog_contracts.stages import SPANS, durations_ms
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.configuration.robot_file import default_robot
from fog_runtime.configuration.site import load_site
from fognav_experiments.processes import Measure, unmeasured
from fognav_experiments.rigs import AGENT, STAMP, System
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.drive import Drive, DriveOutcome, DriveSummary
from fognav_sim.drive.hazard import HazardRequest, HazardSchedule
from fognav_sim.drive.operator import OperatorPolicy

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.bus import Bus
    from fog_contracts.handlers import Ids, Moment
    from fog_contracts.messages import (
        AreaState,
        CommandKind,
        HazardArea,
        Place,
        Pose,
        ProfileName,
        RobotPath,
        RobotPose,
        RobotState,
        SimObstacle,
        SimTruth,
        Trace,
    )
    from fog_runtime.configuration.robot_file import RobotFile
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.machine import CpuMeter
    from fognav_experiments.rigs import Tuning
    from fognav_sim.floor import Floor
    from fognav_sim.sensors import Noise
    from robot_agent.agent.core import AgentCore
    from robot_agent.config import AgentConfig

WARM_UP_S: Final = 30.0
"""Time within which all areas must be known, the robot localized and enabled."""
TRACK_M: Final = 0.25
"""Spacing of the recorded track."""
OPERATOR_STEPS: Final = 50
"""Steps of 10 ms between two decisions of the operator."""
TRUTH_STEPS: Final = 10
"""Steps of 10 ms between two evaluations, the period of the simulator's ground truth."""


class DriveEvent(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """An event of a drive, with the time (s) and the distance driven (m) since the goal was given.

    `codes` identify the reasons of a mode that the robot enters.
    """

    time_s: float
    distance_m: float
    description: str
    codes: list[str] = []


class LockstepResult(DriveSummary, frozen=True, kw_only=True):
    """The result of a drive, by the simulator's ground truth; lengths in m, times in s of the emulated clock.

    `operator_commands` counts the accepted commands, the first enable included. `hazard_at_m` is the distance driven
    when the barrier was placed, `barrier_distance_m` the smallest one between it and the robot's rim. `received_bytes`
    is what the robot received from the fog and its profile uses, since the goal was given. `stages_ms` holds the
    durations of the hazard's stages, `track` the true positions every 0.25 m.
    """

    seed: int
    contacts: int
    planned_m: float
    hazard_at_m: float | None
    stages_ms: dict[str, float]
    pose_error_m: float
    operator_commands: int
    profile: ProfileName
    barrier_distance_m: float | None
    received_bytes: int
    events: list[DriveEvent]
    track: list[tuple[float, float]]


class LockstepDrive:
    """One drive: system, scenario and the records of it."""

    def __init__(  # noqa: PLR0913  # the parts of a drive
        self,
        site: LoadedSite,
        start: Pose,
        goal: RobotGoal,
        seed: int,
        noise: Noise | None,
        *,
        watched: bool | Site,
        hazard: HazardSchedule | None,
        bus: Bus | None,
        mounted: RobotFile | None = None,
        measure: Measure = unmeasured,
        tuning: Tuning | None = None,
        ground: Floor | None = None,
        make_agent: Callable[[AgentConfig, int], AgentCore] = AGENT,
    ) -> None:
        """`watched`: whether the site has areas and nodes, or what it has instead. `ground`: if it is not the map's."""
        robot = msgspec.structs.replace(site.site.robots[0], start=start)
        self.site, self.goal, self.seed, self.hazard = site, goal, seed, hazard
        bare = msgspec.structs.replace(site.site, areas=[], nodes=[])
        with_nodes = watched if isinstance(watched, Site) else site.site if watched else bare
        floor = dataclasses.replace(site, site=with_nodes)
        self.system = System(
            floor, robot, seed, noise=noise, mounted=mounted, bus=bus, measure=measure, tuning=tuning,
            floor=ground, make_agent=make_agent,
        )  # fmt: skip
        self.world = self.system.world
        self.robot = self.system.robot
        self.events: list[DriveEvent] = []
        self.track: list[tuple[float, float]] = []
        self.barrier: SimObstacle | None = None
        self.barrier_distance_m = math.inf
        self.planned_m = 0.0
        self.path: RobotPath | None = None
        self.pose: RobotPose | None = None
        self.state: RobotState | None = None
        self.hazards: dict[str, AreaState] = {}
        self.pose_error = 0.0
        self.traces: list[Trace] = []
        self.commands = 0
        self.started_at = 0.0
        self.start_distance_m = 0.0
        self.received_before = 0
        self.operator = OperatorPolicy(self.now)
        self.drive: Drive | None = None
        self.problem: str | None = None
        self._steps = 0
        self._mode = ""
        self._crossed = 0
        self.system.bus.subscribe(
            {
                ch.HAZARD: self._on_hazard,
                ch.ROBOT_PATH: self._on_path,
                ch.ROBOT_POSE: self._on_pose,
                ch.ROBOT_STATE: self._on_state,
                ch.SIM_TRUTH: self._on_truth,
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

    def log_event(self, description: str, codes: Sequence[str] = ()) -> None:
        """Record an event, and the identifiers of the reasons of a mode."""
        time_s, distance_m = round(self.now - self.started_at, 2), round(self.driven, 2)
        event = DriveEvent(time_s=time_s, distance_m=distance_m, description=description, codes=[*codes])
        self.events.append(event)

    def step(self) -> None:
        """Simulate 10 ms."""
        self._steps += 1
        truth_due = self._steps % TRUTH_STEPS == 0
        self.system.step([self._truth()] if truth_due else [])
        if refused := self.system.bus.refused:
            raise RuntimeError(f"the system refused messages of its own: {'; '.join(refused)}")
        self.traces += self.robot.agent.finished_traces()
        self._record()
        if truth_due and self.drive is not None:
            self._place_barrier_if_due(self.drive)

    def _truth(self) -> Publication:
        return Publication(ch.SIM_TRUTH, self.world.truth(STAMP + self.now), {"robot": self.robot.id})

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
        del ids
        self.state = state
        if self.drive is not None:
            self.drive.on_state(state, at.now)
        return ()

    def _on_truth(self, ids: Ids, truth: SimTruth, at: Moment) -> Sequence[Publication]:
        del ids, at
        if self.drive is not None:
            self.drive.on_truth(truth)
            entered = self.drive.evaluation.route_areas
            for area in entered[self._crossed :]:
                self.log_event(f"enters {area}")
            self._crossed = len(entered)
        if self.barrier is not None:
            distance = distance_to_polygon(self.barrier.polygon, truth.x, truth.y) - self.world.robot.radius
            self.barrier_distance_m = min(self.barrier_distance_m, distance)
        return ()

    def _on_path(self, ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        del ids
        known, self.path = self.path, path
        if self.drive is not None:
            self.drive.on_path(path, at.now)
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
        state = self.state
        if state is not None:
            self.operator.on_state(state, self.now)
            if state.mode != self._mode:
                self._mode = state.mode
                self.log_event(f"robot: {state.mode} ({'; '.join(state.reasons[:2])})", state.codes[:2])
        if self._steps % OPERATOR_STEPS == 0:
            self._operate()

    def _operate(self) -> None:
        command = self.operator.command_due(self.now)
        if command is not None and self.robot.command(command).accepted:
            self.commands += 1
            self.log_event(f"operator: {command}")

    def _place_barrier_if_due(self, drive: Drive) -> None:
        if (due := drive.hazard_due()) is not None:
            self.world.place(due.barrier)
            self.barrier = due.barrier
            drive.on_barrier_placed(due)
            self.log_event(f"barrier appears in {due.area.id}")

    def switch(self, profile: ProfileName) -> str | None:
        """Let the robot navigate by another profile; return None, or why it does not become ready."""
        commands: dict[ProfileName, CommandKind] = {name: kind for kind, name in PROFILE_OF.items()}
        for command in ("disable", commands[profile], "enable"):
            reply = self.robot.command(command)
            if not reply.accepted:
                return reply.reason
        self.state = None  # what it said before it was switched is not how it is now
        return self.warm_up()

    def start(self) -> Drive:
        """Start the drive to the goal."""
        assert self.goal.pose is not None
        self.received_before = self.robot.process.received_bytes
        self.started_at, self.start_distance_m = self.now, self.world.distance
        self.drive = Drive(
            goal=(self.goal.pose.x, self.goal.pose.y),
            goal_id=self.goal.goal_id,
            areas=self.site.site.areas,
            truth=self.world.truth(STAMP + self.now),
            now=self.now,
            hazard=self.hazard,
        )
        return self.drive

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

    def result(self, drive: Drive, outcome: DriveOutcome) -> LockstepResult:
        """Return the result of the drive."""
        summary = drive.summary(outcome)
        return LockstepResult(
            **msgspec.structs.asdict(summary),
            seed=self.seed,
            contacts=self.world.contacts,
            planned_m=round(self.planned_m, 2),
            hazard_at_m=round(drive.blocked_at_m, 2) if drive.blocked_at_m is not None else None,
            stages_ms=durations_ms(next((t for t in self.traces if t.area == summary.area), None), SPANS),
            pose_error_m=round(self.pose_error, 3),
            operator_commands=self.commands,
            profile=self.robot.agent.profile.name,
            barrier_distance_m=round(self.barrier_distance_m, 3) if self.barrier is not None else None,
            received_bytes=self.robot.process.received_bytes - self.received_before,
            events=self.events,
            track=self.track,
        )


def run_lockstep(  # noqa: PLR0913  # the options of a run
    site: LoadedSite,
    start: Pose,
    goal: Place,
    seed: int,
    hazard: HazardRequest | None = None,
    *,
    noise: Noise | None = None,
    watched: bool | Site = True,
    base: str = DEFAULT_BASE,
    lidar: str = DEFAULT_LIDAR,
    bus: Bus | None = None,
    profile: ProfileName = "fog",
    cpu: CpuMeter | None = None,
    tuning: Tuning | None = None,
    mounted: RobotFile | None = None,
) -> LockstepResult:
    """Drive the site's first robot from `start` to `goal`; the result is the same for the same arguments.

    With `hazard` a barrier blocks an area, as in a demonstration: which one and after which distance the seed draws,
    unless they are requested, and never within 3 m of the robot. Without `watched` the site has neither areas nor
    nodes: the robot's own lidar must find the barrier; a `Site` says which ones there are. `base` and `lidar` name the
    robot's hardware, `bus` carries the messages (default: a new one), `profile` says who plans, `cpu` measures the
    components from the goal on, `tuning` changes nodes and robot. `mounted`: all of a robot's settings, in place of
    `base` and `lidar`.

    Raises `BarrierError` for an unknown area, one that no barrier can close, or if no area qualifies, `ValueError` for
    a start inside an obstacle.
    """
    run = ready(
        site, start, goal, seed, hazard,
        noise=noise, watched=watched, bus=bus, profile=profile, cpu=cpu, tuning=tuning,
        mounted=mounted or default_robot(base, lidar),
    )  # fmt: skip
    drive = run.drive
    assert drive is not None
    if run.problem is not None:
        return run.result(drive, DriveOutcome("stopped", run.problem))
    while (outcome := drive.outcome(run.now)) is None:
        run.step()
    return run.result(drive, outcome)


def ready(  # noqa: PLR0913  # as of `run_lockstep`
    site: LoadedSite,
    start: Pose,
    goal: Place,
    seed: int,
    hazard: HazardRequest | None = None,
    *,
    noise: Noise | None = None,
    watched: bool | Site = True,
    bus: Bus | None = None,
    profile: ProfileName = "fog",
    cpu: CpuMeter | None = None,
    tuning: Tuning | None = None,
    mounted: RobotFile | None = None,
) -> LockstepDrive:
    """Return a drive that has just begun, as `run_lockstep` drives it; its `problem` says why it can't."""
    pose = msgspec.convert(
        {"x": goal.x, "y": goal.y, "theta": goal.theta if goal.theta is not None else 0.0}, type(start)
    )
    mission = RobotGoal(goal_id="lockstep-1", pose=pose)
    schedule = HazardSchedule.of(site, seed, hazard) if hazard is not None else None
    run = LockstepDrive(
        site, start, mission, seed, noise,
        watched=watched, hazard=schedule, bus=bus, mounted=mounted,
        measure=cpu.measure if cpu else unmeasured, tuning=tuning,
    )  # fmt: skip
    run.problem = run.warm_up()
    if run.problem is None and profile != "fog":
        run.problem = run.switch(profile)
    run.start()
    if cpu is not None:
        cpu.seconds.clear()
    if run.problem is None:
        run.system.fog.planner.set_goal(run.robot.id, mission, any_heading=goal.theta is None)
    return run


def release_drives() -> None:
    """Free the systems of drives that nobody uses any more; call it after each drive of a process that runs many.

    A system's objects refer to one another, so only the garbage collector frees them. It counts objects, and a drive
    has few, but some 170 MB of arrays in them: by itself it would let dozens of drives pile up. What is left after the
    first drive (modules, compiled kernels) stays as long as the process: no further collection looks through it.
    """
    gc.collect()
    if gc.get_freeze_count() == 0:
        gc.freeze()


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
    parser.add_argument(
        "--profile", choices=sorted(PROFILE_OF.values()), default="fog", help="who plans (default: fog)"
    )
    parser.add_argument("--no-hazard", action="store_true")
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
    hazard = None if arguments.no_hazard else HazardRequest(area=arguments.area)
    try:
        profile, watched = arguments.profile, arguments.profile != "default"
        result = run_lockstep(site, start, goal, arguments.seed, hazard, profile=profile, watched=watched)
    except BarrierError as error:
        parser.error(str(error))
    printed = msgspec.to_builtins(result)
    if not arguments.track:
        del printed["track"]
    sys.stdout.write(json.dumps(printed, indent=2) + "\n")
    raise SystemExit(0 if result.success else 1)


if __name__ == "__main__":
    main()
