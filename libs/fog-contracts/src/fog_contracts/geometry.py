"""Plane geometry of areas and zones: polygons as sequences of (x, y) in metres, frame `map`."""

import itertools
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fog_contracts.grid import GridGeometry, Window

Point = tuple[float, float]
Polygon = Sequence[Point]

_COLLINEAR: Final = 1e-12
"""Twice a triangle's area, relative to the square of its size, below which its sign is only rounding."""


class GeometryError(ValueError):
    """A shape is invalid; the message says what is wrong."""


def signed_area(polygon: Polygon) -> float:
    """Area in m2, positive when the vertices run counter-clockwise (shoelace formula)."""
    return 0.5 * sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(polygon, [*polygon[1:], polygon[0]], strict=True))


def _cross(o: Point, a: Point, b: Point) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def _on_segment(a: Point, b: Point, p: Point) -> bool:
    return min(a[0], b[0]) <= p[0] <= max(a[0], b[0]) and min(a[1], b[1]) <= p[1] <= max(a[1], b[1])


def segments_touch(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the closed segments ab and cd share a point."""
    d1, d2, d3, d4 = _cross(c, d, a), _cross(c, d, b), _cross(a, b, c), _cross(a, b, d)
    if ((d1 > 0) != (d2 > 0)) and ((d3 > 0) != (d4 > 0)) and d1 and d2 and d3 and d4:
        return True
    touching = ((d1, c, d, a), (d2, c, d, b), (d3, a, b, c), (d4, a, b, d))
    return any(side == 0 and _on_segment(p, q, r) for side, p, q, r in touching)


def normalized_polygon(points: Sequence[Sequence[float]]) -> list[Point]:
    """Check a polygon and return it open and counter-clockwise.

    Raises `GeometryError` when it has fewer than three distinct vertices, a number that is not finite, no area, or
    sides that cross.
    """
    ring = _open_ring(points)
    if len(ring) < 3:
        raise GeometryError(f"a polygon needs at least three distinct vertices; this one has {len(ring)}")
    longest = max(math.dist(ring[0], vertex) for vertex in ring)
    if all(abs(_cross(ring[0], ring[1], vertex)) <= _COLLINEAR * longest * longest for vertex in ring):
        raise GeometryError("the polygon has no area: its vertices lie on one line")
    crossing = _first_crossing(ring)
    if crossing is not None:
        raise GeometryError(f"the polygon crosses itself: side {crossing[0]} meets side {crossing[1]}")
    area = signed_area(ring)
    if abs(area) < 1e-9:
        raise GeometryError(f"the polygon has next to no area ({abs(area):.1e} m2)")
    return ring if area > 0 else ring[::-1]


def _open_ring(points: Sequence[Sequence[float]]) -> list[Point]:
    """Return the vertices without repetitions, and without the last one where it closes the ring."""
    ring: list[Point] = []
    for index, point in enumerate(points):
        if len(point) != 2 or not all(math.isfinite(v) for v in point):
            raise GeometryError(f"vertex {index} must be two finite numbers [x, y] in metres, not {list(point)}")
        vertex = (float(point[0]), float(point[1]))
        if not ring or vertex != ring[-1]:
            ring.append(vertex)
    if len(ring) > 1 and ring[0] == ring[-1]:
        ring.pop()
    return ring


def _first_crossing(ring: Sequence[Point]) -> tuple[int, int] | None:
    """Return the numbers of the first two sides that touch without being neighbours, or None."""
    count = len(ring)
    for i in range(count):
        # Neighbouring sides share a vertex: each with the next, and the first with the last.
        for j in range(i + 2, count - 1 if i == 0 else count):
            if segments_touch(ring[i], ring[i + 1], ring[j], ring[(j + 1) % count]):
                return i, j
    return None


def contains_point(polygon: Polygon, x: float, y: float) -> bool:
    """Whether the point lies in the polygon (even-odd rule; points on the border may go either way)."""
    inside = False
    previous = polygon[-1]
    for vertex in polygon:
        (x0, y0), (x1, y1) = previous, vertex
        if (y0 > y) != (y1 > y) and x < (x1 - x0) * (y - y0) / (y1 - y0) + x0:
            inside = not inside
        previous = vertex
    return inside


def distance_to_segment(a: Point, b: Point, x: float, y: float) -> float:
    """Distance (m) from the point to the closed segment ab."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    squared = dx * dx + dy * dy
    t = 0.0 if squared == 0 else max(0.0, min(1.0, ((x - a[0]) * dx + (y - a[1]) * dy) / squared))
    return math.hypot(x - a[0] - t * dx, y - a[1] - t * dy)


def distance_to_polygon(polygon: Polygon, x: float, y: float) -> float:
    """Distance (m) from the point to the polygon: 0 inside."""
    if contains_point(polygon, x, y):
        return 0.0
    sides = zip(polygon, [*polygon[1:], polygon[0]], strict=True)
    return min(distance_to_segment(a, b, x, y) for a, b in sides)


def bounding_box(polygon: Polygon) -> tuple[float, float, float, float]:
    """Smallest upright rectangle around the polygon: (left, bottom, right, top) in metres."""
    xs, ys = [p[0] for p in polygon], [p[1] for p in polygon]
    return min(xs), min(ys), max(xs), max(ys)


class ShapeMask(NamedTuple):
    """The cells of a shape: a window of the grid, and a mask (window height, window width) of the cells in it."""

    window: Window
    mask: NDArray[np.bool_]


def rasterize(polygon: Polygon, geometry: GridGeometry) -> ShapeMask:
    """Return the cells of a polygon.

    A cell belongs to the polygon when its centre lies inside or within half a cell's diagonal of the border, so that
    no part of a hazard is missing. The window is empty when the polygon lies off the grid.

    Inside is determined by the even-odd rule along scan lines: every side flips, in each row that it crosses, all cells
    to its left, so the time does not grow with sides times cells.
    """
    window, near = rasterize_line([*polygon, polygon[0]], 0.0, geometry)
    if window.empty:
        return ShapeMask(window, near)
    xs, ys = geometry.axes(window)
    flips = np.zeros((window.height, window.width + 1), dtype=np.bool_)
    for (x0, y0), (x1, y1) in itertools.pairwise([*polygon, polygon[0]]):
        crossed = np.flatnonzero((y0 > ys) != (y1 > ys))
        if crossed.size:
            at = (x1 - x0) * (ys[crossed] - y0) / (y1 - y0) + x0
            flips[crossed, np.searchsorted(xs, at, side="left")] ^= True
    inside = np.logical_xor.accumulate(flips[:, :0:-1], axis=1)[:, ::-1]
    return ShapeMask(window, near | inside)


def rasterize_line(line: Sequence[Point], reach: float, geometry: GridGeometry) -> ShapeMask:
    """Return the cells within `reach` (m) of a polyline; a single point gives a disc.

    As with a polygon, cells within half a cell's diagonal of the border belong to it.
    """
    reach += geometry.resolution * math.sqrt(0.5)
    left, bottom, right, top = bounding_box(line)
    window = geometry.window_around(left - reach, bottom - reach, right + reach, top + reach)
    mask = np.zeros((window.height, window.width), dtype=np.bool_)
    for (ax, ay), (bx, by) in itertools.pairwise(line if len(line) > 1 else [line[0], line[0]]):
        part = geometry.window_around(
            min(ax, bx) - reach, min(ay, by) - reach, max(ax, bx) + reach, max(ay, by) + reach
        )
        if part.empty:
            continue
        xs, ys = geometry.axes(part)
        px, py = np.meshgrid(xs, ys)
        dx, dy = bx - ax, by - ay
        squared = dx * dx + dy * dy
        t = np.zeros(px.shape) if squared == 0 else np.clip(((px - ax) * dx + (py - ay) * dy) / squared, 0.0, 1.0)
        in_window = Window(part.x - window.x, part.y - window.y, part.width, part.height)
        mask[in_window.rows, in_window.columns] |= np.hypot(px - ax - t * dx, py - ay - t * dy) <= reach
    return ShapeMask(window, mask)
