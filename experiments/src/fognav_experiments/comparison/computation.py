"""Where a robot's computation goes, which pairs of drives tell it, and why it is less in one setup. Pure.

A drive's share of a core depends on what else the machine does meanwhile, so only drives count that were made at one
commit, so many at a time, back to back, and at a like load.
"""

from __future__ import annotations

from statistics import fmean
from typing import TYPE_CHECKING, Final

from fognav_experiments.comparison import repeated
from fognav_experiments.comparison.records import (
    ALIKE,
    LOAD_RATIO,
    MOVE_BASE,
    OF_FOG,
    ON_FOG,
    ON_ROBOT,
    comparable,
)
from fognav_experiments.comparison.repeated import SETUPS
from fognav_experiments.figures import Block, Paragraph, Table, spread

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fognav_experiments.comparison.drives import MeasuredDrive, Setup
    from fognav_experiments.comparison.situations import Drives


PAIRS: Final[tuple[tuple[Setup, Setup], ...]] = (
    ("default", "lean"), ("default", "full"), ("default", "fog"), ("lean", "full"), ("lean", "fog"), ("full", "fog"),
)  # fmt: skip
THESIS_RATIO: Final = 5.5
"""CPU of move_base on the thesis's robot: 110 % in `default`, 20 % in `full`."""


def counted(pairs: Sequence[Drives], setups: Sequence[Setup]) -> list[Drives]:
    """Return those of the pairs whose computation in these setups can be compared."""
    return [drives for drives in pairs if comparable([drives[setup] for setup in setups])]


def ratio(pairs: Sequence[Drives], before: Setup, after: Setup, components: Sequence[str]) -> float | None:
    """Return how many times less `after` takes of a core than `before`; None if no pair counts."""
    chosen = counted(pairs, (before, after))
    return share(chosen, before, components) / share(chosen, after, components) if chosen else None


def share(pairs: Sequence[Drives], setup: Setup, components: Sequence[str]) -> float:
    """Return the mean share of a core (%) of these components in a setup."""
    return fmean(drives[setup].cpu_percent(components) for drives in pairs)


def blocks(pairs: Sequence[Drives], setups: Sequence[Setup], measured: Sequence[MeasuredDrive]) -> list[Block]:
    """Return the report's part on computation; `measured`: drives by real processes."""
    found: list[Block] = [
        Paragraph(
            "Mean share of one core, in %, by component, of all drives. Left out are decoding of messages, sockets and "
            "serial ports, which lockstep does not have; what a setup does not use of the fog is not counted."
        ),
        Table(["component", *setups], _components(pairs, setups)),
        *_ratios(pairs, setups),
    ]
    alike = counted(pairs, setups)
    found += error([[drives[setup].cpu_percent(ALIKE) for setup in setups] for drives in alike], setups)
    if "default" in setups and "fog" in setups and alike:
        default, lean, full, fog = (
            {name: share(alike, setup, [name]) for name in MOVE_BASE} if setup in setups else {} for setup in SETUPS
        )
        whole = share(alike, "default", ON_ROBOT), share(alike, "fog", ON_ROBOT)
        found.append(why(default, lean or None, full or None, fog, whole, repeated.of_processes(measured), len(alike)))
    return found


def _components(pairs: Sequence[Drives], setups: Sequence[Setup]) -> list[list[str]]:
    rows = []
    for component in (*ON_ROBOT, *ON_FOG):
        cells = []
        for setup in setups:
            unused = component in ON_FOG and component not in OF_FOG[setup]
            cells.append("-" if unused else f"{share(pairs, setup, [component]):.3f}")
        rows.append([component, *cells])
    for name, components in (("what move_base held", MOVE_BASE), ("whole robot", ON_ROBOT)):
        rows.append([f"sum: {name}", *(f"{share(pairs, setup, components):.3f}" for setup in setups)])
    received = [
        f"{fmean(drives[setup].received_bytes / (drives[setup].time_s or 1.0) for drives in pairs):.0f}"
        for setup in setups
    ]
    return [*rows, ["received from the fog, bytes/s", *received]]


def _ratios(pairs: Sequence[Drives], setups: Sequence[Setup]) -> list[Block]:
    rows = []
    for before, after in PAIRS:
        if before not in setups or after not in setups:
            continue
        chosen = counted(pairs, (before, after))
        row = [f"{before} / {after}", f"{len(chosen)} of {len(pairs)}"]
        for components in (MOVE_BASE, ON_ROBOT):
            found = ratio(pairs, before, after, components)
            each = [d[before].cpu_percent(components) / (d[after].cpu_percent(components) or 1.0) for d in chosen]
            row += ["-" if found is None else f"{found:.2f}", spread(each) if each else "-"]
        rows.append(row)
    header = ["setups", "pairs that count", "what move_base held", "of each pair", "whole robot", "of each pair"]
    return [
        Paragraph(
            "How many times less one setup computes than another. A pair of drives counts only if both were made at "
            "one commit, so many at a time, back to back where records tell it, and at loads of the machine that "
            f"differ by less than {LOAD_RATIO:g} times (a load below 1 counts as 1: the drive itself). Ratio of the "
            "means; of each pair: median, with the least and the most."
        ),
        Table(header, rows),
    ]


def why(  # noqa: PLR0913  # the same shares in each setup, of how many draws, and what real processes took
    default: Mapping[str, float],
    lean: Mapping[str, float] | None,
    full: Mapping[str, float] | None,
    fog: Mapping[str, float],
    robot: tuple[float, float],
    live: repeated.OfProcesses | None,
    draws: int,
) -> Block:
    """Return why the ratio of computation is what it is, and what of it the fog does.

    default, lean, full, fog: mean share of a core (%) by component of what move_base held; None without such drives.
    robot: that of the whole robot in `default` and `fog`; live: that of its real processes, None if nobody measured it;
    draws: of how many draws these are.
    """
    before, after = sum(default.values()), sum(fog.values())
    local, planning = fog["local planning"], default["global planning"] + default["layers"]
    needed = THESIS_RATIO * after - default["local planning"]
    enough = "have" if needed > planning else "only have"
    rates = ""
    if full is not None:
        between = sum(full.values())
        rates = (
            f"most of it is not the fog's work: `default` plans and controls at the thesis's rates, "
            f"`lean`, `full` and `fog` at lower ones. `full`, which plans for itself at the rates of `fog`, takes "
            f"{before / between:.1f} times less than `default`, and `fog` {between / after:.1f} times less than "
            "`full`. "
        )
        if lean is None:
            rates += (
                "A robot at these rates that knows of no obstacle before it sees it has not been driven here. Here "
            )
        else:
            alone = sum(lean.values())
            rates += (
                f"`lean`, at these rates but without any sensor node, tells both apart: {before / alone:.1f} times "
                f"less than `default` by its rates, and `fog` {alone / after:.1f} times less than `lean` by the fog. "
            )
    processes = (
        "lockstep leaves out the input and output of its processes, which are the same in all setups"
        if live is None
        else f"its real processes, which also read and write, took {live.before:.2f} % and {live.fog:.2f} %: "
        f"{live.before / live.fog:.2f} times less{live.doubt}, and this is what a robot's computer saves"
    )
    return Paragraph(
        f"Why {before / after:.1f} times in the {draws} draws all of whose setups count, where the thesis has "
        f"{THESIS_RATIO}: {rates}`default` spends "
        f"{default['global planning']:.2f} % on searching paths, {default['layers']:.2f} % on layers and "
        f"{default['local planning']:.2f} % on local planning. `fog` keeps the last of these, at half the rate of "
        f"control: {local:.2f} %, {100.0 * local / after:.0f} % of all that is left. That a robot must do itself, so "
        f"it bounds the ratio. For {THESIS_RATIO} times, searches and layers of `default` would {enough} to take "
        f"{needed:.2f} % instead of {planning:.2f} %: the faster they are, the less is saved by not doing them, and "
        "here they run on compiled kernels, and layers compute only what has changed. A stack whose search is "
        "slower, or that computes its layers as a whole, has a larger ratio. The whole robot, which must also locate "
        f"itself, read its lidar and guard its wheels, computes {robot[0]:.2f} % and {robot[1]:.2f} % in lockstep, "
        f"{robot[0] / robot[1]:.1f} times less; {processes}."
    )


def error(shared: Sequence[Sequence[float]], setups: Sequence[str]) -> list[Block]:
    """Return how far figures of CPU time can be trusted: by the spread of the work that all setups do alike.

    shared: per route, by setup, the share of a core (%) of that work.
    """
    rows = []
    for number, setup in enumerate(setups[1:], start=1):
        ratios = sorted(values[number] / values[0] for values in shared if values[0] > 0.0)
        if ratios:
            rows.append([
                f"{setup} / {setups[0]}", f"{fmean(ratios):.2f}", f"{ratios[0]:.2f}", f"{ratios[-1]:.2f}",
                f"{fmean(values[number] - values[0] for values in shared):+.2f}",
            ])  # fmt: skip
    if not rows:
        return []
    return [
        Paragraph(
            "The error of all figures of CPU time: localization, safety and wheels, lidar driver and guardian do the "
            "same work in every setup, and should take the same share. What they took differs between the setups of "
            "one route as this table says, for the machine was loaded more or less. It does not make all setups "
            "dearer alike: a difference of CPU time of this size says nothing of the setups."
        ),
        Table(["work that all setups share", "mean ratio", "least", "most", "mean difference, % of a core"], rows),
    ]
