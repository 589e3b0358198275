"""Connected components of the traversable cells of a costmap: what can be reached from where.

The map is kept as runs (the maximal sequences of traversable cells in a row), which are joined with those of the row
below by union-find (Rosenfeld and Pfaltz 1966; runs as in He, Chao and Suzuki 2008). A diagonal step needs both
orthogonal cells, so 4-connectivity decides what can be reached. An office of 2000 x 1200 cells takes about 1 ms
and 0.3 MB; every question afterwards costs microseconds.
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


@njit(
    int64(_arrays.U8_GRID, _arrays.I32_OUT, _arrays.I32_OUT, _arrays.I32_OUT, types.Array(types.uint8, 1, "C")),
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


class Components:
    """The components of one costmap; each is named by a number >= 0."""

    def __init__(self, costmap: NDArray[np.uint8]) -> None:
        """Find the components of a uint8 (h, w) costmap; raises TypeError or ValueError for another type or shape."""
        costmap = _arrays.grid(costmap, "costmap")
        self._height, self._width = costmap.shape
        self._offsets = np.empty(self._height + 1, np.int32)
        # np.empty only reserves memory: no page is used before a run is written to it.
        most = self._height * ((self._width + 1) // 2)
        first, last = np.empty(most, np.int32), np.empty(most, np.int32)
        count = int(_find_runs(costmap, self._offsets, first, last, np.zeros(8 * (self._width // 8 + 1), np.uint8)))
        self._first, self._last = first[:count].copy(), last[:count].copy()
        self._label = np.empty(count, np.int32)
        _join_runs(self._offsets, self._first, self._last, self._label)

    def of(self, column: int, row: int) -> int:
        """Return the component of a cell, which may lie outside the grid; -1 where it is not traversable."""
        if not (0 <= column < self._width and 0 <= row < self._height):
            return -1
        begin, end = int(self._offsets[row]), int(self._offsets[row + 1])
        index = begin + int(np.searchsorted(self._last[begin:end], column))
        return int(self._label[index]) if index < end and self._first[index] <= column else -1

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
        run = int(_nearest_run(self._offsets, self._first, self._last, self._label, component, column, row))
        found = min(max(column, int(self._first[run])), int(self._last[run]))
        return found, int(np.searchsorted(self._offsets, run, side="right")) - 1

    def labels(self, x: int, y: int, width: int, height: int) -> NDArray[np.int32]:
        """Return the components of a window's cells, int32 (height, width), -1 where a cell is not traversable.

        Raises ValueError for a window that leaves the grid.
        """
        if min(x, y) < 0 or x + width > self._width or y + height > self._height:
            raise ValueError(f"the window {x, y, width, height} leaves the {self._width} x {self._height} grid")
        out = np.empty((height, width), np.int32)
        _paint(self._offsets, self._first, self._last, self._label, x, y, out)
        return out
