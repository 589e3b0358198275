"""The report of a comparison: what the fog saves by route, setup and component, and its files.

Markdown with its figures, CSV of drives and means, and the archive of all records.
"""

from __future__ import annotations

import csv
import io
import itertools
from typing import TYPE_CHECKING, Any, Final

import msgspec

from fog_runtime.configuration.site import load_site
from fog_runtime.files import SHARED, atomic_write
from fognav_experiments import figures
from fognav_experiments.comparison import break_even, computation, limits, repeated, runner
from fognav_experiments.comparison.drives import KINDS, route_ends
from fognav_experiments.comparison.limits import RouteGeometry, Saved
from fognav_experiments.comparison.records import (
    ARCHIVE,
    Asked,
    FolderError,
    machines,
    write_archive,
    write_csv,
)
from fognav_experiments.comparison.repeated import SETUPS
from fognav_experiments.comparison.situations import Drives, by_situation, situations, values, worse
from fognav_experiments.comparison.thesis import QUANTITIES, beside_thesis, paired, places, result
from fognav_experiments.figures import (
    FEWEST_CLUSTERS,
    Block,
    Code,
    Estimate,
    Heading,
    Paragraph,
    Picture,
    Table,
    captioned,
    clustered,
    compare,
    flat,
    spread,
    to_markdown,
    told,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fog_contracts.site import Site
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import MeasuredDrive, Setup
    from fognav_experiments.comparison.limits import Saving
    from fognav_experiments.comparison.records import Folder, Record


TITLE: Final = "What the fog saves a robot: the thesis's experiment, repeated"
_WITHOUT_MAP: Final = (
    "This report was made without the floor's map (`--site`). So an obstacle counts as met where a robot of `default` "
    "followed more than one path, which it also does for other reasons: the map would tell whether its way was barred."
)


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
    methods = [Heading("How this was measured"), *_methods(records, pairs, experiment)]
    if not pairs:
        nothing = Paragraph("No route has succeeded in every setup yet: there is nothing to compare.")
        return [Heading(TITLE, 1), nothing, *methods]
    met = [by_setup for by_setup in pairs if _met(by_setup, savings)]
    return [
        Heading(TITLE, 1),
        result(pairs, met, measured),
        *([] if savings else [Paragraph(_WITHOUT_MAP)]),
        *_tracks(pairs, met, setups, site),
        Paragraph(
            "`default` does everything itself and knows nothing of an obstacle before its own lidar sees it; `lean` is "
            "the same at the lower rates of the others. `full`, the setup of the thesis, plans itself, too, but a "
            "computer in the building tells it which corridor is blocked. In `fog`, Fognav's own, that computer also "
            "keeps the map and plans."
        ),
        *(
            block
            for before, after in (("default", "fog"), ("lean", "fog"))
            if before in setups and after in setups
            for block in by_situation(pairs, met, before, after)
        ),
        *worse(pairs, setups, savings),
        *break_even.blocks(pairs, met),
        *_bounds(pairs, savings),
        Heading("Paired differences"),
        *_differences(pairs, met, setups),
        Heading("Distance, time and computation per route"),
        *_routes(pairs, setups),
        Heading("Where the computation goes"),
        *computation.blocks(pairs, setups, measured),
        *repeated.agreement(measured, records, str(experiment["measured_on"].get("commit", ""))),
        *repeated.beside_lockstep(measured, records),
        *_cost(measured),
        Heading("Drives that failed, and contacts"),
        *_failures(records, measured),
        Heading("Beside the thesis"),
        *beside_thesis(pairs, met, setups, measured, records),
        Heading("Each figure of the thesis, and where it is here"),
        *places(measured, records),
        *methods,
    ]


def _methods(records: Sequence[Record], pairs: Sequence[Drives], experiment: Mapping[str, Any]) -> list[Block]:
    asked, measured = experiment["asked"], experiment["measured_on"]
    setups = ",".join(setup for setup in SETUPS if any(record.setup == setup for record in records))
    runs = max((record.run for record in records), default=0)
    draws = "" if "draws" not in asked else f" --draws {asked['draws']}"
    command = f"fognav experiment --setups {setups} --runs {runs} --seed {asked['seed']}{draws} --out DIR"
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
            "corridors that sensors on the walls watch. All setups are the same program with the same algorithms; each "
            "meets the same obstacles at the same moments, drawn from a seed. All processes' cores, sensors and radio "
            "messages are simulated in lockstep; distances are those of the simulator's ground truth."
        ),
        Paragraph(
            f"{len(records)} drives stand, {len(pairs)} of them in each of the setups on the same run and "
            f"route: these are compared. CPU is what the thread spent, by the kernel's account, at "
            f"{' or '.join(map(str, jobs))} drive{'' if jobs == [1] else 's'} at a time and a load average of "
            f"{min(loads, default=0.0):.1f} to {max(loads, default=0.0):.1f}."
        ),
        Code(command),
        Table(
            ["measured on", ""],
            [
                ["site", f"{asked['site']} ({asked['site_digest']})"],
                *([["robot", asked["robot"]]] if "robot" in asked else []),
                *rows,
            ],
        ),
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
        Saved(
            savings[_key(drives)],
            distance(drives["default"]) - distance(drives["fog"]),
            time(drives["default"]) - time(drives["fog"]),
            situation,
        )
        for drives, situation in zip(both, situations(both), strict=True)
    ]
    blocks = limits.allowed_savings(drives)
    return [Heading("What the floor allows to save"), *blocks] if blocks else []


def _cost(measured: Sequence[MeasuredDrive]) -> list[Block]:
    cost = [*repeated.resources(measured), *repeated.processes(measured)]
    return [Heading("What the robot's processes cost"), *cost] if cost else []


def _routes(pairs: Sequence[Drives], setups: Sequence[Setup]) -> list[Block]:
    routes = sorted({drives[setups[0]].route for drives in pairs})
    blocks: list[Block] = []
    for quantity in QUANTITIES:
        series: dict[str, list[Estimate]] = {setup: [] for setup in setups}
        rows = [[route_ends(route)] for route in routes]
        for row, route in zip(rows, routes, strict=True):
            chosen = [drives for drives in pairs if next(iter(drives.values())).route == route]
            for setup in setups:
                found = values(chosen, setup, quantity.value), situations(chosen)
                series[setup].append(clustered(*found))
                row.append(told(*found))
        groups = [route_ends(route) for route in routes]
        svg = figures.bars(quantity.title, quantity.unit, groups, series)
        caption = captioned(quantity.caption, itertools.chain.from_iterable(series.values()))
        blocks.append(Picture(f"{quantity.file}.svg", svg, caption))
        blocks.append(Table([f"{quantity.title}, {quantity.unit}", *setups], rows))
    return blocks


def _differences(pairs: Sequence[Drives], met: Sequence[Drives], setups: Sequence[Setup]) -> list[Block]:
    rows = []
    for before, after in computation.PAIRS:
        if before not in setups or after not in setups:
            continue
        for subject, chosen in (("all drives", pairs), ("obstacle met", met)):
            if not chosen:
                continue
            for quantity in QUANTITIES:
                alike = computation.counted(chosen, (before, after)) if quantity.of_load else chosen
                if not alike:
                    continue
                one, other = values(alike, before, quantity.value), values(alike, after, quantity.value)
                found = compare(one, other, known := situations(alike))
                rows.append([
                    f"{before} - {after}", subject, f"{quantity.title}, {quantity.unit}", str(found.difference),
                    spread([a - b for a, b in zip(one, other, strict=True)]), str(found.difference.n),
                    str(len(set(known))), _probability(found.p_t), _probability(found.p_flip),
                ])  # fmt: skip
    return [
        Paragraph(
            "Differences of the same run and route. From "
            f"{FEWEST_CLUSTERS} situations on the mean has a 95 % confidence interval that counts these and not the "
            "drives, and there is the probability of a difference as large by chance: by the t test, and by the "
            "sign-flip test, which assumes no distribution. With fewer there is neither."
        ),
        Table(
            [
                "setups",
                "drives",
                "quantity",
                "mean",
                "median (least to most)",
                "n",
                "situations",
                "p (t test)",
                "p (sign flips)",
            ],
            rows,
        ),
    ]


def _tracks(pairs: Sequence[Drives], met: Sequence[Drives], setups: Sequence[Setup], site: Site | None) -> list[Block]:
    first, last = setups[0], setups[-1]
    ordered = sorted(met or pairs, key=lambda drives: drives[first].distance_m - drives[last].distance_m)
    drives = ordered[len(ordered) // 2]
    record = drives[first]
    blocked, stops = _ends(record, site) if site is not None else ((), {})
    svg = figures.tracks({setup: drives[setup].track for setup in setups}, blocked, stops)
    lengths = ", ".join(f"{setup} {drives[setup].distance_m:.0f} m" for setup in setups)
    caption = (
        f"The median of the {len(ordered)} drives{' in which the obstacle was met' if met else ''}, by what was saved: "
        f"run {record.run}, {route_ends(record.route)}, {record.area} is blocked: {lengths}."
    )
    return [Picture("tracks.svg", svg, caption)]


def _ends(record: Record, site: Site) -> tuple[Sequence[tuple[float, float]], dict[str, tuple[float, float]]]:
    """Return the corners (m) of the area that was blocked, and the two stops of the route."""
    blocked = next((area.polygon for area in site.definitions() if area.id == record.area), ())
    if record.ends is not msgspec.UNSET:
        return [(x, y) for x, y in blocked], dict(zip(("P1", "P2"), record.ends, strict=True))
    names = [name for name in site.places if record.route.startswith(name) or record.route.endswith(name)]
    stops = {name.upper(): (site.places[name].x, site.places[name].y) for name in names}
    return [(x, y) for x, y in blocked], stops


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
                f"a fault{_again(measured)}."
            )
        )
    header = ["drive", "made", "outcome", "reason", "contacts", "protective stops and faults"]
    return [*blocks, Table(header, rows)] if rows else blocks


def _again(measured: Sequence[MeasuredDrive]) -> str:
    again = sum(drive.attempt > 1 for drive in measured)
    return f"; {again} of them repeat one that had failed, which is counted, too" if again else ""


def summary_rows(records: Sequence[Record]) -> list[list[str]]:
    """Return the table of means as rows of a CSV file, with a header."""
    pairs = paired(records)
    rows = [["quantity", "unit", "route", "setup", "mean", "half_width_95", "n", "situations"]]
    for quantity in QUANTITIES:
        for route in sorted({record.route for record in records}):
            for setup in SETUPS:
                chosen = [drives[setup] for drives in pairs if setup in drives and drives[setup].route == route]
                if chosen:
                    known = [record.situation for record in chosen]
                    found = clustered([quantity.value(record) for record in chosen], known)
                    half = "" if found.half is None else f"{found.half:.4f}"
                    mean, n = f"{found.mean:.4f}", str(found.n)
                    rows.append([quantity.file, quantity.unit, route, setup, mean, half, n, str(len(set(known)))])
    return rows


def _probability(p: float | None) -> str:
    if p is None:
        return "-"
    return "< 0.0001" if p < 0.0001 else f"{p:.4f}"


def publish(folder: Folder, target: Path, site: Path | None = None) -> list[Path]:
    """Write the report of a folder's records into another one, or the same; return its files. Raises `FolderError`.

    `site`: folder of the floor; with it the report says what the map allows, if the drives were on this very floor.
    """
    experiment, records = folder.description(), folder.drives.read()
    measured = [drive for kind in KINDS for drive in folder.measured(kind).read()]
    if not records:
        raise FolderError(f"{folder.path} holds no drives yet: run `fognav experiment --out {folder.path}` first")
    known = site is not None and runner.site_digest(site) == experiment["asked"]["site_digest"]
    loaded = load_site(site) if known and site is not None else None
    savings = {} if site is None or loaded is None else _savings(records, experiment["asked"], site, loaded)
    blocks = build(records, experiment, savings, measured, None if loaded is None else loaded.site)
    summary = io.StringIO()
    csv.writer(summary, lineterminator="\n").writerows(summary_rows(records))
    texts = {
        "README.md": to_markdown(blocks),
        "summary.csv": summary.getvalue(),
        **{block.file: block.svg for block in blocks if isinstance(block, Picture)},
    }
    for name, text in texts.items():
        atomic_write(target / name, text.encode(), mode=SHARED)
    write_csv(target / "drives.csv", records)
    write_archive(folder, target / ARCHIVE)
    return [target / name for name in (*texts, "drives.csv", ARCHIVE)]


def _savings(
    records: Sequence[Record], asked: dict[str, Any], place: Path, site: LoadedSite
) -> dict[tuple[int, str], Saving]:
    """Return, by run and route, what the map of the drives allows to save."""
    draws, geometry = runner.drawer(site, place, msgspec.convert(asked, Asked)), RouteGeometry(site)
    drawn = [route for run in {record.run for record in records} for route in draws(run)]
    found = {(route.run, route.route.name): geometry.saving(route) for route in drawn}
    return {key: saving for key, saving in found.items() if saving is not None}
