"""Where a sampled polyline first enters marked cells, against all of its samples."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fog_contracts.geometry import lengths_along, sampled
from fog_kernels.lines import first_inside

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
