"""What is driven and what a record says of it: draws, the fields of all records, and how a drive is evaluated. Pure.

Draws depend on seed and run alone, so that every setup meets the same obstacles. A drive of a real robot, with barriers
that a person places, is evaluated by what the robot itself reports; a timeline keeps what a film shows.
"""

from __future__ import annotations

import math
import random
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from fog_contracts import channels as ch
from fog_contracts.messages import (
    Id,  # read at run time, when a file is decoded
    Place,
    Pose,
    ProfileName,
    SimTruth,
)
from fognav_sim.drive.drive import Drive, DriveOutcome
from fognav_sim.drive.hazard import HazardRequest, HazardSchedule

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.bus import Bus
    from fog_contracts.handlers import Ids, Moment, Publication
    from fog_contracts.messages import HazardArea, RobotPath, RobotPose, RobotState
    from fog_contracts.site import Site
    from fognav_sim.drive.drive import DriveSummary
    from fognav_sim.drive.hazard import PlannedHazard, SiteWithMap


UNDER_WAY_M: Final = (3.0, 25.0)
"""Range of the distance that the robot has driven when the obstacle appears, in the runs in which it does so late."""

When = Literal["before", "under way"]
Setup = Literal["default", "lean", "full", "fog"]
PROFILE_OF_SETUP: Final[dict[Setup, ProfileName]] = {"default": "default", "lean": "full", "full": "full", "fog": "fog"}
"""Setups, and the profile by which the robot drives in each."""
ALONE: Final[frozenset[Setup]] = frozenset({"default", "lean"})
"""Setups in which no sensor node tells the robot of an obstacle; `lean` has the rates of `full`."""


class RouteSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A route between two places, and the watched areas one of which is blocked on it."""

    start: Id
    goal: Id
    areas: Annotated[list[Id], Meta(min_length=1)]

    @property
    def name(self) -> str:
        """The route's name in files and tables."""
        return f"{self.start}{self.goal}"


class ExperimentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A site's experiment (`experiment.toml` beside `site.toml`)."""

    routes: Annotated[list[RouteSpec], Meta(min_length=1)]

    def problems(self, site: Site) -> list[str]:
        """Return what the site lacks for this experiment."""
        areas = {area.id for area in site.areas}
        missing = [f"place {name}" for route in self.routes for name in (route.start, route.goal)]
        missing = [text for text in missing if text.removeprefix("place ") not in site.places]
        return missing + [f"area {name}" for route in self.routes for name in route.areas if name not in areas]


class RouteDraw(msgspec.Struct, frozen=True, kw_only=True):
    """One route of one run: the robot's heading at its start (rad), the blocked area, and when it becomes blocked.

    `trigger_m`: distance (m) that the robot has driven then; 0 is before the start. `seed`: of noise and obstacle.
    `ends`: start and goal that were drawn, too; without them the route's are places of the site.
    """

    run: int
    route: RouteSpec
    seed: int
    theta: float
    area: Id
    moment: When
    trigger_m: float
    ends: tuple[Place, Place] | None = None


def draw(spec: ExperimentSpec, seed: int, run: int) -> list[RouteDraw]:
    """Return the routes of a run, numbered from 1."""
    generator = random.Random(f"{seed} {run}")  # noqa: S311  # repeatable, not a secret
    draws = []
    for route in spec.routes:
        moment: When = generator.choice(("before", "under way"))
        late = generator.uniform(*UNDER_WAY_M)
        draws.append(
            RouteDraw(
                run=run,
                route=route,
                seed=generator.randrange(2**31),
                theta=generator.uniform(-math.pi, math.pi),
                area=generator.choice(route.areas),
                moment=moment,
                trigger_m=0.0 if moment == "before" else round(late, 2),
            )
        )
    return draws


class DrivenRoute(msgspec.Struct, frozen=True, kw_only=True):
    """A drawn route that a setup drove; lengths in m, times in s of the system's clock.

    `area`: what was blocked. `version`, `commit`: of the program; the latter is empty where it is not known, or is the
    one that the folder was begun with.
    """

    setup: Setup
    run: int
    route: str
    seed: int
    area: str
    outcome: str
    success: bool
    distance_m: float
    time_s: float | None
    version: str = ""
    commit: str = ""


class ComparedDrive(DrivenRoute, frozen=True, kw_only=True):
    """One drive of a comparison of setups.

    `moment`, `trigger_m`: when the area was to be blocked, by the distance driven. `paths`: paths that the robot
    followed; `modes`: how often it entered each of its modes; `stops`: its protective stops and faults; `route_areas`:
    the watched areas that it crossed, in order. `load`: the machine's load average at the end. `ends`: start and goal
    (m), where these were drawn and are no places of the site.
    """

    moment: str
    trigger_m: float
    reason: str
    paths: int
    stops: list[str]
    route_areas: list[str]
    modes: dict[str, int] = {}
    min_clearance_m: float | None = None
    load: float = 0.0
    ends: tuple[tuple[float, float], tuple[float, float]] | msgspec.UnsetType = msgspec.UNSET

    @property
    def situation(self) -> tuple[str, ...]:
        """What drives have in common that meet the same obstacle on the same route, and so repeat one another."""
        return (self.route, self.area) if self.ends is msgspec.UNSET else (self.route, str(self.run))


def facts(kind: type[ComparedDrive], drawn: RouteDraw, setup: Setup, summary: DriveSummary) -> dict[str, Any]:
    """Return the fields of a record of this `kind` that the draw and a drive's summary tell."""
    told = {name: getattr(summary, name) for name in kind.__struct_fields__ if name in summary.__struct_fields__}
    of_draw = {name: getattr(drawn, name) for name in ("run", "seed", "area", "moment", "trigger_m")}
    if drawn.ends is not None:
        of_draw["ends"] = tuple((end.x, end.y) for end in drawn.ends)
    return told | of_draw | {"route": drawn.route.name, "setup": setup}


def route_ends(name: str) -> str:
    """Return a route's two ends in words, by its name, which is both in one."""
    half = len(name) // 2
    return f"{name[:half].upper()} to {name[half:].upper()}"


def drive_name(run: int, route: str, setup: str, cpu_quota: float | None = None, speed: float = 1.0) -> str:
    """Return the name of a drive's record; without a quota and in real time the same as that in lockstep."""
    quota = "" if cpu_quota is None else f"-quota{cpu_quota:g}"
    return f"{run:04}-{route}-{setup}{quota}" + ("" if speed == 1.0 else f"-speed{speed:g}")


Kind = Literal["live", "hardware"]
KINDS: Final[tuple[Kind, ...]] = ("live", "hardware")
ROBOTS_PROCESSES: Final = ("robot-agent", "robot-guardian", "robot-watchdog")
"""The processes that run on the robot."""


ATTEMPT: Final = "-attempt"
"""What follows a drive's name where it was made again, because it had failed."""


class UsageSample(msgspec.Struct, frozen=True, kw_only=True):
    """What a robot's processes took since the sample before, `at` so many s of the drive.

    Share of a core (%) by process and thread, and resident memory (MB) by process.
    """

    at: float
    cpu_percent: dict[str, dict[str, float]]
    memory_mb: dict[str, float]


class MeasuredDrive(ComparedDrive, frozen=True, kw_only=True):
    """One drive by real processes, whose clock runs `speed` times as fast as real time.

    Distance and areas are those of the simulator's ground truth, with a real robot those of its own poses.
    `cpu_percent`: mean share (%) of one core that each process took, per second of the system's clock. `peak_mb`: its
    largest resident memory (MB), sampled once a second. `cpu_quota`: share of one core that the robot's processes had
    together; None without a limit. `asked_speed`: that of the command, from which `speed` differs where the machine
    could not sustain it. `attempt`: 1, or how many it took with those that failed before.
    `restarts`: processes that died. `barrier_at_m`: distance (m) driven when a person said that the barrier stands.
    `thread_percent`, `samples`: what the robot's exporter told, of threads and every 2 s.
    """

    kind: Kind
    plans: int
    cpu_percent: dict[str, float] = msgspec.field(default_factory=dict)
    peak_mb: dict[str, float] = msgspec.field(default_factory=dict)
    cpu_quota: float | None = None
    speed: float = 1.0
    asked_speed: float = 1.0
    restarts: int = 0
    barrier_at_m: float | None = None
    attempt: int = 1
    thread_percent: dict[str, dict[str, float]] | msgspec.UnsetType = msgspec.UNSET
    samples: list[UsageSample] | msgspec.UnsetType = msgspec.UNSET

    @property
    def name(self) -> str:
        """Name of the record's file, without suffix."""
        first = drive_name(self.run, self.route, self.setup, self.cpu_quota, self.asked_speed)
        return first if self.attempt == 1 else f"{first}{ATTEMPT}{self.attempt}"

    @property
    def in_lockstep(self) -> str | None:
        """Name of the drive in lockstep that it repeats; None under a quota, which lockstep does not have."""
        return drive_name(self.run, self.route, self.setup) if self.cpu_quota is None else None

    def robots_peak_mb(self) -> float | None:
        """Return the sum (MB) of the largest memories of the robot's processes; None if they were not measured."""
        return sum(self.peak_mb.get(name, 0.0) for name in ROBOTS_PROCESSES) if self.peak_mb else None


POSE_S: Final = 1.0
"""Time between two recorded positions."""


class Timeline(msgspec.Struct, frozen=True, kw_only=True):
    """Times in s from the goal on; positions in m, frame `map`.

    `poses`: true positions (time, x, y). `paths`: corners of the fog's paths, in the setup `fog` only. `areas`: states
    of the watched areas (time, id, whether blocked). `barrier_at`: when the obstacle appeared; None if it never did.
    """

    poses: list[tuple[float, float, float]]
    paths: list[tuple[float, list[tuple[float, float]]]]
    areas: list[tuple[float, str, bool]]
    barrier_at: float | None


class TimelineRecorder:
    """Listens to a drive's bus."""

    def __init__(self, bus: Bus, setup: Setup) -> None:
        self._poses: list[tuple[float, float, float]] = []
        self._paths: list[tuple[float, list[tuple[float, float]]]] = []
        self._areas: list[tuple[float, str, bool]] = []
        self._now = 0.0
        bus.subscribe({ch.SIM_TRUTH: self._on_truth, ch.HAZARD: self._on_hazard})
        if setup == "fog":
            bus.subscribe({ch.ROBOT_PATH: self._on_path})

    def timeline(self, time_s: float, barrier_at: float | None) -> Timeline:
        """Return what was recorded, for a drive that took so long and has just ended."""
        began = self._now - time_s
        return Timeline(
            poses=[(round(at - began, 2), x, y) for at, x, y in self._poses if at >= began],
            paths=[(round(at - began, 2), points) for at, points in self._paths],
            areas=[(round(at - began, 2), area, blocked) for at, area, blocked in self._areas],
            barrier_at=barrier_at,
        )

    def _on_truth(self, _ids: Ids, truth: SimTruth, at: Moment) -> Sequence[Publication]:
        self._now = at.now
        if not self._poses or at.now - self._poses[-1][0] >= POSE_S:
            self._poses.append((at.now, round(truth.x, 3), round(truth.y, 3)))
        return ()

    def _on_path(self, _ids: Ids, path: RobotPath, at: Moment) -> Sequence[Publication]:
        self._paths.append((at.now, [(round(x, 3), round(y, 3)) for x, y in path.points]))
        return ()

    def _on_hazard(self, ids: Ids, area: HazardArea, at: Moment) -> Sequence[Publication]:
        area_id, blocked = ids["area"], area.hazard.state == "blocked"
        known = next((state for _, name, state in reversed(self._areas) if name == area_id), None)
        if blocked != known:
            self._areas.append((at.now, area_id, blocked))
        return ()


COUNTED_M: Final = 0.1
"""Displacement from which on a robot has moved: its estimated pose wavers while it stands."""
START_M: Final = 0.5
"""How far from a route's start a robot may stand when it begins."""
START_RAD: Final = math.radians(20.0)
"""How far its heading may be from the route's."""


def ends_of(site: SiteWithMap, drawn: RouteDraw) -> tuple[Place, Place]:
    """Return where a drawn route begins and ends."""
    places = site.site.places
    return drawn.ends or (places[drawn.route.start], places[drawn.route.goal])


def start_of(site: SiteWithMap, drawn: RouteDraw) -> Pose:
    """Return the pose at which a drawn route begins."""
    place, _ = ends_of(site, drawn)
    return Pose(x=place.x, y=place.y, theta=drawn.theta if place.theta is None else place.theta)


def stands_at(pose: RobotPose | None, start: Pose) -> bool:
    """Whether a robot knows its place, and is near enough to the start, in its heading too."""
    if pose is None or not pose.localized:
        return False
    turned = abs(math.remainder(pose.theta - start.theta, math.tau))
    return math.hypot(pose.x - start.x, pose.y - start.y) <= START_M and turned <= START_RAD


def where_to_place(planned: PlannedHazard) -> str:
    """Return in words which barrier a person is to place, and where."""
    corners = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in planned.barrier.polygon)
    label = f" ({planned.area.label})" if planned.area.label else ""
    return f"area {planned.area.id}{label}: a barrier at least {planned.barrier.height:g} m high, corners at {corners}"


class GuidedDrive:
    """One drive of a drawn route, from the moment when the robot is given its goal: feed it what the robot publishes.

    Distance and areas are those of the robot's own poses; what it touched only a person can tell.
    """

    def __init__(
        self,
        site: SiteWithMap,
        drawn: RouteDraw,
        setup: Setup,
        *,
        goal_id: str,
        pose: RobotPose,
        now: float,
    ) -> None:
        """Begin at `now` (s) at this pose; raises `BarrierError` for an area that no barrier closes."""
        self._drawn, self._setup = drawn, setup
        self._counted = pose
        self._distance_m = 0.0
        _, goal = ends_of(site, drawn)
        self._drive = Drive(
            goal=(goal.x, goal.y),
            goal_id=goal_id,
            areas=site.site.areas,
            truth=self._truth(pose),
            now=now,
            hazard=HazardSchedule.of(site, drawn.seed, HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m)),
        )

    def on_pose(self, pose: RobotPose) -> None:
        """Evaluate the robot's pose; one that it is not sure of tells nothing."""
        if not pose.localized:
            return
        moved = math.hypot(pose.x - self._counted.x, pose.y - self._counted.y)
        if moved >= COUNTED_M:
            self._counted, self._distance_m = pose, self._distance_m + moved
        self._drive.on_truth(self._truth(pose))

    def on_state(self, state: RobotState, now: float) -> None:
        """Evaluate the robot's state."""
        self._drive.on_state(state, now)

    def on_path(self, path: RobotPath, now: float) -> None:
        """Evaluate a path or refusal of the planner."""
        self._drive.on_path(path, now)

    def barrier_due(self) -> PlannedHazard | None:
        """Return what a person is to place now, or None."""
        return self._drive.hazard_due()

    def on_barrier_placed(self, planned: PlannedHazard) -> None:
        """Record that a person says that the barrier stands; said again, it changes nothing."""
        if self._drive.blocked_at_m is None:
            self._drive.on_barrier_placed(planned)

    def outcome(self, now: float) -> DriveOutcome | None:
        """Return how the drive ended, or None while it continues."""
        return self._drive.outcome(now)

    def record(self, outcome: DriveOutcome, *, touched: bool, load: float, version: str, commit: str) -> MeasuredDrive:
        """Return the record of the drive that ended so; `touched`: whether a person saw the robot touch something."""
        ended = DriveOutcome("contact", "a person saw the robot touch something") if touched else outcome
        summary = self._drive.summary(ended)
        placed = self._drive.blocked_at_m
        return MeasuredDrive(
            **facts(MeasuredDrive, self._drawn, self._setup, summary),
            kind="hardware",
            barrier_at_m=None if placed is None else round(placed, 2),
            load=load,
            version=version,
            commit=commit,
        )

    def _truth(self, pose: RobotPose) -> SimTruth:
        """Return the robot's own pose in the form that drives are evaluated by; nobody measures its clearance."""
        return SimTruth(
            robot="robot", x=pose.x, y=pose.y, theta=pose.theta, left=pose.v, right=pose.v, distance=self._distance_m,
            clearance=math.inf, min_clearance=math.inf, contacts=0,
        )  # fmt: skip
