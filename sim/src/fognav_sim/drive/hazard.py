"""Draws from a seed which area of a drive becomes blocked, when, and by which barrier. Pure."""

import itertools
import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from fog_contracts.geometry import Point, contains_point, distance_to_polygon
from fog_contracts.messages import SimObstacle
from fog_contracts.site import AreaSite, Site
from fognav_sim.scenario import KEEP_AWAY_M, ScenarioError

TRIGGER_M: Final = (3.0, 8.0)
"""Range of the travelled distance at which the path becomes blocked."""
BRAKING_ROOM_M: Final = 1.0
_STEP_M: Final = 0.05

MakeBarrier = Callable[[AreaSite], SimObstacle]
"""Makes a barrier that closes an area; raises `ScenarioError` if none fits."""


@dataclass(frozen=True)
class PlannedHazard:
    """A hazard to come: the area, the barrier in it, and the travelled distance (m) at which it appears."""

    area: AreaSite
    barrier: SimObstacle
    trigger_m: float


def entry_distance(path: Sequence[Point], polygon: Sequence[Point]) -> float | None:
    """Return the distance (m) along the path at which it first enters the polygon, or None when it never does."""
    travelled = 0.0
    for (x0, y0), (x1, y1) in itertools.pairwise(path):
        length = math.hypot(x1 - x0, y1 - y0)
        steps = max(1, math.ceil(length / _STEP_M))
        for step in range(steps + 1):
            t = step / steps
            if contains_point(polygon, x0 + t * (x1 - x0), y0 + t * (y1 - y0)):
                return travelled + t * length
        travelled += length
    return None


def path_length(path: Sequence[Point]) -> float:
    """Length (m) of a polyline."""
    return sum(math.dist(a, b) for a, b in itertools.pairwise(path))


def draw_trigger(seed: int) -> float:
    """Draw the travelled distance (m) at which the path becomes blocked."""
    return random.Random(seed).uniform(*TRIGGER_M)  # noqa: S311  # repeatable, not a secret


def draw_hazard(site: Site, path: Sequence[Point], seed: int, make_barrier: MakeBarrier) -> PlannedHazard:
    """Draw the area that becomes blocked, among the demo's areas that the path crosses, and when.

    The barrier appears early enough that the robot is still away from the area. Raises `ScenarioError` if no area
    qualifies; the message gives the reason for each.
    """
    wanted = site.demo.areas if site.demo else []
    known = {area.id: area for area in site.areas}
    generator = random.Random(seed)  # noqa: S311  # repeatable, not a secret
    trigger = generator.uniform(*TRIGGER_M)  # as draw_trigger; the area is drawn next
    candidates: list[PlannedHazard] = []
    reasons: list[str] = []
    for identifier in wanted:
        area = known[identifier]
        entry = entry_distance(path, area.polygon)
        if entry is None:
            reasons.append(f"the path does not cross {identifier}")
            continue
        latest = entry - KEEP_AWAY_M - BRAKING_ROOM_M
        if latest < 0:
            reasons.append(f"the path enters {identifier} after only {entry:.1f} m")
            continue
        try:
            candidates.append(PlannedHazard(area, make_barrier(area), min(trigger, latest)))
        except ScenarioError as error:
            reasons.append(str(error))
    if not candidates:
        reason = "; ".join(reasons) or "[demo] of site.toml lists no areas"
        raise ScenarioError(f"no area can be blocked on this path: {reason}. Choose other areas, or use --no-hazard")
    return generator.choice(candidates)


def is_clear_of_robot(hazard: PlannedHazard, robot: Point) -> bool:
    """Whether the robot is far enough away for the barrier to appear."""
    return min(distance_to_polygon(p, *robot) for p in (hazard.area.polygon, hazard.barrier.polygon)) >= KEEP_AWAY_M


class HazardSchedule:
    """Draws the hazard of one drive once its first path is known, and decides when to place the barrier."""

    def __init__(self, site: Site, seed: int, make_barrier: MakeBarrier) -> None:
        self._site = site
        self._seed = seed
        self._barrier_in = make_barrier
        self.planned: PlannedHazard | None = None

    def draw(self, path: Sequence[Point]) -> PlannedHazard:
        """Draw the hazard for a path, replacing any earlier one; raises `ScenarioError`."""
        self.planned = draw_hazard(self._site, path, self._seed, self._barrier_in)
        return self.planned

    def due(self, path: Sequence[Point], travelled_m: float, robot: Point) -> PlannedHazard | None:
        """Return the hazard whose barrier is to be placed now, or None while it is too early; raises `ScenarioError`.

        `path` is the robot's path from here on, `travelled_m` the distance that it has driven, `robot` its true
        position (m).
        """
        planned = self.planned or self.draw(path)
        if travelled_m < planned.trigger_m:
            return None
        if entry_distance(path, planned.area.polygon) is None or not is_clear_of_robot(planned, robot):
            # The path has changed (an obstacle, a service that was down): choose an area on the new one.
            planned = self.draw(path)
            if travelled_m < planned.trigger_m or not is_clear_of_robot(planned, robot):
                return None
        return planned
