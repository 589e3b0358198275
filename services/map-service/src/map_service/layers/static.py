"""The floor plan: the bottom of the costmap, the same for the life of the process."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fog_contracts.grid import Window
    from map_service.layers.protocol import Grid, Touch


class StaticLayer:
    """Paints the floor plan; `cells` is uint8 (height, width): 0 free, 254 occupied, 255 unknown."""

    def __init__(self, cells: Grid) -> None:
        self._cells = cells

    def tick(self, now: float, stamp: float) -> None:
        """Do nothing: a floor plan does not age."""

    def touched(self) -> list[Touch]:
        """Return nothing: a floor plan does not change."""
        return []

    def paint(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write the plan; it sets no speed limit."""
        cost[...] = self._cells[window.rows, window.columns]
        speed[...] = 0
