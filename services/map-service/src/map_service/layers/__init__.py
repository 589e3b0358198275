"""The layers of the costmap, one file each, and their order.

A layer marks the windows in which it changed and combines its costs into a window, on top of what the layers below it
wrote; it never lowers a cost. Inflation comes last and reads what all have written.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from map_service.layers.hazards import HazardsLayer
from map_service.layers.inflation import InflationLayer
from map_service.layers.obstacles import ObstaclesLayer
from map_service.layers.static import StaticLayer
from map_service.layers.zones import ZonesLayer

if TYPE_CHECKING:
    from fog_contracts.grid import GridGeometry
    from map_service.layers.base import CostLayer, Grid

__all__ = ["HazardsLayer", "InflationLayer", "ObstaclesLayer", "StaticLayer", "ZonesLayer", "standard"]


def standard(geometry: GridGeometry, static: Grid) -> list[CostLayer]:
    """Return fresh layers over a map, bottom first.

    `static` is uint8 (height, width): 0 free, 254 occupied, 255 unknown.
    """
    return [StaticLayer(static), HazardsLayer(geometry), ZonesLayer(geometry), ObstaclesLayer(geometry)]
