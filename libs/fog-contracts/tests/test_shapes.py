"""Every shape: containment of points, rasterization, validation."""

import math
import typing

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fog_contracts.geometry import GeometryError, normalized_polygon
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import CircleShape, CorridorShape, PolygonShape, RectangleShape, Shape
from fog_contracts.shapes import KINDS, ShapeError, normalized_shape, rasterize, rasterize_shape, shape_contains

GRID = GridGeometry(80, 60, 0.05, -1.0, -0.5)
coordinate = st.floats(-1.5, 3.5).map(lambda v: round(v, 2))
point = st.tuples(coordinate, coordinate)
shapes = st.one_of(
    st.builds(lambda c, r: CircleShape(centre=c, radius=r), point, st.floats(0.05, 1.0)),
    st.builds(lambda a, b, c, w: CorridorShape(line=[a, b, c], width=w), point, point, point, st.floats(0.05, 0.8)),
    st.builds(lambda a, b: RectangleShape(corner=a, opposite=b), point, point),
    st.builds(lambda points: PolygonShape(points=points), st.lists(point, min_size=3, max_size=8)),
)


def raster(shape: Shape, geometry: GridGeometry = GRID) -> np.ndarray:
    window, mask = rasterize_shape(shape, geometry)
    whole = np.zeros(geometry.shape, dtype=bool)
    whole[window.rows, window.columns] = mask
    return whole


def test_every_zone_shape_is_implemented():
    assert set(KINDS) == set(typing.get_args(Shape))


@pytest.mark.parametrize(
    ("shape", "inside", "outside"),
    [
        (PolygonShape(points=[(0.5, 0.5), (0.5, 1.5), (1.5, 0.5)]), (0.8, 0.8), (1.4, 1.4)),
        (RectangleShape(corner=(1.5, 1.0), opposite=(0.5, 0.5)), (1.4, 0.6), (1.4, 1.2)),
        (CircleShape(centre=(1.0, 1.0), radius=0.3), (1.2, 1.2), (1.25, 1.25)),
        (CorridorShape(line=[(0.0, 0.5), (1.0, 0.5), (1.0, 1.5)], width=0.4), (1.15, 1.2), (0.7, 1.0)),
    ],
)
def test_shape_contains_a_point_inside_and_rasterizes_its_cell(shape, inside, outside):
    assert shape_contains(shape, *inside)
    assert not shape_contains(shape, *outside)
    assert raster(shape)[GRID.cell(*inside)[::-1]]
    assert not raster(shape)[GRID.cell(*outside)[::-1]]


@given(shapes, point)
@settings(deadline=None)
def test_every_point_of_a_shape_lies_on_a_cell_of_its_raster(shape, inside):
    try:
        cells = raster(shape)
    except ShapeError:
        return
    if shape_contains(shape, *inside) and GRID.contains(*inside):
        assert cells[GRID.cell(*inside)[::-1]]


@pytest.mark.parametrize(
    ("shape", "field", "reason"),
    [
        (PolygonShape(points=[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)]), "points", "crosses itself"),
        (PolygonShape(points=[(0.0, 0.0), (1.0, 1.0), (0.0, 0.0)]), "points", "three corners"),
        (RectangleShape(corner=(0.0, 0.0), opposite=(0.0, 1.0)), "opposite", "no area"),
        (CorridorShape(line=[(0.0, 0.0), (0.0, 0.0)], width=1.0), "line", "two different points"),
    ],
)
def test_invalid_shape_is_refused_by_field(shape, field, reason):
    with pytest.raises(ShapeError, match=reason) as caught:
        normalized_shape(shape)
    assert caught.value.field == field


def test_normalizing_makes_a_polygon_counter_clockwise_and_keeps_other_shapes():
    clockwise = [(0.5, 0.5), (0.5, 1.5), (1.5, 0.5)]
    assert normalized_shape(PolygonShape(points=clockwise)) == PolygonShape(points=clockwise[::-1])
    for shape in (CircleShape(centre=(0.0, 0.0), radius=1.0), RectangleShape(corner=(1.0, 1.0), opposite=(0.0, 0.0))):
        assert normalized_shape(shape) == shape


def rasterize_by_definition(polygon: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Rasterize by the definition, testing every cell against every side; also return the cells at its very edge."""
    margin = GRID.resolution * math.sqrt(0.5)
    px, py = np.meshgrid(*GRID.axes(GRID.whole))
    inside, near, edge = (np.zeros(GRID.shape, dtype=bool) for _ in range(3))
    for (x0, y0), (x1, y1) in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
        dx, dy = x1 - x0, y1 - y0
        if dy != 0:
            inside ^= ((y0 > py) != (y1 > py)) & (px < dx * (py - y0) / dy + x0)
        squared = dx * dx + dy * dy
        t = np.zeros_like(px) if squared == 0 else np.clip(((px - x0) * dx + (py - y0) * dy) / squared, 0.0, 1.0)
        distance = np.hypot(px - x0 - t * dx, py - y0 - t * dy)
        near |= distance <= margin
        edge |= np.abs(distance - margin) < 1e-8
    return inside | near, edge


@given(st.lists(point, min_size=3, max_size=9))
@example([(0.0, -1.0), (0.0, -1.5), (1.0, -1.0)])  # wholly below the grid
@settings(max_examples=200, deadline=None)
def test_scan_line_raster_equals_the_definition(points):
    try:
        ring = normalized_polygon(points)
    except GeometryError:
        return
    window, mask = rasterize(ring, GRID)
    found = np.zeros(GRID.shape, dtype=bool)
    found[window.rows, window.columns] = mask
    expected, edge = rasterize_by_definition(ring)
    assert np.array_equal(found | edge, expected | edge)
