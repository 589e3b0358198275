"""One drive with every real core in one process, on an emulated clock: faster than real time, the same for one seed.

What is real: aggregator, map-service, planner, agent and guardian; every message as the bytes of its channel; base
and lidar as bytes on their lines, at the lines' pace, through the robot's own parsers. What is not: brokers, sockets,
threads, and the time that computing and networks take (`stages_ms` therefore holds the waiting, not the computing).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import msgspec
import numpy as np

from fog_contracts.geometry import contains_point, distance_to_polygon
from fog_contracts.messages import PlanRequest, RobotGoal, RobotPath, SimObstacle
from fog_runtime.site import LoadedSite, load_site
from fognav_experiments.rigs import FogRig, RobotRig
from fognav_sim.devices import DEFAULT_BASE, DEFAULT_LIDAR
from fognav_sim.hardware import STEP_S
from fognav_sim.scenario import Event, Scenario, ScenarioError, barrier_across
from fognav_sim.world import Noise, World

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import Pose, Trace
    from fog_contracts.site import AreaSite, Place

Outcome = Literal["reached", "refused", "contact", "timeout", "stopped"]

WARM_UP_S: Final = 12.0
"""Time in which areas must be judged, the pose found and the robot enabled."""
TRIGGER_M: Final = (3.0, 8.0)
"""Between these the travelled distance is drawn after which an area is blocked."""
ROOM_M: Final = 4.0
"""An area is drawn only if the way enters it at least this far after the latest trigger."""
TRACK_M: Final = 0.25
"""Spacing of the recorded track."""
OFF_GOAL_M: Final = 0.30
"""A robot that believes to be at its goal must really be this near."""
REFUSED_S: Final = 10.0
STOPPED_S: Final = 3.0
HELD_S: Final = 62.0

STAGES: Final = {
    "debounce": ("first_reading", "confirmed"),
    "costmap": ("confirmed", "costmap_published"),
    "plan": ("costmap_published", "plan_published"),
    "deliver": ("plan_published", "path_received"),
    "command": ("path_received", "first_command"),
    "total": ("first_reading", "first_command"),
}


class Happening(msgspec.Struct, frozen=True, kw_only=True):
    """Something worth telling, with its time (s) and the way driven (m) since the goal was given."""

    time_s: float
    distance_m: float
    what: str


class LockstepResult(msgspec.Struct, frozen=True, kw_only=True):
    """How a drive went, judged by the simulated truth; lengths in m, times in s of the emulated clock.

    `operator_commands` counts the commands that were accepted, the first enable included.
    `crossed` lists the areas that the robot really entered, `hazard_clearance_m` how near its rim came to the
    barrier, `stages_ms` the blocked hazard's way, `track` the true way every 0.25 m.
    """

    outcome: Outcome
    detail: str
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
    events: list[Happening]
    track: list[tuple[float, float]]


class _Drive:
    """One run: rigs, scenario and what is written down about it."""

    def __init__(
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
        self.world = World(site.map.geometry, site.map.cells, robot, seed, noise=noise)
        self.robot = RobotRig(site, robot, self.world, seed, 0.0, base=base, lidar=lidar)
        self.fog = FogRig(site, self.world, seed, 0.0)
        self.scenario = Scenario((), start=0.0)
        self.events: list[Happening] = []
        self.crossed: list[str] = []
        self.track: list[tuple[float, float]] = []
        self.plans = 0
        self.planned_m = 0.0
        self.path: RobotPath | None = None
        self.refused_since: float | None = None
        self.barrier: SimObstacle | None = None
        self.barrier_since: float | None = None
        self.hazard_clearance = math.inf
        self.pose_error = 0.0
        self.traces: list[Trace] = []
        self.commands = 0
        self.begun_at = 0.0
        self.began_m = 0.0
        self._mode = ""
        self._mode_since = 0.0
        self._any_heading = False

    @property
    def now(self) -> float:
        """The emulated time, s."""
        return self.robot.now

    @property
    def driven(self) -> float:
        """Way since the goal was given, m."""
        return self.world.distance - self.began_m

    def say(self, what: str) -> None:
        """Write down an event."""
        self.events.append(
            Happening(time_s=round(self.now - self.begun_at, 2), distance_m=round(self.driven, 2), what=what)
        )

    def step(self) -> None:
        """Let 10 ms pass everywhere."""
        robot, fog = self.robot, self.fog
        robot.step(fog.snapshot if robot.agent.wants_snapshot(robot.now) else None)
        for happened in self.scenario.step(self.world, self.now):
            self.barrier_since = self.now
            self.say(happened.name)
        known = {area: told.hazard.state for area, told in fog.hazards.items()}
        fog.step(self.now)
        fog.hear(robot.id, robot.tell(), self.now)
        for message in fog.deliver(robot):
            if isinstance(message, RobotPath):
                self._on_path(message)
        for area, told in fog.hazards.items():
            if known.get(area) != told.hazard.state:
                self.say(f"area {area}: {told.hazard.state} ({told.hazard.cause})")
        self.traces += robot.agent.finished_traces()
        self._watch()

    def _on_path(self, path: RobotPath) -> None:
        known, self.path = self.path, path
        if path.refusal is None:
            self.refused_since = None
        elif self.refused_since is None:
            self.refused_since = self.now
        if known is not None and known.plan_id == path.plan_id:
            return
        self.plans += 1
        if path.refusal is not None:
            self.say(f"no way: {path.refusal.reason}")
            return
        length = sum(math.dist(a, b) for a, b in zip(path.points, path.points[1:], strict=False))
        if self.plans == 1:
            self.planned_m = length
        self.say(f"plan {path.plan_id}: {length:.1f} m")

    def _watch(self) -> None:
        x, y, _ = self.world.pose
        if not self.track or math.dist(self.track[-1], (x, y)) >= TRACK_M:
            self.track.append((round(float(x), 3), round(float(y), 3)))
            for area in self.site.site.areas:
                if area.id not in self.crossed and contains_point(area.polygon, x, y):
                    self.crossed.append(area.id)
                    self.say(f"enters {area.id}")
            pose = self.robot.pose
            if pose is not None and pose.localized:
                self.pose_error = max(self.pose_error, math.hypot(pose.x - x, pose.y - y))
        if self.barrier is not None and self.barrier_since is not None:
            gap = distance_to_polygon(self.barrier.polygon, x, y) - self.world.robot.radius
            self.hazard_clearance = min(self.hazard_clearance, gap)
        state = self.robot.state
        if state is not None and state.mode != self._mode:
            self._mode, self._mode_since = state.mode, self.now
            self.say(f"robot: {state.mode} ({'; '.join(state.reasons[:2])})")

    def operate(self) -> None:
        """Do what a person would: enable the robot, at the start and where it waits for a person's look."""
        state = self.robot.state
        if state is None:
            return
        stood = self.now - self._mode_since
        waits = not state.enabled or state.mode == "INIT"
        waits = waits or (state.mode == "PROTECTIVE_STOP" and stood >= STOPPED_S)
        waits = waits or (state.mode == "HOLD" and stood >= HELD_S)
        if not waits:
            return
        reply = self.robot.command("enable")
        if reply.accepted:
            self.commands += 1
            self.say("operator: enable")

    def warm_up(self) -> str | None:
        """Run until the robot may drive; returns why it never could, or None."""
        until = self.now + WARM_UP_S
        steps = 0
        while self.now < until:
            self.step()
            steps += 1
            if steps % 50 == 0:
                self.operate()
            state = self.robot.state
            judged = all(told.hazard.state != "unknown" for told in self.fog.hazards.values())
            if state is not None and state.mode == "NORMAL" and judged:
                return None
        unknown = [area for area, told in self.fog.hazards.items() if told.hazard.state == "unknown"]
        reasons = self.robot.state.reasons if self.robot.state else []
        return f"not ready after {WARM_UP_S:.0f} s: {'; '.join(reasons)}; unknown areas: {unknown}"

    def verdict(self, timeout_s: float) -> tuple[Outcome, str] | None:
        """Return how the drive ended, None while it goes on."""
        state = self.robot.state
        if self.world.contacts:
            x, y, _ = self.world.pose
            return "contact", f"the robot touched something at ({x:.2f}, {y:.2f})"
        if state is not None and state.goal_reached:
            assert self.goal.pose is not None
            x, y, _ = self.world.pose
            off = math.hypot(x - self.goal.pose.x, y - self.goal.pose.y)
            if off > OFF_GOAL_M:
                return "stopped", f"the robot believes to be at its goal and is {off:.2f} m off"
            return "reached", f"{off:.2f} m off the goal"
        if state is not None and state.mode == "FAULT":
            return "stopped", "; ".join(state.reasons)
        if self.refused_since is not None and self.now - self.refused_since > REFUSED_S:
            assert self.path is not None
            return "refused", self.path.refusal.reason if self.path.refusal else ""
        if self.now - self.begun_at > timeout_s:
            return "timeout", "; ".join(state.reasons) if state is not None else ""
        return None

    def result(self, outcome: Outcome, detail: str, area: str | None) -> LockstepResult:
        """Put together what is known."""
        happened = next((event for event in self.events if event.what.startswith("barrier appears")), None)
        return LockstepResult(
            outcome=outcome,
            detail=detail,
            seed=self.seed,
            distance_m=round(self.driven, 3),
            time_s=round(self.now - self.begun_at, 2),
            min_clearance_m=round(self.world.truth(0.0).min_clearance, 3),
            contacts=self.world.contacts,
            planned_m=round(self.planned_m, 2),
            replans=max(0, self.plans - 1),
            hazard_area=area,
            hazard_at_m=happened.distance_m if happened else None,
            hazard_clearance_m=round(self.hazard_clearance, 3) if happened else None,
            crossed=self.crossed,
            stages_ms=self._stages(area),
            pose_error_m=round(self.pose_error, 3),
            operator_commands=self.commands,
            events=self.events,
            track=self.track,
        )

    def _stages(self, area: str | None) -> dict[str, float]:
        trace = next((trace for trace in self.traces if trace.area == area), None)
        if trace is None:
            return {}
        pairs = {stage: (getattr(trace, a), getattr(trace, b)) for stage, (a, b) in STAGES.items()}
        return {stage: round(1000.0 * (b - a), 1) for stage, (a, b) in pairs.items() if a and b}


def run_lockstep(
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

    With `hazard_area` a barrier appears in that area after `hazard_at_m` metres (drawn between 3 and 8 by the seed
    if not given), never within 3 m of the robot. Without `watched` the floor has neither areas nor nodes: the robot's
    own lidar must find the barrier. `base` and `lidar` name the robot's hardware. Raises `ScenarioError` for an area
    that the site does not have or that can't be barred, `ValueError` for a start inside something.
    """
    pose = msgspec.convert(
        {"x": goal.x, "y": goal.y, "theta": goal.theta if goal.theta is not None else 0.0}, type(start)
    )
    mission = RobotGoal(goal_id="lockstep-1", pose=pose)
    bare = msgspec.structs.replace(site.site, areas=[], nodes=[])
    drive = _Drive(
        site if watched else dataclasses.replace(site, site=bare), start, mission, seed, noise, base=base, lidar=lidar
    )
    barrier = None
    if hazard_area is not None:
        barrier = barrier_across(_area(site, hazard_area), site.site, site.map, seed)
    why = drive.warm_up()
    drive.begun_at, drive.began_m = drive.now, drive.world.distance
    if why is not None:
        return drive.result("stopped", why, hazard_area)
    if barrier is not None:
        drive.barrier = barrier
        at = hazard_at_m if hazard_at_m is not None else float(np.random.default_rng((seed, 1)).uniform(*TRIGGER_M))
        event = Event(name=f"barrier appears in {hazard_area}", place=(barrier,), at_distance=at)
        drive.scenario = Scenario([event], start=drive.now, distance=drive.world.distance)
    drive.fog.planner.set_goal(drive.robot.id, mission, any_heading=goal.theta is None)
    steps = 0
    while (verdict := drive.verdict(timeout_s)) is None:
        drive.step()
        steps += 1
        if steps % 50 == 0:
            drive.operate()
    return drive.result(*verdict, hazard_area)


def _area(site: LoadedSite, area_id: str) -> AreaSite:
    for area in site.site.areas:
        if area.id == area_id:
            return area
    raise ScenarioError(f"the site has no area {area_id!r}; it has: {', '.join(a.id for a in site.site.areas)}")


def entry(path: Sequence[tuple[float, float]], area: AreaSite) -> float | None:
    """Return how far along a track (m) it first enters an area; None when it never does."""
    travelled = 0.0
    for index, point in enumerate(path):
        travelled += math.dist(path[index - 1], point) if index else 0.0
        if contains_point(area.polygon, *point):
            return travelled
    return None


def draw_area(site: LoadedSite, track: Sequence[tuple[float, float]], areas: Sequence[str], seed: int) -> str:
    """Draw one of `areas` that a track enters late enough to be blocked before; raises `ScenarioError` if none is."""
    fitting = []
    for area_id in areas:
        at = entry(track, _area(site, area_id))
        if at is not None and at > TRIGGER_M[1] + ROOM_M:
            fitting.append(area_id)
    if not fitting:
        raise ScenarioError(f"the way enters none of the areas {', '.join(areas) or '(none)'} late enough")
    return fitting[int(np.random.default_rng((seed, 2)).integers(len(fitting)))]


def _free_way(site: LoadedSite, start: Pose, goal: Place, seed: int) -> list[tuple[float, float]]:
    """Plan the way on the empty floor, without driving it."""
    mission = RobotGoal(goal_id="look", pose=msgspec.structs.replace(start, x=goal.x, y=goal.y))
    robot = msgspec.structs.replace(site.site.robots[0], start=start)
    fog = FogRig(site, World(site.map.geometry, site.map.cells, robot, seed), seed, 0.0)
    for step in range(200):
        fog.step((step + 1) * STEP_S)
        fog.inform_planner((step + 1) * STEP_S)
    assert mission.pose is not None
    reply = fog.planner.plan(PlanRequest(start=start, goal=mission.pose))
    if reply.refusal is not None:
        raise ScenarioError(f"there is no way even without a hazard: {reply.refusal.reason}")
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
    parser.add_argument("--area", help="area that becomes blocked (default: drawn among the demo's on the way)")
    parser.add_argument("--no-hazard", action="store_true")
    parser.add_argument("--timeout", type=float, default=900.0, help="seconds of the emulated clock")
    parser.add_argument("--track", action="store_true", help="print the true track too")
    arguments = parser.parse_args()
    site = load_site(arguments.site)
    demo = site.site.demo
    names = arguments.start or (demo and demo.start), arguments.goal or (demo and demo.goal)
    for name in names:
        if name not in site.site.places:
            parser.error(f"no place {name!r}; the site has: {', '.join(site.site.places)}")
    begin, goal = (site.site.places[str(name)] for name in names)
    robot = site.site.robots[0].start
    start = msgspec.structs.replace(
        robot, x=begin.x, y=begin.y, theta=begin.theta if begin.theta is not None else robot.theta
    )
    area = None
    try:
        if not arguments.no_hazard:
            areas = demo.areas if demo else [a.id for a in site.site.areas]
            area = arguments.area or draw_area(
                site, _free_way(site, start, goal, arguments.seed), areas, arguments.seed
            )
        result = run_lockstep(site, start, goal, arguments.seed, area, timeout_s=arguments.timeout)
    except ScenarioError as error:
        parser.error(str(error))
    shown = msgspec.to_builtins(result)
    if not arguments.track:
        del shown["track"]
    sys.stdout.write(json.dumps(shown, indent=2) + "\n")
    raise SystemExit(0 if result.outcome == "reached" else 1)


if __name__ == "__main__":
    main()
