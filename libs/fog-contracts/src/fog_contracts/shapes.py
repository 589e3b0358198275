"""Shapes of zones and areas: the cells of a grid that they cover, as spans of columns per row, and their validation.

A shape's spans take memory and time by the length of its outline, not by its area, so that a zone over a whole floor
is as cheap as a small one. `MAX_OUTLINE_ROWS` bounds both.

To add a shape, define its message in `fog_contracts.messages` (and name it in `Shape`), write its class here and add
both to `KINDS`. No other module distinguishes the kinds of shapes.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fog_contracts.geometry import (
    GeometryError,
    Point,
    Polygon,
    contains_point,
    distance_to_segment,
    normalized_polygon,
)
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import CircleShape, CorridorShape, PolygonShape, RectangleShape, Shape

MAX_OUTLINE_ROWS: Final = 100_000
"""How many rows of cells the sides of one shape may cross, summed over its sides: 5 km of outline at 5 cm per cell."""
_TOLERANCE: Final = 1e-9
"""How much further (m) a shape reaches, so that rounding leaves out no cell."""

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]


class ShapeMask(NamedTuple):
    """The cells of a shape: a window of the grid, and a mask (window height, window width) of the cells in it."""

    window: Window
    mask: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Spans:
    """The cells of a shape on a grid: columns `starts[i]` to `stops[i]` (exclusive) of row `rows[i]`, int32 (n,).

    Ordered by row and column; the spans of a row neither overlap nor touch. `window` is the smallest that holds them.
    """

    window: Window
    rows: NDArray[np.int32]
    starts: NDArray[np.int32]
    stops: NDArray[np.int32]

    @property
    def cells(self) -> int:
        """How many cells they cover."""
        return int((self.stops - self.starts).sum(dtype=np.int64))

    def to_mask(self) -> ShapeMask:
        """Return the same cells as a mask over their window."""
        window = self.window
        steps = np.zeros((window.height, window.width + 1), dtype=np.int8)
        steps[self.rows - window.y, self.starts - window.x] = 1
        steps[self.rows - window.y, self.stops - window.x] = -1
        return ShapeMask(window, np.cumsum(steps[:, :-1], axis=1, dtype=np.int8).view(np.bool_))


def mask_spans(shape: ShapeMask) -> Spans:
    """Return the cells of a mask as spans."""
    padded = np.zeros((shape.window.height, shape.window.width + 2), dtype=np.int8)
    padded[:, 1:-1] = shape.mask
    steps = np.diff(padded, axis=1)
    rows, starts = np.nonzero(steps > 0)
    _, stops = np.nonzero(steps < 0)
    return _spans(rows + shape.window.y, starts + shape.window.x, stops + shape.window.x)


def polygon_spans(polygon: Polygon, geometry: GridGeometry) -> Spans:
    """Return the cells of a polygon; none when it lies off the grid.

    A cell belongs to the polygon when its centre lies inside or within half a cell's diagonal of the border, so that
    no part of a hazard is missing. Inside is determined by the even-odd rule along each row of centres. Raises
    `GeometryError` when the outline is too long (`MAX_OUTLINE_ROWS`).
    """
    sides = np.array([*polygon, polygon[0]], dtype=np.float64)
    border = _near_line(sides, geometry.resolution * math.sqrt(0.5), geometry)
    inside = _inside(sides, geometry)
    return _union([border, inside], geometry)


def line_spans(line: Sequence[Point], reach: float, geometry: GridGeometry) -> Spans:
    """Return the cells within `reach` (m) of a polyline; a single point gives a disc.

    As with a polygon, cells within half a cell's diagonal of the border belong to it. Raises `GeometryError` when the
    line is too long (`MAX_OUTLINE_ROWS`).
    """
    points = np.array(line if len(line) > 1 else [line[0], line[0]], dtype=np.float64)
    return _union([_near_line(points, reach + geometry.resolution * math.sqrt(0.5), geometry)], geometry)


def rasterize(polygon: Polygon, geometry: GridGeometry) -> ShapeMask:
    """Return the cells of a polygon (`polygon_spans`) as a mask; its window is empty for a polygon off the grid."""
    return polygon_spans(polygon, geometry).to_mask()


def rasterize_line(line: Sequence[Point], reach: float, geometry: GridGeometry) -> ShapeMask:
    """Return the cells within `reach` (m) of a polyline (`line_spans`) as a mask."""
    return line_spans(line, reach, geometry).to_mask()


class _Intervals(NamedTuple):
    """Columns `starts[i]` to `stops[i]` (exclusive) of row `rows[i]`, in any order, overlapping or empty."""

    rows: _Ints
    starts: _Ints
    stops: _Ints


def _rows_between(low: _Floats, high: _Floats, geometry: GridGeometry) -> tuple[_Ints, _Ints]:
    """Return, for each height range (m), its number and the grid's rows whose centres lie in it: two arrays (n,).

    A row at the very end of a range may be left out or added by rounding.
    """
    scaled_low = (low - geometry.origin_y) / geometry.resolution - 0.5
    scaled_high = (high - geometry.origin_y) / geometry.resolution - 0.5
    first = np.clip(np.ceil(scaled_low), 0, geometry.height).astype(np.int64)
    last = np.clip(np.floor(scaled_high), -1, geometry.height - 1).astype(np.int64)
    counts = np.maximum(last - first + 1, 0)
    total = int(counts.sum())
    if total > MAX_OUTLINE_ROWS:
        raise GeometryError(
            f"its sides cross {total} rows of cells in all, more than {MAX_OUTLINE_ROWS}: draw fewer or shorter sides"
        )
    numbers = np.repeat(np.arange(len(low)), counts)
    before = np.repeat(np.cumsum(counts) - counts, counts)
    return numbers, np.arange(total) - before + np.repeat(first, counts)


def _near_line(points: _Floats, reach: float, geometry: GridGeometry) -> _Intervals:
    """Return the cells whose centres lie within `reach` (m) of a polyline (float64 (n, 2)).

    What lies near one side is convex: a single interval in each row, from two discs and the strip between them.
    """
    reach += _TOLERANCE
    (ax, ay), (bx, by) = points[:-1].T, points[1:].T
    numbers, rows = _rows_between(np.minimum(ay, by) - reach, np.maximum(ay, by) + reach, geometry)
    ax, ay, bx, by = ax[numbers], ay[numbers], bx[numbers], by[numbers]
    xs, ys = geometry.axes(geometry.whole)
    y = ys[rows]
    left, right = _strip(bx - ax, by - ay, y - ay, reach)
    left, right = np.where(left <= right, ax + left, np.inf), np.where(left <= right, ax + right, -np.inf)
    for centre_x, centre_y in ((ax, ay), (bx, by)):
        squared = reach * reach - (y - centre_y) ** 2
        half = np.sqrt(np.maximum(squared, 0.0))
        left = np.minimum(left, np.where(squared >= 0.0, centre_x - half, np.inf))
        right = np.maximum(right, np.where(squared >= 0.0, centre_x + half, -np.inf))
    return _Intervals(rows, np.searchsorted(xs, left, side="left"), np.searchsorted(xs, right, side="right"))


def _strip(dx: _Floats, dy: _Floats, height: _Floats, reach: float) -> tuple[_Floats, _Floats]:
    """Return where, `height` (m) above the start of a side (dx, dy), the side is within `reach` and neither end nearer.

    The result is two distances (m) from the start along x; the first is larger where there is no such place.
    """
    squared = dx * dx + dy * dy
    flat, upright = np.abs(dy) < _TOLERANCE, np.abs(dx) < _TOLERANCE
    safe_dx, safe_dy = np.where(upright, 1.0, dx), np.where(flat, 1.0, dy)
    # Within reach of the straight line through the side ...
    centre, half = height * dx / safe_dy, reach * np.sqrt(squared) / np.abs(safe_dy)
    within = np.where(np.abs(height) <= reach, np.inf, -np.inf)
    left, right = np.where(flat, -within, centre - half), np.where(flat, within, centre + half)
    # ... and between the perpendiculars at its ends.
    start, end = -height * dy / safe_dx, (squared - height * dy) / safe_dx
    between = np.where((height * dy >= 0.0) & (height * dy <= squared) & (squared > 0.0), np.inf, -np.inf)
    left = np.maximum(left, np.where(upright, -between, np.minimum(start, end)))
    right = np.minimum(right, np.where(upright, between, np.maximum(start, end)))
    return left, right


def _inside(sides: _Floats, geometry: GridGeometry) -> _Intervals:
    """Return the cells whose centres lie inside a closed ring (float64 (n + 1, 2)), by the even-odd rule."""
    (x0, y0), (x1, y1) = sides[:-1].T, sides[1:].T
    margin = geometry.resolution
    numbers, rows = _rows_between(np.minimum(y0, y1) - margin, np.maximum(y0, y1) + margin, geometry)
    xs, ys = geometry.axes(geometry.whole)
    y = ys[rows]
    crossed = (y0[numbers] > y) != (y1[numbers] > y)
    numbers, rows, y = numbers[crossed], rows[crossed], y[crossed]
    x0, y0, x1, y1 = x0[numbers], y0[numbers], x1[numbers], y1[numbers]
    columns = np.searchsorted(xs, (x1 - x0) * (y - y0) / (y1 - y0) + x0, side="left")
    # A closed ring crosses each row an even number of times.
    order = np.lexsort((columns, rows))
    rows, columns = rows[order], columns[order]
    return _Intervals(rows[0::2], columns[0::2], columns[1::2])


def _union(intervals: Sequence[_Intervals], geometry: GridGeometry) -> Spans:
    """Return the cells of any of the intervals."""
    rows, starts, stops = (np.concatenate(parts) for parts in zip(*intervals, strict=True))
    filled = starts < stops
    rows, starts, stops = rows[filled], starts[filled], stops[filled]
    # Numbered through all rows, with a gap behind each, so that one pass merges all.
    stride = geometry.width + 1
    first, last = rows * stride + starts, rows * stride + stops
    order = np.argsort(first)
    first, last = first[order], last[order]
    reached = np.maximum.accumulate(last)
    begins = np.ones(len(first), dtype=np.bool_)
    begins[1:] = first[1:] > reached[:-1]
    ends = np.ones(len(first), dtype=np.bool_)
    ends[:-1] = begins[1:]
    first, last = first[begins], reached[ends]
    return _spans(first // stride, first % stride, last - first // stride * stride)


def _spans(rows: _Ints, starts: _Ints, stops: _Ints) -> Spans:
    if not len(rows):
        empty = np.zeros(0, dtype=np.int32)
        return Spans(Window(0, 0, 0, 0), empty, empty, empty)
    left, bottom = int(starts.min()), int(rows[0])
    window = Window(left, bottom, int(stops.max()) - left, int(rows[-1]) + 1 - bottom)
    return Spans(window, rows.astype(np.int32), starts.astype(np.int32), stops.astype(np.int32))


S = TypeVar("S")
Box = tuple[float, float, float, float]


class ShapeError(GeometryError):
    """A shape is invalid: `field` is the path of the invalid part, the message says what is wrong and the remedy."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}")
        self.field = field
        self.problem = problem


class ShapeKind(ABC, Generic[S]):
    """One kind of shape; `outline` names the field that determines how long its outline is."""

    outline = ""

    def normalized(self, shape: S) -> S:
        """Return the shape as it is stored; raises `ShapeError` for an invalid one."""
        return shape

    @abstractmethod
    def contains(self, shape: S, x: float, y: float) -> bool:
        """Whether a point (m, frame `map`) lies in the shape."""

    def box(self, _shape: S) -> Box:
        """Return a box around the shape: left, bottom, right, top (m); by default the whole plane."""
        return -math.inf, -math.inf, math.inf, math.inf

    @abstractmethod
    def spans(self, shape: S, geometry: GridGeometry) -> Spans:
        """Return the cells of a shape, with the same margin as `polygon_spans`; raises `GeometryError`."""


def box_around(points: Sequence[Point], margin: float = 0.0) -> Box:
    """Return the box around points, so much (m) larger on each side: left, bottom, right, top."""
    xs, ys = zip(*points, strict=True)
    return min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin


class _Polygon(ShapeKind[PolygonShape]):
    outline = "points"

    def box(self, shape: PolygonShape) -> Box:
        return box_around(shape.points)

    def normalized(self, shape: PolygonShape) -> PolygonShape:
        """Return it open and counter-clockwise."""
        try:
            return PolygonShape(points=normalized_polygon(shape.points))
        except GeometryError as error:
            raise ShapeError("points", f"{error}; draw one simple outline with at least three corners") from error

    def contains(self, shape: PolygonShape, x: float, y: float) -> bool:
        return contains_point(shape.points, x, y)

    def spans(self, shape: PolygonShape, geometry: GridGeometry) -> Spans:
        return polygon_spans(self.normalized(shape).points, geometry)


class _Rectangle(ShapeKind[RectangleShape]):
    outline = "opposite"

    def box(self, shape: RectangleShape) -> Box:
        return box_around([shape.corner, shape.opposite])

    def normalized(self, shape: RectangleShape) -> RectangleShape:
        (x0, y0), (x1, y1) = shape.corner, shape.opposite
        if x0 == x1 or y0 == y1:
            raise ShapeError("opposite", "the rectangle has no area: give the corner that lies diagonally opposite")
        return shape

    def contains(self, shape: RectangleShape, x: float, y: float) -> bool:
        (x0, y0), (x1, y1) = shape.corner, shape.opposite
        return min(x0, x1) <= x <= max(x0, x1) and min(y0, y1) <= y <= max(y0, y1)

    def spans(self, shape: RectangleShape, geometry: GridGeometry) -> Spans:
        (x0, y0), (x1, y1) = self.normalized(shape).corner, shape.opposite
        left, right, bottom, top = min(x0, x1), max(x0, x1), min(y0, y1), max(y0, y1)
        return polygon_spans([(left, bottom), (right, bottom), (right, top), (left, top)], geometry)


class _Circle(ShapeKind[CircleShape]):
    outline = "radius"

    def box(self, shape: CircleShape) -> Box:
        return box_around([shape.centre], shape.radius)

    def contains(self, shape: CircleShape, x: float, y: float) -> bool:
        return math.dist(shape.centre, (x, y)) <= shape.radius

    def spans(self, shape: CircleShape, geometry: GridGeometry) -> Spans:
        return line_spans([shape.centre], shape.radius, geometry)


class _Corridor(ShapeKind[CorridorShape]):
    outline = "line"

    def box(self, shape: CorridorShape) -> Box:
        return box_around(shape.line, shape.width / 2)

    def normalized(self, shape: CorridorShape) -> CorridorShape:
        if len(set(shape.line)) < 2:
            raise ShapeError("line", "a corridor needs at least two different points")
        return shape

    def contains(self, shape: CorridorShape, x: float, y: float) -> bool:
        sides = zip(shape.line, shape.line[1:], strict=False)
        return any(distance_to_segment(a, b, x, y) <= shape.width / 2 for a, b in sides)

    def spans(self, shape: CorridorShape, geometry: GridGeometry) -> Spans:
        return line_spans(shape.line, shape.width / 2, geometry)


KINDS: Final[Mapping[type, ShapeKind[Any]]] = {
    PolygonShape: _Polygon(),
    RectangleShape: _Rectangle(),
    CircleShape: _Circle(),
    CorridorShape: _Corridor(),
}


def normalized_shape(shape: Shape) -> Shape:
    """Return a shape as it is stored (polygons counter-clockwise); raises `ShapeError` for an invalid one."""
    normalized: Shape = KINDS[type(shape)].normalized(shape)
    return normalized


def shape_contains(shape: Shape, x: float, y: float) -> bool:
    """Whether a point (m, frame `map`) lies in a shape."""
    return KINDS[type(shape)].contains(shape, x, y)


def shape_box(shape: Shape) -> Box:
    """Return a box around a shape: left, bottom, right, top (m)."""
    return KINDS[type(shape)].box(shape)


def shape_spans(shape: Shape, geometry: GridGeometry) -> Spans:
    """Return the cells of a shape and those within half a cell's diagonal of it, so that no part is missing.

    There are none for a shape off the grid. Raises `ShapeError` for an invalid one, or one whose outline is too long.
    """
    kind = KINDS[type(shape)]
    try:
        return kind.spans(shape, geometry)
    except ShapeError:
        raise
    except GeometryError as error:
        raise ShapeError(kind.outline, f"{error}") from error


def rasterize_shape(shape: Shape, geometry: GridGeometry) -> ShapeMask:
    """Return the cells of a shape (`shape_spans`) as a mask; its window is empty for a shape off the grid."""
    return shape_spans(shape, geometry).to_mask()
