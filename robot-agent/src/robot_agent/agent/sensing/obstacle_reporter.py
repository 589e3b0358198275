"""Reports of obstacles: lidar points that the map does not explain, and how far the lidar sees."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

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

_EXPLAINED_M: Final = 0.25
"""A lidar point this near to a wall of the map is explained by it."""
_CELL_M: Final = 0.1
_RANGE_M: Final = 6.0
_TURN_RATE: Final = 0.5
"""Above this turning rate (rad/s) no obstacle is reported: the residual skew would smear it."""
_SCAN_AGE_S: Final = 0.5
_MEMORY_MARGIN_S: Final = 2.0
"""A cell counts as reported by this robot for this much longer than its report is valid: messages take time."""
_POINTS_MIN: Final = 2
"""Fewest points in a reported cell: a single beam may be a mixed echo off an edge."""

_NOWHERE: Final = np.zeros((0, 2))

Cell = tuple[int, int]


class ObstacleReporter:
    """Turns scans into reports, and remembers which cells it reported itself.

    ttl: how long (s) a report is valid. limit: most points in a report; the nearest are kept.
    """

    def __init__(self, ttl: float, limit: int) -> None:
        self._ttl = ttl
        self._limit = limit
        self._reported: dict[Cell, float] = {}
        """Until when each cell counts as reported by this robot."""

    def report(
        self,
        localizer: Localizer,
        replica: Replica,
        scan_age: float,
        at: Moment,
        impassable: NDArray[np.float64] = _NOWHERE,
    ) -> RobotObstacles | None:
        """Return lidar points that the map does not explain; None while pose or scan is not good enough.

        Obstacles that others put on the map are left out; this robot's own are reported for as long as it sees them.
        impassable: (n, 2) m, frame `map`: a place that it could not pass although nothing is seen there.
        """
        points, scan, pose = localizer.points_in_map(), localizer.scan, localizer.pose(at.now)
        if localizer.status != "good" or replica.geometry is None or points is None or scan is None or pose is None:
            return None
        if scan_age > _SCAN_AGE_S or abs(localizer.twist()[1]) > _TURN_RATE:
            return None
        near = np.hypot(*scan.points.T) <= _RANGE_M
        unexplained = points[near & (localizer.wall_distance(points) > _EXPLAINED_M)]
        unexplained = unexplained[self._is_reportable(unexplained, replica, replica.geometry, at.now)]
        cells = self._choose(unexplained, pose)
        cells += [(cx, cy) for cx, cy in np.floor(impassable / _CELL_M).astype(np.int64).tolist()]
        self._remember(cells, at.now)
        return RobotObstacles(
            points=[((cx + 0.5) * _CELL_M, (cy + 0.5) * _CELL_M) for cx, cy in cells],
            stamp=at.stamp,
            ttl=self._ttl,
            view=view(localizer.scan_pose(), points, replica.geometry),
        )

    def is_self_reported(self, points: NDArray[np.float64], now: float) -> NDArray[np.bool_]:
        """Return which points (n, 2; m, frame `map`) lie in a cell that this robot reported, or beside one."""
        reported = {cell for cell, until in self._reported.items() if until >= now}
        around = [(dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        cells = np.floor(points / _CELL_M).astype(np.int64).tolist()
        return np.array([any((cx + dx, cy + dy) in reported for dx, dy in around) for cx, cy in cells], dtype=np.bool_)

    def _choose(self, points: NDArray[np.float64], pose: Pose2) -> list[Cell]:
        """Return the cells with enough of the points (n, 2); beyond the limit, those nearest to the robot."""
        cells, counts = np.unique(np.floor(points / _CELL_M).astype(np.int64), axis=0, return_counts=True)
        chosen = cells[counts >= _POINTS_MIN]
        if len(chosen) > self._limit:
            offset = (chosen + 0.5) * _CELL_M - (pose.x, pose.y)
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
        known_floor = geometry.sample(replica.static, points, UNKNOWN) == FREE
        free = known_floor & (geometry.sample(replica.cost, points, UNKNOWN) < INSCRIBED)
        reportable: NDArray[np.bool_] = free | (self.is_self_reported(points, now) & inside)
        return reportable


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
