"""Where a new node looks, and from which distance on an echo means a hazard: from the map. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import structs

from fog_contracts.cones import SONAR_HALF_CONE, sonar_cone
from fog_contracts.costs import FREE
from fog_contracts.shapes import rasterize
from fog_contracts.site import NodeSite, Sonar
from fog_kernels.raycast import cast
from fog_kernels.sonar import SONAR_MAX_M
from fognav_sim.floor import Floor
from fognav_sim.sensors import Noise, Robot, Sonars

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import NodeCalibration
    from fog_contracts.site import AreaSite

ANGLES: Final = (-0.22, 0.22)
"""The directions of the two sonars in the printed case (rad, relative to the node's)."""
WALL_MARGIN_M: Final = 0.30
"""The limit ends this far before the opposite wall."""
BEHIND_WALL_M: Final = 0.30
"""An echo from so much farther than the opposite wall comes from elsewhere (the firmware's `kBeyondMm`)."""
RELIABLE_M: Final = SONAR_MAX_M - 0.2
"""Up to here a wall echoes reliably."""
NEAREST_LIMIT_M: Final = 0.3
_RAYS: Final = 15
_TURNS: Final = [math.radians(sign * turn) for turn in range(5, 65, 5) for sign in (1, -1)]
_NO_NOISE: Final = Noise(sonar_sigma=0.0, sonar_spike=0.0)
_NO_ROBOT: Final = Robot(x=-1e6, y=-1e6, radius=0.1, height=0.1)


class PlacingError(ValueError):
    """A node at this pose would be of no use; the message says why, and what to change."""


def sonar_limits(static: StaticMap, pose: tuple[float, float, float], angles: Sequence[float] = ANGLES) -> list[Sonar]:
    """Return the sonars of a node at a pose (m, m, rad; frame `map`), each limited by the wall opposite on the map.

    What its silence means, only a calibration shows. Raises `PlacingError` for a node in a wall, or one that looks at a
    wall.
    """
    sonars = []
    for angle, wall in zip(angles, wall_ranges(static, pose, angles), strict=True):
        limit = min(wall, RELIABLE_M) - WALL_MARGIN_M
        if limit < NEAREST_LIMIT_M:
            raise PlacingError(
                f"the sonar at {math.degrees(angle):.0f} degrees looks at a wall {wall:.2f} m away: turn the node "
                "(the third number of its pose) into the corridor, or move it"
            )
        sonars.append(Sonar(angle=angle, range_limit=round(limit, 2)))
    return sonars


def wall_ranges(static: StaticMap, pose: tuple[float, float, float], angles: Sequence[float]) -> list[float]:
    """Return how far (m) from a pose the nearest wall of the map is in each sonar's cone; infinite beyond 5 m.

    Raises `PlacingError` for a pose in a wall, or off the map.
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
    origin = (geometry.resolution, geometry.origin_x, geometry.origin_y)
    spread = np.linspace(-SONAR_HALF_CONE, SONAR_HALF_CONE, _RAYS)
    return [float(cast(walls, *origin, x, y, theta + angle + spread, SONAR_MAX_M + 1.0).min()) for angle in angles]


def heard(floor: Floor, node: NodeSite) -> list[float | None]:
    """Return what each sonar of a node hears (m) of a floor without a robot, measured without noise; None: nothing."""
    sonars, generator = Sonars(floor), np.random.default_rng(0)
    return [sonars.measure(_NO_ROBOT, node, index, _NO_NOISE, generator) for index in range(len(node.sonars))]


def bounded(floor: Floor, node: NodeSite) -> NodeSite:
    """Return a node with the `range_max` of each sonar: 0.3 m behind the wall that it hears on the floor."""
    sonars = [
        structs.replace(sonar, range_max=None if echo is None else round(echo + BEHIND_WALL_M, 2))
        for sonar, echo in zip(node.sonars, heard(floor, node), strict=True)
    ]
    return structs.replace(node, sonars=sonars)


def unlike_the_map(static: StaticMap, node: NodeSite, learned: NodeCalibration) -> list[str]:
    """Return for each sonar that did not hear the map's wall where the map has it, what it learned instead.

    Raises `PlacingError` for a node in a wall.
    """
    walls = wall_ranges(static, (node.x, node.y, node.theta), [sonar.angle for sonar in node.sonars])
    echoes = heard(Floor(static.geometry, static.cells), node)
    found = []
    for index, (wall, echo) in enumerate(zip(walls, echoes, strict=True)):
        on_map = f"the map has a wall at {wall:.2f} m" if wall <= RELIABLE_M else "the map has no wall in range"
        limit = learned.range_limit_m[index]
        told = learned.range_max_m[index] if index < len(learned.range_max_m) else 0.0
        farthest = told or limit + 2 * BEHIND_WALL_M
        if learned.no_echo_is_clear[index]:
            if echo is not None and wall <= RELIABLE_M:
                found.append(f"sonar {index + 1} hears nothing, and {on_map}")
        elif not limit <= wall <= farthest and (echo is None or not limit <= echo <= farthest):
            found.append(f"sonar {index + 1} hears something between {limit:.2f} and {farthest:.2f} m, and {on_map}")
    return found


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


def hears(node: NodeSite) -> bool:
    """Whether a `bounded` node hears any wall: one that does not can never tell that nothing stands there."""
    return any(sonar.range_max is not None for sonar in node.sonars)


def heading_that_hears(static: StaticMap, node: NodeSite, area: AreaSite) -> float | None:
    """Return the heading (rad) nearest to a node's own by which it hears a wall and sees its area, None without one."""
    floor, angles = Floor(static.geometry, static.cells), [sonar.angle for sonar in node.sonars]
    for turn in sorted(_TURNS, key=abs):
        theta = round(math.remainder(node.theta + turn, math.tau), 2)
        try:
            turned = structs.replace(node, theta=theta, sonars=sonar_limits(static, (node.x, node.y, theta), angles))
            check_sees(turned, area, static)
        except PlacingError:
            continue
        if hears(bounded(floor, turned)):
            return theta
    return None
