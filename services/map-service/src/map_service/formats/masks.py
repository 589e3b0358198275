"""Zones as masks of Nav2's costmap filters, and painted masks as zones. Pure.

A mask is a grid of 0 to 100, as map_server publishes it (Nav2's `KeepoutFilter` and `SpeedFilter` read it): in a
keepout mask 100 is lethal and the values below are costs in percent of it, in a speed mask a value is a speed limit in
cm/s; 0 is nothing.

The outline of a painted part runs 0.3 cells inside its cells, so that a zone covers the same cells again:
`polygon_spans` takes cells whose centres lie within 0.71 cells of the outline. Stairs become straight lines through the
middles of their steps, and what lies within 0.4 cells of a line is left out (Ramer 1972, Douglas and Peucker 1973). It
covers at most one cell more on each side then, and none less.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from fog_contracts.costs import COST_PER_FACTOR, LETHAL, PENALTY_FACTOR_MAX
from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.grid import Window
from fog_contracts.shapes import ShapeMask, mask_spans

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from map_service.layers.base import Grid

MaskKind = Literal["keepout", "speed"]

FULL: Final = 100
"""Lethal, in a keepout mask."""
SPEED_STEP: Final = 0.01
"""What a value of a speed mask adds to the limit (m/s): the multiplier of its filter's info."""
MAX_PARTS: Final = 200
"""Most zones of one mask."""
MAX_VALUES: Final = 16
"""Most different values of one mask: a picture with smooth edges has more."""
_MAX_RUNS: Final = 20_000
_MAX_CORNERS: Final = 400
_INSET: Final = 0.3
_TOLERANCE: Final = 0.4
_BLOCKED_FROM: Final = 99


class MaskError(ValueError):
    """A mask can't become zones; the text says why, and the remedy."""


class Part(NamedTuple):
    """A connected part of a mask without holes: its value, its outline in cells of the mask, and how many it covers."""

    value: int
    outline: list[Point]
    cells: int


def keepout_values(cost: Grid) -> Grid:
    """Return the keepout mask of zones' costs (uint8, 0 to 254)."""
    graded = np.clip(np.rint(cost * (FULL / LETHAL)), 1, _BLOCKED_FROM - 1)
    values: Grid = np.where(cost == 0, 0, np.where(cost >= LETHAL, FULL, graded)).astype(np.uint8)
    return values


def speed_values(speed: Grid) -> Grid:
    """Return the speed mask of a speed layer (cm/s): limits of more than 1 m/s count as 1 m/s."""
    values: Grid = np.minimum(speed, FULL).astype(np.uint8)
    return values


def to_shades(values: Grid) -> Grid:
    """Return a mask as a picture in map_server's mode `scale` with the thresholds 0 and 1: black is 100, white 0."""
    shades: Grid = (255 - np.rint(values[::-1] * 2.55)).astype(np.uint8)
    return shades


def is_blocked(value: int) -> bool:
    """Whether a value of a keepout mask is a no-go zone; a lower one is a penalty."""
    return value >= _BLOCKED_FROM


def factor_of(value: int) -> float:
    """Return the factor of the penalty zone that costs as much as a value of a keepout mask."""
    return min(1.0 + value * LETHAL / FULL / COST_PER_FACTOR, PENALTY_FACTOR_MAX)


def parts_of(values: NDArray[np.int8]) -> list[Part]:
    """Return the parts of a mask, int8 (height, width), row 0 at the bottom; -1 counts as 0. Raises `MaskError`."""
    found = [int(value) for value in np.unique(values) if value > 0]
    if len(found) > MAX_VALUES:
        raise MaskError(
            f"the mask has {len(found)} different shades, and {MAX_VALUES} is the limit: paint without smooth edges"
        )
    parts: list[Part] = []
    for value in found:
        for component in _components(values == value):
            for piece in _pieces(component):
                parts.append(Part(value, _outline(piece), int(piece.mask.sum())))
                if len(parts) > MAX_PARTS:
                    raise MaskError(
                        f"the mask has more than {MAX_PARTS} parts: paint fewer, larger ones, or without dithering"
                    )
    return parts


# --- Parts of a mask --------------------------------------------------------------------------------------------------


def _components(mask: NDArray[np.bool_]) -> Iterator[ShapeMask]:
    """Yield the parts whose cells are connected by their sides."""
    height, width = mask.shape
    spans = mask_spans(ShapeMask(Window(0, 0, width, height), mask))
    count = len(spans.rows)
    if count > _MAX_RUNS:
        raise MaskError(f"the mask has {count} rows of painted cells, more than {_MAX_RUNS}: use a wider brush")
    rows, starts, stops = spans.rows.tolist(), spans.starts.tolist(), spans.stops.tolist()
    parent = list(range(count))

    def root(run: int) -> int:
        while parent[run] != run:
            parent[run] = parent[parent[run]]
            run = parent[run]
        return run

    below = 0
    for run in range(count):
        while rows[below] < rows[run] - 1 or (rows[below] == rows[run] - 1 and stops[below] <= starts[run]):
            below += 1
        other = below
        while rows[other] == rows[run] - 1 and starts[other] < stops[run]:
            parent[root(other)] = root(run)
            other += 1
    runs_of: dict[int, list[int]] = {}
    for run in range(count):
        runs_of.setdefault(root(run), []).append(run)
    for runs in runs_of.values():
        left, right = min(starts[run] for run in runs), max(stops[run] for run in runs)
        bottom, top = rows[runs[0]], rows[runs[-1]] + 1
        cells = np.zeros((top - bottom, right - left), np.bool_)
        for run in runs:
            cells[rows[run] - bottom, starts[run] - left : stops[run] - left] = True
        yield ShapeMask(Window(left, bottom, right - left, top - bottom), cells)


def _pieces(component: ShapeMask) -> Iterator[ShapeMask]:
    """Yield a component, cut where it has a hole, or an outline with too many corners."""
    loops = _loops(component.mask)
    holes = loops[1:]
    if not holes and len(_simplified(_without_stairs(loops[0]))) <= _MAX_CORNERS:
        yield component
        return
    window = component.window
    if holes:
        # The one nearest to the middle: halves of many holes are cut again less often than leftmost columns.
        middles = [(min(xs) + max(xs)) // 2 for hole in holes if (xs := [x for x, _ in hole])]
        column = min(middles, key=lambda x: abs(x - window.width / 2))
    else:
        column = window.width // 2
    across = not 0 < column < window.width
    cuts = (slice(None), slice(0, column)), (slice(None), slice(column, None))
    if across or (not holes and window.height > window.width):
        row = window.height // 2
        cuts = (slice(0, row), slice(None)), (slice(row, None), slice(None))
    for rows, columns in cuts:
        for piece in _components(component.mask[rows, columns]):
            x, y = (columns.start or 0) + piece.window.x, (rows.start or 0) + piece.window.y
            moved = Window(window.x + x, window.y + y, piece.window.width, piece.window.height)
            yield from _pieces(ShapeMask(moved, piece.mask))


# --- Outlines ---------------------------------------------------------------------------------------------------------

_Corner = tuple[int, int]


def _loops(mask: NDArray[np.bool_]) -> list[list[_Corner]]:
    """Return the borders of a component along its cells' sides, the cells on the left: the outer one first."""
    padded = np.pad(mask, 1).astype(np.int8)
    following: dict[_Corner, list[_Corner]] = {}
    up, right = np.diff(padded, axis=1)[1:-1], np.diff(padded, axis=0)[:, 1:-1]
    for y, x in np.argwhere(up != 0).tolist():
        # Cells on the right side of the edge: it runs down; on its left side: up.
        begin, end = ((x, y + 1), (x, y)) if up[y, x] > 0 else ((x, y), (x, y + 1))
        following.setdefault(begin, []).append(end)
    for y, x in np.argwhere(right != 0).tolist():
        begin, end = ((x, y), (x + 1, y)) if right[y, x] > 0 else ((x + 1, y), (x, y))
        following.setdefault(begin, []).append(end)
    loops: list[list[_Corner]] = []
    for first in sorted(following):
        while first in following:
            loop = [first]
            corner = _take(following, first, None)
            while corner != first:
                loop.append(corner)
                corner = _take(following, corner, loop[-2])
            loops.append(_without_straight(loop))
    # The leftmost corner of all is of the outer border, which was traced first.
    return loops


def _take(following: dict[_Corner, list[_Corner]], corner: _Corner, before: _Corner | None) -> _Corner:
    """Remove and return the next corner; where two cells meet at a corner only, turn left, to stay with one's own."""
    choices = following[corner]
    if len(choices) > 1 and before is not None:
        dx, dy = corner[0] - before[0], corner[1] - before[1]
        choices.sort(key=lambda to: dx * (to[1] - corner[1]) - dy * (to[0] - corner[0]))
    taken = choices.pop()
    if not choices:
        del following[corner]
    return taken


def _without_straight(loop: list[_Corner]) -> list[_Corner]:
    count = len(loop)
    return [
        loop[i]
        for i in range(count)
        if (loop[i][0] - loop[i - 1][0] == 0) != (loop[(i + 1) % count][0] - loop[i][0] == 0)
    ]


def _inset(loop: list[_Corner]) -> list[Point]:
    """Return a border moved to the left, into its cells."""
    count = len(loop)
    moved = []
    for i, (x, y) in enumerate(loop):
        x_before, y_before = loop[i - 1]
        x_after, y_after = loop[(i + 1) % count]
        into = [_left(x - x_before, y - y_before), _left(x_after - x, y_after - y)]
        moved.append((x + _INSET * sum(each[0] for each in into), y + _INSET * sum(each[1] for each in into)))
    return moved


def _without_stairs(loop: list[_Corner]) -> list[Point]:
    """Return a border moved into its cells, in which each step of one cell, between turns to both sides, is a point."""
    count, moved = len(loop), _inset(loop)
    sides = [(loop[(i + 1) % count][0] - x, loop[(i + 1) % count][1] - y) for i, (x, y) in enumerate(loop)]
    turns = [
        before[0] * side[1] - before[1] * side[0] > 0 for before, side in zip([sides[-1], *sides], sides, strict=False)
    ]
    steps = [abs(dx) + abs(dy) == 1 and turns[i] != turns[(i + 1) % count] for i, (dx, dy) in enumerate(sides)]
    points: list[Point] = []
    for i, (x, y) in enumerate(moved):
        if steps[i]:
            x_after, y_after = moved[(i + 1) % count]
            points.append(((x + x_after) / 2.0, (y + y_after) / 2.0))
        elif not steps[i - 1]:
            points.append((x, y))
    return points


def _left(dx: int, dy: int) -> _Corner:
    return -int(math.copysign(1, dy)) if dy else 0, int(math.copysign(1, dx)) if dx else 0


def _outline(piece: ShapeMask) -> list[Point]:
    """Return the outline of a piece without holes in cells of the mask: simplified, if it stays simple."""
    border = [(piece.window.x + x, piece.window.y + y) for x, y in _loops(piece.mask)[0]]
    try:
        return normalized_polygon(_simplified(_without_stairs(border)))
    except GeometryError:
        return normalized_polygon(_inset(border))


def _simplified(ring: list[Point]) -> list[Point]:
    """Return a ring with fewer corners, none of the others farther than the tolerance (cells) from it."""
    points = np.array([*ring, ring[0]], dtype=np.float64)
    far = int(np.argmax(np.hypot(*(points[:-1] - points[0]).T)))
    kept = {0, far}
    stretches = [(0, far), (far, len(ring))]
    while stretches:
        first, last = stretches.pop()
        if last - first < 2:
            continue
        a, b = points[first], points[last]
        between = points[first + 1 : last]
        along = b - a
        squared = float(along @ along)
        t = np.clip((between - a) @ along / squared, 0.0, 1.0) if squared else np.zeros(len(between))
        distance = np.hypot(*(between - a - t[:, None] * along).T)
        worst = int(np.argmax(distance))
        if distance[worst] > _TOLERANCE:
            index = first + 1 + worst
            kept.add(index)
            stretches += [(first, index), (index, last)]
    return [ring[index] for index in sorted(kept)]
