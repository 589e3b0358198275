"""How rmw_zenoh puts topics and their messages on zenoh: keys, tokens of presence, attachments and payloads. Pure.

Source: the design document of ros2/rmw_zenoh, for Jazzy from 0.2.4 on, Kilted and later. A topic's key ends with the
hash of its type (REP 2016): who was built with another definition of the message has another key, and hears nothing.
"""

from __future__ import annotations

import itertools
import struct
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np
import xxhash
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

RosMessage = Any
"""A message: rosbags makes the classes at run time, from the definitions."""
_DEFINITIONS: Final = {
    "nav2_msgs/msg/CostmapFilterInfo": (
        "std_msgs/Header header\nuint8 type\nstring filter_mask_topic\nfloat32 base\nfloat32 multiplier\n"
    ),
    "rmf_obstacle_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "rmf_obstacle_msgs/msg/Obstacle": (
        "std_msgs/Header header\nint32 id\nstring source\nstring level_name\nstring classification\n"
        "BoundingBox3D bbox\nfloat64 data_resolution\nint8[] data\nbuiltin_interfaces/Duration lifetime\nint32 action\n"
        "int32 ACTION_ADD=1\nint32 ACTION_DELETE=2\nint32 ACTION_DELETEALL=3\n"
    ),
    "rmf_obstacle_msgs/msg/Obstacles": "std_msgs/Header header\nObstacle[] obstacles\n",
    "rmf_fleet_msgs/msg/LaneRequest": "string fleet_name\nuint64[] open_lanes\nuint64[] close_lanes\n",
    "rmf_fleet_msgs/msg/SpeedLimitedLane": "uint64 lane_index\nfloat64 speed_limit\n",
    "rmf_fleet_msgs/msg/SpeedLimitRequest": (
        "string fleet_name\nSpeedLimitedLane[] speed_limits\nuint64[] remove_limits\n"
    ),
    # The parts of the action nav2_msgs/NavigateToPose and of action_msgs/CancelGoal, as they cross the wire.
    "fognav_msgs/msg/SendGoal": "uint8[16] goal_id\ngeometry_msgs/PoseStamped pose\nstring behavior_tree\n",
    "fognav_msgs/msg/GoalAccepted": "bool accepted\nbuiltin_interfaces/Time stamp\n",
    "fognav_msgs/msg/GetResult": "uint8[16] goal_id\n",
    "fognav_msgs/msg/GoalResult": "int8 status\n",
    "fognav_msgs/msg/GoalInfo": "uint8[16] goal_id\nbuiltin_interfaces/Time stamp\n",
    "fognav_msgs/msg/GoalsCanceled": "int8 return_code\nGoalInfo[] goals_canceling\n",
    "fognav_msgs/msg/GoalFeedback": (
        "uint8[16] goal_id\ngeometry_msgs/PoseStamped current_pose\nbuiltin_interfaces/Duration navigation_time\n"
        "builtin_interfaces/Duration estimated_time_remaining\nint16 number_of_recoveries\nfloat32 distance_remaining\n"
    ),
}
"""Messages that rosbags does not know, by their fields alone: a hash covers these."""
TYPES: Final = get_typestore(Stores.ROS2_JAZZY)
for _name, _fields in _DEFINITIONS.items():
    TYPES.register(get_types_from_msg(_fields, _name))

_GRID: Final = "nav_msgs/msg/OccupancyGrid"
_NO_CELLS: Final = np.zeros(0, np.int8)
_ATTACHMENT: Final = struct.Struct("<qqB")
_GID_BYTES: Final = 16
_OLD_ATTACHMENT: Final = 77
"""Bytes of Jazzy's attachment before 0.2.4, with a name before each field."""
LATCHED: Final = ":1:,1:,:,:,,"
"""Quality of service of what a late subscriber is given at once: reliable, transient local, the last one."""
PLAIN: Final = "::,7:,:,:,,"


class WireError(ValueError):
    """What a peer sent can't be used; the text says why, `reason` in a word, for the metric."""

    def __init__(self, words: str, reason: str = "malformed") -> None:
        super().__init__(words)
        self.reason = reason


def dds_type(name: str) -> str:
    """Return a type's name in keys: `nav_msgs::msg::dds_::Path_` for `nav_msgs/msg/Path`."""
    package, kind, message = name.split("/")
    return f"{package}::{kind}::dds_::{message}_"


def type_hash(name: str) -> str:
    """Return the hash of a message's type, `RIHS01_` and 64 digits."""
    return str(TYPES.hash_rihs01(name))


class Topic(NamedTuple):
    """A topic by its name without a leading slash, and the type of its messages."""

    name: str
    type: str
    latched: bool = False

    def key(self, domain: int) -> str:
        """Return the key of its messages."""
        return f"{self.any_hash(domain)[:-1]}{type_hash(self.type)}"

    def any_hash(self, domain: int) -> str:
        """Return the key expression of messages of this name, whatever definition their sender was built with."""
        return f"{domain}/{self.name}/{dds_type(self.type)}/*"


class Attachment(NamedTuple):
    """What rmw_zenoh sends beside each message: its number from 1 on, when it was sent (ns since 1970), by whom."""

    number: int
    sent_ns: int
    gid: bytes

    def encoded(self) -> bytes:
        """Return its bytes; a peer drops a message without them."""
        return _ATTACHMENT.pack(self.number, self.sent_ns, len(self.gid)) + self.gid

    @classmethod
    def decoded(cls, data: bytes) -> Attachment:
        """Read one, of the form before April 2025 too; raises `WireError`."""
        if len(data) == _OLD_ATTACHMENT:
            # Each of its three fields follows its name and what counts the name's letters.
            data = data[16:24] + data[41:49] + data[60:]
        if len(data) != _ATTACHMENT.size + _GID_BYTES:
            raise WireError(f"an attachment of {len(data)} bytes, and rmw_zenoh's have {_ATTACHMENT.size + _GID_BYTES}")
        number, sent_ns, length = _ATTACHMENT.unpack_from(data)
        if length != _GID_BYTES:
            raise WireError(f"an attachment whose sender's id has {length} bytes, and not {_GID_BYTES}")
        return cls(number, sent_ns, data[_ATTACHMENT.size :])


@dataclass
class Node:
    """What a node of ROS tells of itself, so that `ros2 topic list` and `ros2 topic info` show it."""

    domain: int
    zid: str
    name: str

    def __post_init__(self) -> None:
        self._ids = itertools.count()
        self._id = next(self._ids)

    @property
    def token(self) -> str:
        """The node's own token."""
        return self._token(self._id, "NN")

    def entity(self, kind: str, topic: Topic) -> str:
        """Return the token of a new publisher (`MP`) or subscriber (`MS`)."""
        name = "%" + topic.name.replace("/", "%")
        quality = LATCHED if topic.latched else PLAIN
        return f"{self._token(next(self._ids), kind)}/{name}/{dds_type(topic.type)}/{type_hash(topic.type)}/{quality}"

    def _token(self, entity: int, kind: str) -> str:
        return f"@ros2_lv/{self.domain}/{self.zid}/{self._id}/{entity}/{kind}/%/%/{self.name}"


def gid(token: str) -> bytes:
    """Return the id of a publisher or subscriber: XXH3-128 of its token."""
    value = xxhash.xxh3_128_intdigest(token.encode())
    return struct.pack("<QQ", value & (1 << 64) - 1, value >> 64)


class Writer:
    """Numbers the messages of one publisher."""

    def __init__(self, topic: Topic, token: str) -> None:
        self.topic = topic
        self._gid = gid(token)
        self._numbers = itertools.count(1)

    def encoded(self, message: object, sent_ns: int) -> tuple[bytes, bytes]:
        """Return a message's payload (CDR, little-endian, after its header) and attachment."""
        return serialized(self.topic.type, message), Attachment(next(self._numbers), sent_ns, self._gid).encoded()


def serialized(kind: str, message: RosMessage) -> bytes:
    """Return a message's payload (CDR, little-endian, after its header)."""
    return _encoded_grid(message) if kind == _GRID else bytes(TYPES.serialize_cdr(message, kind))


def _encoded_grid(grid: RosMessage) -> bytes:
    """Return a grid's payload. Its cells are its last field, and are copied once: millions, while a robot waits."""
    head = TYPES.serialize_cdr(replace(grid, data=_NO_CELLS), _GRID)
    return b"".join((memoryview(head)[:-4], len(grid.data).to_bytes(4, "little"), grid.data))


def decoded(topic: Topic, payload: bytes) -> RosMessage:
    """Return the message of a topic's payload; raises `WireError` for one that is cut off or is none."""
    return decoded_as(topic.type, payload)


def decoded_as(kind: str, payload: bytes) -> RosMessage:
    """Return the message of a payload of a type, likewise."""
    try:
        return TYPES.deserialize_cdr(payload, kind)
    except Exception as error:  # rosbags raises what its generated code stumbles over
        raise WireError(f"no {kind}: {error!r}") from error
