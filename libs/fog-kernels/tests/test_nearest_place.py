"""The nearest place on a polyline, against all of its places."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fog_kernels.lines import nearest_between, nearest_on

COORDINATE = st.floats(-20.0, 20.0).map(lambda value: round(value, 2))
POINT = st.tuples(COORDINATE, COORDINATE)


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
