"""The way round a closed part of the floor: a lower bound that all searches behind the closure share.

A goal field knows nothing of a hazard that came later. The cells from which a cheapest path leads through the hazard
are its *shadow*: a search guided by the field floods the whole of it before it turns round. For any set of cells A
without the goal, a path from a cell of A enters the rest of the map through one of the few border cells b of A, so

    cost(x, goal) >= min over b of (cost within A from x to b + level(b)) + min over b of (field(b) - level(b))

for any levels, if the field is a lower bound. The first term, the `Detour`, is one Dijkstra search over A and does not
depend on the goal; the second is one number for each goal. So a closure costs one search of the shadow for all robots
in it, instead of one for each robot. The bound is tight for a goal whose field differs from the levels by about the
same at every border cell that matters.

Nothing here has to be exact for a search to stay optimal: any set A gives a valid bound.
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import int64, njit, types, void

from fog_kernels import _arrays
from fog_kernels.astar import DIAGONAL, STRAIGHT
from fog_kernels.guides import TILE, TILE_BITS, Detour

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from fog_kernels.astar import Planner
    from fog_kernels.guides import GoalField

_LIT = 1
_SHADOW = 2
_BORDER = 3
_INSIDE = 4
_START = 5

_BUCKETS = 65536
_UNSET = 2147483647

_U8_OUT = types.Array(types.uint8, 1, "C")
_I64_FLAT = types.Array(types.int64, 1, "C", readonly=True)


@njit(inline="always")
def _steps(width: int) -> tuple[Any, Any, Any, Any]:
    """Return columns, rows, flat offsets and lengths of the steps to the 8 neighbours of a cell."""
    columns = np.array((1, -1, 0, 0, 1, -1, 1, -1), np.int64)
    rows = np.array((0, 0, 1, -1, 1, 1, -1, -1), np.int64)
    return columns, rows, rows * width + columns, np.where(columns * rows == 0, STRAIGHT, DIAGONAL)


@njit(inline="always")
def _cost_to_goal(lowest: Any, columns: int, slots: Any, patterns: Any, x: Any, y: Any) -> Any:
    """Return the cost of a cell in an exact field; -1 where no path leads to the goal."""
    tile = np.uint64((y >> TILE_BITS) * columns + (x >> TILE_BITS))
    last = TILE - 1
    place = (np.int64(slots[tile]) << (2 * TILE_BITS)) + ((y & last) << TILE_BITS) + (x & last)
    rise = np.int64(patterns[np.uint64(place)])
    return rise if rise < 0 or lowest[tile] < 0 else rise + np.int64(lowest[tile])


@njit(
    int64(
        _arrays.U8_FLAT, _arrays.U8_FLAT, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, _arrays.I32_FLAT,
        _arrays.I32_FLAT, _arrays.I32_FLAT, _U8_OUT, _arrays.I32_OUT,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _mark_shadow(
    costmap: Any, bound: Any, width: int, weight: Any, lowest: Any, tile_columns: int, slots: Any, patterns: Any,
    raised: Any, mark: Any, found: Any,
) -> int:  # fmt: skip
    """Mark the cells that have a cheapest path over `bound` through raised cells; return their number.

    They are found from the raised cells, against the direction of the paths, in no special order; `found` receives
    them.
    """
    height = costmap.size // width
    columns, rows, steps, lengths = _steps(width)
    count = 0
    for i in range(raised.size):
        cell: Any = np.int64(raised[i])
        if mark[np.uint64(cell)] == 0:
            mark[np.uint64(cell)] = _SHADOW
            found[np.uint64(count)] = cell
            count += 1
        if weight[costmap[np.uint64(cell)]] > 0:
            continue
        y: Any = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        for k in range(4):  # a diagonal step between these two is cut off now, too
            if not (0 <= x + columns[k] < width and 0 <= y + rows[k] < height):
                continue
            other = cell + steps[k]
            if mark[np.uint64(other)] == 0:
                mark[np.uint64(other)] = _SHADOW
                found[np.uint64(count)] = other
                count += 1
    done = 0
    while done < count:
        cell = np.int64(found[np.uint64(done)])
        done += 1
        own = np.int64(weight[bound[np.uint64(cell)]])
        if own == 0:
            continue
        y = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        cost = _cost_to_goal(lowest, tile_columns, slots, patterns, x, y)
        if cost < 0:
            continue
        within = 0 < x < width - 1 and 0 < y < height - 1
        for k in range(8):
            if not within and not (0 <= x + columns[k] < width and 0 <= y + rows[k] < height):
                continue
            other = cell + steps[k]
            if mark[np.uint64(other)] != 0:
                continue
            weight_there = np.int64(weight[bound[np.uint64(other)]])
            if weight_there == 0:
                continue
            there = _cost_to_goal(lowest, tile_columns, slots, patterns, x + columns[k], y + rows[k])
            if there != cost + lengths[k] * (own + weight_there):
                continue
            if columns[k] != 0 and rows[k] != 0:
                aside, along = np.uint64(cell + columns[k]), np.uint64(cell + steps[k] - columns[k])
                if weight[bound[aside]] == 0 or weight[bound[along]] == 0:
                    continue
            mark[np.uint64(other)] = _SHADOW
            found[np.uint64(count)] = other
            count += 1
    return count


@njit(
    void(
        _arrays.U8_FLAT, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, _U8_OUT, _arrays.I32_OUT, _arrays.I32_OUT,
        _arrays.I32_OUT, _arrays.I64_OUT,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _enclose(
    costmap: Any, width: int, weight: Any, starts: Any, mark: Any, label: Any, inside: Any, border: Any, result: Any
) -> None:
    """List the cells of the shadow that are connected with a start, and the cells where one can leave them.

    `result` receives the numbers of both; the labels of the cells inside are unset.
    """
    height = costmap.size // width
    columns, rows, steps, _ = _steps(width)
    count = 0
    leaving = 0
    for i in range(starts.size):
        cell: Any = np.int64(starts[i])
        if mark[np.uint64(cell)] == _SHADOW and weight[costmap[np.uint64(cell)]] > 0:
            mark[np.uint64(cell)] = _INSIDE
            label[np.uint64(cell)] = _UNSET
            inside[count] = cell
            count += 1
    done = 0
    while done < count:
        cell = np.int64(inside[np.uint64(done)])
        done += 1
        y: Any = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        within = 0 < x < width - 1 and 0 < y < height - 1
        for k in range(8):
            if not within and not (0 <= x + columns[k] < width and 0 <= y + rows[k] < height):
                continue
            other = cell + steps[k]
            if mark[np.uint64(other)] >= _BORDER:
                continue
            there = np.int64(weight[costmap[np.uint64(other)]])
            if there == 0:
                continue
            if columns[k] != 0 and rows[k] != 0:
                aside, along = np.uint64(cell + columns[k]), np.uint64(cell + steps[k] - columns[k])
                if weight[costmap[aside]] == 0 or weight[costmap[along]] == 0:
                    continue
            if mark[np.uint64(other)] == _SHADOW:
                mark[np.uint64(other)] = _INSIDE
                label[np.uint64(other)] = _UNSET
                inside[np.uint64(count)] = other
                count += 1
            else:
                mark[np.uint64(other)] = _BORDER
                border[np.uint64(leaving)] = other
                leaving += 1
    result[0] = count
    result[1] = leaving


@njit(
    int64(
        _arrays.U8_FLAT, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, _I64_FLAT, int64, _U8_OUT, _arrays.I32_OUT,
        _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT, int64,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _fill(
    costmap: Any, width: int, weight: Any, border: Any, levels: Any, starts: int, mark: Any, label: Any,
    queue_cell: Any, queue_next: Any, heads: Any, shift: int,
) -> int:  # fmt: skip
    """Write the lowest cost from cells inside to a border cell, plus that cell's level, until all starts have theirs.

    Return below which costs they are final; costs that are not lower are not lower in truth, either. -1 when the costs
    or the queue exceed their limits.
    """
    height = costmap.size // width
    columns, rows, steps, lengths = _steps(width)
    heads[:] = -1
    free: Any = np.int64(-1)
    used: Any = np.int64(0)
    bucket: Any = np.int64(-1)  # the border's cells come first
    ended: Any = np.int64(-1)  # the bucket in which the last start was
    i: Any = np.int64(0)
    while True:
        if i < border.size:
            cell: Any = np.int64(border[np.uint64(i)])
            here = np.int64(levels[np.uint64(i)])
            i += 1
        else:
            bucket = max(bucket, 0)
            while bucket < heads.size and heads[np.uint64(bucket)] < 0:
                bucket += 1
            if bucket == heads.size or (starts == 0 and bucket > ended):
                return int(bucket << shift)
            entry: Any = np.int64(heads[np.uint64(bucket)])
            heads[np.uint64(bucket)] = queue_next[np.uint64(entry)]
            queue_next[np.uint64(entry)] = free
            free = entry
            cell = np.int64(queue_cell[np.uint64(entry)])
            here = np.int64(label[np.uint64(cell)])
            if here >> shift != bucket:
                continue  # a stale entry: the cell was expanded from a lower bucket
            if mark[np.uint64(cell)] == _START:
                mark[np.uint64(cell)] = _INSIDE
                starts -= 1
                ended = bucket
        y: Any = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        own = np.int64(weight[costmap[np.uint64(cell)]])
        within = 0 < x < width - 1 and 0 < y < height - 1
        for k in range(8):
            if not within and not (0 <= x + columns[k] < width and 0 <= y + rows[k] < height):
                continue
            other = cell + steps[k]
            known = np.int64(label[np.uint64(other)])
            if known <= here:
                continue  # final, or outside
            there = np.int64(weight[costmap[np.uint64(other)]])
            reached = here + lengths[k] * (own + there)
            if reached >= known or there == 0:
                continue
            if columns[k] != 0 and rows[k] != 0:
                aside, along = np.uint64(cell + columns[k]), np.uint64(cell + steps[k] - columns[k])
                if weight[costmap[aside]] == 0 or weight[costmap[along]] == 0:
                    continue
            slot = reached >> shift
            if slot >= heads.size:
                return -1
            label[np.uint64(other)] = reached
            if free >= 0:
                entry = free
                free = np.int64(queue_next[np.uint64(entry)])
            elif used < queue_cell.size:
                entry = used
                used += 1
            else:
                return -1
            queue_cell[np.uint64(entry)] = other
            queue_next[np.uint64(entry)] = heads[np.uint64(slot)]
            heads[np.uint64(slot)] = entry


class Shadow:
    """The part of the floor around the starts from which a cheapest path to a goal led through raised cells.

    Where several paths cost the same, one of them is enough: so its cells are found from the raised ones, in any order.
    """

    def __init__(
        self,
        costmap: NDArray[np.uint8],
        bound: NDArray[np.uint8],
        field: GoalField,
        starts: Iterable[tuple[int, int]],
        planner: Planner,
    ) -> None:
        """Find it on a uint8 (h, w) costmap; `field` is an exact one over the costmap `bound`.

        Takes some 25 ns for each of its cells. Raises ValueError for a field that is not exact.
        """
        if not field.exact:
            raise ValueError(f"the field of goal {field.goal} has one cost for several cells: pass an exact one")
        self._costmap = _arrays.grid(costmap, "costmap")
        self._planner = planner
        size = costmap.size
        self._mark = np.zeros(size, np.uint8)
        self._label, self._memory = np.zeros(size, np.int32), np.empty((2, size), np.int32)
        cells, border = self._memory  # later those of the search's queue
        bound = _arrays.grid(bound, "bound")
        raised = np.flatnonzero((costmap > bound).ravel()).astype(np.int32)
        flat, width, weight = costmap.ravel(), planner.width, planner.weight
        goal = field.goal[1] * width + field.goal[0]
        if weight[flat[goal]] > 0:
            self._mark[goal] = _LIT  # raised or not, nothing lies behind it
        _mark_shadow(
            flat, bound.ravel(), width, weight, field.lowest.ravel(), field.lowest.shape[1], field.slots.ravel(),
            field.patterns.ravel(), raised, self._mark, cells,
        )  # fmt: skip
        first = np.array([row * width + column for column, row in starts], np.int32)
        result = np.empty(2, np.int64)
        _enclose(flat, width, weight, first, self._mark, self._label, cells, border, result)
        leaving = int(result[1])
        self._starts = np.unique(first[self._mark[first] == _INSIDE])
        self.border = border[:leaving].copy()
        """The flat indexes of the cells through which every path leaves it."""

    def contains(self, cell: tuple[int, int]) -> bool:
        """Whether a cell (column, row) is part of it."""
        return bool(self._mark[cell[1] * self._planner.width + cell[0]] >= _INSIDE)

    def detour(self, levels: NDArray[np.int64]) -> Detour | None:
        """Return the bound that begins with a level at each border cell, in full for cells as near to it as the starts.

        Call it once: the bound takes over the memory. None when nothing leads out of the shadow, or when costs exceed
        32 bits. Takes some 50 ns for each cell.
        """
        if len(self.border) == 0:
            return None
        planner, label, memory = self._planner, self._label, self._memory
        levels = levels - levels.min()
        self._mark[self._starts] = _START
        heads = np.empty(_BUCKETS, np.int32)
        highest = int(
            _fill(
                self._costmap.ravel(), planner.width, planner.weight, self.border, levels, len(self._starts),
                self._mark, label, memory[0], memory[1], heads, planner.bucket_shift,
            )
        )  # fmt: skip
        return None if highest < 0 else Detour(label.reshape(self._costmap.shape), highest, self.border, levels)
