"""What stands on the way ahead, as far off as the lidar sees, once several looks agree on it. Pure.

Far away two beams are farther apart than a cell is wide, and an error of the heading moves a point by more than that.
So one look does not prove an obstacle; some looks in a row do, each from elsewhere. How wide it is, and what is open
beside it, one look shows best: the heading's error moves both alike.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.pose import Pose2

    Cells = NDArray[np.int64]
    Flags = NDArray[np.bool_]
    Points = NDArray[np.float64]

CELL_M: Final = 0.1
"""Size of the cells in which obstacles are reported."""
WAY_M: Final = 13.0
"""How much of the path ahead is looked at: the lidar's 12 m, and a curve."""
_LOOKS: Final = 4
"""How many looks must agree that something is there ..."""
_EXTENT_LOOKS: Final = 2
"""... and how many on each part of it: at the end of its range a lidar sees only some of it at first."""
_LOOK_AGAIN_S: Final = 0.3
"""Time between looks while something seems to be there: somebody who walks by is elsewhere after three of them."""
_LOOKS_WITHIN_S: Final = 4.5
"""An older look counts no more. While the robot turns, or its pose is weak, there is none."""
_NEAR: Final = 3
"""How many cells apart two looks may see the same thing: 0.3 m are 2 degrees of heading at 9 m."""
_BESIDE_M: Final = 0.1
"""What comes this much nearer to the path than the body's rim is on the way."""
_BEGIN_MIN: Final = 2
"""Fewest points of an obstacle on the way: a single beam may be a mixed echo off an edge."""
_HALF: Final = 40
"""Half the width, in cells, of the square around what is on the way to which an obstacle is followed."""
_NEAREST_M: Final = 3.0
"""What is nearer is seen by two beams in each cell, and past its ends at such an angle that gaps look closed."""
_WIDE_M: Final = 0.6
"""What is narrower bars no way by itself, and is often a person or a robot: it is not reported from afar."""
_BEHIND_M: Final = 0.3
"""A beam that comes back from this much behind an obstacle has passed it."""
_SPARE_M: Final = 0.1
"""A gap must be this much wider than the body to be told from none."""

_NOTHING: Final = np.zeros((0, 2))


class Look(NamedTuple):
    """What a scan shows, in `map`, from the pose where it ended `at` (s).

    points: (n, 2) m, all of it. unexplained: (m, 2) m, what the floor plan does not explain.
    """

    at: float
    seen_from: Pose2
    points: Points
    unexplained: Points


class BarredWay:
    """Compares looks along the way of a body with this radius (m). Times are s of the robot's monotonic clock."""

    def __init__(self, radius: float) -> None:
        self._reach = radius + _BESIDE_M
        self._gap = 2.0 * radius + _SPARE_M
        """The body fits through what is wider."""
        self._looks: deque[Look] = deque(maxlen=_LOOKS)
        self._unsure = False

    def wants_look(self, now: float) -> bool:
        """Whether something seems to be on the way, and it is time to look again."""
        return self._unsure and now - self._looks[-1].at >= _LOOK_AGAIN_S

    def look(self, look: Look, begins: Flags, way: Points) -> Points:
        """Add a look; return the points (n, 2; m) of the nearest obstacle on the way, all of it, or none.

        begins: which of the unexplained points may be the first that is known of an obstacle. way: (n, 2) m, the path
        ahead, from the robot on, in steps of a cell or less.
        """
        if self._looks and self._looks[-1].at >= look.at:
            return _NOTHING
        self._looks.append(look)
        first = look.unexplained[begins]
        if len(first) and len(way):
            first = first[distances(first, way) <= self._reach]
        self._unsure = len(first) >= _BEGIN_MIN and len(way) > 0
        looks = [past for past in self._looks if look.at - past.at <= _LOOKS_WITHIN_S]
        if not self._unsure or len(looks) < _LOOKS:
            return _NOTHING
        away = np.hypot(*(first - way[0]).T)
        nearest = first[np.argmin(away)]
        if away.min() < _NEAREST_M:
            return _NOTHING
        corner = np.floor(nearest / CELL_M).astype(np.int64) - _HALF
        rasters = [_raster(past.unexplained, corner) for past in looks]
        votes = np.logical_or.reduce(rasters) * np.sum([_grown(raster, _NEAR) for raster in rasters], axis=0)
        begin = _raster(first, corner) & (votes == _LOOKS)
        if begin.sum() < _BEGIN_MIN:
            return _NOTHING
        self._unsure = False  # the next report tells whether the map has it
        whole = _connected(begin, votes >= _EXTENT_LOOKS, math.ceil(self._gap / CELL_M))
        parts = [past.unexplained[_is_in(past.unexplained, whole, corner)] for past in looks]
        if max(_width(part, look) for part in parts) < _WIDE_M:
            return _NOTHING
        # Of two looks that differ the narrower one lacks a beam. A gap is one in either.
        shapes = [self._closed(part, past) for part, past in zip(parts, looks, strict=True)]
        return max(shapes, key=lambda shape: _width(shape, look))

    def _closed(self, obstacle: Points, look: Look) -> Points:
        """Return the points (n, 2) of an obstacle, and more where the body does not fit: between them and at its ends.

        It does not fit beside an end where a beam comes back from no farther than the obstacle: from a wall, or from
        more of it that could as well be the wall.
        """
        bearing, away = _polar(obstacle, look)
        others, others_away = _polar(look.points, look)
        width = (self._gap / away)[:, np.newaxis]
        aside = np.column_stack((-np.sin(bearing), np.cos(bearing)))
        found = [obstacle]
        for side in (-1.0, 1.0):
            next_to = np.remainder(side * (bearing - bearing[:, np.newaxis]), math.tau)
            is_end = ~((next_to > 0.0) & (next_to <= width)).any(axis=1)
            next_to = np.remainder(side * (others - bearing[:, np.newaxis]), math.tau)
            no_farther = others_away <= away[:, np.newaxis] + _BEHIND_M
            shut = is_end & ((next_to > 0.0) & (next_to <= width) & no_farther).any(axis=1)
            found += [obstacle[shut] + side * step * aside[shut] for step in np.arange(CELL_M, self._gap, CELL_M)]
        row = obstacle[np.argsort(np.remainder(bearing - look.seen_from.theta, math.tau))]
        from_one, to_next = row, np.roll(row, -1, axis=0)
        near = np.hypot(*(to_next - from_one).T) <= self._gap
        found += [from_one[near] + share * (to_next - from_one)[near] for share in (0.25, 0.5, 0.75)]
        return np.concatenate(found)


def distances(points: Points, others: Points) -> Points:
    """Return how far (m) each of the points (n, 2) is from the nearest of others (m, 2), of which there must be one."""
    apart = points[:, np.newaxis] - others
    nearest: Points = np.sqrt((apart**2).sum(axis=2).min(axis=1))
    return nearest


def _width(points: Points, look: Look) -> float:
    """Return how wide (m) an obstacle of these points (n, 2) is, across the view of a look."""
    if not len(points):
        return 0.0
    bearing, away = _polar(points, look)
    return float(np.ptp(np.unwrap(bearing)) * away.min())


def _polar(points: Points, look: Look) -> tuple[Points, Points]:
    """Return the bearings (rad) and distances (m) of points (n, 2) as seen from where a look was made."""
    dx, dy = points[:, 0] - look.seen_from.x, points[:, 1] - look.seen_from.y
    return np.arctan2(dy, dx), np.hypot(dx, dy)


def _connected(begin: Flags, cells: Flags, gap: int) -> Flags:
    """Return those of the cells that are connected with the first ones by steps of at most `gap` cells."""
    whole = begin
    while True:
        grown = cells & _grown(whole, gap)
        if grown.sum() == whole.sum():
            return grown
        whole = grown


def _is_in(points: Points, cells: Flags, corner: Cells) -> Flags:
    """Return which of the points (n, 2; m) lie in one of these cells of the square that begins at `corner`."""
    columns, rows = (np.floor(points / CELL_M).astype(np.int64) - corner).T
    size = 2 * _HALF + 1
    inside: Flags = (columns >= 0) & (columns < size) & (rows >= 0) & (rows < size)
    inside[inside] = cells[rows[inside], columns[inside]]
    return inside


def _raster(points: Points, corner: Cells) -> Flags:
    """Return which cells of the square that begins at a cell (column, row) hold one of the points (n, 2; m)."""
    size = 2 * _HALF + 1
    cells = np.floor(points / CELL_M).astype(np.int64) - corner
    columns, rows = cells[((cells >= 0) & (cells < size)).all(axis=1)].T
    raster = np.zeros((size, size), np.bool_)
    raster[rows, columns] = True
    return raster


def _grown(cells: Flags, by: int) -> Flags:
    """Return the cells (h, w) within `by` columns and rows of one of these."""
    size = 2 * by + 1
    sums = np.pad(cells.astype(np.int32), ((by + 1, by), (by + 1, by))).cumsum(axis=0).cumsum(axis=1)
    grown: Flags = sums[size:, size:] - sums[:-size, size:] - sums[size:, :-size] + sums[:-size, :-size] > 0
    return grown
