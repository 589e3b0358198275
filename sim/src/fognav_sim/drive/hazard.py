"""Which area of a drive becomes blocked, when, and by what: drawn by a seed. Pure."""

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
"""Between these the travelled distance is drawn after which the way is blocked."""
BRAKING_ROOM_M: Final = 1.0
_STEP: Final = 0.05

BarrierIn = Callable[[AreaSite], SimObstacle]
"""Makes a barrier that closes an area; raises `ScenarioError` where none fits."""


@dataclass(frozen=True)
class PlannedHazard:
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


def draw_trigger(seed: int) -> float:
    """Draw the travelled distance (m) after which the way is blocked."""
    return random.Random(seed).uniform(*TRIGGER_M)  # noqa: S311  # drawn by a seed, no secret


def draw_hazard(site: Site, path: Sequence[Point], seed: int, barrier_in: BarrierIn) -> PlannedHazard:
    """Draw the area that becomes blocked, among the demo's areas that the path crosses, and the moment.

    The moment is early enough to keep the robot away from the area when the barrier appears. Raises `ScenarioError`
    when no area fits; the message says why.
    """
    wanted = site.demo.areas if site.demo else []
    known = {area.id: area for area in site.areas}
    generator = random.Random(seed)  # noqa: S311  # drawn by a seed, no secret
    trigger = generator.uniform(*TRIGGER_M)  # as draw_trigger; the area is drawn next
    fitting: list[PlannedHazard] = []
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
            fitting.append(PlannedHazard(area, barrier_in(area), min(trigger, latest)))
        except ScenarioError as error:
            reasons.append(str(error))
    if not fitting:
        why = "; ".join(reasons) or "[demo] of site.toml lists no areas"
        raise ScenarioError(f"no area can be blocked on this way: {why}. Choose other areas, or use --no-hazard")
    return generator.choice(fitting)


def may_appear(hazard: PlannedHazard, robot: Point) -> bool:
    """Whether the robot is far enough away for the barrier to appear."""
    return min(distance_to_polygon(p, *robot) for p in (hazard.area.polygon, hazard.barrier.polygon)) >= KEEP_AWAY_M


class HazardSchedule:
    """Draws the hazard of one drive when its first path is known, and says when to place the barrier."""

    def __init__(self, site: Site, seed: int, barrier_in: BarrierIn) -> None:
        self._site = site
        self._seed = seed
        self._barrier_in = barrier_in
        self.planned: PlannedHazard | None = None

    def draw(self, path: Sequence[Point]) -> PlannedHazard:
        """Draw the hazard for a path, in place of any before; raises `ScenarioError`."""
        self.planned = draw_hazard(self._site, path, self._seed, self._barrier_in)
        return self.planned

    def due(self, path: Sequence[Point], travelled_m: float, robot: Point) -> PlannedHazard | None:
        """Return the hazard whose barrier is to be placed now, or None while it is too early; raises `ScenarioError`.

        `path` is the robot's way from here on, `travelled_m` what it has driven, `robot` where it really is (m).
        """
        planned = self.planned or self.draw(path)
        if travelled_m < planned.trigger_m:
            return None
        if along(path, planned.area.polygon) is None or not may_appear(planned, robot):
            # The way has changed meanwhile (an obstacle, a service that was away): another area, from here on.
            planned = self.draw(path)
            if travelled_m < planned.trigger_m or not may_appear(planned, robot):
                return None
        return planned
