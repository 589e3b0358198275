"""Pictures of panels: lines, stacked areas or bands of states over time, in a grid."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

from panels import Panel
from PIL import Image, ImageDraw

_WIDTH, _HEIGHT, _COLUMNS = 660, 250, 2
_LEFT, _TOP, _RIGHT, _BOTTOM = 70, 30, 250, 24
"""Margins of a panel's plot (pixels); the legend is on the right."""
_PAGE_TITLE: Final = 30
_COLOURS: Final = (
    "#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#17becf", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22",
    "#393b79", "#637939", "#e7ba52", "#843c39",
)  # fmt: skip
"""As many as the legend has names."""
_INK, _GRID, _NOTHING = "#222222", "#dddddd", "#b00020"
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
    image = Image.new("RGB", (_COLUMNS * _WIDTH, _PAGE_TITLE + rows * _HEIGHT), "white")
    pen = ImageDraw.Draw(image)
    pen.text((10, 8), title, fill=_INK, font_size=16)
    for number, (panel, series) in enumerate(panels):
        row, column = divmod(number, _COLUMNS)
        _Plot(pen, column * _WIDTH, _PAGE_TITLE + row * _HEIGHT, seconds).draw(panel, series)
    image.save(file, optimize=True)


class _Plot:
    """One panel with its upper left corner at (x, y)."""

    def __init__(self, pen: ImageDraw.ImageDraw, x: int, y: int, seconds: float) -> None:
        self._pen = pen
        self._x, self._y, self._seconds = x, y, seconds
        self._inner_width = _WIDTH - _LEFT - _RIGHT
        self._inner_height = _HEIGHT - _TOP - _BOTTOM

    def draw(self, panel: Panel, series: list[Series]) -> None:
        """Draw frame, series and legend, or that there are none."""
        unit, factor = _SHOWN.get(panel.unit, (panel.unit, 1.0))
        series = [
            Series(each.name, [(at, factor * value) for at, value in each.points]) for each in series if each.points
        ]
        title = f"{panel.title} [{unit}]" if unit else panel.title
        self._pen.text((self._x + _LEFT, self._y + 8), title, fill=_INK, font_size=13)
        left, top = self._x + _LEFT, self._y + _TOP
        self._pen.rectangle((left, top, left + self._inner_width, top + self._inner_height), outline=_GRID)
        self._pen.text((left, top + self._inner_height + 5), f"-{self._seconds:g} s", fill=_INK)
        self._pen.text((left + self._inner_width - 20, top + self._inner_height + 5), "now", fill=_INK)
        if not series:
            text = f"no data: needs {panel.needs}" if panel.needs else "NO DATA"
            self._pen.text((left + 8, top + 8), text, fill=_INK if panel.needs else _NOTHING)
            return
        if panel.kind == "states":
            self._bands(series)
        else:
            self._lines(_stacked(series) if panel.kind == "stacked" else series)
        self._legend(series)

    def _at(self, time_s: float) -> float:
        return self._x + _LEFT + (1.0 + time_s / self._seconds) * self._inner_width

    def _lines(self, series: list[Series]) -> None:
        values = [value for each in series for _, value in each.points]
        low, high = min(0.0, *values), max(values)
        high = high if high > low else low + 1.0
        bottom = self._y + _TOP + self._inner_height
        for share in (0.0, 0.5, 1.0):
            y = bottom - share * self._inner_height
            self._pen.line((self._x + _LEFT, y, self._x + _LEFT + self._inner_width, y), fill=_GRID)
            self._pen.text((self._x + 6, y - 6), f"{low + share * (high - low):.3g}", fill=_INK)
        gap = 1.5 * _period(series, self._seconds)
        for number, each in enumerate(series):
            colour = _COLOURS[number % len(_COLOURS)]
            for points in _unbroken(each, gap):
                line = [(self._at(at), bottom - (value - low) / (high - low) * self._inner_height)
                        for at, value in points]  # fmt: skip
                if len(line) > 1:
                    self._pen.line(line, fill=colour, width=2)
                else:
                    self._pen.circle(line[0], 2, fill=colour)

    def _bands(self, series: list[Series]) -> None:
        """Draw a band for each series, filled where its value is not 0, and a thin line where it is 0."""
        height = self._inner_height / len(series)
        step = _period(series, self._seconds) / self._seconds * self._inner_width
        right = self._x + _LEFT + self._inner_width
        for number, each in enumerate(series):
            top = self._y + _TOP + number * height
            for at, value in each.points:
                left = min(right, self._at(at))  # rounding may put the last sample behind it
                middle = top + height / 2
                span = (top + 1, top + max(2.0, height - 1)) if value else (middle, middle)
                box = (left, span[0], min(right, left + step), span[1])
                self._pen.rectangle(box, fill=_COLOURS[number % len(_COLOURS)])

    def _legend(self, series: list[Series]) -> None:
        x = self._x + _WIDTH - _RIGHT + 8
        for number, each in enumerate(series[:_LEGENDS]):
            y = self._y + _TOP + number * 14
            self._pen.rectangle((x, y + 3, x + 7, y + 9), fill=_COLOURS[number % len(_COLOURS)])
            last = f" {each.points[-1][1]:.3g}" if each.points else ""
            self._pen.text((x + 11, y), each.name[: _LEGEND_CHARACTERS - len(last)] + last, fill=_INK)
        if len(series) > _LEGENDS:
            self._pen.text((x, self._y + _TOP + _LEGENDS * 14), f"and {len(series) - _LEGENDS} more", fill=_INK)


def _period(series: list[Series], seconds: float) -> float:
    """Return the time (s) between two samples: the shortest there is, or little of `seconds` for single ones."""
    gaps = [after[0] - before[0] for each in series for before, after in pairwise(each.points)]
    return min(gaps, default=seconds / 100)


def _unbroken(series: Series, gap: float) -> list[list[tuple[float, float]]]:
    """Return a series' points in pieces, between which there was nothing for longer than `gap` (s)."""
    pieces: list[list[tuple[float, float]]] = []
    for point in series.points:
        if pieces and point[0] - pieces[-1][-1][0] <= gap:
            pieces[-1].append(point)
        else:
            pieces.append([point])
    return pieces


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
