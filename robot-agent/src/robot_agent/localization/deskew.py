"""Deskewing: correct a scan for the robot's motion during the revolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels import scans

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.odometry import OdometryBuffer
    from robot_agent.localization.pose import Pose2

_COMPARED: Final = 120
_COMPARED_LEAST: Final = 20
_BESIDE_RAD: Final = 0.04
"""A beam is compared with those of the scan before that went this near to its direction."""
_ALIKE_M: Final = 0.1
_ALIKE_SHARE: Final = 0.05
"""Ranges differ by no more than this, and this share of them: along a wall that is seen at a low angle by most."""
_ALIKE_BEAMS: Final = 0.7
"""Share of the beams that must be alike."""


@dataclass(frozen=True, slots=True)
class DeskewedScan:
    """A scan whose samples are moved to the robot's pose at its end.

    points: (n, 2) m, frame `base` at the scan's end, without samples that have no return or exceed the rated range.
    odom: pose of `base` in `odom` at that time. timestamp: that time (s).
    """

    points: NDArray[np.float64]
    odom: Pose2
    timestamp: float

    def beams(self, count: int) -> NDArray[np.float64]:
        """Return at most `count` of the points, evenly spread over the revolution."""
        return spread(self.points, count)


def spread(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return at most `count` of the points (n, 2), evenly spread over them."""
    if len(points) <= count:
        return points
    return points[np.arange(count) * (len(points) - 1) // max(count - 1, 1)]


def follows(scan: DeskewedScan, before: DeskewedScan) -> bool:
    """Whether a scan shows what the one before it showed, from where the wheels say that the robot is since.

    If it does not, somebody has carried or turned the robot, or stands around it. The map is not asked: so a door that
    was opened since it was made, which spoils how scans fit the map, says nothing here.
    """
    seen = before.odom.inverse_transform(scan.odom.transform(scan.beams(_COMPARED)))
    order = np.argsort(angles := np.arctan2(before.points[:, 1], before.points[:, 0]))
    if not len(order):
        return False
    bearings, ranges = angles[order], np.hypot(before.points[:, 0], before.points[:, 1])[order]
    bearing, distance = np.arctan2(seen[:, 1], seen[:, 0]), np.hypot(seen[:, 0], seen[:, 1])
    beside = (np.searchsorted(bearings, bearing)[:, None] + np.arange(-2, 2)) % len(order)
    turned = np.abs((bearings[beside] - bearing[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
    compared = turned < _BESIDE_RAD
    alike = compared & (np.abs(ranges[beside] - distance[:, None]) < _ALIKE_M + _ALIKE_SHARE * distance[:, None])
    count = int(compared.any(axis=1).sum())
    return count >= _COMPARED_LEAST and int(alike.any(axis=1).sum()) >= _ALIKE_BEAMS * count


def deskew(scan: LaserScan, odometry: OdometryBuffer, config: LocalizationConfig) -> DeskewedScan | None:
    """Move each sample by the robot's motion between its own time and the scan's end.

    None when no odometry is as old as the scan's end. The lidar's pose in `base` and its rated range are the config's.
    """
    end = odometry.pose(scan.ended_at)
    if end is None or not odometry.reaches_back_to(scan.ended_at):
        return None
    seen = scans.placed(
        scan.angles_rad,
        scan.ranges_m,
        scan.started_at,
        scan.ended_at,
        odometry.track(scan.started_at),
        scans.Mounting(config.lidar_x, config.lidar_y, config.lidar_yaw),
        config.range_min,
        config.range_max,
    )
    return DeskewedScan(end.inverse_transform(seen.points), end, scan.ended_at)
