"""The report of a comparison: the thesis's figures and tables with ours beside them, and what ours adds. Pure."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from fognav_experiments import plots
from fognav_experiments.comparison import agreement, limits, repeated
from fognav_experiments.comparison.document import Block, Code, Figure, Heading, Paragraph, Table, flat
from fognav_experiments.comparison.driven import route_ends
from fognav_experiments.comparison.records import ALIKE, MOVE_BASE, OF_FOG, ON_FOG, ON_ROBOT, machines
from fognav_experiments.comparison.repeated import SETUPS
from fognav_experiments.comparison.thesis import PLACES, REPORTED
from fognav_experiments.statistics import Estimate, compare, estimate

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.messages import ProfileName
    from fog_contracts.site import Site
    from fognav_experiments.comparison.geometry import Saving
    from fognav_experiments.comparison.measured import MeasuredDrive
    from fognav_experiments.comparison.records import Record

TITLE: Final = "What the fog saves a robot: the thesis's experiment, repeated"
PAIRS: Final[tuple[tuple[ProfileName, ProfileName], ...]] = (("default", "full"), ("default", "fog"), ("full", "fog"))

Drives = dict["ProfileName", "Record"]


class Quantity(NamedTuple):
    """A measured quantity: its figure's title, unit, name of the file, and its value for a drive."""

    title: str
    unit: str
    file: str
    caption: str
    value: Callable[[Record], float]


QUANTITIES: Final = (
    Quantity(
        "Distance per route",
        "m",
        "distance",
        "As figures 6.3 and 6.7 of the thesis: mean distance per route, with 95 % confidence intervals.",
        lambda record: record.distance_m,
    ),
    Quantity(
        "Time per route",
        "s",
        "time",
        "As figures 6.4 and 6.8: mean time per route, with 95 % confidence intervals.",
        lambda record: record.time_s or 0.0,
    ),
    Quantity(
        "CPU of what move_base held",
        "% of a core",
        "cpu-move-base",
        "As figures 6.5 and 6.9: global planning, layers and local planning, with 95 % confidence intervals.",
        lambda record: record.cpu_percent(MOVE_BASE),
    ),
    Quantity(
        "CPU of the whole robot",
        "% of a core",
        "cpu-robot",
        "Not in the thesis: all that the robot computes, without the input and output of its processes.",
        lambda record: record.cpu_percent(ON_ROBOT),
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


def build(
    records: Sequence[Record],
    experiment: Mapping[str, Any],
    savings: Mapping[tuple[int, str], Saving] | None = None,
    measured: Sequence[MeasuredDrive] = (),
    site: Site | None = None,
) -> list[Block]:
    """Return the report of these records, measured on what `experiment` says.

    `savings`: by run and route, what the map alone says of them, as far as that is known. `measured`: drives by real
    processes. `site`: that of the drives, if it is at hand.
    """
    savings = savings or {}
    pairs = paired(records)
    setups = [setup for setup in SETUPS if any(record.setup == setup for record in records)]
    blocks: list[Block] = [Heading(TITLE, 1), *_introduction(records, pairs, experiment)]
    if not pairs:
        return [
            *blocks,
            Paragraph("No route has succeeded in every setup yet: there is nothing to compare."),
        ]
    met = [by_setup for by_setup in pairs if _met(by_setup, savings)]
    return [
        *blocks,
        Heading("Beside the thesis"),
        *_beside_thesis(pairs, met, setups, measured, records),
        Heading("Each figure of the thesis, and where it is here"),
        *_places(measured, records),
        Heading("Distance, time and computation per route"),
        *_routes(pairs, setups),
        Heading("Paired differences"),
        *_differences(pairs, met, setups),
        *_bounds(pairs, savings),
        Heading("Where the computation goes"),
        *_components(pairs, setups, measured),
        *agreement.agreement(measured, records, str(experiment["measured_on"].get("commit", ""))),
        *repeated.beside_lockstep(measured, records),
        *_cost(measured),
        Heading("One drive, seen from above"),
        *_tracks(pairs, setups, site),
        Heading("Drives that failed, and contacts"),
        *_failures(records, measured),
    ]


def _introduction(records: Sequence[Record], pairs: Sequence[Drives], experiment: Mapping[str, Any]) -> list[Block]:
    asked, measured = experiment["asked"], experiment["measured_on"]
    setups = ",".join(setup for setup in SETUPS if any(record.setup == setup for record in records))
    runs = max((record.run for record in records), default=0)
    command = f"fognav experiment --setups {setups} --runs {runs} --seed {asked['seed']} --out DIR"
    rows = [[name, str(value)] for name, value in flat(measured)]
    for machine in machines(experiment)[1:]:
        rows += [[f"later {name}", str(value)] for name, value in flat(machine) if name != "commit"]
    jobs = sorted({record.jobs for record in records})
    speed = sum(record.time_s or 0.0 for record in records) / max(sum(record.wall_s for record in records), 1e-9)
    rows.append(["lockstep", f"{speed:.1f} times as fast as real time"])
    for commit in sorted({record.commit for record in records} - {""}):
        count = sum(record.commit == commit for record in records)
        rows.append(["commit", f"{commit}: {count} of the drives"])
    for count in jobs:
        beside = [record.load for record in records if record.jobs == count]
        words = f"{len(beside)} of the drives, at a load average of {min(beside):.1f} to {max(beside):.1f}"
        rows.append([f"{count} at a time", words])
    loads = [record.load for record in records]
    return [
        Paragraph(
            "A robot drives from stop to stop through a building. On each route something blocks one of the "
            "corridors that sensors on the walls watch. In the setup `default` the robot does everything "
            "itself and knows nothing of the obstacle before its own lidar sees it. In `full`, the setup of "
            "the thesis, it plans itself, too, but a computer in the building tells it which corridor is "
            "blocked. In `fog`, Fognav's own, that computer also keeps the map and plans. All three are the "
            "same program with the same algorithms; each meets the same obstacles at the same moments, drawn "
            "from a seed. All processes' cores, sensors and radio messages are simulated in lockstep; "
            "distances are those of the simulator's ground truth."
        ),
        Paragraph(
            f"{len(records)} drives stand, {len(pairs)} of them in each of the setups on the same run and "
            f"route: these are compared. CPU is what the thread spent, by the kernel's account, at "
            f"{' or '.join(map(str, jobs))} drive{'' if jobs == [1] else 's'} at a time and a load average of "
            f"{min(loads, default=0.0):.1f} to {max(loads, default=0.0):.1f}."
        ),
        Code(command),
        Table(["measured on", ""], [["site", f"{asked['site']} ({asked['site_digest']})"], *rows]),
    ]


def _met(by_setup: Drives, savings: Mapping[tuple[int, str], Saving]) -> bool:
    """Whether the obstacle stood in the way of a robot that knew nothing of it."""
    saving = savings.get(_key(by_setup))
    if saving is not None:
        return saving.met
    unwarned = by_setup.get("default")
    return unwarned is not None and unwarned.paths > 1


def _key(by_setup: Drives) -> tuple[int, str]:
    record = next(iter(by_setup.values()))
    return record.run, record.route


def _bounds(pairs: Sequence[Drives], savings: Mapping[tuple[int, str], Saving]) -> list[Block]:
    both = [drives for drives in pairs if "default" in drives and "fog" in drives and _key(drives) in savings]
    distance, time = (quantity.value for quantity in QUANTITIES[:2])
    drives = [
        (
            savings[_key(drives)],
            distance(drives["default"]) - distance(drives["fog"]),
            time(drives["default"]) - time(drives["fog"]),
        )
        for drives in both
    ]
    blocks = limits.geometry(drives)
    return [Heading("What the floor allows to save"), *blocks] if blocks else []


def _cost(measured: Sequence[MeasuredDrive]) -> list[Block]:
    cost = [*agreement.resources(measured), *repeated.memory(measured)]
    return [Heading("What the robot's processes cost"), *cost] if cost else []


def _beside_thesis(
    pairs: Sequence[Drives],
    met: Sequence[Drives],
    setups: Sequence[ProfileName],
    measured: Sequence[MeasuredDrive],
    records: Sequence[Record],
) -> list[Block]:
    ours = {"6.3, 6.7": _saved(pairs, met, QUANTITIES[0]), "6.4, 6.8": _saved(pairs, met, QUANTITIES[1])}
    shares = {setup: _mean(pairs, setup, QUANTITIES[2]) for setup in setups}
    ours["6.5, 6.9"] = ", ".join(f"{setup} {found.mean:.2f} %" for setup, found in shares.items())
    if "default" in shares and "fog" in shares:
        whole = [_mean(pairs, setup, QUANTITIES[3]).mean for setup in ("default", "fog")]
        ours["6.5, 6.9"] += f": default / fog = {shares['default'].mean / shares['fog'].mean:.1f}"
        if "full" in shares:
            lower_rates = shares["default"].mean / shares["full"].mean
            ours["6.5, 6.9"] += f", of which default / full, by lower rates above all, {lower_rates:.1f}"
        ours["6.5, 6.9"] += f"; whole robot {whole[0]:.2f} % and {whole[1]:.2f} %: {whole[0] / whole[1]:.1f}"
        if (live := agreement.of_processes(measured)) is not None:
            ours["6.5, 6.9"] += f"; its real processes {live[0]:.2f} % and {live[1]:.2f} %: {live[0] / live[1]:.2f}"
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
            f"{len(pairs)} drives here. The floor is another one, made in the manner of the thesis's. Its "
            f"figures 6.11 and 6.12 compare simulation and reality, {_reality(measured, records)}."
        ),
        Paragraph(
            "Times of `default` and `full`, and what `fog` saves of them, are about 2 s too large: in lockstep a robot "
            "that plans for itself begins to drive that much after the start, for it has only just changed its setup. "
            "Real processes wait for it first."
        ),
        Paragraph(
            "The time from an echo to a wheel command is not comparable with the thesis's 3 s: lockstep has the "
            "waiting times (of measuring, debouncing and control), but no radio, no brokers and no time of "
            "computation, all of which the thesis's robot had. `fognav demo --report FILE` measures it over real "
            "processes."
        ),
    ]


def _reality(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> str:
    driven = sum(drive.kind == "hardware" for drive in measured)
    if driven:
        return f"as do {driven} drives of a real robot, further below"
    live = len(agreement.compared(measured, records))
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
            found = compare([quantity.value(d["default"]) for d in both], [quantity.value(d["fog"]) for d in both])
            words.append(f"{subject}: {limits.text(found.difference)} {quantity.unit}")
    return "; ".join(words) if len(words) > 1 else "not measured"


def _routes(pairs: Sequence[Drives], setups: Sequence[ProfileName]) -> list[Block]:
    routes = sorted({drives[setups[0]].route for drives in pairs})
    blocks: list[Block] = []
    for quantity in QUANTITIES:
        series: dict[str, list[Estimate]] = {
            setup: [
                estimate([quantity.value(drives[setup]) for drives in pairs if drives[setup].route == route])
                for route in routes
            ]
            for setup in setups
        }
        rows = [
            [route_ends(route), *(limits.text(series[setup][number]) for setup in setups)]
            for number, route in enumerate(routes)
        ]
        groups = [route_ends(route) for route in routes]
        svg = plots.bars(quantity.title, quantity.unit, groups, series)
        blocks.append(Figure(f"{quantity.file}.svg", svg, quantity.caption))
        blocks.append(Table([f"{quantity.title}, {quantity.unit}", *setups], rows))
    return blocks


def _differences(pairs: Sequence[Drives], met: Sequence[Drives], setups: Sequence[ProfileName]) -> list[Block]:
    rows = []
    for before, after in PAIRS:
        if before not in setups or after not in setups:
            continue
        for subject, chosen in (("all drives", pairs), ("obstacle met", met)):
            if not chosen:
                continue
            for quantity in QUANTITIES:
                found = compare(
                    [quantity.value(drives[before]) for drives in chosen],
                    [quantity.value(drives[after]) for drives in chosen],
                )
                rows.append([
                    f"{before} - {after}", subject, f"{quantity.title}, {quantity.unit}", limits.text(found.difference),
                    str(found.difference.n), _probability(found.p_t), _probability(found.p_flip),
                ])  # fmt: skip
    return [
        Paragraph(
            "Mean differences of the same run and route, with 95 % confidence intervals, and the probability "
            "of one as large by chance: by the paired t test, and by the sign-flip test, which assumes no "
            "distribution. The routes of all runs are pooled."
        ),
        Table(["setups", "drives", "quantity", "mean difference", "n", "p (t test)", "p (sign flips)"], rows),
    ]


def _components(
    pairs: Sequence[Drives], setups: Sequence[ProfileName], measured: Sequence[MeasuredDrive]
) -> list[Block]:
    rows = []
    for component in (*ON_ROBOT, *ON_FOG):
        cells = []
        for setup in setups:
            unused = component in ON_FOG and component not in OF_FOG[setup]
            share = estimate([drives[setup].cpu_percent([component]) for drives in pairs]).mean
            cells.append("-" if unused else f"{share:.3f}")
        rows.append([component, *cells])
    for name, components in (("what move_base held", MOVE_BASE), ("whole robot", ON_ROBOT)):
        means = (estimate([drives[setup].cpu_percent(components) for drives in pairs]).mean for setup in setups)
        rows.append([f"sum: {name}", *(f"{mean:.3f}" for mean in means)])
    received = [
        f"{estimate([drives[setup].received_bytes / (drives[setup].time_s or 1.0) for drives in pairs]).mean:.0f}"
        for setup in setups
    ]
    rows.append(["received from the fog, bytes/s", *received])
    blocks: list[Block] = [
        Paragraph(
            "Mean share of one core, in %, by component. Left out are decoding of messages, sockets and "
            "serial ports, which lockstep does not have; what a setup does not use of the fog is not counted."
        ),
        Table(["component", *setups], rows),
        *limits.error([[drives[setup].cpu_percent(ALIKE) for setup in setups] for drives in pairs], setups),
    ]
    if "default" in setups and "fog" in setups:
        default, full, fog = (
            {name: _share(pairs, setup, [name]) for name in MOVE_BASE} if setup in setups else {} for setup in SETUPS
        )
        whole = _share(pairs, "default", ON_ROBOT), _share(pairs, "fog", ON_ROBOT)
        blocks.append(limits.computation(default, full or None, fog, whole, agreement.of_processes(measured)))
    return blocks


def _share(pairs: Sequence[Drives], setup: ProfileName, components: Sequence[str]) -> float:
    return estimate([drives[setup].cpu_percent(components) for drives in pairs]).mean


def _tracks(pairs: Sequence[Drives], setups: Sequence[ProfileName], site: Site | None) -> list[Block]:
    first, last = setups[0], setups[-1]
    drives = max(pairs, key=lambda drives: drives[first].distance_m - drives[last].distance_m)
    record = drives[first]
    blocked, stops = _ends(record, site) if site is not None else ((), {})
    svg = plots.tracks({setup: drives[setup].track for setup in setups}, blocked, stops)
    lengths = ", ".join(f"{setup} {drives[setup].distance_m:.0f} m" for setup in setups)
    caption = (
        f"As figures 6.1 and 6.2: run {record.run}, {route_ends(record.route)}, {record.area} is blocked: {lengths}."
    )
    return [Figure("tracks.svg", svg, caption)]


def _ends(record: Record, site: Site) -> tuple[Sequence[tuple[float, float]], dict[str, tuple[float, float]]]:
    """Return the corners (m) of the area that was blocked, and the two stops of the route."""
    blocked = next((area.polygon for area in site.definitions() if area.id == record.area), ())
    names = [name for name in site.places if record.route.startswith(name) or record.route.endswith(name)]
    stops = {name.upper(): (site.places[name].x, site.places[name].y) for name in names}
    return [(x, y) for x, y in blocked], stops


def _places(measured: Sequence[MeasuredDrive], records: Sequence[Record]) -> list[Block]:
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


def _failures(records: Sequence[Record], measured: Sequence[MeasuredDrive]) -> list[Block]:
    rows = [
        [record.name, "lockstep", record.outcome, record.reason, str(record.contacts), "; ".join(record.stops)]
        for record in records
        if not record.success or record.contacts or record.stops
    ]
    blocks: list[Block] = []
    if not rows:
        words = f"None of {len(records)} drives in lockstep failed, touched anything, or had a protective stop."
        blocks.append(Paragraph(words))
    rows += [
        [drive.name, drive.kind, drive.outcome, drive.reason, "not counted", "; ".join(drive.stops)]
        for drive in measured
        if not drive.success or drive.stops
    ]
    if measured:
        failed = sum(not drive.success for drive in measured)
        stopped = sum(bool(drive.stops) for drive in measured)
        blocks.append(
            Paragraph(
                f"Of {len(measured)} drives by real processes {failed} failed, and {stopped} had a protective stop or "
                "a fault."
            )
        )
    header = ["drive", "made", "outcome", "reason", "contacts", "protective stops and faults"]
    return [*blocks, Table(header, rows)] if rows else blocks


def summary_rows(records: Sequence[Record]) -> list[list[str]]:
    """Return the table of means as rows of a CSV file, with a header."""
    pairs = paired(records)
    rows = [["quantity", "unit", "route", "setup", "mean", "half_width_95", "n"]]
    for quantity in QUANTITIES:
        for route in sorted({record.route for record in records}):
            for setup in SETUPS:
                chosen = [drives[setup] for drives in pairs if setup in drives and drives[setup].route == route]
                if chosen:
                    found = estimate([quantity.value(record) for record in chosen])
                    half = "" if found.half is None else f"{found.half:.4f}"
                    rows.append([quantity.file, quantity.unit, route, setup, f"{found.mean:.4f}", half, str(found.n)])
    return rows


def _mean(pairs: Sequence[Drives], setup: ProfileName, quantity: Quantity) -> Estimate:
    return estimate([quantity.value(drives[setup]) for drives in pairs])


def _probability(p: float | None) -> str:
    if p is None:
        return "-"
    return "< 0.0001" if p < 0.0001 else f"{p:.4f}"
