"""Charts as SVG, which every browser shows and every editor opens: grouped bars with confidence intervals. Pure."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fognav_experiments.comparison.statistics import Estimate

COLOURS: Final = {
    "default": "#d9822b", "full": "#3b7dd8", "fog": "#2a9d5c", "lockstep": "#9a9a9a", "live": "#7a4fb5",
    "hardware": "#444444",
}  # fmt: skip
"""Colours of the setups, of which those of the first two are the thesis's, and of how a drive was made."""
_WIDTH: Final = 640
_HEIGHT: Final = 320
_LEFT: Final = 60
_BOTTOM: Final = 40
_TOP: Final = 44
_TICKS: Final = 5


def bars(title: str, unit: str, groups: Sequence[str], series: Mapping[str, Sequence[Estimate | None]]) -> str:
    """Return a chart with one group of bars per route: the mean of each setup, with its 95 % confidence interval.

    `groups`: their names, each of one or two lines. `series`: for each setup, or whatever else has a colour, an
    estimate per group, None without one.
    """
    known = [found for values in series.values() for found in values if found is not None]
    tops = [found.mean + (found.half or 0.0) for found in known]
    top = _round_up(max([*tops, 1e-9]))
    plot_h, plot_w = _HEIGHT - _TOP - _BOTTOM, _WIDTH - _LEFT - 16
    parts = [_text(_LEFT, 18, f"{title} ({unit})", weight="bold"), *_legend(list(series))]
    for tick in range(_TICKS + 1):
        value = top * tick / _TICKS
        y = _TOP + plot_h * (1 - tick / _TICKS)
        parts.append(f'<line x1="{_LEFT}" x2="{_WIDTH - 16}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>')
        parts.append(_text(_LEFT - 6, y + 4, f"{value:g}", anchor="end"))
    group_w = plot_w / max(len(groups), 1)
    bar_w = 0.7 * group_w / max(len(series), 1)
    for number, group in enumerate(groups):
        left = _LEFT + group_w * number + 0.15 * group_w
        for line, words in enumerate(group.split("\n")):
            parts.append(_text(left + 0.35 * group_w, _HEIGHT - 22 + 14 * line, words, anchor="middle"))
        for place, (setup, values) in enumerate(series.items()):
            if (found := values[number]) is not None:
                parts += _bar(left + bar_w * place, bar_w, found, plot_h / top, COLOURS[setup])
    return _svg(_HEIGHT, parts)


def _bar(x: float, width: float, found: Estimate, scale: float, colour: str) -> list[str]:
    base = _HEIGHT - _BOTTOM
    height, middle = found.mean * scale, x + width / 2
    drawn = [
        f'<rect x="{x + 1:.1f}" y="{base - height:.1f}" width="{width - 2:.1f}" height="{height:.1f}" fill="{colour}"/>'
    ]
    if found.half is not None:
        low, high = base - (found.mean - found.half) * scale, base - (found.mean + found.half) * scale
        drawn += [
            f'<line x1="{middle:.1f}" x2="{middle:.1f}" y1="{min(low, base):.1f}" y2="{high:.1f}" stroke="#222"/>',
            f'<line x1="{middle - 5:.1f}" x2="{middle + 5:.1f}" y1="{high:.1f}" y2="{high:.1f}" stroke="#222"/>',
        ]
    return drawn


def _legend(setups: Sequence[str]) -> list[str]:
    drawn = []
    for number, setup in enumerate(setups):
        x = _WIDTH - 90 * (len(setups) - number) - 10
        drawn.append(f'<rect x="{x}" y="8" width="12" height="12" fill="{COLOURS[setup]}"/>')
        drawn.append(_text(x + 17, 18, setup))
    return drawn


def _text(x: float, y: float, text: str, *, anchor: str = "start", weight: str = "normal") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-weight="{weight}">{escape(text)}</text>'


def _round_up(value: float) -> float:
    """Return the next value of the form 1, 2 or 5 times a power of ten, times 1 to 5 ticks."""
    step = 10.0
    while step > value:
        step /= 10.0
    while step * 10 <= value:
        step *= 10.0
    return next(step * factor for factor in (1, 2, 2.5, 5, 10) if step * factor >= value)


def tracks(
    paths: Mapping[str, Sequence[tuple[float, float]]],
    blocked: Sequence[tuple[float, float]] = (),
    stops: Mapping[str, tuple[float, float]] | None = None,
) -> str:
    """Return the true tracks (m) of several setups, seen from above, with the scale of 10 m.

    `blocked`: corners of the area that was blocked; `stops`: names and positions of the route's ends.
    """
    stops = stops or {}
    points = [point for path in paths.values() for point in path] + [*blocked, *stops.values()]
    left, bottom = min(x for x, _ in points) - 2.0, min(y for _, y in points) - 2.0
    right, top = max(x for x, _ in points) + 2.0, max(y for _, y in points) + 2.0
    scale = (_WIDTH - 20) / max(right - left, 1.0)
    height = (top - bottom) * scale + _TOP
    parts = _legend(list(paths))
    if blocked:
        corners = [((x - left) * scale + 10, height - (y - bottom) * scale) for x, y in blocked]
        places = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        parts.append(f'<polygon points="{places}" fill="#e9b4b4" stroke="#b03030"/>')
        middle, lowest = sum(x for x, _ in corners) / len(corners), max(y for _, y in corners)
        parts.append(_text(middle, lowest + 15, "blocked", anchor="middle"))
    for number, (setup, path) in enumerate(paths.items()):
        # A little apart, so that tracks on the same way are all seen.
        places = " ".join(
            f"{(x - left) * scale + 10 + 2 * number:.1f},{height - (y - bottom) * scale + 2 * number:.1f}"
            for x, y in path
        )
        parts.append(f'<polyline points="{places}" fill="none" stroke="{COLOURS[setup]}" stroke-width="2"/>')
    for name, (x, y) in (stops or {"": points[0]}).items():
        column, row = (x - left) * scale + 10, height - (y - bottom) * scale
        parts.append(f'<circle cx="{column:.1f}" cy="{row:.1f}" r="5"/>')
        parts.append(_text(column + 9, row - 7, name, weight="bold"))
    parts.append(f'<line x1="10" x2="{10 + 10 * scale:.1f}" y1="30" y2="30" stroke="#222" stroke-width="2"/>')
    parts.append(_text(10, 24, "10 m"))
    return _svg(height, parts)


def _svg(height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height:.0f}" width="{_WIDTH}" '
        f'height="{height:.0f}" font-family="sans-serif" font-size="12">'
        f'<rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'
    )
