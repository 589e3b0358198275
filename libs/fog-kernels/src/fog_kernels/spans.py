"""Writing a shape's cost or speed limit into a window of a map, from the shape's spans of columns per row."""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import int64, njit, uint8, void

from fog_contracts.costs import LETHAL
from fog_kernels import _arrays

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.shapes import Spans


@njit(
    void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, int64, uint8, _arrays.U8_GRID_OUT),
    cache=True,
    nogil=True,
)
def _raise_costs(rows: Any, starts: Any, stops: Any, x: int, y: int, value: int, cost: Any) -> None:
    height, width = cost.shape
    for i in range(np.searchsorted(rows, y), np.searchsorted(rows, y + height)):
        row = cost[rows[i] - y]
        # A negative end of a slice would count from the window's other side.
        first, last = max(starts[i] - x, 0), max(min(stops[i] - x, width), 0)
        if value == LETHAL:
            row[first:last] = LETHAL
        else:
            # Unknown is the highest value, so it stays.
            for column in range(first, last):
                row[column] = max(row[column], value)


@njit(
    void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, int64, uint8, _arrays.U8_GRID_OUT),
    cache=True,
    nogil=True,
)
def _lower_speeds(rows: Any, starts: Any, stops: Any, x: int, y: int, value: int, speed: Any) -> None:
    height, width = speed.shape
    for i in range(np.searchsorted(rows, y), np.searchsorted(rows, y + height)):
        row = speed[rows[i] - y]
        for column in range(max(starts[i] - x, 0), min(stops[i] - x, width)):
            if row[column] == 0 or row[column] > value:
                row[column] = value


def raise_costs(shapes: Sequence[tuple[Spans, int]], x: int, y: int, cost: NDArray[np.uint8]) -> None:
    """Combine each shape's cost (0 to 254) with `cost` (uint8, a map's window from column x, row y on) in its cells.

    As `combine_costs`: the higher cost wins, and only 254 replaces unknown. Raises TypeError or ValueError for a wrong
    array or value.
    """
    _arrays.exact(cost, np.uint8, 2, "cost")
    for spans, value in shapes:
        if not 0 <= value <= LETHAL:
            raise ValueError(f"cost must be 0 to {LETHAL}, not {value}")
        _raise_costs(spans.rows, spans.starts, spans.stops, x, y, value, cost)


def lower_speeds(shapes: Sequence[tuple[Spans, int]], x: int, y: int, speed: NDArray[np.uint8]) -> None:
    """Combine speed limits (1 to 254 cm/s) with `speed` (as `cost` of `raise_costs`): the lower limit wins."""
    _arrays.exact(speed, np.uint8, 2, "speed")
    for spans, value in shapes:
        if not 1 <= value <= LETHAL:
            raise ValueError(f"a speed limit must be 1 to {LETHAL} cm/s, not {value}: 0 means no limit")
        _lower_speeds(spans.rows, spans.starts, spans.stops, x, y, value, speed)
