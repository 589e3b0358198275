"""Exact costs to one cell from all others: Dijkstra's search (1959) on a circular bucket queue (Dial 1969)."""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work. So `astar`, `detour` and this module read the weights around a cell by the same lines:
# as a function, even one that numba inlines, they make a field take 1.4 times as long, and a search twice.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

from typing import Any

import numpy as np
from numba import int64, njit, types

from fog_contracts.costs import INSCRIBED
from fog_kernels import _arrays
from fog_kernels.steps import DIAGONAL, FOUND, NOT_FOUND, OVERFLOW, QUEUE_FULL, STRAIGHT


def _field_signature(costs: Any) -> Any:
    return types.Tuple((int64, int64))(  # type: ignore[no-untyped-call]  # numba has no types
        _arrays.U8_FLAT,
        int64,
        _arrays.I32_FLAT,
        int64,
        _arrays.U8_FLAT,
        types.Array(costs, 1, "C"),
        _arrays.I32_OUT,
        _arrays.I32_OUT,
        _arrays.I32_OUT,
        int64,
    )


@njit([_field_signature(types.int32), _field_signature(types.int64)], cache=True, nogil=True, error_model="numpy")
def fill_field(
    costmap: Any,
    width: int,
    weight: Any,
    goal: int,
    exits: Any,
    field: Any,
    queue_cell: Any,
    queue_next: Any,
    heads: Any,
    shift: int,
) -> tuple[int, int]:
    """Write the exact cost from every cell to the goal; cells without a path keep the largest value.

    With a costmap `exits` (else it is empty) the search ends at the cell that is nearest among those traversable
    there. Return a status and that cell. A bucket is no wider than the cheapest edge, so the costs in the lowest
    bucket are final (Dinitz's caliber).
    """
    exit_cell: Any = np.int64(-1)
    highest = np.int64(2147483646) if field.itemsize == 4 else np.int64(1) << 61
    height = costmap.size // width
    mask = heads.size - 1
    capacity = queue_cell.size
    if weight[costmap[goal]] == 0:
        return NOT_FOUND, exit_cell
    offsets = np.empty(8, np.int64)
    lengths = np.empty(8, np.int64)
    for k, (cx, cy) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))):
        offsets[k] = cy * width + cx
        lengths[k] = STRAIGHT if k < 4 else DIAGONAL
    around = np.empty(8, np.int64)
    heads[:] = -1
    free: Any = np.int64(-1)
    used: Any = np.int64(1)
    queue_cell[0] = goal
    queue_next[0] = -1
    heads[0] = 0
    queued = 1
    field[goal] = 0
    bucket: Any = np.int64(0)
    while queued > 0:
        entry: Any = np.int64(heads[np.uint64(bucket & mask)])
        while entry == -1:
            bucket += 1
            entry = np.int64(heads[np.uint64(bucket & mask)])
        if exit_cell >= 0 and bucket > np.int64(field[np.uint64(exit_cell)]) >> shift:
            return FOUND, exit_cell
        cell: Any = np.int64(queue_cell[np.uint64(entry)])
        heads[np.uint64(bucket & mask)] = queue_next[np.uint64(entry)]
        queue_next[np.uint64(entry)] = free
        free = entry
        queued -= 1
        here = np.int64(field[np.uint64(cell)])
        if here >> shift != bucket:
            continue  # a stale entry: the cell was expanded from a lower bucket
        if exits.size > 0 and exits[np.uint64(cell)] < INSCRIBED:
            if exit_cell < 0 or here < np.int64(field[np.uint64(exit_cell)]):
                exit_cell = cell
            continue
        y = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        own = np.int64(weight[costmap[np.uint64(cell)]])
        w_right = np.int64(weight[costmap[np.uint64(cell + 1)]]) if x + 1 < width else np.int64(0)
        w_left = np.int64(weight[costmap[np.uint64(cell - 1)]]) if x > 0 else np.int64(0)
        w_up = np.int64(weight[costmap[np.uint64(cell + width)]]) if y + 1 < height else np.int64(0)
        w_down = np.int64(weight[costmap[np.uint64(cell - width)]]) if y > 0 else np.int64(0)
        around[0] = w_right
        around[1] = w_left
        around[2] = w_up
        around[3] = w_down
        around[4] = weight[costmap[np.uint64(cell + width + 1)]] if w_right > 0 and w_up > 0 else 0
        around[5] = weight[costmap[np.uint64(cell + width - 1)]] if w_left > 0 and w_up > 0 else 0
        around[6] = weight[costmap[np.uint64(cell - width + 1)]] if w_right > 0 and w_down > 0 else 0
        around[7] = weight[costmap[np.uint64(cell - width - 1)]] if w_left > 0 and w_down > 0 else 0
        for k in range(8):
            other = around[k]
            if other == 0:
                continue
            neighbour = cell + offsets[k]
            reached = here + lengths[k] * (own + other)
            if reached >= highest:
                return OVERFLOW, exit_cell
            if reached >= field[np.uint64(neighbour)]:
                continue
            field[np.uint64(neighbour)] = reached
            if free >= 0:
                entry = free
                free = np.int64(queue_next[np.uint64(entry)])
            elif used < capacity:
                entry = used
                used += 1
            else:
                return QUEUE_FULL, exit_cell
            slot = (reached >> shift) & mask
            queue_cell[np.uint64(entry)] = neighbour
            queue_next[np.uint64(entry)] = heads[np.uint64(slot)]
            heads[np.uint64(slot)] = entry
            queued += 1
    if exits.size > 0 and exit_cell < 0:
        return NOT_FOUND, exit_cell
    return FOUND, exit_cell


def _descend_signature(costs: Any) -> Any:
    field = types.Array(costs, 1, "C", readonly=True)
    return int64(_arrays.U8_FLAT, int64, _arrays.I32_FLAT, int64, field, _arrays.I32_OUT)


@njit([_descend_signature(types.int32), _descend_signature(types.int64)], cache=True, nogil=True)
def descend(costmap: Any, width: int, weight: Any, cell: int, field: Any, path: Any) -> int:
    """Write the cells from `cell` to where the field is 0; return their number."""
    height = costmap.size // width
    count = 0
    while True:
        path[count] = cell
        count += 1
        here = np.int64(field[cell])
        if here == 0:
            return count
        y = cell // width
        x = cell - y * width
        for k in range(9):
            dx = k % 3 - 1
            dy = k // 3 - 1
            if (dx == 0 and dy == 0) or not (0 <= x + dx < width and 0 <= y + dy < height):
                continue
            if weight[costmap[y * width + x + dx]] == 0 or weight[costmap[(y + dy) * width + x]] == 0:
                continue
            neighbour = (y + dy) * width + x + dx
            weights = np.int64(weight[costmap[cell]]) + np.int64(weight[costmap[neighbour]])
            length = DIAGONAL if dx != 0 and dy != 0 else STRAIGHT
            if weight[costmap[neighbour]] > 0 and np.int64(field[neighbour]) + length * weights == here:
                cell = neighbour
                break
