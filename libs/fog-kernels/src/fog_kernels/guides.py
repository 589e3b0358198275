"""What guides a search besides the distance to its goal: lower bounds of the cost to go, computed beforehand."""

# The kernel takes arrays and scalars, typed by its compiled signature.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import int64, njit, types, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.dead_ends import SealedEnds

    _Cells = NDArray[np.int32]
    _Arguments = tuple[_Cells, int, int, int, _Cells, _Cells, int]

TILE_BITS: Final = 4
"""An exact field is made of tiles of 16 x 16 cells."""
TILE: Final = 1 << TILE_BITS
NO_PATH: Final = -1
"""In a field: no path leads from here to the goal."""
LANDMARKS: Final = 16
"""How many landmarks a floor has at most (`landmarks`)."""
LEVEL: Final = 0
"""The slot of the pattern of a tile whose cells all count as its lowest cost."""
_NONE: Final = int(np.iinfo(np.int64).max)
_NO_SLOTS: Final[NDArray[np.int32]] = np.empty((0, 0), np.int32)
_NO_PATTERNS: Final[NDArray[np.int32]] = np.empty((0, TILE * TILE), np.int32)


_I64_FLAT: Final = types.Array(types.int64, 1, "C", readonly=True)


@njit(inline="always")
def _cost(lowest: Any, columns: int, bits: int, unit: int, slots: Any, patterns: Any, width: int, cell: Any) -> Any:
    """Return the cost of a cell, given by its flat index, in a field (see `GoalField`); -1 without a path."""
    last = TILE - 1
    y = cell // width
    x = cell - y * width
    block = np.uint64((y >> bits) * columns + (x >> bits))
    least = np.int64(lowest[block])
    rise = np.int64(0)
    if slots.size > 0 and least >= 0:
        place = (np.int64(slots[block]) << (2 * TILE_BITS)) + ((y & last) << TILE_BITS) + (x & last)
        rise = np.int64(patterns[np.uint64(place)])
    return least * unit + rise if least >= 0 and rise >= 0 else np.int64(NO_PATH)


@njit(
    void(
        _arrays.I32_FLAT, int64, int64, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, _arrays.I32_FLAT,
        _arrays.I64_OUT,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _write_costs(
    lowest: Any, columns: int, bits: int, unit: int, slots: Any, patterns: Any, width: int, cells: Any, costs: Any
) -> None:
    """Write the cost of each cell."""
    for i in range(cells.size):
        costs[i] = _cost(lowest, columns, bits, unit, slots, patterns, width, np.int64(cells[i]))


@njit(
    int64(
        _arrays.I32_FLAT, int64, int64, int64, _arrays.I32_FLAT, _arrays.I32_FLAT, int64, _arrays.I32_FLAT, _I64_FLAT
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def _least_rise(
    lowest: Any, columns: int, bits: int, unit: int, slots: Any, patterns: Any, width: int, cells: Any, levels: Any
) -> int:
    """Return by how much the costs of the cells are above their levels, at least; `_NONE` if none has a cost."""
    least = np.int64(_NONE)
    for i in range(cells.size):
        cost = _cost(lowest, columns, bits, unit, slots, patterns, width, np.int64(cells[i]))
        if cost >= 0:
            least = min(least, cost - levels[i])
    return int(least)


@njit(
    void(
        int64, int64, int64, int64, int64, int64,
        _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_FLAT, _arrays.I32_OUT,
    ),
    cache=True, nogil=True, error_model="numpy",
)  # fmt: skip
def fill_tile(
    tile: Any, columns: Any, goal_x: Any, goal_y: Any, straight: Any, extra: Any,
    lowest: Any, slots: Any, patterns: Any, chosen: Any, own: Any, bounds: Any,
) -> None:  # fmt: skip
    """Write the bounds of a tile's cells: -1 where no path leads from there to the goal.

    straight, extra: the least cost of a straight step, and by how much that of a diagonal one exceeds it. chosen: the
    landmarks by their number, own: the goal's cost in the field of each.
    """
    tiles = lowest.size // LANDMARKS
    row = bounds[tile * TILE * TILE : (tile + 1) * TILE * TILE]
    left, top = tile % columns * TILE, tile // columns * TILE
    for y in range(TILE):
        down = abs(top + y - goal_y)
        for x in range(TILE):
            across = abs(left + x - goal_x)
            row[y * TILE + x] = np.int32(straight * max(across, down) + extra * min(across, down))
    for i in range(chosen.size):
        place = np.int64(chosen[i]) * tiles + tile
        if lowest[place] == NO_PATH:
            row[:] = NO_PATH
            return
        rise = np.int32(lowest[place] - own[i])
        first = np.int64(slots[place]) << 2 * TILE_BITS
        pattern = patterns[first : first + TILE * TILE]
        for cell in range(TILE * TILE):
            row[cell] = max(row[cell], abs(np.int32(rise + pattern[cell])))
        if i == chosen.size - 1:
            for cell in range(TILE * TILE):
                if pattern[cell] < 0:
                    row[cell] = NO_PATH


@dataclass(frozen=True, slots=True)
class GoalField:
    """The cost to one goal from every cell, or a lower bound of it for every block of 2^bits x 2^bits cells.

    `lowest` is int32 (rows, columns): the lowest cost in a block in multiples of `unit`, rounded down; -1 where no path
    leads to the goal. With `slots`, int32 (rows, columns), the blocks are tiles, and the costs of a tile's cells are
    its lowest cost plus the row of `patterns`, int32 (n, 256), that the slot names; without, `slots` is empty.
    It guides `Planner.plan` on costmaps of `width` x `height` cells none of which is lower than in the costmap that it
    was computed on. 2000 x 1200 cells take 75 KB and what `TilePatterns` holds; in blocks of 4 cells 0.6 MB.
    """

    goal: tuple[int, int]
    width: int
    height: int
    bits: int
    lowest: NDArray[np.int32]
    unit: int
    slots: NDArray[np.int32] = field(default_factory=lambda: _NO_SLOTS)
    patterns: NDArray[np.int32] = field(default_factory=lambda: _NO_PATTERNS)

    @property
    def exact(self) -> bool:
        """Whether it gives every cell its true cost."""
        return self.slots.size > 0 and self.unit == 1

    @property
    def size(self) -> int:
        """The memory (bytes) that it does not share with other fields."""
        return self.lowest.nbytes + self.slots.nbytes

    def coarser(self) -> GoalField:
        """Return the field in blocks of twice the side, a field of tiles in blocks of a tile's side.

        Searches stay exact and expand more cells.
        """
        if self.slots.size > 0:
            return GoalField(self.goal, self.width, self.height, self.bits, self.lowest, self.unit)
        rows, columns = self.lowest.shape
        padded = np.full((rows + rows % 2, columns + columns % 2), NO_PATH, np.int32)
        padded[:rows, :columns] = self.lowest
        # Without a path is the highest value of the unsigned type, so the minimum is that of the others.
        parts = padded.view(np.uint32)
        lowest = np.minimum(
            np.minimum(parts[::2, ::2], parts[1::2, ::2]), np.minimum(parts[::2, 1::2], parts[1::2, 1::2])
        )
        return GoalField(self.goal, self.width, self.height, self.bits + 1, lowest.view(np.int32), self.unit)

    def toward(self, cell: tuple[int, int]) -> GoalField | None:
        """Return a bound of the cost to a cell (column, row) from all others: by how much this field rises from there.

        By the triangle inequality no way is shorter than the difference of its ends' costs. Where robots drive along
        shortest paths from the field's goal, the bound is the cost itself. None for a field that is not exact, or if
        it has no cost at the cell.
        """
        here = int(self.costs(np.array([cell[1] * self.width + cell[0]]))[0])
        if here < 0 or not self.exact:
            return None
        rise = np.where(self.lowest == NO_PATH, NO_PATH, np.maximum(self.lowest - here, 0))
        slots = np.where(self.lowest < here, LEVEL, self.slots)
        return GoalField(cell, self.width, self.height, self.bits, rise, 1, slots, self.patterns)

    def costs(self, cells: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the costs at cells given by flat indexes, int64 of their shape; -1 where no path leads to the goal."""
        flat = np.ascontiguousarray(cells, np.int32)
        costs = np.empty(flat.shape, np.int64)
        _write_costs(*self._arguments, flat.ravel(), costs.ravel())
        return costs

    def least_rise(self, cells: NDArray[np.int32], levels: NDArray[np.int64]) -> int | None:
        """Return the lowest difference of cost and level, both (n,), at cells given by flat indexes.

        None where no path leads to the goal from any of them. Raises TypeError or ValueError for other arrays.
        """
        _arrays.exact(cells, np.int32, 1, "cells")
        _arrays.exact(levels, np.int64, 1, "levels")
        if cells.size != levels.size:
            raise ValueError(f"levels must be one for each of the {cells.size} cells, not {levels.size}")
        least = int(_least_rise(*self._arguments, cells, levels))
        return least if least != _NONE else None

    @property
    def _arguments(self) -> _Arguments:
        """What kernels read of it."""
        return (
            self.lowest.ravel(), self.lowest.shape[1], self.bits, self.unit, self.slots.ravel(),
            self.patterns.ravel(), self.width,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Detour:
    """A lower bound of the cost from a part of the floor, the same for all goals outside it but for an offset.

    `costs` is int32 (h, w), 0 outside the part; costs above `highest` count as that. It holds on the costmap that it
    was computed on, and on any whose costs are higher, as long as `holds` says so.
    """

    costs: NDArray[np.int32]
    highest: int
    border: NDArray[np.int32]
    """The flat indexes of the cells through which every path leaves the part."""
    levels: NDArray[np.int64]
    """What the bound begins with at each of them."""
    sealed: SealedEnds | None = None
    """The dead ends that are left out, where `costs` is `SEALED`."""

    def covers(self, cell: tuple[int, int]) -> bool:
        """Whether the bound is the full one of a cell (column, row), and holds for a search from there."""
        return bool(0 < self.costs[cell[1], cell[0]] < self.highest) and not self._seals(cell)

    def outside(self, cell: tuple[int, int]) -> bool:
        """Whether a cell (column, row) lies outside the part, so that the bound holds for a search to it."""
        return bool(self.costs[cell[1], cell[0]] == 0) and not self._seals(cell)

    def _seals(self, cell: tuple[int, int]) -> bool:
        return self.sealed is not None and self.sealed.contains(cell)

    def holds(self, costmap: NDArray[np.uint8]) -> bool:
        """Whether it holds on a uint8 (h, w) costmap none of whose costs is lower than in its own."""
        return self.sealed is None or self.sealed.hold(costmap)

    def offset(self, field: GoalField) -> int | None:
        """Return what is to be added for a goal outside the part; None where its field gives no border cell a cost."""
        return field.least_rise(self.border, self.levels)
