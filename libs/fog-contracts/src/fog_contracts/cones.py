"""What a sensor node's sonars see: sectors between the node, their range limits and the walls, as polygons. Pure.

Lengths in m, angles in rad, frame `map`. A sonar's cone ends at its range limit or before the first wall of the map.
"""

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import FREE
from fog_contracts.geometry import GeometryError, Point, normalized_polygon
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.shapes import rasterize, rasterize_line
from fog_contracts.site import NodeSite

_Floats = NDArray[np.float64]

SONAR_HALF_CONE: Final = math.radians(7.5)
"""Half of a sonar's beam: the HC-SR04's cone is 15 degrees wide (Mendes 2022, section 3.3)."""
_RAYS: Final = 17
_STEPS_PER_CELL: Final = 4
_BRIDGED: Final = 2.0 * SONAR_HALF_CONE
"""Cones that lie no farther apart have no gap between them that a person fits into unseen."""
_NECK_M: Final = 0.02
"""So near an HC-SR04 measures nothing (datasheet): there the outline joins cones that lie farther apart, and what looks
at a wall nearer than that ends there, so that the outline touches the node once only."""
_DECIMALS: Final = 4


SEEN_BESIDE_M: Final = 0.25
"""Half the width of a person, or of a box that is worth a detour: it is seen where it touches a cone."""


class ConeError(ValueError):
    """A node's sonars see nothing that could be an area; the message says why, and what to change."""


def sonar_cone(node: NodeSite, sonar: int, static: StaticMap) -> list[Point]:
    """Return the outline of what one sonar of a node sees: the node, then the ends of its rays, counter-clockwise."""
    angles = _angles(node, sonar)
    ends = _ends(node, angles, np.full(angles.size, node.sonars[sonar].range_limit), static)
    return [(node.x, node.y), *map(tuple, ends.tolist())]


def node_cone(node: NodeSite, static: StaticMap) -> list[Point]:
    """Return the outline of what all sonars of a node see together, a simple polygon that runs counter-clockwise.

    Neighbouring cones are one if no person fits between them. Raises `ConeError` when the node stands in a wall, or all
    of its sonars look at one right in front of it.
    """
    covered = [_angles(node, sonar) for sonar in range(len(node.sonars))]
    angles = _from_widest_gap(np.unique(np.concatenate(covered) % math.tau))
    limits = np.zeros(angles.size)
    for sonar in node.sonars:
        off_axis = np.abs(np.remainder(angles - node.theta - sonar.angle + math.pi, math.tau) - math.pi)
        limits = np.maximum(limits, np.where(off_axis <= SONAR_HALF_CONE + 1e-9, sonar.range_limit, 0.0))
    outline: list[Point] = [(node.x, node.y)]
    ends = _ends(node, angles, limits, static)
    reach = np.hypot(ends[:, 0] - node.x, ends[:, 1] - node.y)
    if reach.max() < _NECK_M:
        raise _sees_nothing(node)
    nearest = np.array((node.x, node.y)) + _NECK_M * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    ends = np.where(reach[:, None] < _NECK_M, nearest, ends)
    for (before, after), (x, y) in zip(pairwise([angles[0], *angles.tolist()]), ends.tolist(), strict=True):
        if after - before > _BRIDGED:
            middle = 0.5 * (before + after)
            outline.append((node.x + _NECK_M * math.cos(middle), node.y + _NECK_M * math.sin(middle)))
        outline.append((x, y))
    try:
        return normalized_polygon([(round(x, _DECIMALS), round(y, _DECIMALS)) for x, y in outline])
    except GeometryError as error:
        raise _sees_nothing(node) from error


def _sees_nothing(node: NodeSite) -> ConeError:
    return ConeError(
        f"node {node.id} at ({node.x:g}, {node.y:g}) sees nothing: it stands in a wall of the map, or looks at one "
        "right in front of it. Move or turn it"
    )


def node_cones(nodes: Iterable[NodeSite], static: StaticMap) -> dict[str, list[Point]]:
    """Return the outlines by node; nodes that see nothing are left out."""
    cones = {}
    for node in nodes:
        try:
            cones[node.id] = node_cone(node, static)
        except ConeError:
            continue
    return cones


def sonar_cones(nodes: Iterable[NodeSite], static: StaticMap) -> dict[str, list[list[Point]]]:
    """Return the outlines of what each sonar of a node sees, by node."""
    return {
        node.id: [
            [(round(x, _DECIMALS), round(y, _DECIMALS)) for x, y in sonar_cone(node, sonar, static)]
            for sonar in range(len(node.sonars))
        ]
        for node in nodes
    }


def seen_cells(cones: Iterable[list[Point]], geometry: GridGeometry) -> NDArray[np.bool_]:
    """Return the cells (height, width) from which something half a metre wide touches one of the cones."""
    seen = np.zeros(geometry.shape, dtype=np.bool_)
    for cone in cones:
        for window, mask in (rasterize(cone, geometry), rasterize_line([*cone, cone[0]], SEEN_BESIDE_M, geometry)):
            seen[window.rows, window.columns] |= mask
    return seen


def seen_share(area: list[Point], nodes: Iterable[NodeSite], static: StaticMap) -> float:
    """Return on which share of an area's free floor something half a metre wide touches a cone of the nodes (0 to 1).

    The height of cones and things does not count: what is lower than a cone is not seen either.
    """
    window, mask = rasterize(area, static.geometry)
    floor = mask & (static.cells[window.rows, window.columns] == FREE)
    if not floor.any():
        return 0.0
    cones = [cone for outlines in sonar_cones(nodes, static).values() for cone in outlines]
    seen = seen_cells(cones, static.geometry.part(window)) & floor
    return float(np.count_nonzero(seen)) / int(np.count_nonzero(floor))


def _angles(node: NodeSite, sonar: int) -> _Floats:
    middle = node.theta + node.sonars[sonar].angle
    return np.linspace(middle - SONAR_HALF_CONE, middle + SONAR_HALF_CONE, _RAYS)


def _from_widest_gap(
    angles: _Floats,
) -> _Floats:
    """Return ascending angles, from the one after the widest gap on, where the outline passes the node."""
    start = int(np.argmax(np.diff(angles, append=angles[0] + math.tau))) + 1
    return np.concatenate((angles[start:], angles[:start] + math.tau))


def _ends(
    node: NodeSite,
    angles: _Floats,
    limits: _Floats,
    static: StaticMap,
) -> _Floats:
    """Return where rays (n,) from a node end ((n, 2)): at their limits, or on the last free step before a wall."""
    step = static.geometry.resolution / _STEPS_PER_CELL
    along = np.arange(0.0, float(limits.max()) + step, step)
    lengths = np.minimum(along[None, :], limits[:, None])
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    points = np.array((node.x, node.y)) + lengths[:, :, None] * directions[:, None, :]
    free = static.geometry.sample(static.cells, points.reshape(-1, 2), outside=255).reshape(lengths.shape) == FREE
    reached = np.where(free.all(axis=1), free.shape[1], np.argmin(free, axis=1))
    last = np.maximum(reached - 1, 0)
    ends: _Floats = points[np.arange(angles.size), last]
    return ends
