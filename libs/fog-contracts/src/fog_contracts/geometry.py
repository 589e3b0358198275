"""Plane geometry of areas, zones and paths: polygons as sequences of (x, y), lines as arrays, metres, frame `map`."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]
Polygon = Sequence[Point]
_Floats = NDArray[np.float64]

PATH_SPACING_M: Final = 0.10
"""How far apart the points of a path are, where it is followed or checked point by point."""
_COLLINEAR: Final = 1e-12
"""Twice a triangle's area, relative to the square of its size, below which its sign is only rounding."""


class GeometryError(ValueError):
    """A shape is invalid; the message says what is wrong."""


def sampled(corners: _Floats, spacing: float) -> _Floats:
    """Return the polyline through the corners (n, 2) as points (m, 2) at most `spacing` apart, all corners included."""
    steps = np.diff(corners, axis=0)
    counts = np.maximum(np.ceil(np.hypot(steps[:, 0], steps[:, 1]) / spacing), 1.0).astype(np.int64)
    line = np.repeat(np.arange(len(counts)), counts)
    ends = np.cumsum(counts)
    number = np.arange(1, len(line) + 1) - (ends - counts)[line]
    points: _Floats = corners[line] + (number / counts[line])[:, None] * steps[line]
    points[ends - 1] = corners[1:]
    return np.concatenate((corners[:1], points))


def lengths_along(line: _Floats) -> _Floats:
    """Return how far (m) each point of a polyline (n, 2) is from its first one, along the line."""
    if len(line) < 2:
        return np.zeros(len(line))
    steps = line[1:] - line[:-1]
    along = np.zeros(len(line))
    np.cumsum(np.hypot(steps[:, 0], steps[:, 1]), out=along[1:])
    return along


def signed_area(polygon: Polygon) -> float:
    """Area in m2, positive when the vertices run counter-clockwise (shoelace formula)."""
    return 0.5 * sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(polygon, [*polygon[1:], polygon[0]], strict=True))


def _cross(o: Point, a: Point, b: Point) -> float:
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


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
    """Return the numbers of the first two sides that touch without being neighbours, or None.

    All pairs of sides whose bounding boxes meet are compared at once: a message's 500 vertices take some milliseconds.
    """
    count = len(ring)
    a = np.array(ring, dtype=np.float64)
    b = np.roll(a, -1, axis=0)
    low, high = np.minimum(a, b), np.maximum(a, b)
    near = np.tri(count, k=-2, dtype=np.bool_).T
    for axis in (0, 1):
        reaches = low[:, None, axis] <= high[None, :, axis]
        near &= reaches & reaches.T
    # Neighbouring sides share a vertex: each with the next, and the first with the last.
    near[0, count - 1] = False
    first, second = np.nonzero(near)
    touching = np.flatnonzero(_segments_touch(a[first].T, b[first].T, a[second].T, b[second].T))
    return (int(first[touching[0]]), int(second[touching[0]])) if touching.size else None


def _segments_touch(a: _Floats, b: _Floats, c: _Floats, d: _Floats) -> NDArray[np.bool_]:
    """Whether the closed segments ab and cd, whose bounding boxes meet, share a point; each end is float64 (2, n)."""

    def side(o: _Floats, p: _Floats, q: _Floats) -> _Floats:
        turn: _Floats = (p[0] - o[0]) * (q[1] - o[1]) - (p[1] - o[1]) * (q[0] - o[0])
        return turn

    def between(p: _Floats, q: _Floats, r: _Floats) -> NDArray[np.bool_]:
        inside: NDArray[np.bool_] = (np.minimum(p, q) <= r) & (r <= np.maximum(p, q))
        both: NDArray[np.bool_] = inside[0] & inside[1]
        return both

    sides = (side(c, d, a), side(c, d, b), side(a, b, c), side(a, b, d))
    crossing: NDArray[np.bool_] = ((sides[0] > 0) != (sides[1] > 0)) & ((sides[2] > 0) != (sides[3] > 0))
    for value in sides:
        crossing = crossing & (value != 0)
    for value, (p, q, r) in zip(sides, ((c, d, a), (c, d, b), (a, b, c), (a, b, d)), strict=True):
        crossing = crossing | ((value == 0) & between(p, q, r))
    return crossing


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
