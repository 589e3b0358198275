"""People who walk through beams and paths: what nodes report of them, and what they cost a robot.

The same routes are driven among more and more people (`fognav_sim.people`), by a robot that the fog leads and by one on
its own, in lockstep. People are the same at the start, and then react to the robot, so that drives of one seed differ.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from fog_contracts.cones import sonar_cones
from fog_contracts.geometry import contains_point, distance_to_polygon
from fog_contracts.messages import ReasonCode
from fognav_experiments.comparison.drives import ALONE, PROFILE_OF_SETUP, DrivenRoute, draw, ends_of, start_of
from fognav_experiments.lockstep import ready, release_drives
from fognav_experiments.machine import results
from fognav_sim.drive.drive import DriveOutcome
from fognav_sim.hardware import STEP_S
from fognav_sim.people import BODY_M, People
from fognav_sim.people import STEP_S as PEOPLE_S

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import ExperimentSpec, RouteDraw, Setup
    from fognav_experiments.comparison.records import DriveFiles
    from fognav_experiments.lockstep import LockstepDrive
    from planner.waits.blocks import BlockRecord

_SEED_OF_EARLIER: Final = 1_000_003
"""What is added to the seed of a drive for the one before it, which has other people."""
KINDS: Final[tuple[tuple[Setup, bool], ...]] = (("fog", False), ("fog", True), ("lean", False))
"""A robot that the fog leads, the same whose planner has learned for how long blocks last, and the control: one on its
own at the same rates."""
ARCHIVE: Final = "people.jsonl.xz"
"""All records: drives go on from it."""
MISSED_S: Final = 2.0
"""Who stands in an area for longer than this should be reported: confirming takes up to about half a second."""
EGRESS_S: Final = 5.0
"""After this long in a blocked area an operator who sees it lets the robot out."""
_REPORTED_S: Final = 1.0
"""Of somebody who has gone a node may still report for so long."""
_OBSERVED_STEPS: Final = 10
_MOVES_M_S: Final = 0.02


class Episodes(msgspec.Struct, kw_only=True):
    """What nodes reported of people, over all areas of a drive.

    `blocks`: how often an area became blocked; `passing`: by people of whom none stood there meanwhile; `empty`: with
    nobody in the area at all. `passing_s`: how long (s) areas were blocked by these two. `stood`: how often somebody
    stood in an area for `MISSED_S`; `missed`: of these, those during whom it was never blocked; `stood_seen`,
    `missed_seen`: the same of those who stood in a cone of its node. `passed`: how often somebody walked through a
    cone; `passed_reported`: of these, those during whom or within 1 s the area was blocked.
    """

    blocks: int = 0
    passing: int = 0
    empty: int = 0
    passing_s: float = 0.0
    stood: int = 0
    missed: int = 0
    stood_seen: int = 0
    missed_seen: int = 0
    passed: int = 0
    passed_reported: int = 0


class PeopleDrive(DrivenRoute, frozen=True, kw_only=True):
    """One drive among people.

    `people`: how many are on the floor. `closest_m`: least distance between the robot's rim and a person, and
    `closest_moving_m` while the robot moved. `contacts`: of the robot with anybody or anything, as far as it drove into
    them. `stood_s`: how long (s) it stood on its way. `modes`: how often it entered each mode, `modes_s`: for how long
    (s). `stops`: its protective stops and faults; `egresses`: how often an operator let it out of a blocked area.
    `learned`: its planner has seen the blocks of the same drive among other people before.
    """

    people: int
    learned: bool = False
    reason: str
    closest_m: float | None
    closest_moving_m: float | None
    contacts: int
    min_clearance_m: float | None
    stood_s: float
    paths: int
    route_areas: list[str]
    modes: dict[str, int]
    modes_s: dict[str, float]
    stops: list[str]
    operator_commands: int
    egresses: int
    episodes: Episodes

    @property
    def name(self) -> str:
        """Name of the record's file, without suffix."""
        return PeopleTask.named(self.run, self.route, self.setup, self.people, learned=self.learned)


class PeopleTask(NamedTuple):
    """A drive to run."""

    drawn: RouteDraw
    setup: Setup
    people: int
    learned: bool = False

    @property
    def name(self) -> str:
        """Name of its record."""
        return self.named(self.drawn.run, self.drawn.route.name, self.setup, self.people, learned=self.learned)

    @staticmethod
    def named(run: int, route: str, setup: str, people: int, *, learned: bool) -> str:
        """Return the name of a drive's record."""
        return f"{run:04}-{route}-{setup}{'-learned' * learned}-{people:02}"


def people_tasks(spec: ExperimentSpec, seed: int, runs: int, counts: Sequence[int]) -> list[PeopleTask]:
    """Return the drives, run by run: each is of the site's first route, with a heading and noise of its own."""
    drawn = [draw(spec, seed, run)[0] for run in range(1, runs + 1)]
    return [
        PeopleTask(route, setup, count, learned)
        for route in drawn
        for count in counts
        for setup, learned in KINDS
        if count or not learned
    ]


@dataclass
class _Block:
    """An area is blocked: since when (s), and whether somebody was there meanwhile, and stood there."""

    since: float
    occupied: bool
    stood: bool


@dataclass
class _Stay:
    """Somebody stands in an area or walks through a cone: since and until when (s), reported, and seen by a cone."""

    since: float
    until: float
    reported: bool = False
    seen: bool = False


class _Observer:
    """Compares what nodes report with who is there."""

    def __init__(self, site: LoadedSite) -> None:
        cones = sonar_cones(site.site.nodes, site.map)
        self._areas = {area.id: area.polygon for area in site.site.areas}
        self._cones = {
            area: [cone for node in site.site.nodes if node.area == area for cone in cones[node.id]]
            for area in self._areas
        }
        self._found = Episodes()
        self._blocks: dict[str, _Block] = {}
        self._standing: dict[tuple[str, int], _Stay] = {}
        self._passing: dict[tuple[str, int], _Stay] = {}

    def observe(self, now: float, people: People, states: Mapping[str, str]) -> None:
        """Take note of who is where at `now` (s), and of the areas' states."""
        standing = people.standing
        for area, polygon in self._areas.items():
            blocked = states.get(area) == "blocked"
            there = {
                who: (float(x), float(y))
                for who, (x, y) in enumerate(people.places)
                if distance_to_polygon(polygon, float(x), float(y)) <= BODY_M
            }
            for who, at in there.items():
                seen = any(distance_to_polygon(cone, *at) <= BODY_M for cone in self._cones[area])
                if standing[who] and contains_point(polygon, *at):
                    self._standing.setdefault((area, who), _Stay(now, now)).until = now
                    self._standing[area, who].seen |= seen
                elif seen and not standing[who]:
                    self._passing.setdefault((area, who), _Stay(now, now)).until = now
            if blocked:
                block = self._blocks.setdefault(area, _Block(now, occupied=False, stood=False))
                block.occupied |= bool(there)
                block.stood |= any(standing[who] for who in there)
                for stays in (self._standing, self._passing):
                    for (where, _), stay in stays.items():
                        stay.reported |= where == area
            elif area in self._blocks:
                self._end_block(area, now)
        self._end_stays(now)

    def end(self, now: float) -> Episodes:
        """Return what was found, with what lasts until now."""
        for area in list(self._blocks):
            self._end_block(area, now)
        self._end_stays(math.inf)
        self._found.passing_s = round(self._found.passing_s, 2)
        return self._found

    def _end_block(self, area: str, now: float) -> None:
        block = self._blocks.pop(area)
        self._found.blocks += 1
        if not block.stood:
            self._found.passing += block.occupied
            self._found.empty += not block.occupied
            self._found.passing_s += now - block.since

    def _end_stays(self, now: float) -> None:
        """Count those who went away; a node may report them for `_REPORTED_S` more."""
        found = self._found
        for key in [key for key, stay in self._standing.items() if now - stay.until > _REPORTED_S]:
            stay = self._standing.pop(key)
            if stay.until - stay.since >= MISSED_S:
                found.stood += 1
                found.missed += not stay.reported
                found.stood_seen += stay.seen
                found.missed_seen += stay.seen and not stay.reported
        for key in [key for key, stay in self._passing.items() if now - stay.until > _REPORTED_S]:
            found.passed += 1
            found.passed_reported += self._passing.pop(key).reported


def people_drives(
    site: LoadedSite, asked: Sequence[PeopleTask], files: DriveFiles[PeopleDrive], jobs: int, commit: str = ""
) -> Iterator[PeopleDrive]:
    """Run the drives that have no record yet, so many at a time, and yield each record once it is written.

    `commit` is only recorded.
    """
    due = [task for task in asked if not files.has(task.name)]
    for drive in results(partial(people_drive, site, commit), due, jobs):
        files.write(drive)
        yield drive


def people_drive(site: LoadedSite, commit: str, task: PeopleTask) -> PeopleDrive:
    """Drive one task in lockstep; the same whenever it is repeated."""
    learned: dict[str, BlockRecord] = {}
    if task.learned:
        earlier = msgspec.structs.replace(task.drawn, seed=task.drawn.seed + _SEED_OF_EARLIER)
        _, run = _driven(site, task._replace(drawn=earlier), commit, {})
        records = run.system.fog.planner.core.waits.blocks.to_store(run.now)
        learned = {area: msgspec.structs.replace(record, standing=None) for area, record in records.items()}
        release_drives()
    drive, _ = _driven(site, task, commit, learned)
    release_drives()
    return drive


def _driven(
    site: LoadedSite, task: PeopleTask, commit: str, learned: Mapping[str, BlockRecord]
) -> tuple[PeopleDrive, LockstepDrive]:
    """Drive a task with a planner that knows how long blocks lasted; return the drive, and what drove."""
    drawn = task.drawn
    run = ready(
        site,
        start_of(site, drawn),
        ends_of(site, drawn)[1],
        drawn.seed,
        watched=task.setup not in ALONE,
        profile=PROFILE_OF_SETUP[task.setup],
    )
    drive = run.drive
    assert drive is not None
    outcome = None if run.problem is None else DriveOutcome("stopped", run.problem)
    run.system.fog.planner.core.waits.blocks.restore(learned, run.now)
    among = _Among(site, run, task)
    while outcome is None:
        among.step()
        outcome = drive.outcome(run.now)
    result = run.result(drive, outcome)
    told_by_drive = (
        "reason", "success", "outcome", "distance_m", "time_s", "contacts", "min_clearance_m", "paths", "route_areas",
        "modes", "stops", "operator_commands",
    )  # fmt: skip
    told_of = PeopleDrive(
        **{name: getattr(result, name) for name in told_by_drive},
        setup=task.setup,
        run=drawn.run,
        route=drawn.route.name,
        seed=drawn.seed,
        area="",
        people=task.people,
        learned=task.learned,
        closest_m=_finite(among.closest_m),
        closest_moving_m=_finite(among.closest_moving_m),
        stood_s=round(among.stood_s, 2),
        modes_s={mode: round(count * STEP_S, 2) for mode, count in sorted(among.modes.items())},
        egresses=among.egresses,
        episodes=among.observer.end(run.now),
        commit=commit,
        version=version("fognav-experiments"),
    )
    return told_of, run


class _Among:
    """A drive among people, step by step."""

    def __init__(self, site: LoadedSite, run: LockstepDrive, task: PeopleTask) -> None:
        x, y, _ = run.world.pose
        self.people = People(site.map, task.people, task.drawn.seed, (x, y))
        self.people.begin(run.world)
        self.observer = _Observer(site)
        self.closest_m = self.closest_moving_m = math.inf
        self.stood_s = 0.0
        self.modes: Counter[str] = Counter()
        self.egresses = 0
        self._run = run
        self._steps = 0
        self._shut_in_since: float | None = None
        self._distance_m = run.world.distance

    def step(self) -> None:
        """Simulate 10 ms."""
        run = self._run
        if self._steps % round(PEOPLE_S / STEP_S) == 0:
            self.people.walk(run.world)
        run.step()
        self.modes[run.robot.agent.safety.mode] += 1
        self._steps += 1
        if self._steps % _OBSERVED_STEPS == 0:
            self._observe()

    def _observe(self) -> None:
        run, world = self._run, self._run.world
        moved, self._distance_m = world.distance - self._distance_m, world.distance
        moves = moved > _MOVES_M_S * _OBSERVED_STEPS * STEP_S
        self.stood_s += 0.0 if moves else _OBSERVED_STEPS * STEP_S
        if len(self.people.places):
            away = np.hypot(*(self.people.places - world.pose[:2]).T).min() - world.robot.radius - BODY_M
            self.closest_m = min(self.closest_m, float(away))
            if moves:
                self.closest_moving_m = min(self.closest_moving_m, float(away))
        self.observer.observe(run.now, self.people, run.hazards)
        self._let_out()

    def _let_out(self) -> None:
        """Let the operator, who sees that people are gone, lead a robot out of a blocked area that it is shut in."""
        run = self._run
        state = run.state
        if state is None or state.mode != "PROTECTIVE_STOP" or ReasonCode.IN_BLOCKED not in state.codes:
            self._shut_in_since = None
        elif self._shut_in_since is None:
            self._shut_in_since = run.now
        elif run.now - self._shut_in_since > EGRESS_S:
            self._shut_in_since = None
            if run.robot.command("egress").accepted:
                self.egresses += 1
                run.log_event("operator: egress")


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
