"""Whether a robot waits before what closes its way, and where; the block stays as impassable as it was. Pure.

The choice is made anew every second. A robot that waits drives to where the way round branches off, and no further.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import INSCRIBED, LETHAL, UNKNOWN
from fog_contracts.geometry import distance_to_polygon, lengths_along
from fog_contracts.messages import BlockedWay, HazardArea
from fog_contracts.shapes import box_around, shape_box, shape_contains
from fog_kernels.course import sampled_along, values_at
from planner.path_search import Route
from planner.planning_map import USUAL_SPEED
from planner.regions import cause_of, name_of
from planner.waits.blocks import Blocks
from planner.waits.durations import all_of, best_policy, until
from planner.waits.pace import Times

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import PointXY
    from planner.config import PlannerConfig
    from planner.path_search import SearchResult
    from planner.planning_map import PlanningMap
    from planner.regions import Source
    from planner.waits.durations import Policy, Survival

Floats = NDArray[np.float64]
Bounds = tuple[float, float, float, float]

_JUDGE_S: Final = 1.0
"""How often the choice is made anew."""
_SPACING_M: Final = 0.1
_BRANCH_M: Final = 0.5
"""The way round branches off where it is so far from the blocked way; a robot that far off it has left it."""
_KEEP_M: Final = 0.5
"""A robot that waits keeps this far from the first cell that it could not enter."""
_TAIL_M: Final = 0.3
"""So much of the way beyond the place to wait is published, not released: the end of the path would be the goal."""
_SHORT_M: Final = 0.15
"""With less of it nobody waits: the robot stands so near that it would count as arrived, or stuck."""
_SAME_PLACE_M: Final = 0.5
"""A robot waits on where it waits, as long as that is so near to where it would."""
_GRACE_S: Final = 5.0
"""A zone or override that is in force for so long after its end has another one, or a clock is wrong: nobody waits."""
_NEAR_M: Final = 0.3
"""Beyond its inscribed radius, a source closes no cell farther away from it than this."""


@dataclass(frozen=True)
class Judgement:
    """A choice for a robot whose `way` is blocked, made at `made_at` (s).

    To wait: on the path `route`, of which it may drive `hold` (m), at `place` (m), since `since` (s). One that stays
    at its place has a path already.
    """

    choice: BlockedWay
    way: Route
    route: Route
    hold: float
    place: PointXY
    since: float
    made_at: float

    @property
    def waits(self) -> bool:
        """Whether it is to wait."""
        return self.choice.choice == "wait"

    def is_due(self, now: float) -> bool:
        """Whether the choice is to be made again."""
        return now >= self.made_at + _JUDGE_S

    def stays(self, place: PointXY) -> bool:
        """Whether a robot that waits keeps its place, if it is to wait at another one."""
        return self.waits and math.dist(self.place, place) <= _SAME_PLACE_M


@dataclass
class _Known:
    at: Moment
    sources: Sequence[Source]
    areas: Sequence[HazardArea]
    speed: NDArray[np.uint8]
    survivals: dict[int, Survival | None] = field(default_factory=dict)
    """How long sources go on, by `id`, as far as somebody has asked."""
    awaited: list[Bounds] | None = None
    """The boxes of those of which that is known, once somebody has asked."""


@dataclass
class Waits:
    """Chooses for robots whose way is blocked; `look` tells it first what the world is like."""

    config: PlannerConfig
    blocks: Blocks = field(default_factory=Blocks)
    _known: _Known | None = None
    _boxes: dict[int, tuple[Source, Bounds]] = field(default_factory=dict)
    _boxed: Sequence[Source] = ()
    _edges: Floats = field(default_factory=lambda: np.zeros((4, 0)))
    """The boxes of those as numbers: each one's left, bottom, right and top."""

    def look(
        self, at: Moment, sources: Sequence[Source], areas: Sequence[HazardArea], speed: NDArray[np.uint8]
    ) -> None:
        """Use this time, these hazards and zones that close cells, these areas, closed or not, and speed limits."""
        self._known = _Known(at, sources, areas, speed)

    def judge(
        self, way: Route | None, before: Judgement | None, at: PointXY, found: SearchResult, planning_map: PlanningMap
    ) -> Judgement | None:
        """Return the choice between the way found, round a block, and the blocked way; None when there is none.

        Then the robot drives by the way found: the other one is free, is not the robot's any more, or is closed by
        something that is not waited for. `at`: where it is (m); `before`: the choice that it follows.
        """
        way = before.way if before is not None else way
        since = before.since if before is not None and before.waits else None
        if self.config.wait == "off" or self._known is None or way is None or found.route is None:
            return None
        along, off = way.nearest(*at) if since is not None or self._may_end_on(way) else (0.0, math.inf)
        if off > _BRANCH_M or len(corners := way.remaining(along)) < 2:
            return None
        rest, steps = sampled_along(corners, _SPACING_M)
        geometry = planning_map.geometry
        grid = geometry.origin_x, geometry.origin_y, geometry.resolution
        blocked = np.flatnonzero(values_at(rest, planning_map.cost, grid, UNKNOWN) >= INSCRIBED)
        if not len(blocked):
            return None
        cut = self._cut(rest[blocked], since)
        if cut is None:
            return None
        branch = steps[found.route.last_beside(rest[: blocked[0]], _BRANCH_M) if blocked[0] else 0]
        hold = max(0.0, min(float(branch), float(steps[blocked[0]]) - _KEEP_M))
        end = min(hold + _TAIL_M, float(steps[blocked[0]]) - 2.0 * geometry.resolution)
        speed = self.config.cruise_speed
        place = _point(rest, steps, hold)
        around, _ = found.route.nearest(*place)
        ways = [Times.of(each, self._known.speed, geometry) for each in (found.route, way)]
        detour = (ways[0].rest(around) - ways[1].rest(along + hold)) * USUAL_SPEED / speed
        stays = before is not None and before.stays(place) and blocked[0] > 0
        if (end < hold + _SHORT_M and not stays) or detour <= 0.0:
            return None  # it stands before the block already, or is as quick round it
        sources, block, age = cut
        policy = best_policy(block, detour, hold / speed)
        now = self._known.at.now
        if before is not None and stays:
            place = before.place
            hold = max(0.0, min(way.nearest(*place)[0] - along, float(steps[blocked[0]]) - _KEEP_M))
        kept = np.concatenate((corners[lengths_along(corners) < end], [_point(rest, steps, end)]))
        choice = _choice(sources, age, policy, detour, waiting=policy.waits)
        return Judgement(choice, way, Route(kept, way.spacing), hold, place, now if since is None else since, now)

    def _cut(self, points: Floats, waiting_since: float | None) -> tuple[list[Source], Survival, float] | None:
        """Return what closes these points, how long it goes on, and its age; None if that is not to be waited for.

        Lidars may see for a moment more what stood in an area that is clear again: whoever waited, waits on.
        """
        assert self._known is not None
        at, reach = self._known.at, self._reach
        left: list[PointXY] = [(x, y) for x, y in points.tolist()]
        (x0, y0), (x1, y1) = (points.min(axis=0) - reach).tolist(), (points.max(axis=0) + reach).tolist()
        around = (x0, y0, x1, y1)
        found: list[tuple[Source, Survival, float]] = []
        for source in self._near(self._known.sources, around):
            others = _beyond(source, left, reach)
            if len(others) == len(left):
                continue
            left = others
            if (block := self._survival(source)) is None:
                return None
            age = self.blocks.age(source.hazard.area, at.now) if isinstance(source, HazardArea) else None
            found.append((source, block, age or 0.0))
        for area in self._known.areas if waiting_since is not None else ():
            others = _beyond(area, left, reach) if left and _overlap(_bounds(area), around) else left
            if waiting_since is not None and len(others) < len(left):
                age = at.now - waiting_since
                block = self.blocks.survival(area.hazard.area, age, at.stamp, learned=self.config.wait == "learned")
                if block is not None:  # else something else must account for these points
                    left = others
                    found.append((area, block, age))
        if left or not found:
            return None
        return [source for source, _, _ in found], all_of([b for _, b, _ in found]), max(age for *_, age in found)

    @property
    def _reach(self) -> float:
        """How near (m) a source closes a cell."""
        return self.config.inflation.inscribed_radius + _NEAR_M

    def _may_end_on(self, way: Route) -> bool:
        """Whether anything near a way is known to end by itself: without that no robot waits on it."""
        known = self._known
        assert known is not None
        if known.awaited is None:
            ending = [source for source in known.sources if self._survival(source) is not None]
            known.awaited = [_bounds(source) for source in ending]
        if not known.awaited:
            return False
        around = box_around(way.corner_points, self._reach)
        return any(_overlap(box, around) for box in known.awaited)

    def _near(self, sources: Sequence[Source], around: Bounds) -> list[Source]:
        """Return the sources whose boxes overlap another one; the box of each source is computed once."""
        if self._boxed is not sources:
            self._boxes = {id(each): self._boxes.get(id(each)) or (each, _bounds(each)) for each in sources}
            self._boxed = sources
            self._edges = np.array([self._boxes[id(each)][1] for each in sources]).reshape(-1, 4).T.copy()
        left, bottom, right, top = self._edges
        near = (left <= around[2]) & (around[0] <= right) & (bottom <= around[3]) & (around[1] <= top)
        return [sources[number] for number in np.flatnonzero(near).tolist()]

    def _survival(self, source: Source) -> Survival | None:
        """Return how long a hazard or zone goes on; None if that is unknown. Computed once for all robots."""
        assert self._known is not None
        found = self._known.survivals
        if id(source) not in found:
            found[id(source)] = self._find_survival(source, self._known.at)
        return found[id(source)]

    def _find_survival(self, source: Source, at: Moment) -> Survival | None:
        if not isinstance(source, HazardArea):
            return None if source.expires_at is None else _until(source.expires_at - at.stamp)
        hazard, age = source.hazard, self.blocks.age(source.hazard.area, at.now)
        if (override := hazard.override) is not None:
            ends = override.set_at + override.ttl_s - at.stamp
            return _until(ends) if override.measured_penalty < LETHAL else None
        if age is None:
            return None
        return self.blocks.survival(hazard.area, age, at.stamp, learned=self.config.wait == "learned")


def _until(rest: float) -> Survival | None:
    """Return the survival of what ends in `rest` s, as far as that can be trusted: it may take a moment to go."""
    return until(max(0.0, rest)) if rest > -_GRACE_S else None


def _point(points: Floats, along: Floats, at: float) -> tuple[float, float]:
    """Return the point so many metres, 0 or more, along a polyline."""
    before = int(along.searchsorted(at, "right")) - 1
    begin, (x, y) = along.item(before), points[before].tolist()
    if before == len(along) - 1 or begin == at:
        return x, y
    length, (next_x, next_y) = along.item(before + 1) - begin, points[before + 1].tolist()
    return (next_x - x) / length * (at - begin) + x, (next_y - y) / length * (at - begin) + y


_RING: Final = [(math.cos(k * math.tau / 12), math.sin(k * math.tau / 12)) for k in range(12)]


def _beyond(source: Source, points: list[PointXY], reach: float) -> list[PointXY]:
    """Return the points (m) near which, within `reach` (m), a source closes no cells; most sources lie elsewhere."""
    left, bottom, right, top = _bounds(source)
    return [
        (x, y)
        for x, y in points
        if not (left - reach <= x <= right + reach and bottom - reach <= y <= top + reach)
        or not _is_near(source, (x, y), reach)
    ]


def _overlap(a: Bounds, b: Bounds) -> bool:
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]


def _bounds(source: Source) -> Bounds:
    """Return the least and greatest x and y (m) of what a source covers: left, bottom, right and top."""
    return box_around(source.polygon) if isinstance(source, HazardArea) else shape_box(source.shape)


def _is_near(source: Source, point: PointXY, reach: float) -> bool:
    """Whether a source closes cells within `reach` (m) of a point; of zones, by a ring of points around it."""
    x, y = point
    if isinstance(source, HazardArea):
        return distance_to_polygon(source.polygon, x, y) <= reach
    around = [(x, y), *((x + share * reach * a, y + share * reach * b) for share in (0.5, 1.0) for a, b in _RING)]
    return any(shape_contains(source.shape, *each) for each in around)


def _choice(sources: Sequence[Source], age: float, policy: Policy, detour: float, *, waiting: bool) -> BlockedWay:
    names = ", ".join(name_of(source) for source in sources)
    costs = f"waiting is expected to cost {policy.waiting:.0f} s, the way round {detour:.0f} s"
    then = f"waits, {policy.limit:.0f} s at most" if waiting else "goes round"
    return BlockedWay(
        choice="wait" if waiting else "detour",
        causes=[cause_of(source) for source in sources][:16],
        standing_s=round(age, 1),
        expected_s=round(policy.waiting, 1),
        limit_s=round(policy.limit, 1) if waiting else None,
        detour_s=round(detour, 1),
        reason=f"in the way for {age:.0f} s: {names}; {then}, because {costs}"[:500],
    )
