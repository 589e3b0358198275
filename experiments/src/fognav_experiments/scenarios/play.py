"""Plays scenarios in lockstep, with one robot or several, and tells how they went.

Several robots share the corridors and one fog node, each in its own world, which holds one robot: the others are in its
way wherever they are, and its lidar and the sonars see them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import tomllib
from functools import cache
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.geometry import distance_to_polygon
from fog_contracts.messages import PolygonShape, Pose, RobotGoal, Zone
from fog_contracts.site import RobotSite
from fog_runtime.configuration.parts import DEFAULT_BASE
from fog_runtime.configuration.site import load_site
from fognav_experiments.lockstep import LockstepDrive, LockstepResult, release_drives
from fognav_experiments.machine import CpuMeter
from fognav_experiments.rigs import STAMP, TICK_STEPS, FogRig, RobotRig, moment
from fognav_experiments.scenarios.description import Scenario, deviations
from fognav_experiments.scenarios.stage import Stage
from fognav_sim import devices
from fognav_sim.drive.drive import Drive, DriveOutcome
from fognav_sim.drive.operator import OperatorPolicy
from fognav_sim.floor import Floor
from fognav_sim.world import World

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fog_contracts.geometry import Polygon
    from fog_contracts.handlers import Ids, Moment, Publication
    from fog_contracts.messages import RobotPath, RobotState
    from fog_runtime.configuration.site import LoadedSite


READY_S: Final = 20.0
_OPERATOR_STEPS: Final = 50


class Mission(NamedTuple):
    """A robot, which stands at its start, and its goal (x, y; m)."""

    robot: RobotSite
    goal: tuple[float, float]


class Vehicle:
    """One robot of the fleet: its world, its processes, its operator and its drive."""

    def __init__(self, site: LoadedSite, mission: Mission, bus: Bus, seed: int, cpu: CpuMeter) -> None:
        emulator = devices.make_base(DEFAULT_BASE)
        floor = Floor(site.map.geometry, site.map.cells)
        self.goal = mission.goal
        self.world = World(floor, mission.robot, seed, axle_m=emulator.axle_m)
        self.rig = RobotRig(site, mission.robot, self.world, emulator, bus, seed, 0.0, measure=cpu.measure)
        self.operator = OperatorPolicy(0.0)
        self.state: RobotState | None = None
        self.drive: Drive | None = None
        self.outcome: DriveOutcome | None = None
        self._begun_m = 0.0
        own = {"robot": mission.robot.id}
        bus.subscribe({ch.ROBOT_STATE: self._on_state, ch.ROBOT_PATH: self._on_path}, only=own)

    @property
    def id(self) -> str:
        """The robot's id."""
        return self.rig.id

    @property
    def driven_m(self) -> float:
        """Distance driven since the goal was given, m."""
        return self.world.distance - self._begun_m

    def start(self, goal_id: str) -> None:
        """Begin the drive to the goal, which the planner has got."""
        truth = self.world.truth(STAMP + self.rig.now)
        self._begun_m = self.world.distance
        self.drive = Drive(goal=self.goal, goal_id=goal_id, areas=(), truth=truth, now=self.rig.now, hazard=None)

    def evaluate(self) -> None:
        """Evaluate the ground truth, until the drive has its outcome."""
        if self.drive is not None and self.outcome is None:
            self.drive.on_truth(self.world.truth(STAMP + self.rig.now))
            self.outcome = self.drive.outcome(self.rig.now)

    def operate(self) -> None:
        """Let the operator give the command that is due, if one is."""
        command = self.operator.command_due(self.rig.now)
        if command is not None:
            self.rig.command(command)

    def _on_state(self, ids: Ids, state: RobotState, at: Moment) -> Sequence[Publication]:
        del ids
        self.state = state
        self.operator.on_state(state, at.now)
        if self.drive is not None:
            self.drive.on_state(state, at.now)
        return ()

    def _on_path(self, ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        del ids
        if self.drive is not None:
            self.drive.on_path(path, at.now)
        return ()


class Fleet:
    """A site with its fog node, its sensor nodes, and several robots."""

    def __init__(self, site: LoadedSite, missions: Sequence[Mission], seed: int, cpu: CpuMeter) -> None:
        """Assemble the system; `cpu` measures its components."""
        robots = [mission.robot for mission in missions]
        site = dataclasses.replace(site, site=msgspec.structs.replace(site.site, robots=robots))
        self.bus = Bus(site.site.id)
        self.vehicles = [
            Vehicle(site, mission, self.bus, seed + number, cpu) for number, mission in enumerate(missions)
        ]
        for vehicle in self.vehicles:
            vehicle.world.share_with(other.world for other in self.vehicles if other is not vehicle)
        self.fog = FogRig(site, self.vehicles[0].world, self.bus, seed, 0.0, measure=cpu.measure)
        self.least_gap_m = math.inf
        """The smallest distance between the rims of two robots so far."""
        self.places: list[Polygon] = []
        self.most_in_place = 0
        """How many robots were in a place for one at once, at most."""
        self._steps = 0

    @property
    def now(self) -> float:
        """The emulated time, s."""
        return self.vehicles[0].rig.now

    def step(self) -> None:
        """Simulate 10 ms."""
        for vehicle in self.vehicles:
            vehicle.rig.sense()
        self._note_gap()
        tick = self._steps % TICK_STEPS == 0
        if tick:
            for vehicle in self.vehicles:
                vehicle.world.see_others()
        at = moment(self.now)
        self.fog.measure(at.now)
        self.fog.deliver(at)
        for vehicle in self.vehicles:
            vehicle.rig.act()
        if tick:
            self.fog.tick(at)
            for vehicle in self.vehicles:
                vehicle.rig.process.tick(at)
            self.fog.deliver(at)
        self._steps += 1
        self._supervise(evaluate=tick)

    def warm_up(self) -> str | None:
        """Run until all robots are ready; return None, or which are not."""
        waiting = self.vehicles
        while self.now < READY_S:
            self.step()
            waiting = [v for v in self.vehicles if v.state is None or v.state.mode != "NORMAL"]
            if not waiting:
                return None
        return f"not ready after {READY_S:.0f} s: {', '.join(vehicle.id for vehicle in waiting)}"

    def start(self) -> None:
        """Give all robots their goals."""
        for vehicle in self.vehicles:
            goal = RobotGoal(goal_id=f"to-{vehicle.id}", pose=Pose(x=vehicle.goal[0], y=vehicle.goal[1], theta=0.0))
            vehicle.start(goal.goal_id)
            self.fog.planner.set_goal(vehicle.id, goal, any_heading=True)

    def keep_for_one(self, places: Sequence[Polygon]) -> None:
        """Draw zones for one robot at a time."""
        self.places = list(places)
        for number, place in enumerate(places, start=1):
            zone = Zone(id=f"one-{number}", kind="RELEASE", shape=PolygonShape(points=list(place)))
            self.fog.put_zone(zone, moment(self.now))

    def _note_gap(self) -> None:
        for place in self.places:
            worlds = [vehicle.world for vehicle in self.vehicles]
            inside = sum(distance_to_polygon(place, *world.pose[:2]) < world.robot.radius for world in worlds)
            self.most_in_place = max(self.most_in_place, inside)
        for one, other in itertools.combinations((vehicle.world for vehicle in self.vehicles), 2):
            gap = math.dist(one.pose[:2], other.pose[:2]) - one.robot.radius - other.robot.radius
            self.least_gap_m = min(self.least_gap_m, gap)

    def _supervise(self, *, evaluate: bool) -> None:
        if refused := self.bus.refused:
            raise RuntimeError(f"the system refused messages of its own: {'; '.join(refused)}")
        for vehicle in self.vehicles:
            if evaluate:
                vehicle.evaluate()
            if self._steps % _OPERATOR_STEPS == 0:
                vehicle.operate()


class FleetResult(msgspec.Struct, frozen=True, kw_only=True):
    """How the drives of a fleet went, from the moment when all robots got their goals.

    `distance_m`: of all robots together; `time_s`: until the last one arrived, None if not all did; `arrived`: how many
    did. `gap_m`: smallest distance between two robots' rims. `plans`: paths that the planner gave, `planner_percent`:
    share of one core (%) that it took, per second of the simulated clock.
    """

    contacts: int
    reason: str
    distance_m: float
    time_s: float | None
    arrived: int
    gap_m: float
    plans: int
    planner_percent: float
    most_in_place: int = 0
    """How many robots were in a place for one at once, at most."""


class _Ending(NamedTuple):
    """How the drives ended, in the scenarios' words, and why."""

    kind: str
    reason: str


def play_fleet(scenario: Scenario, site: LoadedSite) -> tuple[FleetResult, str]:
    """Drive all robots of a scenario; return the result, and how it ended as the scenarios' outcomes name it."""
    cpu = CpuMeter()
    fleet = Fleet(site, _missions(scenario, site), scenario.seed, cpu)
    problem = fleet.warm_up()
    cpu.seconds.clear()
    begun = fleet.now
    if problem is None:
        fleet.keep_for_one(scenario.one_robot)
        fleet.start()
        while fleet.now - begun < scenario.seconds and any(vehicle.outcome is None for vehicle in fleet.vehicles):
            fleet.step()
    ended = _ended(fleet.vehicles) if problem is None else _Ending("stopped", problem)
    seconds = fleet.now - begun
    drives = [vehicle.drive for vehicle in fleet.vehicles if vehicle.drive is not None]
    result = FleetResult(
        contacts=sum(vehicle.world.contacts for vehicle in fleet.vehicles),
        reason="every robot stands at its goal" if ended is None else ended.reason,
        distance_m=round(sum(vehicle.driven_m for vehicle in fleet.vehicles), 2),
        time_s=round(seconds, 2) if ended is None else None,
        arrived=sum(_arrived(vehicle) for vehicle in fleet.vehicles),
        gap_m=round(fleet.least_gap_m, 3),
        most_in_place=fleet.most_in_place,
        plans=sum(drive.evaluation.plans for drive in drives),
        planner_percent=round(100.0 * cpu.seconds["planner"] / max(seconds, 1e-9), 2),
    )
    return result, "reached" if ended is None else ended.kind


def _missions(scenario: Scenario, site: LoadedSite) -> list[Mission]:
    """Return the robots like the site's first one, with their goals: the scenario's own and the others."""
    wanted = [(scenario.start, scenario.goal), *((other.start, other.goal) for other in scenario.others)]
    like = site.site.robots[0]
    return [
        Mission(
            RobotSite(id=f"r{number}", start=Pose(x=x, y=y, theta=theta), radius=like.radius, height=like.height), goal
        )
        for number, ((x, y, theta), goal) in enumerate(wanted, start=1)
    ]


def _arrived(vehicle: Vehicle) -> bool:
    return vehicle.outcome is not None and vehicle.outcome.kind == "reached"


def _ended(vehicles: Sequence[Vehicle]) -> _Ending | None:
    """Return None if every robot has arrived, else how the first one that has not ended its drive, or still drives."""
    for vehicle in vehicles:
        if not _arrived(vehicle):
            x, y, _ = vehicle.world.pose
            state = vehicle.state
            mode = "" if state is None else f" in {state.mode} ({'; '.join(state.reasons)})"
            if vehicle.outcome is None:
                return _Ending("driving", f"robot {vehicle.id} is at ({x:.1f}, {y:.1f}){mode}")
            return _Ending(vehicle.outcome.kind, f"robot {vehicle.id}: {vehicle.outcome.reason}")
    return None


class ScenarioError(ValueError):
    """A scenario's file is invalid; the message names file and place."""


class Played(NamedTuple):
    """A scenario that was played: its result, how it ended, and what differs from what was expected."""

    scenario: Scenario
    result: LockstepResult | FleetResult
    outcome: str
    deviations: list[str]


def read_scenario(file: Path) -> Scenario:
    """Return the scenario of a file; raises `ScenarioError`."""
    try:
        return msgspec.convert(tomllib.loads(file.read_text("utf-8")), Scenario)
    except (OSError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ScenarioError(f"{file}: {error}. Correct it") from error


def play(scenario: Scenario, sites: Path) -> Played:
    """Drive a scenario on its site, one of the folder `sites`."""
    site = _site(sites / scenario.site)
    played = _play_others(scenario, site) if scenario.others else _play_alone(scenario, site)
    release_drives()
    return played


def _play_others(scenario: Scenario, site: LoadedSite) -> Played:
    result, outcome = play_fleet(scenario, site)
    found = deviations(scenario.expected, result, outcome, ())
    most = scenario.expected.plans
    if most is not None and result.plans > most:
        found.append(f"{result.plans} paths, more than {most}")
    return Played(scenario, result, outcome, found)


def _play_alone(scenario: Scenario, site: LoadedSite) -> Played:
    x, y, theta = scenario.start
    goal = RobotGoal(goal_id="scenario", pose=Pose(x=scenario.goal[0], y=scenario.goal[1], theta=0.0))
    run = LockstepDrive(
        site,
        Pose(x=x, y=y, theta=theta),
        goal,
        scenario.seed,
        None,
        watched=scenario.profile != "default",
        hazard=None,
        bus=None,
    )
    waits = run.system.fog.planner.core.waits
    waits.config = dataclasses.replace(waits.config, wait=scenario.wait)
    problem = run.warm_up()
    if problem is None and scenario.profile != "fog":
        problem = run.switch(scenario.profile)
    drive, before = run.start(), len(run.events)
    stage = Stage(run, scenario.events)
    outcome = None if problem is None else DriveOutcome("stopped", problem)
    if outcome is None:
        run.system.fog.planner.set_goal(run.robot.id, goal, any_heading=True)
    while outcome is None and stage.elapsed < scenario.seconds:
        stage.step()
        run.step()
        outcome = drive.outcome(run.now)
    ended = outcome or DriveOutcome("stopped", f"ended after {scenario.seconds:.0f} s")
    result = run.result(drive, ended)
    name = "driving" if outcome is None else outcome.kind
    return Played(scenario, result, name, deviations(scenario.expected, result, name, result.events[before:]))


_PAGE: Final = """\
# Drives on which something goes wrong

```
fognav experiment scenarios --table FILE
```

{count} in one go, in lockstep; measured on: {facts}.

Times are those of the simulated clock. `driving` means that the robot had not ended its drive after the scenario's
time, which may be what is expected. What is expected of each, and checked, stands in its file.
"""


def markdown_page(drives: Mapping[str, Played], measured_on: Mapping[str, object]) -> str:
    """Return a Markdown page of scenarios that were played, by name: what happens, and how each drive ended.

    `measured_on`: commit, machine and versions, by name.
    """
    rows = [
        f"| [{name}](../../experiments/scenarios/{name}.toml) | {played.scenario.title} | {played.outcome} | "
        f"{played.result.distance_m:.1f} | {played.result.time_s or played.scenario.seconds:.0f} | "
        f"{'; '.join(played.deviations) or 'yes'}{_of_fleet(played)} |"
        for name, played in drives.items()
    ]
    header = ["| scenario | what happens | outcome | m | s | as expected |", "| --- | --- | --- | --- | --- | --- |"]
    facts = ", ".join(f"{name} {value}" for name, value in measured_on.items())
    return "\n".join([_PAGE.format(count=len(drives), facts=facts), *header, *rows]) + "\n"


def _of_fleet(played: Played) -> str:
    """Return in words what several robots did to one another and to the planner."""
    result = played.result
    if not isinstance(result, FleetResult):
        return ""
    return (
        f"; {result.arrived} of {1 + len(played.scenario.others)} arrived, nearest {result.gap_m:.2f} m, "
        f"{result.plans} paths, planner {result.planner_percent:.1f} % of a core"
    )


@cache
def _site(folder: Path) -> LoadedSite:
    return load_site(folder)
