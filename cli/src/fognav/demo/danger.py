"""Which area becomes blocked, when, and by what: pure, drawn by a seed."""

import itertools
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from fog_contracts.geometry import Point, contains_point, distance_to_polygon
from fog_contracts.messages import SimObstacle
from fog_contracts.site import AreaSite, NodeSite, Site

TRIGGER_M: Final = (3.0, 8.0)
"""Between these the travelled distance is drawn after which the way is blocked."""
KEEP_AWAY_M: Final = 3.0
"""Nothing appears nearer to the robot than this."""
BRAKING_ROOM_M: Final = 1.0
_STEP: Final = 0.05
_THICKNESS: Final = 0.4
_REACH: Final = 2.0
_NODE_GAP: Final = 0.35
_NEAREST_ECHO: Final = 0.4
_RANGE_SHARE: Final = 0.85
"""The barrier stands well within the node's calibrated range, not at its edge."""
BARRIER_HEIGHT: Final = 1.0

IsFree = Callable[[float, float], bool]


class NoDangerError(ValueError):
    """No area of the site fits the way; the message says why."""


@dataclass(frozen=True)
class Danger:
    """What will happen: the area, the barrier in it, and the travelled distance (m) at which it appears."""

    area: AreaSite
    barrier: SimObstacle
    trigger_m: float


def along(path: Sequence[Point], polygon: Sequence[Point]) -> float | None:
    """Return the distance (m) along the path at which it first enters the polygon, or None when it never does."""
    travelled = 0.0
    for (x0, y0), (x1, y1) in itertools.pairwise(path):
        length = math.hypot(x1 - x0, y1 - y0)
        steps = max(1, math.ceil(length / _STEP))
        for step in range(steps + 1):
            t = step / steps
            if contains_point(polygon, x0 + t * (x1 - x0), y0 + t * (y1 - y0)):
                return travelled + t * length
        travelled += length
    return None


def path_length(path: Sequence[Point]) -> float:
    """Length (m) of a polyline."""
    return sum(math.dist(a, b) for a, b in itertools.pairwise(path))


def barrier(area: AreaSite, nodes: Sequence[NodeSite], path: Sequence[Point], is_free: IsFree) -> SimObstacle:
    """Return a barrier across the path inside the area, in the beam of one of its nodes.

    Raises `NoDangerError` when no point of the area is both in a beam and near the path.
    """
    watching = [node for node in nodes if node.area == area.id]
    if not watching:
        raise NoDangerError(f"area {area.id} has no node: nobody would see a barrier there")
    candidates = [
        spot
        for node in watching
        for sonar in node.sonars
        for spot in _beam(node, node.theta + sonar.angle, sonar.range_limit * _RANGE_SHARE)
        if contains_point(area.polygon, *spot) and is_free(*spot)
    ]
    if not candidates:
        raise NoDangerError(f"area {area.id}: its nodes' beams meet no free floor inside its polygon")
    spot = min(candidates, key=lambda p: _nearest(path, p)[0])
    _, heading = _nearest(path, spot)
    across = (-math.sin(heading), math.cos(heading))
    mounts = [(node.x, node.y) for node in watching]

    def stands(x: float, y: float) -> bool:
        clear = all(math.hypot(x - mx, y - my) >= _NODE_GAP for mx, my in mounts)
        return clear and contains_point(area.polygon, x, y) and is_free(x, y)

    left = _reach(spot, across, stands)
    right = _reach(spot, (-across[0], -across[1]), stands)
    forward = (math.cos(heading) * _THICKNESS / 2, math.sin(heading) * _THICKNESS / 2)
    ends = [(spot[0] + across[0] * left, spot[1] + across[1] * left)]
    ends.append((spot[0] - across[0] * right, spot[1] - across[1] * right))
    (ax, ay), (bx, by) = ends
    fx, fy = forward
    polygon = [(ax - fx, ay - fy), (bx - fx, by - fy), (bx + fx, by + fy), (ax + fx, ay + fy)]
    return SimObstacle(id="barrier", polygon=polygon, height=BARRIER_HEIGHT)


def _beam(node: NodeSite, direction: float, reach: float) -> list[Point]:
    steps = max(0, int((reach - _NEAREST_ECHO) / _STEP))
    distances = [_NEAREST_ECHO + step * _STEP for step in range(steps + 1)]
    return [(node.x + d * math.cos(direction), node.y + d * math.sin(direction)) for d in distances]


def _nearest(path: Sequence[Point], spot: Point) -> tuple[float, float]:
    """Return distance to the path and the path's heading there."""
    best = (math.inf, 0.0)
    for a, b in itertools.pairwise(path):
        dx, dy = b[0] - a[0], b[1] - a[1]
        squared = dx * dx + dy * dy
        if squared == 0:
            continue
        t = max(0.0, min(1.0, ((spot[0] - a[0]) * dx + (spot[1] - a[1]) * dy) / squared))
        distance = math.hypot(spot[0] - a[0] - t * dx, spot[1] - a[1] - t * dy)
        if distance < best[0]:
            best = (distance, math.atan2(dy, dx))
    return best


def _reach(spot: Point, direction: Point, stands: IsFree) -> float:
    """Return how far (m, at least half the thickness) a barrier may extend from the spot in a direction."""
    reach = 0.0
    while reach + _STEP <= _REACH and stands(
        spot[0] + direction[0] * (reach + _STEP), spot[1] + direction[1] * (reach + _STEP)
    ):
        reach += _STEP
    return max(reach, _THICKNESS / 4)


def choose(site: Site, path: Sequence[Point], seed: int, is_free: IsFree) -> Danger:
    """Draw the area that becomes blocked, among the demo's areas that the path crosses, and the moment.

    The moment is early enough to keep the robot away from the area when the barrier appears. Raises `NoDangerError`.
    """
    wanted = site.demo.areas if site.demo else []
    known = {area.id: area for area in site.areas}
    generator = random.Random(seed)
    trigger = generator.uniform(*TRIGGER_M)
    fitting: list[Danger] = []
    reasons: list[str] = []
    for identifier in wanted:
        area = known[identifier]
        entry = along(path, area.polygon)
        if entry is None:
            reasons.append(f"the way does not cross {identifier}")
            continue
        latest = entry - KEEP_AWAY_M - BRAKING_ROOM_M
        if latest < 0:
            reasons.append(f"{identifier} lies only {entry:.1f} m along the way")
            continue
        try:
            fitting.append(Danger(area, barrier(area, site.nodes, path, is_free), min(trigger, latest)))
        except NoDangerError as error:
            reasons.append(str(error))
    if not fitting:
        why = "; ".join(reasons) or "[demo] of site.toml lists no areas"
        raise NoDangerError(f"no area can be blocked on this way: {why}. Choose other areas, or use --no-hazard")
    return generator.choice(fitting)


def may_appear(danger: Danger, robot: Point) -> bool:
    """Whether the robot is far enough away for the barrier to appear."""
    return min(distance_to_polygon(p, *robot) for p in (danger.area.polygon, danger.barrier.polygon)) >= KEEP_AWAY_M
