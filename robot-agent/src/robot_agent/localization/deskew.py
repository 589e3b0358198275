"""Deskewing: correct a scan for the robot's motion during the revolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fog_kernels import scans

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.odometry_buffer import OdometryBuffer
    from robot_agent.localization.pose import Pose2


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
