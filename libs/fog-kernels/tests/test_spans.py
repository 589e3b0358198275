"""Shapes written as spans equal the same shapes combined as masks."""

from __future__ import annotations

import numpy as np
import pytest
from compiler import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.grid import Window, combine_costs, combine_speed_limits
from fog_contracts.shapes import ShapeMask, Spans, mask_spans
from fog_kernels.inflation import lower_speeds, raise_costs

WIDTH, HEIGHT = 40, 30


@st.composite
def placed_masks(draw: st.DrawFn) -> ShapeMask:
    x, y = draw(st.integers(0, WIDTH - 1)), draw(st.integers(0, HEIGHT - 1))
    window = Window(x, y, draw(st.integers(1, WIDTH - x)), draw(st.integers(1, HEIGHT - y)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    return ShapeMask(window, rng.random((window.height, window.width)) < draw(st.sampled_from([0.0, 0.1, 0.5, 1.0])))


def whole_mask(shape: ShapeMask) -> np.ndarray:
    whole = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    whole[shape.window.rows, shape.window.columns] = shape.mask
    return whole


@settings(max_examples=examples(100), deadline=None)
@given(placed_masks())
def test_spans_hold_exactly_the_cells_of_their_mask(shape: ShapeMask) -> None:
    spans = mask_spans(shape)
    assert np.array_equal(whole_mask(spans.to_mask()), whole_mask(shape))
    assert spans.cells == shape.mask.sum()
    same_row = spans.rows[1:] == spans.rows[:-1]
    assert np.all(spans.rows[1:] >= spans.rows[:-1])
    assert np.all((spans.starts[1:] > spans.stops[:-1])[same_row])


@settings(max_examples=examples(100), deadline=None)
@given(placed_masks(), st.integers(0, 254), st.data())
def test_spans_are_combined_with_a_window_like_masks(shape: ShapeMask, value: int, data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    whole = rng.choice(np.array([0, 1, 90, 252, 253, 254, 255], np.uint8), (HEIGHT, WIDTH))
    x, y = data.draw(st.integers(0, WIDTH - 1)), data.draw(st.integers(0, HEIGHT - 1))
    window = Window(x, y, data.draw(st.integers(1, WIDTH - x)), data.draw(st.integers(1, HEIGHT - y)))
    mask = whole_mask(shape)[window.rows, window.columns]
    below = np.ascontiguousarray(whole[window.rows, window.columns])
    spans, layer = mask_spans(shape), np.full(below.shape, value, np.uint8)
    cost = below.copy()
    raise_costs([(spans, value)], x, y, cost)
    assert np.array_equal(cost, combine_costs(below, layer, mask))
    if value > 0:
        speed = np.minimum(below, 254)
        expected = combine_speed_limits(speed, np.where(mask, layer, 0).astype(np.uint8))
        lower_speeds([(spans, value)], x, y, speed)
        assert np.array_equal(speed, expected)


def test_lethal_span_beside_a_window_changes_nothing_in_it() -> None:
    left: Spans = mask_spans(ShapeMask(Window(0, 0, 1, 1), np.ones((1, 1), np.bool_)))
    cost = np.zeros((1, 4), np.uint8)
    raise_costs([(left, 254)], 2, 0, cost)
    assert not cost.any()


def test_invalid_values_and_arrays_are_refused_by_name() -> None:
    spans: Spans = mask_spans(ShapeMask(Window(0, 0, 1, 1), np.ones((1, 1), np.bool_)))
    grid = np.zeros((2, 2), np.uint8)
    with pytest.raises(ValueError, match="cost must be 0 to 254"):
        raise_costs([(spans, 255)], 0, 0, grid)
    with pytest.raises(ValueError, match="must be 1 to 254 cm/s"):
        lower_speeds([(spans, 0)], 0, 0, grid)
    with pytest.raises(TypeError, match="speed must be uint8"):
        lower_speeds([(spans, 1)], 0, 0, grid.astype(np.int32))
