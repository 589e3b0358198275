"""Inflates the combined layers, as the last step; recomputed only around changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.grid import Window
from fog_kernels.inflation import inflate, inflate_window, inflation_table

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.costs import Inflation
    from map_service.layers.base import Grid


class InflationLayer:
    """Holds the inflated map of a grid of this resolution (m per cell)."""

    def __init__(self, raw: Grid, resolution: float, inflation: Inflation) -> None:
        self._table = inflation_table(resolution, inflation)
        self.cost = inflate(raw, self._table)

    def update(self, raw: Grid, windows: Iterable[Window]) -> list[Window]:
        """Update the inflation around windows in which `raw` changed; return the windows of `cost` that it rewrote."""
        rewritten = (Window(*inflate_window(raw, self._table, *window, self.cost)) for window in windows)
        return [window for window in rewritten if not window.empty]

    def inflate_all(self, raw: Grid) -> Grid:
        """Return the inflation of a whole map, computed from scratch."""
        return inflate(raw, self._table)
