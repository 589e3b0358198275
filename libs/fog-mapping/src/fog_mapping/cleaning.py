"""Cleaning of maps by commands: lines of text, in metres, that are kept and applied again to a new recording's map.

    # The first map, whose frame counts, and the fingerprint of its cells.
    map floor.yaml 3fa2b1c0d9e8
    straighten                      # turns the map so that its walls run along the axes, or by degrees: straighten 3.2
    crop 0 0 60 25                  # keeps a rectangle: left, bottom, right, top
    erase 3.0 1.0 4.0 2.0           # makes what is occupied in a rectangle free: people, noise
    wall 5.0 1.0 5.0 4.0            # draws a wall along points: glass, mirrors, a shut door
    block 8.0 2.0 8.6 3.0           # fills a rectangle: furniture
    freeze 20 0 25 5                # keeps the first map's cells there in a later recording
    free 1 1 4 1 4 3                # makes a polygon free
    unknown 61 0 70 0 70 9 61 9     # makes a polygon unknown: what was seen through windows
    speckles                        # makes single occupied cells and pairs amid free floor free: people, noise
    islands                         # makes free floor unknown that no free floor joins to the largest part

Coordinates are those of the map as the lines above it leave it. To undo a command, delete its line.
"""

from __future__ import annotations

import hashlib
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.grid import GridGeometry, StaticMap, Window
from fog_contracts.resampling import resampled
from fog_contracts.shapes import rasterize, rasterize_line
from fog_mapping.alignment import Alignment, align, laid_onto, wall_points
from fog_mapping.checking import islands, specks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_RECTANGLE: Final = "left bottom right top"
_FORMS: Final = {
    "straighten": "[degrees]",
    "crop": _RECTANGLE,
    "erase": _RECTANGLE,
    "block": _RECTANGLE,
    "freeze": _RECTANGLE,
    "wall": "x y x y ...",
    "free": "x y x y x y ...",
    "unknown": "x y x y x y ...",
    "speckles": "",
    "islands": "",
}
_FIRST_MAP: Final = "map"
_FINGERPRINT_DIGITS: Final = 12
_MOST_M: Final = 1e5
_THICK_CELLS: Final = 0.75
"""Half the thickness of a drawn wall: no step, not even a diagonal one, leads through it."""


class CommandError(ValueError):
    """A line of a cleaning file can't be used; the message names its number, the problem and the remedy."""

    def __init__(self, line: int, problem: str, remedy: str) -> None:
        super().__init__(f"line {line}: {problem}. {remedy}")


class Command(NamedTuple):
    """One line: its number, its word, and its numbers (m; degrees for straighten)."""

    line: int
    word: str
    numbers: tuple[float, ...]

    def __str__(self) -> str:
        return " ".join((self.word, *(f"{value:g}" for value in self.numbers)))


class Cleaning(NamedTuple):
    """The commands of a file, and its first map (name and fingerprint), None if it names none."""

    commands: tuple[Command, ...]
    first: tuple[str, str] | None


class Cleaned(NamedTuple):
    """A map after its commands, and how it was laid onto the first one; None for the first map itself."""

    map: StaticMap
    alignment: Alignment | None


def fingerprint(static: StaticMap) -> str:
    """Return what tells a map from another: digits of a hash of its cells and their places."""
    g = static.geometry
    told = f"{g.width} {g.height} {g.resolution:.6f} {g.origin_x:.6f} {g.origin_y:.6f} ".encode()
    return hashlib.sha256(told + np.ascontiguousarray(static.cells).tobytes()).hexdigest()[:_FINGERPRINT_DIGITS]


def read(text: str) -> Cleaning:
    """Return the commands of a cleaning file's text; raises `CommandError`."""
    first: tuple[str, str] | None = None
    commands: list[Command] = []
    for line, full in enumerate(text.splitlines(), start=1):
        words = full.partition("#")[0].split()
        if not words:
            continue
        if words[0] == _FIRST_MAP:
            if len(words) < 3 or first is not None or commands:
                raise CommandError(line, "the first map is named once, before all commands", "Write: map FILE DIGITS")
            first = " ".join(words[1:-1]), words[-1]
        else:
            commands.append(_command(line, words))
    return Cleaning(tuple(commands), first)


def _command(line: int, words: Sequence[str]) -> Command:
    word = words[0]
    if word not in _FORMS:
        raise CommandError(line, f"{word!r} is no command", f"Use one of {', '.join(_FORMS)}")
    remedy = f"Write: {word} {_FORMS[word]}".rstrip()
    try:
        numbers = tuple(float(text) for text in words[1:])
    except ValueError:
        raise CommandError(line, f"{' '.join(words[1:])} are not all numbers", remedy) from None
    if not all(abs(value) <= _MOST_M for value in numbers):
        raise CommandError(line, f"a number is none, or larger than {_MOST_M:g}", remedy)
    problem = _problem(word, numbers)
    if problem is not None:
        raise CommandError(line, problem, remedy)
    return Command(line, word, numbers)


def _problem(word: str, numbers: tuple[float, ...]) -> str | None:
    """Return why a command can't have these numbers, or None."""
    count = len(numbers)
    most = 1 if word == "straighten" else 0 if not _FORMS[word] else None
    if most is not None:
        return f"there are {count} numbers, and at most {most} is of use" if count > most else None
    if _FORMS[word] == _RECTANGLE:
        if count != 4:
            return f"a rectangle has 4 numbers, not {count}"
        empty = numbers[0] >= numbers[2] or numbers[1] >= numbers[3]
        return "the rectangle is empty: left and bottom come first" if empty else None
    least = 4 if word == "wall" else 6
    if count < least or count % 2:
        return f"{count} numbers are no {least // 2} points or more"
    try:
        if word != "wall":
            normalized_polygon(list(zip(numbers[::2], numbers[1::2], strict=True)))
    except GeometryError as error:
        return f"the polygon is none: {error}"
    return None


def clean(commands: Sequence[Command], static: StaticMap, first: StaticMap | None = None) -> Cleaned:
    """Return a map after the commands; it is the first map itself, or laid onto that by matching of walls.

    The result covers both maps (unless cropped). Raises `CommandError`, and `MisfitError` for a map of another place.
    """
    if first is None:
        return Cleaned(_applied(commands, static, static), None)
    alignment = align(static, first)
    laid = laid_onto(static, first, alignment.pose)
    return Cleaned(_applied(commands, _joined(laid, first.geometry), first), alignment)


def _applied(commands: Sequence[Command], static: StaticMap, first: StaticMap) -> StaticMap:
    for command in commands:
        if command.word == "straighten":
            turn = -math.radians(command.numbers[0]) if command.numbers else -wall_angle(first)
            turned = _turned(first, turn, first.geometry)
            static = turned if static is first else _turned(static, turn, turned.geometry)
            first = turned
            continue
        # What is frozen comes from the first map as the commands so far have left it.
        changed = _changed(command, static, first)
        first = changed if static is first else _changed(command, first, first)
        static = changed
    return static


def _turned(static: StaticMap, turn: float, aligned_to: GridGeometry) -> StaticMap:
    g = static.geometry
    cos, sin = math.cos(turn), math.sin(turn)
    corner = g.origin_x * cos - g.origin_y * sin, g.origin_x * sin + g.origin_y * cos
    return resampled(static, turn, corner, aligned_to=aligned_to)


def wall_angle(static: StaticMap) -> float:
    """Return by how much (rad, within an eighth of a turn) most walls are turned from the axes; 0 without walls."""
    points, normals = wall_points(static)
    if not len(points):
        return 0.0
    # The angles of walls repeat each quarter turn; then the turn at which walls fill the fewest rows and columns.
    rough = math.atan2(*_sum_of_quarters(normals)) / 4.0
    cell = static.geometry.resolution

    def sharpness(angle: float) -> float:
        cos, sin = math.cos(angle), math.sin(angle)
        across = points @ np.array((cos, sin)), points @ np.array((-sin, cos))
        return sum(float((np.bincount(((one - one.min()) / cell).astype(int)) ** 2.0).sum()) for one in across)

    best = rough
    for span, step in ((0.03, 0.002), (0.002, 0.0002)):
        candidates = best + np.arange(-span, span + step / 2, step)
        best = float(candidates[int(np.argmax([sharpness(float(angle)) for angle in candidates]))])
    return best


def _sum_of_quarters(normals: NDArray[np.float64]) -> tuple[float, float]:
    angles = 4.0 * np.arctan2(normals[:, 1], normals[:, 0])
    return float(np.sin(angles).sum()), float(np.cos(angles).sum())


def _changed(command: Command, static: StaticMap, first: StaticMap) -> StaticMap:
    _, word, numbers = command
    geometry = static.geometry
    if not _FORMS[word]:
        found, becomes = (specks, FREE) if word == "speckles" else (islands, UNKNOWN)
        return StaticMap(geometry, np.where(found(static.cells), np.uint8(becomes), static.cells))
    if word in {"wall", "free", "unknown"}:
        points = list(zip(numbers[::2], numbers[1::2], strict=True))
        reach = _THICK_CELLS * geometry.resolution
        window, mask = (
            rasterize_line(points, reach, geometry)
            if word == "wall"
            else rasterize(normalized_polygon(points), geometry)
        )
        _refuse_empty(command, window, geometry)
        cells = static.cells.copy()
        cells[window.rows, window.columns][mask] = {"wall": LETHAL, "free": FREE, "unknown": UNKNOWN}[word]
        return StaticMap(geometry, cells)
    window = _rectangle(numbers, geometry)
    _refuse_empty(command, window, geometry)
    if word == "crop":
        return StaticMap(geometry.part(window), np.ascontiguousarray(static.cells[window.rows, window.columns]))
    cells = static.cells.copy()
    part = cells[window.rows, window.columns]
    if word == "erase":
        part[part == LETHAL] = FREE
    elif word == "block":
        part[:] = LETHAL
    else:
        centres = geometry.centres(np.argwhere(np.ones_like(part))[:, ::-1] + (window.x, window.y))
        part[:] = first.geometry.sample(first.cells, centres, UNKNOWN).reshape(part.shape)
    return StaticMap(geometry, cells)


def _rectangle(numbers: Sequence[float], geometry: GridGeometry) -> Window:
    """Return the cells whose centres lie in a rectangle (m); edges between cells don't depend on rounding."""
    left, bottom, right, top = (
        math.ceil((value - origin) / geometry.resolution - 0.5 - 1e-6)
        for value, origin in zip(numbers, (geometry.origin_x, geometry.origin_y) * 2, strict=True)
    )
    return geometry.clip(Window(left, bottom, right - left, top - bottom))


def _refuse_empty(command: Command, window: Window, geometry: GridGeometry) -> None:
    if window.empty:
        left, bottom, right, top = geometry.bounds
        raise CommandError(
            command.line,
            f"`{command}` meets no cell of the map, which reaches from ({left:.2f}, {bottom:.2f}) to "
            f"({right:.2f}, {top:.2f})",
            "Correct or delete it; it counts in the map as the lines above it leave it",
        )


def _joined(static: StaticMap, other: GridGeometry) -> StaticMap:
    """Return a map with unknown cells around it, so that it covers another on the same cells."""
    g = static.geometry
    x, y = (
        round((theirs - ours) / g.resolution)
        for ours, theirs in ((g.origin_x, other.origin_x), (g.origin_y, other.origin_y))
    )
    whole = g.whole.union(Window(x, y, other.width, other.height))
    cells = np.full((whole.height, whole.width), UNKNOWN, np.uint8)
    cells[-whole.y : -whole.y + g.height, -whole.x : -whole.x + g.width] = static.cells
    return StaticMap(g.part(whole), cells)
