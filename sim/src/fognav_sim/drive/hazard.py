"""Draws from a seed which area of a drive becomes blocked, when, and by which barrier. Pure."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from fog_contracts.geometry import contains_point, distance_to_polygon
from fog_contracts.messages import SimObstacle
from fog_contracts.site import AreaSite
from fognav_sim.barrier import KEEP_AWAY_M, BarrierError, barrier_across

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.geometry import Point
    from fog_contracts.grid import StaticMap
    from fog_contracts.site import Site

TRIGGER_M: Final = (3.0, 8.0)
"""Range of the travelled distance at which the path becomes blocked."""
BRAKING_ROOM_M: Final = 1.0
_STEP_M: Final = 0.05

MakeBarrier = Callable[[AreaSite], SimObstacle]
"""Makes a barrier that closes an area; raises `BarrierError` if none fits."""


class SiteWithMap(Protocol):
    """A site and its floor plan, as `fog_runtime.configuration.site.load_site` returns them."""

    @property
    def site(self) -> Site:
        """The configuration of the site."""

    @property
    def map(self) -> StaticMap:
        """The floor plan."""


@dataclass(frozen=True, kw_only=True)
class HazardRequest:
    """What a drive's hazard shall be: its area, and the travelled distance (m) at which it appears; None is drawn."""

    area: str | None = None
    trigger_m: float | None = None


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


def draw_hazard(
    site: Site, path: Sequence[Point], seed: int, make_barrier: MakeBarrier, *, trigger_m: float | None = None
) -> PlannedHazard:
    """Draw the area that becomes blocked, among the demo's areas that the path crosses, and when.

    The barrier appears early enough that the robot is still away from the area, after `trigger_m` metres at the latest
    if that is given. Raises `BarrierError` if no area qualifies; the message gives the reason for each.
    """
    wanted = site.demo.areas if site.demo else []
    known = {area.id: area for area in site.areas}
    generator = random.Random(seed)  # noqa: S311  # repeatable, not a secret
    drawn = generator.uniform(*TRIGGER_M)  # as draw_trigger; the area is drawn next
    trigger = drawn if trigger_m is None else trigger_m
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
        except BarrierError as error:
            reasons.append(str(error))
    if not candidates:
        reason = "; ".join(reasons) or "[demo] of site.toml lists no areas"
        raise BarrierError(f"no area can be blocked on this path: {reason}. Choose other areas, or use --no-hazard")
    return generator.choice(candidates)


def is_clear_of_robot(hazard: PlannedHazard, robot: Point) -> bool:
    """Whether the robot is far enough away for the barrier to appear."""
    return min(distance_to_polygon(p, *robot) for p in (hazard.area.polygon, hazard.barrier.polygon)) >= KEEP_AWAY_M


class HazardSchedule:
    """Draws the hazard of one drive once its first path is known, and decides when to place the barrier.

    A requested area is blocked wherever the path leads; without one the area is drawn on the path.
    """

    def __init__(self, site: Site, seed: int, make_barrier: MakeBarrier, request: HazardRequest | None = None) -> None:
        """Prepare the drawing; raises `BarrierError` for a requested area that the site lacks or that can't be closed.

        `request` asks for an area or a distance; by default both are drawn.
        """
        self._site = site
        self._seed = seed
        self._make_barrier = make_barrier
        self._request = request or HazardRequest()
        self._fixed = self._requested(self._request.area) if self._request.area is not None else None
        self.planned: PlannedHazard | None = self._fixed

    @classmethod
    def of(cls, site: SiteWithMap, seed: int, request: HazardRequest | None = None) -> HazardSchedule:
        """Return the schedule of a drive on a site, with barriers from wall to wall."""
        return cls(site.site, seed, lambda area: barrier_across(area, site.site, site.map, seed), request)

    def draw(self, path: Sequence[Point]) -> PlannedHazard:
        """Draw the hazard for a path, replacing any earlier one; raises `BarrierError`."""
        self.planned = self._fixed or draw_hazard(
            self._site, path, self._seed, self._make_barrier, trigger_m=self._request.trigger_m
        )
        return self.planned

    def due(self, path: Sequence[Point], travelled_m: float, robot: Point) -> PlannedHazard | None:
        """Return the hazard whose barrier is to be placed now, or None while it is too early; raises `BarrierError`.

        `path` is the robot's path from here on, `travelled_m` the distance that it has driven, `robot` its true
        position (m).
        """
        planned = self.planned or self.draw(path)
        if travelled_m < planned.trigger_m:
            return None
        left = self._fixed is None and entry_distance(path, planned.area.polygon) is None
        if left or not is_clear_of_robot(planned, robot):
            # The path has changed (an obstacle, a service that was down): choose an area on the new one.
            planned = self.draw(path)
            if travelled_m < planned.trigger_m or not is_clear_of_robot(planned, robot):
                return None
        return planned

    def _requested(self, area_id: str) -> PlannedHazard:
        trigger = self._request.trigger_m
        for area in self._site.areas:
            if area.id == area_id:
                return PlannedHazard(
                    area, self._make_barrier(area), draw_trigger(self._seed) if trigger is None else trigger
                )
        known = ", ".join(area.id for area in self._site.areas)
        raise BarrierError(f"the site has no area {area_id!r}; it has: {known}")
