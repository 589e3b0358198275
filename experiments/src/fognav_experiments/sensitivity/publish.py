"""Writes what a sweep has found: a heat map of each plane, and a page that explains them."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

from fog_runtime.files import SHARED, atomic_write
from fognav_experiments import plots
from fognav_experiments.comparison.document import (
    Block,
    Code,
    Figure,
    Heading,
    Paragraph,
    Table,
    flat,
    to_html,
    to_markdown,
)
from fognav_experiments.comparison.limits import text
from fognav_experiments.sensitivity.planes import UNITS, gain

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from fognav_experiments.sensitivity.planes import Plane, SweptDrive

TITLE: Final = "How what the fog saves depends on its parts"


def publish(
    drives: Sequence[SweptDrive], planes: Sequence[Plane], command: str, measured_on: Mapping[str, Any], target: Path
) -> list[Path]:
    """Write the pages and figures of a sweep into a folder; return the files."""
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
        "report.html": to_html(TITLE, blocks),
        **{block.file: block.svg for block in blocks if isinstance(block, Figure)},
    }
    for name, content in texts.items():
        atomic_write(target / name, content.encode(), mode=SHARED)
    return [target / name for name in texts]


def _spread(drives: Sequence[SweptDrive], planes: Sequence[Plane]) -> str:
    """Return in words what a cell's figures are; a single route has no confidence interval."""
    found = [gain(drives, point) for plane in planes for point in plane.points()]
    if any(cell.metres.n > 1 for cell in found if cell is not None):
        return " on average, with the 95 % confidence interval where there is more than one route"
    return " on the one route, which says nothing of others"


def _commits(drives: Sequence[SweptDrive]) -> list[list[str]]:
    """Return how many of the drives each commit made."""
    counts = sorted(Counter(drive.commit or "not known" for drive in drives).items())
    return [["commit", f"{commit}: {count} of the drives"] for commit, count in counts]


def _plane(drives: Sequence[SweptDrive], plane: Plane) -> list[Block]:
    gains = {point: found for point in plane.points() if (found := gain(drives, point)) is not None}
    name = f"{plane.x.quantity}-{plane.y.quantity}".replace("_", "-")
    caption = f"Metres and seconds that the fog saves, by {UNITS[plane.x.quantity]} and {UNITS[plane.y.quantity]}."
    rows = [
        [f"{getattr(point, plane.x.quantity):g}", f"{getattr(point, plane.y.quantity):g}", str(found.metres.n),
         text(found.metres), text(found.seconds)]
        for point, found in gains.items()
    ]  # fmt: skip
    return [
        Heading(f"{plane.x.quantity} and {plane.y.quantity}"),
        Figure(
            f"{name}.svg",
            plots.heat_map(
                "What the fog saves per route",
                (UNITS[plane.x.quantity], plane.x.values),
                (UNITS[plane.y.quantity], plane.y.values),
                [[gains.get(plane.at(x, y)) for x in plane.x.values] for y in plane.y.values],
            ),
            caption,
        ),
        Table([UNITS[plane.x.quantity], UNITS[plane.y.quantity], "routes", "metres saved", "seconds saved"], rows),
    ]
