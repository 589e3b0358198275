"""What guides a search to any goal: exact fields of a few far cells, the landmarks.

Method: ALT (Goldberg and Harrelson 2005). By the triangle inequality no way from x to the goal costs less than the
difference of their costs to a landmark. A search takes the largest of these bounds over the landmarks that are best for
its start and goal. Fields are stored in tiles (`tiles`), so the bounds are computed for a whole tile when the search
first gets there: some 2 ns for each of its cells, where single look-ups would take longer than the search.

The bounds hold on the costmap that the fields were computed on and on any with raised costs, as a goal's field does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED
from fog_kernels.components import Components
from fog_kernels.guides import LANDMARKS, NO_PATH, TILE, TILE_BITS
from fog_kernels.tiles import TilePatterns

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from fog_kernels.guides import GoalField

    _Cells = NDArray[np.int32]
    Cell = tuple[int, int]
    FieldSearch = Callable[[NDArray[np.uint8], Cell, TilePatterns], GoalField]

_BEST: Final = 8
"""How many of them guide a search."""


class Landmarks:
    """The fields of some cells of a floor, farthest from each other; add one after another, on any one thread."""

    def __init__(self, width: int, height: int, capacity: int = 10_000_000) -> None:
        """Begin without landmarks on a floor of so many cells; `capacity`: the memory (bytes) of their patterns.

        Where the patterns do not fit, fewer landmarks have to do.
        """
        self.width, self.height = width, height
        self.columns = -(-width // TILE)
        tiles = self.columns * -(-height // TILE)
        self.fields: list[GoalField] = []
        self.lowest: _Cells = np.full((LANDMARKS, tiles), NO_PATH, np.int32)
        self.slots: _Cells = np.zeros((LANDMARKS, tiles), np.int32)
        self._patterns = TilePatterns(capacity)
        self.is_complete = False

    @property
    def patterns(self) -> _Cells:
        """The patterns of all fields."""
        return self._patterns.rows

    @property
    def size(self) -> int:
        """The memory (bytes) in use."""
        return self._patterns.size + self.lowest.nbytes + self.slots.nbytes

    def add(self, costmap: NDArray[np.uint8], goal_field: FieldSearch) -> None:
        """Add another landmark by a search of the whole floor, or else set `is_complete`.

        `costmap`: uint8 (h, w), the same for all of them. `goal_field`: `astar.Planner.goal_field`. Searches may use
        the others meanwhile.
        """
        number = len(self.fields)
        cell = self._farthest() if self.fields else _first(costmap)
        field = None if cell is None else goal_field(costmap, cell, self._patterns)
        if field is None or not field.exact:
            self.is_complete = True
            return
        self.lowest[number], self.slots[number] = field.lowest.ravel(), field.slots.ravel()
        shape = field.lowest.shape
        kept = self.lowest[number].reshape(shape), self.slots[number].reshape(shape)
        self.fields.append(replace(field, lowest=kept[0], slots=kept[1]))
        self.is_complete = len(self.fields) == LANDMARKS

    def _farthest(self) -> Cell | None:
        """Return a cell in the tile that is farthest from all landmarks; None when each has one."""
        nearest = self.lowest[: len(self.fields)].min(axis=0)
        tile = int(np.argmax(nearest))
        if nearest[tile] <= 0:
            return None
        pattern = self.patterns[self.slots[0, tile]]
        cell = int(np.argmin(np.where(pattern < 0, np.iinfo(np.int32).max, pattern)))
        return tile % self.columns * TILE + cell % TILE, tile // self.columns * TILE + cell // TILE

    def best(self, start: Cell, goal: Cell) -> tuple[_Cells, _Cells]:
        """Return the numbers of the landmarks that guide a search, and the goal's cost in the field of each."""
        count = len(self.fields)
        from_start, own = self._costs(start, count), self._costs(goal, count)
        gain = np.where(own == NO_PATH, NO_PATH, abs(from_start - own))
        order = np.argsort(-gain, kind="stable")[:_BEST]
        chosen = order[own[order] != NO_PATH]
        return chosen.astype(np.int32), own[chosen].astype(np.int32)

    def _costs(self, cell: Cell, count: int) -> NDArray[np.int64]:
        x, y = cell
        tile = (y >> TILE_BITS) * self.columns + (x >> TILE_BITS)
        least = self.lowest[:count, tile].astype(np.int64)
        rise = self.patterns[self.slots[:count, tile], (y % TILE) * TILE + x % TILE]
        return np.where((least == NO_PATH) | (rise == NO_PATH), NO_PATH, least + rise)


def _first(costmap: NDArray[np.uint8]) -> Cell | None:
    """Return a traversable cell of the largest part of the floor, at its upper edge; None if there is none."""
    height, width = costmap.shape
    labels = Components(costmap).labels(0, 0, width, height).ravel()
    if not np.any(costmap < INSCRIBED):
        return None
    place = int(np.argmax(labels == np.argmax(np.bincount(labels[labels >= 0]))))
    return place % width, place // width
