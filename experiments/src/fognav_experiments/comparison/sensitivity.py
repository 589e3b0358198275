"""How what the fog saves depends on its parts and its world: debouncing, nodes, speed, radio, how long blocks stand.

A sweep drives planes of two quantities each, on every core of this machine, and may be killed at any moment. At each
point the robot that the fog leads is compared with the one on its own, on the same drawn routes. A heat map of each
plane, and a page that explains them, say what was found.
"""

from __future__ import annotations

import random
from collections import Counter
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from fog_contracts.messages import NodeConfig
from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.comparison.drives import ALONE, PROFILE_OF_SETUP, DrivenRoute, ends_of, start_of
from fognav_experiments.figures import (
    FEWEST_CLUSTERS,
    Block,
    Code,
    Estimate,
    Heading,
    Paragraph,
    Picture,
    Table,
    clustered,
    flat,
    heat_map,
    to_markdown,
)
from fognav_experiments.lockstep import ready, release_drives
from fognav_experiments.machine import results
from fognav_experiments.rigs import Tuning
from fognav_experiments.scenarios.description import BusyRadio, DeceivedNode, Obstacle
from fognav_experiments.scenarios.stage import Stage
from fognav_sim.barrier import KEEP_AWAY_M, barrier_across
from fognav_sim.drive.drive import DriveOutcome
from fognav_sim.hardware import STEP_S
from planner.waits.blocks import BlockRecord
from planner.waits.durations import Durations

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from fog_contracts.site import Site
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import RouteDraw, Setup
    from fognav_experiments.comparison.records import DriveFiles
    from fognav_experiments.scenarios.description import AnyEvent


Quantity = Literal["readings", "pause_ms", "areas", "speed_m_s", "delay_ms", "gaps_per_min", "stays_s", "known_blocks"]
_FALSE_ECHO_M: Final = 0.3
"""What the sonars of an area hear during a false alarm: something that hangs before them."""
_EVER_S: Final = 36_000.0
UNITS: Final[dict[Quantity, str]] = {
    "readings": "readings that confirm a state (debounce N)",
    "pause_ms": "pause of a node between two readings, ms",
    "areas": "watched areas (0: all)",
    "speed_m_s": "highest speed of the robot, m/s",
    "delay_ms": "median delay of a message, ms",
    "gaps_per_min": "gaps of the radio a minute",
    "stays_s": "how long the block stands, s (0: for ever)",
    "known_blocks": "blocks as long that the planner has seen",
}
OF_THE_ROBOT: Final[frozenset[Quantity]] = frozenset({"speed_m_s", "stays_s"})
"""What also changes the robot that nobody warns; it is driven once for all values of the others."""


NODE_PAUSE_MS: Final[int] = next(
    field.default for field in msgspec.structs.fields(NodeConfig) if field.name == "pause_ms"
)
"""The pause of a node that nobody has configured otherwise."""


class Variation(msgspec.Struct, frozen=True, kw_only=True):
    """A point of a plane.

    `readings` in a row confirm a state, 0: by the site's own rule. `pause_ms`: of a node between two readings. `areas`:
    how many are watched, 0: all. `speed_m_s`: the robot's highest. `delay_ms`: median of the lognormal times that
    messages take between robot and fog, and from a node, 0: none; `gaps_per_min`: how often nothing arrives for around
    0.3 s (`BusyRadio`). `stays_s`: how long the obstacle stands, 0: for ever. `known_blocks`: so many blocks as long
    has the planner seen in the area before. `false_alarm`: nothing stands there, the area's nodes alone say so.
    """

    readings: int = 0
    pause_ms: int = NODE_PAUSE_MS
    areas: int = 0
    speed_m_s: float = 0.3
    delay_ms: float = 0.0
    gaps_per_min: float = 0.0
    stays_s: float = 0.0
    known_blocks: int = 0
    false_alarm: bool = False

    @property
    def name(self) -> str:
        """The point's name in files."""
        of_the_world = f"d{self.delay_ms:g}-g{self.gaps_per_min:g}-s{self.stays_s:g}-k{self.known_blocks}"
        kind = "false" if self.false_alarm else "true"
        return f"n{self.readings}-p{self.pause_ms}-a{self.areas}-v{self.speed_m_s:g}-{of_the_world}-{kind}"


BASE: Final = Variation()


class Axis(NamedTuple):
    """A quantity and its values."""

    quantity: Quantity
    values: Sequence[float]


class Plane(NamedTuple):
    """Two quantities of which every combination is tried, all others as they are by default.

    `false_alarms`: nothing stands where the nodes say so.
    """

    x: Axis
    y: Axis
    false_alarms: bool = False

    @property
    def name(self) -> str:
        """The plane's name in files."""
        quantities = f"{self.x.quantity}-{self.y.quantity}".replace("_", "-")
        return f"false-alarms-{quantities}" if self.false_alarms else quantities

    def at(self, x: float, y: float) -> Variation:
        """Return the point with these values."""
        changed = {self.x.quantity: x, self.y.quantity: y, "false_alarm": self.false_alarms}
        return msgspec.convert(msgspec.to_builtins(BASE) | changed, Variation)

    def points(self) -> list[Variation]:
        """Return every point, row by row."""
        return [self.at(x, y) for y in self.y.values for x in self.x.values]


class SweptDrive(DrivenRoute, frozen=True, kw_only=True):
    """One drive of a sweep in lockstep; `modes_s`: how long (s) the robot was in each of its modes."""

    variation: Variation
    modes_s: dict[str, float] = msgspec.field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the record's file, without suffix."""
        return f"{self.run:04}-{self.route}-{self.setup}-{self.variation.name}"


class SweepTask(NamedTuple):
    """A drive to run."""

    drawn: RouteDraw
    setup: Setup
    variation: Variation

    @property
    def name(self) -> str:
        """Name of its record."""
        return f"{self.drawn.run:04}-{self.drawn.route.name}-{self.setup}-{self.variation.name}"


def unwarned(variation: Variation) -> Variation:
    """Return the variation by which the robot on its own drives: what the fog has means nothing to it."""
    own: dict[str, Any] = {quantity: getattr(variation, quantity) for quantity in OF_THE_ROBOT}
    if variation.false_alarm:
        own |= {"stays_s": 0.0, "false_alarm": True}  # it hears no alarm, however long
    return msgspec.convert(msgspec.to_builtins(BASE) | own, Variation)


def sweep_tasks(planes: Iterable[Plane], drawn: Sequence[RouteDraw]) -> list[SweepTask]:
    """Return the drives of all points, each once."""
    found: dict[str, SweepTask] = {}
    for route in drawn:
        for plane in planes:
            for point in plane.points():
                both = SweepTask(route, "default", unwarned(point)), SweepTask(route, "fog", point)
                found |= {task.name: task for task in both}
    return list(found.values())


def varied_site(site: Site, variation: Variation, seed: int) -> Site:
    """Return the site with so many of its watched areas, drawn from the seed, that debounce as the variation says."""
    kept = [area.id for area in site.areas]
    if 0 < variation.areas < len(kept):
        kept = random.Random(seed).sample(kept, variation.areas)  # noqa: S311  # repeatable, not a secret
    debounce = {"rule": "consecutive", "to_blocked": variation.readings, "to_clear": variation.readings}
    areas = [
        msgspec.structs.replace(area, debounce=debounce) if variation.readings else area
        for area in site.areas
        if area.id in kept
    ]
    return msgspec.structs.replace(site, areas=areas, nodes=[node for node in site.nodes if node.area in kept])


class Gain(NamedTuple):
    """What the fog saves at a point: metres and seconds, over the routes that both robots drove."""

    metres: Estimate
    seconds: Estimate


def gain(drives: Iterable[SweptDrive], point: Variation) -> Gain | None:
    """Return what the fog saves at a point; None without a route that both robots drove to its end."""
    known = {(drive.setup, drive.variation, drive.run, drive.route): drive for drive in drives if drive.success}
    metres, seconds, situations = [], [], []
    for (setup, variation, run, route), led in known.items():
        alone = known.get(("default", unwarned(point), run, route))
        if setup == "fog" and variation == point and alone is not None:
            metres.append(alone.distance_m - led.distance_m)
            seconds.append((alone.time_s or 0.0) - (led.time_s or 0.0))
            situations.append((route, led.area))
    return Gain(clustered(metres, situations), clustered(seconds, situations)) if metres else None


def sweep(
    site: LoadedSite, asked: Sequence[SweepTask], files: DriveFiles[SweptDrive], jobs: int, commit: str = ""
) -> Iterator[SweptDrive]:
    """Run the drives that have no record yet, so many at a time, and yield each record once it is written.

    `commit` is only recorded.
    """
    due = [task for task in asked if not files.has(task.name)]
    for drive in results(partial(swept_drive, site, commit), due, jobs):
        files.write(drive)
        yield drive


def swept_drive(site: LoadedSite, commit: str, task: SweepTask) -> SweptDrive:
    """Drive one task in lockstep; the same whenever it is repeated. Raises `BarrierError` where no barrier fits."""
    drawn, variation = task.drawn, task.variation
    run = ready(
        site,
        start_of(site, drawn),
        ends_of(site, drawn)[1],
        drawn.seed,
        watched=varied_site(site.site, variation, drawn.seed) if task.setup not in ALONE else False,
        profile=PROFILE_OF_SETUP[task.setup],
        tuning=Tuning(pause_ms=variation.pause_ms, speed_m_s=variation.speed_m_s),
    )
    drive = run.drive
    assert drive is not None
    if variation.known_blocks:
        run.system.fog.planner.core.waits.blocks.restore({drawn.area: _seen(variation)}, run.now)
    stage = Stage(run, what_happens(site, drawn, variation), drawn.seed)
    steps: Counter[str] = Counter()
    outcome = None if run.problem is None else DriveOutcome("stopped", run.problem)
    while outcome is None:
        stage.step()
        run.step()
        steps[run.robot.agent.safety.mode] += 1
        outcome = drive.outcome(run.now)
    result = run.result(drive, outcome)
    release_drives()
    return SweptDrive(
        variation=variation,
        setup=task.setup,
        run=drawn.run,
        route=drawn.route.name,
        seed=drawn.seed,
        area=drawn.area,
        success=result.success,
        outcome=result.outcome,
        distance_m=result.distance_m,
        time_s=result.time_s,
        modes_s={mode: round(count * STEP_S, 2) for mode, count in sorted(steps.items())},
        commit=commit,
        version=version("fognav-experiments"),
    )


def what_happens(site: LoadedSite, drawn: RouteDraw, variation: Variation) -> list[AnyEvent]:
    """Return what happens on a drive: the drawn block, or an alarm in its place, and what the radio does."""
    area = next(area for area in site.site.areas if area.id == drawn.area)
    events: list[AnyEvent] = []
    if variation.false_alarm:
        events += [
            DeceivedNode(node=node.id, scale=0.0, offset=_FALSE_ECHO_M, at_m=drawn.trigger_m, seconds=variation.stays_s)
            for node in site.site.nodes
            if node.area == drawn.area
        ]
    else:
        barrier = barrier_across(area, site.site, site.map, drawn.seed)
        events.append(
            Obstacle(
                polygon=barrier.polygon, height=barrier.height, area=drawn.area,
                at_m=drawn.trigger_m, keep_m=KEEP_AWAY_M, seconds=variation.stays_s,
            )
        )  # fmt: skip
    if variation.delay_ms or variation.gaps_per_min:
        events.append(
            BusyRadio(
                seconds=_EVER_S,
                median_s=max(variation.delay_ms / 1000.0, STEP_S / 10.0),
                gaps_per_min=variation.gaps_per_min,
            )
        )
    return events


def _seen(variation: Variation) -> BlockRecord:
    """Return what the planner knows of an area with so many blocks of this length, at every hour."""
    seen = Durations()
    for _ in range(variation.known_blocks):
        seen.add(0.0, variation.stays_s or _EVER_S, ended=True)
    spans = [
        (int(span), float(seen.ended[span]), float(seen.spent[span]))
        for span in np.flatnonzero(seen.spent + seen.ended)
    ]
    return BlockRecord(hours={str(hour): spans for hour in range(24)})


TITLE: Final = "How what the fog saves depends on its parts"


def publish(
    drives: Sequence[SweptDrive], planes: Sequence[Plane], command: str, measured_on: Mapping[str, Any], target: Path
) -> list[Path]:
    """Write the page and figures of a sweep into a folder; return the files."""
    blocks: list[Block] = [
        Heading(TITLE, 1),
        Paragraph(
            "The same drawn obstacles are met by a robot on its own and by one that the fog leads, in lockstep. Each "
            f"cell says how many metres and seconds the second saves{_spread(drives, planes)}; "
            "one quantity changes along each side, all others are as by default. Only routes count on which the "
            "obstacle bars the shortest way. Of a part of the areas only, which ones are watched is drawn per route: "
            "an obstacle that no sensor sees saves nothing."
        ),
        Code(command),
        Table(["measured on", ""], [*([name, str(value)] for name, value in flat(measured_on)), *_commits(drives)]),
    ]
    for plane in planes:
        blocks += _plane(drives, plane)
    failed = [drive for drive in drives if not drive.success]
    blocks.append(Paragraph(f"{len(drives)} drives, of which {len(failed)} failed and count for nothing."))
    if failed:
        blocks.append(Table(["drive", "outcome"], [[drive.name, drive.outcome] for drive in failed]))
    texts = {
        "README.md": to_markdown(blocks),
        **{block.file: block.svg for block in blocks if isinstance(block, Picture)},
    }
    for name, content in texts.items():
        atomic_write(target / name, content.encode(), mode=SHARED)
    return [target / name for name in texts]


def _spread(drives: Sequence[SweptDrive], planes: Sequence[Plane]) -> str:
    """Return in words what a cell's figures are; few situations have no confidence interval."""
    found = [gain(drives, point) for plane in planes for point in plane.points()]
    if any(cell.metres.half is not None for cell in found if cell is not None):
        return " on average, with the 95 % confidence interval, which counts situations"
    if any(cell.metres.n > 1 for cell in found if cell is not None):
        return (
            f" on average. There are fewer than {FEWEST_CLUSTERS} situations, too few for a confidence interval: other "
            "routes may tell something else"
        )
    return " on the one route, which says nothing of others"


def _commits(drives: Sequence[SweptDrive]) -> list[list[str]]:
    """Return how many of the drives each commit made."""
    counts = sorted(Counter(drive.commit or "not known" for drive in drives).items())
    return [["commit", f"{commit}: {count} of the drives"] for commit, count in counts]


def _plane(drives: Sequence[SweptDrive], plane: Plane) -> list[Block]:
    gains = {point: found for point in plane.points() if (found := gain(drives, point)) is not None}
    caption = f"Metres and seconds that the fog saves, by {UNITS[plane.x.quantity]} and {UNITS[plane.y.quantity]}."
    what = "False alarms: " if plane.false_alarms else ""
    rows = [
        [f"{getattr(point, plane.x.quantity):g}", f"{getattr(point, plane.y.quantity):g}", str(found.metres.n),
         str(found.metres), str(found.seconds), *_slowed(drives, point)]
        for point, found in gains.items()
    ]  # fmt: skip
    columns = ["routes", "metres saved", "seconds saved", "of the time in DEGRADED, %", "in HOLD, %"]
    return [
        Heading(f"{what}{plane.x.quantity} and {plane.y.quantity}"),
        Picture(
            f"{plane.name}.svg",
            heat_map(
                "What the fog saves per route",
                (UNITS[plane.x.quantity], plane.x.values),
                (UNITS[plane.y.quantity], plane.y.values),
                [[gains.get(plane.at(x, y)) for x in plane.x.values] for y in plane.y.values],
            ),
            caption,
        ),
        Table([UNITS[plane.x.quantity], UNITS[plane.y.quantity], *columns], rows),
    ]


def _slowed(drives: Sequence[SweptDrive], point: Variation) -> list[str]:
    """Return for how much of their time the robots that the fog led at a point were in DEGRADED and in HOLD, in %."""
    modes = sum((Counter(each.modes_s) for each in drives if (each.setup, each.variation) == ("fog", point)), Counter())
    whole = sum(modes.values())
    return [f"{100.0 * modes[mode] / whole:.1f}" if whole else "-" for mode in ("DEGRADED", "HOLD")]
