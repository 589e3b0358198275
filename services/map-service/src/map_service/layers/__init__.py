"""The layers of the costmap, one file each, and their order.

A layer says which windows it changed and paints its opinion inside a window, on top of what the layers before it
painted; it never lowers a cost. To change a layer, change its file; to add one, add a file that keeps
`map_service.layers.protocol.Layer` and put it into `stack`. Inflation comes last and reads what all have painted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from map_service.layers.hazards import HazardsLayer
from map_service.layers.inflation import InflationLayer
from map_service.layers.obstacles import ObstaclesLayer
from map_service.layers.static import StaticLayer
from map_service.layers.zones import ZonesLayer

if TYPE_CHECKING:
    from fog_contracts.grid import GridGeometry
    from map_service.layers.protocol import Grid, Layer

__all__ = ["HazardsLayer", "InflationLayer", "ObstaclesLayer", "Stack", "StaticLayer", "ZonesLayer", "stack"]


class Stack(NamedTuple):
    """The painting layers by name; `order` is bottom first."""

    hazards: HazardsLayer
    zones: ZonesLayer
    obstacles: ObstaclesLayer
    order: tuple[Layer, ...]


def stack(geometry: GridGeometry, static: Grid) -> Stack:
    """Return fresh layers over a map; `static` is uint8 (height, width): 0 free, 254 occupied, 255 unknown."""
    hazards = HazardsLayer(geometry)
    zones = ZonesLayer(geometry)
    obstacles = ObstaclesLayer(geometry)
    return Stack(hazards, zones, obstacles, (StaticLayer(static), hazards, zones, obstacles))
