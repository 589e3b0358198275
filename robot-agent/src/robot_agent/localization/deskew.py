"""Deskewing: correct a scan for the robot's motion during the revolution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

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
    return points[np.linspace(0, len(points) - 1, count).astype(np.int64)]


def deskew(scan: LaserScan, odometry: OdometryBuffer, config: LocalizationConfig) -> DeskewedScan | None:
    """Move each sample by the robot's motion between its own time and the scan's end.

    None when no odometry is as old as the scan's end. The lidar's pose in `base` and its rated range are the config's.
    """
    end = odometry.pose(scan.ended_at)
    if end is None or not odometry.reaches_back_to(scan.ended_at):
        return None
    ranges = np.asarray(scan.ranges_m, dtype=np.float64)
    valid = np.isfinite(ranges) & (ranges >= config.range_min) & (ranges <= config.range_max)
    count = len(ranges)
    times = scan.started_at + (scan.ended_at - scan.started_at) * np.arange(count) / max(count - 1, 1)
    directions = np.asarray(scan.angles_rad)[valid] + config.lidar_yaw
    base_x = config.lidar_x + ranges[valid] * np.cos(directions)
    base_y = config.lidar_y + ranges[valid] * np.sin(directions)
    x, y, theta = odometry.poses(times[valid])
    odom_x = x + np.cos(theta) * base_x - np.sin(theta) * base_y - end.x
    odom_y = y + np.sin(theta) * base_x + np.cos(theta) * base_y - end.y
    cos, sin = math.cos(end.theta), math.sin(end.theta)
    points = np.column_stack((cos * odom_x + sin * odom_y, -sin * odom_x + cos * odom_y))
    return DeskewedScan(points, end, scan.ended_at)
