"""Proposes a site on any map: start, goal, areas to watch, and sensor nodes. Pure, seeded.

A proposal is a starting point: it considers walls, not how people use the floor.
"""

import math
import random
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from fog_contracts.cones import SONAR_HALF_CONE
from fog_contracts.costs import DEFAULT_INFLATION, FREE, LETHAL, ROBOT_RADIUS
from fog_contracts.geometry import Point
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import AreaState, Place, Pose
from fog_contracts.shapes import rasterize
from fog_contracts.site import AreaSite, DemoPlan, NodeSite, RobotSite, Site, Sonar
from fog_kernels.astar import Planner
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from fog_kernels.sonar import classify, default_config
from fognav.nodes.placing import ANGLES, bounded, heard
from fognav_sim.barrier import BarrierError, barrier_across
from fognav_sim.floor import Floor

PLACE_CLEARANCE_M: Final = 0.45
DRIVE_M: Final = (15.0, 60.0)
"""Length of the demo's path: long enough for a hazard ahead, short enough to watch."""
_ENDS_M: Final = (8.0, 3.0)
"""Minimum distances along the path from the start to an area and from an area to the goal."""
_SCALES: Final = (1.0, 0.5, 0.25)
"""Where no path is as long, these shares of the distances do: a flat has no corridor of 15 m."""
_CORRIDOR_M: Final = (0.9, 4.2)
_EVEN_M: Final = 2.4
"""So far along a corridor its walls must be even where an area is proposed."""
_SHORTEST_M: Final = 0.8
_SONAR_MAX_M: Final = 3.8
"""A little less than the sonar's specified range (4 m): the opposite wall must echo reliably."""
_WALL_MARGIN_M: Final = 0.35
_MOUNT_GAP_M: Final = 0.06
_NODE_HEIGHT_M: Final = 0.3
_CANDIDATE_STEP_M: Final = 1.0
_AREA_SPACING_M: Final = 4.0
_MAX_DETOUR: Final = 4.0
_MAX_AREAS: Final = 3
_DRIVES: Final = 100
"""How many paths are looked at."""
_PAIRS: Final = 3000
"""How many pairs of ends are drawn for them: on a large or branched floor most have no path of a suitable length."""
_HEADINGS: Final = 36
_PLACES_APART_M: Final = 6.0
_MOST_PLACES: Final = 8
_MOST_AREAS: Final = 12
_NEIGHBOURS: Final = 2
"""From each place the ways to so many of its nearest ones are watched, ..."""
_NODES_APART_M: Final = 10.0
"""... by nodes that are so far apart."""
_BLOCK_M: Final = 1.0
"""A place is the widest spot in a square of this side, ..."""
_MOST_BLOCKS: Final = 300
"""... or of a larger one, where a map has more of them along a side."""
_BARRIERS: Final = 8
_UNSEEN: Final = "have walls from which a sonar opposite does not get a clear echo, or too near for one"


class NoSiteError(ValueError):
    """The map has no path that is long enough for a robot; the message gives the criteria."""


class Proposal(NamedTuple):
    """A site; `why`: why it has no watched area, and what to do, "" if it has some."""

    site: Site
    why: str


class _NoAreaError(ValueError):
    """A spot can't be watched; the message says why, in words that fit other spots too."""


@dataclass(frozen=True)
class _Floor:
    """The map, and the grids that a proposal needs."""

    geometry: GridGeometry
    raw: NDArray[np.uint8]
    walls: NDArray[np.uint8]
    cost: NDArray[np.uint8]
    clearance: NDArray[np.float64]
    echoing: Floor
    """What a sonar would meet: only what the map shows as occupied echoes, unknown cells do not."""
    scale: float = 1.0
    """Share of the usual distances between places and areas: a flat is smaller than an office floor."""

    def inflated(self, raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
        table = inflation_table(self.geometry.resolution, DEFAULT_INFLATION)
        return inflate(raw, table)

    def ranges(self, at: Point, angles: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
        """Return the distance (m) to the first wall in each direction, at most `reach`."""
        g = self.geometry
        found = cast(self.walls, g.resolution, g.origin_x, g.origin_y, *at, angles, reach)
        return np.minimum(found, reach)


@dataclass(frozen=True)
class _Drive:
    """A path with areas on it that the robot can drive around."""

    start: Pose
    goal: Point
    areas: list[tuple[AreaSite, NodeSite]]
    length: float


def propose(  # a map, and what is wanted on it
    name: str,
    map_path: str,
    geometry: GridGeometry,
    cells: NDArray[np.uint8],
    seed: int = 1,
    *,
    whole_floor: bool = False,
) -> Proposal:
    """Return a site on the map (`cells`: 0 free, 254 occupied, 255 unknown); raises `NoSiteError`.

    With any one of the demo's areas blocked there is another path. A map without such areas gets a demo without areas.
    `whole_floor`: with places all over the floor that the robot can reach, and areas on the ways to them, too.
    """
    whole = _floor(geometry, cells)
    best: _Drive | None = None
    for scale in _SCALES:
        floor = replace(whole, scale=scale)
        drives, reasons = 0, Counter[str]()
        for drive in _drives(floor, random.Random(seed), reasons):  # noqa: S311  # repeatable, not a secret
            drives += 1
            if best is None or _rank(drive) > _rank(best):
                best = drive
            if len(best.areas) >= 2:  # enough for the demo to choose from
                break
        if best is not None:
            break
    else:
        raise NoSiteError(
            f"no path of {_SCALES[-1] * DRIVE_M[0]:.0f} m or more was found between two points with "
            f"{PLACE_CLEARANCE_M} m of clearance. Check the map's resolution and thresholds"
        )
    places = {
        "a": Place(x=best.start.x, y=best.start.y, label="A"),
        "b": Place(x=best.goal[0], y=best.goal[1], label="B"),
    }
    watched = list(best.areas)
    if whole_floor:
        further = _places(floor, [(place.x, place.y) for place in places.values()])
        for letter, (x, y) in zip("cdefgh", further, strict=False):
            places[letter] = Place(x=x, y=y, label=letter.upper())
        watched = _on_the_ways(floor, watched, [(place.x, place.y) for place in places.values()], reasons)
    areas = [area for area, _ in watched]
    site = Site(
        id=name,
        name=name,
        map=map_path,
        places=places,
        areas=areas,
        nodes=[node for _, node in watched],
        robots=[RobotSite(id="r1", start=best.start, radius=ROBOT_RADIUS)],
        demo=DemoPlan(start="a", goal="b", areas=[area.id for area, _ in best.areas]),
    )
    return Proposal(site, "" if areas else _why(drives, reasons, floor.scale))


def _places(floor: _Floor, known: list[Point]) -> list[Point]:
    """Return more places, each the widest spot of its surroundings, and as far as can be from all others.

    All can be reached from the known ones. Farthest point sampling (Gonzalez 1985).
    """
    geometry = floor.geometry
    side = max(1, round(_BLOCK_M / geometry.resolution), max(geometry.width, geometry.height) // _MOST_BLOCKS)
    components = Components(floor.cost)
    home = components.of(*geometry.cell(*known[0]))
    spots: list[Point] = []
    for y in range(0, geometry.height, side):
        for x in range(0, geometry.width, side):
            block = floor.clearance[y : y + side, x : x + side]
            row, column = divmod(int(np.argmax(block)), block.shape[1])
            if block[row, column] >= PLACE_CLEARANCE_M and components.of(x + column, y + row) == home:
                spots.append(geometry.centre(x + column, y + row))
    found: list[Point] = []
    while spots and len(known) + len(found) < _MOST_PLACES:
        away = [min(math.dist(spot, other) for other in (*known, *found)) for spot in spots]
        farthest = max(range(len(spots)), key=away.__getitem__)
        if away[farthest] < floor.scale * _PLACES_APART_M:
            break
        found.append((round(spots[farthest][0], 3), round(spots[farthest][1], 3)))
    return found


def _on_the_ways(
    floor: _Floor, watched: list[tuple[AreaSite, NodeSite]], places: list[Point], reasons: Counter[str]
) -> list[tuple[AreaSite, NodeSite]]:
    """Return the watched areas, and more on the paths from each place to its nearest ones, apart from all others."""
    planner = Planner(floor.geometry.width, floor.geometry.height)
    found = list(watched)
    ways = {
        tuple(sorted((place, other)))
        for place in places
        for other in sorted(places, key=lambda other, place=place: math.dist(place, other))[1 : 1 + _NEIGHBOURS]  # type: ignore[misc]  # mypy does not see that the lambda has a default
    }
    for ends in sorted(ways):
        start, goal = (floor.geometry.cell(*end) for end in ends)
        route = planner.plan(floor.cost, start, goal)
        path = [(x, y) for x, y in floor.geometry.centres(route.cells).tolist()] if route.found else []
        for area, node in _areas(floor, planner, path, _length(path), start, goal, reasons):
            apart = min((math.dist((node.x, node.y), (other.x, other.y)) for _, other in found), default=math.inf)
            if apart < floor.scale * _NODES_APART_M or len(found) == _MOST_AREAS:
                continue
            name = f"z{len(found) + 1}"
            area = structs.replace(area, id=name, label=name.upper(), number=len(found) + 1)  # noqa: PLW2901  # same one
            found.append((area, structs.replace(node, id=f"node-{len(found) + 1}", area=name)))
    return found


def _why(drives: int, reasons: Counter[str], scale: float) -> str:
    """Return why no spot on any path was good for a watched area, the most frequent reason first."""
    tried = sum(reasons.values())
    if not tried:
        first, both = scale * _ENDS_M[0], scale * sum(_ENDS_M)
        return (
            f"{drives} paths were looked at, and none goes on for more than {both:.0f} m: areas are proposed "
            f"{first:.0f} m behind the start at the earliest. Write your own areas into it, see docs/maps.md"
        )
    found = "; ".join(f"{count} {reason}" for reason, count in reasons.most_common())
    return (
        f"{tried} places on {drives} paths were looked at: {found}. Write areas and nodes of your own into it where a "
        "sensor can watch the whole width, or try another --seed"
    )


def _rank(drive: _Drive) -> tuple[int, float]:
    return min(len(drive.areas), 2), -abs(drive.length - 30.0)


def _floor(geometry: GridGeometry, cells: NDArray[np.uint8]) -> _Floor:
    # Unknown cells may be walls: a proposal avoids them.
    raw = np.where(cells == FREE, np.uint8(FREE), np.uint8(LETHAL))
    walls = (raw == LETHAL).astype(np.uint8)
    cap = max(1, math.ceil(2.0 / geometry.resolution))
    clearance = np.sqrt(squared_distance_capped(walls, cap).astype(np.float64)) * geometry.resolution
    echoing = Floor(geometry, cells)
    half = _Floor(geometry, raw, walls, raw, clearance, echoing)
    return _Floor(geometry, raw, walls, half.inflated(raw), clearance, echoing)


def _drives(floor: _Floor, generator: random.Random, reasons: Counter[str]) -> Iterator[_Drive]:
    """Yield drives on the floor, and count in `reasons` why places on their paths have no area."""
    rows, columns = np.nonzero(floor.clearance >= PLACE_CLEARANCE_M)
    if rows.size == 0:
        return
    planner = Planner(floor.geometry.width, floor.geometry.height)
    drives = 0
    for _ in range(_PAIRS):
        if drives == _DRIVES:
            return
        i, j = generator.randrange(rows.size), generator.randrange(rows.size)
        start, goal = (int(columns[i]), int(rows[i])), (int(columns[j]), int(rows[j]))
        apart = math.dist(start, goal) * floor.geometry.resolution
        if not floor.scale * DRIVE_M[0] / 2 <= apart <= DRIVE_M[1]:
            continue
        found = planner.plan(floor.cost, start, goal)
        if not found.found:
            continue
        path = [(x, y) for x, y in floor.geometry.centres(found.cells).tolist()]
        length = _length(path)
        if not floor.scale * DRIVE_M[0] <= length <= DRIVE_M[1]:
            continue
        drives += 1
        areas = _areas(floor, planner, path, length, start, goal, reasons)
        ahead = path[min(len(path) - 1, round(1.0 / floor.geometry.resolution))]
        heading = math.atan2(ahead[1] - path[0][1], ahead[0] - path[0][0])
        pose = Pose(x=round(path[0][0], 3), y=round(path[0][1], 3), theta=round(heading, 3))
        yield _Drive(pose, (round(path[-1][0], 3), round(path[-1][1], 3)), areas, length)


def _length(path: list[Point]) -> float:
    return sum(math.dist(a, b) for a, b in pairwise(path))


def _areas(  # noqa: PLR0913  # a path with its ends, and what it lies on
    floor: _Floor,
    planner: Planner,
    path: list[Point],
    length: float,
    start: tuple[int, int],
    goal: tuple[int, int],
    reasons: Counter[str],
) -> list[tuple[AreaSite, NodeSite]]:
    """Return watched areas along the path, each of which has a detour; count in `reasons` why others were not taken."""
    found: list[tuple[AreaSite, NodeSite]] = []
    behind, before = (floor.scale * end for end in _ENDS_M)
    travelled, last, next_at = 0.0, -math.inf, behind
    for previous, point in pairwise(path):
        travelled += math.dist(previous, point)
        if travelled < next_at:
            continue
        next_at = travelled + _CANDIDATE_STEP_M
        if travelled > length - before or travelled - last < _AREA_SPACING_M:
            continue
        try:
            candidate = _area_at(floor, point, len(found) + 1)
            _check_sensed(floor, *candidate)
            detour = _detour(floor, planner, candidate[0].polygon, start, goal)
            if detour is None:
                raise _NoAreaError("have no other way to the goal")  # noqa: TRY301  # as the two before it
            if detour > _MAX_DETOUR * length:
                raise _NoAreaError(f"have another way only that is more than {_MAX_DETOUR:.0f} times as long")  # noqa: TRY301  # same
        except _NoAreaError as error:
            reasons[str(error)] += 1
            continue
        found.append(candidate)
        last = travelled
        if len(found) == _MAX_AREAS:
            break
    return found


def _area_at(floor: _Floor, spot: Point, number: int) -> tuple[AreaSite, NodeSite]:
    """Return an area across the corridor at a spot with a node on its nearer wall; raises `_NoAreaError`."""
    headings = np.linspace(0.0, math.pi, _HEADINGS, endpoint=False, dtype=np.float64)
    reach = _CORRIDOR_M[1]
    one, other = floor.ranges(spot, headings, reach), floor.ranges(spot, headings + math.pi, reach)
    narrowest = int(np.argmin(one + other))
    width = float(one[narrowest] + other[narrowest])
    if not _CORRIDOR_M[0] <= width <= _CORRIDOR_M[1]:
        raise _NoAreaError(f"are no corridor of {_CORRIDOR_M[0]} to {_CORRIDOR_M[1]} m")
    across = float(headings[narrowest])
    near, far = float(other[narrowest]), float(one[narrowest])
    if near > far:
        across, near, far = across + math.pi, far, near
    # A different width half an area ahead or behind means a door or a corner.
    dx, dy = math.cos(across), math.sin(across)
    half = _EVEN_M / 2
    for side in (-half, half):
        beside = (spot[0] - dy * side, spot[1] + dx * side)
        if not floor.geometry.contains(*beside):
            raise _NoAreaError("are at the edge of the map")
        spread = floor.ranges(beside, np.array([across, across + math.pi]), reach)
        if abs(float(spread.sum()) - width) > 0.25 * width:
            raise _NoAreaError(f"are not as wide all along {_EVEN_M} m: a door, a corner or an uneven wall")
    mount = (spot[0] - dx * (near - _MOUNT_GAP_M), spot[1] - dy * (near - _MOUNT_GAP_M))
    sonars = []
    for angle in ANGLES:
        cone = across + angle + np.linspace(-SONAR_HALF_CONE, SONAR_HALF_CONE, 7)
        echo = float(floor.ranges(mount, cone, _SONAR_MAX_M + 1.0).min())
        limit = min(echo, _SONAR_MAX_M) - _WALL_MARGIN_M
        if limit < _CORRIDOR_M[0] / 2:
            raise _NoAreaError(_UNSEEN)
        sonars.append(Sonar(angle=angle, range_limit=round(limit, 2)))
    # As long as the cones together are wide where they end: what stands elsewhere would leave the area clear.
    half = max(_SHORTEST_M / 2, *(each.range_limit * math.sin(abs(each.angle) + SONAR_HALF_CONE) for each in sonars))
    corners = [
        (spot[0] + dx * u - dy * v, spot[1] + dy * u + dx * v)
        for u, v in ((-near, -half), (far, -half), (far, half), (-near, half))
    ]
    left, bottom, right, top = floor.geometry.bounds
    ring = [(round(min(max(x, left), right), 3), round(min(max(y, bottom), top), 3)) for x, y in corners]
    identifier = f"z{number}"
    area = AreaSite(id=identifier, label=identifier.upper(), number=number, polygon=ring)
    node = NodeSite(
        id=f"node-{number}",
        area=identifier,
        x=round(mount[0], 3),
        y=round(mount[1], 3),
        theta=round(math.remainder(across, math.tau), 4),
        height=_NODE_HEIGHT_M,
        sonars=sonars,
    )
    return area, bounded(floor.echoing, node)


def _check_sensed(floor: _Floor, area: AreaSite, node: NodeSite) -> None:
    """Raise `_NoAreaError` unless the simulated node is sure that its area is clear, and that a barrier blocks it.

    A wall may be too irregular, too oblique or unknown to echo; and no barrier may fit in for several seeds.
    """
    if _state_of(floor, node) != "clear":
        raise _NoAreaError(_UNSEEN)
    alone = Site(id="site", areas=[area], nodes=[node])
    static = StaticMap(floor.geometry, floor.raw)
    for seed in range(_BARRIERS):
        try:
            barrier = barrier_across(area, alone, static, seed)
        except BarrierError:
            raise _NoAreaError("have walls between which no barrier fits without a gap") from None
        floor.echoing.place(barrier)
        try:
            if _state_of(floor, node) != "blocked":
                raise _NoAreaError(_UNSEEN)
        finally:
            floor.echoing.remove(barrier.id)


def _state_of(floor: _Floor, node: NodeSite) -> AreaState:
    """Return what a node reports on the floor without a robot, measured without noise."""
    return classify(heard(floor.echoing, node), default_config(node))


def _detour(
    floor: _Floor, planner: Planner, polygon: list[Point], start: tuple[int, int], goal: tuple[int, int]
) -> float | None:
    """Return the length (m) of the path around a blocked area, or None if there is none."""
    raw = floor.raw.copy()
    window, mask = rasterize(polygon, floor.geometry)
    raw[window.rows, window.columns][mask] = LETHAL
    found = planner.plan(floor.inflated(raw), start, goal)
    if not found.found:
        return None
    return _length([(x, y) for x, y in floor.geometry.centres(found.cells).tolist()])
