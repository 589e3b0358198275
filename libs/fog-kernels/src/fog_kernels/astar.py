"""Shortest paths on costmaps: exact A* with integer costs (`steps`), and replanning with a goal field.

Methods: A* (Hart, Nilsson and Raphael 1968) on a circular bucket queue (Dial 1969). A bucket spans several costs, so a
cell is expanded again when a cheaper path to it appears; the search ends only when no open cell can lead to a cheaper
path. An entry is never put into a bucket below the current one (pathmax, Mero 1984), nor beyond the last: the search is
exact for every heuristic that never overestimates, also for the rounded one of a goal field.

Long, because the search is one kernel: a call per cell would cost more than its work.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import int64, njit, types, void

from fog_contracts.costs import COST_WEIGHT, INSCRIBED, NEUTRAL_WEIGHT
from fog_kernels import _arrays
from fog_kernels.flood import descend, fill_field
from fog_kernels.guides import TILE, TILE_BITS, GoalField, fill_tile
from fog_kernels.lines import leaves, line_cost, raised_near, shortcut
from fog_kernels.steps import DIAGONAL, FOUND, NOT_FOUND, OVERFLOW, QUEUE_FULL, SEALED, STRAIGHT, TIMED_OUT, weights_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.guides import Detour
    from fog_kernels.landmarks import Landmarks
    from fog_kernels.tiles import TilePatterns

    _Cells = NDArray[np.int32]
    _Guides = tuple[
        _Cells, int, int, int, _Cells, _Cells, _Cells, int, int,
        _Cells, _Cells, _Cells, _Cells, _Cells, _Cells, _Cells, int,
    ]  # fmt: skip

BUCKETS = 1024  # heads fit the first-level cache; a power of two

BESIDE: Final = 10
"""Within so many cells of a path another one is made dearer ..."""
DEARER: Final = 2
"""... by this cost, 3 % of a free cell's weight: 8 directions can let a cheaper way seem so much dearer."""
WAYS: Final = 3
"""Of so many paths the cheapest one is taken at most."""

type_scratch = _arrays.I32_OUT


@njit(
    int64(
        _arrays.U8_FLAT, int64, _arrays.I32_FLAT, int64, int64, int64, _arrays.I32_FLAT, int64, _arrays.I32_FLAT,
        _arrays.I32_FLAT, _arrays.I32_FLAT, int64, int64, int64, type_scratch,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _walk(
    costmap: Any, width: int, weight: Any, start: int, goal: int, cost: int, lowest: Any, field_width: int, slots: Any,
    patterns: Any, detour: Any, detour_highest: int, detour_offset: int, most: int, path: Any,
) -> int:  # fmt: skip
    """Write a path of steps that cost as much as the bound of the rest falls, goal first; return its number of cells.

    It costs what the bound, `cost`, is at the start, so none is cheaper. 0 if it gets no farther somewhere, or within
    `most` steps (0: no limit): then only a search tells.
    """
    height = costmap.size // width
    last = TILE - 1
    columns = np.array((1, -1, 0, 0, 1, -1, 1, -1), np.int64)
    rows = np.array((0, 0, 1, -1, 1, 1, -1, -1), np.int64)
    cell: Any = np.int64(start)
    y: Any = cell // width
    x: Any = cell - y * width
    left: Any = np.int64(cost)
    count: Any = np.int64(0)
    direction: Any = np.int64(0)
    path[0] = start
    while cell != goal and (most == 0 or count < most) and count + 1 < path.size:
        own = np.int64(weight[costmap[np.uint64(cell)]])
        before = count
        for turn in range(-1, 8):  # as before, if that is possible
            k = direction if turn < 0 else np.int64(turn)
            nx = x + columns[k]
            ny = y + rows[k]
            if nx < 0 or nx >= width or ny < 0 or ny >= height:
                continue
            other = ny * width + nx
            there = np.int64(weight[costmap[np.uint64(other)]])
            block = np.uint64((ny >> TILE_BITS) * field_width + (nx >> TILE_BITS))
            remaining: Any = np.int64(lowest[block])
            if there == 0 or remaining < 0:
                continue
            place = (np.int64(slots[block]) << (2 * TILE_BITS)) + ((ny & last) << TILE_BITS) + (nx & last)
            rise = np.int64(patterns[np.uint64(place)])
            bound: Any = np.int64(detour[np.uint64(other)]) if detour.size > 0 else np.int64(0)
            if rise < 0 or bound == SEALED:
                continue
            remaining += rise
            if bound > 0:
                remaining = max(remaining, min(bound, detour_highest) + detour_offset)
            if remaining + (STRAIGHT if k < 4 else DIAGONAL) * (own + there) != left:
                continue
            if k >= 4 and (
                weight[costmap[np.uint64(cell + columns[k])]] == 0
                or weight[costmap[np.uint64(other - columns[k])]] == 0
            ):
                continue
            direction, x, y, cell, left = k, nx, ny, other, remaining
            count += 1
            path[np.uint64(count)] = cell
            break
        if count == before:
            return 0
    if cell != goal or left != 0:
        return 0
    for i in range((count + 1) // 2):
        path[i], path[count - i] = path[count - i], path[i]
    return int(count + 1)


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
        _arrays.I32_FLAT,  # landmark_lowest
        _arrays.I32_FLAT,  # landmark_slots
        _arrays.I32_FLAT,  # landmark_patterns
        _arrays.I32_FLAT,  # chosen
        _arrays.I32_FLAT,  # own
        _arrays.I32_OUT,  # bounds
        _arrays.I32_OUT,  # filled
        int64,  # number
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
    landmark_lowest: Any,
    landmark_slots: Any,
    landmark_patterns: Any,
    chosen: Any,
    own_costs: Any,
    bounds: Any,
    filled: Any,
    number: int,
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

    With landmarks, `bounds` is `patterns`, and the rows of the tiles that this search, by its `number`, has not entered
    yet in `filled` are written when it does. Where the bound of the rest is exact all along, a walk takes its place.
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
    use_landmarks = chosen.size > 0
    goal_x = goal % width
    goal_y = goal // width
    last = TILE - 1
    cheapest = 2 * np.int64(weight[0])
    step_straight = STRAIGHT * cheapest
    step_extra = (DIAGONAL - STRAIGHT) * cheapest

    result[0] = NOT_FOUND
    result[1] = 0
    result[2] = 0
    result[3] = 0
    if weight[costmap[start]] == 0 or weight[costmap[goal]] == 0:
        return
    if start == goal:
        queue_cell[0] = start
        result[0] = FOUND
        result[2] = 1
        return
    y: Any = start // width
    x: Any = start % width
    if use_field:
        block = np.uint64((y >> field_bits) * field_width + (x >> field_bits))
        if use_landmarks and filled[block] != number:
            filled[block] = number
            fill_tile(
                np.int64(block), field_width, goal_x, goal_y, step_straight, step_extra,
                landmark_lowest, landmark_slots, landmark_patterns, chosen, own_costs, bounds,
            )  # fmt: skip
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
        if use_patterns and field_unit == 1 and not use_landmarks:
            cells = _walk(
                costmap, width, weight, start, goal, remaining, lowest, field_width, slots, patterns, detour,
                detour_highest, detour_offset, max_expansions, queue_cell,
            )  # fmt: skip
            if cells > 0:
                result[0] = FOUND
                result[1] = remaining
                result[2] = cells
                result[3] = cells - 1
                return
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
    status = NOT_FOUND

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
            status = TIMED_OUT
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
                    status = OVERFLOW
                    break
                continue
            nx = x + columns[k]
            ny = y + rows[k]
            if use_field:
                block = np.uint64((ny >> field_bits) * field_width + (nx >> field_bits))
                if use_landmarks and filled[block] != number:
                    filled[block] = number
                    fill_tile(
                        np.int64(block), field_width, goal_x, goal_y, step_straight, step_extra,
                        landmark_lowest, landmark_slots, landmark_patterns, chosen, own_costs, bounds,
                    )  # fmt: skip
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
                    if bound == SEALED:
                        continue
                    if bound > 0:
                        remaining = max(remaining, min(bound, detour_highest) + detour_offset)
            else:
                dx = abs(nx - goal_x)
                dy = abs(ny - goal_y)
                remaining = step_straight * max(dx, dy) + step_extra * min(dx, dy)
            f = reached + remaining
            if f >= highest:
                status = OVERFLOW
                break
            if f >= best:
                continue
            if first_reached:
                reached_cells[n_reached] = neighbour
                n_reached += 1
            g[np.uint64(neighbour)] = reached
            if neighbour == goal:
                best = reached
                status = FOUND
                continue
            if free >= 0:
                entry = free
                free = np.int64(queue_next[np.uint64(entry)])
            elif used < capacity:
                entry = used
                used += 1
            else:
                status = QUEUE_FULL
                break
            slot = min(max(f >> shift, bucket), bucket + mask) & mask
            queue_cell[np.uint64(entry)] = neighbour
            queue_next[np.uint64(entry)] = heads[np.uint64(slot)]
            heads[np.uint64(slot)] = entry
            queued += 1
        if status in (OVERFLOW, QUEUE_FULL):
            break

    if status == FOUND:
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


# It keeps the GIL: it takes some microseconds, and another thread may keep the GIL for longer before it gives it back.
@njit(void(_arrays.I32_FLAT, int64, _arrays.I32_GRID_OUT), cache=True, error_model="numpy")
def _write_path(flat: Any, width: int, cells: Any) -> None:
    """Write the columns and rows of a path whose cells are given by flat indexes, the last one first."""
    last = cells.shape[0] - 1
    for i in range(cells.shape[0]):
        cell = np.uint32(flat[last - i])
        row = cell // np.uint32(width)
        cells[i, 0] = cell - row * np.uint32(width)
        cells[i, 1] = row


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


_NO_GUIDE: NDArray[np.int32] = np.empty(0, np.int32)
_NO_CELLS: NDArray[np.int32] = np.empty(0, np.int32)
_NO_EXITS: NDArray[np.uint8] = np.empty(0, np.uint8)


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
        self.weight = weights_of(neutral, factor)
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
        self._bounds = self._filled = self._level = self._tiles = _NO_GUIDE
        self._number = 0

    def _allocate(self) -> None:
        # np.empty only reserves memory; pages that no search uses cost none. g must be initialized.
        self._g: NDArray[np.int32 | np.int64] = np.full(
            self.width * self.height, np.iinfo(self._costs).max, self._costs
        )
        self._queue_cell = np.empty(self._capacity, np.int32)
        self._queue_next = np.empty(self._capacity, np.int32)

    @property
    def scratch(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Three arrays of at least width x height numbers, for other kernels to use between two searches."""
        return self._queue_cell, self._queue_next, self._reached_cells

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
        landmarks: Landmarks | None = None,
    ) -> PlanResult:
        """Return a cheapest path from start to goal, both (column, row), on a uint8 (h, w) costmap.

        The goal's field, if given, guides the search, which stays exact as long as no cell of the costmap is lower than
        in the costmap of the field; so does the detour, which counts with a field only, for a goal outside its part of
        the floor. Without a field, landmarks guide it, on the same condition. `max_expansions` above 0 limits the work.
        A start or goal that isn't traversable gives `found=False`. Raises ValueError for cells outside, for a costmap
        of another shape, for landmarks of another, and for a field of
        another goal or shape.
        """
        costmap = self._grid(costmap)
        first = self._index(start, "start")
        last = self._index(goal, "goal")
        here, there = (int(start[0]), int(start[1])), (int(goal[0]), int(goal[1]))
        guides = self._guides(here, there, field, detour, landmarks)
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
            if status == OVERFLOW:
                self._widen()
            elif status == QUEUE_FULL:
                self._capacity *= 2
                self._allocate()
            else:
                break
        if status != FOUND:
            return PlanResult(
                found=False,
                cost=math.inf,
                cells=np.empty((0, 2), np.int32),
                expansions=expansions,
                timed_out=status == TIMED_OUT,
            )
        cells = np.empty((length, 2), np.int32)
        _write_path(self._queue_cell, self.width, cells)
        return PlanResult(found=True, cost=cost / (2.0 * STRAIGHT), cells=cells, expansions=expansions)

    def _guides(
        self,
        start: tuple[int, int],
        goal: tuple[int, int],
        field: GoalField | None,
        detour: Detour | None,
        landmarks: Landmarks | None,
    ) -> _Guides:
        """Return the kernel's arguments for what guides it; raises ValueError for a field of another goal or map."""
        no_landmarks = _NO_GUIDE, _NO_GUIDE, _NO_GUIDE, _NO_GUIDE, _NO_GUIDE, _NO_CELLS, _NO_CELLS, 0
        if field is None:
            if landmarks is not None and self._costs is np.int32:
                return self._landmark_guides(start, goal, landmarks)
            return _NO_GUIDE, 0, 0, 0, _NO_GUIDE, _NO_GUIDE, _NO_GUIDE, 0, 0, *no_landmarks
        if field.goal != goal or (field.width, field.height) != (self.width, self.height):
            size = f"{field.width} x {field.height}"
            raise ValueError(f"the field is of goal {field.goal} on {size} cells: pass that of this goal and map")
        around, highest, offset = _NO_GUIDE, 0, None
        if detour is not None and (offset := detour.offset(field)) is not None:
            around, highest = detour.costs.ravel(), detour.highest
        return (
            field.lowest.ravel(), field.lowest.shape[1], field.bits, field.unit, field.slots.ravel(),
            field.patterns.ravel(), around, highest, offset or 0, *no_landmarks,
        )  # fmt: skip

    def _landmark_guides(self, start: tuple[int, int], goal: tuple[int, int], landmarks: Landmarks) -> _Guides:
        if (landmarks.width, landmarks.height) != (self.width, self.height):
            size = f"{landmarks.width} x {landmarks.height}"
            raise ValueError(f"the landmarks are on {size} cells: pass those of this map")
        tiles = landmarks.lowest.shape[1]
        if self._bounds.size == 0:
            self._bounds = np.empty(tiles * TILE * TILE, np.int32)
            self._filled = np.zeros(tiles, np.int32)
            self._level, self._tiles = np.zeros(tiles, np.int32), np.arange(tiles, dtype=np.int32)
        self._number += 1
        chosen, own = landmarks.best(start, goal)
        if chosen.size == 0:
            return self._guides(start, goal, None, None, None)
        return (
            self._level, landmarks.columns, TILE_BITS, 1, self._tiles, self._bounds, _NO_GUIDE, 0, 0,
            landmarks.lowest.ravel(), landmarks.slots.ravel(), landmarks.patterns.ravel(), chosen, own,
            self._bounds, self._filled, self._number,
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
        if status == FOUND:
            count = int(descend(costmap.ravel(), self.width, self.weight, cell, self._g, self._queue_cell))
            flat = self._queue_cell[:count][::-1]
            cells = np.stack((flat % self.width, flat // self.width), axis=1).astype(np.int32)
        self._g.fill(np.iinfo(self._costs).max)
        return cells

    def _fill(self, costmap: NDArray[np.uint8], target: int, exits: NDArray[np.uint8]) -> tuple[int, int]:
        """Write the costs to a cell into `g`, which the caller resets; return the kernel's status and exit."""
        while True:
            status, cell = fill_field(
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
            if status == OVERFLOW:
                self._widen()
            elif status == QUEUE_FULL:
                self._capacity *= 2
                self._allocate()
            else:
                return int(status), int(cell)

    def shortcut(
        self, costmap: NDArray[np.uint8], cells: NDArray[np.int32], *, relax: bool = True
    ) -> NDArray[np.float64]:
        """Return `shortcut` with this planner's weights."""
        return shortcut(costmap, cells, self.neutral, self.factor, relax=relax)

    def straightened(
        self,
        costmap: NDArray[np.uint8],
        cells: NDArray[np.int32],
        max_expansions: int = 0,
        field: GoalField | None = None,
        landmarks: Landmarks | None = None,
    ) -> NDArray[np.float64]:
        """Return the `shortcut` of a path or, where its lines cost less, of another one that avoids the first.

        In 8 directions the cheapest path may pass things on the side that is dearer for straight lines. Where the
        second path is another way, there may be a third one, which the second hides: it avoids both. The arguments are
        those of `plan`, and guide these searches, from the first cell to the last one; `max_expansions` limits them
        together. Raises as `shortcut` and `plan` do.
        """
        lines, raised = [self.shortcut(costmap, cells)], costmap
        (x, y), (goal_x, goal_y) = cells[0].tolist(), cells[-1].tolist()
        left = max_expansions
        while len(lines) < WAYS:
            raised = raised_near(raised, cells, BESIDE, DEARER)
            found = self.plan(raised, (x, y), (goal_x, goal_y), left, field, None, landmarks)
            if not found.found:
                break
            cells = found.cells
            lines.append(self.shortcut(costmap, cells))
            if not leaves(lines[-1], lines[0], 2.0 * BESIDE, 0.5 * BESIDE) or 0 < left <= found.expansions:
                break
            left -= found.expansions if left > 0 else 0
        return min(lines, key=lambda line: self._cost(costmap, line))

    def _cost(self, costmap: NDArray[np.uint8], corners: NDArray[np.float64]) -> float:
        lines = pairwise(corners.tolist())
        costs = [line_cost(costmap, x, y, to_x, to_y, self.neutral, self.factor) for (x, y), (to_x, to_y) in lines]
        return sum(costs, 0.0)


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
