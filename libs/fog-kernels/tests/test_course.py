"""The points of a path with the distances beside it, and whether the way is blocked, against plain numpy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fog_contracts.geometry import lengths_along, sampled
from fog_contracts.grid import GridGeometry
from fog_kernels.clearance import Clearance
from fog_kernels.course import (
    Cells,
    beside,
    distances,
    is_blocked,
    last_beside,
    sampled_along,
    seconds_along,
    values_at,
)
from fog_kernels.lines import nearest_between

FINE, LEFT, BOTTOM, SIZE = 0.05, -0.3, 0.4, 12
COORDINATE = st.floats(-1.0, 2.0).map(lambda value: round(value, 2))
PATHS = st.lists(st.tuples(COORDINATE, COORDINATE), min_size=1, max_size=7).map(np.array)
SEEDS = st.integers(0, 2**16)


def window(seed):
    field = np.random.default_rng(seed).random((SIZE, SIZE)).astype(np.float32)
    return Clearance(np.zeros((SIZE, SIZE), np.uint8), field, FINE, LEFT, BOTTOM)


def points_along(path, spacing):
    steps = np.diff(path, axis=0)
    along = np.concatenate(([0.0], np.cumsum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2))))
    where = np.linspace(0.0, along[-1], max(2, math.ceil(along[-1] / spacing) + 1))
    return np.column_stack([np.interp(where, along, path[:, i]) for i in (0, 1)]), where


def interpolated(around, x, y):
    column, row = np.clip(((x - LEFT) / FINE - 0.5, (y - BOTTOM) / FINE - 0.5), 0.0, SIZE - 1.0)
    i, j = min(int(column), SIZE - 2), min(int(row), SIZE - 2)
    c, r = column - i, row - j
    square = around.distance[j : j + 2, i : i + 2].astype(float)
    return np.array((1.0 - r, r)) @ square @ np.array((1.0 - c, c))


@given(PATHS, st.sampled_from([0.03, 0.05, 0.4, 9.0]), SEEDS)
def test_points_every_so_many_metres_with_the_distances_there(path, spacing, seed):
    around = window(seed)
    points, along, free = beside(path, spacing, around)
    expected, where = points_along(path, spacing)
    assert points == pytest.approx(expected, abs=1e-9)
    assert along == pytest.approx(where, abs=1e-9)
    assert free == pytest.approx(np.array([interpolated(around, *point) for point in points]), abs=1e-6)
    assert distances(around, points).tolist() == free.tolist()


@given(PATHS, st.lists(st.tuples(COORDINATE, COORDINATE), max_size=2), st.sampled_from([0, 1, 2, 4, 8]), SEEDS)
def test_way_is_blocked_where_a_cell_on_it_is(path, seen, square, seed):
    """Cells of 0.1 m; those that the window of distances covers are two of its cells wide."""
    path = path + 0.0037  # beside the cells' borders
    numbers = np.random.default_rng(seed)
    cost = np.where(numbers.random((20, 25)) < 0.995, 0, numbers.choice([252, 253, 254, 255], (20, 25))).astype(
        np.uint8
    )
    cells = Cells(cost, 2.0 * FINE, -0.7, -0.6)
    around = window(seed)
    around.distance[:] = np.where(around.distance < 0.8, 0.1, 0.3)
    points = np.array(seen).reshape(-1, 2)

    def is_bad(x, y):
        column, row = math.floor((x + 0.7) / 0.1), math.floor((y + 0.6) / 0.1)
        if not (0 <= column < 25 and 0 <= row < 20) or cost[row, column] == 255:
            return False
        if cost[row, column] >= 253:
            return True
        i, j = 2 * (column - 4), 2 * (row - 10)
        if 0 <= i < SIZE and 0 <= j < SIZE:
            return around.distance[j : j + 2, i : i + 2].max() < 0.2
        return any(
            (math.floor((u + 0.7) / 0.1) - column) ** 2 + (math.floor((v + 0.6) / 0.1) - row) ** 2 <= square
            for u, v in points
            if -0.7 <= u < 1.8 and -0.6 <= v < 1.4
        )

    way, _ = points_along(np.vstack(((0.013, 0.021), path)), 0.05)
    on_borders = np.abs(np.mod(way / 0.1 + 0.5, 1.0) - 0.5).min() < 1e-6
    assume(not on_borders)  # rounding decides on which side of one a sample lies
    expected = any(is_bad(x, y) for x, y in way)
    assert is_blocked(0.013, 0.021, path, 0.05, cells, points, square, around, 0.2) == expected


def test_path_without_points_or_with_unknown_ones_is_refused():
    with pytest.raises(ValueError, match="n >= 1"):
        beside(np.zeros((0, 2)), 0.05, window(0))
    with pytest.raises(ValueError, match="finite"):
        distances(window(0), np.array([(math.nan, 0.0)]))
    with pytest.raises(ValueError, match="finite"):
        beside(np.array([(0.0, math.nan), (1.0, 1.0)]), 0.05, window(0))


GRID = GridGeometry(30, 20, 0.1, -1.0, -0.5)
PLACE = GRID.origin_x, GRID.origin_y, GRID.resolution


@given(PATHS, st.sampled_from((0.05, 0.1, 0.7)))
def test_samples_of_a_line_are_those_of_everybody_else_bit_for_bit(path, spacing):
    points, along = sampled_along(path, spacing)
    assert np.array_equal(points, sampled(path, spacing))
    assert np.array_equal(along, lengths_along(points))


@given(PATHS, SEEDS)
def test_values_at_points_are_those_of_their_cells(path, seed):
    cells = np.random.default_rng(seed).integers(0, 256, GRID.shape, np.uint8)
    assert np.array_equal(values_at(path, cells, PLACE, 255), GRID.sample(cells, path, 255))


@given(PATHS, SEEDS)
def test_time_along_a_line_follows_the_limits_between_its_points(path, seed):
    limits = np.random.default_rng(seed).choice(np.array((0, 10, 25, 90), np.uint8), GRID.shape)
    points, along = sampled_along(path, 0.1)
    between = GRID.sample(limits, (points[:-1] + points[1:]) / 2.0, 0) / 100.0
    speeds = np.where(between > 0.0, np.minimum(between, 0.3), 0.3)
    expected = np.append(0.0, np.cumsum(np.diff(along) / speeds))
    assert np.array_equal(seconds_along(points, along, limits, PLACE, 0.3), expected)


@given(PATHS, PATHS, st.sampled_from((0.2, 0.5, 1.5)))
def test_a_line_is_beside_another_one_up_to_its_first_point_that_is_far_off(path, other, reach):
    points, lengths = sampled(path, 0.1), lengths_along(other)
    ahead = last = 0
    for number, (x, y) in enumerate(points):
        where, apart = nearest_between(other, lengths, ahead - 0.5, ahead + 2.0, x, y)
        if math.isinf(apart):
            where, apart = nearest_between(other, lengths, -math.inf, math.inf, x, y)
        apart = math.dist(other[0], (x, y)) if math.isinf(apart) else apart
        assume(abs(apart - reach) > 1e-9)
        if apart > reach:
            break
        ahead, last = max(ahead, where), number
    assert last_beside(points, other, lengths, reach, (0.5, 2.0)) == last


def test_lines_of_another_shape_are_refused():
    points, along = sampled_along(np.zeros((2, 2)), 0.1)
    with pytest.raises(ValueError, match=r"corners must have shape \(n, 2\)"):
        sampled_along(np.zeros((0, 2)), 0.1)
    with pytest.raises(ValueError, match="spacing must be above zero"):
        sampled_along(points, 0.0)
    with pytest.raises(ValueError, match="one number for each of the 2 points"):
        seconds_along(points, along[:1].copy(), np.zeros(GRID.shape, np.uint8), PLACE, 0.3)
    with pytest.raises(ValueError, match="one number for each of the 2 points of the line"):
        last_beside(points, points, along[:1].copy(), 0.5, (0.5, 2.0))
