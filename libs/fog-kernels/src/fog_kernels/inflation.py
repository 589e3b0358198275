"""Inflation of lethal cells, for whole maps and for the cells that a change affects; a shape's costs in a window.

Costs follow Nav2's inflation layer with its default settings: 254 on a lethal cell, 253 within the inscribed radius, an
exponential decay beyond, up to the inflation radius rounded up to whole cells. Unknown cells (255) are not inflated
themselves; within the inscribed radius of a lethal cell they become 253, elsewhere they stay unknown. A shape's cost or
speed limit is written by the shape's spans of columns per row.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import int64, njit, uint8, void

from fog_contracts.costs import INSCRIBED, LETHAL, PENALTY_MAX, UNKNOWN
from fog_kernels import _arrays

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.costs import Inflation
    from fog_contracts.shapes import Spans

MAX_REACH = 180  # the sum of two squares of up to reach + 1 must fit uint16


@dataclass(frozen=True, slots=True)
class InflationTable:
    """Cost by squared distance in cells: uint8 (reach^2 + 1), and the reach in cells beyond which it is 0."""

    cost: NDArray[np.uint8] = field(repr=False)
    reach: int


def inflation_table(resolution: float, inflation: Inflation) -> InflationTable:
    """Tabulate the inflated cost by squared distance in cells on a grid of this resolution (m per cell).

    Raises ValueError if the resolution is not above 0, or the inflation radius spans more than 180 cells.
    """
    resolution = _arrays.positive(resolution, "resolution")
    # Up, as Nav2; the tolerance keeps a radius that is a whole number of cells from gaining one by rounding.
    reach = math.ceil(inflation.inflation_radius / resolution - 1e-9)
    if reach > MAX_REACH:
        raise ValueError(f"inflation_radius spans {reach} cells, at most {MAX_REACH} are supported")
    cost = np.zeros(reach * reach + 1, np.uint8)
    for square in range(reach * reach + 1):
        distance = math.sqrt(square) * resolution
        if square == 0:
            cost[square] = LETHAL
        elif distance <= inflation.inscribed_radius + 1e-9:
            cost[square] = INSCRIBED
        else:
            cost[square] = int(
                PENALTY_MAX * math.exp(-inflation.cost_scaling * (distance - inflation.inscribed_radius))
            )
    cost.setflags(write=False)
    return InflationTable(cost=cost, reach=reach)


@njit(
    void(_arrays.U8_GRID, _arrays.U8_FLAT, int64, int64, int64, int64, int64, _arrays.U8_GRID_OUT),
    cache=True,
    nogil=True,
)
def _inflate(raw: Any, cost: Any, reach: int, x0: int, y0: int, x1: int, y1: int, out: Any) -> None:
    """Write the inflated costs of cells x0 <= x < x1, y0 <= y < y1, reading `reach` cells around them."""
    height, width = raw.shape
    top = max(y0 - reach, 0)
    bottom = min(y1 + reach, height)
    left = max(x0 - reach, 0)
    right = min(x1 + reach, width)
    span = right - left
    far = np.uint8(reach + 1)
    one = np.uint8(1)

    # Vertical distance of every read cell to a lethal one in its column, capped; rows are slices for SIMD.
    vertical = np.empty((bottom - top, span), np.uint8)
    for y in range(top, bottom):
        source = raw[y, left:right]
        row = vertical[y - top]
        if y == top:
            for x in range(span):
                row[x] = np.uint8(0) if source[x] == LETHAL else far
        else:
            above = vertical[y - top - 1]
            for x in range(span):
                step = np.uint8(above[x] + one)
                step = min(step, far)
                row[x] = np.uint8(0) if source[x] == LETHAL else step
    for y in range(bottom - 2, top - 1, -1):
        row = vertical[y - top]
        below = vertical[y - top + 1]
        for x in range(span):
            step = np.uint8(below[x] + one)
            row[x] = min(row[x], step)

    # Horizontal minimum in blocks, so that blocks far from everything cost only a copy.
    block = 64
    beyond = np.uint16((reach + 1) * (reach + 1))
    padded = np.full(block + 2 * reach, beyond, np.uint16)
    squares = np.empty(block, np.uint16)
    limit = reach * reach
    for y in range(y0, y1):
        row = vertical[y - top]
        source = raw[y]
        target = out[y]
        for start in range(x0, x1, block):
            stop = min(start + block, x1)
            count = stop - start
            read_from = max(start - reach, left)
            read_to = min(stop + reach, right)
            near = row[read_from - left : read_to - left]
            nearest = far
            for i in range(near.size):
                nearest = min(nearest, near[i])
            if nearest == far:
                target[start:stop] = source[start:stop]
                continue
            if read_from > start - reach or read_to < stop + reach or count < block:
                padded[:] = beyond
            window = padded[read_from - (start - reach) : read_to - (start - reach)]
            for i in range(near.size):
                value = np.uint16(near[i])
                window[i] = np.uint16(value * value)
            centre = padded[reach : reach + block]
            for i in range(block):
                squares[i] = centre[i]
            for shift in range(1, reach + 1):
                square = np.uint16(shift * shift)
                before = padded[reach - shift : reach - shift + block]
                after = padded[reach + shift : reach + shift + block]
                for i in range(block):
                    best = np.uint16(min(before[i], after[i]) + square)
                    squares[i] = min(squares[i], best)
            for i in range(count):
                distance = squares[i]
                inflated = cost[distance] if distance <= limit else np.uint8(0)
                below = source[start + i]
                # Where a robot's centre can't be, it matters no more what is there.
                target[start + i] = inflated if below == UNKNOWN and inflated >= INSCRIBED else max(below, inflated)


def _check_out(raw: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    _arrays.exact(out, np.uint8, 2, "out")
    if out.shape != raw.shape:
        raise ValueError(f"out must have the shape of raw, {raw.shape}, not {out.shape}")
    if np.may_share_memory(raw, out):
        raise ValueError("out must not be raw: lethal cells are read again on the next change")


def inflate(raw: NDArray[np.uint8], table: InflationTable, out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Return max(raw, cost inflated around lethal cells), uint8 (h, w); 255 is kept but where 253 replaces it.

    Writes into `out` when given. Raises TypeError or ValueError for wrong types or shapes.
    """
    raw = _arrays.grid(raw, "raw")
    if out is None:
        out = np.empty(raw.shape, np.uint8)
    _check_out(raw, out)
    _inflate(raw, table.cost, table.reach, 0, 0, raw.shape[1], raw.shape[0], out)
    return out


def inflate_window(
    raw: NDArray[np.uint8], table: InflationTable, x: int, y: int, w: int, h: int, out: NDArray[np.uint8]
) -> tuple[int, int, int, int]:
    """Update `out` after cells of `raw` inside the window (column x, row y, w by h cells) changed.

    `out` must be `inflate` of `raw` before the change; afterwards it equals `inflate(raw, table)` bit for bit.
    Returns the window (x, y, w, h) that was rewritten: the change and the reach around it, inside the map; empty
    (w or h 0) when the window lies off the map. Raises TypeError or ValueError for wrong types or shapes.
    """
    raw = _arrays.grid(raw, "raw")
    _check_out(raw, out)
    height, width = raw.shape
    inside_x0, inside_x1 = max(x, 0), min(x + w, width)
    inside_y0, inside_y1 = max(y, 0), min(y + h, height)
    if inside_x0 >= inside_x1 or inside_y0 >= inside_y1:
        return 0, 0, 0, 0
    x0, x1 = max(inside_x0 - table.reach, 0), min(inside_x1 + table.reach, width)
    y0, y1 = max(inside_y0 - table.reach, 0), min(inside_y1 + table.reach, height)
    _inflate(raw, table.cost, table.reach, x0, y0, x1, y1, out)
    return x0, y0, x1 - x0, y1 - y0


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
