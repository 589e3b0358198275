"""Drives by real processes beside the same ones in lockstep: whether they agree, and what they cost. Pure.

Noise is drawn as often as a process measures, and real processes are scheduled by the machine: no two live drives are
equal to the millimetre. What must agree, within stated tolerances, is what an experiment is about. The thesis's figures
of memory, and of simulation beside reality, need real processes, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from fognav_experiments import figures
from fognav_experiments.comparison.drives import KINDS, PROFILE_OF_SETUP, ROBOTS_PROCESSES, route_ends
from fognav_experiments.comparison.records import loaded_alike
from fognav_experiments.figures import (
    Block,
    Estimate,
    Heading,
    Paragraph,
    Picture,
    Table,
    captioned,
    clustered,
    estimate,
    told,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fognav_experiments.comparison.drives import Kind, MeasuredDrive, Setup
    from fognav_experiments.comparison.records import Record


DISTANCE_M: Final = 1.5
DISTANCE_SHARE: Final = 0.03
TIME_S: Final = 6.0
TIME_SHARE: Final = 0.05
PATHS: Final = 1
STOPPING_MODES: Final = frozenset({"PROTECTIVE_STOP", "FAULT", "EGRESS"})
"""Modes that a drive has not by chance: a robot slows down here and there, and holds for a moment at its goal."""

_BY: Final[dict[Kind, tuple[str, str]]] = {
    "live": ("real processes", "brokers, sockets, threads and serial lines"),
    "hardware": ("a real robot", "as the thesis's figures 6.11 and 6.12 compare simulation and reality"),
}
"""By whom drives of a kind were repeated, and what that means."""


class Compared(NamedTuple):
    """A drive by real processes, the same one in lockstep, and in what they differ beyond the tolerances."""

    live: MeasuredDrive
    lockstep: Record
    differences: list[str]


def compare_drives(live: MeasuredDrive, lockstep: Record) -> Compared:
    """Compare a drive by real processes with the same one in lockstep."""
    found = []
    if live.outcome != lockstep.outcome:
        found.append(f"outcome {live.outcome} ({live.reason}), in lockstep {lockstep.outcome}")
    if abs(live.distance_m - lockstep.distance_m) > max(DISTANCE_M, DISTANCE_SHARE * lockstep.distance_m):
        found.append(f"{live.distance_m:.1f} m, in lockstep {lockstep.distance_m:.1f} m")
    if live.time_s is not None and lockstep.time_s is not None:
        if abs(live.time_s - lockstep.time_s) > max(TIME_S, TIME_SHARE * lockstep.time_s):
            found.append(f"{live.time_s:.1f} s, in lockstep {lockstep.time_s:.1f} s")
    elif live.time_s is not lockstep.time_s:
        found.append("only one of them ended")
    if abs(live.paths - lockstep.paths) > PATHS:
        found.append(f"{live.paths} paths followed, in lockstep {lockstep.paths}")
    if live.route_areas != lockstep.route_areas:
        found.append(f"through {_listed(live.route_areas)}, in lockstep through {_listed(lockstep.route_areas)}")
    if (stopped := _stopping(live.modes)) != (expected := _stopping(lockstep.modes)):
        found.append(f"was in {_listed(sorted(stopped))}, in lockstep in {_listed(sorted(expected))}")
    return Compared(live, lockstep, found)


def compared(live: Sequence[MeasuredDrive], lockstep: Sequence[Record]) -> list[Compared]:
    """Compare all drives of which there is one in lockstep, those under a quota left out."""
    known = {record.name: record for record in lockstep}
    found = ((drive, known.get(drive.in_lockstep or "")) for drive in live)
    return [compare_drives(drive, record) for drive, record in found if record is not None]


def agreement(drives: Sequence[MeasuredDrive], lockstep: Sequence[Record], begun_with: str = "") -> list[Block]:
    """Return the comparison as parts of the report, each with its heading: one per kind of drives, none without any.

    `begun_with`: the commit of the records in lockstep that name none.
    """
    by_kind = ([drive for drive in drives if drive.kind == kind] for kind in KINDS)
    return [block for found in by_kind for block in _agreement(found, lockstep, begun_with)]


def _agreement(live: Sequence[MeasuredDrive], lockstep: Sequence[Record], begun_with: str) -> list[Block]:
    pairs = compared(live, lockstep)
    if not pairs:
        return []
    equal = [_same_commit(pair.live.commit, pair.lockstep.commit or begun_with) for pair in pairs]
    same = all(equal)
    rows = [
        [
            pair.live.name, pair.live.commit or "-", pair.lockstep.commit or begun_with or "-", f"{pair.live.load:.1f}",
            f"{pair.live.distance_m:.1f}", f"{pair.lockstep.distance_m:.1f}",
            _seconds(pair.live.time_s), _seconds(pair.lockstep.time_s), f"{pair.live.paths}", f"{pair.lockstep.paths}",
            "; ".join(pair.differences) or "yes",
        ]
        for pair in pairs
    ]  # fmt: skip
    agreed = sum(not pair.differences for pair in pairs)
    speeds = sorted({pair.live.speed for pair in pairs})
    subject = f"{len(pairs)} of the drives" if same else f"The routes and seeds of {len(pairs)} drives"
    version = "" if same else f" and {'in part ' if any(equal) else ''}another version of the program"
    by, how = _BY[pairs[0].live.kind]
    return [
        Heading(f"The same {'drives' if same else 'routes and seeds'} by {by}"),
        Paragraph(
            f"{subject} were repeated by {by}{version}: {how}, "
            f"at {', '.join(f'{speed:g}' for speed in speeds)} times real time. {agreed} of them agree with lockstep "
            f"in outcome, in distance within {DISTANCE_M} m or {100 * DISTANCE_SHARE:.0f} %, in time within "
            f"{TIME_S:.0f} s or {100 * TIME_SHARE:.0f} %, in the number of paths within {PATHS}, in the watched areas "
            f"that the robot crossed, and in whether it was in one of the modes {_listed(sorted(STOPPING_MODES))}."
        ),
        Table(
            [
                "drive", "commit, live", "commit, lockstep", "load, live", "live, m", "lockstep, m", "live, s",
                "lockstep, s", "paths, live", "paths, lockstep", "agrees",
            ],
            rows,
        ),
    ]  # fmt: skip


def resources(drives: Sequence[MeasuredDrive]) -> list[Block]:
    """Return what the robot's processes cost, by setup, quota, speed and commit; nothing if no drive measured it."""
    measured = [drive for drive in drives if drive.cpu_percent and drive.peak_mb]
    rows = []
    for setup, quota, speed, commit in sorted({_circumstances(drive) for drive in measured}, key=str):
        chosen = [drive for drive in measured if _circumstances(drive) == (setup, quota, speed, commit)]
        shares = [_mean([drive.cpu_percent.get(name, 0.0) for drive in chosen]) for name in ROBOTS_PROCESSES]
        peaks = [max(drive.peak_mb.get(name, 0.0) for drive in chosen) for name in ROBOTS_PROCESSES]
        times = [drive.time_s for drive in chosen if drive.time_s is not None]
        loads = [drive.load for drive in chosen]
        rows.append([
            setup, "none" if quota is None else f"{quota:g} of a core", f"{speed:g}", commit or "-",
            f"{min(loads):.0f} to {max(loads):.0f}", str(len(chosen)),
            *(f"{share:.2f}" for share in shares), f"{sum(shares):.2f}",
            *(f"{peak:.0f}" for peak in peaks), f"{sum(peaks):.0f}", _seconds(_mean(times) if times else None),
        ])  # fmt: skip
    if not rows:
        return []
    names = [name.removeprefix("robot-") for name in ROBOTS_PROCESSES]
    return [
        Paragraph(
            "What the robot's processes took, by the kernel's account: mean share of one core, per second of the "
            "system's clock, and the largest resident memory of any drive. A quota limits all of them together to a "
            "share of one core, as control groups enforce it."
        ),
        Table(
            [
                "setup", "quota", "speed", "commit", "load", "drives", *(f"{name}, %" for name in names), "robot, %",
                *(f"{name}, MB" for name in names), "robot, MB", "mean time, s",
            ],
            rows,
        ),
    ]  # fmt: skip


class OfProcesses(NamedTuple):
    """What the robot's processes took in two setups, % of a core, and how many pairs of drives can be compared."""

    before: float
    fog: float
    pairs: int
    counted: int

    @property
    def doubt(self) -> str:
        """What is to be said beside a difference of the two, in brackets; empty if all pairs count."""
        if self.counted == self.pairs:
            return ""
        return (
            f" (an indication: {self.counted} of {self.pairs} pairs of drives count by the rule for lockstep, one "
            "commit and like loads of the machine)"
        )


def of_processes(drives: Sequence[MeasuredDrive], before: Setup = "default") -> OfProcesses | None:
    """Return what the robot's processes took in `before` and in `fog`, of draws driven in both; None without any.

    Of drives that reached their goal, at the pace of real time and without a quota.
    """
    plain = [
        drive
        for drive in drives
        if drive.cpu_percent and drive.success and drive.cpu_quota is None and drive.speed == 1.0
    ]
    ours, others = ([drive for drive in plain if drive.setup == setup] for setup in ("fog", before))
    pairs = [(one, other) for one in others for other in ours if (one.run, one.route) == (other.run, other.route)]
    if not pairs:
        return None
    counted = sum(one.commit == other.commit and loaded_alike((one, other)) for one, other in pairs)
    before_percent, fog_percent = (_mean(list(map(_of_robot, drives))) for drives in zip(*pairs, strict=True))
    return OfProcesses(before_percent, fog_percent, len(pairs), counted)


def _of_robot(drive: MeasuredDrive) -> float:
    return sum(drive.cpu_percent.get(name, 0.0) for name in ROBOTS_PROCESSES)


def _circumstances(drive: MeasuredDrive) -> tuple[str, float | None, float, str]:
    """Return what a drive's cost depends on, its route apart."""
    return drive.setup, drive.cpu_quota, drive.speed, drive.commit


def _same_commit(one: str, other: str) -> bool:
    """Whether two revisions, shortened or not, are the same; one that is not known is no other's."""
    return bool(one and other) and (one.startswith(other) or other.startswith(one))


def _mean(values: Sequence[float]) -> float:
    return estimate(values).mean if values else 0.0


def _stopping(modes: dict[str, int]) -> frozenset[str]:
    return STOPPING_MODES & modes.keys()


def _seconds(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


SETUPS: Final[tuple[Setup, ...]] = tuple(PROFILE_OF_SETUP)
_UNKNOWN: Final[dict[Kind, str]] = {
    "live": "only by real processes (fognav experiment --live): lockstep runs all setups in one",
    "hardware": "only by a real robot (fognav experiment --hardware), whose exporter tells it",
}
_REALITY_UNKNOWN: Final = "only by real processes (fognav experiment --live or --hardware)"


class _Quantity(NamedTuple):
    figure: str
    title: str
    unit: str
    file: str
    value: Callable[[MeasuredDrive | Record], float]


_QUANTITIES: Final = (
    _Quantity("6.11", "Distance", "m", "distance", lambda drive: drive.distance_m),
    _Quantity("6.12", "Time", "s", "time", lambda drive: drive.time_s or 0.0),
)


def places(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> dict[str, str]:
    """Return where a reader of the thesis finds its figures of real processes (6.6, 6.9 to 6.12)."""
    kinds = [kind for kind in KINDS if _both(kind, measured, records)]
    found = {
        f"{kind}-{cost.file}": f"{kind}-{cost.file}.svg, and the table below it"
        if _with_cost(measured, kind, cost)
        else _UNKNOWN[kind]
        for kind in KINDS
        for cost in _COSTS
    }
    for quantity in _QUANTITIES:
        files = " and ".join(f"{kind}-{quantity.file}.svg" for kind in kinds)
        found[quantity.file] = f"{files}, and the table below" if files else _REALITY_UNKNOWN
    return found


class _Cost(NamedTuple):
    figures: dict[Kind, str]
    title: str
    unit: str
    file: str
    what: str
    value: Callable[[MeasuredDrive], float | None]


_COSTS: Final = (
    _Cost(
        {"live": "Not in the thesis, nearest to its figure 6.5", "hardware": "As figure 6.9 of the thesis"},
        "CPU of the robot's processes", "% of a core", "cpu",
        "mean share of a core that agent, guardian and watchdog took together",
        lambda drive: _of_robot(drive) if drive.cpu_percent else None,
    ),
    _Cost(
        {"live": "As figure 6.6 of the thesis", "hardware": "As figure 6.10 of the thesis"},
        "Memory of the robot's processes", "MB", "memory",
        "the largest resident memory of agent, guardian and watchdog, added up",
        lambda drive: drive.robots_peak_mb(),
    ),
)  # fmt: skip


def processes(measured: Sequence[MeasuredDrive]) -> list[Block]:
    """Return CPU and memory of the robot's processes by route and setup, by kind; nothing if no drive measured it."""
    blocks: list[Block] = []
    for kind in KINDS:
        for cost in _COSTS:
            if drives := _with_cost(measured, kind, cost):
                blocks += _cost(kind, cost, drives)
    return [*blocks, *_threads(measured)]


def _cost(kind: Kind, cost: _Cost, drives: Sequence[MeasuredDrive]) -> list[Block]:
    routes = sorted({drive.route for drive in drives})
    setups = [setup for setup in SETUPS if any(drive.setup == setup for drive in drives)]
    titles = [route_ends(route) for route in routes]
    series: dict[str, list[Estimate | None]] = {setup: [] for setup in setups}
    rows = [[title] for title in titles]
    for row, route in zip(rows, routes, strict=True):
        for setup in setups:
            chosen = [drive for drive in drives if (drive.route, drive.setup) == (route, setup)]
            values = [value for drive in chosen if (value := cost.value(drive)) is not None]
            known = [drive.situation for drive in chosen]
            series[setup].append(clustered(values, known) if values else None)
            row.append(told(values, known) if values else "-")
    caption = (
        f"{cost.figures[kind]}: {cost.what}, mean of {len(drives)} drives by {_BY[kind][0]} that reached their goal"
    )
    shown = [found for values in series.values() for found in values]
    svg = figures.bars(cost.title, cost.unit, titles, series)
    return [
        Picture(f"{kind}-{cost.file}.svg", svg, captioned(caption, shown)),
        Table([f"{cost.title}, {cost.unit}, by {_BY[kind][0]}", *setups], rows),
    ]


def _threads(measured: Sequence[MeasuredDrive]) -> list[Block]:
    """Return what each thread of the robot's processes took, of the drives whose exporter told it."""
    known = [drive for drive in measured if drive.success and isinstance(drive.thread_percent, dict)]
    shares: dict[tuple[Kind, str, str], dict[Setup, list[float]]] = {}
    for drive in known:
        assert isinstance(drive.thread_percent, dict)
        for process, threads in drive.thread_percent.items():
            for thread, percent in threads.items():
                shares.setdefault((drive.kind, process, thread), {}).setdefault(drive.setup, []).append(percent)
    if not shares:
        return []
    setups = [setup for setup in SETUPS if any(drive.setup == setup for drive in known)]
    rows = [
        [kind, process, thread, *(f"{_mean(found[setup]):.2f}" if setup in found else "-" for setup in setups)]
        for (kind, process, thread), found in sorted(shares.items())
    ]
    return [
        Paragraph(f"Mean share of a core (%) by thread, as the robot's exporter told it in {len(known)} drives."),
        Table(["drives", "process", "thread", *setups], rows),
    ]


def beside_lockstep(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> list[Block]:
    """Return distance and time of the drives that reached their goal in lockstep and by real processes, by kind."""
    blocks: list[Block] = []
    for kind in KINDS:
        pairs = _both(kind, measured, records)
        if pairs:
            blocks += [Heading(f"Lockstep beside {_BY[kind][0]}"), *_charts(kind, pairs)]
    return blocks


def _charts(kind: Kind, pairs: Sequence[Compared]) -> list[Block]:
    bars_of = sorted({(pair.live.route, SETUPS.index(pair.live.setup)) for pair in pairs})
    chosen = [
        [pair for pair in pairs if (pair.live.route, pair.live.setup) == (route, SETUPS[place])]
        for route, place in bars_of
    ]
    groups = [f"{route_ends(route)}\n{SETUPS[place]}" for route, place in bars_of]
    blocks: list[Block] = [
        Paragraph(
            f"{len(pairs)} drives that reached their goal both in lockstep and by {_BY[kind][0]}, none under a quota: "
            "the same routes, draws and setups in both."
        )
    ]
    columns: list[list[str]] = []
    for quantity in _QUANTITIES:
        series = {
            "lockstep": [[quantity.value(pair.lockstep) for pair in drives] for drives in chosen],
            kind: [[quantity.value(pair.live) for pair in drives] for drives in chosen],
        }
        known = [[pair.live.situation for pair in drives] for drives in chosen]
        bars = {name: list(map(clustered, values, known)) for name, values in series.items()}
        caption = (
            f"As figure {quantity.figure} of the thesis, which compares simulation and reality: mean "
            f"{quantity.title.lower()} in lockstep and by {_BY[kind][0]}"
        )
        svg = figures.bars(f"{quantity.title}, lockstep and {kind}", quantity.unit, groups, bars)
        shown = captioned(caption, [found for values in bars.values() for found in values])
        blocks.append(Picture(f"{kind}-{quantity.file}.svg", svg, shown))
        columns += [list(map(told, values, known)) for values in series.values()]
        columns.append([
            told([quantity.value(pair.live) - quantity.value(pair.lockstep) for pair in drives], situations)
            for drives, situations in zip(chosen, known, strict=True)
        ])  # fmt: skip
    header = [f"{name}, {quantity.unit}" for quantity in _QUANTITIES for name in ("lockstep", kind, "difference")]
    rows = [
        [*group.split("\n"), str(len(drives)), *(column[number] for column in columns)]
        for number, (group, drives) in enumerate(zip(groups, chosen, strict=True))
    ]
    return [*blocks, Table(["route", "setup", "drives", *header], rows)]


def _both(kind: Kind, measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> list[Compared]:
    """Return the drives of a kind that reached their goal as in lockstep; those under a quota are left out."""
    pairs = compared([drive for drive in measured if drive.kind == kind], records)
    return [pair for pair in pairs if pair.live.success and pair.lockstep.success]


def _with_cost(measured: Sequence[MeasuredDrive], kind: Kind, cost: _Cost) -> list[MeasuredDrive]:
    return [
        drive
        for drive in measured
        if drive.kind == kind and drive.success and drive.cpu_quota is None and cost.value(drive) is not None
    ]
