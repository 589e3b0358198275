"""Standstills: whether robots can still reach their goals one after the other, and who makes room if not. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from fog_kernels.course import sampled_along
from planner.leases.corridors import (
    SPACING_M,
    WAITING_M,
    Corridor,
    Disc,
    between,
    box,
    disc,
    reach_of,
)
from planner.leases.pairs import Pairs

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from planner.leases.narrow_places import NarrowPlace

    Floats = NDArray[np.float64]
    Bools = NDArray[np.bool_]

ASIDE_M: Final = 0.25
"""So much farther off the way of others a robot stands aside: it stops somewhat before the end of its path."""
RETRY_S: Final = 2.0
"""After so long room that was not found is looked for again."""


Kind = Literal["past", "lane", "round", "aside", "detour"]
"""Room that a robot makes: past another one that it would let pass, or its goal; beside corridors of those it meets;
round where they stand; off their way until they have passed; or round where they stand, however far that is."""
_KINDS: Final[tuple[Kind, ...]] = ("lane", "round", "aside", "detour")


@dataclass(frozen=True)
class Room:
    """A robot that needs another path, the places that it must avoid, and for `aside` those where it must not stay."""

    robot: str
    kind: Kind
    avoid: list[Disc]
    keep_off: list[Disc]
    whom: frozenset[str]


class Standstills:
    """Finds robots that stand in one another's way for ever."""

    def __init__(self, robots: Mapping[str, Corridor], places: Sequence[NarrowPlace] = ()) -> None:
        """`robots`: all that are known, by id; whoever changes a path or a lease calls `changed`.

        `places`: those for one robot; whoever changes them calls `forget_pairs`.
        """
        self._robots, self._places = robots, places
        self._stuck: dict[str, frozenset[str]] | None = None
        self._tried: dict[tuple[str, Kind], float] = {}
        self._pairs = Pairs(places)
        self._touched: set[str] = set()

    def changed(self, robot: str) -> None:
        """Judge anew: a robot, its path or its lease has changed."""
        self._stuck = None
        self._touched.add(robot)

    def forget_pairs(self) -> None:
        """Compare all robots again: places for one robot have changed."""
        self._stuck, self._pairs = None, Pairs(self._places)

    def moved(self, robot: str) -> None:
        """Note that a robot has driven on, which by itself changes nothing."""
        self._touched.add(robot)

    def stuck(self) -> Mapping[str, frozenset[str]]:
        """Return the robots that can't reach their goals one after the other, each with those who stand in its way."""
        if self._stuck is None:
            self._stuck = self.order({})
        return self._stuck

    def order(self, ends: Mapping[str, int]) -> dict[str, frozenset[str]]:
        """Let robots reach their goals one after the other, from the ends of their leases, or from `ends`."""
        self._pairs.update(self._robots, self._touched)
        self._touched.clear()
        pairs = self._pairs.copy()
        robots = pairs.robots
        for number in [number for number, robot in enumerate(robots) if robot.id in ends]:
            pairs.move(number, ends[robots[number].id])
        left = sorted((n for n, robot in enumerate(robots) if robot.drives), key=lambda n: robots[n].order)
        stepped: set[int] = set()
        while left:
            blocked: Bools = np.any(pairs.stands[left], axis=1)
            ready = [n for n, waits in zip(left, blocked.tolist(), strict=True) if not waits]
            if not ready:
                if not self._step_on(left, pairs, stepped):
                    break
                continue
            # Whose goal is in nobody's way goes first: that blocks no other one.
            in_the_way: Bools = np.any(pairs.passes[left], axis=0)
            for n in [n for n in ready if not in_the_way[n]] or ready[:1]:
                left.remove(n)
                pairs.arrive(n)
        return {robots[n].id: frozenset(robots[j].id for j in np.flatnonzero(pairs.stands[n])) for n in left}

    def _step_on(self, left: list[int], pairs: Pairs, stepped: set[int]) -> bool:
        """Let one of the robots that are left drive to a place on its way where it is in no other one's, if one can."""
        for n in left:
            if n not in stepped:
                stepped.add(n)
                stop = pairs.stop_before(n, pairs.limit(n), left)
                if stop > pairs.begins[n]:
                    pairs.move(n, stop)
                    return True
        return False

    def room_needed(self, now: float, obstacles: Callable[[str], list[Disc]]) -> Room | None:
        """Return which robot needs another path to end a standstill, the last in order first; None if none does."""
        if all(robot.waits_for is None for robot in self._robots.values()):
            return None
        stuck = self.stuck()
        for me in self._robots.values():
            other = self._robots.get(me.lets_pass or "")
            if other is None or me.end - me.progress > WAITING_M:
                continue
            # Nobody has to wait where there is room for both.
            one, passed = (other, me) if me.parks else (me, other)
            line = me.points[-1:] if me.parks else between(me, other.ahead(), reach_of(me, other))
            if now - self._tried.get((one.id, "past"), -math.inf) >= RETRY_S:
                self._tried[one.id, "past"] = now
                avoid = [*obstacles(one.id), disc(one, passed, line)]
                return Room(one.id, "past", avoid, [], frozenset((passed.id,)))
        # Who waits for others at its goal, or theirs beside it, can only wait.
        waiting = [me for me in map(self._robots.__getitem__, stuck) if not self._goal_taken(me, stuck[me.id])]
        ordered = sorted(waiting, key=lambda robot: robot.order, reverse=True)
        for kind in _KINDS:
            for me in ordered:
                if now - self._tried.get((me.id, kind), -math.inf) >= RETRY_S:
                    room = self._room(me, kind, stuck)
                    self._tried[me.id, kind] = now
                    if room is not None:
                        return room
        return None

    def _goal_taken(self, me: Corridor, blockers: frozenset[str]) -> bool:
        others = [self._robots[robot] for robot in blockers]
        ends = [(other.points[-1] if other.drives else other.at[0], reach_of(me, other)) for other in others]
        return any(math.dist(me.points[-1], end) <= reach for end, reach in ends)

    def _room(self, me: Corridor, kind: Kind, stuck: Mapping[str, frozenset[str]]) -> Room | None:
        blockers = [self._robots[robot] for robot in sorted(stuck[me.id])]
        facing = [other for other in blockers if me.id in stuck.get(other.id, ())]
        if kind == "lane" and not facing:
            return None
        avoid = [
            disc(me, other, between(me, other.ahead(), reach_of(me, other)))
            for other in (facing if kind == "lane" else ())
        ]
        keep_off: list[Disc] = []
        if kind == "aside":
            others = [other for other in self._robots.values() if other is not me]
            blockers = [other for other in others if other.drives and other.id in stuck] or blockers
            avoid = [disc(me, other, line) for other in others for line in other.held()]
            keep_off = [Disc(other.ahead(), reach_of(me, other) + ASIDE_M) for other in others] + avoid
            keep_off += [place.disc(me) for place in self._places if not place.has_body(me)]
        else:
            standing = [other for other in blockers if kind != "lane" or other not in facing]
            avoid += [disc(me, other, line) for other in standing for line in (*other.held(), *other.stand())]
            held = [place for place in self._places if any(place.holds(other, other.held()) for other in blockers)]
            avoid += [place.disc(me) for place in held if not place.has_body(me)]
        return Room(me.id, kind, avoid, keep_off, frozenset(other.id for other in blockers))

    def accepts(self, room: Room, corners: Floats) -> bool:
        """Whether robots can do more with this path than without it."""
        me, before = self._robots[room.robot], self.stuck()
        kept = me.points, me.along, me.low, me.high, me.progress, me.leased
        me.points, me.along = sampled_along(corners, SPACING_M)
        (me.low, me.high), me.progress = box(corners), 0.0
        me.leased = me.first
        self._touched.add(me.id)
        after = self.order({})
        me.points, me.along, me.low, me.high, me.progress, me.leased = kept
        self._touched.add(me.id)
        return after.keys() <= before.keys() if room.kind == "past" else after.keys() < before.keys()
