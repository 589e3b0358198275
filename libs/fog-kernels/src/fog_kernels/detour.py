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

One module, although long: its kernels inline the same steps, and only together give a bound.
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import int64, njit, types, void

from fog_kernels import _arrays
from fog_kernels.dead_ends import NEAR_GATE
from fog_kernels.guides import NO_PATH, TILE, TILE_BITS, Detour
from fog_kernels.steps import DIAGONAL, SEALED, STRAIGHT

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from fog_kernels.astar import Planner
    from fog_kernels.dead_ends import DeadEnds, SealedEnds
    from fog_kernels.guides import GoalField

_SHADOW = 1 << 30
"""Labels from here on belong to cells of the shadow without a cost; what is added is the number of their group."""
_CANDIDATE = 1
"""The label of a cell beside the shadow."""
_MOST_GROUPS = 24
"""How many groups one raised cell can begin at most: it, its 8 neighbours, and steps that it cuts off."""
_COMPARED: Final = 512
"""How many cells of two costmaps are compared at once: most of a closed floor is as it was."""

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
    least = np.int64(lowest[tile])
    return least + rise if least >= 0 and rise >= 0 else np.int64(NO_PATH)


@njit(inline="always")
def _may_step(costmap: Any, weight: Any, cell: Any, column: Any, step: Any) -> bool:
    """Whether a step between two cells that are traversable themselves cuts no corner."""
    row = step - column
    if column == 0 or row == 0:
        return True
    return bool(weight[costmap[np.uint64(cell + column)]] > 0 and weight[costmap[np.uint64(cell + row)]] > 0)


@njit(inline="always")
def _root(groups: Any, number: Any) -> Any:
    """Return the group to which a group was joined, and shorten the way there."""
    while groups[np.uint64(number)] != number:
        above = np.int64(groups[np.uint64(number)])
        groups[np.uint64(number)] = groups[np.uint64(above)]
        number = above
    return number


@njit(int64(_arrays.U8_FLAT, _arrays.U8_FLAT, _arrays.I32_OUT), cache=True, nogil=True, error_model="numpy")
def _find_raised(costmap: Any, bound: Any, found: Any) -> int:
    """Write the cells whose cost is above the bound, in their order; return their number."""
    count: Any = np.int64(0)
    for begin in range(0, costmap.size, _COMPARED):
        costs, least = costmap[begin : begin + _COMPARED], bound[begin : begin + _COMPARED]
        differs = False
        for i in range(costs.size):
            differs |= costs[i] > least[i]
        if not differs:
            continue
        for i in range(costs.size):
            if costs[i] > least[i]:
                found[np.uint64(count)] = begin + i
                count += 1
    return int(count)


_mark_signature = types.UniTuple(int64, 3)(  # type: ignore[no-untyped-call]  # numba has no types
    _arrays.U8_FLAT, _arrays.U8_FLAT, int64, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, _arrays.I32_FLAT,
    _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT,
)  # fmt: skip


@njit(_mark_signature, cache=True, nogil=True, error_model="numpy")
def _mark_shadow(
    costmap: Any, bound: Any, width: int, goal: int, weight: Any, lowest: Any, tile_columns: int, slots: Any,
    patterns: Any, raised: Any, label: Any, found: Any, beside: Any, groups: Any,
) -> tuple[int, int, int]:  # fmt: skip
    """Label the cells that have a cheapest path over `bound` through raised cells; return their number.

    So are all cells beside them that are labelled `NEAR_GATE`: they are no way out, whatever their costs promise. Cells
    that are labelled `SEALED` stay so.

    They are found from the raised cells, against the direction of the paths, in no special order; `found` receives
    them, `beside` the cells next to them, whose number is returned, too, and then that of the groups. Cells that a step
    on `costmap` joins get the same group, as `_root` tells it. `goal` is never labelled.
    """
    height = costmap.size // width
    columns, rows, steps, lengths = _steps(width)
    count = 0
    n_beside = 0
    n_groups: Any = np.int64(0)
    for i in range(raised.size):
        cell: Any = np.int64(raised[i])
        if cell == goal or label[np.uint64(cell)] == SEALED:
            continue
        if label[np.uint64(cell)] < _SHADOW:
            label[np.uint64(cell)] = _SHADOW + n_groups
            groups[np.uint64(n_groups)] = n_groups
            n_groups += 1
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
            if label[np.uint64(other)] < _SHADOW and label[np.uint64(other)] != SEALED and other != goal:
                label[np.uint64(other)] = _SHADOW + n_groups
                groups[np.uint64(n_groups)] = n_groups
                n_groups += 1
                found[np.uint64(count)] = other
                count += 1
    done = 0
    while done < count:
        cell = np.int64(found[np.uint64(done)])
        done += 1
        own_label = np.int64(label[np.uint64(cell)])
        own = np.int64(weight[bound[np.uint64(cell)]])
        if own == 0:
            continue
        y = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        cost = _cost_to_goal(lowest, tile_columns, slots, patterns, x, y)
        passable = weight[costmap[np.uint64(cell)]] > 0
        within = 0 < x < width - 1 and 0 < y < height - 1
        for k in range(8):
            if not within and not (0 <= x + columns[k] < width and 0 <= y + rows[k] < height):
                continue
            other = cell + steps[k]
            known = np.int64(label[np.uint64(other)])
            if known in (own_label, SEALED):
                continue
            if known >= _SHADOW:
                if not passable or weight[costmap[np.uint64(other)]] == 0:
                    continue
                first, second = _root(groups, own_label - _SHADOW), _root(groups, known - _SHADOW)
                if first != second and _may_step(costmap, weight, cell, columns[k], steps[k]):
                    groups[np.uint64(max(first, second))] = min(first, second)
                continue
            there = _cost_to_goal(lowest, tile_columns, slots, patterns, x + columns[k], y + rows[k])
            if there < 0 <= cost:
                continue  # no step leads there
            if there > cost >= 0 or known == NEAR_GATE:
                there_weight = np.int64(weight[bound[np.uint64(other)]])
                follows = known == NEAR_GATE or there == cost + lengths[k] * (own + there_weight)
                if follows and there_weight > 0 and _may_step(bound, weight, cell, columns[k], steps[k]):
                    if passable and _may_step(costmap, weight, cell, columns[k], steps[k]):
                        label[np.uint64(other)] = own_label
                    else:
                        label[np.uint64(other)] = _SHADOW + n_groups
                        groups[np.uint64(n_groups)] = n_groups
                        n_groups += 1
                    found[np.uint64(count)] = other
                    count += 1
                    continue
            if known == 0:
                label[np.uint64(other)] = _CANDIDATE
                beside[np.uint64(n_beside)] = other
                n_beside += 1
    return count, n_beside, n_groups


@njit(
    int64(
        _arrays.U8_FLAT, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT,
        _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _enclose(
    costmap: Any, width: int, weight: Any, starts: Any, found: Any, beside: Any, label: Any, groups: Any, border: Any
) -> int:
    """Unlabel what is not connected with a start; list where one can leave the rest, and return the number of cells."""
    height = costmap.size // width
    columns, rows, steps, _ = _steps(width)
    behind = np.zeros(groups.size, np.bool_)
    for i in range(starts.size):
        known = np.int64(label[np.uint64(starts[i])])
        if known >= _SHADOW and weight[costmap[np.uint64(starts[i])]] > 0:
            behind[np.uint64(_root(groups, known - _SHADOW))] = True
    for i in range(groups.size):
        behind[i] = behind[np.uint64(_root(groups, np.int64(i)))]
    for i in range(found.size):
        cell: Any = np.uint64(found[i])
        if not behind[np.uint64(np.int64(label[cell]) - _SHADOW)]:
            label[cell] = 0
    leaving = 0
    for i in range(beside.size):
        cell = np.int64(beside[i])
        if label[np.uint64(cell)] != _CANDIDATE:
            continue
        label[np.uint64(cell)] = 0
        if weight[costmap[np.uint64(cell)]] == 0:
            continue
        y: Any = np.int64(np.uint32(cell) // np.uint32(width))
        x = cell - y * width
        for k in range(8):
            if not (0 <= x + columns[k] < width and 0 <= y + rows[k] < height):
                continue
            other = cell + steps[k]
            if label[np.uint64(other)] < _SHADOW or weight[costmap[np.uint64(other)]] == 0:
                continue
            if _may_step(costmap, weight, cell, columns[k], steps[k]):
                border[np.uint64(leaving)] = cell
                leaving += 1
                break
    return leaving


@njit(
    int64(
        _arrays.U8_FLAT, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, _I64_FLAT, _arrays.I32_FLAT, _arrays.I32_OUT,
        _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT, int64,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _fill(
    costmap: Any, width: int, weight: Any, border: Any, levels: Any, starts: Any, label: Any,
    queue_cell: Any, queue_next: Any, heads: Any, shift: int,
) -> int:  # fmt: skip
    """Write the lowest cost from labelled cells to a border cell, plus that cell's level, until all starts have theirs.

    Return below which costs they are final; costs that are not lower are not lower in truth, either. -1 when the costs
    or the queue exceed their limits.
    """
    height = costmap.size // width
    _, _, steps, lengths = _steps(width)
    around = np.empty(8, np.int64)
    heads[:] = -1
    free: Any = np.int64(-1)
    used: Any = np.int64(0)
    bucket: Any = np.int64(-1)  # the border's cells come first
    waiting = starts.size
    i: Any = np.int64(0)
    while True:
        if i < border.size:
            cell: Any = np.int64(border[np.uint64(i)])
            here = np.int64(levels[np.uint64(i)])
            i += 1
        else:
            if bucket < 0 or heads[np.uint64(bucket)] < 0:
                bucket = max(bucket, 0)
                while bucket < heads.size and heads[np.uint64(bucket)] < 0:
                    bucket += 1
                while waiting > 0 and np.int64(label[np.uint64(starts[waiting - 1])]) < bucket << shift:
                    waiting -= 1
                if bucket == heads.size or (waiting == 0 and starts.size > 0):
                    return int(bucket << shift)
            entry: Any = np.int64(heads[np.uint64(bucket)])
            heads[np.uint64(bucket)] = queue_next[np.uint64(entry)]
            queue_next[np.uint64(entry)] = free
            free = entry
            cell = np.int64(queue_cell[np.uint64(entry)])
            here = np.int64(label[np.uint64(cell)])
            if here >> shift != bucket:
                continue  # a stale entry: the cell was expanded from a lower bucket
        y: Any = np.int64(np.uint32(cell) // np.uint32(width))
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
            there = around[k]
            if there == 0:
                continue
            other = cell + steps[k]
            reached = here + lengths[k] * (own + there)
            if reached >= label[np.uint64(other)]:
                continue  # no better; or outside, where labels are not above 0
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


@njit(void(types.Array(types.int64, 2, "C", readonly=True), int64, _arrays.I64_OUT), cache=True, nogil=True)
def _compare_levels(costs: Any, own: int, gains: Any) -> None:
    """Write what `compare_levels` returns."""
    for i in range(costs.shape[0]):
        levels = costs[i]
        total = np.int64(0)
        for j in range(costs.shape[0]):
            goal = costs[j]
            least = goal[0] - levels[0]
            for k in range(levels.size):
                least = min(least, goal[k] - levels[k])
            total += least
        first = costs[own]
        least = levels[0] - first[0]
        for k in range(levels.size):
            least = min(least, levels[k] - first[k])
        gains[i] = total + costs.shape[0] * least


def compare_levels(costs: NDArray[np.int64], own: int) -> NDArray[np.int64]:
    """Return how high the bounds of all goals are in sum, at least, if they begin with the levels of each goal in turn.

    `costs` is int64 (goals, cells), each goal's cost at the cells of a border, `own` the row of the goal whose cheapest
    way out is known. A cell's way to the border is not below that row's cheapest one minus its cost there, so the sum
    for the levels of row r is, but for the same number in all,

        sum over rows i of (min over cells of costs[i] - costs[r]) + rows * (min over cells of costs[r] - costs[own]).

    Raises TypeError or ValueError for another array, or one without a cell, or a row that it does not have.
    """
    _arrays.exact(costs, np.int64, 2, "costs")
    if costs.size == 0 or not 0 <= own < len(costs):
        raise ValueError(f"costs must have cells and row {own}, not shape {costs.shape}")
    gains = np.empty(len(costs), np.int64)
    _compare_levels(costs, own, gains)
    return gains


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
        dead_ends: DeadEnds | None = None,
        goals: Iterable[tuple[int, int]] = (),
        label: NDArray[np.int32] | None = None,
    ) -> None:
        """Find it on a uint8 (h, w) costmap; `field` is an exact one over the costmap `bound`.

        The `dead_ends`, which were found on `bound`, are left out, but for those with a start or one of the `goals`.
        Takes some 15 ns for each of its cells, in the planner's memory. `label`: zeros, int32 (height * width,), which
        the shadow takes over; fresh memory can cost more time than all the rest. Raises ValueError for a field that is
        not exact, and TypeError or ValueError for a costmap, bound or labels of another type or shape.
        """
        if not field.exact:
            raise ValueError(f"the field of goal {field.goal} has one cost for several cells: pass an exact one")
        self._costmap = _arrays.grid(costmap, "costmap")
        self._planner = planner
        bound = _arrays.grid(bound, "bound")
        if not costmap.shape == bound.shape == (planner.height, planner.width):
            expected = (planner.height, planner.width)
            raise ValueError(
                f"costmap and bound must have the planner's shape {expected}, not {costmap.shape} and {bound.shape}"
            )
        flat, width, weight = costmap.ravel(), planner.width, planner.weight
        found, beside, groups = planner.scratch
        raised = beside[: int(_find_raised(flat, bound.ravel(), beside))].copy()
        goal = field.goal[1] * width + field.goal[0]
        first = np.unique(np.array([row * width + column for column, row in starts], np.int32))
        self._label = np.zeros(costmap.size, np.int32) if label is None else label
        _arrays.exact(self._label, np.int32, 1, "label")
        if self._label.size != costmap.size:
            raise ValueError(f"label must have one number for each of the {costmap.size} cells, not {self._label.size}")
        self._sealed: SealedEnds | None = None
        if dead_ends is not None:
            last = np.array([row * width + column for column, row in (field.goal, *goals)], np.int32)
            self._sealed = dead_ends.seal(costmap, raised, np.concatenate((first, last)))
            self._sealed.paint(self._label)
        groups = groups[: min(costmap.size, _MOST_GROUPS * (len(raised) + 1))]
        count, candidates, n_groups = _mark_shadow(
            flat, bound.ravel(), width, goal if weight[flat[goal]] > 0 else -1, weight, field.lowest.ravel(),
            field.lowest.shape[1], field.slots.ravel(), field.patterns.ravel(), raised, self._label, found, beside,
            groups,
        )  # fmt: skip
        border = np.empty(candidates, np.int32)
        leaving = int(
            _enclose(
                flat, width, weight, first, found[:count], beside[:candidates], self._label, groups[:n_groups], border
            )
        )
        self._starts = first[(self._label[first] >= _SHADOW) & (weight[flat[first]] > 0)]
        self.border = border[:leaving].copy()
        """The flat indexes of the cells through which every path leaves it."""

    def contains(self, cell: tuple[int, int]) -> bool:
        """Whether a cell (column, row) is part of it."""
        index = cell[1] * self._planner.width + cell[0]
        return bool(self._label[index] > 0 and self._planner.weight[self._costmap.ravel()[index]] > 0)

    def detour(self, levels: NDArray[np.int64]) -> Detour | None:
        """Return the bound that begins with a level at each border cell, in full for cells as near to it as the starts.

        Call it once: the bound takes over the labels. None when nothing leads out of the shadow, or when costs exceed
        30 bits. Takes some 30 ns for each cell.
        """
        if len(self.border) == 0:
            return None
        planner, label = self._planner, self._label
        levels = levels - levels.min()
        queue_cell, queue_next, _ = planner.scratch
        heads = np.empty(_SHADOW >> planner.bucket_shift, np.int32)
        highest = int(
            _fill(
                self._costmap.ravel(), planner.width, planner.weight, self.border, levels, self._starts, label,
                queue_cell, queue_next, heads, planner.bucket_shift,
            )
        )  # fmt: skip
        if highest < 0:
            return None
        return Detour(label.reshape(self._costmap.shape), highest, self.border, levels, self._sealed)
