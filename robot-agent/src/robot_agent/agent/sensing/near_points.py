"""What the lidar saw near the robot during the last moments, each sample from where the robot was when it was taken."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from robot_agent.motion.surfaces import smoothed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.hardware import LidarSamples
    from robot_agent.localization.localizer import Localizer

_PENDING_MAX: Final = 64
"""Batches that may wait for the next call of `seen_from`: more than arrive while samples are remembered."""


class _Batch(NamedTuple):
    """Points (n, 2; m, frame `odom`) and their times (n; s)."""

    points: NDArray[np.float64]
    times: NDArray[np.float64]


class NearPoints:
    """The returns of the last `memory` s within `reach` m of the lidar, be their scan whole or not."""

    def __init__(self, lidar: LocalizationConfig, reach: float, memory: float) -> None:
        self._lidar = lidar
        self._reach = reach
        self._memory = memory
        self._pending: deque[LidarSamples] = deque(maxlen=_PENDING_MAX)
        self._batches: deque[_Batch] = deque()

    def add(self, samples: LidarSamples) -> None:
        """Add the newest samples."""
        self._pending.append(samples)

    def seen_from(self, localizer: Localizer, now: float) -> NDArray[np.float64]:
        """Return the points (n, 2; m) in `base` as the robot is now, without those older than `memory`.

        The odometry alone connects the times: a correction of the pose in `map` moves no point.
        """
        body = localizer.odom_at(now)
        if body is None:
            return np.zeros((0, 2))
        while self._pending:
            samples = self._pending.popleft()
            if samples.ended_at >= now - self._memory:  # else it came while nobody asked
                self._place(samples, localizer)
        while self._batches and self._batches[0].times[-1] < now - self._memory:
            self._batches.popleft()
        if not self._batches:
            return np.zeros((0, 2))
        return body.inverse_transform(np.concatenate([batch.points for batch in self._batches]))

    def _place(self, samples: LidarSamples, localizer: Localizer) -> None:
        """Move a batch into `odom`, each sample by the odometry at its own time."""
        near = (samples.ranges_m <= self._reach).nonzero()[0]  # False for nan
        if not len(near):
            return
        ranges = samples.ranges_m[near].astype(np.float64)
        angles = samples.angles_rad[near].astype(np.float64) + self._lidar.lidar_yaw
        period = (samples.ended_at - samples.started_at) / max(len(samples.ranges_m) - 1, 1)
        times = samples.started_at + np.float64(period) * near
        x, y, theta = localizer.odom_poses(times)
        cos, sin = np.cos(theta), np.sin(theta)
        base_x = self._lidar.lidar_x + ranges * np.cos(angles)
        base_y = self._lidar.lidar_y + ranges * np.sin(angles)
        points = np.column_stack((x + cos * base_x - sin * base_y, y + sin * base_x + cos * base_y))
        self._batches.append(_Batch(smoothed(points), times))
