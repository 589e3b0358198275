"""The thesis's figures that need drives by real processes: memory, and simulation beside what was driven. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from fognav_experiments import plots
from fognav_experiments.comparison import agreement, limits
from fognav_experiments.comparison.document import Block, Figure, Heading, Paragraph, Table
from fognav_experiments.comparison.driven import route_ends
from fognav_experiments.comparison.measured import KINDS
from fognav_experiments.comparison.thesis import MEMORY_UNKNOWN, REALITY_UNKNOWN
from fognav_experiments.statistics import Estimate, estimate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.messages import ProfileName
    from fognav_experiments.comparison.agreement import Compared
    from fognav_experiments.comparison.measured import Kind, MeasuredDrive
    from fognav_experiments.comparison.records import Record

SETUPS: Final[tuple[ProfileName, ...]] = ("default", "full", "fog")
MEMORY_FILE: Final = "memory.svg"
_BY: Final[dict[Kind, str]] = {"live": "real processes", "hardware": "a real robot"}


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
    """Return where a reader of the thesis finds its figures of memory (6.6, 6.10) and of reality (6.11, 6.12)."""
    kinds = [kind for kind in KINDS if _both(kind, measured, records)]
    found = {"memory": f"{MEMORY_FILE}, and the table below it" if _with_memory(measured) else MEMORY_UNKNOWN}
    for quantity in _QUANTITIES:
        files = " and ".join(f"{kind}-{quantity.file}.svg" for kind in kinds)
        found[quantity.file] = f"{files}, and the table below" if files else REALITY_UNKNOWN
    return found


def memory(measured: Sequence[MeasuredDrive]) -> list[Block]:
    """Return how much memory the robot's processes take by route and setup; nothing if no drive measured it."""
    drives = _with_memory(measured)
    if not drives:
        return []
    routes = sorted({drive.route for drive in drives})
    setups = [setup for setup in SETUPS if any(drive.setup == setup for drive in drives)]
    series: dict[str, list[Estimate | None]] = {
        setup: [_peaks([d for d in drives if (d.route, d.setup) == (route, setup)]) for route in routes]
        for setup in setups
    }
    titles = [route_ends(route) for route in routes]
    title = "Memory of the robot's processes"
    caption = (
        "As figures 6.6 and 6.10 of the thesis: the largest resident memory of agent, guardian and watchdog, added up, "
        f"mean of {len(drives)} drives by real processes that reached their goal, with 95 % confidence intervals."
    )
    rows = [[name, *(_text(series[setup][number]) for setup in setups)] for number, name in enumerate(titles)]
    return [
        Figure(MEMORY_FILE, plots.bars(title, "MB", titles, series), caption),
        Table([f"{title}, MB", *setups], rows),
    ]


def beside_lockstep(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> list[Block]:
    """Return distance and time of the drives that reached their goal in lockstep and by real processes, by kind."""
    blocks: list[Block] = []
    for kind in KINDS:
        pairs = _both(kind, measured, records)
        if pairs:
            blocks += [Heading(f"Lockstep beside {_BY[kind]}"), *_charts(kind, pairs)]
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
            f"{len(pairs)} drives that reached their goal both in lockstep and by {_BY[kind]}, none under a quota: the "
            "same routes, draws and setups in both."
        )
    ]
    columns: list[list[str]] = []
    for quantity in _QUANTITIES:
        series = {
            "lockstep": [estimate([quantity.value(pair.lockstep) for pair in drives]) for drives in chosen],
            kind: [estimate([quantity.value(pair.live) for pair in drives]) for drives in chosen],
        }
        caption = (
            f"As figure {quantity.figure} of the thesis, which compares simulation and reality: mean "
            f"{quantity.title.lower()} in lockstep and by {_BY[kind]}, with 95 % confidence intervals."
        )
        svg = plots.bars(f"{quantity.title}, lockstep and {kind}", quantity.unit, groups, series)
        blocks.append(Figure(f"{kind}-{quantity.file}.svg", svg, caption))
        columns += [[limits.text(found) for found in values] for values in series.values()]
        columns.append([
            limits.text(estimate([quantity.value(pair.live) - quantity.value(pair.lockstep) for pair in drives]))
            for drives in chosen
        ])  # fmt: skip
    header = [f"{name}, {quantity.unit}" for quantity in _QUANTITIES for name in ("lockstep", kind, "difference")]
    rows = [
        [*group.split("\n"), str(len(drives)), *(column[number] for column in columns)]
        for number, (group, drives) in enumerate(zip(groups, chosen, strict=True))
    ]
    return [*blocks, Table(["route", "setup", "drives", *header], rows)]


def _both(kind: Kind, measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> list[Compared]:
    """Return the drives of a kind that reached their goal as in lockstep; those under a quota are left out."""
    pairs = agreement.compared([drive for drive in measured if drive.kind == kind], records)
    return [pair for pair in pairs if pair.live.success and pair.lockstep.success]


def _with_memory(measured: Sequence[MeasuredDrive]) -> list[MeasuredDrive]:
    return [d for d in measured if d.success and d.cpu_quota is None and d.robots_peak_mb() is not None]


def _peaks(drives: Sequence[MeasuredDrive]) -> Estimate | None:
    peaks = [peak for drive in drives if (peak := drive.robots_peak_mb()) is not None]
    return estimate(peaks) if peaks else None


def _text(found: Estimate | None) -> str:
    return "-" if found is None else limits.text(found)
