"""What the lidar saw near the robot during the last moments, each sample from where the robot was when it was taken."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels.scans import Mounting, Placed, placed
from fog_kernels.sweep import half_planes
from robot_agent.motion.recent_scans import smoothed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.scans import Track
    from robot_agent.config import LocalizationConfig
    from robot_agent.footprint import Footprint
    from robot_agent.hardware import LidarSamples
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2

_PENDING_MAX: Final = 64
"""Batches that may wait for the next call of `seen_from`: more than arrive while samples are remembered."""
_RING_M: Final = 0.02
"""So near to its shortest range a lidar does not see everything in each turn."""
_INSIDE_M: Final = 0.01
"""What is deeper in the body is no obstacle, but an error of the odometry or the robot itself."""
_CELL_M: Final = 0.01
"""One of the points that are kept is enough in each square of this size."""
_BESIDE_M: Final = 0.005
_BEHIND_M: Final = 0.05
_BEAMS: Final = 2
"""A point is not there any more if so many beams of one batch pass it within the one distance, and end farther away by
more than the other: less is the noise of an edge."""
_NONE: Final = np.zeros((0, 2))


class NearPoints:
    """The returns of the last `memory` s within `reach` m of the lidar, be their scan whole or not.

    What came so near to a lidar at the body's rim that it can't be measured any more stays until the robot has moved
    away from it, and until the lidar measures something farther away in its place.
    """

    def __init__(self, lidar: LocalizationConfig, reach: float, memory: float, footprint: Footprint) -> None:
        self._mounting = Mounting(lidar.lidar_x, lidar.lidar_y, lidar.lidar_yaw)
        self._reach = reach
        self._memory = memory
        self._pending: deque[LidarSamples] = deque(maxlen=_PENDING_MAX)
        self._batches: deque[Placed] = deque()
        blind = -footprint.outside_by(lidar.lidar_x, lidar.lidar_y) < lidar.range_min
        self._ring = lidar.range_min + _RING_M if blind else 0.0
        """Radius (m) around the lidar in which it does not see everything; 0 if all of that is the body itself."""
        self._body = half_planes(footprint.polygon)
        self._unseen = _NONE
        """The points in the ring (n, 2; m, frame `odom`) that were seen before they came there."""

    def add(self, samples: LidarSamples) -> None:
        """Add the newest samples."""
        self._pending.append(samples)

    def seen_from(self, localizer: Localizer, now: float) -> NDArray[np.float64]:
        """Return the points (n, 2; m) in `base` as the robot is now, without those older than `memory`.

        The odometry alone connects the times: a correction of the pose in `map` moves no point.
        """
        body = localizer.odom_at(now)
        if body is None:
            return _NONE
        while self._pending:
            samples = self._pending.popleft()
            if samples.ended_at >= now - self._memory:  # else it came while nobody asked
                self._place(samples, localizer)
        expired = []
        while self._batches and self._batches[0].times[-1] < now - self._memory:
            expired.append(self._batches.popleft().points)
        if self._ring > 0.0:
            self._keep_unseen(expired, body, now)
        if not self._batches and not len(self._unseen):
            return _NONE
        return body.inverse_transform(np.concatenate([self._unseen, *(batch.points for batch in self._batches)]))

    def _keep_unseen(self, expired: list[NDArray[np.float64]], body: Pose2, now: float) -> None:
        """Keep those of the points that the lidar could not see again; what has left the ring is to be seen again."""
        points, known = np.concatenate([self._unseen, *expired]), len(self._unseen)
        if not len(points):
            return
        at = body.inverse_transform(points)
        near = np.hypot(at[:, 0] - self._mounting.x, at[:, 1] - self._mounting.y) <= self._ring
        if not near[:known].all():
            left = self._unseen[~near[:known]]
            self._batches.append(Placed(left, np.full(len(left), now)))
        near &= (at @ self._body.normals.T - self._body.offsets).max(axis=1) >= -_INSIDE_M
        kept = points[near]
        _, first = np.unique(np.floor(kept / _CELL_M), axis=0, return_index=True)
        self._unseen = kept[np.sort(first)]

    def _look_through(self, samples: LidarSamples, track: Track) -> None:
        """Forget the unseen points that beams pass."""
        times = samples.started_at, samples.ended_at
        lengths = np.zeros_like(samples.ranges_m), np.ones_like(samples.ranges_m)
        heads, ahead = (
            placed(samples.angles_rad, length, *times, track, self._mounting, 0.0, 1.0).points for length in lengths
        )
        offset = self._unseen[:, None] - heads
        beam = ahead - heads
        along = (offset * beam).sum(axis=2)
        beside = np.abs(offset[..., 0] * beam[:, 1] - offset[..., 1] * beam[:, 0])
        passed = (along > 0.0) & (beside <= _BESIDE_M) & (samples.ranges_m > along + _BEHIND_M)
        self._unseen = self._unseen[passed.sum(axis=1) < _BEAMS]

    def _place(self, samples: LidarSamples, localizer: Localizer) -> None:
        """Move a batch into `odom`, each sample by the odometry at its own time."""
        track = localizer.odom_track(samples.started_at)
        if len(self._unseen):
            self._look_through(samples, track)
        seen = placed(
            samples.angles_rad,
            samples.ranges_m,
            samples.started_at,
            samples.ended_at,
            track,
            self._mounting,
            -math.inf,
            self._reach,
        )
        if len(seen.times):
            self._batches.append(Placed(smoothed(seen.points), seen.times))
