"""Inflation of what all layers painted: the last step, recomputed only around what changed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.grid import Window
from fog_kernels.inflation import inflate, inflate_window, inflation_table

if TYPE_CHECKING:
    from collections.abc import Iterable

    from map_service.layers.protocol import Grid


class InflationLayer:
    """Keeps the inflated map; radii in m, `cost_scaling` in 1/m (Nav2's `cost_scaling_factor`)."""

    def __init__(
        self, raw: Grid, resolution: float, inscribed_radius: float, inflation_radius: float, cost_scaling: float
    ) -> None:
        self._table = inflation_table(resolution, inscribed_radius, inflation_radius, cost_scaling)
        self.cost = inflate(raw, self._table)

    def update(self, raw: Grid, windows: Iterable[Window]) -> list[Window]:
        """Take in that `raw` changed inside these windows; return the windows of `cost` that were rewritten."""
        rewritten = (Window(*inflate_window(raw, self._table, *window, self.cost)) for window in windows)
        return [window for window in rewritten if not window.empty]

    def whole(self, raw: Grid) -> Grid:
        """Return the inflation of a whole map, computed from scratch."""
        return inflate(raw, self._table)
