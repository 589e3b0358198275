"""The costs that have stayed on the map: walls, zones, and whatever else nobody has taken away for a while.

Distance fields over these costs lead round what stands in the way for long; fields over the walls alone lead into it.
A cell whose cost fell once is not trusted above that cost again, so that what comes and goes never outdates the fields
a second time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import INSCRIBED, UNKNOWN

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import Window

    Grid = NDArray[np.uint8]


class StandingMap:
    """Costs that no cell has fallen below for `period` (s); they are raised at most once in that time."""

    def __init__(self, period: float) -> None:
        self._period = period
        self._begun = 0.0
        self.costs: Grid = np.zeros((0, 0), np.uint8)
        """Never above the newest costs of traversable cells; another array whenever a cost changes."""
        self._lowest = self.costs
        """The lowest cost of each cell since the period began."""
        self._distrusted = self.costs
        """By how much the highest cost that each cell may get is below the highest of all: 0 for most, untouched."""

    def load(self, cost: Grid, *, same_floor: bool, now: float) -> None:
        """Begin with a whole costmap; on the same floor as before what is known of its cells is kept."""
        if same_floor and cost.shape == self.costs.shape:
            self._lower(np.s_[:, :], cost)
            np.minimum(self._lowest, cost, out=self._lowest)
            return
        self.costs, self._lowest, self._begun = cost.copy(), cost.copy(), now
        self._distrusted = np.zeros(cost.shape, np.uint8)

    def update(self, window: Window, cost: Grid) -> None:
        """Follow a change of the costs in a window."""
        place = window.rows, window.columns
        np.minimum(self._lowest[place], cost, out=self._lowest[place])
        self._lower(place, cost)

    def _lower(self, place: tuple[slice, slice], cost: Grid) -> None:
        standing = self.costs[place]
        fell = (cost < standing) & (cost < INSCRIBED)
        if fell.any():
            self.costs = self.costs.copy()
            self.costs[place][fell] = cost[fell]
            self._distrusted[place][fell] = UNKNOWN - cost[fell]

    def settle(self, cost: Grid, now: float) -> None:
        """Raise the costs to the lowest ones of the period, when it has ended; `cost` is the newest costmap."""
        if now - self._begun < self._period or self.costs.size == 0:
            return
        lowest = np.minimum(self._lowest, UNKNOWN - self._distrusted)
        if np.any(lowest > self.costs):
            self.costs = np.maximum(lowest, self.costs)
        self._lowest, self._begun = cost.copy(), now
