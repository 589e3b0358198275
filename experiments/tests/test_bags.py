"""Recordings of ROS 2, written here by rosbags and read as logs; damaged ones are refused in words."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from fognav.output import WrongUseError
from fognav_experiments.lidar_logs.logs import read_log
from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from pathlib import Path

STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
BEAMS = 8
LIDAR = Pose2(0.2, 0.0, math.pi / 2)
MAP = Pose2(5.0, -1.0, math.pi)
"""Of the odometry's frame."""


def message(name: str, **fields: Any) -> Any:
    return TYPES[name](**fields)


def header(at: float, frame: str) -> Any:
    stamp = message("builtin_interfaces/msg/Time", sec=int(at), nanosec=round(at % 1.0 * 1e9))
    return message("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def turned(theta: float, *, upside_down: bool = False) -> Any:
    half, name = theta / 2.0, "geometry_msgs/msg/Quaternion"
    if upside_down:  # half a turn about the lidar's own x axis
        return message(name, x=math.cos(half), y=math.sin(half), z=0.0, w=0.0)
    return message(name, x=0.0, y=0.0, z=math.sin(half), w=math.cos(half))


def odometry(at: float, pose: Pose2) -> Any:
    place = message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=pose.x, y=pose.y, z=0.0),
        orientation=turned(pose.theta),
    )
    zero = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = message("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    nothing = np.zeros(36)
    return message(
        "nav_msgs/msg/Odometry",
        header=header(at, "odom"),
        child_frame_id="base_link",
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=nothing),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=nothing),
    )


def transform(at: float, parent: str, child: str, pose: Pose2, *, upside_down: bool = False) -> Any:
    moved = message("geometry_msgs/msg/Vector3", x=pose.x, y=pose.y, z=0.3)
    rotation = turned(pose.theta, upside_down=upside_down)
    change = message("geometry_msgs/msg/Transform", translation=moved, rotation=rotation)
    stamped = message(
        "geometry_msgs/msg/TransformStamped", header=header(at, parent), child_frame_id=child, transform=change
    )
    return message("tf2_msgs/msg/TFMessage", transforms=[stamped])


def scan(at: float, ranges: list[float]) -> Any:
    return message(
        "sensor_msgs/msg/LaserScan",
        header=header(at, "laser"),
        angle_min=-1.0,
        angle_max=1.0,
        angle_increment=2.0 / (BEAMS - 1),
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.15,
        range_max=12.0,
        ranges=np.array(ranges, dtype=np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


Recorded = list[tuple[str, float, Any]]


def drive(*, upside_down: bool = False) -> Recorded:
    """Half a metre straight ahead in one second: odometry 10 times a second, scans between these."""
    found: Recorded = [
        ("/tf_static", 100.0, transform(100.0, "base_link", "laser", LIDAR, upside_down=upside_down)),
        ("/tf", 100.0, transform(100.0, "map", "odom", MAP)),
    ]
    for step in range(11):
        found.append(("/odom", 100.0 + 0.1 * step, odometry(100.0 + 0.1 * step, Pose2(0.05 * step, 0.0, 0.0))))
    for step in range(10):
        at = 100.05 + 0.1 * step
        found.append(("/scan", at, scan(at, [0.1, math.inf, math.nan, 2.0, 3.0 + 0.1 * step, 4.0, 5.0, 13.0])))
    return found


def record(folder: Path, recorded: Recorded, storage: StoragePlugin = StoragePlugin.MCAP) -> Path:
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        connections = {}
        for topic, at, each in recorded:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, each.__msgtype__, typestore=STORE)
            data = STORE.serialize_cdr(each, each.__msgtype__)
            writer.write(connections[topic], round(at * 1e9), data)
    return folder


@pytest.mark.parametrize("storage", StoragePlugin)
def test_scans_have_the_lidars_pose_by_odometry_at_their_time_and_its_reference(
    tmp_path: Path, storage: StoragePlugin
) -> None:
    log = read_log(record(tmp_path / "bag", drive(), storage))
    assert [each.stamp for each in log.scans] == pytest.approx([0.1 * step for step in range(10)])
    for step, each in enumerate(log.scans):
        lidar = Pose2(0.025 + 0.05 * step, 0.0, 0.0).compose(LIDAR)
        assert tuple(each.odom) == pytest.approx(tuple(lidar))
        assert each.reference is not None
        assert tuple(each.reference) == pytest.approx(tuple(MAP.compose(lidar)))
        assert each.angles == pytest.approx(np.linspace(-1.0, 1.0, BEAMS))
        assert np.isnan(each.ranges).tolist() == [True, True, True, False, False, False, False, True]
        assert each.ranges[4] == pytest.approx(3.0 + 0.1 * step)


def test_lidar_that_hangs_upside_down_turns_the_other_way(tmp_path: Path) -> None:
    log = read_log(record(tmp_path / "bag", drive(upside_down=True)))
    assert log.scans[0].angles == pytest.approx(-np.linspace(-1.0, 1.0, BEAMS))


def test_file_of_a_recording_stands_for_its_folder(tmp_path: Path) -> None:
    (file,) = record(tmp_path / "bag", drive()).glob("*.mcap")
    assert len(read_log(file).scans) == 10


def test_recording_without_scans_or_odometry_is_refused_by_the_missing_type(tmp_path: Path) -> None:
    for missing, name in (("/scan", "LaserScan"), ("/odom", "Odometry")):
        bag = record(tmp_path / name, [each for each in drive() if each[0] != missing])
        with pytest.raises(WrongUseError, match=f"has no topic of type .*{name}: the robot's {name} must be recorded"):
            read_log(bag)


def test_of_several_lidars_the_usual_topic_is_taken_and_else_none(tmp_path: Path) -> None:
    rear = [("/rear", at, each) for topic, at, each in drive() if topic == "/scan"]
    assert len(read_log(record(tmp_path / "both", drive() + rear)).scans) == 10
    front = [("/front" if topic == "/scan" else topic, at, each) for topic, at, each in drive()]
    with pytest.raises(WrongUseError, match=r"several topics of type .*LaserScan \(/front, /rear\)"):
        read_log(record(tmp_path / "neither", front + rear))


@pytest.mark.parametrize("wrong", ["/odom", "/scan", "/tf_static"])
def test_recording_with_values_that_are_no_numbers_is_refused_in_words(tmp_path: Path, wrong: str) -> None:
    instead = {
        "/odom": odometry(100.5, Pose2(math.nan, 0.0, 0.0)),
        "/scan": replace(scan(100.55, [1.0] * BEAMS), angle_increment=math.nan),
        "/tf_static": transform(100.0, "base_link", "laser", Pose2(0.0, math.inf, 0.0)),
    }
    with pytest.raises(WrongUseError, match=r"bag is damaged: .* not finite"):
        read_log(record(tmp_path / "bag", [*drive(), (wrong, 100.6, instead[wrong])]))


@pytest.mark.parametrize("storage", StoragePlugin)
def test_damaged_recording_is_refused_in_words(tmp_path: Path, storage: StoragePlugin) -> None:
    whole = record(tmp_path / "whole", drive(), storage)
    (file,) = (each for each in whole.iterdir() if each.name != "metadata.yaml")
    for number, damage in enumerate(("cut", "overwritten", "gone", "metadata cut", "metadata gone")):
        bag = tmp_path / f"damaged-{number}"
        shutil.copytree(whole, bag)
        data, metadata = bag / file.name, bag / "metadata.yaml"
        if damage == "cut":
            data.write_bytes(data.read_bytes()[: data.stat().st_size // 3])
        elif damage == "overwritten":
            data.write_bytes(b"\0" * data.stat().st_size)
        elif damage == "gone":
            data.unlink()
        elif damage == "metadata cut":
            metadata.write_text(metadata.read_text()[:40])
        else:
            metadata.unlink()
        with pytest.raises(WrongUseError, match=r"Record it again, or name a folder with a whole metadata\.yaml"):
            read_log(bag)
