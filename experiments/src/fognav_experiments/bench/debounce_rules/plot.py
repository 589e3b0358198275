"""Draws the comparison of debounce rules by the share of echoes: detection time, misses, losses, what is known."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from PIL import Image, ImageDraw

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

_PANELS: Final = (
    ("detection_median_ms", "time to detection, median, ms"),
    ("detection_p95_ms", "time to detection, 95th percentile, ms"),
    ("missed_percent", "obstacles missed for 2 s, %"),
    ("lost_percent", "obstacles lost within 4 s, %"),
    ("known_percent", "share of its 4 s an obstacle is known, %"),
)
_COLOURS: Final = ("#d62728", "#1f77b4", "#2ca02c", "#9467bd", "#ff7f0e")
_WIDTH: Final = 380
_HEIGHT: Final = 280
_MARGIN: Final = 46
_LEGEND: Final = 40


def draw(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write a PNG with one panel per figure, and one line per rule."""
    rules = list(dict.fromkeys(row["rule"] for row in rows))
    image = Image.new("RGB", (_WIDTH * len(_PANELS), _HEIGHT + _LEGEND), "white")
    canvas = ImageDraw.Draw(image)
    for index, (key, title) in enumerate(_PANELS):
        lines = [[(row["echo_rate"], row[key]) for row in rows if row["rule"] == rule] for rule in rules]
        _panel(canvas, index * _WIDTH, title, [[(x, y) for x, y in line if y is not None] for line in lines])
    for index, rule in enumerate(rules):
        x, y = _MARGIN + index * _WIDTH // 2, _HEIGHT + _LEGEND // 2
        canvas.line((x, y, x + 24, y), fill=_COLOURS[index % len(_COLOURS)], width=3)
        alarms = next(row["false_alarms_stressed_per_h"] for row in rows if row["rule"] == rule)
        canvas.text((x + 30, y - 6), f"{rule} ({alarms:g}/h)", fill="black")
    image.save(path)


def _panel(canvas: ImageDraw.ImageDraw, left: int, title: str, lines: Sequence[Sequence[tuple[float, float]]]) -> None:
    points = [point for line in lines for point in line]
    low, high = min(x for x, _ in points), max(x for x, _ in points)
    top = max(1.0, *(y for _, y in points))

    def place(point: tuple[float, float]) -> tuple[float, float]:
        x, y = point
        across = (x - low) / max(high - low, 1e-9)
        return left + _MARGIN + across * (_WIDTH - 1.5 * _MARGIN), _HEIGHT - _MARGIN - y / top * (_HEIGHT - 2 * _MARGIN)

    canvas.text((left + _MARGIN, 12), title, fill="black")
    for x in (low, (low + high) / 2, high):
        canvas.text((place((x, 0))[0] - 10, _HEIGHT - _MARGIN + 6), f"{100 * x:.0f} %", fill="black")
    for y in (0.0, top / 2, top):
        canvas.text((left + 4, place((low, y))[1] - 6), f"{y:.0f}", fill="black")
        canvas.line((*place((low, y)), *place((high, y))), fill="#dddddd")
    for index, line in enumerate(lines):
        canvas.line([place(point) for point in line], fill=_COLOURS[index % len(_COLOURS)], width=2)
