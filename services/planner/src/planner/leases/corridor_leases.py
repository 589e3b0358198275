"""Robots make room for one another: stretches of paths are released as leases that do not overlap. Pure.

A robot's corridor is where its body may come along a stretch of its path. A stretch is leased to one robot at a time,
never taken back while the robot may drive on it, and given free as the robot leaves it behind. Three rules (ADR 71):

- a robot gets a stretch only as far as its corridor meets no other one that is leased, and no robot that stands;
- it may end only where no other robot has to pass, or where all can still reach their goals, one after the other, with
  the others standing at the ends of their leases (the banker's rule: Dijkstra 1965, Habermann 1969);
- where no such order exists, robots are face to face: one of them gets another way, or a passing place (`Room`).

Times are s of a monotonic clock, lengths m, points in the frame `map`.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import GeometryError
from fog_kernels.course import sampled_along
from fog_kernels.lines import first_near
from planner.leases.corridors import (
    DEFAULT_RADIUS_M,
    SPACING_M,
    STRAY_M,
    WAITING_M,
    Corridor,
    Disc,
    between,
    box,
    comes_near,
    contender_of,
    meets,
    reach_of,
    stop_before,
)
from planner.leases.narrow_places import NarrowPlace
from planner.leases.standstills import Standstills

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from fog_contracts.messages import Zone
    from planner.leases.standstills import Kind, Room
    from planner.missions import PathId

    Floats = NDArray[np.float64]

PATIENCE_S: Final = 15.0
"""After so long without moving, a robot whose lease another one needs is asked to give it back ..."""
WITHDRAWN_S: Final = 10.0
"""... and after so long more it has: it has heard, or its own gate has stopped it (3 s without map or planner)."""
FORGET_S: Final = 60.0
"""A robot that is silent for so long is an obstacle that others see, no longer one that stands in the way unseen. One
in a place for one robot keeps that, until it is heard elsewhere or an operator takes it out of service."""
SILENT_S: Final = 3.0
"""After so long without a pose a robot gets nothing, and has stopped. So long a path may be on its way to it."""
MOST_ROBOTS: Final = 20
"""More robots with a path get what a robot alone gets: when a hazard turns all of them, to lease takes too long."""
MEETING_M: Final = 1.0
"""A robot on whose path another one is so near has not met it yet."""
_SPEED_M_S: Final = 0.3
_MOVED_M: Final = 0.1
_LIKE_M: Final = 0.02
"""Leases so much nearer than they may be do not overlap: they end at points of a path."""
_BODIES: Final = 0.9
"""Nearer than this share of their radii's sum two bodies touch, whatever their poses' errors."""


class CorridorLeases:
    """Who may drive how far. A robot alone on its floor gets whatever is wanted for it."""

    def __init__(self, most_robots: int | None = None) -> None:
        self._most, self._crowded = MOST_ROBOTS if most_robots is None else most_robots, False
        self._robots: dict[str, Corridor] = {}
        self._arrivals = 0
        self._now = -math.inf
        self._places: list[NarrowPlace] = []
        self._gone: set[str] = set()
        """Robots that an operator has taken out of service, until they are heard."""
        self.standstills = Standstills(self._robots, self._places)
        self.made: dict[Kind, int] = {}
        """How often robots got room, by kind."""

    # --- What is known of robots ------------------------------------------------------------------------------------

    def place(self, robot: str, x: float, y: float, now: float, radius: float = DEFAULT_RADIUS_M) -> None:
        """Note where a robot is (m)."""
        me, self._now = self._of(robot), now
        self._gone.discard(robot)
        me.at, me.radius, me.heard_at = np.array(((x, y),)), radius, now
        if math.dist(me.moved_from, (x, y)) >= _MOVED_M or math.isinf(me.moved_at):
            me.moved_from, me.moved_at = (x, y), now
            if not me.drives:
                self.standstills.changed(robot)  # it was carried, or drives by itself
        self.standstills.moved(robot)

    def advance(self, robot: str, progress: float) -> None:
        """Note how far along its path (m) a robot is: what lies behind is free again."""
        me = self._of(robot)
        me.progress = max(me.progress, progress)
        me.leased = max(me.leased, me.first)
        self.standstills.moved(robot)

    def follow(self, robot: str, path: PathId, corners: Floats, mission: str, priority: int = 0) -> None:
        """Give a robot another path ((n, 2), m), of which nothing is leased yet; the same one again changes nothing.

        The stretch of the path before stays leased until the robot names another one. Who has a lower `priority`, or
        got its mission later, waits for the others.
        """
        me = self._of(robot)
        if me.path == path:
            return
        self._leave(me)
        if me.mission != mission:
            self._arrivals += 1
            me.mission = mission
            me.order = (-priority, self._arrivals)
        me.path = path
        me.points, me.along = sampled_along(corners, SPACING_M)
        me.low, me.high = box(corners)
        me.leased = me.first
        self.standstills.changed(robot)

    def stop(self, robot: str) -> None:
        """Take a robot's path away: it has none, or must not drive on."""
        me = self._robots.get(robot)
        if me is not None and me.path is not None:
            self._leave(me)
            self.standstills.changed(robot)

    def on_state(self, robot: str, received: PathId | None, now: float, *, able: bool, strays: bool) -> None:
        """Note which path a robot has, whether it may drive, and whether it drives by none of this planner's.

        It never goes back to an older path than the one that it names, but may still get a newer one; without any, one
        that is on its way.
        """
        me = self._of(robot)
        before, stray = len(me.former), me.stray
        if received is not None:
            me.former = {path: line for path, line in me.former.items() if path >= received}
        elif now - me.left_at > SILENT_S:
            me.former = {}
        me.able = able
        me.stray = strays or (received is not None and received != me.path and received not in me.former)
        revived = me.standing and able and math.isinf(me.withdrawn_at) and now - me.heard_at <= SILENT_S
        if revived:
            me.standing = False
        if revived or me.stray != stray or len(me.former) != before:
            self.standstills.changed(robot)

    def set_places(self, zones: Iterable[Zone], now: float) -> None:
        """Let at most one robot at a time be in each of these zones from now on.

        Robots that have a lease into a place that is new, and are not in it, are asked to give that back.
        """
        before = {place.zone.id: place for place in self._places}
        self._places[:] = []
        for zone in zones:
            place = before.get(zone.id)
            try:
                self._places.append(place if place and place.zone.shape == zone.shape else NarrowPlace(zone))
            except GeometryError:
                continue  # the map-service refuses it, too
        for place in [place for place in self._places if place is not before.get(place.zone.id)]:
            holders = [me for me in self._robots.values() if place.holds(me, me.held())]
            for me in holders if len(holders) > 1 else []:
                if me.path is not None and not place.has_body(me):
                    me.withdrawn_at = min(me.withdrawn_at, now)
        for me in self._robots.values():
            me.apart = {place: known for place, known in me.apart.items() if place in self._places}
        self.standstills.forget_pairs()

    def forget(self) -> None:
        """Forget all paths and leases: another planner leads."""
        for robot in [*self._robots]:
            self._drop(robot)

    def _of(self, robot: str) -> Corridor:
        me = self._robots.get(robot)
        if me is None:
            me = self._robots[robot] = Corridor(robot, (0, 0))
            self.standstills.changed(robot)
        return me

    def _drop(self, robot: str) -> None:
        del self._robots[robot]
        self.standstills.changed(robot)

    def _leave(self, me: Corridor) -> None:
        if me.path is not None:
            me.former[me.path], me.left_at = me.points[me.first : me.leased + 1], self._now
        me.path, me.points, me.along = None, np.zeros((0, 2)), np.zeros(0)
        me.low, me.high = (math.inf, math.inf), (-math.inf, -math.inf)
        me.progress, me.end, me.leased, me.wanted = 0.0, 0.0, 0, 0.0
        me.waits_for, me.lets_pass, me.passes = None, None, frozenset()

    def take_out(self, robot: str) -> None:
        """Note that an operator has taken a robot out of service: silent, it holds no place for one robot any more."""
        self._gone.add(robot)

    # --- Leases -----------------------------------------------------------------------------------------------------

    def release(self, robot: str, wanted: float, now: float) -> float:
        """Return how far along its path (m) a robot may drive, and lease that to it, but at most `wanted`.

        A robot without others on its floor, or with too many, may drive as far as anybody wants: infinity. Those who
        wait and whose turn is before its own get theirs first.
        """
        me, self._now = self._of(robot), now
        me.wanted = wanted
        self._settle(now)
        crowded, self._crowded = self._crowded, self._driving > self._most
        if crowded and not self._crowded:
            self._withdraw_overlaps(now)
        if me.path is None or not self._shared:
            me.end, me.leased = wanted, max(me.first, min(int(me.along.searchsorted(wanted)), len(me.points) - 1))
            me.waits_for = me.lets_pass = None
            return math.inf
        if self._somebody_on(me):
            me.withdrawn_at = min(me.withdrawn_at, now)
        for other in sorted(self._robots.values(), key=lambda other: other.order):
            before = other.waits_for is not None and other.order < me.order
            if before and now - other.heard_at <= SILENT_S and not other.far_from(me, reach_of(me, other)):
                self._retry(other, now)
        self._extend(me, now)
        return me.end if math.isinf(me.withdrawn_at) else min(me.end, me.progress)

    @property
    def _shared(self) -> bool:
        """Whether robots share a floor by leases."""
        return len(self._robots) > 1 and self._driving <= self._most

    @property
    def _driving(self) -> int:
        return sum(me.path is not None for me in self._robots.values())

    def _withdraw_overlaps(self, now: float) -> None:
        """Ask for the leases back that overlap: they are of a time when robots were too many for leases."""
        for me, other in itertools.combinations([me for me in self._robots.values() if me.path is not None], 2):
            reach = reach_of(me, other) - _LIKE_M
            lines = [] if me.far_from(other, reach) and not me.former else [*other.held()]
            near = (first_near(one, 0, len(one), line, reach, SPACING_M) for one in me.held() for line in lines)
            if any(point >= 0 for point in near):
                # Both: until the one has heard, it may drive on the other one's stretch.
                for robot in (me, other):
                    robot.withdrawn_at = min(robot.withdrawn_at, now)

    def _somebody_on(self, me: Corridor) -> bool:
        """Whether another body is on a robot's leased stretch: it was put there, or both had got too much."""
        here = me.points[me.first]
        for place in self._places:
            leads_in = place.entry(me, me.first, me.leased + 1) <= me.leased and not place.has_body(me)
            if leads_in and any(other is not me and place.has_body(other) for other in self._robots.values()):
                return True
        for other in self._robots.values():
            bodies = _BODIES * (me.radius + other.radius)
            if other is not me and not me.far_from_point(other.at[0], bodies):
                nearer = min(bodies, math.dist(here, other.at[0]) - SPACING_M)  # it may be going away
                if comes_near(me, other.at, nearer, me.leased + 1):
                    return True
        return False

    def waits_for(self, robot: str) -> str | None:
        """Return whom a robot lets pass, or whose place it waits for, when it can't drive much further; else None."""
        me = self._robots.get(robot)
        if me is None or me.path is None or me.end - me.progress > WAITING_M:
            return None
        return me.waits_for or min(me.passes, default=None)

    def figures(self) -> tuple[int, float]:
        """Return how many robots wait for another one, and how much path (m) ahead of robots is leased; any thread."""
        robots = [me for me in self._robots.copy().values() if me.path is not None]
        waiting = sum(self.waits_for(me.id) is not None for me in robots)
        return waiting, sum(max(0.0, me.end - me.progress) for me in robots)

    def _extend(self, me: Corridor, now: float) -> None:
        last = min(int(me.along.searchsorted(me.wanted)), len(me.points) - 1)
        me.waits_for = me.lets_pass = None
        self.standstills.moved(me.id)
        if not me.drives or me.wanted <= me.end:
            return
        if last <= me.leased:
            me.end = min(me.wanted, float(me.along[me.leased]))
            return
        others = [other for other in self._robots.values() if other is not me]
        limit, blocker = last + 1, None
        for other in others:
            lines = () if me.far_from(other, reach_of(me, other)) else other.held()
            if (met := meets(me, other, me.leased, limit, lines)) < limit:
                limit, blocker = met, other
        for place in self._places:
            if (entry := place.entry(me, me.leased, limit)) < limit:
                holder = next((other for other in others if place.holds(other, other.held())), None)
                limit, blocker = (entry, holder) if holder is not None else (limit, blocker)
        end, contender = self._stop(me, limit - 1, others)
        waits = contender or blocker
        if end > me.leased:
            if me.end <= me.progress + WAITING_M:
                me.moved_at = now  # it could not move before
            me.leased, me.end = end, min(me.wanted, float(me.along[end]))
            self.standstills.changed(me.id)
        if waits is not None:
            me.waits_for = waits.id
            me.lets_pass, me.parks = None if contender is None else contender.id, limit == len(me.points)
            self._press(waits, now)

    def _retry(self, me: Corridor, now: float) -> None:
        """Lease what a robot waits for, unless the one that it waits for was in the same place just now."""
        other = self._robots.get(me.waits_for or "")
        there = None if other is None else (now, other.id, other.path, other.first, other.leased, other.standing)
        if there is None or there != me.tried:
            self._extend(me, now)
            me.tried = there

    def _stop(self, me: Corridor, end: int, others: list[Corridor]) -> tuple[int, Corridor | None]:
        """Return the last point up to `end` where a robot may stop, and who has to pass before it gets further."""
        contender = self._contender(me, end, others) if end > me.leased else None
        if contender is None:
            return end, None
        before = self.standstills.stuck()
        if me.id not in before and self.standstills.order({me.id: end}).keys() <= before.keys():
            return end, None
        drivers = [other for other in others if other.drives]
        marked = np.zeros(len(me.points), np.bool_)
        for place in self._places:
            if any(place.passes(other, other.first) for other in drivers):
                marked |= place.taken(me)
        near = [(other, other.first) for other in drivers if not me.far_from(other, reach_of(me, other))]
        return stop_before(me, me.leased, end, near, marked), contender

    def _contender(self, me: Corridor, stop: int, others: list[Corridor]) -> Corridor | None:
        """Return a robot that has to pass where this one would stop."""
        for place in self._places:
            if place.taken(me)[stop]:
                for other in others:
                    if place.passes(other, other.first):
                        return other
        return contender_of(me, stop, others)

    # --- Robots that stand or are silent ------------------------------------------------------------------------------

    def _press(self, other: Corridor, now: float) -> None:
        """Ask a robot for its lease that another one needs, when it has not moved for long.

        One that waits keeps the end of its lease, unless it can't drive, or is silent.
        """
        if not other.drives or now - other.moved_at < PATIENCE_S or not math.isinf(other.withdrawn_at):
            return
        waits = other.waits_for is not None or other.end <= other.progress + WAITING_M
        if not waits or not other.able or now - other.heard_at > SILENT_S:
            other.withdrawn_at = now

    def _settle(self, now: float) -> None:
        """Free what was given back, and forget robots that have long been silent."""
        for other in [*self._robots.values()]:
            if now - other.withdrawn_at >= WITHDRAWN_S:
                # Heard: it stands where it is. Silent: it may have driven on until it was asked, and a little more.
                unheard = max(0.0, other.withdrawn_at - other.heard_at)
                end = other.progress + (_SPEED_M_S * unheard + STRAY_M if now - other.heard_at > 1.0 else 0.0)
                other.end = min(other.end, end)
                other.leased = min(other.leased, max(other.first, int(other.along.searchsorted(other.end))))
                other.withdrawn_at, other.standing = math.inf, True
                self.standstills.changed(other.id)
            if now - other.heard_at > FORGET_S:
                stays = other.id not in self._gone and any(place.has_body(other) for place in self._places)
                if not stays:
                    self._drop(other.id)

    # --- Robots that make room ----------------------------------------------------------------------------------------

    def room_needed(self, now: float) -> Room | None:
        """Return which robot needs another path so that robots that meet get on; None if none does."""
        return self.standstills.room_needed(now, self.obstacles) if self._shared else None

    def take(self, room: Room, path: PathId, corners: Floats) -> None:
        """Let a robot follow the path that makes room."""
        me = self._robots[room.robot]
        self.follow(room.robot, path, corners, me.mission or "")
        me.passes = room.whom if room.kind == "aside" else frozenset()
        self.made[room.kind] = self.made.get(room.kind, 0) + 1

    def aside_ended(self) -> list[str]:
        """Return the robots that stand aside, or drive there, for others who have passed or turned off."""
        return [
            me.id
            for me in self._robots.values()
            if me.passes and not any(self._still_comes(me, self._robots.get(other)) for other in me.passes)
        ]

    def _still_comes(self, me: Corridor, other: Corridor | None) -> bool:
        if other is None or not other.drives:
            return False
        return comes_near(other, me.points, reach_of(me, other))

    def obstacles(self, robot: str, beside: Iterable[str] = ()) -> list[Disc]:
        """Return the places that a new path of a robot should avoid: robots that stand, corridors of those `beside`."""
        me = self._of(robot)
        near = set(beside)
        found: list[Disc] = []
        if not self._shared:
            return found
        for other in self._robots.values():
            if other is not me and math.isfinite(other.at[0, 0]):
                reach = reach_of(me, other) - (STRAY_M if other.stray is None else 0.0)
                to_meet = other.drives and other.id in near and comes_near(me, other.at, reach + MEETING_M)
                if not other.drives:
                    places = [place for place in self._places if place.has_body(other) and not place.has_body(me)]
                    found += [place.disc(me) for place in places]
                if to_meet or not other.drives:
                    found.append(Disc(between(me, other.ahead(), reach) if to_meet else other.at, reach))
        return found
