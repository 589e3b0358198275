"""Ray casting compared with brute force, from inside and outside the grid."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import examples
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from numpy.typing import NDArray


def walk(occupied: NDArray[np.bool_], x: float, y: float, angle: float, reach: float, step: float) -> float:
    """Return the first sampled distance (cells) inside an occupied cell."""
    distances = np.arange(0.0, reach, step)
    columns = np.floor(x + distances * math.cos(angle)).astype(int)
    rows = np.floor(y + distances * math.sin(angle)).astype(int)
    height, width = occupied.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    hits = inside.copy()
    hits[inside] = occupied[rows[inside], columns[inside]]
    return float(distances[np.argmax(hits)]) if hits.any() else math.inf


def box_distance(x: float, y: float, angle: float, column: int, row: int) -> float:
    """Return the exact distance at which a ray enters a cell; touching its border in one point does not count.

    A ray that starts in the cell, whose lower borders belong to it, has entered it wherever it goes.
    """
    if column <= x < column + 1 and row <= y < row + 1:
        return 0.0
    dx, dy = math.cos(angle), math.sin(angle)
    enter, leave = 0.0, math.inf
    for start, direction, low in ((x, dx, column), (y, dy, row)):
        if abs(direction) < 1e-300:
            if not low <= start < low + 1:
                return math.inf
            continue
        near, far = sorted(((low - start) / direction, (low + 1 - start) / direction))
        enter, leave = max(enter, near), min(leave, far)
    return enter if enter < leave else math.inf


# A start on a line of the grid touches cells in single points, and may count them or not.
COORDINATES = st.floats(-6, 20).map(lambda value: round(value, 9)).filter(lambda value: not value.is_integer())
"""No nearer to a border than the rays beside one are apart, so that these are on both sides of it."""


@settings(max_examples=examples(120), deadline=None)
@example(seed=504, height=1, width=1, x=0.0, y=0.0, angle=2.0, density=0.02).via(
    "a ray that leaves the cell on whose border it starts"
)
@example(seed=0, height=2, width=2, x=2.0, y=1.0, angle=0.0, density=0.02).via(
    "a ray that leaves the grid on whose border it starts"
)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 14),
    st.integers(1, 14),
    COORDINATES,
    COORDINATES,
    st.floats(-10, 10).map(lambda value: round(value, 9)),
    st.sampled_from([0.02, 0.2, 0.6]),
)
def test_range_is_the_distance_to_the_first_occupied_cell(  # noqa: PLR0913  # one argument per drawn value
    seed: int, height: int, width: int, x: float, y: float, angle: float, density: float
) -> None:
    occupied = np.random.default_rng(seed).random((height, width)) < density
    expected = min(
        (box_distance(x, y, angle, int(column), int(row)) for row, column in np.argwhere(occupied)), default=math.inf
    )
    measured = cast(occupied, 1.0, 0.0, 0.0, x, y, [angle], 100.0)[0]
    # A ray through a corner may pass on either side of it: compare also with rays beside it.
    beside = [
        min((box_distance(x, y, angle + e, int(c), int(r)) for r, c in np.argwhere(occupied)), default=math.inf)
        for e in (-1e-9, 1e-9)
    ]
    assert any(measured == pytest.approx(value, abs=1e-5) for value in [expected, *beside])


def test_scan_in_metres_with_an_origin_equals_dense_sampling() -> None:
    rng = np.random.default_rng(3)
    occupied = rng.random((60, 80)) < 0.03
    angles = np.linspace(-math.pi, math.pi, 181)
    ranges = cast(occupied.view(np.uint8), 0.05, -1.0, 2.0, 0.983, 3.4817, angles, 2.5)
    for angle, measured in zip(angles, ranges, strict=True):
        sampled = 0.05 * walk(occupied, 1.983 / 0.05, 1.4817 / 0.05, angle, 50.0, 0.002)
        if math.isinf(sampled) or math.isinf(measured):
            assert min(sampled, measured) > 2.49 or measured == sampled
        else:
            assert sampled - 0.011 <= measured <= sampled + 1e-9


def test_range_is_infinite_without_a_hit_and_zero_inside_an_obstacle() -> None:
    occupied = np.zeros((10, 10), bool)
    occupied[5, 9] = True
    assert cast(occupied, 0.1, 0.0, 0.0, 0.05, 0.55, [0.0], 2.0)[0] == pytest.approx(0.85)
    assert cast(occupied, 0.1, 0.0, 0.0, 0.05, 0.55, [0.0], 0.8)[0] == math.inf
    assert cast(occupied, 0.1, 0.0, 0.0, 0.05, 0.55, [math.pi], 2.0)[0] == math.inf
    assert cast(occupied, 0.1, 0.0, 0.0, 0.95, 0.55, [1.0], 2.0)[0] == 0.0
    assert cast(occupied, 0.1, 0.0, 0.0, 2.0, 0.55, [math.pi], 2.0)[0] == pytest.approx(1.0)


def test_non_finite_pose_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        cast(np.zeros((2, 2), bool), 0.1, 0.0, 0.0, math.nan, 0.0, [0.0], 1.0)
    with pytest.raises(TypeError, match="occupied"):
        cast(np.zeros((2, 2), np.float64), 0.1, 0.0, 0.0, 0.0, 0.0, [0.0], 1.0)
