"""What bounds the savings that a comparison finds: the floor's geometry, and the work that every setup does. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fognav_experiments.comparison.document import Block, Paragraph, Table
from fognav_experiments.statistics import Estimate, estimate

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fognav_experiments.comparison.geometry import Saving

SPEED_M_S: Final = 0.30
"""The robot's highest speed: no drive saves its metres faster."""
THESIS_RATIO: Final = 5.5
"""CPU of move_base on the thesis's robot: 110 % in `default`, 20 % in `full`."""
_NOTHING_M: Final = 0.05
"""What a map allows to save below one of its cells is rounding: no share of it means anything."""


def geometry(drives: Sequence[tuple[Saving, float, float]]) -> list[Block]:
    """Return what the map allows beside what was measured: per drive the saving, and the metres and seconds saved."""
    if not drives:
        return []
    rows = []
    for subject, chosen in (
        ("all drives", drives),
        ("obstacle on the way", [drive for drive in drives if drive[0].met]),
    ):
        if not chosen:
            continue
        allowed = estimate([saving.saved_m for saving, _, _ in chosen])
        metres, seconds = estimate([m for _, m, _ in chosen]), estimate([s for _, _, s in chosen])
        share = f"{100.0 * metres.mean / allowed.mean:.0f} %" if allowed.mean >= _NOTHING_M else "-"
        rows.append([
            subject, str(len(chosen)), text(allowed), text(metres), share,
            f"{allowed.mean / SPEED_M_S:.1f}", text(seconds),
        ])  # fmt: skip
    return [
        Paragraph(
            "Warned and unwarned robots were also computed from the map alone. Both drive shortest paths; the one "
            "turns when the obstacle appears, the other when its lidar, 12 m of reach, could see any point of it. "
            "This is what a warning can save on this floor, however well a robot drives. Where the measured saving is "
            "larger, the unwarned robot drove nearer before it was sure."
        ),
        Table(
            [
                "default - fog", "drives", "the map allows, m", "measured, m", "share",
                f"the map allows at {SPEED_M_S} m/s, s", "measured, s",
            ],
            rows,
        ),
    ]  # fmt: skip


def computation(  # the same shares in each setup, and what real processes took
    default: Mapping[str, float],
    full: Mapping[str, float] | None,
    fog: Mapping[str, float],
    robot: tuple[float, float],
    live: tuple[float, float] | None,
) -> Block:
    """Return why the ratio of computation is what it is, and what of it the fog does.

    default, full, fog: mean share of a core (%) by component of what move_base held; full: None without such drives.
    robot: that of the whole robot in `default` and `fog`; live: that of its real processes, None if nobody measured it.
    """
    before, after = sum(default.values()), sum(fog.values())
    local, planning = fog["local planning"], default["global planning"] + default["layers"]
    needed = THESIS_RATIO * after - default["local planning"]
    enough = "have" if needed > planning else "only have"
    rates = ""
    if full is not None:
        between = sum(full.values())
        rates = (
            f"most of it is not the fog's work: `default` plans and controls at the usual rates of the ROS navigation "
            f"stack, `full` and `fog` at lower ones. `full`, which plans for itself at the rates of `fog`, takes "
            f"{before / between:.1f} times less than `default`, and `fog` {between / after:.1f} times less than "
            "`full`. A robot at these rates that knows of no obstacle before it sees it, which would tell the fog's "
            "share apart, has not been driven yet. Here "
        )
    processes = (
        "lockstep leaves out the input and output of its processes, which are the same in all setups"
        if live is None
        else f"its real processes, which also read and write, took {live[0]:.2f} % and {live[1]:.2f} %: "
        f"{live[0] / live[1]:.2f} times less, and this is what a robot's computer saves"
    )
    return Paragraph(
        f"Why {before / after:.1f} times, where the thesis has {THESIS_RATIO}: {rates}`default` spends "
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
                f"{setup} / {setups[0]}", f"{estimate(ratios).mean:.2f}", f"{ratios[0]:.2f}", f"{ratios[-1]:.2f}",
                f"{estimate([values[number] - values[0] for values in shared]).mean:+.2f}",
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


def text(found: Estimate) -> str:
    """Return a mean with its 95 % confidence interval."""
    digits = 1 if abs(found.mean) >= 10.0 else 2
    return f"{found.mean:.{digits}f}" + ("" if found.half is None else f" ± {found.half:.{digits}f}")
