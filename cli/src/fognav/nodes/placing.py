"""Where a new node looks, and from which distance on an echo means a hazard: from the map. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.cones import SONAR_HALF_CONE, sonar_cone
from fog_contracts.costs import FREE
from fog_contracts.raster import rasterize
from fog_contracts.site import NodeSite, Sonar
from fog_kernels.raycast import cast
from fognav_sim.sensors import SONAR_MAX_M

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import StaticMap
    from fog_contracts.site import AreaSite

ANGLES: Final = (-0.22, 0.22)
"""The directions of the two sonars in the printed case (rad, relative to the node's)."""
WALL_MARGIN_M: Final = 0.30
"""The limit ends this far before the opposite wall."""
RELIABLE_M: Final = SONAR_MAX_M - 0.2
"""Up to here a wall echoes reliably."""
NEAREST_LIMIT_M: Final = 0.3
_RAYS: Final = 15


class PlacingError(ValueError):
    """A node at this pose would be of no use; the message says why, and what to change."""


def sonar_limits(static: StaticMap, pose: tuple[float, float, float], angles: Sequence[float] = ANGLES) -> list[Sonar]:
    """Return the sonars of a node at a pose (m, m, rad; frame `map`), each limited by the wall opposite on the map.

    Raises `PlacingError` for a node in a wall, or one that looks at a wall.
    """
    x, y, theta = pose
    geometry, walls = static.geometry, (static.cells != FREE).astype(np.uint8)
    if not geometry.contains(x, y):
        raise PlacingError(
            f"({x:g}, {y:g}) is not on the map: it reaches from {geometry.bounds[:2]} to {geometry.bounds[2:]}"
        )
    column, row = geometry.cell(x, y)
    if walls[row, column]:
        raise PlacingError(f"({x:g}, {y:g}) is in a wall on the map: name a point some centimetres off it")
    sonars = []
    for angle in angles:
        directions = theta + angle + np.linspace(-SONAR_HALF_CONE, SONAR_HALF_CONE, _RAYS)
        origin = (geometry.resolution, geometry.origin_x, geometry.origin_y)
        echo = float(cast(walls, *origin, x, y, directions, SONAR_MAX_M + 1.0).min())
        limit = min(echo, RELIABLE_M) - WALL_MARGIN_M
        if limit < NEAREST_LIMIT_M:
            raise PlacingError(
                f"the sonar at {math.degrees(angle):.0f} degrees looks at a wall {echo:.2f} m away: turn the node "
                "(the third number of its pose) into the corridor, or move it"
            )
        sonars.append(Sonar(angle=angle, range_limit=round(limit, 2), no_echo_is_clear=echo > RELIABLE_M))
    return sonars


def check_sees(node: NodeSite, area: AreaSite, static: StaticMap) -> None:
    """Raise `PlacingError` unless a cone of the node reaches its area."""
    window, mask = rasterize(area.polygon, static.geometry)
    inside = np.zeros(static.geometry.shape, dtype=np.bool_)
    inside[window.rows, window.columns] = mask
    for sonar in range(len(node.sonars)):
        seen, cells = rasterize(sonar_cone(node, sonar, static), static.geometry)
        if (inside[seen.rows, seen.columns] & cells).any():
            return
    raise PlacingError(f"the node would see nothing of area {area.id}: check its pose, above all the direction")
