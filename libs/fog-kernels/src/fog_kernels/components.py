"""Connected components of the traversable cells of a costmap: what can be reached from where.

The map is kept as runs (the maximal sequences of traversable cells in a row), which are joined with those of the row
below by union-find (Rosenfeld and Pfaltz 1966; runs as in He, Chao and Suzuki 2008). A diagonal step needs both
orthogonal cells, so 4-connectivity decides what can be reached. An office of 2000 x 1200 cells takes about 1 ms and
0.3 MB; every question afterwards costs microseconds.
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, C901, PLR0913

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import int64, njit, types, void

from fog_contracts.costs import INSCRIBED
from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray


_U8_OUT = types.Array(types.uint8, 1, "C")


@njit(
    int64(_arrays.U8_GRID, _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT, _U8_OUT),
    cache=True,
    nogil=True,
)
def _find_runs(costmap: Any, offsets: Any, first: Any, last: Any, edges: Any) -> int:
    """Write the runs' first and last columns; those of row y are offsets[y]..offsets[y + 1] - 1. Return their number.

    `edges` is scratch of a multiple of eight bytes, zero, and at least one byte longer than a row.
    """
    height, width = costmap.shape
    words = edges.view(np.uint64)
    count = 0
    for y in range(height):
        offsets[y] = count
        row = costmap[y]
        # Where runs begin and end is marked first: the compiler vectorizes this, and most words stay zero.
        edges[0] = row[0] < INSCRIBED
        for x in range(1, width):
            edges[x] = (row[x] < INSCRIBED) != (row[x - 1] < INSCRIBED)
        edges[width] = row[width - 1] < INSCRIBED
        inside = False
        for i in range(words.size):
            if words[i] == 0:
                continue
            for x in range(8 * i, min(8 * i + 8, width + 1)):
                if edges[x] == 0:
                    continue
                if inside:
                    last[count] = x - 1
                    count += 1
                else:
                    first[count] = x
                inside = not inside
    offsets[height] = count
    return count


# It keeps the GIL: it takes less time than another thread may keep the GIL before it gives it back.
@njit(int64(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, int64), cache=True)
def _run_at(offsets: Any, first: Any, last: Any, column: int, row: int) -> int:
    """Return the run of a cell of the grid; -1 where it is not traversable."""
    low: Any = np.int64(offsets[row])
    high: Any = np.int64(offsets[row + 1])
    end = high
    while low < high:
        middle = (low + high) >> 1
        if last[middle] < column:
            low = middle + 1
        else:
            high = middle
    return int(low) if low < end and first[low] <= column else -1


@njit(
    void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, _arrays.I32_FLAT, _U8_OUT),
    cache=True,
    nogil=True,
)
def _flag_runs(offsets: Any, first: Any, last: Any, width: int, cells: Any, flags: Any) -> None:
    for i in range(cells.size):
        run = _run_at(offsets, first, last, cells[i] % width, cells[i] // width)
        if run >= 0:
            flags[run] = 1


@njit(void(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_OUT), cache=True, nogil=True)
def _join_runs(offsets: Any, first: Any, last: Any, label: Any) -> None:
    """Write each run's component: the index of the component's first run."""
    for i in range(label.size):
        label[i] = i
    for y in range(1, offsets.size - 1):
        below = offsets[y - 1]
        here = offsets[y]
        while below < offsets[y] and here < offsets[y + 1]:
            if first[below] <= last[here] and first[here] <= last[below]:
                a = below
                while label[a] != a:
                    label[a] = label[label[a]]
                    a = label[a]
                b = here
                while label[b] != b:
                    label[b] = label[label[b]]
                    b = label[b]
                if a < b:
                    label[b] = a
                elif b < a:
                    label[a] = b
            if last[below] < last[here]:
                below += 1
            else:
                here += 1
    # A run's parent has a lower index, so one pass in order reaches the roots.
    for i in range(label.size):
        label[i] = label[label[i]]


@njit(
    int64(_arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, int64, int64),
    cache=True,
    nogil=True,
)
def _nearest_run(offsets: Any, first: Any, last: Any, label: Any, component: int, column: int, row: int) -> int:
    """Return the component's run that is nearest to (column, row)."""
    best = -1
    least = np.int64(1) << 62
    y = 0
    for i in range(component, label.size):
        if label[i] != component:
            continue
        while offsets[y + 1] <= i:
            y += 1
        dx = max(first[i] - column, 0, column - last[i])
        square = dx * dx + (y - row) * (y - row)
        if square < least:
            least = square
            best = i
    return best


@njit(
    void(
        _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, int64, _arrays.I32_GRID_OUT
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _paint(offsets: Any, first: Any, last: Any, label: Any, left: int, bottom: int, out: Any) -> None:
    height, width = out.shape
    for y in range(height):
        row = out[y]
        row[:] = -1
        for i in range(offsets[bottom + y], offsets[bottom + y + 1]):
            for x in range(max(first[i], left), min(last[i] + 1, left + width)):
                row[x - left] = label[i]


@njit(
    void(
        _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_PAIRS, int64, int64, _U8_OUT
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _find_both(offsets: Any, first: Any, last: Any, label: Any, windows: Any, a: int, b: int, found: Any) -> None:
    """Write 1 for each window (x, y, width, height) that has cells of both components, 0 for the others."""
    for i in range(windows.shape[0]):
        left = windows[i, 0]
        right = left + windows[i, 2]
        has_a = False
        has_b = False
        for y in range(windows[i, 1], windows[i, 1] + windows[i, 3]):
            low, high = offsets[y], offsets[y + 1]
            end = high
            while low < high:
                middle = (low + high) >> 1
                if last[middle] < left:
                    low = middle + 1
                else:
                    high = middle
            while low < end and left < right and first[low] < right:
                has_a |= label[low] == a
                has_b |= label[low] == b
                low += 1
            if has_a and has_b:
                break
        found[i] = has_a and has_b


class Runs:
    """The runs of one costmap, row by row from the lowest, numbered from 0."""

    def __init__(self, costmap: NDArray[np.uint8]) -> None:
        """Find the runs of a uint8 (h, w) costmap; raises TypeError or ValueError for another type or shape."""
        costmap = _arrays.grid(costmap, "costmap")
        self.height, self.width = costmap.shape
        self.offsets = np.empty(self.height + 1, np.int32)
        """The runs of row y are offsets[y]..offsets[y + 1] - 1."""
        # np.empty only reserves memory: no page is used before a run is written to it.
        most = self.height * ((self.width + 1) // 2)
        first, last = np.empty(most, np.int32), np.empty(most, np.int32)
        count = int(_find_runs(costmap, self.offsets, first, last, np.zeros(8 * (self.width // 8 + 1), np.uint8)))
        self.first = first[:count].copy()
        """Each run's first column."""
        self.last = last[:count].copy()
        """Each run's last column."""

    def __len__(self) -> int:
        return len(self.first)

    def at(self, column: int, row: int) -> int:
        """Return the run of a cell, which may lie outside the grid; -1 where it is not traversable."""
        if not (0 <= column < self.width and 0 <= row < self.height):
            return -1
        return int(_run_at(self.offsets, self.first, self.last, column, row))

    def with_cells(self, cells: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Return for each run whether it has one of the cells, given by their flat indexes: 1 or 0."""
        flags = np.zeros(len(self), np.uint8)
        _flag_runs(self.offsets, self.first, self.last, self.width, cells, flags)
        return flags

    def row(self, run: int) -> int:
        """Return the row of a run."""
        return int(np.searchsorted(self.offsets, run, side="right")) - 1


class Components:
    """The components of one costmap; each is named by a number >= 0."""

    def __init__(self, costmap: NDArray[np.uint8]) -> None:
        """Find the components of a uint8 (h, w) costmap; raises TypeError or ValueError for another type or shape."""
        self._runs = Runs(costmap)
        self._label = np.empty(len(self._runs), np.int32)
        _join_runs(self._runs.offsets, self._runs.first, self._runs.last, self._label)

    def of(self, column: int, row: int) -> int:
        """Return the component of a cell, which may lie outside the grid; -1 where it is not traversable."""
        run = self._runs.at(column, row)
        return int(self._label[run]) if run >= 0 else -1

    def connected(self, a: tuple[int, int], b: tuple[int, int]) -> bool:
        """Whether there is a path between two cells (column, row)."""
        component = self.of(*a)
        return component >= 0 and component == self.of(*b)

    def nearest(self, component: int, cell: tuple[int, int]) -> tuple[int, int]:
        """Return the component's (column, row) nearest to a cell (Euclid); among equals the lowest row, then column.

        Raises ValueError for a number that names no component.
        """
        if not (0 <= component < len(self._label) and self._label[component] == component):
            raise ValueError(f"there is no component {component}")
        column, row = int(cell[0]), int(cell[1])
        runs = self._runs
        run = int(_nearest_run(runs.offsets, runs.first, runs.last, self._label, component, column, row))
        return min(max(column, int(runs.first[run])), int(runs.last[run])), runs.row(run)

    def labels(self, x: int, y: int, width: int, height: int) -> NDArray[np.int32]:
        """Return the components of a window's cells, int32 (height, width), -1 where a cell is not traversable.

        Raises ValueError for a window that leaves the grid.
        """
        runs = self._runs
        if min(x, y) < 0 or x + width > runs.width or y + height > runs.height:
            raise ValueError(f"the window {x, y, width, height} leaves the {runs.width} x {runs.height} grid")
        out = np.empty((height, width), np.int32)
        _paint(runs.offsets, runs.first, runs.last, self._label, x, y, out)
        return out

    def both_in(self, windows: NDArray[np.int32], a: int, b: int) -> NDArray[np.bool_]:
        """Return for each window whether it has cells of both components; windows are int32 (n, 4).

        Each is x, y, width and height. Raises TypeError or ValueError for other arrays, or a window that leaves the
        grid.
        """
        _arrays.exact(windows, np.int32, 2, "windows")
        if windows.shape[1] != 4:
            raise ValueError(f"windows must have shape (n, 4), not {windows.shape}")
        runs, wide = self._runs, windows.astype(np.int64)
        leaves = (wide < 0).any(axis=1) | (wide[:, :2] + wide[:, 2:] > (runs.width, runs.height)).any(axis=1)
        if leaves.any():
            window = tuple(wide[int(np.argmax(leaves))].tolist())
            raise ValueError(f"the window {window} leaves the {runs.width} x {runs.height} grid")
        found = np.empty(len(windows), np.uint8)
        _find_both(runs.offsets, runs.first, runs.last, self._label, windows, int(a), int(b), found)
        return found.view(np.bool_)
