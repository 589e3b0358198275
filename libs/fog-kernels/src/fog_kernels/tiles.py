"""Exact cost fields of many goals in little memory: tiles of a field are stored as patterns that fields share.

A tile of 16 x 16 cells is stored as its lowest cost and, for each cell, the difference from it. Far from the goal these
differences depend on how one leaves the tile, not on the goal: all goals outside a room have the same pattern in it,
and a corridor's tile has one for each way out that it leads to. On an office of 2000 x 1200 cells the fields of 50
goals have 8000 different tiles of 470,000: 12 MB, where single costs would take 480 MB as 32-bit numbers.
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import int64, njit, types, void

from fog_kernels import _arrays
from fog_kernels.guides import LEVEL, NO_PATH, TILE, TILE_BITS, GoalField

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Costs = NDArray[np.int32 | np.int64]

_CELLS = TILE * TILE
_MOST = 2147483646
"""The highest cost and difference that is stored; higher ones are stored as this, which stays a lower bound."""
_HASH = (1 << 40) - 1


@njit(inline="always")
def _place(patterns: Any, number: int, index: Any) -> int:
    """Return where in the index a pattern stands that equals pattern `number`, or where it belongs."""
    first = number * _CELLS
    value = np.int64(0)
    for cell in range(_CELLS):
        value = (value * 1000003 + np.int64(patterns[np.uint64(first + cell)]) + 1) & _HASH
    mask = index.size - 1
    place = (value ^ (value >> 20)) & mask
    while True:
        known = np.int64(index[np.uint64(place)])
        if known < 0:
            return int(place)
        cell = 0
        while cell < _CELLS:
            if patterns[np.uint64(known * _CELLS + cell)] != patterns[np.uint64(first + cell)]:
                break
            cell += 1
        if cell == _CELLS:
            return int(place)
        place = (place + 1) & mask


@njit(inline="always")
def _write(costs: Any, unset: int, width: int, height: int, tile: int, least: Any, patterns: Any, number: int) -> None:
    """Write by how much the costs of a tile's cells exceed the lowest one."""
    columns = (width + TILE - 1) // TILE
    left, top = tile % columns * TILE, tile // columns * TILE
    first = number * _CELLS
    for cell in range(_CELLS):
        x, y = left + cell % TILE, top + cell // TILE
        cost = np.int64(unset)
        if x < width and y < height:
            cost = np.int64(costs[np.uint64(y * width + x)])
        patterns[np.uint64(first + cell)] = NO_PATH if cost == unset else min(cost - least, _MOST)


def _signature(costs: Any) -> Any:
    flat = types.Array(costs, 1, "C", readonly=True)
    out = _arrays.I32_OUT
    return int64(flat, int64, int64, int64, int64, out, out, out, int64, int64, out)


@njit([_signature(types.int32), _signature(types.int64)], cache=True, nogil=True, error_model="numpy")
def _divide(
    costs: Any, unset: int, width: int, height: int, unit: int,
    lowest: Any, slots: Any, patterns: Any, count: int, limit: int, index: Any,
) -> int:  # fmt: skip
    """Write lowest cost and slot of each tile; return the number of patterns, or -1 when there is room for no more.

    A new pattern is written behind the last one, and counts only if the index has no other one like it.
    """
    columns = (width + TILE - 1) // TILE
    rows = (height + TILE - 1) // TILE
    for tile in range(rows * columns):
        left, top = tile % columns * TILE, tile // columns * TILE
        right, bottom = min(left + TILE, width), min(top + TILE, height)
        least = np.int64(unset)
        for y in range(top, bottom):
            for x in range(left, right):
                least = min(least, np.int64(costs[np.uint64(y * width + x)]))
        slots[np.uint64(tile)] = 0
        if least == unset:
            lowest[np.uint64(tile)] = NO_PATH
            continue
        lowest[np.uint64(tile)] = least // unit
        if count == limit:
            return -1
        _write(costs, unset, width, height, tile, least, patterns, count)
        place = _place(patterns, count, index)
        if index[np.uint64(place)] < 0:
            index[np.uint64(place)] = count
            count += 1
        slots[np.uint64(tile)] = index[np.uint64(place)]
    return int(count)


@njit(void(_arrays.I32_OUT, int64, _arrays.I32_OUT), cache=True, nogil=True, error_model="numpy")
def _fill_index(patterns: Any, count: int, index: Any) -> None:
    """Enter patterns, no two of which are equal, into the index."""
    index[:] = -1
    for number in range(count):
        index[np.uint64(_place(patterns, number, index))] = number


def _block_signature(costs: Any) -> Any:
    flat = types.Array(costs, 1, "C", readonly=True)
    return void(flat, int64, int64, int64, int64, int64, _arrays.I32_OUT)


@njit([_block_signature(types.int32), _block_signature(types.int64)], cache=True, nogil=True, error_model="numpy")
def _coarsen(costs: Any, unset: int, width: int, bits: int, columns: int, unit: int, lowest: Any) -> None:
    """Write the lowest cost of each block of 2^bits x 2^bits cells."""
    lowest[:] = NO_PATH
    for cell in range(costs.size):
        cost = np.int64(costs[np.uint64(cell)])
        if cost == unset:
            continue
        block = np.uint64((cell // width >> bits) * columns + (cell % width >> bits))
        known = np.int64(lowest[block])
        if known < 0 or cost // unit < known:
            lowest[block] = cost // unit


def _blocks(length: int, bits: int) -> int:
    return -(-length >> bits)


class TilePatterns:
    """The patterns of all fields; what is written stays as it is, so that any thread may search with a field.

    One thread at a time may add fields.
    """

    def __init__(self, capacity: int) -> None:
        """Prepare room for `capacity` (bytes); what is not used takes no memory."""
        self._limit = 1 + capacity // (4 * _CELLS)
        self._patterns = np.empty((self._limit, _CELLS), np.int32)
        self._patterns[LEVEL] = 0
        self._index = np.empty(1 << (2 * self._limit).bit_length(), np.int32)
        self._count = 1
        _fill_index(self._patterns.ravel(), self._count, self._index)

    @property
    def size(self) -> int:
        """The memory (bytes) in use, without the index (at most 1.6 % of the capacity)."""
        return (self._count - 1) * 4 * _CELLS

    @property
    def rows(self) -> NDArray[np.int32]:
        """All patterns, (n, 256)."""
        return self._patterns

    @property
    def crowded(self) -> bool:
        """Whether more than half of the room is taken."""
        return 2 * self._count > self._limit

    def worth_compacting(self, fields: Sequence[GoalField]) -> bool:
        """Whether the room is crowded, and a quarter of the patterns belongs to none of these fields."""
        return self.crowded and 4 * int(self._used(fields).sum()) < 3 * self._count

    def _used(self, fields: Sequence[GoalField]) -> NDArray[np.bool_]:
        used = np.zeros(self._count, np.bool_)
        used[LEVEL] = True
        for field in fields:
            if field.slots.size > 0:
                used[field.slots[field.lowest >= 0]] = True
        return used

    def field(self, costs: Costs, goal: tuple[int, int], width: int, height: int, bits: int) -> GoalField:
        """Return the field of costs ((width * height,), the type's highest value without a path) to a goal.

        One of blocks of 2^bits cells, when its patterns don't fit.
        """
        unset = int(np.iinfo(costs.dtype).max)
        unit = int(costs.max(where=costs != unset, initial=0)) // _MOST + 1
        lowest = np.empty((_blocks(height, TILE_BITS), _blocks(width, TILE_BITS)), np.int32)
        slots = np.empty_like(lowest)
        count = int(
            _divide(
                costs, unset, width, height, unit, lowest.ravel(), slots.ravel(), self._patterns.ravel(),
                self._count, self._limit, self._index,
            )
        )  # fmt: skip
        if count >= 0:
            self._count = count
            return GoalField(goal, width, height, TILE_BITS, lowest, unit, slots, self._patterns)
        _fill_index(self._patterns.ravel(), self._count, self._index)  # without what was entered for this field
        return blocks(costs, goal, width, height, bits)

    def compacted(self, fields: Sequence[GoalField]) -> tuple[TilePatterns, list[GoalField]]:
        """Return patterns for these fields only, and the fields with them; fields without patterns stay as they are."""
        used = self._used(fields)
        smaller = TilePatterns((self._limit - 1) * 4 * _CELLS)
        smaller._count = int(used.sum())
        smaller._patterns[: smaller._count] = self._patterns[: self._count][used]
        _fill_index(smaller._patterns.ravel(), smaller._count, smaller._index)
        number = np.zeros(max(1, self._count), np.int32)
        number[: self._count] = np.maximum(np.cumsum(used) - 1, 0)
        return smaller, [
            GoalField(
                field.goal, field.width, field.height, field.bits, field.lowest, field.unit,
                number[field.slots], smaller._patterns,
            ) if field.slots.size > 0 else field
            for field in fields
        ]  # fmt: skip


def blocks(costs: Costs, goal: tuple[int, int], width: int, height: int, bits: int) -> GoalField:
    """Return the field in blocks of 2^bits x 2^bits cells of costs ((width * height,)) to a goal."""
    unset = int(np.iinfo(costs.dtype).max)
    unit = int(costs.max(where=costs != unset, initial=0)) // _MOST + 1
    lowest = np.empty((_blocks(height, bits), _blocks(width, bits)), np.int32)
    _coarsen(costs, unset, width, bits, lowest.shape[1], unit, lowest.ravel())
    return GoalField(goal, width, height, bits, lowest, unit)
