"""Corridors that are blocked and free again: what a fleet gains by nodes that see them, over its own lidars.

Blocks close watched areas from wall to wall. Two kinds of eyes see the same ones: `nodes`, those of the areas, besides
the robots' lidars, and `lidars` alone, of which each tells all robots what it has seen. Both have the same map-service,
planner and leases, which robots need to pass one another, and the same draws of blocks, starts and goals. Nodes err
never here. Nor do lidars, which also see a block as soon as two beams hit it, and all that shows of it at once.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from itertools import islice
from statistics import mean
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, get_args

import msgspec
import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import contains_point, distance_to_polygon, normalized_polygon
from fog_contracts.handlers import Moment
from fog_contracts.messages import SEVERITY, AggregatorHeartbeat, AreaHazard, RobotObstacles, hazards_digest
from fog_contracts.shapes import rasterize
from fog_contracts.site import AreaSite, Site
from fog_runtime.configuration.site import load_site
from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.bench.room import (
    AISLES_M,
    NEAREST_M,
    RADIUS_M,
    STEP_S,
    ChangingMap,
    Floor,
    Run,
    aisles,
    drive,
)
from fognav_experiments.figures import Code, Heading, Paragraph, Picture, Table, curves, svg_of, to_markdown, told
from fognav_sim.barrier import barrier_across
from fognav_sim.floor import Floor as Ground
from map_service.core import MapCore
from map_service.registry import make_layers
from robot_agent.agent.obstacle_reporter import view
from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from fog_contracts.grid import StaticMap
    from fog_contracts.handlers import Publication
    from fog_contracts.messages import SimObstacle
    from fognav_experiments.bench.room import BlindRobot
    from fognav_experiments.figures import Block as Part
    from planner.core import PlannerCore

Eyes = Literal["nodes", "lidars"]
EYES: Final[tuple[Eyes, ...]] = get_args(Eyes)
RECORDS: Final = "runs.jsonl"
FREE_S: Final = 540.0
"""How long an area is free between two blocks, on average (exponential)."""
STANDS_S: Final = (60.0, 300.0)
"""How long a block stands (uniform)."""
TOLD_S: Final = {"blocked": 0.3, "clear": 1.2}
"""From a change to the area's state, as a drive in lockstep had it."""
RANGE_M: Final = 12.0
MEMORY_S: Final = 600.0
"""How long a robot's report holds where no lidar sees that the obstacle is gone: the agent's default."""
_CELL_M: Final = 0.1
_BEAMS: Final = np.radians(np.arange(360.0))
_REPORT_STEPS: Final = 10
_POSE_STEPS: Final = 5
_HEARTBEAT_STEPS: Final = 2
_WARM_UP_S: Final = 1.5
_BEFORE_S: Final = 3600.0
"""Blocks are drawn from so long before the start, so that some stand there already."""
_STAMP: Final = 1_700_000_000.0


class Block(NamedTuple):
    """What closes an area from `begins` to `ends` (s after the start)."""

    area: str
    obstacle: SimObstacle
    begins: float
    ends: float


def watched_floor(name: str, sites: Path) -> tuple[Site, StaticMap]:
    """Return a floor by its name with its watched areas; aisles have one each, 4 m in the middle. Raises `ValueError`.

    `sites`: the folder of the others.
    """
    if name not in AISLES_M:
        if not (sites / name / "site.toml").is_file():
            raise ValueError(f"no floor {name!r}: take {', '.join(AISLES_M)} or a site of {sites}")
        loaded = load_site(sites / name)
        return loaded.site, loaded.map
    width, number, shelf, wall, left, right = AISLES_M[name], 6, 1.2, 0.2, 14.2, 18.2
    areas = []
    for aisle in range(number):
        low = wall + aisle * (width + shelf)
        corners = [(left, low), (right, low), (right, low + width), (left, low + width)]
        areas.append(AreaSite(id=f"a{aisle + 1}", polygon=corners))
    return Site(id=name, areas=areas), aisles(width, number)


def blocks(site: Site, map_: StaticMap, seed: int, seconds: float) -> list[Block]:
    """Return the blocks of all areas that stand within so long (s) after the start."""
    found: list[Block] = []
    for number, area in enumerate(site.areas):
        rng = np.random.default_rng((seed, number, 2))
        begins = -_BEFORE_S + rng.exponential(FREE_S)
        while begins < seconds:
            ends = begins + rng.uniform(*STANDS_S)
            if ends > 0.0:
                name = f"{area.id}-{len(found)}"
                obstacle = barrier_across(area, site, map_, int(rng.integers(2**31)), name=name)
                found.append(Block(area.id, obstacle, begins, ends))
            begins = ends + rng.exponential(FREE_S)
    return sorted(found, key=lambda block: block.begins)


class WatchedMap(ChangingMap):
    """The real map-service with what it hears of blocks: from nodes, if there are any, and from the robots' lidars."""

    def __init__(self, site: Site, map_: StaticMap, eyes: Eyes, drawn: Sequence[Block]) -> None:
        super().__init__(map_)
        self._site = site
        self._areas = site.areas if eyes == "nodes" else []
        kept = np.ones(map_.geometry.shape, np.bool_)
        for area in site.areas:
            mask = rasterize(normalized_polygon(area.polygon), map_.geometry)
            kept[mask.window.rows, mask.window.columns] = False
        self.free = self.free[kept[self.free[:, 1], self.free[:, 0]]]  # nobody is sent into an area that may be blocked
        self._ground = Ground(map_.geometry, map_.cells)
        definitions = site.definitions() if eyes == "nodes" else []
        layers = make_layers(map_, site.layers)
        self._core = MapCore(site.id, map_, epoch=1, layers=layers, definitions=definitions)
        self._due, self._standing = list(drawn), list[Block]()
        self._begun, self._steps = 0.0, 0
        self._hazards_told: dict[str, AreaHazard] = {}
        self._changed: dict[str, float] = {}
        self._reporter: dict[str, str] = {}
        """Which robot has reported a block: it goes on while it sees it. What is on the map already, nobody reports."""
        self._in_block: set[tuple[str, str]] = set()
        self.blocked, self.entered = 0, 0
        """How many blocks stood, and how often a robot's body entered one."""
        self.blocked_s = 0.0

    def start(self, core: PlannerCore, now: float, rng: np.random.Generator) -> None:
        """Let the map be complete, and load it into the planner."""
        del rng
        self._begun = now
        at = now - _WARM_UP_S
        self._core.load_zones([], Moment(at, _STAMP + at))
        while at < now - STEP_S / 2.0:
            at = round(at + STEP_S, 3)
            told = self._nodes(Moment(at, _STAMP + at))
            told += self._core.tick(Moment(at, _STAMP + at))
        core.load(self._core.costmap.snapshot(), now)
        self._pass(core, self._core.lead(1), Moment(now, _STAMP + now))

    def step(self, core: PlannerCore, robots: Sequence[BlindRobot], at: Moment, rng: np.random.Generator) -> None:
        """Let blocks come and go, nodes and lidars see them, and the planner hear of the map."""
        del rng
        self._steps += 1
        at = Moment(at.now, _STAMP + at.now)
        self._change_blocks(robots, at.now - self._begun)
        told = self._nodes(at)
        for number, robot in enumerate(robots):
            self._note_entered(robot)
            if (self._steps + number) % _POSE_STEPS == 0:
                told += self._hear(ch.ROBOT_POSE, {"robot": robot.id}, robot.pose(at.stamp), at)
            if (self._steps + number) % _REPORT_STEPS == 0:
                told += self._hear(ch.ROBOT_OBSTACLES, {"robot": robot.id}, self._seen(robot, at), at)
        told += self._core.tick(at)
        while self._core.pending:
            told += self._core.continue_commit(at)
        self._pass(core, told, at)

    def _hear(self, channel: ch.Channel, ids: dict[str, str], message: object, at: Moment) -> list[Publication]:
        return list(self._core.handlers()[channel](ids, message, at))

    @staticmethod
    def _pass(core: PlannerCore, told: Iterable[Publication], at: Moment) -> None:
        handlers = core.handlers()
        for publication in told:
            if (handler := handlers.get(publication.channel)) is not None:
                handler(publication.ids, publication.message, at)

    def _change_blocks(self, robots: Sequence[BlindRobot], since_start: float) -> None:
        """Remove the blocks that are over; place those that are due, once no robot is near."""
        for block in [block for block in self._standing if block.ends <= since_start]:
            self._standing.remove(block)
            self._ground.remove(block.obstacle.id)
        self._due = [block for block in self._due if block.ends > since_start]
        for block in [block for block in self._due if block.begins <= since_start]:
            if all(distance_to_polygon(block.obstacle.polygon, robot.x, robot.y) > NEAREST_M for robot in robots):
                self._due.remove(block)
                self._standing.append(block)
                self._ground.place(block.obstacle)
                self.blocked += 1
        self.blocked_s += STEP_S * len(self._standing)

    def _nodes(self, at: Moment) -> list[Publication]:
        """Let the nodes' areas change, and the aggregator confirm them."""
        told: list[Publication] = []
        if not self._areas:
            return told
        blocked = {block.area for block in self._standing}
        for area in self._areas:
            known, state = self._hazards_told.get(area.id), "blocked" if area.id in blocked else "clear"
            if known is not None and known.state == state:
                self._changed.pop(area.id, None)
            elif known is None or at.now - self._changed.setdefault(area.id, at.now) >= TOLD_S[state]:
                hazard = AreaHazard(
                    area=area.id, state="blocked" if state == "blocked" else "clear", severity=SEVERITY[state],
                    penalty=LETHAL if state == "blocked" else 0, since=at.stamp, epoch=1,
                    seq=1 if known is None else known.seq + 1, cause=f"its node says {state}",
                )  # fmt: skip
                self._hazards_told[area.id] = hazard
                told += self._hear(ch.AREA_HAZARD, {"area": area.id}, hazard, at)
        if self._steps % _HEARTBEAT_STEPS == 0:
            heartbeat = AggregatorHeartbeat(
                epoch=1, areas={area: hazard.seq for area, hazard in self._hazards_told.items()}, complete=True,
                digest=hazards_digest(self._hazards_told.values()), uptime=at.now, stamp=at.stamp,
            )  # fmt: skip
            told += self._hear(ch.AGGREGATOR_HEARTBEAT, {}, heartbeat, at)
        return told

    def _seen(self, robot: BlindRobot, at: Moment) -> RobotObstacles:
        """Return what a robot's lidar sees: how far it is free, and the blocks that two beams or more hit."""
        ranges = self._ground.wall_ranges(robot.x, robot.y, _BEAMS, RANGE_M)
        hit: list[SimObstacle] = []
        seen = list(self._ground.obstacle_ranges(robot.x, robot.y, _BEAMS, RANGE_M))
        nearest = np.min([ranges, *(found for _, found, _ in seen)], axis=0)
        for obstacle, found, _ in seen:
            if int(((found <= nearest) & (found <= RANGE_M)).sum()) >= 2:
                hit.append(obstacle)
        told = {area for area, hazard in self._hazards_told.items() if hazard.state == "blocked"}
        for block in self._standing:
            if block.area not in told and block.obstacle in hit:
                self._reporter.setdefault(block.obstacle.id, robot.id)
        echo = nearest <= RANGE_M
        points = np.column_stack((
            robot.x + nearest[echo] * np.cos(_BEAMS[echo]), robot.y + nearest[echo] * np.sin(_BEAMS[echo])
        ))  # fmt: skip
        return RobotObstacles(
            points=[
                point
                for obstacle in hit
                if self._reporter.get(obstacle.id) == robot.id
                for point in _cells_of(obstacle)
            ],
            stamp=at.stamp,
            ttl=MEMORY_S,
            view=view(Pose2(robot.x, robot.y, robot.theta), points, self.geometry),
        )

    def _note_entered(self, robot: BlindRobot) -> None:
        for block in self._standing:
            pair = robot.id, block.obstacle.id
            if pair not in self._in_block and distance_to_polygon(block.obstacle.polygon, robot.x, robot.y) < RADIUS_M:
                self._in_block.add(pair)
                self.entered += 1


def _cells_of(obstacle: SimObstacle) -> list[tuple[float, float]]:
    """Return the centres (m) of the cells of a report in an obstacle."""
    low, high = np.min(obstacle.polygon, axis=0), np.max(obstacle.polygon, axis=0)
    columns, rows = (np.arange(math.floor(a / _CELL_M), math.ceil(b / _CELL_M)) for a, b in zip(low, high, strict=True))
    centres = [(float(column + 0.5) * _CELL_M, float(row + 0.5) * _CELL_M) for row in rows for column in columns]
    return [centre for centre in centres if contains_point(obstacle.polygon, *centre)]


class BlocksRun(msgspec.Struct, frozen=True):
    """A run among blocks: what every run gives, and of the blocks how many stood, their time (s), bodies in them."""

    floor: str
    eyes: Eyes
    run: Run
    blocked: int
    blocked_s: float
    entered: int
    commit: str = ""
    load: float = 0.0

    @property
    def name(self) -> tuple[str, int, int, float, Eyes]:
        """What tells runs apart."""
        return self.floor, self.run.robots, self.run.seed, self.run.seconds, self.eyes

    @property
    def per_hour(self) -> float:
        """Missions of the fleet per hour."""
        return len(self.run.took) / self.run.seconds * 3600.0


def play(  # noqa: PLR0913  # what is driven
    name: str, sites: Path, robots: int, seed: int, seconds: float, eyes: Eyes, commit: str = ""
) -> BlocksRun:
    """Let robots drive among blocks for so long (s); return what happened. Raises `ValueError` for another floor."""
    site, map_ = watched_floor(name, sites)
    map_of_blocks = WatchedMap(site, map_, eyes, blocks(site, map_, seed, seconds))
    run = drive(Floor(map_of_blocks, robots, seed, own_goals=True), seed, seconds)
    return BlocksRun(
        name, eyes, run, map_of_blocks.blocked, round(map_of_blocks.blocked_s, 1), map_of_blocks.entered, commit,
        round(os.getloadavg()[0], 1),
    )  # fmt: skip


def play_all(  # noqa: PLR0913  # what is driven, and where it is kept
    name: str, sites: Path, robots: int, seeds: Sequence[int], seconds: float, out: Path | None, commit: str
) -> Iterator[BlocksRun]:
    """Yield the runs with nodes and with lidars alone, seed by seed; those that `out` has are not made again."""
    known = {run.name: run for run in read(out)} if out is not None else {}
    for seed in seeds:
        for eyes in EYES:
            found = known.get((name, robots, seed, seconds, eyes))
            if found is None:
                found = play(name, sites, robots, seed, seconds, eyes, commit)
                if out is not None:
                    out.mkdir(parents=True, exist_ok=True)
                    with (out / RECORDS).open("ab") as file:
                        file.write(msgspec.json.encode(found) + b"\n")
            yield found


def read(out: Path) -> list[BlocksRun]:
    """Return the runs of a folder, in order."""
    file = out / RECORDS
    lines = file.read_bytes().splitlines() if file.exists() else []
    return sorted((msgspec.json.decode(line, type=BlocksRun) for line in lines), key=lambda run: run.name)


def publish(runs: Sequence[BlocksRun], out: Path) -> None:
    """Write the page of all runs, and its picture."""
    page: list[Part] = [Heading("Fleets with and without sensor nodes", 1), Paragraph(_ABOUT), Code(_COMMAND)]
    floors = {floor: [run for run in runs if run.floor == floor] for floor in dict.fromkeys(run.floor for run in runs)}
    page.append(Picture("missions.svg", svg_of(curves({
        floor: {eyes: [(robots, mean(run.per_hour for run in of if run.eyes == eyes)) for robots, of in _sizes(found)]
                for eyes in EYES}
        for floor, found in floors.items()
    }, "robots")), "Missions of the whole fleet per hour, mean of the seeds."))  # fmt: skip
    for floor, found in floors.items():
        page += [Heading(floor), Table(_HEADER, [_row(robots, of) for robots, of in _sizes(found)])]
    made = Counter((run.commit, run.run.seconds) for run in runs)
    loads = [run.load for run in runs]
    of_commits = [f"{n} runs of {seconds:.0f} s at commit {commit}" for (commit, seconds), n in made.items()]
    page.append(Paragraph(
        f"{'; '.join(of_commits)}. Load of the machine {min(loads):g} to {max(loads):g}; the clock is simulated."
    ))  # fmt: skip
    for name, text in (
        ("README.md", to_markdown(page)),
        *((b.file, b.svg) for b in page if isinstance(b, Picture)),
    ):
        atomic_write(out / name, text.encode(), mode=SHARED)


def _sizes(runs: Sequence[BlocksRun]) -> list[tuple[int, list[BlocksRun]]]:
    """Return the runs of which both kinds of eyes were driven, by number of robots."""
    both = Counter((run.run.robots, run.run.seed) for run in runs)
    paired = [run for run in runs if both[run.run.robots, run.run.seed] == len(EYES)]
    sizes = sorted({run.run.robots for run in paired})
    return [(robots, [run for run in paired if run.run.robots == robots]) for robots in sizes]


def pairs(runs: Sequence[BlocksRun]) -> list[tuple[BlocksRun, BlocksRun]]:
    """Return the runs of one size with nodes and with lidars alone, seed by seed."""
    by = {(run.run.seed, run.eyes): run for run in runs}
    return [(run, by[run.run.seed, "lidars"]) for run in runs if run.eyes == "nodes"]


def _saved_s(with_nodes: Run, without: Run) -> list[float]:
    """Return how much longer (s) missions took without nodes, of those that ended in both: each robot's first ones."""
    saved: list[float] = []
    mine, others = iter(with_nodes.took), iter(without.took)
    for one, other in zip(with_nodes.ended, without.ended, strict=True):
        times = list(islice(mine, one)), list(islice(others, other))
        saved += [longer - shorter for shorter, longer in zip(*times, strict=False)]
    return saved


def _row(robots: int, runs: Sequence[BlocksRun]) -> list[str]:
    both = pairs(runs)
    alike = [(saved, one.run.seed) for one, other in both for saved in _saved_s(one.run, other.run)]
    more = [one.per_hour - other.per_hour for one, other in both]
    sides = [[one for one, _ in both], [other for _, other in both]]

    def each(figure: Callable[[list[BlocksRun]], str]) -> str:
        return ", ".join(figure(side) for side in sides)

    return [
        str(robots), str(len(both)), each(lambda side: f"{mean(run.per_hour for run in side):.1f}"),
        told(more, [one.run.seed for one, _ in both]),
        f"{sum(value > 0.0 for value in more)}, {sum(value < 0.0 for value in more)}",
        told([saved for saved, _ in alike], [seed for _, seed in alike]) if alike else "-",
        str(len(alike)),
        each(lambda side: f"{100.0 * mean(run.run.waited for run in side):.1f}"),
        each(lambda side: f"{100.0 * mean(run.run.without_way for run in side):.1f}"),
        each(lambda side: f"{mean(run.blocked_s for run in side) / side[0].run.seconds:.1f}"),
        each(lambda side: f"{sum(run.run.contacts for run in side)} + {sum(run.entered for run in side)}"),
        each(lambda side: f"{sum(len(run.run.deadlocks) for run in side)}"),
    ]  # fmt: skip


_HEADER: Final = [
    "robots", "seeds", "missions per hour: nodes, lidars", "more with nodes", "seeds with more, with fewer",
    "s saved in missions of both", "such missions", "waiting, %", "without a way, %", "areas blocked at a time",
    "contacts with robots + blocks", "deadlocks",
]  # fmt: skip
_COMMAND: Final = "fognav bench room --blocks --floor FLOOR --robots N --seeds S --seconds 1200 --out DIR"
_ABOUT: Final = (
    "Robots drive one mission after the other between random places, while watched areas are closed from wall to wall "
    f"and free again: free for {FREE_S:.0f} s on average (exponential), blocked for {STANDS_S[0]:.0f} to "
    f"{STANDS_S[1]:.0f} s (uniform), chosen so that many are met. Each seed is driven twice, with the same blocks, "
    "starts and goals (a goal within a metre of another robot's is drawn again); a block waits until no robot is "
    f"within {NEAREST_M:.0f} m. *Nodes*: each area's node tells the fog of a block {TOLD_S['blocked']:g} s later and "
    f"of its end {TOLD_S['clear']:g} s later, and robots' lidars report what the map lacks. *Lidars*, the control: "
    f"there are no nodes; what a robot's lidar sees, from up to {RANGE_M:.0f} m, all robots know at once, and it stays "
    f"on the map until one sees that it is gone, at most for {MEMORY_S:.0f} s. Map-service, planner and leases are the "
    "same, since robots without an order in narrow places block one another for good: what differs is the nodes, not "
    "the fog. Robots that tell one another nothing were not driven. Robots are blind bodies with an exact pose, as in "
    "[the bench of leases](../../benchmarks.md#robots-that-make-room); no node errs or overlooks a block, every block "
    "stands in a watched area, and the planner has seen none before, so that it sends robots round. Intervals are of "
    "95 % and count seeds; below ten seeds the least and the most stand instead, and nothing can be concluded. "
    "Missions of both are those that a robot ended in both runs of a seed: its first ones, from the same place to the "
    "same goal, perhaps at another time, among other blocks."
)
