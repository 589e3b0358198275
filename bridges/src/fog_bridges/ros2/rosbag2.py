"""Writes a recording as a rosbag2: `python -m fog_bridges.ros2.rosbag2 RECORDING FOLDER` (`fognav rosbag`).

Its messages are those that the bridge sends. The costmap is not among them: a recording has changes of it alone.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError

from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.wire import TYPES
from fog_contracts.messages import HazardArea, RobotObstacles, RobotPath, RobotPose, RobotState
from fog_runtime.record import RecordError, read

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rosbags.interfaces import Connection

    from fog_bridges.ros2.wire import RosMessage
    from fog_contracts.messages import Message

_VERSION: Final = 9
"""Of rosbag2's format: Jazzy and later."""


def convert(recording: Path, folder: Path) -> dict[str, int]:
    """Write a rosbag2 (MCAP) into a new folder; return how many messages each of its topics has.

    Raises `RecordError`, `OSError`, and `WriterError` for a folder that is there already.
    """
    counts: Counter[str] = Counter()
    connections: dict[str, Connection] = {}
    hazards: dict[str, HazardArea] = {}
    with Writer(folder, version=_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        for time_ns, _, ids, told in read(recording):
            for topic, kind, message in _told(ids, told, hazards, time_ns / 1e9):
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, kind, typestore=TYPES)
                bag.write(connections[topic], time_ns, bytes(TYPES.serialize_cdr(message, kind)))
                counts[topic] += 1
    return dict(sorted(counts.items()))


def _told(
    ids: Mapping[str, str], told: Message | str, hazards: dict[str, HazardArea], stamp: float
) -> Iterator[tuple[str, str, RosMessage]]:
    """Yield the topics, types and messages that tell what was told at a time (s since 1970)."""
    if isinstance(told, HazardArea):
        hazards[ids["area"]] = told
        yield "/fognav/hazards", "visualization_msgs/msg/MarkerArray", ros.markers(hazards, [], None, stamp)
        return
    if "robot" not in ids:
        return
    robot = ros.ros_name(ids["robot"])
    if isinstance(told, RobotPose):
        base = ros.transform(told.x, told.y, told.theta, f"{robot}/base_footprint", told.stamp)
        yield "/tf", "tf2_msgs/msg/TFMessage", base
        yield f"/{robot}/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", ros.robot_pose(told)
    elif isinstance(told, RobotPath):
        yield f"/{robot}/plan", "nav_msgs/msg/Path", ros.path(told, stamp)
    elif isinstance(told, RobotState):
        yield f"/{robot}/battery_state", "sensor_msgs/msg/BatteryState", ros.battery(told, stamp)
    elif isinstance(told, RobotObstacles) and told.view is not None:
        view = told.view
        yield "/tf", "tf2_msgs/msg/TFMessage", ros.transform(view.x, view.y, 0.0, f"{robot}/view", told.stamp)
        yield f"/{robot}/scan", "sensor_msgs/msg/LaserScan", ros.scan(view, ids["robot"], told.stamp)


if __name__ == "__main__":
    try:
        found = convert(Path(sys.argv[1]), Path(sys.argv[2]))
    except WriterError as problem:
        sys.exit(f"{problem} Name a new folder")
    except (RecordError, OSError) as problem:
        sys.exit(str(problem))
    sys.stdout.write(msgspec.json.encode(found).decode() + "\n")
