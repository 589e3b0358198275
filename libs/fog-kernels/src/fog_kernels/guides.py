"""What guides a search besides the distance to its goal: lower bounds of the cost to go, computed beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

UNREACHABLE = 65535
"""In a field: no path leads from the block to the goal."""


@dataclass(frozen=True, slots=True)
class GoalField:
    """A lower bound of the cost to one goal, for every block of 2^bits x 2^bits cells.

    `costs` is uint16 (rows, columns): the lowest cost in a block in multiples of `unit`, rounded down; 65535 where no
    path leads to the goal. It guides `Planner.plan` on costmaps of `width` x `height` cells none of which is lower than
    in the costmap that it was computed on. 2000 x 1200 cells take 4.8 MB, and a quarter of that with each further bit.
    """

    goal: tuple[int, int]
    width: int
    height: int
    bits: int
    costs: NDArray[np.uint16]
    unit: int

    @property
    def size(self) -> int:
        """The memory (bytes) of the costs."""
        return self.costs.nbytes

    def coarser(self) -> GoalField:
        """Return the field with blocks of twice the side: searches stay exact and expand more cells."""
        rows, columns = self.costs.shape
        padded = np.full((rows + rows % 2, columns + columns % 2), UNREACHABLE, np.uint16)
        padded[:rows, :columns] = self.costs
        costs = np.minimum(
            np.minimum(padded[::2, ::2], padded[1::2, ::2]), np.minimum(padded[::2, 1::2], padded[1::2, 1::2])
        )
        return GoalField(self.goal, self.width, self.height, self.bits + 1, costs, self.unit)


@dataclass(frozen=True, slots=True)
class Detour:
    """A lower bound of the cost from a part of the floor, the same for all goals outside it but for an offset.

    `costs` is uint16 (h, w) in multiples of `unit`, 65535 outside the part. It holds on the costmap that it was
    computed on, and on any whose costs are higher.
    """

    costs: NDArray[np.uint16]
    unit: int
    border: NDArray[np.int32]
    """The flat indexes of the cells through which every path leaves the part."""
    levels: NDArray[np.int64]
    """What the bound begins with at each of them."""

    def covers(self, cell: tuple[int, int]) -> bool:
        """Whether the bound says something of a cell (column, row)."""
        return bool(self.costs[cell[1], cell[0]] != UNREACHABLE)

    def offset(self, field: GoalField) -> int | None:
        """Return what is to be added for a goal outside the part; None where its field gives no border cell a cost."""
        costs = border_costs(field, self.border)
        known = costs >= 0
        return int((costs - self.levels)[known].min()) if known.any() else None


def border_costs(field: GoalField, border: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the field's cost at cells given by flat indexes, int64 (n,); -1 where no path leads to the goal."""
    costs = field.costs[(border // field.width) >> field.bits, (border % field.width) >> field.bits].astype(np.int64)
    return np.where(costs == UNREACHABLE, -1, costs * field.unit)
