"""Distance transform and inflation: exact, and windows equal to full recomputes bit for bit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from compiler import COMPILED, examples
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION, Inflation
from fog_kernels.distance import squared_distance_capped
from fog_kernels.inflation import InflationTable, inflate, inflate_window, inflation_table

if TYPE_CHECKING:
    from numpy.typing import NDArray


def brute_force_squares(occupied: NDArray[Any], cap: int) -> NDArray[np.int64]:
    height, width = occupied.shape
    squares = np.full((height, width), cap * cap, np.int64)
    rows, cols = np.mgrid[0:height, 0:width]
    for y, x in np.argwhere(occupied):
        squares = np.minimum(squares, (rows - y) ** 2 + (cols - x) ** 2)
    return squares


@st.composite
def raw_maps(draw: st.DrawFn, max_side: int = 90) -> NDArray[np.uint8]:
    height = draw(st.integers(1, max_side))
    width = draw(st.integers(1, max_side))
    seed = draw(st.integers(0, 2**32 - 1))
    density = draw(st.sampled_from([0.0, 0.001, 0.01, 0.2, 1.0]))
    rng = np.random.default_rng(seed)
    raw = rng.choice(np.array([0, 1, 90, 252, 253, 255], np.uint8), (height, width))
    raw[rng.random((height, width)) < density] = 254
    return raw


@settings(max_examples=examples(60), deadline=None)
@given(raw_maps(50), st.integers(1, 20))
def test_distances_equal_brute_force(raw: NDArray[np.uint8], cap: int) -> None:
    occupied = raw == 254
    assert np.array_equal(squared_distance_capped(occupied, cap), brute_force_squares(occupied, cap))
    assert np.array_equal(squared_distance_capped(occupied.view(np.uint8), cap), brute_force_squares(occupied, cap))


def reference_inflation(raw: NDArray[np.uint8], table: InflationTable) -> NDArray[np.uint8]:
    squares = brute_force_squares(raw == 254, table.reach + 1)
    inside = squares <= table.reach**2
    inflated = np.where(inside, table.cost[np.where(inside, squares, 0)], 0)
    unknown = np.where(inflated >= 253, inflated, 255)
    return np.where(raw == 255, unknown, np.maximum(raw, inflated)).astype(np.uint8)


@settings(max_examples=examples(60), deadline=None)
@given(raw_maps(), st.floats(0.05, 0.8))
def test_inflation_equals_its_definition(raw: NDArray[np.uint8], radius: float) -> None:
    table = inflation_table(0.05, Inflation(inflation_radius=radius))
    assert np.array_equal(inflate(raw, table), reference_inflation(raw, table))


@settings(max_examples=examples(150), deadline=None)
@given(raw_maps(90 if COMPILED else 40), st.data())
def test_inflating_a_window_updates_the_whole_map(raw: NDArray[np.uint8], data: st.DataObject) -> None:
    table = inflation_table(0.05, Inflation(inflation_radius=data.draw(st.sampled_from([0.0, 0.2, 0.55]))))
    out = inflate(raw, table)
    height, width = raw.shape
    changed = raw.copy()
    x = data.draw(st.integers(-5, width))
    y = data.draw(st.integers(-5, height))
    w = data.draw(st.integers(0, 30))
    h = data.draw(st.integers(0, 30))
    value = data.draw(st.sampled_from([0, 100, 254, 255]))
    changed[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] = value
    before = out.copy()
    x0, y0, w0, h0 = inflate_window(changed, table, x, y, w, h, out)
    assert np.array_equal(out, inflate(changed, table))
    outside = np.ones(raw.shape, bool)
    outside[y0 : y0 + h0, x0 : x0 + w0] = False
    assert np.array_equal(out[outside], before[outside])


def test_costs_follow_the_exponential_decay() -> None:
    table = inflation_table(0.05, DEFAULT_INFLATION)
    assert table.reach == 11
    assert table.cost[0] == 254
    assert table.cost[9] == 253  # 0.15 m
    assert table.cost[16] == int(252 * math.exp(-3.0 * (0.20 - 0.17)))
    assert table.cost[121] == int(252 * math.exp(-3.0 * (0.55 - 0.17)))
    assert np.all(np.diff(table.cost.astype(int)) <= 0)


def test_reach_is_the_inflation_radius_rounded_up_to_whole_cells() -> None:
    for radius, cells in ((0.0, 0), (0.01, 1), (0.05, 1), (0.52, 11), (0.55, 11), (0.56, 12)):
        table = inflation_table(0.05, Inflation(inflation_radius=radius))
        assert table.reach == cells, radius
        assert len(table.cost) == cells**2 + 1
    raw = np.zeros((1, 15), np.uint8)
    raw[0, 0] = 254
    inflated = inflate(raw, inflation_table(0.05, Inflation(inflation_radius=0.52)))
    assert inflated[0, 11] == int(252 * math.exp(-3.0 * (0.55 - 0.17)))
    assert inflated[0, 12] == 0


def test_unknown_cells_within_the_inscribed_radius_are_inscribed_and_others_stay_unknown() -> None:
    raw = np.full((1, 12), 255, np.uint8)
    raw[0, 0] = 254
    assert inflate(raw, inflation_table(0.05, DEFAULT_INFLATION)).tolist() == [[254, 253, 253, 253, *[255] * 8]]


def test_read_only_maps_are_accepted() -> None:
    raw = np.frombuffer(bytes([0, 254, 0, 0]), np.uint8).reshape(2, 2)
    table = inflation_table(0.05, Inflation(inscribed_radius=0.0, inflation_radius=0.0))
    assert inflate(raw, table).tolist() == [[0, 254], [0, 0]]


def test_invalid_arrays_are_refused_by_name() -> None:
    table = inflation_table(0.05, DEFAULT_INFLATION)
    with pytest.raises(TypeError, match="raw must be uint8"):
        inflate(np.zeros((4, 4), np.int32), table)
    with pytest.raises(ValueError, match="raw must be C-ordered"):
        inflate(np.zeros((4, 8), np.uint8)[:, ::2], table)
    with pytest.raises(ValueError, match="out must have the shape"):
        inflate(np.zeros((4, 4), np.uint8), table, np.zeros((4, 5), np.uint8))
    raw = np.zeros((4, 4), np.uint8)
    with pytest.raises(ValueError, match="out must not be raw"):
        inflate(raw, table, raw)
    with pytest.raises(ValueError, match="180"):
        inflation_table(0.01, Inflation(inflation_radius=2.0))
    with pytest.raises(ValueError, match="cap_cells"):
        squared_distance_capped(raw, 0)
