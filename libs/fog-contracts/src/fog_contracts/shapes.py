"""The shapes of zones: validation, containment of points, and rasterization.

To add a shape, define its message in `fog_contracts.messages` (and name it in `Shape`), write its class here and add
both to `KINDS`. No other module distinguishes the kinds of shapes.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Final, Generic, TypeVar

from fog_contracts.geometry import GeometryError, contains_point, distance_to_segment, normalized_polygon
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import CircleShape, CorridorShape, PolygonShape, RectangleShape, Shape
from fog_contracts.raster import ShapeMask, Spans, line_spans, polygon_spans

S = TypeVar("S")


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

    @abstractmethod
    def spans(self, shape: S, geometry: GridGeometry) -> Spans:
        """Return the cells of a shape, with the same margin as `polygon_spans`; raises `GeometryError`."""


class _Polygon(ShapeKind[PolygonShape]):
    outline = "points"

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

    def contains(self, shape: CircleShape, x: float, y: float) -> bool:
        return math.dist(shape.centre, (x, y)) <= shape.radius

    def spans(self, shape: CircleShape, geometry: GridGeometry) -> Spans:
        return line_spans([shape.centre], shape.radius, geometry)


class _Corridor(ShapeKind[CorridorShape]):
    outline = "line"

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
