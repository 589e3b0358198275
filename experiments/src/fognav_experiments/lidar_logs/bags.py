"""Recordings of ROS 2 (rosbag2), read by the package rosbags: a planar lidar's scans, each with odometry at its time.

Where the lidar is on the base is taken from the recording's transforms (`/tf_static`). What they say of the odometry's
frame in the frame `map` (`/tf`, by a localization or mapping that ran beside it) gives reference poses.
"""

from __future__ import annotations

import bisect
import itertools
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fognav.output import WrongUseError
from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

SCAN: Final = "sensor_msgs/msg/LaserScan"
ODOMETRY: Final = "nav_msgs/msg/Odometry"
TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
_MAP: Final = "map"
_USUAL: Final = {SCAN: "/scan", ODOMETRY: "/odom"}
_WAIT_S: Final = 0.5
"""A scan farther than this from any odometry has none."""
_DAMAGED: Final = "Record it again, or name a folder with a whole metadata.yaml and its files (.mcap or .db3)"


class BagScan(NamedTuple):
    """A scan: stamp (s), angles (rad) in the lidar's frame, ranges (m or nan); poses of the lidar (m, rad).

    `odom` is by odometry; `reference`, in the frame `map`, is None where the recording has none.
    """

    stamp: float
    odom: Pose2
    reference: Pose2 | None
    angles: NDArray[np.float64]
    ranges: NDArray[np.float64]


class _Mounting(NamedTuple):
    """Where a lidar is on its base, and whether it hangs upside down."""

    pose: Pose2 = Pose2(0.0, 0.0, 0.0)
    upside_down: bool = False


def is_bag(path: Path) -> bool:
    """Whether a path looks like a recording of ROS 2: a folder, or one of the files in it."""
    return path.is_dir() or path.suffix in {".mcap", ".db3"}


def read_bag(path: Path) -> list[BagScan]:
    """Read a recording's scans; raises `WrongUseError` for one that is damaged, or has no scan or odometry."""
    try:
        from rosbags.highlevel import AnyReader  # noqa: PLC0415  # an optional dependency
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415  # same
    except ImportError as error:
        raise WrongUseError(
            f"{path}: recordings of ROS 2 are read by the package rosbags, which is not installed: pip install rosbags"
        ) from error
    folder = path if path.is_dir() else path.parent
    if not (folder / "metadata.yaml").is_file():
        raise WrongUseError(f"{path}: there is no metadata.yaml in {folder}. {_DAMAGED}")
    messages: dict[str, list[tuple[float, Any]]] = {SCAN: [], ODOMETRY: [], TRANSFORMS: []}
    topics: dict[str, set[str]] = {SCAN: set(), ODOMETRY: set(), TRANSFORMS: set()}
    try:
        with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            for connection in reader.connections:
                topics.get(connection.msgtype, set()).add(connection.topic)
            chosen = {kind: _topic(path, kind, topics[kind]) for kind in _USUAL}
            wanted = [
                connection
                for connection in reader.connections
                if connection.topic == chosen.get(connection.msgtype) or connection.msgtype == TRANSFORMS
            ]
            for connection, _, data in reader.messages(connections=wanted):
                message: Any = reader.deserialize(data, connection.msgtype)
                messages[connection.msgtype].append((_stamp(message), message))
    except WrongUseError:
        raise
    except Exception as error:  # the libraries of each storage and compression raise their own
        raise WrongUseError(f"{path} is damaged: {type(error).__name__}: {error}. {_DAMAGED}") from error
    return _scans(path, messages)


def _topic(path: Path, kind: str, topics: set[str]) -> str:
    name = kind.rpartition("/")[2]
    if not topics:
        raise WrongUseError(f"{path} has no topic of type {kind}: the robot's {name} must be recorded")
    if len(topics) > 1 and _USUAL[kind] not in topics:
        raise WrongUseError(
            f"{path} has several topics of type {kind} ({', '.join(sorted(topics))}), and none is {_USUAL[kind]}: "
            "record or convert one of them"
        )
    return _USUAL[kind] if _USUAL[kind] in topics else next(iter(topics))


def _scans(path: Path, messages: Mapping[str, list[tuple[float, Any]]]) -> list[BagScan]:
    odometry = sorted(messages[ODOMETRY], key=lambda each: each[0])
    if not odometry:
        raise WrongUseError(f"{path} has no odometry. {_DAMAGED}")
    stamps = np.array([stamp for stamp, _ in odometry])
    poses = [_planar(message.pose.pose) for _, message in odometry]
    _check(path, "a pose of the odometry", itertools.chain.from_iterable(poses))
    for _, message in messages[TRANSFORMS]:
        for transform in message.transforms:
            moved, turned = transform.transform.translation, transform.transform.rotation
            values = (moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w)
            _check(path, f"the transform to {transform.child_frame_id}", values)
    parents = {
        transform.child_frame_id.lstrip("/"): (transform.header.frame_id.lstrip("/"), transform.transform)
        for _, message in messages[TRANSFORMS]
        for transform in message.transforms
    }
    base, frame = odometry[0][1].child_frame_id.lstrip("/"), odometry[0][1].header.frame_id.lstrip("/")
    corrections = sorted(
        (
            (_stamp(transform), _mounted(_matrix(transform.transform)).pose)
            for _, message in messages[TRANSFORMS]
            for transform in message.transforms
            if (transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")) == (_MAP, frame)
        ),
        key=lambda each: each[0],
    )
    found: list[BagScan] = []
    for stamp, message in sorted(messages[SCAN], key=lambda each: each[0]):
        pose = _at(stamps, poses, stamp)
        if pose is None:
            continue
        mounting = _mounting(parents, message.header.frame_id.lstrip("/"), base)
        ranges = np.asarray(message.ranges, dtype=np.float64)
        valid = np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max)
        angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
        lidar = pose.compose(mounting.pose)
        _check(path, f"an angle of the scan at {stamp:.3f} s", angles)
        earlier = bisect.bisect_right(corrections, stamp + _WAIT_S, key=lambda each: each[0])
        found.append(
            BagScan(
                stamp,
                lidar,
                corrections[earlier - 1][1].compose(lidar) if earlier else None,
                -angles if mounting.upside_down else angles,
                np.where(valid, ranges, math.nan),
            )
        )
    if not found:
        raise WrongUseError(f"{path} has no scan within {_WAIT_S} s of an odometry message")
    return found


def _at(stamps: NDArray[np.float64], poses: list[Pose2], stamp: float) -> Pose2 | None:
    """Return the pose at a time, between the two messages around it; None if these are too far away."""
    after = int(np.searchsorted(stamps, stamp))
    near = [index for index in (after - 1, after) if 0 <= index < len(poses) and abs(stamps[index] - stamp) <= _WAIT_S]
    if len(near) < 2 or stamps[near[1]] <= stamps[near[0]]:
        return poses[near[0]] if near else None
    first, second = near
    share = float((stamp - stamps[first]) / (stamps[second] - stamps[first]))
    step = poses[second].relative_to(poses[first])
    return poses[first].compose(Pose2(share * step.x, share * step.y, share * step.theta))


def _mounting(parents: Mapping[str, tuple[str, Any]], frame: str, base: str) -> _Mounting:
    """Return where a frame is on the base, by the transforms between them; where they do not lead to it, its middle."""
    chain: list[Any] = []
    known = {frame}
    while frame != base:
        if frame not in parents:
            return _Mounting()
        frame, transform = parents[frame]
        if frame in known:
            return _Mounting()
        known.add(frame)
        chain.append(transform)
    matrix = np.eye(4)
    for transform in reversed(chain):
        matrix = matrix @ _matrix(transform)
    return _mounted(matrix)


def _mounted(matrix: NDArray[np.float64]) -> _Mounting:
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    return _Mounting(Pose2(float(matrix[0, 3]), float(matrix[1, 3]), heading), bool(matrix[2, 2] < 0.0))


def _matrix(transform: Any) -> NDArray[np.float64]:  # noqa: ANN401  # a type that rosbags makes of the recording
    x, y, z, w = (getattr(transform.rotation, name) for name in "xyzw")
    moved = transform.translation
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), moved.x],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), moved.y],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), moved.z],
        [0.0, 0.0, 0.0, 1.0],
    ])  # fmt: skip


def _planar(pose: Any) -> Pose2:  # noqa: ANN401  # same
    turned = pose.orientation
    heading = math.atan2(
        2.0 * (turned.w * turned.z + turned.x * turned.y), 1.0 - 2.0 * (turned.y * turned.y + turned.z * turned.z)
    )
    return Pose2(float(pose.position.x), float(pose.position.y), heading)


def _check(path: Path, what: str, values: Iterable[float]) -> None:
    if not all(map(math.isfinite, values)):
        raise WrongUseError(f"{path} is damaged: {what} is not finite. {_DAMAGED}")


def _stamp(message: Any) -> float:  # noqa: ANN401  # same
    header = getattr(message, "header", None)
    return 0.0 if header is None else float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)
