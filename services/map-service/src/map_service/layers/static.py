"""The floor plan: the bottom layer, constant for the lifetime of the process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from map_service.layers.base import CostLayer, LayerFactory, NoOptions

if TYPE_CHECKING:
    from fog_contracts.grid import Window
    from map_service.layers.base import Grid


class StaticLayer(CostLayer):
    """Writes the floor plan; `cells` is uint8 (height, width): 0 free, 254 occupied, 255 unknown."""

    def __init__(self, cells: Grid) -> None:
        super().__init__()
        self._cells = cells

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the plan; it sets no speed limit."""
        cost[...] = self._cells[window.rows, window.columns]
        speed[...] = 0


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: StaticLayer(plan.cells))
