"""What a site's sensor nodes see: the share of each watched area, and the blind stretches of each route. Pure.

A sonar sees what stands in its cone nearer than its range limit and before the first wall. What is looked for is as
wide as a person, so it is seen when it touches a cone (`fog_contracts.cones`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.cones import seen_cells, seen_share, sonar_cone
from fog_contracts.costs import DEFAULT_INFLATION, FREE, LETHAL
from fog_contracts.geometry import lengths_along
from fog_contracts.shapes import rasterize
from fog_kernels.astar import Planner, nearest_traversable
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from fognav_sim.sensors import LIDAR_MAX_M

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import Place
    from fog_contracts.site import Site

SPEED_M_S: Final = 0.3
_PLACE_REACH_M: Final = 0.5
_SIGHT_STEP_M: Final = 0.25


@dataclass(frozen=True)
class AreaCoverage:
    """How much of an area its own nodes see: the share of its free floor, and the cones' outlines."""

    area: str
    nodes: list[str]
    share: float
    cones: list[list[Point]]


@dataclass(frozen=True)
class Lead:
    """What an area's nodes are worth on a route.

    `entry_m`: where the route enters the area; `lidar_m`: how long before the spot the robot's own lidar first
    sees it; `lead_s`: by how much the fog may know earlier, at the robot's full speed.
    """

    area: str
    entry_m: float
    lidar_m: float
    lead_s: float


@dataclass(frozen=True)
class RouteCoverage:
    """A route between two places.

    `points` (m, shape (n, 2)) and how far each is `travelled` from the start (m); the `blind` stretches, which no node
    sees, from and to (m from the start).
    """

    start: str
    goal: str
    points: NDArray[np.float64]
    travelled: NDArray[np.float64]
    blind: list[tuple[float, float]]
    leads: list[Lead]

    @property
    def length_m(self) -> float:
        """The length of the route."""
        return float(self.travelled[-1])

    @property
    def blind_m(self) -> float:
        """The length of all blind stretches together."""
        return sum(end - begin for begin, end in self.blind)


@dataclass(frozen=True)
class Coverage:
    """What all nodes of a site see; `unreachable` are pairs of places without a way between them."""

    areas: list[AreaCoverage]
    routes: list[RouteCoverage]
    unreachable: list[tuple[str, str]]


def coverage(site: Site, static: StaticMap) -> Coverage:
    """Return what the nodes of a site see on its map."""
    walls = (static.cells != FREE).astype(np.uint8)
    areas = []
    for area in site.areas:
        nodes = [node for node in site.nodes if node.area == area.id]
        cones = [sonar_cone(node, sonar, static) for node in nodes for sonar in range(len(node.sonars))]
        share = seen_share(area.polygon, nodes, static)
        areas.append(AreaCoverage(area.id, [node.id for node in nodes], share, cones))
    seen = seen_cells([cone for area in areas for cone in area.cones], static.geometry)
    rings = {area.id: area.polygon for area in site.areas}
    planner = Planner(static.geometry.width, static.geometry.height)
    cost = inflate(
        np.where(walls, np.uint8(LETHAL), np.uint8(FREE)),
        inflation_table(static.geometry.resolution, DEFAULT_INFLATION),
    )
    routes, unreachable = [], []
    for (start, a), (goal, b) in combinations(sorted(site.places.items()), 2):
        points = _route(planner, cost, static, a, b)
        if points is None:
            unreachable.append((start, goal))
            continue
        travelled = lengths_along(points)
        columns, rows = _cells(static, points)
        routes.append(
            RouteCoverage(
                start=start,
                goal=goal,
                points=points,
                travelled=travelled,
                blind=_stretches(~seen[rows, columns], travelled),
                leads=_leads(rings, points, travelled, static, walls),
            )
        )
    return Coverage(areas, routes, unreachable)


def _route(
    planner: Planner, cost: NDArray[np.uint8], static: StaticMap, start: Place, goal: Place
) -> NDArray[np.float64] | None:
    reach = round(_PLACE_REACH_M / static.geometry.resolution)
    ends = [nearest_traversable(cost, static.geometry.cell(place.x, place.y), reach) for place in (start, goal)]
    if ends[0] is None or ends[1] is None:
        return None
    found = planner.plan(cost, ends[0], ends[1])
    return static.geometry.centres(found.cells) if found.found else None


def _cells(static: StaticMap, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    cells, _ = static.geometry.cells(points)
    return cells[:, 0], cells[:, 1]


def _stretches(blind: NDArray[np.bool_], travelled: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return where a route is blind: from the first to the last point of each run."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], blind, [False])).astype(np.int8)))
    return [
        (float(travelled[begin]), float(travelled[end - 1])) for begin, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _leads(
    rings: dict[str, list[Point]],
    points: NDArray[np.float64],
    travelled: NDArray[np.float64],
    static: StaticMap,
    walls: NDArray[np.uint8],
) -> list[Lead]:
    columns, rows = _cells(static, points)
    found = []
    for area, ring in rings.items():
        window, mask = rasterize(ring, static.geometry)
        inside = np.zeros(static.geometry.shape, dtype=np.bool_)
        inside[window.rows, window.columns] = mask
        within = np.flatnonzero(inside[rows, columns])
        if within.size == 0:
            continue
        # A hazard stands in the middle of what the route crosses of the area.
        spot = int(within[within.size // 2])
        sight = travelled[spot] - travelled[_first_sight(points, travelled, spot, static, walls)]
        lead_s = float(travelled[spot] - sight) / SPEED_M_S
        found.append(Lead(area, float(travelled[within[0]]), float(sight), lead_s))
    return sorted(found, key=lambda lead: lead.entry_m)


def _first_sight(
    points: NDArray[np.float64],
    travelled: NDArray[np.float64],
    spot: int,
    static: StaticMap,
    walls: NDArray[np.uint8],
) -> int:
    """Return the first point of the route from which the robot's lidar sees the route's point `spot`."""
    g = static.geometry
    next_at = -math.inf
    for index in range(spot):
        if travelled[index] < next_at:
            continue
        next_at = travelled[index] + _SIGHT_STEP_M
        (x, y), (dx, dy) = points[index], points[spot] - points[index]
        distance = math.hypot(dx, dy)
        if distance > LIDAR_MAX_M:
            continue
        angle = np.array([math.atan2(dy, dx)])
        if (
            float(cast(walls, g.resolution, g.origin_x, g.origin_y, x, y, angle, distance)[0])
            >= distance - g.resolution
        ):
            return index
    return spot
