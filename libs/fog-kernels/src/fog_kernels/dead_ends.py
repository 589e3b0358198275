"""Dead ends of a floor: rooms that no cheapest path between two places outside of them passes through.

A run (`fog_kernels.components`) is a *gate* if every path between what is behind it and the rest of the floor crosses
it: an articulation point of the graph of runs (Tarjan 1972). A doorway is one, in the rows or in the columns. Who goes
through a gate and back can as well go along it, which costs at most S, the cost from one of its ends to the other. So
a cheapest path between two places on the near side never gets k rows behind the gate if k rows there and back cost more
than S, and a search may leave all cells out that lie farther behind it.

The gates are found once for a costmap. They hold on any other whose costs are higher, as long as the gate's own are
not: `DeadEnds.seal` tells which dead ends may be left out for a set of searches.
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, C901, PLR0913

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import int64, njit, types, void

from fog_kernels import _arrays
from fog_kernels.components import Runs
from fog_kernels.steps import SEALED, STRAIGHT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Cells = NDArray[np.int32]
    Flags = NDArray[np.uint8]

NEAR_GATE: Final = -2
"""The label of a cell that lies in a dead end, but so near its gate that it is not left out."""
_FAR: Final = 1 << 30

_FLAGS = types.Array(types.uint8, 1, "C", readonly=True)
_FLAGS_OUT = types.Array(types.uint8, 1, "C")


@njit(
    void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT),
    cache=True, nogil=True,
)  # fmt: skip
def _find_rows(offsets: Any, first: Any, last: Any, row: Any, below: Any, above: Any) -> None:
    """Write each run's row, and the first runs in the row below and above that do not end left of it."""
    height = offsets.size - 1
    for y in range(height):
        down = offsets[max(y - 1, 0)]
        up = offsets[y + 1]
        for i in range(offsets[y], offsets[y + 1]):
            row[i] = y
            while y > 0 and down < offsets[y] and last[down] < first[i]:
                down += 1
            while y + 1 < height and up < offsets[y + 2] and last[up] < first[i]:
                up += 1
            below[i] = down if y > 0 else 0
            above[i] = up


@njit(
    void(
        _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT,
        _arrays.I32_FLAT, _arrays.I32_OUT, _arrays.I32_OUT, _FLAGS_OUT,
    ),
    cache=True, nogil=True,
)  # fmt: skip
def _find_gates(
    offsets: Any, first: Any, last: Any, row: Any, below: Any, above: Any, roots: Any,
    order: Any, parent: Any, behind: Any,
) -> None:  # fmt: skip
    """Write a depth-first tree of the runs, which begins at the first of its runs in `roots`.

    `order` receives the runs as they are visited; `parent` each one's parent, -1 for a root; `behind` whether all paths
    from its subtree to the rest lead through the parent.
    """
    count = first.size
    height = offsets.size - 1
    number = np.full(count, -1, np.int32)
    lowest = np.empty(count, np.int32)
    following = np.empty(count, np.int32)
    upwards = np.zeros(count, np.bool_)
    seen = 0
    for root in roots:
        if number[root] >= 0:
            continue
        parent[root] = -1
        behind[root] = 0
        run = np.int64(root)
        new = True
        while run >= 0:
            if new:
                order[seen] = run
                number[run] = lowest[run] = seen
                seen += 1
                following[run] = below[run]
                upwards[run] = row[run] == 0
                if upwards[run]:
                    following[run] = above[run]
            new = False
            other = np.int64(following[run])
            y = np.int64(row[run]) + (1 if upwards[run] else -1)
            if y < height and other < offsets[y + 1] and first[other] <= last[run]:
                following[run] += 1
                if number[other] < 0:
                    parent[other] = run
                    run = other
                    new = True
                elif other != parent[run]:
                    lowest[run] = min(lowest[run], number[other])
            elif not upwards[run]:
                upwards[run] = True
                following[run] = above[run]
            else:
                above_it = np.int64(parent[run])
                if above_it >= 0:
                    lowest[above_it] = min(lowest[above_it], lowest[run])
                    behind[run] = lowest[run] >= number[above_it]
                run = above_it


@njit(
    void(
        _arrays.U8_GRID, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_OUT
    ),
    cache=True, nogil=True,
)  # fmt: skip
def _measure(costmap: Any, row: Any, first: Any, last: Any, weight: Any, reach: Any) -> None:
    """Write how many rows behind each run no cheapest path gets that comes back to it."""
    there_and_back = 4 * STRAIGHT * np.int64(weight[0])
    for run in range(row.size):
        cells = costmap[row[run]]
        along = np.int64(0)
        for x in range(first[run], last[run]):
            along += STRAIGHT * (np.int64(weight[cells[x]]) + np.int64(weight[cells[x + 1]]))
        reach[run] = along // there_and_back + 1


@njit(
    void(
        _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _FLAGS, _arrays.I32_FLAT, _FLAGS_OUT, _FLAGS,
        _FLAGS_OUT, _FLAGS_OUT, _FLAGS_OUT,
    ),
    cache=True, nogil=True,
)  # fmt: skip
def _seal(
    row: Any, order: Any, parent: Any, behind: Any, reach: Any, busy: Any, raised: Any,
    inside: Any, sealed: Any, used: Any,
) -> None:  # fmt: skip
    """Write whether each run is behind a gate that is used, whether it is left out, and whether it is such a gate.

    A gate is used unless it is `raised` or a run behind it is `busy`: afterwards, so is each run before one.
    """
    low, high = np.empty(row.size, np.int32), np.empty(row.size, np.int32)
    for i in range(order.size - 1, -1, -1):
        run = order[i]
        if busy[run] and parent[run] >= 0:
            busy[parent[run]] = 1
    for i in range(order.size):
        run = order[i]
        gate = parent[run]
        low[run], high[run] = -_FAR, _FAR  # between these rows a run is not left out
        inside[run] = sealed[run] = used[run] = 0
        if gate < 0:
            continue
        low[run], high[run], inside[run] = low[gate], high[gate], inside[gate]
        y = row[gate]
        # A gate that lets searches as far in as an earlier one is not used: each has to be watched.
        if (
            behind[run] and not busy[run] and not raised[gate] and low[gate] < y < high[gate]
            and (y + reach[gate] < high[gate] if row[run] > y else y - reach[gate] > low[gate])
        ):  # fmt: skip
            low[run] = max(low[gate], y - reach[gate])
            high[run] = min(high[gate], y + reach[gate])
            inside[run] = used[gate] = 1
        sealed[run] = not low[run] < row[run] < high[run]


@njit(
    void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _FLAGS, int64, int64, int64, _arrays.I32_OUT),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _paint(row: Any, first: Any, last: Any, chosen: Any, value: int, step: int, stride: int, label: Any) -> None:
    """Write a value to the chosen runs; `step` and `stride` lead to the next cell of a run and of a row."""
    for run in range(row.size):
        if not chosen[run]:
            continue
        base = np.int64(row[run]) * stride
        if step == 1:
            label[base + first[run] : base + last[run] + 1] = value
        else:
            for x in range(first[run], last[run] + 1):
                label[np.uint64(base + x * step)] = value


@njit(void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _FLAGS_OUT), cache=True, nogil=True)
def _forget_shallow(row: Any, order: Any, parent: Any, reach: Any, behind: Any) -> None:
    """Forget the gates behind which no cell is left out."""
    lowest, highest = row.copy(), row.copy()
    for i in range(order.size - 1, -1, -1):
        run = order[i]
        gate = parent[run]
        if gate < 0:
            continue
        lowest[gate], highest[gate] = min(lowest[gate], lowest[run]), max(highest[gate], highest[run])
        if row[gate] - reach[gate] < lowest[run] and highest[run] < row[gate] + reach[gate]:
            behind[run] = 0


class _Side:
    """The gates among the runs of a floor's rows, or with `turned` of its columns."""

    def __init__(self, costmap: NDArray[np.uint8], weight: Cells, *, turned: bool) -> None:
        grid = np.ascontiguousarray(costmap.T) if turned else costmap
        self.runs = runs = Runs(grid)
        self.turned = turned
        width = int(costmap.shape[1])
        self._step, self._stride = (width, 1) if turned else (1, width)
        self.row, self._order, self._parent, self._reach = (np.empty(len(runs), np.int32) for _ in range(4))
        self._behind = np.empty(len(runs), np.uint8)
        below, above = np.empty(len(runs), np.int32), np.empty(len(runs), np.int32)
        _find_rows(runs.offsets, runs.first, runs.last, self.row, below, above)
        # What contains the root is behind no gate: so the longest run, which is seldom in a small room.
        roots = np.argsort(runs.first - runs.last, kind="stable").astype(np.int32)
        _find_gates(
            runs.offsets, runs.first, runs.last, self.row, below, above, roots, self._order, self._parent, self._behind
        )
        _measure(grid, self.row, runs.first, runs.last, weight, self._reach)
        _forget_shallow(self.row, self._order, self._parent, self._reach, self._behind)

    def _flags(self, cells: Cells) -> Flags:
        """Return for each run whether it has one of the floor's cells."""
        if self.turned:
            rows, columns = np.divmod(cells, np.int32(self._step))
            cells = columns * np.int32(self.runs.width) + rows
        return self.runs.with_cells(cells)

    def seal(self, places: Cells, raised: Cells) -> _SealedSide:
        inside, sealed, used = (np.empty(len(self.runs), np.uint8) for _ in range(3))
        _seal(
            self.row, self._order, self._parent, self._behind, self._reach, self._flags(places), self._flags(raised),
            inside, sealed, used,
        )  # fmt: skip
        return _SealedSide(self, inside, sealed, np.flatnonzero(used))

    def paint(self, chosen: Flags, value: int, label: Cells) -> None:
        _paint(self.row, self.runs.first, self.runs.last, chosen, value, self._step, self._stride, label)

    def cells_of(self, runs: NDArray[np.int64]) -> Cells:
        """Return the flat indexes of the cells of some runs."""
        first = self.runs.first[runs].astype(np.int64)
        lengths = self.runs.last[runs] + 1 - first
        along = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths) + np.repeat(first, lengths)
        across = np.repeat(self.row[runs], lengths)
        cells: Cells = (along * self._step + across * self._stride).astype(np.int32)
        return cells


class _SealedSide:
    def __init__(self, side: _Side, inside: Flags, sealed: Flags, gates: NDArray[np.int64]) -> None:
        self._side = side
        self._inside, self._sealed = inside, sealed
        self.gates = side.cells_of(gates)

    def paint_near_gates(self, label: Cells) -> None:
        self._side.paint(self._inside & ~self._sealed, NEAR_GATE, label)

    def paint_sealed(self, label: Cells) -> None:
        self._side.paint(self._sealed, SEALED, label)

    def contains(self, cell: tuple[int, int]) -> bool:
        run = self._side.runs.at(*(cell[::-1] if self._side.turned else cell))
        return run >= 0 and bool(self._inside[run])


class SealedEnds:
    """The dead ends that some searches leave out, on the costmap that they were sealed for."""

    def __init__(self, sides: tuple[_SealedSide, ...], costmap: NDArray[np.uint8], places: Cells) -> None:
        self._sides = sides
        self._width = costmap.shape[1]
        self._places = frozenset(places.tolist())
        self._gates = np.concatenate([side.gates for side in sides])
        self._costs = costmap.ravel()[self._gates]

    def paint(self, label: Cells) -> None:
        """Write `SEALED` to the cells that are left out, and `NEAR_GATE` to the others in a dead end.

        `label` is int32 (height * width,).
        """
        for side in self._sides:
            side.paint_near_gates(label)
        for side in self._sides:
            side.paint_sealed(label)

    def contains(self, cell: tuple[int, int]) -> bool:
        """Whether a cell (column, row) lies in one of them: a search from there, or to there, must not leave them out.

        Such a cell need not be left out itself: it may be near the gate.
        """
        if cell[1] * self._width + cell[0] in self._places:
            return False  # what it was sealed for; most questions are about these
        return any(side.contains(cell) for side in self._sides)

    def hold(self, costmap: NDArray[np.uint8]) -> bool:
        """Whether they may be left out on a uint8 (h, w) costmap none of whose costs is lower: no gate's is higher."""
        return bool(np.array_equal(costmap.ravel()[self._gates], self._costs))


class DeadEnds:
    """The dead ends of one costmap."""

    def __init__(self, costmap: NDArray[np.uint8], weight: Cells) -> None:
        """Find them on a uint8 (h, w) costmap; `weight` tells what each cost weighs (`Planner.weight`).

        Takes some milliseconds on 2000 x 1200 cells. Raises TypeError or ValueError as `Runs` does.
        """
        costmap = _arrays.grid(costmap, "costmap")
        self._shape = costmap.shape
        self._sides = tuple(_Side(costmap, weight, turned=turned) for turned in (False, True))

    def seal(self, costmap: NDArray[np.uint8], raised: Cells, places: Cells) -> SealedEnds:
        """Return the dead ends that may be left out by searches between places, each outside of all that are returned.

        `costmap`, uint8 (h, w), is nowhere lower than the one that they were found on, and higher at the cells `raised`
        only; these and `places` are flat indexes. Raises ValueError for a costmap of another shape.
        """
        if costmap.shape != self._shape:
            raise ValueError(f"costmap must have shape {self._shape}, not {costmap.shape}")
        return SealedEnds(tuple(side.seal(places, raised) for side in self._sides), costmap, places)
