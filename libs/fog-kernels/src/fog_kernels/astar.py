"""Shortest paths on costmaps: exact A* with integer costs, replanning with a goal field, shortcuts.

Grid: 8-connected; a cell is traversable below 253 (inscribed); a diagonal needs both orthogonal cells traversable.
An edge costs its length times the mean weight of its two end cells, `weight = neutral + factor * cost`, so costs are
symmetric. Lengths are the integers 408 and 577 (577/408 is sqrt 2 within 2e-6), weights are rounded to integers: the
search is exact for this integer problem, and no float rounding can make it depend on the order of expansion.

Methods: A* (Hart, Nilsson and Raphael 1968) on a circular bucket queue (Dial 1969). A bucket spans several costs, so a
cell is expanded again when a cheaper path to it appears; the search ends only when no open cell can lead to a cheaper
path. An entry is never put into a bucket below the current one (pathmax, Mero 1984), nor beyond the last: the search is
exact for every heuristic that never overestimates, also for the rounded one of a goal field. Shortcuts integrate the
cost along lines of sight cell by cell (Amanatides and Woo 1987).
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import float64, int64, njit, types

from fog_contracts.costs import COST_WEIGHT, INSCRIBED, NEUTRAL_WEIGHT, PENALTY_MAX
from fog_kernels import _arrays
from fog_kernels.guides import TILE, TILE_BITS, GoalField

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.guides import Detour
    from fog_kernels.tiles import TilePatterns

    _Cells = NDArray[np.int32]
    _Guides = tuple[_Cells, int, int, int, _Cells, _Cells, _Cells, int, int]

STRAIGHT = 408
DIAGONAL = 577
BUCKETS = 1024  # heads fit the first-level cache; a power of two

_FOUND = 0
_NOT_FOUND = 1
_TIMED_OUT = 2
_OVERFLOW = 3
_QUEUE_FULL = 4

type_cells = _arrays.I32_FLAT
type_scratch = _arrays.I32_OUT


def _search_signature(costs: Any) -> Any:
    write = types.Array(costs, 1, "C")
    return types.void(
        _arrays.U8_FLAT,  # costmap
        int64,  # width
        _arrays.I32_FLAT,  # weight
        int64,  # start
        int64,  # goal
        _arrays.I32_FLAT,  # lowest
        int64,  # field_width
        int64,  # field_bits
        int64,  # field_unit
        _arrays.I32_FLAT,  # slots
        _arrays.I32_FLAT,  # patterns
        _arrays.I32_FLAT,  # detour
        int64,  # detour_highest
        int64,  # detour_offset
        write,  # g
        type_scratch,  # queue_cell
        type_scratch,  # queue_next
        type_scratch,  # heads
        int64,  # shift
        type_scratch,  # reached_cells
        int64,  # max_expansions
        _arrays.I64_OUT,  # result
    )


@njit([_search_signature(types.int32), _search_signature(types.int64)], cache=True, nogil=True, error_model="numpy")
def _search(
    costmap: Any,
    width: int,
    weight: Any,
    start: int,
    goal: int,
    lowest: Any,
    field_width: int,
    field_bits: int,
    field_unit: int,
    slots: Any,
    patterns: Any,
    detour: Any,
    detour_highest: Any,
    detour_offset: int,
    g: Any,
    queue_cell: Any,
    queue_next: Any,
    heads: Any,
    shift: int,
    reached_cells: Any,
    max_expansions: int,
    result: Any,
) -> None:
    """Search from start to goal; an empty `lowest` (see `GoalField`) means the octile heuristic, and no detour.

    `g` holds its largest value everywhere before and after. A negative g is the complement of an expanded cell's
    cost. `result` receives status, cost, path length, expansions; the path itself ends in queue_cell, goal first.
    """
    # Indices are unsigned: numba checks signed ones for negative values, which costs a fifth of the search's time.
    unset = g[start]
    highest = np.int64(2147483646) if g.itemsize == 4 else np.int64(1) << 61
    height = costmap.size // width
    mask = heads.size - 1
    capacity = queue_cell.size
    use_field = lowest.size > 0
    use_patterns = slots.size > 0
    use_detour = detour.size > 0
    goal_x = goal % width
    goal_y = goal // width
    last = TILE - 1
    cheapest = 2 * np.int64(weight[0])
    step_straight = STRAIGHT * cheapest
    step_extra = (DIAGONAL - STRAIGHT) * cheapest

    result[0] = _NOT_FOUND
    result[1] = 0
    result[2] = 0
    result[3] = 0
    if weight[costmap[start]] == 0 or weight[costmap[goal]] == 0:
        return
    if start == goal:
        queue_cell[0] = start
        result[0] = _FOUND
        result[2] = 1
        return
    y: Any = start // width
    x: Any = start % width
    if use_field:
        block = np.uint64((y >> field_bits) * field_width + (x >> field_bits))
        remaining: Any = np.int64(lowest[block]) * field_unit
        if remaining < 0:
            return
        if use_patterns:
            place = (np.int64(slots[block]) << (2 * TILE_BITS)) + ((y & last) << TILE_BITS) + (x & last)
            rise = np.int64(patterns[np.uint64(place)])
            if rise < 0:
                return
            remaining += rise
        if use_detour and detour[start] > 0:
            remaining = max(remaining, min(np.int64(detour[start]), detour_highest) + detour_offset)
        bucket = remaining >> shift
    else:
        dx = abs(start % width - goal_x)
        dy = abs(start // width - goal_y)
        bucket = (step_straight * max(dx, dy) + step_extra * min(dx, dy)) >> shift

    offsets = np.empty(8, np.int64)
    columns = np.empty(8, np.int64)
    rows = np.empty(8, np.int64)
    lengths = np.empty(8, np.int64)
    for k, (cx, cy) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))):
        columns[k] = cx
        rows[k] = cy
        offsets[k] = cy * width + cx
        lengths[k] = STRAIGHT if k < 4 else DIAGONAL
    around = np.empty(8, np.int64)

    heads[:] = -1
    free: Any = np.int64(-1)
    used: Any = np.int64(1)
    queue_cell[0] = start
    queue_next[0] = -1
    heads[np.uint64(bucket & mask)] = 0
    queued = 1
    g[start] = 0
    reached_cells[0] = start
    n_reached = 1
    best = highest
    expansions = 0
    status = _NOT_FOUND

    while queued > 0:
        entry: Any = np.int64(heads[np.uint64(bucket & mask)])
        while entry == -1:
            bucket += 1
            entry = np.int64(heads[np.uint64(bucket & mask)])
        if (bucket << shift) >= best:
            break
        cell: Any = np.int64(queue_cell[np.uint64(entry)])
        heads[np.uint64(bucket & mask)] = queue_next[np.uint64(entry)]
        queue_next[np.uint64(entry)] = free
        free = entry
        queued -= 1
        here = np.int64(g[np.uint64(cell)])
        if here < 0:
            continue  # a stale entry: the cell was expanded at its current cost
        y = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        if best != highest:
            if use_field:
                block = np.uint64((y >> field_bits) * field_width + (x >> field_bits))
                remaining = np.int64(lowest[block]) * field_unit
                if use_patterns:
                    place = (np.int64(slots[block]) << (2 * TILE_BITS)) + ((y & last) << TILE_BITS) + (x & last)
                    remaining += np.int64(patterns[np.uint64(place)])
                if use_detour:
                    bound = np.int64(detour[np.uint64(cell)])
                    if bound > 0:
                        remaining = max(remaining, min(bound, detour_highest) + detour_offset)
                f = here + remaining
            else:
                dx = abs(x - goal_x)
                dy = abs(y - goal_y)
                f = here + step_straight * max(dx, dy) + step_extra * min(dx, dy)
            if f >= best:
                continue
        g[np.uint64(cell)] = ~here
        expansions += 1
        if max_expansions > 0 and expansions > max_expansions:
            status = _TIMED_OUT
            break
        own = np.int64(weight[costmap[np.uint64(cell)]])

        right = x + 1 < width
        left = x > 0
        up = y + 1 < height
        down = y > 0
        w_right = np.int64(weight[costmap[np.uint64(cell + 1)]]) if right else np.int64(0)
        w_left = np.int64(weight[costmap[np.uint64(cell - 1)]]) if left else np.int64(0)
        w_up = np.int64(weight[costmap[np.uint64(cell + width)]]) if up else np.int64(0)
        w_down = np.int64(weight[costmap[np.uint64(cell - width)]]) if down else np.int64(0)
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
            old = np.int64(g[np.uint64(neighbour)])
            first_reached = old == unset
            if old < 0:
                old = ~old
            if reached >= old:
                if reached >= highest:
                    status = _OVERFLOW
                    break
                continue
            nx = x + columns[k]
            ny = y + rows[k]
            if use_field:
                block = np.uint64((ny >> field_bits) * field_width + (nx >> field_bits))
                remaining = np.int64(lowest[block]) * field_unit
                if remaining < 0:
                    continue
                if use_patterns:
                    place = (np.int64(slots[block]) << (2 * TILE_BITS)) + ((ny & last) << TILE_BITS) + (nx & last)
                    rise = np.int64(patterns[np.uint64(place)])
                    if rise < 0:
                        continue
                    remaining += rise
                if use_detour:
                    bound = np.int64(detour[np.uint64(neighbour)])
                    if bound > 0:
                        remaining = max(remaining, min(bound, detour_highest) + detour_offset)
            else:
                dx = abs(nx - goal_x)
                dy = abs(ny - goal_y)
                remaining = step_straight * max(dx, dy) + step_extra * min(dx, dy)
            f = reached + remaining
            if f >= highest:
                status = _OVERFLOW
                break
            if f >= best:
                continue
            if first_reached:
                reached_cells[n_reached] = neighbour
                n_reached += 1
            g[np.uint64(neighbour)] = reached
            if neighbour == goal:
                best = reached
                status = _FOUND
                continue
            if free >= 0:
                entry = free
                free = np.int64(queue_next[np.uint64(entry)])
            elif used < capacity:
                entry = used
                used += 1
            else:
                status = _QUEUE_FULL
                break
            slot = min(max(f >> shift, bucket), bucket + mask) & mask
            queue_cell[np.uint64(entry)] = neighbour
            queue_next[np.uint64(entry)] = heads[np.uint64(slot)]
            heads[np.uint64(slot)] = entry
            queued += 1
        if status in (_OVERFLOW, _QUEUE_FULL):
            break

    if status == _FOUND:
        # Parents are not stored: a predecessor is a neighbour whose cost plus edge is the cell's cost. Among several
        # the one in the same direction as before is preferred.
        cell = goal
        count = 0
        direction = 0
        while True:
            queue_cell[count] = cell
            count += 1
            if cell == start:
                break
            here = np.int64(g[np.uint64(cell)])
            if here < 0:
                here = ~here
            y = np.int64(np.uint32(cell) // np.uint32(width))
            x = cell - y * width
            own = np.int64(weight[costmap[np.uint64(cell)]])
            for turn in range(8):
                k = (direction + turn) & 7
                nx = x + columns[k]
                ny = y + rows[k]
                if nx < 0 or nx >= width or ny < 0 or ny >= height:
                    continue
                neighbour = cell + offsets[k]
                there = np.int64(g[np.uint64(neighbour)])
                if there >= 0:
                    continue  # never expanded
                other = np.int64(weight[costmap[np.uint64(neighbour)]])
                if ~there + lengths[k] * (own + other) != here:
                    continue
                if k >= 4 and (weight[costmap[cell + columns[k]]] == 0 or weight[costmap[cell + rows[k] * width]] == 0):
                    continue
                cell = neighbour
                direction = k
                break
        result[1] = best
        result[2] = count
    result[0] = status
    result[3] = expansions
    for i in range(n_reached):
        g[reached_cells[i]] = unset


def _field_signature(costs: Any) -> Any:
    return types.Tuple((int64, int64))(  # type: ignore[no-untyped-call]  # numba has no types
        _arrays.U8_FLAT,
        int64,
        _arrays.I32_FLAT,
        int64,
        _arrays.U8_FLAT,
        types.Array(costs, 1, "C"),
        type_scratch,
        type_scratch,
        type_scratch,
        int64,
    )


@njit([_field_signature(types.int32), _field_signature(types.int64)], cache=True, nogil=True, error_model="numpy")
def _fill_field(
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
        return _NOT_FOUND, exit_cell
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
            return _FOUND, exit_cell
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
                return _OVERFLOW, exit_cell
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
                return _QUEUE_FULL, exit_cell
            slot = (reached >> shift) & mask
            queue_cell[np.uint64(entry)] = neighbour
            queue_next[np.uint64(entry)] = heads[np.uint64(slot)]
            heads[np.uint64(slot)] = entry
            queued += 1
    if exits.size > 0 and exit_cell < 0:
        return _NOT_FOUND, exit_cell
    return _FOUND, exit_cell


def _descend_signature(costs: Any) -> Any:
    field = types.Array(costs, 1, "C", readonly=True)
    return int64(_arrays.U8_FLAT, int64, _arrays.I32_FLAT, int64, field, type_scratch)


@njit([_descend_signature(types.int32), _descend_signature(types.int64)], cache=True, nogil=True)
def _descend(costmap: Any, width: int, weight: Any, cell: int, field: Any, path: Any) -> int:
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


@njit(int64(_arrays.U8_GRID, int64, int64, int64), cache=True, nogil=True)
def _nearest_traversable(costmap: Any, col: int, row: int, reach: int) -> int:
    height, width = costmap.shape
    nearest = -1
    least = reach * reach + 1
    for y in range(max(row - reach, 0), min(row + reach + 1, height)):
        for x in range(max(col - reach, 0), min(col + reach + 1, width)):
            square = (x - col) ** 2 + (y - row) ** 2
            if square < least and costmap[y, x] < INSCRIBED:
                least = square
                nearest = y * width + x
    return nearest


@njit(float64(_arrays.U8_GRID, _arrays.I32_FLAT, float64, float64, float64, float64, float64), cache=True, nogil=True)
def _line_cost(costmap: Any, weight: Any, x0: float, y0: float, x1: float, y1: float, limit: float) -> float:
    """Integrate the weight along a line in cell coordinates; infinite if blocked, or as soon as it exceeds limit."""
    height, width = costmap.shape
    x = math.floor(x0 + 0.5)
    y = math.floor(y0 + 0.5)
    last_x = math.floor(x1 + 0.5)
    last_y = math.floor(y1 + 0.5)
    if min(x, last_x) < 0 or max(x, last_x) >= width or min(y, last_y) < 0 or max(y, last_y) >= height:
        return math.inf
    dx = x1 - x0
    dy = y1 - y0
    length = math.sqrt(dx * dx + dy * dy)
    step_x = 1 if dx > 0.0 else -1
    step_y = 1 if dy > 0.0 else -1
    next_x = (x + 0.5 * step_x - x0) / dx if dx != 0.0 else math.inf
    next_y = (y + 0.5 * step_y - y0) / dy if dy != 0.0 else math.inf
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    done = 0.0
    total = 0.0
    # Cells are counted instead of comparing parameters, so that rounding can't miss the last cell.
    left_x = abs(last_x - x)
    left_y = abs(last_y - y)
    while True:
        own = np.int64(weight[costmap[y, x]])
        if own == 0:
            return math.inf
        if left_x == 0 and left_y == 0:
            return total + max(1.0 - done, 0.0) * length * own
        corner = left_x > 0 and left_y > 0 and abs(next_x - next_y) < 1e-9
        if corner:
            # A corner may be crossed only where a diagonal step is allowed.
            if weight[costmap[y, x + step_x]] == 0 or weight[costmap[y + step_y, x]] == 0:
                return math.inf
            until = next_x
            x += step_x
            y += step_y
            next_x += delta_x
            next_y += delta_y
            left_x -= 1
            left_y -= 1
        elif left_y == 0 or (left_x > 0 and next_x < next_y):
            until = next_x
            x += step_x
            next_x += delta_x
            left_x -= 1
        else:
            until = next_y
            y += step_y
            next_y += delta_y
            left_y -= 1
        until = min(until, 1.0)
        total += (until - done) * length * own
        done = until
        if total > limit:
            return math.inf


@njit(float64(_arrays.U8_GRID, _arrays.I32_FLAT, _arrays.F64_GRID), cache=True, nogil=True)
def _polyline_cost(costmap: Any, weight: Any, points: Any) -> float:
    """Integrate the weight along the lines between points; infinite if one is blocked."""
    total = 0.0
    for i in range(points.shape[0] - 1):
        total += _line_cost(costmap, weight, points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1], math.inf)
    return total


@njit(float64(_arrays.U8_GRID, _arrays.I32_FLAT, _arrays.I32_PAIRS, _arrays.F64_OUT), cache=True, nogil=True)
def _cells_cost(costmap: Any, weight: Any, cells: Any, cumulated: Any) -> float:
    """Fill cumulated[i] with the cost from the first cell to cell i; infinite if a step isn't one of the grid's."""
    height, width = costmap.shape
    total = 0.0
    for i in range(cells.shape[0]):
        x = np.int64(cells[i, 0])
        y = np.int64(cells[i, 1])
        if x < 0 or x >= width or y < 0 or y >= height or weight[costmap[y, x]] == 0:
            return math.inf
        if i > 0:
            last_x = np.int64(cells[i - 1, 0])
            last_y = np.int64(cells[i - 1, 1])
            if abs(x - last_x) > 1 or abs(y - last_y) > 1:
                return math.inf
            if x != last_x and y != last_y:
                if weight[costmap[last_y, x]] == 0 or weight[costmap[y, last_x]] == 0:
                    return math.inf
                length = float(DIAGONAL)
            elif x != last_x or y != last_y:
                length = float(STRAIGHT)
            else:
                length = 0.0
            total += length * (np.int64(weight[costmap[y, x]]) + np.int64(weight[costmap[last_y, last_x]]))
        cumulated[i] = total / (2.0 * STRAIGHT)
    return total / (2.0 * STRAIGHT)


@njit(
    int64(_arrays.U8_GRID, _arrays.I32_FLAT, _arrays.I32_PAIRS, _arrays.F64_FLAT, float64, _arrays.I64_OUT),
    cache=True,
    nogil=True,
)
def _shortcut(costmap: Any, weight: Any, cells: Any, cumulated: Any, slack: float, kept: Any) -> int:
    """Keep cells between which straight lines cost no more than the path: exponential, then binary search."""
    last = cells.shape[0] - 1
    kept[0] = 0
    count = 1
    anchor = 0
    while anchor < last:
        good = anchor + 1
        stride = 2
        bad = last + 1
        while anchor + stride <= last or good < last:
            probe = min(anchor + stride, last)
            allowed = (cumulated[probe] - cumulated[anchor]) * (1.0 + slack) + 1e-9
            cost = _line_cost(
                costmap,
                weight,
                float(cells[anchor, 0]),
                float(cells[anchor, 1]),
                float(cells[probe, 0]),
                float(cells[probe, 1]),
                allowed,
            )
            if cost > allowed:
                bad = probe
                break
            good = probe
            if probe == last:
                break
            stride *= 2
        while bad - good > 1 and bad <= last:
            probe = (good + bad) // 2
            allowed = (cumulated[probe] - cumulated[anchor]) * (1.0 + slack) + 1e-9
            cost = _line_cost(
                costmap,
                weight,
                float(cells[anchor, 0]),
                float(cells[anchor, 1]),
                float(cells[probe, 0]),
                float(cells[probe, 1]),
                allowed,
            )
            if cost > allowed:
                bad = probe
            else:
                good = probe
        kept[count] = good
        count += 1
        anchor = good
    return count


def _weights(neutral: int, factor: float) -> NDArray[np.int32]:
    """Tabulate the weight of every cost; 0 marks impassable cells."""
    if neutral < 1 or factor < 0.0 or not math.isfinite(factor):
        raise ValueError(f"neutral must be at least 1 and factor at least 0, not {neutral} and {factor}")
    weight = np.zeros(256, np.int32)
    graded = neutral + factor * np.arange(INSCRIBED)
    if graded[-1] > 100_000:
        raise ValueError(f"neutral + factor * {PENALTY_MAX} must not exceed 100000")
    weight[:INSCRIBED] = np.rint(graded)
    weight.setflags(write=False)
    return weight


_DEFAULT_WEIGHTS = _weights(NEUTRAL_WEIGHT, COST_WEIGHT)


_NO_GUIDE: NDArray[np.int32] = np.empty(0, np.int32)
_NO_EXITS: NDArray[np.uint8] = np.empty(0, np.uint8)


def _weights_of(neutral: int, factor: float) -> NDArray[np.int32]:
    if neutral == NEUTRAL_WEIGHT and factor == COST_WEIGHT:
        return _DEFAULT_WEIGHTS
    return _weights(neutral, factor)


def _cells_array(cells: NDArray[np.int32]) -> NDArray[np.int32]:
    _arrays.exact(cells, np.int32, 2, "cells")
    if cells.shape[0] == 0 or cells.shape[1] != 2:
        raise ValueError(f"cells must have shape (n, 2) with n >= 1, not {cells.shape}")
    return cells


@dataclass(frozen=True, slots=True)
class PlanResult:
    """Result of a search.

    `cost` is the sum over edges of length in cells times mean weight (infinite without a path), `cells` the path from
    start to goal, int32 (n, 2) as (column, row), empty without a path. `timed_out`: the limit of expansions ended the
    search.
    """

    found: bool
    cost: float
    cells: NDArray[np.int32]
    expansions: int
    timed_out: bool = False


class Planner:
    """Exact A* on costmaps of one size; owns the memory of its searches, so that planning allocates little.

    One thread may use it at a time. `neutral` is the weight of a free cell, `factor` multiplies the cost (0..252) that
    is added to it: with the defaults a path through cells of the highest cost weighs about as much as a detour five
    times as long over free cells.
    """

    def __init__(self, width: int, height: int, neutral: int = NEUTRAL_WEIGHT, factor: float = COST_WEIGHT) -> None:
        if width < 1 or height < 1 or width * height > 2**31 - 2:
            raise ValueError(f"width and height must be positive and below 2^31 cells in all, not {width} x {height}")
        self.width = width
        self.height = height
        self.neutral = neutral
        self.factor = factor
        self.weight = _weights_of(neutral, factor)
        """The weight of every cost (0..255); 0 marks impassable cells."""
        highest_edge_cost = 2 * DIAGONAL * int(self.weight.max())
        # With a consistent heuristic the total estimate rises by at most twice the highest edge cost per step.
        self._shift = max(0, (2 * highest_edge_cost // (BUCKETS - 2)).bit_length())
        self.bucket_shift = (2 * STRAIGHT * int(self.weight[0])).bit_length() - 1
        open_buckets = (highest_edge_cost >> self.bucket_shift) + 3
        self._field_buckets = 1 << open_buckets.bit_length()
        self._costs: type[np.int32 | np.int64] = np.int32
        self._capacity = width * height
        self._allocate()
        self._heads = np.empty(BUCKETS, np.int32)
        self._reached_cells = np.empty(width * height, np.int32)
        self._result = np.zeros(4, np.int64)

    def _allocate(self) -> None:
        # np.empty only reserves memory; pages that no search uses cost none. g must be initialized.
        self._g: NDArray[np.int32 | np.int64] = np.full(
            self.width * self.height, np.iinfo(self._costs).max, self._costs
        )
        self._queue_cell = np.empty(self._capacity, np.int32)
        self._queue_next = np.empty(self._capacity, np.int32)

    def _grid(self, costmap: NDArray[np.uint8]) -> NDArray[np.uint8]:
        costmap = _arrays.grid(costmap, "costmap")
        if costmap.shape != (self.height, self.width):
            raise ValueError(f"costmap must have shape {(self.height, self.width)}, not {costmap.shape}")
        return costmap

    def _index(self, cell: tuple[int, int], name: str) -> int:
        col, row = int(cell[0]), int(cell[1])
        if not (0 <= col < self.width and 0 <= row < self.height):
            raise ValueError(f"{name} {col, row} lies outside the {self.width} x {self.height} grid")
        return row * self.width + col

    def plan(
        self,
        costmap: NDArray[np.uint8],
        start: tuple[int, int],
        goal: tuple[int, int],
        max_expansions: int = 0,
        field: GoalField | None = None,
        detour: Detour | None = None,
    ) -> PlanResult:
        """Return a cheapest path from start to goal, both (column, row), on a uint8 (h, w) costmap.

        The goal's field, if given, guides the search, which stays exact as long as no cell of the costmap is lower than
        in the costmap of the field; so does the detour, which counts with a field only, for a goal outside its part of
        the floor. `max_expansions` above 0 limits the work. A start or goal that isn't traversable
        gives `found=False`. Raises ValueError for cells outside, for a costmap of another shape, and for a field of
        another goal or shape.
        """
        costmap = self._grid(costmap)
        first = self._index(start, "start")
        last = self._index(goal, "goal")
        guides = self._guides((int(goal[0]), int(goal[1])), field, detour)
        while True:
            _search(
                costmap.ravel(),
                self.width,
                self.weight,
                first,
                last,
                *guides,
                self._g,
                self._queue_cell,
                self._queue_next,
                self._heads,
                self._shift,
                self._reached_cells,
                max_expansions,
                self._result,
            )
            status, cost, length, expansions = (int(value) for value in self._result)
            if status == _OVERFLOW:
                self._widen()
            elif status == _QUEUE_FULL:
                self._capacity *= 2
                self._allocate()
            else:
                break
        if status != _FOUND:
            return PlanResult(
                found=False,
                cost=math.inf,
                cells=np.empty((0, 2), np.int32),
                expansions=expansions,
                timed_out=status == _TIMED_OUT,
            )
        flat = self._queue_cell[length - 1 :: -1] if length == self._capacity else self._queue_cell[:length][::-1]
        cells = np.empty((length, 2), np.int32)
        np.floor_divide(flat, self.width, out=cells[:, 1])
        np.subtract(flat, cells[:, 1] * self.width, out=cells[:, 0])
        return PlanResult(found=True, cost=cost / (2.0 * STRAIGHT), cells=cells, expansions=expansions)

    def _guides(self, goal: tuple[int, int], field: GoalField | None, detour: Detour | None) -> _Guides:
        """Return the kernel's arguments for field and detour; raises ValueError for a field of another goal or map."""
        if field is None:
            return _NO_GUIDE, 0, 0, 0, _NO_GUIDE, _NO_GUIDE, _NO_GUIDE, 0, 0
        if field.goal != goal or (field.width, field.height) != (self.width, self.height):
            size = f"{field.width} x {field.height}"
            raise ValueError(f"the field is of goal {field.goal} on {size} cells: pass that of this goal and map")
        around, highest, offset = _NO_GUIDE, 0, None
        if detour is not None and (offset := detour.offset(field)) is not None:
            around, highest = detour.costs.ravel(), detour.highest
        return (
            field.lowest.ravel(), field.lowest.shape[1], field.bits, field.unit, field.slots.ravel(),
            field.patterns.ravel(), around, highest, offset or 0,
        )  # fmt: skip

    def _widen(self) -> None:
        """Switch to 64-bit costs permanently: a path's cost exceeds 32 bits."""
        self._costs = np.int64
        self._allocate()

    def goal_field(
        self, costmap: NDArray[np.uint8], goal: tuple[int, int], patterns: TilePatterns, bits: int = TILE_BITS
    ) -> GoalField:
        """Return the field of a goal (column, row), which guides `plan` on this costmap and on any with raised costs.

        Its tiles are added to `patterns`; if they don't fit, it has blocks of 2^bits cells. Takes as long as a Dijkstra
        search of the whole map. Raises ValueError as `plan` does.
        """
        costmap = self._grid(costmap)
        self._fill(costmap, self._index(goal, "goal"), _NO_EXITS)
        field = patterns.field(self._g, (int(goal[0]), int(goal[1])), self.width, self.height, bits)
        self._g.fill(np.iinfo(self._costs).max)
        return field

    def exit_path(
        self, costmap: NDArray[np.uint8], exits: NDArray[np.uint8], start: tuple[int, int]
    ) -> NDArray[np.int32] | None:
        """Return a cheapest path over `costmap` from start (column, row) to a cell that is traversable on `exits`.

        Both are uint8 (h, w); the path is int32 (n, 2) as (column, row), None without one. Raises ValueError as `plan`
        does.
        """
        costmap, exits = self._grid(costmap), self._grid(exits)
        status, cell = self._fill(costmap, self._index(start, "start"), exits.ravel())
        cells = None
        if status == _FOUND:
            count = int(_descend(costmap.ravel(), self.width, self.weight, cell, self._g, self._queue_cell))
            flat = self._queue_cell[:count][::-1]
            cells = np.stack((flat % self.width, flat // self.width), axis=1).astype(np.int32)
        self._g.fill(np.iinfo(self._costs).max)
        return cells

    def _fill(self, costmap: NDArray[np.uint8], target: int, exits: NDArray[np.uint8]) -> tuple[int, int]:
        """Write the costs to a cell into `g`, which the caller resets; return the kernel's status and exit."""
        while True:
            status, cell = _fill_field(
                costmap.ravel(),
                self.width,
                self.weight,
                target,
                exits,
                self._g,
                self._queue_cell,
                self._queue_next,
                np.empty(self._field_buckets, np.int32),
                self.bucket_shift,
            )
            if status == _OVERFLOW:
                self._widen()
            elif status == _QUEUE_FULL:
                self._capacity *= 2
                self._allocate()
            else:
                return int(status), int(cell)

    def shortcut(self, costmap: NDArray[np.uint8], cells: NDArray[np.int32]) -> NDArray[np.float64]:
        """Return `shortcut` with this planner's weights."""
        return shortcut(costmap, cells, self.neutral, self.factor)


def nearest_traversable(costmap: NDArray[np.uint8], cell: tuple[int, int], reach: int) -> tuple[int, int] | None:
    """Return the traversable (column, row) nearest to a cell within `reach` cells, or None.

    Walls in between are ignored: this is for a robot whose own cell became impassable. Raises TypeError or
    ValueError for a costmap of another type or shape.
    """
    costmap = _arrays.grid(costmap, "costmap")
    found = int(_nearest_traversable(costmap, int(cell[0]), int(cell[1]), int(reach)))
    if found < 0:
        return None
    return found % costmap.shape[1], found // costmap.shape[1]


def line_cost(
    costmap: NDArray[np.uint8],
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    neutral: int = NEUTRAL_WEIGHT,
    factor: float = COST_WEIGHT,
) -> float:
    """Return the integral of the weight along a straight line, in cells times weight.

    Coordinates are columns and rows, whole numbers being the centres of cells. Infinite when the line crosses a cell
    that isn't traversable, cuts a corner that a diagonal step may not cut, or leaves the grid.
    Raises TypeError or ValueError for a costmap of another type or shape.
    """
    costmap = _arrays.grid(costmap, "costmap")
    weight = _weights_of(neutral, factor)
    return float(_line_cost(costmap, weight, float(x0), float(y0), float(x1), float(y1), math.inf))


def polyline_cost(costmap: NDArray[np.uint8], points: NDArray[np.float64]) -> float:
    """Return the sum of `line_cost`, with the weights of the default, over the lines between points (float64 (n, 2)).

    Raises TypeError or ValueError for arrays of another type or shape.
    """
    costmap = _arrays.grid(costmap, "costmap")
    _arrays.exact(points, np.float64, 2, "points")
    if points.shape[1] != 2:
        raise ValueError(f"points must have shape (n, 2), not {points.shape}")
    return float(_polyline_cost(costmap, _DEFAULT_WEIGHTS, points))


def shortcut(
    costmap: NDArray[np.uint8],
    cells: NDArray[np.int32],
    neutral: int = NEUTRAL_WEIGHT,
    factor: float = COST_WEIGHT,
    slack: float = 0.01,
) -> NDArray[np.float64]:
    """Straighten a path along lines of sight that cost at most `1 + slack` times the section that they replace.

    `cells` is int32 (n, 2) as (column, row), a path of `Planner.plan` on this costmap. Returns float64 (m, 2) in the
    same coordinates, the first and last cell kept: corners to be joined by straight lines, none of which crosses a
    cell that isn't traversable. Raises ValueError if the path itself crosses one or isn't connected, TypeError or
    ValueError for wrong types or shapes.
    """
    costmap = _arrays.grid(costmap, "costmap")
    cells = _cells_array(cells)
    if slack < 0.0:
        raise ValueError(f"slack must not be negative, not {slack}")
    weight = _weights_of(neutral, factor)
    cumulated = np.empty(len(cells))
    if not math.isfinite(_cells_cost(costmap, weight, cells, cumulated)):
        raise ValueError("cells aren't a path on this costmap: plan again before straightening")
    kept = np.empty(len(cells), np.int64)
    count = int(_shortcut(costmap, weight, cells, cumulated, slack, kept))
    return cells[kept[:count]].astype(np.float64)
