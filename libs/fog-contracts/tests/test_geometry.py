import itertools
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from fog_contracts.geometry import (
    GeometryError,
    contains_point,
    distance_to_polygon,
    normalized_polygon,
    sampled,
    signed_area,
)
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.shapes import rasterize

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]
GRID = GridGeometry(40, 30, 0.1, -2.0, -1.0)


@given(
    st.lists(st.tuples(st.floats(-60, 60), st.floats(-60, 60)), min_size=1, max_size=6),
    st.sampled_from([0.1, 0.7, 50.0]),
)
def test_samples_divide_each_line_evenly_and_contain_every_corner(corners, spacing):
    expected = [corners[0]]
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        count = max(1, math.ceil(math.hypot(x1 - x0, y1 - y0) / spacing))
        expected += [(x0 + k / count * (x1 - x0), y0 + k / count * (y1 - y0)) for k in range(1, count)]
        expected.append((x1, y1))
    assert sampled(np.array(corners), spacing).tolist() == [list(point) for point in expected]


@st.composite
def stars(draw):
    """Simple polygons: vertices at growing angles around a centre, clockwise or not, closed or open."""
    count = draw(st.integers(3, 12))
    angles = sorted(draw(st.lists(st.integers(0, 359), min_size=count, max_size=count, unique=True)))
    gaps = [(b - a) % 360 for a, b in zip(angles, [*angles[1:], angles[0]], strict=True)]
    assume(max(gaps) < 170)
    x, y = draw(st.floats(-3, 3)), draw(st.floats(-2, 3))
    ring = []
    for angle in angles:
        radius = draw(st.floats(0.2, 1.5))
        ring.append((x + radius * math.cos(math.radians(angle)), y + radius * math.sin(math.radians(angle))))
    if draw(st.booleans()):
        ring.reverse()
    if draw(st.booleans()):
        ring.append(ring[0])
    return ring


@given(ring=stars())
def test_normalized_polygon_is_open_counter_clockwise_and_has_the_same_vertices(ring):
    polygon = normalized_polygon(ring)
    assert signed_area(polygon) > 0
    assert polygon[0] != polygon[-1]
    assert set(polygon) == set(ring)
    assert normalized_polygon(polygon) == polygon
    assert signed_area(polygon) == pytest.approx(abs(signed_area(polygon[::-1])))


@given(ring=stars(), start=st.integers(0, 11))
def test_normalizing_a_rotated_list_of_vertices_gives_the_same_polygon(ring, start):
    polygon = normalized_polygon(ring)
    shifted = polygon[start % len(polygon) :] + polygon[: start % len(polygon)]
    assert set(normalized_polygon(shifted)) == set(polygon)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        ([], "three distinct"),
        ([(0, 0), (1, 1)], "three distinct"),
        ([(0, 0), (1, 1), (0, 0)], "three distinct"),
        ([(0, 0), (1, 1), (2, 2)], "one line"),
        ([(0, 0), (1, 0), (3, 0), (2, 0)], "one line"),
        ([(0, 0), (1, 1), (1, 0), (0, 1)], "crosses itself"),  # a bow tie: no area in sum
        ([(0, 0), (4, 0), (4, 4), (1, -1)], "crosses itself"),
        ([(0, 0), (2, 0), (2, 2), (1, 0), (0, 2)], "crosses itself"),  # touches its own side
        ([(0, 0), (2, 0), (1, 0), (1, 1)], "crosses itself"),  # folds back on its own side
        ([(0, 0), (2, 0), (2, 2), (2, -1)], "crosses itself"),
        ([(0, 0), (1, 0), (math.nan, 1)], "vertex 2"),
        ([(0, 0), (1, 0), (math.inf, 1)], "vertex 2"),
        ([(0, 0), (1, 0), (1, 1, 1)], "vertex 2"),
    ],
)
def test_invalid_polygon_is_refused_with_the_reason(points, reason):
    with pytest.raises(GeometryError, match=reason):
        normalized_polygon(points)


def test_collinear_vertices_are_kept_and_repeated_ones_removed():
    assert normalized_polygon([(0, 0), (1, 0), (2, 0), (2, 2), (2, 2), (0, 2)]) == [
        (0, 0),
        (1, 0),
        (2, 0),
        (2, 2),
        (0, 2),
    ]


@given(ring=stars())
def test_raster_contains_exactly_the_cells_within_half_a_diagonal_of_the_polygon(ring):
    polygon = normalized_polygon(ring)
    window, mask = rasterize(polygon, GRID)
    assert GRID.clip(window) == window
    assert mask.shape == (window.height, window.width) or window.empty
    raster = np.zeros(GRID.shape, dtype=bool)
    if not window.empty:
        raster[window.rows, window.columns] = mask
    reach = GRID.resolution * math.sqrt(0.5)
    for row in range(0, GRID.height, 2):
        for column in range(0, GRID.width, 2):
            distance = distance_to_polygon(polygon, *GRID.centre(column, row))
            if abs(distance - reach) > 1e-9:
                assert raster[row, column] == (distance < reach), (column, row)


# Half of all points in a bounding box lie outside the polygon or the grid.
@settings(suppress_health_check=[HealthCheck.filter_too_much])
@given(ring=stars(), x=st.floats(0, 1), y=st.floats(0, 1))
def test_every_point_of_a_polygon_lies_on_a_cell_of_its_raster(ring, x, y):
    polygon = normalized_polygon(ring)
    (left, bottom), (right, top) = np.min(polygon, axis=0), np.max(polygon, axis=0)
    px, py = left + x * (right - left), bottom + y * (top - bottom)
    assume(contains_point(polygon, px, py))
    assume(GRID.contains(px, py))
    window, mask = rasterize(polygon, GRID)
    column, row = GRID.cell(px, py)
    assert mask[row - window.y, column - window.x]


def test_polygon_off_the_grid_has_an_empty_raster():
    window, mask = rasterize([(x + 100, y) for x, y in SQUARE], GRID)
    assert window.empty
    assert mask.size == 0


@given(ring=stars(), x=st.floats(-5, 5), y=st.floats(-5, 5))
def test_distance_is_zero_inside_and_bounded_by_the_vertices_outside(ring, x, y):
    polygon = normalized_polygon(ring)
    distance = distance_to_polygon(polygon, x, y)
    if contains_point(polygon, x, y):
        assert distance == 0.0
    assert distance <= min(math.dist((x, y), vertex) for vertex in polygon) + 1e-9


@given(column=st.integers(-100, 100), row=st.integers(-100, 100))
def test_centre_of_a_cell_lies_in_it(column, row):
    assert GRID.cell(*GRID.centre(column, row)) == (column, row)
    assert GRID.contains(*GRID.centre(column, row)) == GRID.contains_cell(column, row)


windows = st.builds(Window, st.integers(-50, 60), st.integers(-50, 60), st.integers(0, 60), st.integers(0, 60))


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), max_size=12))
def test_cells_of_an_array_of_points_equal_those_of_single_points(points):
    cells, inside = GRID.cells(np.array(points, dtype=np.float64))
    assert [tuple(cell) for cell in cells.tolist()] == [GRID.cell(x, y) for x, y in points]
    assert inside.tolist() == [GRID.contains(x, y) for x, y in points]
    assert [tuple(centre) for centre in GRID.centres(cells).tolist()] == [GRID.centre(*cell) for cell in cells.tolist()]


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), max_size=12))
def test_grid_coordinates_are_whole_at_centres_and_invertible(points):
    coordinates = GRID.grid_coordinates(np.array(points, dtype=np.float64))
    assert GRID.centres(coordinates) == pytest.approx(np.array(points, dtype=np.float64).reshape(-1, 2), abs=1e-9)
    assert GRID.grid_coordinates(np.array([GRID.centre(3, 5)]))[0] == pytest.approx((3.0, 5.0))


def test_sampling_returns_cell_values_and_the_given_value_outside():
    grid = np.arange(GRID.width * GRID.height, dtype=np.uint8).reshape(GRID.shape)
    points = np.array([(-1.95, -0.95), (-1.85, -0.85), (-2.01, 0.0), (1.99, 1.99), (2.01, 0.0), (0.0, 9.0)])
    assert GRID.sample(grid, points, 7).tolist() == [0, grid[1, 1], 7, grid[29, 39], 7, 7]
    assert GRID.sample(grid, np.empty((0, 2)), 7).shape == (0,)


def test_axes_are_the_centres_of_a_windows_columns_and_rows():
    xs, ys = GRID.axes(Window(3, 5, 2, 4))
    assert [(x, y) for y in ys for x in xs] == [GRID.centre(c, r) for r in range(5, 9) for c in range(3, 5)]
    assert GRID.whole == Window(0, 0, 40, 30)


@given(a=windows, b=windows)
def test_windows_are_clipped_joined_and_intersected(a, b):
    clipped = GRID.clip(a)
    assert GRID.clip(clipped) == clipped or clipped.empty
    joined = a.union(b)
    for part in (a, b):
        if not part.empty:
            assert joined.union(part) == joined
    masks = [np.zeros((200, 200), dtype=bool) for _ in range(3)]
    for mask, window in zip(masks, (a, b, a.intersection(b)), strict=True):
        shifted = Window(window.x + 60, window.y + 60, window.width, window.height)
        mask[shifted.rows, shifted.columns] = True
    assert np.array_equal(masks[0] & masks[1], masks[2])
    grid = np.zeros(GRID.shape, dtype=np.uint8)
    assert grid[clipped.rows, clipped.columns].shape == (clipped.height, clipped.width) or clipped.empty


@pytest.mark.parametrize("wrong", [{"width": 0}, {"resolution": 0.0}, {"resolution": math.nan}, {"origin_x": math.inf}])
def test_invalid_grid_geometry_is_refused(wrong):
    good = {"width": 2, "height": 2, "resolution": 0.1, "origin_x": 0.0, "origin_y": 0.0}
    with pytest.raises(ValueError, match=r"grid|resolution|origin"):
        GridGeometry(**{**good, **wrong})
