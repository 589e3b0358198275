"""Barriers that close a corridor from wall to wall. Pure."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import contains_point
from fog_contracts.messages import SimObstacle
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_contracts.site import AreaSite, NodeSite, Site

KEEP_AWAY_M: Final = 3.0
"""Nothing appears nearer to the robot than this."""
BARRIER_HEIGHT_M: Final = 1.0
_MAX_GAP_M: Final = 0.30
"""Widest gap beside a barrier; the robot needs 0.34 m."""
_NODE_OFFSET_M: Final = 0.20
"""A barrier begins this far in front of the node, where its sonars meet it at a right angle."""
_WALL_GAP_M: Final = 0.02
_THICKNESS_M: Final = (0.4, 0.8)
_MAX_SHIFT_M: Final = 0.1
_EDGE_TOLERANCE_M: Final = 0.4
_MAX_RAY_M: Final = 20.0
_ATTEMPTS: Final = 400
"""In a recorded corridor with uneven walls, one of ten drawn places may fit."""


class BarrierError(ValueError):
    """No barrier can be placed as wanted on this site; the message gives the reason."""


def barrier_across(area: AreaSite, site: Site, static: StaticMap, seed: int, *, name: str = "barrier") -> SimObstacle:
    """Return a box inside the area that a robot can't pass and that the area's nodes see.

    It spans the corridor along the beam of one of the area's nodes, from just in front of the node to the opposite wall
    (in an area without nodes, along its narrowest direction), without entering a wall. Raises `BarrierError` if the
    area has no such place.
    """
    generator = np.random.default_rng((seed, *area.id.encode()))
    nodes = [node for node in site.nodes if node.area == area.id]
    for _ in range(_ATTEMPTS):
        thickness = float(generator.uniform(*_THICKNESS_M))
        if nodes:
            node = nodes[int(generator.integers(len(nodes)))]
            box = _before_node(node, static, thickness, float(generator.uniform(-_MAX_SHIFT_M, _MAX_SHIFT_M)))
        else:
            box = _at_narrowest(area, static, thickness, float(generator.uniform(0.35, 0.65)))
        if box is not None and all(contains_point(area.polygon, *_shrunk(box, corner)) for corner in box):
            return SimObstacle(id=name, polygon=box, height=BARRIER_HEIGHT_M)
    raise BarrierError(
        f"area {area.id}: no barrier fits from wall to wall with gaps up to {_MAX_GAP_M} m: choose another area"
    )


def _shrunk(box: Sequence[tuple[float, float]], corner: tuple[float, float]) -> tuple[float, float]:
    """Move a corner towards the middle: a barrier ends at the walls and their recesses, an area may end before them."""
    mx, my = sum(x for x, _ in box) / len(box), sum(y for _, y in box) / len(box)
    share = min(1.0, _EDGE_TOLERANCE_M / math.dist(corner, (mx, my)))
    return corner[0] + share * (mx - corner[0]), corner[1] + share * (my - corner[1])


def _before_node(node: NodeSite, static: StaticMap, thickness: float, shift: float) -> list[tuple[float, float]] | None:
    direction = node.theta + sum(sonar.angle for sonar in node.sonars) / len(node.sonars)
    x, y = node.x - shift * math.sin(direction), node.y + shift * math.cos(direction)
    return _box(static, x, y, direction, thickness, begin=_NODE_OFFSET_M)


def _at_narrowest(
    area: AreaSite, static: StaticMap, thickness: float, share: float
) -> list[tuple[float, float]] | None:
    xs, ys = [x for x, _ in area.polygon], [y for _, y in area.polygon]
    x = min(xs) + share * (max(xs) - min(xs))
    y = min(ys) + share * (max(ys) - min(ys))
    if not contains_point(area.polygon, x, y):
        return None
    half = np.arange(0.0, math.pi, math.pi / 36)
    widths = _ray_lengths(static, x, y, half) + _ray_lengths(static, x, y, half + math.pi)
    return _box(static, x, y, float(half[int(np.argmin(widths))]), thickness, begin=None)


def _box(
    static: StaticMap, x: float, y: float, direction: float, thickness: float, *, begin: float | None
) -> list[tuple[float, float]] | None:
    """Return a box along `direction` around (x, y) from wall to wall, or from `begin` on; None if a gap is too wide.

    Each end is at the nearest point of the wall over the box's thickness, so that the box never enters a wall.
    """
    along = (math.cos(direction), math.sin(direction))
    across = (-along[1], along[0])
    offsets = np.linspace(-0.5, 0.5, 17) * thickness
    ahead = np.empty(len(offsets))
    behind = np.empty(len(offsets))
    for index, offset in enumerate(offsets):
        px, py = x + offset * across[0], y + offset * across[1]
        ahead[index], behind[index] = _ray_lengths(static, px, py, np.array([direction, direction + math.pi]))
    if not (np.isfinite(ahead).all() and np.isfinite(behind).all()):
        return None
    end = float(ahead.min()) - _WALL_GAP_M
    first = begin if begin is not None else _WALL_GAP_M - float(behind.min())
    if end <= first or float(ahead.max()) - end > _MAX_GAP_M or float(behind.max()) + first > _MAX_GAP_M:
        return None
    corners = itertools.chain(((first, -0.5), (end, -0.5)), ((end, 0.5), (first, 0.5)))
    return [
        (x + u * along[0] + v * thickness * across[0], y + u * along[1] + v * thickness * across[1]) for u, v in corners
    ]


def _ray_lengths(static: StaticMap, x: float, y: float, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths (m) of rays that end at the first cell that is not free."""
    grid = static.geometry
    return cast(static.cells, grid.resolution, grid.origin_x, grid.origin_y, x, y, angles, _MAX_RAY_M)
