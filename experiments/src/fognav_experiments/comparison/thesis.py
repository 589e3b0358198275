"""What the thesis reports (Mendes 2022, chapter 6), as its text states it, and the same quantities here. Pure.

Its figures give no numbers.
"""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

from fognav_experiments.comparison import computation, repeated
from fognav_experiments.comparison.records import MOVE_BASE, ON_ROBOT
from fognav_experiments.comparison.repeated import SETUPS
from fognav_experiments.comparison.situations import Drives, saved, situations
from fognav_experiments.figures import Block, Estimate, Paragraph, Table, estimate, spread, told

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fognav_experiments.comparison.drives import MeasuredDrive, Setup
    from fognav_experiments.comparison.records import Record


class Reported(NamedTuple):
    """A figure of the thesis: what it shows, in simulation (50 runs) and on the robot (10 runs)."""

    figures: str
    subject: str
    simulated: str
    real: str


REPORTED: Final = (
    Reported(
        "6.3, 6.7",
        "distance saved per route (default - full)",
        "around 80 m on each route",
        "around 70, 70 and 30 m",
    ),
    Reported(
        "6.4, 6.8",
        "time saved per route (default - full)",
        "around 20 s on each route",
        "60, 80 and 15 s",
    ),
    Reported(
        "6.5, 6.9",
        "CPU of move_base (default -> full)",
        "more than 175 % -> 25 to 50 % of a core (virtual machine)",
        "around 110 % -> around 20 % (Raspberry Pi 4)",
    ),
    Reported(
        "6.6, 6.10",
        "memory of move_base",
        "no difference",
        "more in full, for the layer that it adds",
    ),
    Reported(
        "(text)",
        "detection of a danger until it reaches the robot",
        "not measured",
        "around 3 s",
    ),
)

PLACES: Final = (
    ("6.1", "default: the path leads into the blocked zone", "`fognav experiment film FILE.png`; tracks.svg, orange"),
    ("6.2", "full: the path avoids it", "the same with --setups default,full; tracks.svg, blue and green"),
    ("6.3", "distance per route, simulated", "distance.svg, and the table below it"),
    ("6.4", "time per route, simulated", "time.svg, and the table below it"),
    ("6.5", "CPU of move_base, simulated", "cpu-move-base.svg, and the table below it"),
    ("6.6", "memory of move_base, simulated", "{live-memory}"),
    ("6.7", "distance per route, real", "distance.svg, as 6.3"),
    ("6.8", "time per route, real", "time.svg, as 6.4"),
    ("6.9", "CPU of move_base, real", "{hardware-cpu}"),
    ("6.10", "memory of move_base, real", "{hardware-memory}"),
    ("6.11", "distance, simulated and real", "{distance}"),
    ("6.12", "time, simulated and real", "{time}"),
)
"""The thesis's figures of chapter 6: what each shows, and where a report has the same."""


class Quantity(NamedTuple):
    """A measured quantity: its figure's title, unit, name of the file, and its value for a drive."""

    title: str
    unit: str
    file: str
    caption: str
    value: Callable[[Record], float]
    of_load: bool = False
    """Whether it depends on what else the machine does."""


QUANTITIES: Final = (
    Quantity(
        "Distance per route",
        "m",
        "distance",
        "As figures 6.3 and 6.7 of the thesis: mean distance per route",
        lambda record: record.distance_m,
    ),
    Quantity(
        "Time per route",
        "s",
        "time",
        "As figures 6.4 and 6.8: mean time per route",
        lambda record: record.time_s or 0.0,
    ),
    Quantity(
        "CPU of what move_base held",
        "% of a core",
        "cpu-move-base",
        "As figures 6.5 and 6.9: global planning, layers and local planning",
        lambda record: record.cpu_percent(MOVE_BASE),
        of_load=True,
    ),
    Quantity(
        "CPU of the whole robot",
        "% of a core",
        "cpu-robot",
        "Not in the thesis: all that the robot computes, without the input and output of its processes",
        lambda record: record.cpu_percent(ON_ROBOT),
        of_load=True,
    ),
)


def paired(records: Sequence[Record]) -> list[Drives]:
    """Return the drives of each run and route of which every setup that was tried at all has a successful one."""
    tried = {record.setup for record in records}
    drives: dict[tuple[int, str], Drives] = defaultdict(dict)
    for record in records:
        drives[record.run, record.route][record.setup] = record
    return [
        by_setup
        for _, by_setup in sorted(drives.items())
        if by_setup.keys() == tried and all(record.success for record in by_setup.values())
    ]


def beside_thesis(
    pairs: Sequence[Drives],
    met: Sequence[Drives],
    setups: Sequence[Setup],
    measured: Sequence[MeasuredDrive],
    records: Sequence[Record],
) -> list[Block]:
    """Return the thesis's figures with ours beside them, and how they can be compared."""
    ours = {"6.3, 6.7": _saved(pairs, met, QUANTITIES[0]), "6.4, 6.8": _saved(pairs, met, QUANTITIES[1])}
    shares = {setup: _mean(pairs, setup, QUANTITIES[2]) for setup in setups}
    ours["6.5, 6.9"] = ", ".join(f"{setup} {found.mean:.2f} %" for setup, found in shares.items())
    ours["6.5, 6.9"] += _less_computation(pairs, setups)
    if (live := repeated.of_processes(measured)) is not None:
        ours["6.5, 6.9"] += (
            f"; the whole robot's real processes {live.before:.2f} % in default and {live.fog:.2f} % in fog: "
            f"{live.before / live.fog:.2f} times less{live.doubt}"
        )
    ours["6.6, 6.10"] = _memory(measured)
    reactions = [record.reaction_s for drives in pairs for record in drives.values() if record.reaction_s is not None]
    if reactions:
        ours["(text)"] = (
            f"{estimate(reactions).mean:.2f} s from the first echo to the first wheel command "
            f"({len(reactions)} drives); not comparable, see below"
        )
    rows = [
        [row.figures, row.subject, row.simulated, row.real, ours.get(row.figures, "not measured")] for row in REPORTED
    ]
    return [
        Table(["figure", "what", "thesis, simulated", "thesis, real", "here"], rows),
        Paragraph(
            "The thesis draws one of two or three corridors to be blocked, so that often the blocked one is "
            f"not on the robot's way. The obstacle met a robot that did not know of it in {len(met)} of "
            f"{len(pairs)} drives here. The floor is another one. Its "
            f"figures 6.11 and 6.12 compare simulation and reality, {_reality(measured, records)}."
        ),
        Paragraph(
            "The thesis's own figures don't fit one another. At 0.3 m/s, a robot's speed here, 80 m less are 267 s "
            "earlier, not 20 (simulated); 70 m less are 233 s, not 60 or 80, and 30 m less 100 s, not 15 (real). At a "
            "Roomba's highest speed, 0.5 m/s, these would still be 160, 140 and 60 s. Here seconds follow from metres."
        ),
        *late(pairs),
        Paragraph(
            "The time from an echo to a wheel command is not comparable with the thesis's 3 s: lockstep has the "
            "waiting times (of measuring, debouncing and control), but no radio, no brokers and no time of "
            "computation, all of which the thesis's robot had. `fognav demo --report FILE` measures it over real "
            "processes."
        ),
    ]


def _less_computation(pairs: Sequence[Drives], setups: Sequence[Setup]) -> str:
    """Return in words how many times less is computed, of the pairs of drives that count."""
    asked: list[tuple[Setup, Setup, str]] = [
        ("default", "fog", ""), ("default", "lean", " by lower rates"), ("lean", "fog", " by the fog"),
        ("default", "full", " by lower rates above all"), ("full", "fog", " by planning in the fog"),
    ]  # fmt: skip
    known = [
        f"{before} / {after}{by} {found:.2f}"
        for before, after, by in asked
        if before in setups and after in setups and (found := computation.ratio(pairs, before, after, MOVE_BASE))
    ]
    return f"; of the pairs that count {', '.join(known)}" if known else "; no pair of drives counts for a ratio"


def result(pairs: Sequence[Drives], met: Sequence[Drives], measured: Sequence[MeasuredDrive]) -> Paragraph:
    """Return what was found, in a sentence or two."""
    if not any("default" in drives and "fog" in drives for drives in pairs):
        return Paragraph(f"{len(pairs)} routes were driven in each setup; `default` and `fog` are not among them.")
    words = f"In none of {len(pairs)} drives did the obstacle meet a robot that did not know of it. "
    if met:
        metres, seconds = zip(*(saved(drives, "default", "fog") for drives in met), strict=True)
        beyond = " (about 2 s of it are no part of the drives, see below)" if late(pairs) else ""
        words = (
            f"Where an obstacle stood in the way, the fog saved a robot {spread(metres)} m and {spread(seconds)} s"
            f"{beyond}: median, least and most of {len(met)} drives of {len(set(situations(met)))} situations, beside "
            f"{len(pairs) - len(met)} drives in which nothing was in its way. "
        )
    if (live := repeated.of_processes(measured)) is not None:
        words += (
            f"As real processes the whole robot took {live.fog:.2f} % of a core instead of {live.before:.2f} %"
            + ("" if (full := repeated.of_processes(measured, "full")) is None else f", and {full[0]:.2f} % in `full`")
            + f"{live.doubt}."
        )
    return Paragraph(words.strip())


def late(pairs: Sequence[Drives]) -> list[Block]:
    """Return what is wrong with the times of drives that were recorded before a drive waited for a switched robot."""
    if all(record.ready is True for drives in pairs for record in drives.values()):
        return []
    return [
        Paragraph(
            "Times of `default` and `full`, and what `fog` saves of them, are about 2 s too large: in lockstep a robot "
            "that plans for itself began to drive that much after the start, for it had only just changed its setup. "
            "Real processes wait for it first, as lockstep does since."
        )
    ]


def _reality(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> str:
    driven = sum(drive.kind == "hardware" for drive in measured)
    if driven:
        return f"as do {driven} drives of a real robot, further below"
    live = len(repeated.compared(measured, records))
    return "for which there is no robot here" + (
        f": {live} drives by real processes on a simulated one are compared with lockstep, further below"
        if live
        else ""
    )


def _memory(measured: Sequence[MeasuredDrive]) -> str:
    """Return in words the largest memory of the robot's processes, by setup."""
    peaks: dict[str, float] = {}
    for drive in measured:
        if (peak := drive.robots_peak_mb()) is not None:
            peaks[drive.setup] = max(peak, peaks.get(drive.setup, 0.0))
    if not peaks:
        return "all setups run in one process in lockstep, which says nothing of a robot's memory"
    words = ", ".join(f"{setup} {peaks[setup]:.0f} MB" for setup in SETUPS if setup in peaks)
    return f"largest of all the robot's processes together: {words}"


def _saved(pairs: Sequence[Drives], met: Sequence[Drives], quantity: Quantity) -> str:
    """Return in words what `fog` saves against `default`."""
    words = ["default - fog"]
    for subject, chosen in (("all", pairs), ("obstacle met", met)):
        both = [drives for drives in chosen if "default" in drives and "fog" in drives]
        if both:
            less = [quantity.value(d["default"]) - quantity.value(d["fog"]) for d in both]
            known = situations(both)
            words.append(f"{subject}: {told(less, known)} {quantity.unit} in {len(set(known))} situations")
    return "; ".join(words) if len(words) > 1 else "not measured"


def places(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> list[Block]:
    """Return where a reader of the thesis finds its figures again."""
    real = any(drive.kind == "hardware" for drive in measured)
    known = repeated.places(measured, records)
    rows = [[figure, shows, place.format(**known)] for figure, shows, place in PLACES]
    words = "Its chapter 6 has no tables. Figures of its real runs (6.7 to 6.12) are those of a robot; " + (
        "drives of a real one are among those by real processes."
        if real
        else "here all robots are simulated, until `fognav experiment --hardware` drives one."
    )
    return [Table(["figure", "shows", "here"], rows), Paragraph(words)]


def _mean(pairs: Sequence[Drives], setup: Setup, quantity: Quantity) -> Estimate:
    return estimate([quantity.value(drives[setup]) for drives in pairs])
