"""Components: the same as a flood from every cell."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_kernels.components import Components

if TYPE_CHECKING:
    from numpy.typing import NDArray

Cell = tuple[int, int]


def flood(costmap: NDArray[np.uint8], start: Cell) -> set[Cell]:
    """All cells (column, row) that a robot reaches, by the definition."""
    height, width = costmap.shape
    seen, stack = {start}, [start]
    while stack:
        x, y = stack.pop()
        for cell in ((x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)):
            if 0 <= cell[0] < width and 0 <= cell[1] < height and costmap[cell[::-1]] < 253 and cell not in seen:
                seen.add(cell)
                stack.append(cell)
    return seen


@st.composite
def costmaps(draw: st.DrawFn) -> NDArray[np.uint8]:
    height, width = draw(st.integers(1, 20)), draw(st.integers(1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    costmap = np.zeros((height, width), np.uint8)
    walls = rng.random((height, width)) < draw(st.sampled_from([0.0, 0.2, 0.4, 0.6, 1.0]))
    costmap[walls] = rng.choice(np.array([252, 253, 254, 255], np.uint8), int(walls.sum()))
    return costmap


@settings(max_examples=examples(200), deadline=None)
@given(costmaps(), st.data())
def test_components_are_what_a_flood_reaches(costmap: NDArray[np.uint8], data: st.DataObject) -> None:
    height, width = costmap.shape
    cell = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    components = Components(costmap)
    component = components.of(*cell)
    assert (component >= 0) == (costmap[cell[::-1]] < 253)
    if component < 0:
        assert not components.connected(cell, cell)
        return
    reached = flood(costmap, cell)
    for other in product(range(-1, width + 1), range(-1, height + 1)):
        assert components.connected(cell, other) == (other in reached)
    goal = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))

    def order(cell: Cell) -> tuple[int, int, int]:
        return (cell[0] - goal[0]) ** 2 + (cell[1] - goal[1]) ** 2, cell[1], cell[0]

    assert components.nearest(component, goal) == min(reached, key=order)


@settings(max_examples=examples(100), deadline=None)
@given(costmaps(), st.data())
def test_labels_of_a_window_are_those_of_its_cells(costmap: NDArray[np.uint8], data: st.DataObject) -> None:
    height, width = costmap.shape
    x, y = data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
    w, h = data.draw(st.integers(1, width - x)), data.draw(st.integers(1, height - y))
    components = Components(costmap)
    expected = [[components.of(column, row) for column in range(x, x + w)] for row in range(y, y + h)]
    assert components.labels(x, y, w, h).tolist() == expected


@settings(max_examples=examples(100), deadline=None)
@given(costmaps(), st.data())
def test_window_has_both_components_when_its_cells_belong_to_them(
    costmap: NDArray[np.uint8], data: st.DataObject
) -> None:
    height, width = costmap.shape
    components = Components(costmap)
    columns, rows = st.integers(0, width - 1), st.integers(0, height - 1)
    first, second = (components.of(data.draw(columns), data.draw(rows)) for _ in range(2))
    windows = []
    for _ in range(data.draw(st.integers(0, 5))):
        x, y = data.draw(columns), data.draw(rows)
        windows.append((x, y, data.draw(st.integers(0, width - x)), data.draw(st.integers(0, height - y))))
    found = components.both_in(np.array(windows, np.int32).reshape(-1, 4), first, second)
    expected = [
        first >= 0 <= second and {first, second} <= set(components.labels(*window).ravel().tolist())
        for window in windows
    ]
    assert found.tolist() == expected


def test_unknown_component_and_window_off_the_grid_are_refused() -> None:
    components = Components(np.zeros((4, 5), np.uint8))
    with pytest.raises(ValueError, match="component 3"):
        components.nearest(3, (0, 0))
    with pytest.raises(ValueError, match="window"):
        components.labels(2, 0, 4, 1)
    for window in ((2, 0, 4, 1), (0, 3, 1, 2), (-1, 0, 1, 1), (0, 0, 2**31 - 1, 1)):
        with pytest.raises(ValueError, match=r"window .* leaves the 5 x 4 grid"):
            components.both_in(np.array([(0, 0, 1, 1), window], np.int32), 0, 0)
    with pytest.raises(ValueError, match=r"shape \(n, 4\)"):
        components.both_in(np.zeros((1, 2), np.int32), 0, 0)
