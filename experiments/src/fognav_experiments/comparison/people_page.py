"""The report of drives among people: a page with a table and a figure."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fog_runtime.files import SHARED, atomic_write
from fognav_experiments.comparison.drives import ALONE
from fognav_experiments.comparison.people import EGRESS_S, KINDS, MISSED_S
from fognav_experiments.figures import (
    Block,
    Code,
    Heading,
    Paragraph,
    Picture,
    Table,
    bars,
    captioned,
    clustered,
    flat,
    spread,
    to_markdown,
    told,
)
from fognav_sim.people import FROM_ROBOT_M, SPEED_M_S, STANDS_S

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fognav_experiments.comparison.drives import Setup
    from fognav_experiments.comparison.people import PeopleDrive
    from fognav_experiments.figures import Estimate

_WORDS: Final = """\
A robot drives from A to B among people, who walk by the social-force model of Helbing and Molnár \
(*Physical Review E* 51, 4282, 1995) with its parameters: {speed} ± {spread} m/s (at most 1.3 times as fast as \
somebody likes), relaxation 0.5 s, others 2.1 m²/s² and 0.3 m, walls 10 m²/s² and 0.2 m, 200° of sight and half of \
that weight behind. Others are thought to be ahead by 1 s, in which open implementations of the paper differ. The \
rest is our own: people go from anywhere on the floor to anywhere, stand there for {stands:g} s on average, and give \
way to nobody then; who walks makes room for the robot as for a person, and comes no nearer than {near} m by himself. \
They are round, 0.4 m wide, and echo as the simulator's boxes do. Each run draws others, the same in both setups. \
`fog` is led by the fog; `lean`, the control, drives on its own at the same rates. In `fog` the planner has seen no \
block before, so that it sends the robot round; in `fog, learned` it has seen those of one such drive among others, \
and waits in areas where five ended by themselves. *Operator* counts commands after the first enable; after \
{egress:g} s in an area that stays blocked round the robot one is to let it out."""
_OF_NODES: Final = """\
*By passers-by*: blocks during which nobody stood in the area. *Missed*: who stood in a watched area for more than \
{missed:g} s while it was never blocked; in brackets those of them who stood in a cone. *More* is against the same \
drive without people. *Stops* are protective stops, *holds* those on the way. *Closest* is the least distance between \
the robot's rim and a person in a drive while the robot moved: median, least and most."""
_HEADER: Final = (
    "people", "setup", "drives, arrived", "m more", "s more", "s stood", "stops", "holds", "operator", "closest, m",
    "contacts", "blocks", "by passers-by", "walked through cones (reported)", "stood in areas (in cones)",
    "missed (in cones)",
)  # fmt: skip


def publish(drives: Sequence[PeopleDrive], command: str, measured_on: Mapping[str, Any], target: Path) -> list[Path]:
    """Write page and figure into a folder; return the files."""
    counts = sorted({drive.people for drive in drives})
    words = _WORDS.format(speed=SPEED_M_S[0], spread=SPEED_M_S[1], stands=STANDS_S, near=FROM_ROBOT_M, egress=EGRESS_S)
    seconds: dict[str, list[Estimate | None]] = {
        _named(kind): [_seconds(_cell(drives, count, kind)) for count in counts] for kind in KINDS
    }
    shown = [found for line in seconds.values() for found in line]
    picture = Picture(
        "seconds.svg",
        bars("A drive among people", "s", [str(count) for count in counts], seconds),
        captioned("Seconds that a drive takes, by how many people are on the floor", shown),
    )
    blocks: list[Block] = [
        Heading("People in beams and paths", 1),
        Paragraph(words),
        Code(command),
        picture,
        Table(_HEADER, [row for count in counts for kind in KINDS if (row := _row(drives, count, kind))]),
        Paragraph(_OF_NODES.format(missed=MISSED_S)),
    ]
    if failed := [[drive.name, drive.outcome, drive.reason] for drive in drives if not drive.success]:
        blocks += [Paragraph("Drives that failed, and count in no mean:"), Table(["drive", "outcome", "why"], failed)]
    commits = Counter(drive.commit for drive in drives)
    blocks.append(Paragraph(f"Drives by commit: {', '.join(f'{n} at {commit}' for commit, n in commits.items())}."))
    blocks.append(Table(["measured on", ""], [[name, str(value)] for name, value in flat(measured_on)]))
    files = {"README.md": to_markdown(blocks).encode(), picture.file: picture.svg.encode()}
    for name, content in files.items():
        atomic_write(target / name, content, mode=SHARED)
    return [target / name for name in files]


def _named(kind: tuple[Setup, bool]) -> str:
    return f"{kind[0]}, learned" if kind[1] else kind[0]


def _cell(drives: Sequence[PeopleDrive], count: int, kind: tuple[Setup, bool]) -> list[PeopleDrive]:
    return [drive for drive in drives if (drive.people, drive.setup, drive.learned) == (count, *kind)]


def _seconds(cell: Sequence[PeopleDrive]) -> Estimate | None:
    took = [(drive.time_s, drive.run) for drive in cell if drive.success and drive.time_s is not None]
    return clustered([time_s for time_s, _ in took], [run for _, run in took]) if took else None


def _row(drives: Sequence[PeopleDrive], count: int, kind: tuple[Setup, bool]) -> list[str]:
    """Return a row of the table; none without a drive."""
    cell = _cell(drives, count, kind)
    if not cell:
        return []
    free = {drive.run: drive for drive in _cell(drives, 0, (kind[0], False)) if drive.success}
    pairs = [(drive, free[drive.run]) for drive in cell if drive.success and drive.run in free]
    metres = [drive.distance_m - empty.distance_m for drive, empty in pairs]
    seconds = [(drive.time_s or 0.0) - (empty.time_s or 0.0) for drive, empty in pairs]
    more = [told(values, [drive.run for drive, _ in pairs]) if count and pairs else "-" for values in (metres, seconds)]
    closest = [drive.closest_moving_m for drive in cell if drive.closest_moving_m is not None]
    of = [drive.episodes for drive in cell]
    nodes = [
        str(sum(each.blocks for each in of)),
        str(sum(each.passing + each.empty for each in of)),
        f"{sum(each.passed for each in of)} ({sum(each.passed_reported for each in of)})",
        f"{sum(each.stood for each in of)} ({sum(each.stood_seen for each in of)})",
        f"{sum(each.missed for each in of)} ({sum(each.missed_seen for each in of)})",
    ]
    return [
        str(count), _named(kind), f"{len(cell)}, {sum(drive.success for drive in cell)}", *more,
        f"{np.mean([drive.stood_s for drive in cell]):.1f}",
        str(sum(drive.modes.get("PROTECTIVE_STOP", 0) for drive in cell)),
        str(sum(drive.modes.get("HOLD", 0) for drive in cell)),
        str(sum(drive.operator_commands - 1 + drive.egresses for drive in cell)),
        spread(closest) if closest else "-",
        str(sum(drive.contacts for drive in cell)),
        *(nodes if kind[0] not in ALONE else ["-"] * len(nodes)),
    ]  # fmt: skip
