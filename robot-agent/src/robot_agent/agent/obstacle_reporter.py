"""Reports of obstacles: lidar points that the map does not explain, how far the lidar sees, what bars the way. Pure.

Far away two beams are farther apart than a cell is wide, and an error of the heading moves a point by more than that.
So one look does not prove an obstacle on the way ahead; some looks in a row do (`BarredWay`), each from elsewhere. How
wide it is, and what is open beside it, one look shows best: the heading's error moves both alike.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import FREE, INSCRIBED, UNKNOWN
from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS, RobotObstacles, View

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Moment
    from fog_contracts.replica import Replica
    from robot_agent.localization.localizer import Localizer
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


_EXPLAINED_M: Final = 0.25
"""A lidar point this near to a wall of the map is explained by it."""
_RANGE_M: Final = 6.0
"""Up to here one scan is enough; what is farther away is reported only if it bars the robot's way."""
_TURN_RATE: Final = 0.5
"""Above this turning rate (rad/s) no obstacle is reported: the residual skew would smear it."""
_FAR_TURN_RATE: Final = 0.25
_FAR_HEADING_RAD: Final = _EXPLAINED_M / _RANGE_M
"""Above this rate, or with a less certain heading (standard deviation), nothing is looked for on the way ahead."""
_SAME_M: Final = 0.5
"""What is this near to an obstacle that was found on the way is more of it, be it near a wall or on the map already:
if the path still leads there, there is a gap beside it, or seemed to be."""
_SCAN_AGE_S: Final = 0.5
_MEMORY_MARGIN_S: Final = 2.0
"""A cell counts as reported by this robot for this much longer than its report is valid: messages take time."""
_POINTS_MIN: Final = 2
"""Fewest points in a reported cell: a single beam may be a mixed echo off an edge."""

_NOWHERE: Final = np.zeros((0, 2))

Cell = tuple[int, int]


class _Seen(NamedTuple):
    """What a scan shows; of what the map does not explain, how far (m) its next wall is, and how far away it is."""

    look: Look
    distance: NDArray[np.float64]
    away: NDArray[np.float64]


class ObstacleReporter:
    """Turns scans into reports, and remembers which cells it reported itself.

    ttl: how long (s) a report is valid. limit: most points in a report; the nearest are kept. radius: the body's, m.
    """

    def __init__(self, ttl: float, limit: int, radius: float) -> None:
        self._ttl = ttl
        self._limit = limit
        self._barred_way = BarredWay(radius)
        self._barring = _NOWHERE
        """Points (n, 2; m, frame `map`) of the obstacle that was found last on the path ahead, ..."""
        self._news = False
        """... and whether it has yet to be reported."""
        self._reported: dict[Cell, float] = {}
        """Until when each cell counts as reported by this robot."""

    def wants_look(self, now: float) -> bool:
        """Whether something seems to be on the path ahead, so that `look` is due before the next report."""
        return self._barred_way.wants_look(now)

    def look(self, localizer: Localizer, replica: Replica, scan_age: float, way: NDArray[np.float64]) -> bool:
        """Look at the path ahead, as `report` does; return whether an obstacle on it must be reported now."""
        seen = _seen(localizer, replica, scan_age)
        if seen is not None:
            self._look_ahead(seen, localizer, replica, way)
        return self._news

    def report(
        self,
        localizer: Localizer,
        replica: Replica,
        scan_age: float,
        at: Moment,
        impassable: NDArray[np.float64] = _NOWHERE,
        way: NDArray[np.float64] = _NOWHERE,
    ) -> RobotObstacles | None:
        """Return lidar points that the map does not explain; None while pose or scan is not good enough.

        Obstacles that others put on the map are left out; this robot's own are reported for as long as it sees them.
        impassable: (n, 2) m, frame `map`: a place that it could not pass although nothing is seen there. way: (m, 2) m,
        the path ahead: an obstacle on it is reported once, as a whole, from as far as the lidar sees.
        """
        seen, pose = _seen(localizer, replica, scan_age), localizer.pose(at.now)
        if seen is None or pose is None or replica.geometry is None:
            return None
        near = seen.look.unexplained[seen.away <= _RANGE_M]
        if len(near):
            near = near[self._is_reportable(near, replica, replica.geometry, at.now)]
        cells = self._choose(near, pose) if len(near) else []
        cells += [(cx, cy) for cx, cy in np.floor(impassable / CELL_M).astype(np.int64).tolist()]
        self._look_ahead(seen, localizer, replica, way)
        if self._news:
            cells += [(cx, cy) for cx, cy in np.floor(self._barring / CELL_M).astype(np.int64).tolist()]
            self._news = False
        self._remember(cells, at.now)
        return RobotObstacles(
            points=[((cx + 0.5) * CELL_M, (cy + 0.5) * CELL_M) for cx, cy in dict.fromkeys(cells)],
            stamp=at.stamp,
            ttl=self._ttl,
            view=view(seen.look.seen_from, seen.look.points, replica.geometry),
        )

    def is_self_reported(self, points: NDArray[np.float64], now: float) -> NDArray[np.bool_]:
        """Return which points (n, 2; m, frame `map`) lie in a cell that this robot reported, or beside one."""
        reported = {cell for cell, until in self._reported.items() if until >= now}
        around = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        cells = np.floor(points / CELL_M).astype(np.int64).tolist()
        return np.array([any((cx + dx, cy + dy) in reported for dx, dy in around) for cx, cy in cells], dtype=np.bool_)

    def _look_ahead(self, seen: _Seen, localizer: Localizer, replica: Replica, way: NDArray[np.float64]) -> None:
        """Look at the path ahead; keep the cells of an obstacle on it for the next report, if the map lacks them."""
        if abs(localizer.twist()[1]) > _FAR_TURN_RATE or localizer.uncertainty.heading > _FAR_HEADING_RAD:
            return
        look = seen.look
        if not len(look.unexplained):
            self._barred_way.look(look, np.zeros(0, np.bool_), _NOWHERE)
            return
        # A wall may seem to be as much farther off as it is farther away.
        begins = seen.distance > _EXPLAINED_M * np.maximum(1.0, seen.away / _RANGE_M)
        begins &= _is_free(look.unexplained, replica)
        if len(self._barring):
            begins |= distances(look.unexplained, self._barring) <= _SAME_M
        found = self._barred_way.look(look, begins, way)
        found = found[_is_free(found, replica)][: self._limit]
        if len(found):
            self._barring, self._news = found, True

    def _choose(self, points: NDArray[np.float64], pose: Pose2) -> list[Cell]:
        """Return the cells with enough of the points (n, 2); beyond the limit, those nearest to the robot."""
        cells, counts = np.unique(np.floor(points / CELL_M).astype(np.int64), axis=0, return_counts=True)
        chosen = cells[counts >= _POINTS_MIN]
        if len(chosen) > self._limit:
            offset = (chosen + 0.5) * CELL_M - (pose.x, pose.y)
            chosen = chosen[np.argsort(np.hypot(*offset.T), kind="stable")[: self._limit]]
        return [(cx, cy) for cx, cy in chosen.tolist()]

    def _remember(self, cells: list[Cell], now: float) -> None:
        self._reported = {cell: until for cell, until in self._reported.items() if until >= now}
        self._reported.update(dict.fromkeys(cells, now + self._ttl + _MEMORY_MARGIN_S))

    def _is_reportable(
        self, points: NDArray[np.float64], replica: Replica, geometry: GridGeometry, now: float
    ) -> NDArray[np.bool_]:
        """Return which points (n, 2) lie on floor that is free but for this robot's own reports."""
        _, inside = geometry.cells(points)
        reportable: NDArray[np.bool_] = _is_free(points, replica) | (self.is_self_reported(points, now) & inside)
        return reportable


def _seen(localizer: Localizer, replica: Replica, scan_age: float) -> _Seen | None:
    """Return what the newest scan shows; None while pose or scan is not good enough."""
    pose, points, scan = localizer.scan_pose(), localizer.points_in_map(), localizer.scan
    if localizer.status != "good" or replica.geometry is None or pose is None or points is None or scan is None:
        return None
    if scan_age > _SCAN_AGE_S or abs(localizer.twist()[1]) > _TURN_RATE:
        return None
    distance = localizer.wall_distance(points)
    strange = distance > _EXPLAINED_M
    look = Look(scan.timestamp, pose, points, points[strange])
    return _Seen(look, distance[strange], np.hypot(*scan.points[strange].T))


def _is_free(points: NDArray[np.float64], replica: Replica) -> NDArray[np.bool_]:
    """Return which points (n, 2; m, frame `map`) lie on known floor that the map shows as free."""
    geometry = replica.geometry
    assert geometry is not None
    known_floor = geometry.sample(replica.static, points, UNKNOWN) == FREE
    free: NDArray[np.bool_] = known_floor & (geometry.sample(replica.cost, points, UNKNOWN) < INSCRIBED)
    return free


def view(pose: Pose2 | None, points: NDArray[np.float64], geometry: GridGeometry) -> View | None:
    """Return how far the lidar saw from its pose, by the points (n, 2; m, frame `map`); None off the map."""
    if pose is None or not geometry.contains_cell(*geometry.cell(pose.x, pose.y)):
        return None
    dx, dy = points[:, 0] - pose.x, points[:, 1] - pose.y
    sectors = np.floor(np.arctan2(dy, dx) % math.tau * (VIEW_SECTORS / math.tau)).astype(np.int64) % VIEW_SECTORS
    reach = np.full(VIEW_SECTORS, np.inf)
    np.minimum.at(reach, sectors, np.hypot(dx, dy))
    units = np.where(np.isfinite(reach), np.clip(np.floor(reach / REACH_UNIT_M), 0, 255), 0).astype(np.uint8)
    return View(x=pose.x, y=pose.y, reach=units.tobytes())
