"""Straight lines and paths made of them: their costs, where they enter cells, and the place on them that is nearest."""

from __future__ import annotations

import math

import numpy as np
import pytest
from compiler import examples
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fog_contracts.geometry import lengths_along, sampled
from fog_kernels.lines import first_inside, first_near, leaves, mark_near, nearest_between, nearest_on

coordinates = st.floats(-20.0, 20.0, width=32)
lines = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=6).map(
    lambda points: np.array(points, float)
)


def farthest(line: np.ndarray, other: np.ndarray, spacing: float) -> float:
    """Return how far (m) the points of a line, `spacing` apart, are at most from another line."""
    found = 0.0
    for start, end in zip(line, [*line[1:], line[-1]], strict=True):
        count = max(1, int(np.ceil(np.hypot(*(end - start)) / spacing)))
        for point in start + np.linspace(0.0, 1.0, count + 1)[:, None] * (end - start):
            nearest = np.inf
            for a, b in zip(other, [*other[1:], other[-1]], strict=True):
                share = np.linspace(0.0, 1.0, 801)[:, None]
                nearest = min(nearest, float(np.min(np.hypot(*(a + share * (b - a) - point).T))))
            found = max(found, nearest)
    return found


@settings(max_examples=examples(60), deadline=None)
@given(lines, lines, st.floats(0.5, 15.0))
def test_line_leaves_another_where_a_point_of_it_is_farther_than_the_reach(
    line: np.ndarray, other: np.ndarray, reach: float
) -> None:
    most = farthest(line, other, 1.0)
    assume(abs(most - reach) > 0.1)  # the other line is sampled here
    assert leaves(line, other, reach, 1.0) == (most > reach)


def test_part_of_a_line_does_not_leave_it_and_a_longer_one_does() -> None:
    line = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]])
    assert not leaves(np.array([[2.0, 0.0], [9.0, 0.0]]), line, 0.5, 0.5)
    assert not leaves(line[::-1].copy(), line, 0.5, 0.5)
    assert leaves(np.array([[2.0, 0.0], [11.0, 0.0]]), line, 0.5, 0.5)


def test_line_of_another_shape_is_refused() -> None:
    line = np.zeros((2, 2))
    with pytest.raises(ValueError, match="other must have shape"):
        leaves(line, np.zeros((0, 2)), 1.0, 1.0)
    with pytest.raises(TypeError, match="line must be float64"):
        leaves(line.astype(np.float32), line, 1.0, 1.0)  # type: ignore[arg-type]  # refused at run time, too
    with pytest.raises(ValueError, match="spacing"):
        leaves(line, line, 1.0, 0.0)


LEFT, BOTTOM, RESOLUTION = -3.0, -4.0, 0.5
GRID = LEFT, BOTTOM, RESOLUTION
COORDINATE = st.floats(-6.0, 6.0).map(lambda value: round(value, 2))
CORNERS = st.lists(st.tuples(COORDINATE, COORDINATE), min_size=1, max_size=8)


@given(
    CORNERS, st.sampled_from([0.1, 0.35, 2.0]), st.floats(-1.0, 12.0), st.integers(0, 8), st.integers(0, 8),
    st.integers(0, 2**16),
)  # fmt: skip
def test_first_sample_in_a_marked_cell_is_found(corners, spacing, begin, column, row, seed):
    line = np.array(corners)
    mask = np.random.default_rng(seed).random((5, 4)) < 0.4
    points = sampled(line, spacing)
    along = lengths_along(points)
    assume(np.all(np.abs(along - begin) > 1e-9))  # else rounding decides
    cells = np.floor((points - (LEFT, BOTTOM)) / RESOLUTION).astype(int) - (column, row)
    expected = math.inf
    for where, (x, y) in zip(along, cells, strict=True):
        if where >= begin and 0 <= x < 4 and 0 <= y < 5 and mask[y, x]:
            expected = where
            break
    found = first_inside(line, lengths_along(line), spacing, begin, GRID, (column, row), mask)
    assert found == pytest.approx(expected, abs=1e-9)


def test_arrays_that_are_no_line_or_no_mask_are_refused():
    line, mask = np.array([(0.0, 0.0), (1.0, 0.0)]), np.ones((2, 2), np.bool_)
    with pytest.raises(ValueError, match="no point"):
        first_inside(np.empty((0, 2)), np.empty(0), 0.1, 0.0, GRID, (0, 0), mask)
    with pytest.raises(ValueError, match="one for each entry of along"):
        first_inside(line, np.array([0.0]), 0.1, 0.0, GRID, (0, 0), mask)
    with pytest.raises(TypeError, match="mask"):
        first_inside(line, np.array([0.0, 1.0]), 0.1, 0.0, GRID, (0, 0), mask.astype(np.int64))
    with pytest.raises(ValueError, match="spacing"):
        first_inside(line, np.array([0.0, 1.0]), 0.0, 0.0, GRID, (0, 0), mask)


PLACE = st.floats(-20.0, 20.0).map(lambda value: round(value, 2))
POINT = st.tuples(PLACE, PLACE)


def line_of(corners: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
    points = np.array(corners)
    return points, np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))


@given(st.lists(POINT, min_size=2, max_size=12), POINT, st.data())
def test_no_place_of_the_segments_is_nearer_and_the_one_found_is_on_them(corners, place, data):
    points, along = line_of(corners)
    first = data.draw(st.integers(0, len(points) - 2))
    last = data.draw(st.integers(first + 1, len(points) - 1))
    assume(along[last] > along[first])
    where, distance = nearest_on(points, along, first, last, *place)
    assert along[first] - 1e-9 <= where <= along[last] + 1e-9
    found = [np.interp(where, along, points[:, axis]) for axis in (0, 1)]
    assert math.dist(found, place) == pytest.approx(distance, abs=1e-6)
    for share in np.linspace(along[first], along[last], 200):
        other = [np.interp(share, along, points[:, axis]) for axis in (0, 1)]
        assert distance <= math.dist(other, place) + 1e-6


@given(st.lists(POINT, min_size=2, max_size=12), POINT, st.data())
def test_no_place_of_a_part_of_the_line_is_nearer_and_the_one_found_is_in_it(corners, place, data):
    points, along = line_of(corners)
    assume(along[-1] > 0.0)
    low = data.draw(st.floats(-5.0, along[-1]))
    high = data.draw(st.floats(max(low, 0.0), along[-1] + 5.0))
    where, distance = nearest_between(points, along, low, high, *place)
    assert max(low, 0.0) - 1e-9 <= where <= min(high, along[-1]) + 1e-9
    found = [np.interp(where, along, points[:, axis]) for axis in (0, 1)]
    assert math.dist(found, place) == pytest.approx(distance, abs=1e-6)
    for share in np.linspace(max(low, 0.0), min(high, along[-1]), 200):
        other = [np.interp(share, along, points[:, axis]) for axis in (0, 1)]
        assert distance <= math.dist(other, place) + 1e-6


def test_part_that_the_line_does_not_have_has_no_nearest_place():
    points, along = line_of([(0.0, 0.0), (1.0, 0.0), (1.0, 0.0)])
    assert nearest_between(points, along, 1.5, 3.0, 0.5, 0.5)[1] == math.inf
    assert nearest_between(points[1:], along[1:], -math.inf, math.inf, 0.5, 0.5)[1] == math.inf


def test_no_segment_or_none_with_a_length_has_no_nearest_place():
    points, along = line_of([(0.0, 0.0), (1.0, 0.0), (1.0, 0.0)])
    assert nearest_on(points, along, 1, 1, 0.5, 0.5)[1] == math.inf
    assert nearest_on(points, along, 1, 2, 0.5, 0.5)[1] == math.inf
    assert nearest_on(points, along, 0, 2, math.nan, 0.5)[1] == math.inf
    assert nearest_on(points, along, 0, 2, 0.5, 0.5) == (0.5, 0.5)


def test_wrong_lines_and_segments_are_refused():
    points, along = line_of([(0.0, 0.0), (1.0, 0.0)])
    with pytest.raises(ValueError, match="segments 0 to 2"):
        nearest_on(points, along, 0, 2, 0.0, 0.0)
    with pytest.raises(ValueError, match="shape"):
        nearest_on(points[:1], along, 0, 0, 0.0, 0.0)
    with pytest.raises(TypeError, match="float64"):
        nearest_on(points.astype(np.float32), along, 0, 1, 0.0, 0.0)


@settings(max_examples=examples(60), deadline=None)
@given(lines, lines, st.floats(0.1, 10.0))
def test_all_points_of_a_line_near_another_one_are_marked_and_the_first_is_found(line, other, reach):
    line, other = sampled(line, 0.1), sampled(other, 0.1)
    apart = np.hypot(*(line[:, None, :] - other[None, :, :]).transpose(2, 0, 1)).min(axis=1)
    assume(np.abs(apart - reach).min() > 1e-6)
    marked = np.zeros(len(line), np.bool_)
    mark_near(line, 0, len(line), other, reach, 0.1, marked)
    assert marked.tolist() == (apart <= reach).tolist()
    near = np.flatnonzero(marked)
    assert first_near(line, 0, len(line), other, reach, 0.1) == (near[0] if len(near) else -1)
    with pytest.raises(ValueError, match="not among"):
        mark_near(line, 0, len(line) + 1, other, reach, 0.1, marked)
