"""Reports of obstacles: lidar points that the map does not explain, and how far the lidar sees."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import FREE, INSCRIBED, UNKNOWN
from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS, RobotObstacles, View
from robot_agent.agent.sensing.barred_way import CELL_M, BarredWay, Look, distances

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Moment
    from fog_contracts.replica import Replica
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2

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
