"""Zones' shapes: checked in the operator's words, and turned into cells. Pure."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import structs

from fog_contracts.geometry import GeometryError, bounding_box, normalized_polygon
from fog_contracts.messages import CircleShape, CorridorShape, PolygonShape, RectangleShape

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import Shape, Zone

    Axis = NDArray[np.float64]


class ShapeMask(NamedTuple):
    """The cells of a shape: a window of the grid and a mask (window height, window width) inside it."""

    window: Window
    mask: NDArray[np.bool_]


class ZoneError(ValueError):
    """A zone that can't be used: `field` is its path in the zone, the message says what is wrong and what to do."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


def _outline(shape: PolygonShape | RectangleShape) -> list[Point]:
    if isinstance(shape, PolygonShape):
        try:
            return normalized_polygon(shape.points)
        except GeometryError as error:
            raise ZoneError("shape.points", f"{error}; draw one simple outline with at least three corners") from error
    (x0, y0), (x1, y1) = shape.corner, shape.opposite
    if x0 == x1 or y0 == y1:
        raise ZoneError("shape.opposite", "the rectangle has no area: give the corner that lies diagonally opposite")
    left, right, bottom, top = min(x0, x1), max(x0, x1), min(y0, y1), max(y0, y1)
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def _near_line(line: list[Point], reach: float, geometry: GridGeometry) -> ShapeMask:
    """Return the cells whose centres lie within `reach` (m) of a polyline; one point makes a disc."""
    left, bottom, right, top = bounding_box(line)
    window = geometry.window_around(left - reach, bottom - reach, right + reach, top + reach)
    mask = np.zeros((window.height, window.width), dtype=np.bool_)
    for (ax, ay), (bx, by) in itertools.pairwise(line if len(line) > 1 else [line[0], line[0]]):
        part = geometry.window_around(
            min(ax, bx) - reach, min(ay, by) - reach, max(ax, bx) + reach, max(ay, by) + reach
        )
        if part.empty:
            continue
        xs, ys = _centres(part, geometry)
        dx, dy = bx - ax, by - ay
        squared = dx * dx + dy * dy
        t = np.zeros(xs.shape) if squared == 0 else np.clip(((xs - ax) * dx + (ys - ay) * dy) / squared, 0.0, 1.0)
        near = np.hypot(xs - ax - t * dx, ys - ay - t * dy) <= reach
        mask[
            part.y - window.y : part.y - window.y + part.height, part.x - window.x : part.x - window.x + part.width
        ] |= near
    return ShapeMask(window, mask)


def _rasterized(ring: list[Point], geometry: GridGeometry) -> ShapeMask:
    """Return what `fog_contracts.geometry.rasterize` does, in time that does not grow with sides times cells.

    Even-odd rule by scan lines: every side flips, in each row that it crosses, all cells to its left.
    """
    margin = geometry.resolution * math.sqrt(0.5)
    window, near = _near_line([*ring, ring[0]], margin, geometry)
    if window.empty:
        return ShapeMask(window, near)
    xs, ys = _axes(window, geometry)
    flips = np.zeros((window.height, window.width + 1), dtype=np.bool_)
    for (x0, y0), (x1, y1) in itertools.pairwise([*ring, ring[0]]):
        crossed = np.flatnonzero((y0 > ys) != (y1 > ys))
        if crossed.size:
            at = (x1 - x0) * (ys[crossed] - y0) / (y1 - y0) + x0
            flips[crossed, np.searchsorted(xs, at, side="left")] ^= True
    inside = np.logical_xor.accumulate(flips[:, :0:-1], axis=1)[:, ::-1]
    return ShapeMask(window, near | inside)


def _axes(window: Window, geometry: GridGeometry) -> tuple[Axis, Axis]:
    """Return the x of the window's columns and the y of its rows (m, centres)."""
    xs = geometry.origin_x + (np.arange(window.x, window.x + window.width) + 0.5) * geometry.resolution
    ys = geometry.origin_y + (np.arange(window.y, window.y + window.height) + 0.5) * geometry.resolution
    return xs.astype(np.float64), ys.astype(np.float64)


def _centres(window: Window, geometry: GridGeometry) -> tuple[Axis, Axis]:
    px, py = np.meshgrid(*_axes(window, geometry))
    return px, py


def rasterize_shape(shape: Shape, geometry: GridGeometry) -> ShapeMask:
    """Return the cells of a shape: those within half a cell's diagonal of it, so that none is drawn too small.

    Raises `ZoneError` for an outline that can't be used. The window is empty for a shape off the map.
    """
    margin = geometry.resolution * math.sqrt(0.5)
    if isinstance(shape, CircleShape):
        return _near_line([shape.centre], shape.radius + margin, geometry)
    if isinstance(shape, CorridorShape):
        return _near_line(shape.line, shape.width / 2 + margin, geometry)
    return _rasterized(_outline(shape), geometry)


def checked_zone(zone: Zone, geometry: GridGeometry, stamp: float) -> Zone:
    """Return the zone as it is stored (polygons counter-clockwise); raises `ZoneError` that names field and remedy."""
    if zone.kind == "PENALTY" and zone.factor is None:
        raise ZoneError("factor", "a PENALTY zone needs a factor of 1 or more: how much dearer its floor is")
    if zone.kind == "SPEED_LIMIT" and zone.speed is None:
        raise ZoneError("speed", "a SPEED_LIMIT zone needs a speed in m/s")
    if zone.kind != "PENALTY" and zone.factor is not None:
        raise ZoneError("factor", f"a {zone.kind} zone has no factor: leave it out or make the kind PENALTY")
    if zone.kind != "SPEED_LIMIT" and zone.speed is not None:
        raise ZoneError("speed", f"a {zone.kind} zone has no speed: leave it out or make the kind SPEED_LIMIT")
    if zone.expires_at is not None and zone.expires_at <= max(stamp, zone.starts_at or 0.0):
        raise ZoneError("expires_at", "the zone would be over before it begins: give a later time, or leave it out")
    shape = zone.shape
    if isinstance(shape, PolygonShape):
        shape = PolygonShape(points=_outline(shape))
    if isinstance(shape, CorridorShape) and len(set(shape.line)) < 2:
        raise ZoneError("shape.line", "a corridor needs at least two different points")
    if not rasterize_shape(shape, geometry).mask.any():
        left, bottom, right, top = geometry.bounds
        raise ZoneError(
            "shape",
            f"the zone lies off the map, which reaches from ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}) m:"
            " draw it there",
        )
    return structs.replace(zone, shape=shape)
