"""Scans without their skew, of the entries of an input log: read from a file, or live.

A lidar that turns five times a second turns by 15 degrees while its robot turns once in five seconds. The entries have
the time of each sample and the wheels' counters, so the agent's own odometry moves every sample to the scan's end.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from robot_agent.agent.recording.input_log import BaseReceived, ScanReceived, Started
from robot_agent.localization.odometry import EncoderFault, Odometry, OdometryBuffer
from robot_agent.localization.scans import deskew

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import AgentConfig
    from robot_agent.localization.pose import Pose2


class RobotScan(NamedTuple):
    """A scan at its end: stamp (s), the odometry's pose then, and returns by angle (rad) in the frame of the robot.

    stretch: how many breaks of the odometry lie before it. Nobody knows how the robot moved during one.
    """

    stamp: float
    odom: Pose2
    angles: NDArray[np.float64]
    ranges: NDArray[np.float64]
    stretch: int = 0


_PAUSE_S: Final = 1.0
_STOOD_M: Final = 0.02
"""Wheels that were silent for longer than that, and have turned by more than this since, drove who knows what way."""


class LogScans:
    """Entries in, scans out."""

    def __init__(self) -> None:
        self.config: AgentConfig | None = None
        """The robot's configuration, from its first entry on."""
        self._odometry: Odometry | None = None
        self._poses = OdometryBuffer()
        self._counted_at = math.inf
        """When (s) the wheels were counted last; inf: not yet."""
        self._stretch = 0

    def take(self, entry: Any) -> RobotScan | None:  # noqa: ANN401  # of any kind
        """Take an entry in; return the scan that it completes, None for any other.

        An agent that was started anew goes on where the one before it ended: the wheels' counters have not.
        """
        match entry:
            case Started():
                if self.config is None or self.config.drive_train != entry.config.drive_train:
                    self._stretch += self.config is not None
                    self._odometry = Odometry(entry.config.drive_train)
                    self._poses = OdometryBuffer()
                    self._counted_at = math.inf
                self.config = entry.config
            case BaseReceived() if self._odometry is not None:
                self._on_wheels(entry, self._odometry)
            case ScanReceived() if self.config is not None:
                return self._scan(entry)
        return None

    def _on_wheels(self, entry: BaseReceived, odometry: Odometry) -> None:
        motion = odometry.update(entry.feedback.odometry, entry.now)
        if isinstance(motion, EncoderFault):
            return
        silent = entry.now - self._counted_at > _PAUSE_S
        if motion.skipped is not None or (silent and max(abs(motion.left_m), abs(motion.right_m)) > _STOOD_M):
            self._stretch += 1
            self._poses = OdometryBuffer()  # between the last pose and this one there is none
        self._counted_at = entry.now
        self._poses.add(entry.now, motion.x, motion.y, motion.theta)

    def _scan(self, entry: ScanReceived) -> RobotScan | None:
        assert self.config is not None
        scan = deskew(entry.scan(), self._poses, self.config.localization)
        if scan is None:
            return None
        angles = np.arctan2(scan.points[:, 1], scan.points[:, 0])
        order = np.argsort(angles, kind="stable")
        return RobotScan(scan.timestamp, scan.odom, angles[order], np.hypot(*scan.points[order].T), self._stretch)
