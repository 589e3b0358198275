"""What the lidar saw near the robot during the last moments, each sample from where the robot was when it was taken."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels.scans import Mounting, Placed, placed
from robot_agent.motion.surfaces import smoothed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.hardware import LidarSamples
    from robot_agent.localization.localizer import Localizer

_PENDING_MAX: Final = 64
"""Batches that may wait for the next call of `seen_from`: more than arrive while samples are remembered."""


class NearPoints:
    """The returns of the last `memory` s within `reach` m of the lidar, be their scan whole or not."""

    def __init__(self, lidar: LocalizationConfig, reach: float, memory: float) -> None:
        self._mounting = Mounting(lidar.lidar_x, lidar.lidar_y, lidar.lidar_yaw)
        self._reach = reach
        self._memory = memory
        self._pending: deque[LidarSamples] = deque(maxlen=_PENDING_MAX)
        self._batches: deque[Placed] = deque()

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
        seen = placed(
            samples.angles_rad,
            samples.ranges_m,
            samples.started_at,
            samples.ended_at,
            localizer.odom_track(samples.started_at),
            self._mounting,
            -math.inf,
            self._reach,
        )
        if len(seen.times):
            self._batches.append(Placed(smoothed(seen.points), seen.times))
