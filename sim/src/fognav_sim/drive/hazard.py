"""Draws from a seed which area of a drive becomes blocked, when, and by which barrier. Pure."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np

from fog_contracts.geometry import contains_point, distance_to_polygon, lengths_along, sampled
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
BRAKING_ROOM_M: Final = 0.75
"""A barrier is to appear at least this much of the path before the last place that is far enough away from it."""
_MARGIN_M: Final = 0.25
"""How much farther away than `KEEP_AWAY_M` the path must be: the robot drives beside it."""
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
    west, south, east, north = (limit(values) for limit in (min, max) for values in zip(*polygon, strict=True))
    for (x0, y0), (x1, y1) in itertools.pairwise(path):
        length = math.hypot(x1 - x0, y1 - y0)
        steps = max(1, math.ceil(length / _STEP_M))
        near = min(x0, x1) <= east and max(x0, x1) >= west and min(y0, y1) <= north and max(y0, y1) >= south
        for step in range(steps + 1) if near else ():
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


def remaining(path: Sequence[Point], driven_m: float) -> list[Point]:
    """Return what is left of a polyline after its first `driven_m` metres, beginning where these end."""
    for index, (a, b) in enumerate(itertools.pairwise(path)):
        length = math.dist(a, b)
        if driven_m < length:
            t = max(0.0, driven_m) / length
            return [(a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])), *path[index + 1 :]]
        driven_m -= length
    return list(path[-1:])


def draw_hazard(  # noqa: PLR0913  # what is drawn, on what, and what is known of it already
    site: Site,
    path: Sequence[Point],
    seed: int,
    make_barrier: MakeBarrier,
    *,
    trigger_m: float | None = None,
    travelled_m: float = 0.0,
    keep: str | None = None,
) -> PlannedHazard:
    """Draw the area that becomes blocked, among the demo's areas that the path crosses, and when.

    `path` begins where the robot is after `travelled_m` metres. The barrier appears while the robot is still away from
    the area that it drives to, as near to `trigger_m` metres of its drive (drawn if not given) as the path allows. The
    area `keep` is taken again if it qualifies. Raises `BarrierError` if none does; the message gives each one's reason.
    """
    wanted = site.demo.areas if site.demo else []
    known = {area.id: area for area in site.areas}
    generator = random.Random(seed)  # noqa: S311  # repeatable, not a secret
    drawn = generator.uniform(*TRIGGER_M)  # as draw_trigger; the area is drawn next
    trigger = drawn if trigger_m is None else trigger_m
    candidates: dict[str, PlannedHazard] = {}
    reasons: list[str] = []
    for identifier in wanted:
        area = known[identifier]
        entry = entry_distance(path, area.polygon)
        if entry is None:
            reasons.append(f"the path does not cross {identifier}")
            continue
        try:
            barrier = make_barrier(area)
        except BarrierError as error:
            reasons.append(str(error))
            continue
        place = _appears_at(path, entry, (area.polygon, barrier.polygon), trigger - travelled_m)
        if place is None:
            reasons.append(
                f"the path enters {identifier} after {entry:.1f} m and never is far enough from it before for a "
                f"barrier {KEEP_AWAY_M:g} m away"
            )
            continue
        candidates[identifier] = PlannedHazard(area, barrier, travelled_m + place)
    if not candidates:
        reason = "; ".join(reasons) or "[demo] of site.toml lists no areas"
        raise BarrierError(f"no area can be blocked on this path: {reason}. Choose other areas, or use --no-hazard")
    return candidates[keep] if keep in candidates else generator.choice(list(candidates.values()))


def _appears_at(
    path: Sequence[Point], entry_m: float, polygons: Sequence[Sequence[Point]], wanted_m: float
) -> float | None:
    """Return the distance (m) along the path at which a barrier is to appear: where the path is away from it.

    That is `wanted_m` if possible, else the nearest place before it, else the first one after it; None if there is none
    up to `BRAKING_ROOM_M` before the last place that is far enough away.
    """
    line = sampled(np.array(path, dtype=np.float64), _STEP_M)
    away = [
        along
        for along, (x, y) in zip(lengths_along(line).tolist(), line.tolist(), strict=True)
        if along < entry_m and _distance(polygons, (x, y)) >= KEEP_AWAY_M + _MARGIN_M
    ]
    if not away:
        return None
    usable = [place for place in away if place <= away[-1] - BRAKING_ROOM_M]
    before = [place for place in usable if place <= wanted_m]
    if not before:
        return min(usable, default=None)
    return wanted_m if wanted_m - before[-1] < _STEP_M else before[-1]


def _distance(polygons: Sequence[Sequence[Point]], point: Point) -> float:
    return min(distance_to_polygon(polygon, *point) for polygon in polygons)


def is_clear_of_robot(hazard: PlannedHazard, robot: Point) -> bool:
    """Whether the robot is far enough away for the barrier to appear."""
    return _distance((hazard.area.polygon, hazard.barrier.polygon), robot) >= KEEP_AWAY_M


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

    def draw(self, left: Sequence[Point], travelled_m: float = 0.0) -> PlannedHazard:
        """Draw the hazard for what is left of the path after `travelled_m` metres of the drive; raises `BarrierError`.

        It replaces an earlier one, in the same area if that still qualifies.
        """
        self.planned = self._fixed or draw_hazard(
            self._site,
            left,
            self._seed,
            self._make_barrier,
            trigger_m=self._request.trigger_m,
            travelled_m=travelled_m,
            keep=self.planned.area.id if self.planned is not None else None,
        )
        return self.planned

    def due(self, left: Sequence[Point], travelled_m: float, robot: Point) -> PlannedHazard | None:
        """Return the hazard whose barrier is to be placed now, or None while it is too early; raises `BarrierError`.

        `left` is the robot's path from here on, `travelled_m` the distance that it has driven, `robot` its true
        position (m).
        """
        planned = self.planned or self.draw(left, travelled_m)
        if travelled_m < planned.trigger_m:
            return None
        if not is_clear_of_robot(planned, robot) or not self.is_ahead(planned, left):
            # The path has changed (an obstacle, a service that was down): choose an area on what is left of it.
            planned = self.draw(left, travelled_m)
            if travelled_m < planned.trigger_m or not is_clear_of_robot(planned, robot):
                return None
        return planned

    def is_ahead(self, planned: PlannedHazard, left: Sequence[Point]) -> bool:
        """Whether what is left of a path enters the hazard's area; true of an area that was asked for."""
        return self._fixed is not None or entry_distance(left, planned.area.polygon) is not None

    def _requested(self, area_id: str) -> PlannedHazard:
        trigger = self._request.trigger_m
        for area in self._site.areas:
            if area.id == area_id:
                return PlannedHazard(
                    area, self._make_barrier(area), draw_trigger(self._seed) if trigger is None else trigger
                )
        known = ", ".join(area.id for area in self._site.areas)
        raise BarrierError(f"the site has no area {area_id!r}; it has: {known}")
