"""Who would stand in whose way: all pairs of robots, of which only those that have changed are compared again. Pure.

With fifty robots there are 2,450 pairs, but few robots change at a time, and boxes tell most pairs apart at once.
"""

from __future__ import annotations

import math
from copy import copy
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels.lines import first_near
from planner.leases.corridors import MARGIN_M, NOWHERE, SPACING_M, STRAY_M, Corridor, box, meets, reach_of, stop_before

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from planner.leases.narrow_places import NarrowPlace

    Floats = NDArray[np.float64]
    Bools = NDArray[np.bool_]

_NO_BOX: Final = (1e12, 1e12, -1e12, -1e12)
_OWN: Final = (
    "begins", "lasts", "lines", "ends", "ahead_box", "stand_box", "end_box", "stands", "goals", "passes", "enters",
    "stands_in", "ends_in",
)  # fmt: skip
_SAME_M: Final = 0.02
"""A robot that has moved less stands where it was ..."""
_SAME_POINTS: Final = 10
"""... and looks as far ahead."""


def _box(lines: Sequence[Floats]) -> tuple[float, float, float, float]:
    if not lines or not all(map(len, lines)):
        return _NO_BOX
    points = lines[0] if len(lines) == 1 else np.concatenate(lines)
    low, high = box(points)
    return (*low, *high) if math.isfinite(high[0]) else _NO_BOX


def _near(one: NDArray[np.float64], boxes: NDArray[np.float64], reach: NDArray[np.float64]) -> list[int]:
    """Return the numbers of the boxes ((n, 4): left, bottom, right, top) that may come within `reach` of one box."""
    apart = np.maximum(boxes[:, :2] - one[2:], one[:2] - boxes[:, 2:]).max(axis=1)
    found: list[int] = np.flatnonzero(apart <= reach).tolist()
    return found


class Pairs:
    """For each pair of robots, whether one blocks the other's rest of its path.

    `stands[i, j]`: j, at the end of its lease, blocks i from the end of its own; `goals[i, j]`: j would at its goal.
    `passes[i, j]`: i passes the goal of j.
    """

    def __init__(self, places: Sequence[NarrowPlace] = ()) -> None:
        self._places = places
        self.robots: list[Corridor] = []
        self._keys: list[object] = []
        self._reset(0)

    def _reset(self, count: int) -> None:
        self.begins = [0] * count
        self.lasts = [0] * count
        self.lines: list[list[Floats]] = [[] for _ in range(count)]
        """Where each stands ..."""
        self.ends: list[Floats] = [NOWHERE] * count
        """... and will at its goal; nowhere when that is too far away."""
        self._points: list[Floats] = [NOWHERE] * count
        self.ahead_box, self.stand_box, self.end_box = (np.tile(np.array(_NO_BOX), (count, 1)) for _ in range(3))
        self.radius, self.stray = np.zeros(count), np.zeros(count)
        shape = count, len(self._places)
        self.enters, self.stands_in, self.ends_in = (np.zeros(shape, np.bool_) for _ in range(3))
        """Which places for one robot each gets into on its way, and in which it stands, or will at its goal."""
        self.stands, self.goals, self.passes = (np.zeros((count, count), np.bool_) for _ in range(3))

    def update(self, robots: Mapping[str, Corridor], touched: Iterable[str]) -> None:
        """Compare those robots again that have changed, of those that may have."""
        if (known := list(robots.values())) != self.robots:
            self.robots = known
            self._keys = [None] * len(self.robots)
            self._reset(len(self.robots))
            touched = robots
        numbers = {robot.id: number for number, robot in enumerate(self.robots)}
        changed = []
        for number in [numbers[robot] for robot in touched if robot in numbers]:
            me = self.robots[number]
            if (key := _key(me)) != self._keys[number]:
                self._keys[number] = key
                self._points[number] = me.points  # kept, so that no other array gets its id
                self._note(number, me.leased, me.stand())
                changed.append(number)
        for number in changed:
            self._compare(number)

    def copy(self) -> Pairs:
        """Return a copy that may be changed."""
        other = copy(self)
        for name in _OWN:
            setattr(other, name, getattr(self, name).copy())
        return other

    def move(self, number: int, stop: int) -> None:
        """Let a robot begin and stand at another point of its path."""
        self._note(number, stop, [self.robots[number].place(stop)])
        self._compare(number)

    def arrive(self, number: int) -> None:
        """Let a robot stand at its goal."""
        self.lines[number] = [self.ends[number]]
        self.stand_box[number], self.stands_in[number] = self.end_box[number], self.ends_in[number]
        self.stands[:, number] = self.goals[:, number]

    def limit(self, number: int) -> int:
        """Return the first point of a robot's path where another one stands, from where it begins; else its last."""
        me, end = self.robots[number], self.lasts[number]
        for j in _near(self.ahead_box[number], self.stand_box, self._reach_from(number)):
            if j != number:
                end = meets(me, self.robots[j], self.begins[number], end, self.lines[j])
        for k, place in enumerate(self._places):
            if np.count_nonzero(self.stands_in[:, k]) > self.stands_in[number, k]:
                end = place.entry(me, self.begins[number], end)
        return end

    def stop_before(self, number: int, end: int, others: Sequence[int]) -> int:
        """Return the last point before `end` where a robot is in none of the others' way; else where it begins."""
        me, begin = self.robots[number], self.begins[number]
        reach = self.radius[others] + (me.radius + MARGIN_M) + self.stray[others] + 1e-9
        near = [others[k] for k in _near(np.array(_box([me.points[begin:end]])), self.ahead_box[others], reach)]
        marked = np.zeros(len(me.points), np.bool_)
        for k, place in enumerate(self._places):
            if any(self.enters[j, k] for j in others if j != number):
                marked |= place.taken(me)
        return stop_before(me, begin, end, [(self.robots[j], self.begins[j]) for j in near if j != number], marked)

    def _note(self, number: int, begin: int, lines: list[Floats]) -> None:
        me = self.robots[number]
        last = me.last if me.drives else 0
        self.begins[number], self.lasts[number], self.lines[number] = begin, last, lines
        whole = me.drives and last == len(me.points)
        self.ends[number] = me.place(len(me.points) - 1) if whole else NOWHERE
        self.ahead_box[number] = _box([me.points[begin:last]])
        self.stand_box[number], self.end_box[number] = _box(lines), _box([self.ends[number]])
        for k, place in enumerate(self._places):
            self.enters[number, k] = last > begin and place.entry(me, begin, last) < last
            self.stands_in[number, k] = place.holds(me, lines)
            self.ends_in[number, k] = whole and place.holds(me, [self.ends[number]])
        self.radius[number], self.stray[number] = me.radius, 0.0 if me.stray is False else STRAY_M

    def _reach_from(self, number: int) -> NDArray[np.float64]:
        """Return how near (m) a robot may come to each other one, as `reach_of` does."""
        reach: NDArray[np.float64] = self.radius + (self.radius[number] + MARGIN_M) + self.stray + 1e-9
        return reach

    def _compare(self, number: int) -> None:
        me, reach = self.robots[number], self._reach_from(number)
        for matrix, boxes in ((self.stands, self.stand_box), (self.goals, self.end_box), (self.passes, self.end_box)):
            matrix[number] = matrix[:, number] = False
            if me.drives:
                for j in _near(self.ahead_box[number], boxes, reach):
                    matrix[number, j] = j != number and self._holds(matrix, number, j)
        reach = reach - self.stray + self.stray[number]
        for j in _near(self.stand_box[number], self.ahead_box, reach):
            self.stands[j, number] = j != number and self._holds(self.stands, j, number)
        for j in _near(self.end_box[number], self.ahead_box, reach):
            self.goals[j, number] = j != number and self._holds(self.goals, j, number)
            self.passes[j, number] = j != number and self._holds(self.passes, j, number)
        if self._places:
            both = (self.stands, self.stands_in), (self.goals, self.ends_in), (self.passes, self.ends_in)
            for matrix, inside in both:
                matrix[number] |= np.any(self.enters[number] & inside, axis=1)
                matrix[:, number] |= np.any(self.enters & inside[number], axis=1)
                matrix[number, number] = False

    def _holds(self, matrix: Bools, i: int, j: int) -> bool:
        me, other, begin, last = self.robots[i], self.robots[j], self.begins[i], self.lasts[i]
        if matrix is self.passes:
            end, reach = self.ends[j], reach_of(me, other)
            return begin < last and first_near(me.points, begin, last, end, reach, SPACING_M) >= 0
        lines = self.lines[j] if matrix is self.stands else [self.ends[j]]
        return meets(me, other, begin, last, lines) < last


def _key(me: Corridor) -> object:
    """Return what the comparison with others depends on."""
    x, y = me.at[0].tolist()
    at = (x // _SAME_M, y // _SAME_M, me.first) if me.waits else ()
    last = me.last if me.drives else 0
    ahead = last // _SAME_POINTS, last == len(me.points)
    return id(me.points), me.leased, ahead, at, (*me.former,), me.path, me.standing, me.stray, me.radius
