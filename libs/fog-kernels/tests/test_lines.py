"""How far one line parts from another, against a dense sampling of both."""

from __future__ import annotations

import numpy as np
import pytest
from compiler import examples
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fog_kernels.lines import leaves

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
