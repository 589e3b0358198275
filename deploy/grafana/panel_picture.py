"""Pictures of panels: lines, stacked areas or bands of states over time, in a grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from math import nan
from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from panels import Panel

_COLUMNS: Final = 2
_LEGENDS: Final = 14
_SHOWN: Final = {
    "percentunit": ("%", 100.0), "short": ("", 1.0), "lengthm": ("m", 1.0), "hertz": ("Hz", 1.0), "volt": ("V", 1.0),
    "celsius": ("degrees Celsius", 1.0), "bytes": ("MB", 1e-6), "Bps": ("kB/s", 1e-3),
}  # fmt: skip
"""What Grafana's names of units mean: a unit that is read easily, and what to multiply by."""
_LEGEND_CHARACTERS: Final = 40


@dataclass(frozen=True)
class Series:
    """A named series of (time in s, now is 0; value)."""

    name: str
    points: list[tuple[float, float]]


def draw_page(file: Path, title: str, panels: Sequence[tuple[Panel, list[Series]]], *, seconds: float) -> None:
    """Write a PNG with a plot of each panel over the last `seconds`; raises `OSError`."""
    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(7.0 * _COLUMNS, 2.8 * rows), layout="constrained")
    figure.suptitle(title)
    for axes, shown in zip_longest(figure.subplots(rows, _COLUMNS, squeeze=False).flat, panels):
        if shown is None:
            axes.set_axis_off()
        else:
            draw_panel(axes, *shown, seconds=seconds)
    figure.savefig(file)


def draw_panel(axes: Axes, panel: Panel, series: list[Series], *, seconds: float) -> None:
    """Draw frame, series and legend over the last `seconds`, or that there are none."""
    unit, factor = _SHOWN.get(panel.unit, (panel.unit, 1.0))
    series = [Series(each.name, [(at, factor * value) for at, value in each.points]) for each in series if each.points]
    axes.set_title(f"{panel.title} [{unit}]" if unit else panel.title, loc="left", size="medium")
    axes.set_xticks((-seconds, 0.0), (f"-{seconds:g} s", "now"))
    axes.set_xlim(-seconds, 0.0)
    if not series:
        axes.set_yticks(())
        text, colour = (f"no data: needs {panel.needs}", "black") if panel.needs else ("NO DATA", "#b00020")
        axes.text(0.02, 0.9, text, color=colour, transform=axes.transAxes, va="top")
        return
    period = _period(series, seconds)
    colours = [f"C{number}" for number in range(len(series))]
    if panel.kind == "states":
        # A band for each series where its value is not 0, and a thin line where it is 0.
        axes.set_yticks(())
        axes.invert_yaxis()
        for number, (each, colour) in enumerate(zip(series, colours, strict=True)):
            for place, height, is_so in (((number - 0.45), 0.9, True), (number - 0.02, 0.04, False)):
                spans = [(at, min(period, -at)) for at, value in each.points if bool(value) is is_so and at < 0.0]
                axes.broken_barh(spans, (place, height), color=colour)
    else:
        for each, colour in zip(_stacked(series) if panel.kind == "stacked" else series, colours, strict=True):
            axes.plot(*zip(*_broken(each, 1.5 * period), strict=True), color=colour, marker=".", markersize=2)
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))
        axes.grid(axis="y", color="#ddd")
    _legend(axes, series, colours)


def _legend(axes: Axes, series: list[Series], colours: list[str]) -> None:
    """Name each series beside the panel, with its last value."""
    for each, colour in list(zip(series, colours, strict=True))[:_LEGENDS]:
        last = f" {each.points[-1][1]:.3g}"
        axes.plot((), (), color=colour, label=each.name[: _LEGEND_CHARACTERS - len(last)] + last)
    if len(series) > _LEGENDS:
        axes.plot((), (), " ", label=f"and {len(series) - _LEGENDS} more")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="x-small", frameon=False)


def _period(series: list[Series], seconds: float) -> float:
    """Return the time (s) between two samples: the shortest there is, or little of `seconds` for single ones."""
    gaps = [after[0] - before[0] for each in series for before, after in pairwise(each.points)]
    return min(gaps, default=seconds / 100)


def _broken(series: Series, gap: float) -> list[tuple[float, float]]:
    """Return a series' points, with one that is not drawn where there was nothing for longer than `gap` (s)."""
    points = series.points[:1]
    for before, after in pairwise(series.points):
        points += [after] if after[0] - before[0] <= gap else [(before[0], nan), after]
    return points


def _stacked(series: list[Series]) -> list[Series]:
    """Return each series with all before it added, at its own times."""
    total: dict[float, float] = {}
    stacked: list[Series] = []
    for each in series:
        points: list[tuple[float, float]] = []
        for at, value in each.points:
            total[round(at, 2)] = total.get(round(at, 2), 0.0) + value
            points.append((at, total[round(at, 2)]))
        stacked.append(Series(each.name, points))
    return stacked
