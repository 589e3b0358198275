"""What reports consist of: means with confidence intervals, tests of paired differences, plots, and pages as Markdown.

The same input gives the same bytes. Student's t (Gosset 1908), the paired t test, and the sign-flip test (Fisher 1935),
which assumes no distribution. Values that repeat the same situation are no evidence of their own: intervals and tests
count clusters of them (Liang and Zeger 1986).
"""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass
from itertools import chain
from math import nan
from statistics import median
from textwrap import fill
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.transforms import offset_copy
from scipy.special import stdtr, stdtrit

from fog_contracts.costs import FREE, LETHAL
from fog_runtime.files import SHARED, atomic_write
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from fog_contracts.grid import StaticMap

    _Floats = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

_EXACT_UP_TO: Final = 14
"""With at most this many pairs every combination of signs is tried, beyond that random ones."""
_FLIPS: Final = 20_000
FEWEST_CLUSTERS: Final = 10
"""With fewer clusters than these there is no interval and no test: their spread would be a guess."""


class Estimate(NamedTuple):
    """A mean of `n` values with half the width of its 95 % confidence interval; None where there are too few."""

    mean: float
    half: float | None
    n: int

    def __str__(self) -> str:
        """Write the mean with its interval, as tables do."""
        digits = 1 if abs(self.mean) >= 10.0 else 2
        return f"{self.mean:.{digits}f}" + ("" if self.half is None else f" ± {self.half:.{digits}f}")


class Paired(NamedTuple):
    """A mean difference, and how likely one so large is by chance: by the paired t test and the sign-flip test."""

    difference: Estimate
    p_t: float | None
    p_flip: float | None


def _student_975(freedom: int) -> float:
    """Return the value that Student's t of so many degrees of freedom stays below in 97.5 of 100 cases."""
    return float(stdtrit(freedom, 0.975))


def estimate(values: Sequence[float]) -> Estimate:
    """Return the mean with its 95 % confidence interval; raises `ValueError` without a value."""
    if not values:
        raise ValueError("there is no mean of no values")
    mean, n = float(np.mean(values)), len(values)
    if n < 2:
        return Estimate(mean, None, n)
    return Estimate(mean, _student_975(n - 1) * float(np.std(values, ddof=1)) / math.sqrt(n), n)


def clustered(values: Sequence[float], clusters: Sequence[Hashable]) -> Estimate:
    """Return the mean with the 95 % confidence interval of values that depend on one another within a cluster.

    `clusters`: that of each value. The error is the cluster-robust one of a mean, with Student's t of one degree of
    freedom per cluster but one; with every value in a cluster of its own it is that of `estimate`. There is no interval
    below `FEWEST_CLUSTERS`. Raises `ValueError` without a value.
    """
    mean, n = estimate(values).mean, len(values)
    sums = _sums(np.array(values) - mean, clusters)
    if len(sums) < FEWEST_CLUSTERS:
        return Estimate(mean, None, n)
    return Estimate(mean, _student_975(len(sums) - 1) * _error(sums, n), n)


def spread(values: Sequence[float]) -> str:
    """Return the median in words, with the least and the most value; raises `ValueError` without a value."""
    ordered = sorted(values)
    digits = 1 if abs(median(ordered)) >= 10.0 else 2
    return f"{median(ordered):.{digits}f}" + (
        f" ({ordered[0]:.{digits}f} to {ordered[-1]:.{digits}f})" if len(ordered) > 1 else ""
    )


def told(values: Sequence[float], clusters: Sequence[Hashable]) -> str:
    """Return the mean in words with its interval; with the least and the most value where there is no interval."""
    found = clustered(values, clusters)
    if found.half is not None or found.n < 2:
        return str(found)
    digits = 1 if abs(found.mean) >= 10.0 else 2
    return f"{found} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def captioned(words: str, shown: Iterable[Estimate | None]) -> str:
    """Return a caption as a sentence that names the intervals of what is shown, if there are any."""
    intervals = any(found is not None and found.half is not None for found in shown)
    return f"{words}{', with 95 % confidence intervals' if intervals else ''}."


def compare(before: Sequence[float], after: Sequence[float], clusters: Sequence[Hashable]) -> Paired:
    """Return how much smaller `after` is than `before`, pair by pair, of pairs in these clusters; as `clustered`."""
    differences = np.array(before) - np.array(after)
    found = clustered(differences.tolist(), clusters)
    if found.half is None:
        return Paired(found, None, None)
    sums = _sums(differences - found.mean, clusters)
    error = _error(sums, found.n)
    if error == 0.0:
        p_t = 1.0 if found.mean == 0.0 else 0.0
    else:
        p_t = 2.0 * (1.0 - float(stdtr(len(sums) - 1, abs(found.mean) / error)))
    return Paired(found, p_t, _flip_test(_sums(differences, clusters)))


def _sums(values: _Floats, clusters: Sequence[Hashable]) -> _Floats:
    """Return the sum of each cluster's values, in the order in which clusters come first."""
    numbers = {cluster: number for number, cluster in enumerate(dict.fromkeys(clusters))}
    sums: _Floats = np.bincount([numbers[cluster] for cluster in clusters], weights=values).astype(np.float64)
    return sums


def _error(sums: _Floats, n: int) -> float:
    """Return the standard error of a mean of `n` values, by the sums of the clusters' deviations from it."""
    return math.sqrt(len(sums) / (len(sums) - 1) * float((sums**2).sum())) / n


def _flip_test(differences: _Floats) -> float:
    """Return the share of all combinations of signs with a sum at least as far from 0; exact for few clusters."""
    n = len(differences)
    if n <= _EXACT_UP_TO:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=n)))
    else:
        signs = np.random.default_rng(1).choice((-1.0, 1.0), size=(_FLIPS, n))
        signs[0] = 1.0
    sums = np.abs(signs @ differences)
    return float(np.mean(sums >= abs(differences.sum()) - 1e-9))


COLOURS: Final = {
    "default": "#d9822b", "lean": "#8a6d3b", "full": "#3b7dd8", "fog": "#2a9d5c", "lockstep": "#9a9a9a",
    "live": "#7a4fb5", "hardware": "#444444", "fog, learned": "#a3d9a5",
}  # fmt: skip
"""Colours of the setups, of which `default` and `full` are the thesis's, and of how a drive was made."""
_SAVED: Final = LinearSegmentedColormap.from_list("saved", [COLOURS["default"], "white", COLOURS["fog"]])
_FLOOR_PX: Final = 1600


def bars(title: str, unit: str, groups: Sequence[str], series: Mapping[str, Sequence[Estimate | None]]) -> str:
    """Return a chart as SVG with a group of bars per route: each setup's mean, with its 95 % confidence interval.

    `groups`: their names, each of one or two lines. `series`: for each setup, or whatever else has a colour, an
    estimate per group, None without one.
    """
    figure = Figure(figsize=(6.6, 3.4), layout="constrained")
    axes = figure.add_subplot()
    width = 0.7 / len(series)
    for place, (setup, values) in enumerate(series.items()):
        known = [(number, found) for number, found in enumerate(values) if found is not None]
        middles = [number + width * (place - (len(series) - 1) / 2) for number, _ in known]
        halves = [nan if found.half is None else found.half for _, found in known]
        means = [found.mean for _, found in known]
        axes.bar(middles, means, 0.95 * width, yerr=halves, capsize=3, color=COLOURS[setup], label=setup)
    axes.set_xticks(range(len(groups)), groups)
    axes.set_ylim(bottom=0.0)
    axes.tick_params(length=0)
    axes.grid(axis="y", color="#ddd")
    axes.set_axisbelow(True)
    _title(figure, axes, f"{title} ({unit})")
    return svg_of(figure)


def tracks(
    paths: Mapping[str, Sequence[tuple[float, float]]],
    blocked: Sequence[tuple[float, float]] = (),
    stops: Mapping[str, tuple[float, float]] | None = None,
) -> str:
    """Return the true tracks (m) of several setups as SVG, seen from above.

    `blocked`: corners of the area that was blocked; `stops`: names and positions of the route's ends.
    """
    shown = np.array([*chain.from_iterable(paths.values()), *blocked, *(stops or {}).values()])
    low, high = shown.min(axis=0) - 2.0, shown.max(axis=0) + 2.0
    wide, tall = high - low
    figure = Figure(figsize=(6.6, 1.0 + 6.0 * tall / wide), layout="constrained")
    axes = figure.add_subplot(aspect="equal", xlabel="m", ylabel="m", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    if blocked:
        axes.fill(*zip(*blocked, strict=True), facecolor="#e9b4b4", edgecolor="#b03030")
        axes.annotate("blocked", np.mean(blocked, axis=0), ha="center", va="center")
    for number, (setup, path) in enumerate(paths.items()):
        # A little apart, so that tracks on the same way are all seen.
        apart = offset_copy(axes.transData, figure, x=1.5 * number, y=-1.5 * number, units="points")
        axes.plot(*zip(*path, strict=True), color=COLOURS[setup], label=setup, transform=apart)
    for name, stop in (stops or {"": next(iter(paths.values()))[0]}).items():
        axes.plot(*stop, "ko")
        axes.annotate(name, stop, (6, 5), textcoords="offset points", weight="bold")
    _title(figure, axes, "")
    return svg_of(figure)


def heat_map(
    title: str,
    across: tuple[str, Sequence[float]],
    upwards: tuple[str, Sequence[float]],
    saved: Sequence[Sequence[tuple[Estimate, Estimate] | None]],
) -> str:
    """Return a plane of two quantities as SVG, by their names and values: the greener a cell, the more is saved there.

    `saved`: by rows, what a cell says: metres with their 95 % confidence interval, and seconds; None, where none was
    driven, is grey.
    """
    columns, rows = len(across[1]), len(upwards[1])
    figure = Figure(figsize=(max(1.2 + 1.1 * columns, 4.5), 1.2 + 0.7 * rows), layout="constrained")
    axes = figure.add_subplot(title=title, xlabel=across[0], ylabel=fill(upwards[0], 8 * rows), facecolor="#eee")
    metres = np.array([[nan if cell is None else cell[0].mean for cell in row] for row in saved])
    most = max(np.abs(metres[~np.isnan(metres)]), default=0.0) or 1.0
    axes.pcolormesh(np.ma.masked_invalid(metres), cmap=_SAVED, vmin=-most, vmax=most, edgecolors="white")
    for row, cells in enumerate(saved):
        for column, cell in enumerate(cells):
            if cell is not None:
                half = "" if cell[0].half is None else f" ± {cell[0].half:.1f}"
                words = f"{cell[0].mean:.1f}{half} m\n{cell[1].mean:.0f} s"
                axes.text(column + 0.5, row + 0.5, words, ha="center", va="center")
    axes.set_xticks(np.arange(columns) + 0.5, [f"{x:g}" for x in across[1]])
    axes.set_yticks(np.arange(rows) + 0.5, [f"{y:g}" for y in upwards[1]])
    axes.tick_params(length=0)
    return svg_of(figure)


def curves(panels: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]], across: str) -> Figure:
    """Return panels by their titles, side by side, each with lines of points by their names; one legend for all."""
    figure = Figure(figsize=(3.8 * len(panels), 3.4), layout="constrained")
    for axes, (title, lines) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        axes.set(title=title, xlabel=across)
        axes.grid(color="#ddd")
        for name, points in lines.items():
            axes.plot(*zip(*points, strict=True), label=name)
        axes.set_ylim(bottom=0)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(panels))
    return figure


def scatter(points: Mapping[str, tuple[float, Estimate]], across: str, upwards: str) -> str:
    """Return named points as SVG, by a value and an estimate, which is shown with its 95 % confidence interval."""
    figure = Figure(figsize=(6.6, 3.6), layout="constrained")
    axes = figure.add_subplot(xlabel=across, ylabel=upwards)
    for name, (x, found) in points.items():
        axes.errorbar(x, found.mean, yerr=found.half, fmt="o", capsize=3, label=name)
    axes.set_xlim(left=0.0)
    axes.grid(color="#ddd")
    axes.axhline(0.0, color="#888")
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    return svg_of(figure)


def floor(map_: StaticMap) -> tuple[Figure, Axes]:
    """Return a map to draw on, in metres of frame `map`: free cells white, occupied black, unknown grey."""
    geometry = map_.geometry
    size = np.array((geometry.width, geometry.height))
    figure = Figure(figsize=_FLOOR_PX / 100 * size / size.max(), layout="constrained")
    axes = figure.add_subplot(xlabel="m", ylabel="m")
    shades = np.full(map_.cells.shape, 200, np.uint8)
    shades[map_.cells == FREE], shades[map_.cells == LETHAL] = 255, 0
    (left, bottom), (wide, high) = (geometry.origin_x, geometry.origin_y), size * geometry.resolution
    extent = (left, left + wide, bottom, bottom + high)
    axes.imshow(shades, cmap="gray", vmin=0, vmax=255, origin="lower", extent=extent, interpolation="nearest")
    return figure, axes


def write_png(figure: Figure, file: Path) -> None:
    """Write a picture; raises `WrongUseError` if the file can't be written."""
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    try:
        atomic_write(file, data.getvalue(), mode=SHARED)
    except OSError as error:
        raise WrongUseError(f"{file} can't be written: {error.strerror}. Name another file") from error


def _title(figure: Figure, axes: Axes, title: str) -> None:
    """Put a title above on the left, and what the colours mean on the right."""
    axes.set_title(title, loc="left", weight="bold", size="medium")
    figure.legend(loc="outside upper right", ncols=4, frameon=False)


def svg_of(figure: Figure) -> str:
    """Return a figure as an element that a page can contain, with its words as text."""
    data = io.StringIO()
    with rc_context({"svg.hashsalt": "fognav", "svg.fonttype": "none"}):
        figure.savefig(data, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = " ".join(data.getvalue().split()).replace("> <", "><")
    return text[text.index("<svg") :] + "\n"


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading; level 1 is the title."""

    text: str
    level: int = 2


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A paragraph of plain text."""

    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """Lines to be typed, or read as they are."""

    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """A table of plain text."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure as SVG, with the name of its file and a caption."""

    file: str
    svg: str
    caption: str


Block = Heading | Paragraph | Code | Table | Picture


def to_markdown(blocks: Sequence[Block]) -> str:
    """Return the document as Markdown, with its figures as files beside it."""
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def _markdown(block: Block) -> str:
    match block:
        case Heading():
            return f"{'#' * block.level} {block.text}"
        case Paragraph():
            return block.text
        case Code():
            return f"```\n{block.text}\n```"
        case Table():
            rows = [block.header, ["---"] * len(block.header), *block.rows]
            return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows)
        case Picture():
            return f"![{block.caption}]({block.file})\n\n*{block.caption}*"


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return nested values as pairs of a name and a value."""
    found = []
    for name, value in values.items():
        found += flat(value, f"{prefix}{name} ") if isinstance(value, dict) else [(f"{prefix}{name}", value)]
    return found
