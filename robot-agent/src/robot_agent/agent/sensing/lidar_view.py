"""What the newest whole scan covers, against what the robot's map leads to expect from where it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.costs import LETHAL
from fog_kernels.raycast import cast
from robot_agent.footprint import SECTORS
from robot_agent.safety.visibility import SECTOR_ANGLES, Visibility

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.replica import Replica
    from robot_agent.config import LocalizationConfig, VisibilityConfig
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.pose import Pose2


class LidarView:
    """Feeds `Visibility` with scans and the walls of the static map."""

    def __init__(self, lidar: LocalizationConfig, config: VisibilityConfig) -> None:
        self._lidar = lidar
        self._range = min(config.range_share * lidar.range_max, config.range_max)
        self.visibility = Visibility(config)
        self._static = np.zeros((1, 1), np.uint8)
        self._walls = np.zeros((1, 1), np.bool_)

    def on_scan(self, scan: LaserScan, pose: Pose2 | None, replica: Replica) -> None:
        """Handle a whole scan that ended at `pose` (frame `map`; None while it is unknown: nothing is expected)."""
        angles = np.asarray(scan.angles_rad, np.float64) + self._lidar.lidar_yaw
        self.visibility.update(angles, np.isfinite(scan.ranges_m), self._expected(pose, replica))

    def _expected(self, pose: Pose2 | None, replica: Replica) -> NDArray[np.bool_]:
        """Return in which sectors the map has a wall within the range at which the lidar surely sees one."""
        geometry = replica.geometry
        if pose is None or geometry is None:
            return np.zeros(SECTORS, np.bool_)
        if self._static is not replica.static:
            self._static, self._walls = replica.static, replica.static == LETHAL
        ranges = cast(
            self._walls,
            geometry.resolution,
            geometry.origin_x,
            geometry.origin_y,
            pose.x,
            pose.y,
            SECTOR_ANGLES + pose.theta,
            self._range,
        )
        return np.isfinite(ranges)
