"""Drives a hunted world in lockstep under the oracle's eyes."""

from __future__ import annotations

import itertools
import math
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from fog_contracts.messages import Pose, RobotGoal
from fog_runtime.configuration.maps import MapFileError, load_map
from fog_runtime.configuration.site import LoadedSite
from fognav_experiments.hunt import oracle as watching
from fognav_experiments.hunt.oracle import Figures, Oracle, Violation
from fognav_experiments.hunt.world import Built, HuntWorld, build, to_map
from fognav_experiments.lockstep import LockstepDrive, release_drives
from fognav_experiments.rigs import STAMP
from fognav_experiments.scenarios.stage import Source, Stage
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.drive import DriveOutcome
from fognav_sim.drive.hazard import HazardSchedule
from fognav_sim.emulators import QuirkyBase

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import CommandKind, Zone

_AFTER_S: Final = 3.0
"""How long a drive goes on after a broken rule: what it leads to says more of it."""
_HELP_S: Final = 12.0
_FIND_POSE: Final[tuple[CommandKind, ...]] = ("turn", "advance", "initial_pose")
"""What an operator tries if a robot does not know its pose."""
_BUSY_S: Final = 2.0
"""How late messages are at most, but one in thousands, while a radio is busy."""
_REPEATED_S: Final = 0.05
"""How often a guardian repeats a command, of five bytes."""
_UNLUCKY: Final = 1e-3
_SETTLED_S: Final = 0.3
"""What wheels take to stop after a wrong command, and to be seen standing: truth comes every 0.1 s."""


class Hunted(msgspec.Struct, frozen=True, kw_only=True):
    """How a drive of a world went: its end, its simulated seconds, what was broken, and its figures."""

    title: str
    outcome: str
    reason: str
    simulated_s: float
    violations: list[Violation]
    figures: Figures


def read_world(file: Path) -> HuntWorld:
    """Return the world of a file; raises `ValueError` with the file's name."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=HuntWorld)
    except (OSError, msgspec.DecodeError) as error:
        raise ValueError(f"{file}: {error}. Correct it") from error


def write_world(world: HuntWorld) -> bytes:
    """Return a world as the text of its file, a line for each field that is not as usual."""
    usual = msgspec.to_builtins(HuntWorld(title="", start=(0.0, 0.0, 0.0), goal=(0.0, 0.0)))
    said = {name: value for name, value in msgspec.to_builtins(world).items() if value != usual[name]}
    if "sensors" in said:
        said["sensors"] = {name: value for name, value in said["sensors"].items() if value != usual["sensors"][name]}
    lines = (b'"%s": %s' % (name.encode(), msgspec.json.encode(value)) for name, value in said.items())
    return b"{\n" + b",\n".join(lines) + b"\n}\n"


def load_recorded(name: str, folders: Sequence[Path]) -> StaticMap:
    """Return the map of a file in one of the folders; raises `ValueError`."""
    for folder in folders:
        if (folder / name).is_file():
            return _load(folder / name)
    raise ValueError(f"map {name} is in no folder of: {', '.join(map(str, folders)) or 'none'}. Name its folder")


@cache
def _load(file: Path) -> StaticMap:
    try:
        return load_map(file)
    except MapFileError as error:
        raise ValueError(str(error)) from error


def build_world(world: HuntWorld, folders: Sequence[Path] = ()) -> Built:
    """Return a world's floor; its map is in one of the folders. Raises `ValueError`."""
    return build(world, load_recorded(world.map, folders) if world.map else None)


def hunt(world: HuntWorld, folders: Sequence[Path] = ()) -> Hunted:
    """Drive a world to its end, or to its first broken rule and a few seconds more; the same for the same world."""
    built = build_world(world, folders)
    mission = RobotGoal(goal_id="hunt", pose=Pose(x=world.goal[0], y=world.goal[1], theta=0.0))
    site = LoadedSite(built.site, built.map, Path())
    hazard = HazardSchedule.of(site, world.seed) if world.demo else None
    run = LockstepDrive(
        site, built.site.robots[0].start, mission, world.seed,
        world.sensors.noise(), watched=True, hazard=hazard, bus=None, ground=built.floor,
        mounted=world.mounted(),
    )  # fmt: skip
    if world.quirks:
        base = run.robot.hardware.base
        if not isinstance(base, QuirkyBase):
            raise ValueError(f"{world.title}: no quirks of a {world.base} are known: leave them out")
        base.set_quirks(**world.quirks)
    oracle = Oracle(
        watching.World(
            radius=world.radius,
            to_map=lambda x, y, theta: (*to_map(world, x, y), theta),
            tolerance_m=0.10 + world.resolution + 0.5 * world.warp_m,
            pose_floor_m=0.06 + world.resolution + world.warp_m,
            gain=max(1.0, *world.sensors.gain) * (1.0 + 3.0 * world.sensors.wander),
            late_s=_BUSY_S if world.busy else 0.0,
            wrong_s=_wrong_s(world.garbled),
            ahead_s=lambda: run.robot.clock.ahead(run.now),
        ),
        STAMP,
    )
    run.system.bus.subscribe(oracle.handlers())
    run.robot.process.observe = lambda publications, at: oracle.on_robot(publications, at.now)
    outcome = _drive(world, run, oracle, mission)
    found = Hunted(
        title=world.title,
        outcome=outcome.kind,
        reason=outcome.reason,
        simulated_s=round(run.now, 2),
        violations=oracle.violations,
        figures=oracle.figures.rounded(),
    )
    release_drives()
    return found


def _wrong_s(garbled: float) -> float:
    """Return for how long wheels may do what arrived wrong, if this share of bytes does: once in 1,000 times longer."""
    if garbled == 0.0:
        return 0.0
    return _SETTLED_S + _REPEATED_S * math.log(_UNLUCKY) / math.log(1.0 - (1.0 - garbled) ** 5)


class _WatchedStage(Stage):
    """Tells the oracle."""

    def __init__(self, run: LockstepDrive, world: HuntWorld, oracle: Oracle) -> None:
        super().__init__(run, world.events, world.seed)
        self._oracle = oracle
        self._over_cliff = self._fallen = False

    def step(self) -> None:
        super().step()
        world = self._run.world
        if world.over_cliff is not self._over_cliff:
            self._over_cliff = world.over_cliff
            self.on_lost("floor", lost=self._over_cliff)
        if world.fallen and not self._fallen:
            self._fallen = True
            self._oracle.on_fallen(self._run.now)

    def on_lost(self, source: Source, *, lost: bool) -> None:
        (self._oracle.on_lost if lost else self._oracle.on_restored)(source, self._run.now)

    def on_acknowledged(self, zone: Zone) -> None:
        self._oracle.on_acknowledged(zone, self._run.now)

    def on_obstacle(self, area: str, *, stands: bool) -> None:
        if stands:
            self._oracle.on_obstacle(area, self._run.now)
        else:
            self._oracle.on_obstacle_gone(area)


class _Helper:
    """An operator who does what a robot's reasons ask for, beside enabling it: some commands are refused."""

    def __init__(self, world: HuntWorld, now: float) -> None:
        self._world = world
        self._next = now
        self._asked = itertools.cycle(_FIND_POSE)

    def help(self, run: LockstepDrive) -> None:
        """Give a command, at most one in a while."""
        if run.state is None or run.now < self._next:
            return
        codes, pose = run.state.codes, None
        if "pose_lost" in codes:
            kind = next(self._asked)
            x, y, theta = run.world.pose
            map_x, map_y = to_map(self._world, x, y)
            pose = Pose(x=map_x, y=map_y, theta=theta) if kind == "initial_pose" else None
        elif "in_blocked" in codes and run.state.mode in {"INIT", "PROTECTIVE_STOP"}:
            kind = "egress"
        else:
            return
        self._next = run.now + _HELP_S
        reply = run.robot.command(kind, pose)
        run.log_event(f"operator: {kind}: {reply.reason or 'accepted'}")


def _drive(world: HuntWorld, run: LockstepDrive, oracle: Oracle, mission: RobotGoal) -> DriveOutcome:
    problem = run.warm_up()
    drive = run.start()
    if problem is not None:
        return DriveOutcome("stopped", problem)
    stage = _WatchedStage(run, world, oracle)
    run.system.fog.planner.set_goal(run.robot.id, mission, any_heading=True)
    until, helper = math.inf, _Helper(world, run.now)
    outcome, closed = None, False
    while outcome is None and stage.elapsed < min(world.seconds, until):
        stage.step()
        with suppress(BarrierError):  # no area can be closed on this path, and the drive goes on without
            run.step()
        if drive.blocked_at_m is not None and drive.hazard is not None and not closed:
            assert drive.hazard.planned is not None
            closed = True
            oracle.on_barrier(drive.hazard.planned.area.polygon, run.now)
        helper.help(run)
        outcome = drive.outcome(run.now)
        if oracle.violations and until == math.inf:
            until = stage.elapsed + _AFTER_S
    return outcome or DriveOutcome("stopped", f"ended after {stage.elapsed:.0f} s")
