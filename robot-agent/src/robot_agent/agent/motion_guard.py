"""The last limit of every wheel command: the stop field over what the lidar has just seen, and what it did not see.

`NearPoints` is what the lidar saw near the robot during the last moments, each sample from where the robot was when it
was taken; `LidarView` what the newest whole scan covers, against what the map leads to expect from there.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import LETHAL
from fog_contracts.messages import Reason, ReasonCode
from fog_kernels.raycast import cast
from fog_kernels.scans import Mounting, Placed, placed
from fog_kernels.sweep import half_planes
from robot_agent.footprint import SECTORS
from robot_agent.localization.scans import smoothed
from robot_agent.safety.stop_field import SECTOR_ANGLES, StopField, Visibility

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from fog_contracts.replica import Replica
    from fog_kernels.scans import Track
    from robot_agent.config import AgentConfig, LocalizationConfig, VisibilityConfig
    from robot_agent.footprint import Footprint
    from robot_agent.hardware import LaserScan, LidarSamples
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.stop_field import Wheels

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
        looked = scan.unmasked()
        angles = np.asarray(looked.angles_rad, np.float64) + self._lidar.lidar_yaw
        self.visibility.update(angles, np.isfinite(looked.ranges_m), self._expected(pose, replica))

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


class MotionGuard:
    """Limits the wheel speeds of whoever commands, mission or operator, by what the lidar sees."""

    def __init__(self, config: AgentConfig, localizer: Localizer) -> None:
        self._localizer = localizer
        self._drive = config.drive_train
        self._view = LidarView(config.localization, config.visibility)
        self._field = StopField(config.footprint, config.drive_train, config.stop_field)
        lidar = config.localization
        # A point may come nearer while it is remembered, and the lidar need not be in the middle.
        reach = self._field.reach + abs(lidar.lidar_x) + abs(lidar.lidar_y)
        reach += config.stop_field.memory * config.drive_train.wheel_speed_max_m_s
        self._points = NearPoints(lidar, reach, config.stop_field.memory, config.footprint)
        self.reason: Reason | None = None
        """Why the last command is zero although another one was requested; else None."""

    def on_samples(self, samples: LidarSamples) -> None:
        """Handle the lidar's newest samples."""
        self._points.add(samples)

    def on_scan(self, scan: LaserScan, replica: Replica) -> None:
        """Handle a whole scan, after the localizer has."""
        self._view.on_scan(scan, self._localizer.scan_pose(), replica)

    def limit(self, wheels: Wheels, now: float) -> Wheels:
        """Return the wheel speeds (m/s) that may be commanded at `now` (s, monotonic) instead of these."""
        if wheels == (0.0, 0.0):
            # Nothing to limit; the points wait until they are needed.
            self.reason = None
            return wheels
        points = self._points.seen_from(self._localizer, now)
        seen = self._field.limit(wheels, points)
        unseen = self._view.visibility.limit(seen.wheels, self._drive.twist(*seen.wheels))
        self.reason = seen.reason or unseen.reason
        if unseen.wheels == seen.wheels:
            return seen.wheels
        # Of an arc, sight may leave only the turn, and a body that is not round needs room for it.
        left = self._field.limit(unseen.wheels, points)
        self.reason = self.reason or left.reason
        return left.wheels

    def blindness(self, wheels: Wheels) -> Reason | None:
        """Return why the robot would not move at these wheel speeds (m/s), as it sees too little there; else None."""
        return self._view.visibility.limit(wheels, self._drive.twist(*wheels)).reason

    def hazard(
        self, wheels: Wheels, keep: Callable[[NDArray[np.float64]], NDArray[np.float64]], now: float
    ) -> Reason | None:
        """Return why a robot that nobody slows down must not go on at these wheel speeds (m/s); None when it may.

        keep: returns those of the points (n, 2; m) in `base` that count.
        """
        points = keep(self._points.seen_from(self._localizer, now))
        if self._field.limit(wheels, points).zone != "free":
            return Reason(ReasonCode.OBSTACLE_NEAR, "the lidar sees an obstacle near the robot's way")
        if self._view.visibility.limit(wheels, self._drive.twist(*wheels)).zone == "free":
            return None
        return Reason(ReasonCode.LIDAR_BLIND, "the lidar does not see enough of the robot's way")
