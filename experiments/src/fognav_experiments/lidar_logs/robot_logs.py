"""Logs of Fognav's own robots: what an agent wrote with `FOGNAV_INPUT_LOG`, as scans without their skew.

A lidar that turns five times a second turns by 15 degrees while its robot turns once in five seconds. The log has the
time of each sample and the wheels' counters, so the agent's own odometry moves every sample to the scan's end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from fog_runtime.record import RecordError, read_entries
from fognav.output import WrongUseError
from robot_agent.agent.recording.input_log import ENTRY_OF_TOPIC, BaseReceived, ScanReceived, Started
from robot_agent.localization.odometry import EncoderFault, Odometry, OdometryBuffer
from robot_agent.localization.scans import deskew

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from robot_agent.localization.pose import Pose2


class RobotScan(NamedTuple):
    """A scan at its end: stamp (s), the odometry's pose then, and returns by angle (rad) in the frame of the robot."""

    stamp: float
    odom: Pose2
    angles: NDArray[np.float64]
    ranges: NDArray[np.float64]


def is_robot_log(path: Path) -> bool:
    """Whether a file may be a log of Fognav: a recording without the description that ROS 2 puts beside its own."""
    return path.suffix == ".mcap" and path.is_file() and not (path.parent / "metadata.yaml").exists()


def read_robot_log(path: Path) -> Iterator[RobotScan]:
    """Yield the scans of an agent's log; raises `WrongUseError` where it is none or damaged."""
    config, odometry, poses = None, None, OdometryBuffer()
    try:
        for _, topic, data in read_entries(path):
            kind = ENTRY_OF_TOPIC.get(topic)
            if kind is Started:
                config = msgspec.json.decode(data, type=Started).config
                odometry, poses = Odometry(config.drive_train), OdometryBuffer()
            elif config is None or odometry is None:
                continue
            elif kind is BaseReceived:
                received = msgspec.json.decode(data, type=BaseReceived)
                motion = odometry.update(received.feedback.odometry, received.now)
                if not isinstance(motion, EncoderFault):
                    poses.add(received.now, motion.x, motion.y, motion.theta)
            elif kind is ScanReceived:
                scan = deskew(msgspec.json.decode(data, type=ScanReceived).scan(), poses, config.localization)
                if scan is not None:
                    angles = np.arctan2(scan.points[:, 1], scan.points[:, 0])
                    order = np.argsort(angles, kind="stable")
                    yield RobotScan(scan.timestamp, scan.odom, angles[order], np.hypot(*scan.points[order].T))
    except (RecordError, msgspec.DecodeError) as error:
        raise WrongUseError(f"{path}: {error}. Name the file that an agent wrote with FOGNAV_INPUT_LOG") from error
