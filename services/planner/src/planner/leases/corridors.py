"""A robot's corridor: where its body may come along its path, and how corridors are compared. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.lines import first_near, mark_near

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from numpy.typing import NDArray

    from planner.missions import PathId

    Floats = NDArray[np.float64]

MARGIN_M: Final = 0.15
"""Between the rims of two robots: how far each may be off its path, and the error of both poses."""
OFF_PATH_M: Final = 0.15
"""A robot farther from its path than this also holds the place where it is."""
SHORT: Final = 2
"""So many points of its path before the end of its lease a robot may stop already: it brakes, and lets it be."""
SPACING_M: Final = 0.1
"""Corridors are compared at points of the paths this far apart."""
HORIZON_M: Final = 35.0
"""So far ahead it is looked for robots that meet; a longer passage for one robot is entered from both ends."""
DEFAULT_RADIUS_M: Final = 0.17
"""Of a robot whose pose has not told its own."""
STRAY_M: Final = 0.6
"""Around a robot that drives by no path of this planner: how far it may get before it learns of anything."""
WAITING_M: Final = 0.5
"""With less than so much left of its lease a robot waits."""
_BETWEEN_M: Final = 0.15
"""So much farther off than that, since of places only the cells are known."""
_LEAVING: Final = 0.3
"""So much farther off, for each metre that it drives, a robot gets that leaves the line of another one."""
NOWHERE: Final = np.full((1, 2), np.inf)


class Disc(NamedTuple):
    """The places within `reach` (m) of a line's points ((n, 2), m)."""

    points: Floats
    reach: float


@dataclass(eq=False)
class Corridor:
    """Where a robot is, its path, and how far that is leased to it; m, frame `map`."""

    id: str
    order: tuple[int, int]
    """Whose turn is first: by priority, then by arrival."""
    radius: float = DEFAULT_RADIUS_M
    at: Floats = field(default_factory=NOWHERE.copy)
    heard_at: float = -math.inf
    moved_at: float = -math.inf
    moved_from: tuple[float, float] = (math.inf, math.inf)
    mission: str | None = None
    path: PathId | None = None
    points: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    along: Floats = field(default_factory=lambda: np.zeros(0))
    low: tuple[float, float] = (math.inf, math.inf)
    high: tuple[float, float] = (-math.inf, -math.inf)
    progress: float = 0.0
    """How far along its path (m) the robot is ..."""
    end: float = 0.0
    """... how far it may drive ..."""
    leased: int = 0
    """... and the number of the path's point up to which its corridor is leased."""
    former: dict[PathId, Floats] = field(default_factory=dict)
    """Stretches of earlier paths on which it may still drive, until it names a newer one."""
    left_at: float = -math.inf
    """When it got another path last, or none."""
    stray: bool | None = None
    """Whether it drives by no path of this planner; None: it has told no state yet."""
    able: bool = True
    withdrawn_at: float = math.inf
    standing: bool = False
    """Whether it counts as an obstacle: it gets no lease, and others find their way round it."""
    wanted: float = 0.0
    waits_for: str | None = None
    tried: object = None
    """What it waited for when it was tried to lease more to it, besides at its own request."""
    lets_pass: str | None = None
    """Who has to pass before it may drive on ..."""
    parks: bool = False
    """... and it would be at its goal."""
    passes: frozenset[str] = frozenset()
    """For whom it stands aside."""
    apart: dict[object, tuple[Floats, Floats]] = field(default_factory=dict)
    """How far (m) a path's points are from places for one robot, each with that path."""

    @property
    def first(self) -> int:
        """Number of the last point of the path that the robot has passed."""
        return max(0, int(self.along.searchsorted(self.progress, "right")) - 1)

    @property
    def last(self) -> int:
        """Number after the last point that is looked at."""
        return int(self.along.searchsorted(self.progress + HORIZON_M, "right"))

    @property
    def drives(self) -> bool:
        """Whether it has a path of this planner and may be led along it."""
        return self.path is not None and not self.standing

    def stand(self) -> list[Floats]:
        """Return where it stands once it has driven all that is leased to it."""
        return list(self.held()) if self.waits else [self.place(self.leased)]

    @property
    def waits(self) -> bool:
        """Whether it stays where it is."""
        return not self.drives or self.end - self.progress <= WAITING_M

    def place(self, stop: int) -> Floats:
        """Return where it may stand when it stops at a point of its path: somewhat before it, too."""
        return self.points[max(0, stop - SHORT) : stop + 1]

    def held(self) -> Iterator[Floats]:
        """Yield the lines along which it may be: the leased stretch, former ones, and where it is beside them."""
        if self.path is not None:
            yield self.points[self.first : self.leased + 1]
        yield from self.former.values()
        if self.path is None or math.dist(self.at[0], self.points[self.first]) > OFF_PATH_M + SPACING_M:
            yield self.at

    def ahead(self) -> Floats:
        """Return the rest of its path, as far as it is looked at; where it stands without one."""
        return self.points[self.first : self.last] if self.drives else self.at

    def far_from(self, other: Corridor, reach: float) -> bool:
        """Whether its path comes nowhere near the other's path and place."""
        x, y = other.at[0].tolist()
        apart_x = max(self.low[0] - max(other.high[0], x), min(other.low[0], x) - self.high[0])
        apart_y = max(self.low[1] - max(other.high[1], y), min(other.low[1], y) - self.high[1])
        return not other.former and max(apart_x, apart_y) > reach

    def far_from_point(self, point: Floats, reach: float) -> bool:
        """Whether its path comes nowhere near a point."""
        x, y = point.tolist()  # numpy's own numbers are slow
        apart = max(self.low[0] - x, x - self.high[0], self.low[1] - y, y - self.high[1])
        return bool(apart > reach)


def box(points: Floats) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the lower left and the upper right corner of the box around points ((n, 2), m)."""
    (left, bottom), (right, top) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return (left, bottom), (right, top)


def reach_of(me: Corridor, other: Corridor) -> float:
    """Return how near (m) the middles of two robots may come."""
    return me.radius + other.radius + MARGIN_M + (0.0 if other.stray is False else STRAY_M)


def between(me: Corridor, line: Floats, reach: float) -> Floats:
    """Return a line without its points near a robot's place and goal, which somebody has to leave or to reach."""
    ends = np.concatenate((me.at, me.points[-1:]))
    apart = np.hypot(*(line[:, None, :] - ends[None, :, :]).transpose(2, 0, 1)).min(axis=1)
    kept: Floats = line[apart > reach + _BETWEEN_M]
    return kept


def disc(me: Corridor, other: Corridor, line: Floats) -> Disc:
    """Return where a robot would come too near to another one on a line ((n, 2), m)."""
    return Disc(line, reach_of(me, other))


def meets(me: Corridor, other: Corridor, begin: int, end: int, lines: Iterable[Floats]) -> int:
    """Return the first point of a path from `begin` on where its robot is too near to another one's lines; else `end`.

    Who begins nearer than that may drive on as long as it gets no nearer; and where bodies could touch, as long as it
    gets farther away.
    """
    reach = reach_of(me, other)
    for line in lines:
        met = first_near(me.points, begin, end, line, reach, SPACING_M) if begin < end else -1
        if met == begin:
            apart = _apart(me.points[begin], line)
            if apart < me.radius + other.radius:
                end = _leaves(me, begin, end, line, reach)
                continue
            met = first_near(me.points, begin, end, line, apart - 1e-6, SPACING_M)
        end = met if met >= 0 else end
    return end


def _apart(point: Floats, line: Floats) -> float:
    return float(np.hypot(*(line - point).T).min())


def _leaves(me: Corridor, begin: int, end: int, line: Floats, reach: float) -> int:
    """Return the point up to which a robot that begins on another one's line only gets away from it; else `end`."""
    apart = _apart(me.points[begin], line)
    for stop in range(begin + 1, end):
        before, apart = apart, _apart(me.points[stop], line)
        if apart > reach:
            met = first_near(me.points, stop, end, line, reach, SPACING_M)
            return met if met >= 0 else end
        if apart < before + _LEAVING * SPACING_M:
            return stop
    return end


def contender_of(
    me: Corridor, stop: int, others: Iterable[Corridor], begins: Mapping[str, int] | None = None
) -> Corridor | None:
    """Return a robot that has to pass where this one would stop, from where it is or from one of `begins`."""
    place = me.place(stop)
    for other in others:
        reach = reach_of(me, other)
        if other is not me and other.drives and not other.far_from_point(me.points[stop], reach):
            first = other.first if begins is None else begins[other.id]
            if first_near(place, 0, len(place), other.points[first : other.last], reach, SPACING_M) >= 0:
                return other
    return None


def stop_before(
    me: Corridor, begin: int, end: int, others: Iterable[tuple[Corridor, int]], marked: NDArray[np.bool_]
) -> int:
    """Return the last point between two where a robot is in no other one's way; else `begin`.

    `others`: each with the point of its path from which on it drives. A robot may stop somewhat before the point, too.
    `marked`: points where it must not stop either; others are marked in it.
    """
    first, count = max(0, begin + 1 - SHORT), end - begin - 1
    if count <= 0:
        return begin
    for other, start in others:
        mark_near(me.points, first, end, other.points[start : other.last], reach_of(me, other), SPACING_M, marked)
    taken = np.concatenate((np.zeros(SHORT, np.bool_), marked[:end]))[-count - SHORT :]
    free = np.flatnonzero(~(taken[SHORT:] | taken[1:-1] | taken[:-SHORT]))
    return begin + 1 + int(free[-1]) if len(free) else begin


def comes_near(me: Corridor, line: Floats, reach: float, end: int | None = None) -> bool:
    """Whether the rest of a robot's path, as far as it is looked at or up to `end`, comes near a line."""
    end = me.last if end is None else end
    return me.first < end and first_near(me.points, me.first, end, line, reach, SPACING_M) >= 0
