"""Runs the drives of the comparison that are not recorded yet, several at a time; may be killed at any moment.

They are of the thesis's few routes, or drawn at random over a floor: two stops, uniform over the floor on which the
robot can stand, with a way of some length between them; in three of four draws one of the watched areas that this way
crosses, else any of the site's; and, in half of them, a moment under way, uniform over its length. Left out is only
what is no drive: stops that no way leads between, and obstacles that leave none. So every run is a situation of its
own. Of areas anywhere one in twelve stood in the way on `estig`.
"""

from __future__ import annotations

import hashlib
import math
import os
import random
import time
import tomllib
from datetime import UTC, datetime
from functools import cache, partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from fog_contracts.bus import Bus
from fog_contracts.messages import Place
from fog_contracts.stages import TOTAL
from fog_runtime.configuration.robot_file import ROBOT_FILE, load_robot
from fog_runtime.configuration.site import load_site
from fognav_experiments.comparison.drives import (
    ALONE,
    PROFILE_OF_SETUP,
    UNDER_WAY_M,
    ExperimentSpec,
    RouteDraw,
    RouteSpec,
    TimelineRecorder,
    draw,
    drive_name,
    ends_of,
    facts,
    start_of,
)
from fognav_experiments.comparison.limits import RouteGeometry
from fognav_experiments.comparison.records import Asked, Folder, FolderError, Record, loaded_alike
from fognav_experiments.lockstep import release_drives, run_lockstep
from fognav_experiments.machine import CpuMeter, on_one_core, results
from fognav_sim.barrier import BarrierError, barrier_across
from fognav_sim.drive.hazard import HazardRequest, entry_distance, path_length

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from fog_runtime.configuration.robot_file import RobotFile
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import Setup, When
    from fognav_experiments.comparison.records import Draws
    from fognav_sim.drive.hazard import SiteWithMap

STOPS: Final = ("p1", "p2")
"""Names of the stops that were drawn; they are no places of the site."""
ROUTE_M: Final = 20.0
"""Least way between two stops; on a small floor a third of its diagonal."""
CROSSED: Final = 0.75
"""Share of the draws whose area lies on the shortest way, where one does."""
_MOST_COST: Final = 128
"""Inflated cost below which a stop lies: a robot that stands there has walls at some distance."""
_ATTEMPTS: Final = 300


class FloorDrawError(ValueError):
    """A floor on which nothing can be drawn; the message says what is missing."""


class FloorDraws:
    """Draws the runs of one floor."""

    def __init__(self, site: SiteWithMap) -> None:
        """Prepare a floor; raises `FloorDrawError` for one without watched areas."""
        self._site = site
        if not site.site.areas:
            raise FloorDrawError(f"site {site.site.id} has no watched areas: nothing can be blocked there")
        self._geometry = RouteGeometry(site)
        grid = site.map.geometry
        cells = np.argwhere(self._geometry.open_cost < _MOST_COST)[:, ::-1] + 0.5
        self._floor = cells * grid.resolution + (grid.origin_x, grid.origin_y)
        west, south, east, north = grid.bounds
        self._least_m = min(ROUTE_M, math.hypot(east - west, north - south) / 3.0)

    def draw(self, seed: int, run: int) -> list[RouteDraw]:
        """Return the one route of a run, the same whenever it is drawn; raises `FloorDrawError` if none is found."""
        generator = random.Random(f"floor {seed} {run}")  # noqa: S311  # repeatable, not a secret
        areas = [area.id for area in self._site.site.areas]
        for _ in range(_ATTEMPTS):
            start, goal = self._stop(generator), self._stop(generator)
            way = self._geometry.way(start, goal)
            if way is None or (length := path_length(way)) < self._least_m:
                continue
            crossed = [area.id for area in self._site.site.areas if entry_distance(way, area.polygon) is not None]
            on_way = generator.random() < CROSSED
            moment: When = generator.choice(("before", "under way"))
            late = generator.uniform(min(UNDER_WAY_M[0], length), length)
            drawn = RouteDraw(
                run=run,
                route=RouteSpec(start=STOPS[0], goal=STOPS[1], areas=areas),
                seed=generator.randrange(2**31),
                theta=generator.uniform(-math.pi, math.pi),
                area=generator.choice(crossed if on_way and crossed else areas),
                moment=moment,
                trigger_m=0.0 if moment == "before" else round(late, 2),
                ends=(start, goal),
            )
            if self._can_be_driven(drawn):
                return [drawn]
        raise FloorDrawError(
            f"on the floor of site {self._site.site.id} no two stops {self._least_m:.0f} m apart were found between "
            f"which a way is left when an area is blocked ({_ATTEMPTS} draws of run {run}): draw on a larger floor"
        )

    def _stop(self, generator: random.Random) -> Place:
        x, y = self._floor[generator.randrange(len(self._floor))]
        return Place(x=round(float(x), 3), y=round(float(y), 3))

    def _can_be_driven(self, drawn: RouteDraw) -> bool:
        try:
            return self._geometry.saving(drawn) is not None
        except BarrierError:
            return False


def drive(  # what is driven, by what, and what is only recorded
    site: LoadedSite,
    drawn: RouteDraw,
    setup: Setup,
    jobs: int = 1,
    commit: str = "",
    mounted: RobotFile | None = None,
) -> Record:
    """Drive a drawn route in a setup; the same but for CPU and wall time whenever it is repeated.

    `jobs` (drives that run at the same time on this machine) and `commit` are only recorded. `mounted`: the robot's
    settings, by default the thesis's. Raises `BarrierError` for an area that no barrier closes.
    """
    cpu, bus = CpuMeter(), Bus(site.site.id)
    recorder = TimelineRecorder(bus, setup)
    begun = time.perf_counter()
    result = run_lockstep(
        site,
        start_of(site, drawn),
        ends_of(site, drawn)[1],
        drawn.seed,
        HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m),
        watched=setup not in ALONE,
        profile=PROFILE_OF_SETUP[setup],
        cpu=cpu,
        bus=bus,
        mounted=mounted,
    )
    appears = (event.time_s for event in result.events if event.description.startswith("barrier appears"))
    total = result.stages_ms.get(TOTAL)
    return msgspec.convert(
        facts(Record, drawn, setup, result)
        | {
            "reaction_s": None if total is None else total / 1000.0,
            "cpu_s": {name: round(seconds, 4) for name, seconds in sorted(cpu.seconds.items())},
            "ready": True,
            "jobs": jobs,
            "load": round(os.getloadavg()[0], 2),
            "wall_s": round(time.perf_counter() - begun, 1),
            "version": version("fognav-experiments"),
            "commit": commit,
            "timeline": None if result.time_s is None else recorder.timeline(result.time_s, next(appears, None)),
        },
        Record,
    )


SPEC_FILE = "experiment.toml"
_RUNS_TO_SEARCH = 50


class SpecError(ValueError):
    """A site has no experiment, or an invalid one; the message names file and remedy."""


class Task(NamedTuple):
    """A drive to run."""

    drawn: RouteDraw
    setup: Setup

    @property
    def name(self) -> str:
        """Name of its record."""
        return drive_name(self.drawn.run, self.drawn.route.name, self.setup)


def read_spec(site: LoadedSite, folder: Path) -> ExperimentSpec:
    """Return the experiment of a site; raises `SpecError`."""
    file = folder / SPEC_FILE
    try:
        spec = msgspec.convert(tomllib.loads(file.read_text("utf-8")), ExperimentSpec)
    except FileNotFoundError as error:
        raise SpecError(f"{file} does not exist. Write [[routes]] with start, goal and areas into it") from error
    except (OSError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise SpecError(f"{file}: {error}. Correct it") from error
    if problems := spec.problems(site.site):
        raise SpecError(f"{file}: the site has no {', no '.join(problems)}. Correct it, or add them to site.toml")
    return spec


def site_digest(folder: Path) -> str:
    """Return a hash of a site's files: drives on another floor are no part of the same experiment."""
    digest = hashlib.sha256()
    for file in sorted(folder.iterdir()):
        if file.suffix in {".toml", ".yaml", ".pgm", ".png"}:
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]


def drawer(site: LoadedSite, folder: Path, asked: Asked) -> Callable[[int], list[RouteDraw]]:
    """Return what draws the routes of a run of the experiment that is asked for, by its number.

    Raises `SpecError` for a site without such an experiment; so does what is returned.
    """
    if asked.draws == "thesis":
        return partial(draw, read_spec(site, folder), asked.seed)
    try:
        on_floor = FloorDraws(site)
    except FloorDrawError as error:
        raise SpecError(str(error)) from error

    def drawn(run: int) -> list[RouteDraw]:
        try:
            return on_floor.draw(asked.seed, run)
        except FloorDrawError as error:
            raise SpecError(str(error)) from error

    return drawn


def tasks(draws: Callable[[int], list[RouteDraw]], runs: Sequence[int], setups: Sequence[Setup]) -> list[Task]:
    """Return the drives of these runs, all setups of a route one after another: what is there is always comparable."""
    return [Task(drawn, setup) for run in runs for drawn in draws(run) for setup in setups]


def check_barriers(site: LoadedSite, asked: Sequence[Task]) -> None:
    """Raise `SpecError` for a drawn area that no barrier closes, before the first of many drives is begun."""
    for drawn in {(task.drawn.run, task.drawn.route.name): task.drawn for task in asked}.values():
        area = next(area for area in site.site.areas if area.id == drawn.area)
        try:
            barrier_across(area, site.site, site.map, drawn.seed)
        except BarrierError as error:
            name = f"{SPEC_FILE}: run {drawn.run}, route {drawn.route.name}"
            raise SpecError(f"{name}: {error}, or change its polygon in site.toml") from error


def run(  # what is driven, where to, and how
    site_folder: Path,
    asked: list[Task],
    folder: Folder,
    jobs: int = 1,
    commit: str = "",
    robot_file: Path | None = None,
) -> Iterator[Record]:
    """Run the tasks that have no record yet, and yield each record once it is written; `commit` is only recorded.

    Those of the same run and route are driven one after another on one core, and again if the machine was loaded
    otherwise during one of them: their CPU times could not be compared. So each of these sittings is recorded as a
    whole, or not at all.
    """
    due: dict[tuple[int, str], list[Task]] = {}
    for task in asked:
        if not folder.drives.has(task.name):
            due.setdefault((task.drawn.run, task.drawn.route.name), []).append(task)
    for records in results(partial(_drive_together, site_folder, jobs, commit, robot_file), due.values(), jobs):
        for record in records:
            folder.drives.write(record)
        yield from records


def new(
    site: LoadedSite, site_folder: Path, seed: int, draws: Draws = "thesis", robot_file: Path | None = None
) -> Asked:
    """Return what a new folder of this experiment is about; raises `SettingsError` for a robot file."""
    robot = ""
    if robot_file is not None:
        settings = load_robot({ROBOT_FILE: str(robot_file)}).settings
        digest = hashlib.sha256(msgspec.json.encode(settings)).hexdigest()[:8]
        robot = f"{settings.base.driver}, {settings.lidar.driver} ({digest})"
    return Asked(site=site.site.id, site_digest=site_digest(site_folder), seed=seed, draws=draws, robot=robot)


def barred_routes(site: LoadedSite, spec: ExperimentSpec, seed: int, count: int) -> list[RouteDraw]:
    """Return the first drawn routes whose obstacle bars the shortest way; raises `SpecError` if there are too few."""
    geometry = RouteGeometry(site)
    found: list[RouteDraw] = []
    for drawn in (route for run in range(1, _RUNS_TO_SEARCH + 1) for route in draw(spec, seed, run)):
        saving = geometry.saving(drawn)
        if saving is not None and saving.met:
            found.append(drawn)
            if len(found) == count:
                return found
    raise SpecError(f"of {_RUNS_TO_SEARCH} runs only {len(found)} routes are barred by their obstacle: ask for fewer")


def recorded_draw(folder: Folder, site: LoadedSite, place: Path, run: int, route: str | None) -> RouteDraw:
    """Return how a recorded run drew a route, by default its first one.

    Raises `FolderError` for another floor than that of the records, and `SpecError`.
    """
    asked = msgspec.convert(folder.description()["asked"], Asked)
    if asked.site_digest != site_digest(place):
        raise FolderError(f"{folder.path} holds drives on another floor than {place}: name theirs with --site")
    drawn = {found.route.name: found for found in drawer(site, place, asked)(run)}
    if route is not None and route not in drawn:
        raise SpecError(f"no route {route}: there are {', '.join(drawn)}")
    return drawn[route] if route is not None else next(iter(drawn.values()))


SITTINGS: Final = 3
"""How often drives that belong together are made at most until the machine was loaded alike during all of them."""


def _drive_together(
    site_folder: Path, jobs: int, commit: str, robot_file: Path | None, asked: Sequence[Task]
) -> list[Record]:
    records: list[Record] = []
    with on_one_core() as core:
        for _ in range(SITTINGS):
            sitting = datetime.now(UTC).isoformat(timespec="seconds")
            records = [
                msgspec.structs.replace(_drive(site_folder, jobs, commit, robot_file, task), core=core, sitting=sitting)
                for task in asked
            ]
            if loaded_alike(records):
                break
    return records


def _drive(site_folder: Path, jobs: int, commit: str, robot_file: Path | None, task: Task) -> Record:
    mounted = None if robot_file is None else load_robot({ROBOT_FILE: str(robot_file)})
    record = drive(_site(site_folder), task.drawn, task.setup, jobs, commit, mounted)
    release_drives()
    return record


@cache
def _site(folder: Path) -> LoadedSite:
    return load_site(folder)
