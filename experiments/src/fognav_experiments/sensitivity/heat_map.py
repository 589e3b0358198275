"""A plane as a heat map in SVG: one cell per point, the greener the more the fog saves there. Pure."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Final

from fognav_experiments.sensitivity.planes import UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fognav_experiments.sensitivity.planes import Gain, Plane, Variation

_CELL_W: Final = 96
_CELL_H: Final = 54
_LEFT: Final = 92
_TOP: Final = 34
_BOTTOM: Final = 52
_RIGHT: Final = 20
_LEAST_W: Final = 420
_FULL: Final = (42, 157, 92)
_NONE: Final = (255, 255, 255)
_LOSS: Final = (217, 130, 43)


def heat_map(title: str, plane: Plane, gains: Mapping[Variation, Gain]) -> str:
    """Return the picture: metres saved with their 95 % confidence interval, and seconds; grey where none was driven."""
    columns, rows = len(plane.x.values), len(plane.y.values)
    width = max(_LEFT + _CELL_W * columns + _RIGHT, _LEAST_W)
    height = _TOP + _CELL_H * rows + _BOTTOM
    most = max((abs(gain.metres.mean) for gain in gains.values()), default=0.0)
    parts = [_text(10, 20, title, weight="bold")]
    for row, y in enumerate(reversed(plane.y.values)):
        top = _TOP + _CELL_H * row
        parts.append(_text(_LEFT - 8, top + _CELL_H / 2 + 4, f"{y:g}", anchor="end"))
        for column, x in enumerate(plane.x.values):
            parts += _cell(_LEFT + _CELL_W * column, top, gains.get(plane.at(x, y)), most)
    bottom = _TOP + _CELL_H * rows
    for column, x in enumerate(plane.x.values):
        parts.append(_text(_LEFT + _CELL_W * (column + 0.5), bottom + 17, f"{x:g}", anchor="middle"))
    parts.append(_text(_LEFT, bottom + 38, UNITS[plane.x.quantity]))
    parts.append(
        f'<g transform="translate(22 {bottom}) rotate(-90)">{_lines(UNITS[plane.y.quantity], _CELL_H * rows)}</g>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
        f"{''.join(parts)}</svg>\n"
    )


def _lines(text: str, room: float) -> str:
    """Return a text in as many lines as fit its room (px)."""
    letters = max(int(room / 6.5), 10)
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > letters:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "".join(_text(0, 14 * number, line) for number, line in enumerate(lines))


def _cell(x: float, y: float, gain: Gain | None, most: float) -> list[str]:
    if gain is None:
        fill = "#eee"
        words: list[str] = []
    else:
        fill = _colour(gain.metres.mean, most)
        half = "" if gain.metres.half is None else f" ± {gain.metres.half:.1f}"
        words = [f"{gain.metres.mean:.1f}{half} m", f"{gain.seconds.mean:.0f} s"]
    drawn = [f'<rect x="{x}" y="{y}" width="{_CELL_W}" height="{_CELL_H}" fill="{fill}" stroke="#fff"/>']
    middle = x + _CELL_W / 2
    return drawn + [_text(middle, y + 24 + 16 * number, word, anchor="middle") for number, word in enumerate(words)]


def _colour(value: float, most: float) -> str:
    share = min(abs(value) / most, 1.0) if most > 0.0 else 0.0
    end = _FULL if value >= 0.0 else _LOSS
    mixed = (round(none + (full - none) * share) for none, full in zip(_NONE, end, strict=True))
    return "#" + "".join(f"{part:02x}" for part in mixed)


def _text(x: float, y: float, text: str, *, anchor: str = "start", weight: str = "normal") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-weight="{weight}">{escape(text)}</text>'
