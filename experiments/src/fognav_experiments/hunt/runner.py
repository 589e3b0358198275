"""Hunts: drives world after world until its time is over, records each, and shrinks what broke a rule.

A world that breaks a rule is made smaller while it still breaks it: what is left is what it takes. Each try is a whole
drive of some seconds of computation, so the few changes are tried that make a world simpler to a reader, the largest
first, instead of the hundreds of small ones of a general shrinker.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import asdict, replace

from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.hunt.draw import draw_on_map, draw_world
from fognav_experiments.hunt.oracle import Figures, Rule
from fognav_experiments.hunt.play import Hunted, build_world, hunt, load_recorded, write_world
from fognav_experiments.hunt.world import HuntWorld, Mounting, Sensors
from fognav_experiments.machine import results

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence


RECORDS: Final = "drives.jsonl"
FOUND: Final = "found"
"""Folder of the worlds that broke a rule, shrunk."""
_ATTEMPTS: Final = 200
_RECORDED_EVERY: Final = 6
"""One world of so many is on a recorded floor."""
_MOST_CELLS: Final = 3_000_000


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """One drive: its draw, at which commit, and how it went; `rules` are those that it broke."""

    seed: int
    number: int
    commit: str
    kind: str
    outcome: str
    reason: str
    simulated_s: float
    figures: Figures
    exact: bool
    rules: list[Rule] = []
    values: str = ""


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """A world to draw and drive."""

    seed: int
    number: int
    commit: str
    maps: list[str]
    folders: list[str]
    tries: int


class Found(msgspec.Struct, frozen=True, kw_only=True):
    """A drive's record, and the world if it broke a rule."""

    record: Record
    world: bytes | None


def read_records(folder: Path) -> list[Record]:
    """Return the drives that are recorded in a folder; raises `ValueError` for a damaged file."""
    file = folder / RECORDS
    if not file.is_file():
        return []
    try:
        return [msgspec.json.decode(line, type=Record) for line in file.read_bytes().splitlines()]
    except msgspec.DecodeError as error:
        raise ValueError(f"{file}: {error}. Restore it, or remove the damaged line") from error


def run(  # noqa: PLR0913  # the options of a hunt
    folder: Path, seed: int, minutes: float, jobs: int, commit: str, folders: Sequence[Path], tries: int
) -> Iterator[Record]:
    """Drive the worlds of a seed that have no record yet, for so many minutes; yield each record once it is written.

    `folders` hold recorded maps; at most `tries` drives shrink a world.
    """
    until = time.monotonic() + 60.0 * minutes
    known = {record.number for record in read_records(folder) if record.seed == seed}
    maps = sorted({str(file.relative_to(base)) for base in folders for file in base.rglob("*.yaml") if _is_map(file)})

    def tasks() -> Iterator[Task]:
        for number in itertools.count(1):
            if time.monotonic() >= until:
                return
            if number not in known:
                yield Task(
                    seed=seed, number=number, commit=commit, maps=maps, folders=list(map(str, folders)), tries=tries
                )

    for found in results(drive, tasks(), jobs):
        yield _keep(folder, found)


def drive(task: Task) -> Found:
    """Draw a world, drive it, and shrink it if it broke a rule."""
    folders = [Path(folder) for folder in task.folders]
    world = draw(task, folders)
    hunted = hunt(world, folders)
    record = _record(task, world, hunted)
    if not hunted.violations:
        return Found(record=record, world=None)
    rule = hunted.violations[0].rule

    def breaks(smaller: HuntWorld) -> float | None:
        try:
            again = hunt(smaller, folders)
        except ValueError:
            return None  # its start or goal lies in a wall
        return next((violation.at_s for violation in again.violations if violation.rule == rule), None)

    return Found(record=record, world=write_world(shrink(world, breaks, task.tries)))


def draw(task: Task, folders: Sequence[Path]) -> HuntWorld:
    """Return the world of a task, on whose floor there is a way from start to goal."""
    for attempt in range(_ATTEMPTS):
        world = draw_world(task.seed, task.number, attempt)
        if task.maps and task.number % _RECORDED_EVERY == 0 and attempt < _ATTEMPTS // 2:
            name = task.maps[task.number // _RECORDED_EVERY % len(task.maps)]
            recorded = load_recorded(name, folders)
            if recorded.cells.size <= _MOST_CELLS:
                world = draw_on_map(task.seed, task.number, attempt, name, recorded)
        try:
            if build_world(world, folders).connects(world):
                return world
        except ValueError:
            continue
    raise ValueError(f"no world of seed {task.seed}, number {task.number} has a way from start to goal: leave it out")


def summary(records: Iterable[Record]) -> str:
    """Return in words what records sum up to."""
    drives = list(records)
    hours = sum(record.simulated_s for record in drives) / 3600.0
    driven = sum(record.figures.driven_m for record in drives) / 1000.0
    lines = [f"{len(drives)} drives, {hours:.2f} simulated hours, {driven:.2f} km driven"]
    for label, chosen in (
        ("exact maps", [r for r in drives if r.exact]),
        ("maps that are off", [r for r in drives if not r.exact]),
    ):
        poses = sum(record.figures.poses for record in chosen)
        if poses:
            rms = (sum(record.figures.squared_error for record in chosen) / poses) ** 0.5
            share = 100.0 * sum(record.figures.within_two_sigma for record in chosen) / poses
            worst = max(record.figures.worst_error_m for record in chosen)
            clearance = min(record.figures.min_clearance_m for record in chosen)
            pose = f"pose error rms {rms:.3f} m, worst {worst:.2f} m, {share:.1f} % within 2 sigma"
            lines.append(f"{label}: {len(chosen)} drives, {pose}, least clearance {clearance:.3f} m")
    moving = sum(record.figures.moving_s for record in drives)
    if moving:
        slow = 100.0 * sum(record.figures.degraded_s for record in drives) / moving
        lines.append(f"DEGRADED for {slow:.1f} % of the time in which robots moved")
    ended = Counter[str](record.outcome for record in drives)
    broken = Counter[str](rule for record in drives for rule in set(record.rules))
    lines.append("ended: " + _counted(ended))
    lines.append("drives that broke a rule: " + _counted(broken))
    return "\n".join(lines)


def _counted(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items())) or "none"


def _is_map(file: Path) -> bool:
    return any(line.startswith("image:") for line in file.read_text("utf-8", "replace").splitlines())


def _keep(folder: Path, found: Found) -> Record:
    folder.mkdir(parents=True, exist_ok=True)
    record = found.record
    if found.world is not None:
        (folder / FOUND).mkdir(exist_ok=True)
        atomic_write(folder / FOUND / f"{record.rules[0]}-{record.seed}-{record.number}.json", found.world, mode=SHARED)
    with (folder / RECORDS).open("ab") as file:
        file.write(msgspec.json.encode(record) + b"\n")
    return record


def _record(task: Task, world: HuntWorld, hunted: Hunted) -> Record:
    first = hunted.violations[0] if hunted.violations else None
    return Record(
        seed=task.seed, number=task.number, commit=task.commit, kind=world.title.partition(",")[0],
        outcome=hunted.outcome, reason=hunted.reason[:200], simulated_s=hunted.simulated_s, figures=hunted.figures,
        exact=world.warp_m == 0.0, rules=[violation.rule for violation in hunted.violations],
        values="" if first is None else f"at {first.at_s} s, ({first.x}, {first.y}): {first.values}",
    )  # fmt: skip


_LISTS: Final = ("events", "placed", "opened", "pillars", "watched")
_PLAIN: Final[dict[str, Any]] = {
    "warp_m": 0.0,
    "resolution": 0.05,
    "radius": 0.17,
    "base": DEFAULT_BASE,
    "lidar": DEFAULT_LIDAR,
    "mounting": Mounting(),
    "quirks": {},
}


def shrink(world: HuntWorld, breaks: Callable[[HuntWorld], float | None], tries: int) -> HuntWorld:
    """Return the smallest world found in so many tries.

    `breaks`: when (s) a world breaks the rule that it is about, or None if it does not.
    """
    left = tries
    changed = True
    while changed and left > 0:
        changed = False
        for smaller in _smaller(world):
            if left <= 0:
                break
            left -= 1
            if breaks(smaller) is not None:
                world, changed = smaller, True
                break
    return world


def _smaller(world: HuntWorld) -> Iterator[HuntWorld]:
    """Yield the next simpler worlds."""
    if world.sensors != Sensors():
        yield replace(world, sensors=Sensors())
    for name in _LISTS:
        yield from (replace(world, **{name: fewer}) for fewer in _fewer(getattr(world, name)))
    for name, plain in _PLAIN.items():
        if getattr(world, name) != plain:
            yield replace(world, **{name: plain})
    for sensors in _plainer(world.sensors):
        yield replace(world, sensors=sensors)
    for free in _fewer(world.free[1:]):
        yield replace(world, free=[*world.free[:1], *free])


def _plainer(sensors: Sensors) -> Iterator[Sensors]:
    usual = asdict(Sensors())
    for name, value in asdict(sensors).items():
        if isinstance(value, list):
            yield from (replace(sensors, **{name: fewer}) for fewer in _fewer(value))
        elif value != usual[name]:
            yield replace(sensors, **{name: usual[name]})


def _fewer(items: list[Any]) -> Iterator[list[Any]]:
    """Yield none of them, if there are several, and all but one."""
    if len(items) > 1:
        yield []
    for index in range(len(items)):
        yield items[:index] + items[index + 1 :]
