"""Robots of ROS 2 hear of a floor's hazards and zones over rmw_zenoh's wire, and send goals."""

import asyncio
import json
import os
import struct
import threading
import time
from collections import Counter
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any, Self, cast

import httpx
import msgspec
import numpy as np
import pytest
import zenoh
import zenoh.ext as ze
from hypothesis import given
from hypothesis import strategies as st
from manual_clock import ManualClock
from rosbags.typesys import Stores, get_typestore

from fog_bridges.floor import REFUSED
from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.advice import GOAL_TYPE, PATH_TYPE
from fog_bridges.ros2.bridge import (
    LANES_TYPE,
    LIMITS_TYPE,
    MAP_TYPE,
    OBSTACLES_TYPE,
    POSE_TYPE,
    TF_TYPE,
    Relay,
)
from fog_bridges.ros2.others import OBSTACLES_MAX, Others, robot_radii
from fog_bridges.ros2.rmf import GraphError, Traffic, read_graph
from fog_bridges.ros2.session import RosSession, ros_config
from fog_bridges.ros2.wire import TYPES, Attachment, Node, Topic, WireError, Writer, decoded, type_hash
from fog_contracts import channels as ch
from fog_contracts.costs import penalty_cost
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import (
    AreaHazard,
    CircleShape,
    HazardArea,
    MapSnapshot,
    RectangleShape,
    Reported,
    RobotPath,
    RobotPose,
    RobotState,
    View,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import MasterMap, decode_map
from fog_runtime.clock import SystemClock

DOMAIN = 7
STORE = get_typestore(Stores.ROS2_JAZZY)
GRID = "nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
GOAL = "geometry_msgs::msg::dds_::PoseStamped_/RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8"
PEERS = "FOGNAV_ROS2_PEERS"
CLOCK = SystemClock()

# --- The wire ---------------------------------------------------------------------------------------------------------


def test_keys_and_tokens_are_those_of_rmw_zenoh():
    topic = Topic("fognav/lab/keepout_mask", "nav_msgs/msg/OccupancyGrid", latched=True)
    assert topic.key(0) == f"0/fognav/lab/keepout_mask/{GRID}"
    assert topic.any_hash(0) == "0/fognav/lab/keepout_mask/nav_msgs::msg::dds_::OccupancyGrid_/*"
    assert type_hash("std_msgs/msg/String") == (
        "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    ), "as rmw_zenoh's design document has it"
    assert type_hash("nav2_msgs/msg/CostmapFilterInfo") == (
        "RIHS01_61ce391bf7690f76a331c01c9d5ce8ca71e6c99273b9fb75e48380f05c6dfdc8"
    )
    node = Node(0, "aac3178e146ba6f1fc6e6a4085e77f21", "fognav_lab")
    assert node.token == "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/fognav_lab"
    assert node.entity("MP", topic) == (
        f"@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/1/MP/%/%/fognav_lab/%fognav%lab%keepout_mask/{GRID}/:1:,1:,:,:,,"
    )


@given(st.integers(1, 2**62), st.integers(0, 2**62), st.binary(min_size=16, max_size=16))
def test_attachment_is_read_again_in_both_forms(number, sent_ns, sender):
    attachment = Attachment(number, sent_ns, sender)
    assert attachment.encoded() == struct.pack("<qqB", number, sent_ns, 16) + sender
    assert Attachment.decoded(attachment.encoded()) == attachment
    named = (b"sequence_number", attachment.encoded()[:8]), (b"source_timestamp", attachment.encoded()[8:16])
    older = b"".join(bytes([len(name)]) + name + value for name, value in named)
    assert Attachment.decoded(older + b"\x0asource_gid\x10" + sender) == attachment


@given(st.binary(max_size=200))
def test_bytes_that_are_no_message_are_refused_by_one_kind_of_error(data):
    topic = Topic("r1/goal_pose", "geometry_msgs/msg/PoseStamped")
    for read in (Attachment.decoded, lambda payload: decoded(topic, payload)):
        with suppress(WireError):
            read(data)


# --- Messages ---------------------------------------------------------------------------------------------------------


def test_mask_blocks_what_the_costmap_does_and_the_plan_does_not():
    static = np.zeros((4, 5), np.uint8)
    static[0], static[3] = 254, 255
    cost = static.copy()
    cost[1, 2:4], cost[1, 1], cost[2] = 254, 253, 80
    mask = ros.keepout_values(cost, static)
    assert mask.tolist() == [[0] * 5, [0, 0, 100, 100, 0], [0] * 5, [0] * 5]
    assert ros.map_values(static).tolist() == [[100] * 5, [0] * 5, [0] * 5, [-1] * 5]


def test_speed_mask_has_the_lower_of_its_limits_everywhere():
    speed = np.array([[0, 10, 50, 120]], np.uint8)
    assert ros.speed_values(speed).tolist() == [[0, 10, 50, 100]]
    assert ros.speed_values(speed, limit=0.15).tolist() == [[15, 10, 15, 15]]


def test_grid_is_sent_as_others_serialize_it():
    values = np.arange(-1, 59, dtype=np.int8).reshape(6, 10)
    grid = ros.grid(values, GridGeometry(10, 6, 0.05, -1.0, 2.0), 7.5)
    payload, _ = Writer(Topic("m", "nav_msgs/msg/OccupancyGrid"), "token").encoded(grid, 1)
    assert payload == bytes(STORE.serialize_cdr(grid, "nav_msgs/msg/OccupancyGrid"))


def test_path_battery_and_markers_can_be_sent():
    path = RobotPath(
        plan_id=1, planner_epoch=1, goal_id="g", points=[(0.0, 0.0), (1.0, 0.0), (1.0, 2.0)], map_epoch=1, map_seq=1,
        released_length=3.0,
    )  # fmt: skip
    told = sent("r1/plan", "nav_msgs/msg/Path", ros.path(path, 5.5))
    assert [(pose.pose.position.x, pose.pose.position.y) for pose in told.poses] == path.points
    assert [ros.heading(pose.pose.orientation) for pose in told.poses] == pytest.approx([0.0, np.pi / 2, np.pi / 2])
    assert (told.header.stamp.sec, told.header.stamp.nanosec) == (5, 500_000_000)
    state = RobotState(
        mode="HOLD", reasons=[], enabled=False, battery=0.63, goal_id=None, map_epoch=0, map_seq=0, plan_id=None
    )
    battery = sent("r1/battery_state", "sensor_msgs/msg/BatteryState", ros.battery(state, 1.0))
    assert (round(battery.percentage, 2), bool(np.isnan(battery.voltage))) == (0.63, True)
    zone = Zone(id="wet", kind="BLOCKED", shape=CircleShape(centre=(1.0, 1.0), radius=0.5), reason="mopped")
    drawn = ros.markers({}, [zone], GridGeometry(60, 60, 0.05, 0.0, 0.0), 1.0)
    everything, stripes, words = sent("h", "visualization_msgs/msg/MarkerArray", drawn).markers
    assert (everything.action, words.text) == (3, "wet: mopped")
    assert all(abs((point.x - 1.0) ** 2 + (point.y - 1.0) ** 2 - 0.25) < 0.09 for point in stripes.points)


def sent(name: str, kind: str, message):
    """Return a message as another store of types reads what was sent, where that knows the type."""
    payload, _ = Writer(Topic(name, kind), "token").encoded(message, 1)
    return (STORE if kind in STORE.fielddefs else TYPES).deserialize_cdr(payload, kind)


# --- The map ----------------------------------------------------------------------------------------------------------


def whole(grid, height: int, width: int) -> np.ndarray:
    """Return the values of a grid, which may have a part of the floor only, on the whole floor (height, width)."""
    cells = np.zeros((height, width), np.int8)
    x, y = (round(value / 0.05) for value in (grid.info.origin.position.x, grid.info.origin.position.y))
    cells[y : y + grid.info.height, x : x + grid.info.width] = grid.data.reshape(grid.info.height, grid.info.width)
    return cells


class Floor:
    """A floor's channels and a node of ROS: what was told on each topic."""

    site = "test"

    def __init__(self, level: str = "") -> None:
        self.clock = ManualClock(100.0)
        self.hear: dict[Any, Any] = {}
        self.reported: list[tuple[str, Reported]] = []
        self.snapshot: MapSnapshot | None = None
        """The answer to who asks for the map; None: none comes."""
        self.told: dict[str, list[Any]] = {}
        self.refused: list[str] = []
        self.relay = Relay(
            cast("Any", self), cast("Any", self), cast("Any", None), self.clock, Others({"tb4": 0.2}, level)
        )
        self.relay.subscribe()

    def subscribe(self, what: Any, second: Any, third: Any = None) -> None:
        """A channel of the floor, its type and handler; or a topic of ROS, its handler and its limit of age."""
        self.hear[what.name if isinstance(what, Topic) else what] = second if isinstance(what, Topic) else third

    async def query(self, *_: object) -> MapSnapshot:
        if self.snapshot is None:
            await asyncio.Event().wait()
        assert self.snapshot is not None
        return self.snapshot

    def publish(self, topic: Any, message: Any, _stamp: float = 0.0, *, thing: str = "") -> None:
        if topic is ch.REPORTED:
            self.reported.append((thing, message))
        else:
            self.told.setdefault(topic.name.removeprefix("fognav/test/"), []).append(message)

    def refuse(self, reason: str, _topic: str, words: str) -> None:
        self.refused.append(f"{reason}: {words}")

    async def show(self, master: MasterMap) -> None:
        """Let the relay have a map, and tell its masks."""
        self.snapshot = master.snapshot()
        await self.relay._load()
        self.relay._tell_masks()

    async def pass_s(self, seconds: float) -> None:
        for _ in range(round(10 * seconds)):
            self.clock.advance(0.1)
            await asyncio.sleep(0.01)


def plan(wall: int, epoch: int) -> MasterMap:
    """A map of 4 x 5 cells, of which a column is a wall."""
    static = np.zeros((4, 5), np.uint8)
    static[:, wall] = 254
    return MasterMap("test", GridGeometry(5, 4, 0.05, 0.0, 0.0), static, static, epoch)


async def test_another_map_of_the_same_size_is_told_once():
    floor = Floor()
    for epoch, wall in ((1, 0), (2, 0), (3, 4)):
        await floor.show(plan(wall, epoch))
    walls = [grid.data.reshape(4, 5)[0].tolist().index(100) for grid in floor.told["map"]]
    assert walls == [0, 4], "robots must not drive by the walls of the map before"


async def test_floor_becomes_slow_also_while_a_snapshot_is_waited_for():
    floor, master = Floor(), plan(0, 1)
    floor.snapshot = master.snapshot()
    loops = [asyncio.create_task(loop()) for loop in (floor.relay.snapshot_loop, floor.relay.map_loop)]
    try:
        async with asyncio.timeout(10.0):
            while "speed_mask" not in floor.told or floor.told["speed_mask"][-1].data.any():
                floor.hear[ch.MAP_HEARTBEAT]({}, master.heartbeat(floor.clock.now()))
                await floor.pass_s(0.1)
        floor.snapshot = None
        master.write([("cost", master.geometry.whole, np.full((4, 5), 254, np.uint8))], [], [])  # its delta is lost
        floor.hear[ch.MAP_HEARTBEAT]({}, master.heartbeat(floor.clock.now()))
        await floor.pass_s(3.0)
        assert (floor.told["speed_mask"][-1].data == 15).all()
    finally:
        for loop in loops:
            loop.cancel()


async def test_keepout_mask_has_what_was_ever_blocked_and_no_more_so_that_robots_clear_it_again():
    floor, geometry = Floor(), GridGeometry(40, 40, 0.05, 0.0, 0.0)
    sizes = []
    for epoch, cells in enumerate([(), [(10, 20)], [(12, 22)], ()], 1):
        cost = np.zeros((40, 40), np.uint8)
        for row, column in cells:
            cost[row, column] = 254
        floor.clock.advance(1.0)
        await floor.show(MasterMap("test", geometry, np.zeros((40, 40), np.uint8), cost, epoch))
        grid = floor.told["keepout_mask"][-1]
        sizes.append((grid.info.width, grid.info.height))
        assert {(int(y), int(x)) for y, x in np.argwhere(whole(grid, 40, 40))} == set(cells)
    assert sizes == [(1, 1), (21, 11), (23, 13), (23, 13)], "Nav2 draws so many cells anew, from its costmap's corner"


async def test_penalty_zone_is_a_cost_on_the_keepout_mask():
    floor, master = Floor(), plan(0, 1)
    shape = RectangleShape(corner=(0.11, 0.01), opposite=(0.24, 0.19))
    zone = Zone(id="slow", kind="PENALTY", shape=shape, factor=3.0)
    floor.hear[ch.ZONES]({}, ZoneSet(epoch=1, seq=1, zones=[zone], active=["slow"]))
    await floor.show(master)
    mask = whole(floor.told["keepout_mask"][-1], 4, 5)
    assert round(int(mask[2, 3]) * 254 / 100) == pytest.approx(penalty_cost(3.0), abs=1), "as Nav2 computes a cost"
    assert mask[2, 0] == 0
    floor.clock.advance(1.0)
    floor.hear[ch.ZONES]({}, ZoneSet(epoch=1, seq=2, zones=[zone], active=[]))
    floor.relay._tell_masks()
    assert not floor.told["keepout_mask"][-1].data.any()


async def test_plan_is_cleared_when_the_mission_ends():
    floor = Floor()
    path = RobotPath(
        plan_id=1, planner_epoch=1, goal_id="g", points=[(0.0, 0.0), (1.0, 0.0)], map_epoch=1, map_seq=1,
        released_length=1.0,
    )  # fmt: skip
    state = RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=None, map_epoch=0, map_seq=0, plan_id=None
    )
    for told in (path, state, msgspec.structs.replace(state, goal_id="g"), state, state):
        floor.hear[ch.ROBOT_PATH if told is path else ch.ROBOT_STATE]({"robot": "r-1"}, told)
    lengths = [len(each.poses) for each in floor.told["r_1/plan"]]
    assert lengths == [2, 0], "a state from before the robot had its goal clears nothing"
    reached = msgspec.structs.replace(state, goal_id="g", goal_reached=True)
    for told in (path, msgspec.structs.replace(state, goal_id="g"), reached):
        floor.hear[ch.ROBOT_PATH if told is path else ch.ROBOT_STATE]({"robot": "r-1"}, told)
    assert len(floor.told["r_1/plan"][-1].poses) == 0


def test_what_a_lidar_sees_is_a_scan_turned_as_the_map_is():
    reach = bytearray(180)
    reach[45], reach[0] = 40, 255
    told = sent("r1/scan", "sensor_msgs/msg/LaserScan", ros.scan(View(x=1.0, y=2.0, reach=bytes(reach)), "r1", 1.0))
    assert told.header.frame_id == "r1/view"
    assert told.ranges[45] == pytest.approx(2.0)
    assert told.angle_min + 45 * told.angle_increment == pytest.approx(np.radians(91.0))
    assert np.isnan(told.ranges).sum() == 178, "a sector without an echo says nothing"


# --- Robots of others, and obstacles ----------------------------------------------------------------------------------


def stamped(pose, frame: str = "map"):
    return ros.message(
        "geometry_msgs/msg/PoseWithCovarianceStamped", header=ros.header(1.0, frame),
        pose=ros.message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
    )  # fmt: skip


def transforms(*links: tuple[str, str, float, float, float]):
    """A message of transforms, each by parent, child, x, y, theta."""
    made = []
    for parent, child, *where in links:
        (each,) = ros.transform(*where, child, 1.0).transforms
        each.header.frame_id = parent
        made.append(each)
    return ros.message("tf2_msgs/msg/TFMessage", transforms=made)


def test_robot_of_others_is_where_its_pose_or_its_transforms_say():
    floor = Floor()
    floor.hear["tb4/amcl_pose"](stamped(ros.pose(1.0, 2.0, 0.5)))
    ((thing, told),) = floor.reported
    assert (thing, told.kind, told.shape, told.theta) == (
        "tb4", "robot", CircleShape(centre=(1.0, 2.0), radius=0.2), pytest.approx(0.5)
    )  # fmt: skip
    floor.clock.advance(1.0)
    floor.hear["tb4/tf"](transforms(("map", "odom", 1.0, 0.0, np.pi / 2)))
    assert len(floor.reported) == 1, "where the base is in `odom` is not known yet"
    floor.hear["tb4/tf"](transforms(("tb4/odom", "tb4/base_link", 2.0, 0.0, 0.0)))
    assert floor.reported[-1][1].shape.centre == pytest.approx((1.0, 2.0))
    floor.hear["tb4/tf"](transforms(("odom", "base_link", 2.5, 0.0, 0.0)))
    assert len(floor.reported) == 2, "at most five reports a second"
    floor.clock.advance(4.0)
    floor.hear["tb4/tf"](transforms(("odom", "base_link", 2.5, 0.0, 0.0)))
    assert len(floor.reported) == 2, "its localization is silent"


@pytest.mark.parametrize(
    ("topic", "message", "reason"),
    [
        ("tb4/amcl_pose", stamped(ros.pose(1.0, 2.0, 0.0), "odom"), "frame"),
        ("tb4/amcl_pose", stamped(ros.pose(float("nan"), 2.0, 0.0)), "malformed"),
        ("tb4/tf", transforms(("map", "base_link", float("inf"), 0.0, 0.0)), "malformed"),
        ("tb4/tf", transforms(*[("a", f"f{n}", 0.0, 0.0, 0.0) for n in range(201)]), "malformed"),
    ],
)
def test_pose_that_is_none_is_refused(topic, message, reason):
    floor = Floor()
    with pytest.raises(WireError) as refused:
        floor.hear[topic](message)
    assert (refused.value.reason, floor.reported) == (reason, [])


def test_transforms_that_lead_in_a_circle_lead_nowhere():
    floor = Floor()
    floor.hear["tb4/tf"](transforms(("base_link", "odom", 0.0, 0.0, 0.0), ("odom", "base_link", 0.0, 0.0, 0.0)))
    assert floor.reported == []


async def test_mask_leaves_out_a_robot_of_others_but_not_the_hazard_that_it_stands_in():
    floor = Floor()
    geometry = GridGeometry(40, 40, 0.05, 0.0, 0.0)
    cost = np.zeros((40, 40), np.uint8)
    cost[16:24, 16:24] = 254
    ring = [(0.8, 0.8), (1.0, 0.8), (1.0, 1.2), (0.8, 1.2)]
    hazard = AreaHazard(area="hall", state="blocked", severity=3, penalty=254, since=0.0, seq=1, epoch=1, cause="")
    for blocked in (False, True):
        floor.clock.advance(1.0)
        floor.hear["tb4/amcl_pose"](stamped(ros.pose(1.0, 1.0, 0.0)))
        if blocked:
            floor.hear[ch.HAZARD]({"area": "hall"}, HazardArea(hazard=hazard, polygon=ring))
        await floor.show(MasterMap("test", geometry, np.zeros((40, 40), np.uint8), cost, 1))
        mask = whole(floor.told["keepout_mask"][-1], 40, 40)
        assert (bool(mask[20, 17]), bool(mask[20, 22])) == (blocked, False)


def obstacle(number: int, source: str = "camera", action: int = 1, size: float = 1.0, level: str = ""):
    return ros.message(
        "rmf_obstacle_msgs/msg/Obstacle", header=ros.header(1.0), id=number, source=source, level_name=level,
        classification="box", data_resolution=0.0, data=np.zeros(0, np.int8), action=action,
        bbox=ros.message(
            "rmf_obstacle_msgs/msg/BoundingBox3D", center=ros.pose(2.0, 2.0, np.pi / 4),
            size=ros.message("geometry_msgs/msg/Vector3", x=size, y=size, z=1.0),
        ),
        lifetime=ros.message("builtin_interfaces/msg/Duration", sec=5, nanosec=0),
    )  # fmt: skip


def obstacles(*found):
    message = ros.message("rmf_obstacle_msgs/msg/Obstacles", header=ros.header(1.0), obstacles=list(found))
    payload, _ = Writer(Topic("rmf_obstacles", "rmf_obstacle_msgs/msg/Obstacles"), "token").encoded(message, 1)
    return decoded(Topic("rmf_obstacles", "rmf_obstacle_msgs/msg/Obstacles"), payload)


def test_obstacles_of_others_are_reported_for_their_lifetime_and_deleted():
    assert type_hash("rmf_obstacle_msgs/msg/Obstacles") == (
        "RIHS01_7b96bbe6a33162d9ad6d751b8f08dbaa32c23c5b4a8942c78d5249f48443b701"
    )
    floor = Floor()
    hear = floor.hear["rmf_obstacles"]
    hear(obstacles(obstacle(3), obstacle(-4), obstacle(5, source="fognav test")))
    first, second = floor.reported
    assert first[1].shape.points[0] == pytest.approx((2.0, 2.0 - np.sqrt(0.5)))
    assert (first[1].kind, first[1].ttl, first[0] != second[0]) == ("obstacle", 5.0, True)
    hear(obstacles(obstacle(3, action=2), obstacle(0, action=3)))
    assert [(thing, told.shape) for thing, told in floor.reported[2:]] == [(first[0], None), (second[0], None)]
    for wrong in (obstacle(3, size=float("nan")), obstacle(3, size=50.0), obstacle(3, action=9)):
        hear(obstacles(wrong))
    assert (len(floor.refused), len(floor.reported)) == (3, 4)
    for number in range(OBSTACLES_MAX):
        hear(obstacles(obstacle(number)))
    hear(obstacles(obstacle(OBSTACLES_MAX)))
    assert floor.refused[3:] == [f"too_many: {OBSTACLES_MAX} obstacles are there already"]
    with pytest.raises(WireError, match="in one message"):
        hear(obstacles(*[obstacle(number) for number in range(OBSTACLES_MAX + 1)]))


def test_an_obstacle_that_is_none_hides_no_other_and_those_of_another_level_are_left_out():
    floor = Floor(level="L1")
    hear = floor.hear["rmf_obstacles"]
    hear(obstacles(obstacle(1), obstacle(2, size=0.0), obstacle(3, level="L2"), obstacle(4, level="L1")))
    assert (len(floor.reported), len(floor.refused)) == (2, 1)
    hear(obstacles(obstacle(1, size=2.0)))
    assert len(floor.reported) == 2, "five times a second each, at most"
    floor.clock.advance(0.3)
    hear(obstacles(obstacle(1, size=2.0)))
    assert len(floor.reported) == 3


def test_frames_that_nobody_speaks_of_any_more_leave_room_for_the_base():
    floor = Floor()
    floor.hear["tb4/tf"](transforms(*[("map", f"joint{number}", 0.0, 0.0, 0.0) for number in range(200)]))
    base = transforms(("map", "base_link", 2.0, 1.0, 0.0))
    floor.hear["tb4/tf"](base)
    assert floor.reported == []
    floor.clock.advance(4.0)
    floor.hear["tb4/tf"](base)
    assert floor.reported[0][1].shape.centre == (2.0, 1.0)
    with pytest.raises(WireError, match="letters"):
        floor.hear["tb4/tf"](transforms(("map", "j" * 500, 0.0, 0.0, 0.0)))


async def test_what_stands_where_a_robot_of_others_was_is_on_the_mask_again():
    floor = Floor()
    geometry = GridGeometry(40, 40, 0.05, 0.0, 0.0)
    cost = np.zeros((40, 40), np.uint8)
    cost[16:24, 16:24] = 254
    floor.hear["tb4/amcl_pose"](stamped(ros.pose(1.0, 1.0, 0.0)))
    master = MasterMap("test", geometry, np.zeros((40, 40), np.uint8), cost, 1)
    await floor.show(master)
    assert whole(floor.told["keepout_mask"][-1], 40, 40)[20, 20] == 0
    loop = asyncio.create_task(floor.relay.map_loop())
    await floor.pass_s(5.0)
    loop.cancel()
    assert whole(floor.told["keepout_mask"][-1], 40, 40)[20, 20] == 100


def test_robot_that_waits_for_an_operator_takes_no_goal():
    floor = Floor()
    state = RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=None, map_epoch=0, map_seq=0, plan_id=None
    )
    goal = ros.message("geometry_msgs/msg/PoseStamped", header=ros.header(1.0), pose=ros.pose(1.0, 1.0, 0.0))
    floor.hear[ch.ROBOT_STATE]({"robot": "r-1"}, state)
    floor.hear["r_1/goal_pose"](goal)
    for stopped in (
        msgspec.structs.replace(state, enabled=False),
        msgspec.structs.replace(state, awaits_operator=True),
    ):
        floor.hear[ch.ROBOT_STATE]({"robot": "r-1"}, stopped)
        with pytest.raises(WireError, match="enables it"):
            floor.hear["r_1/goal_pose"](goal)
    assert floor.relay._goals.qsize() == 1


async def test_robot_that_tells_nothing_for_5_s_takes_no_goal_also_none_that_waits_until_it_is_heard_again():
    floor = Floor()
    state = RobotState(
        mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=None, map_epoch=0, map_seq=0, plan_id=None
    )
    goal = ros.message("geometry_msgs/msg/PoseStamped", header=ros.header(1.0), pose=ros.pose(1.0, 1.0, 0.0))
    floor.hear[ch.ROBOT_STATE]({"robot": "r-1"}, state)
    floor.clock.advance(4.9)
    floor.hear["r_1/goal_pose"](goal)
    floor.clock.advance(0.2)
    with pytest.raises(WireError, match="silent"):
        floor.hear["r_1/goal_pose"](goal)
    loop = asyncio.create_task(floor.relay.goal_loop())
    await floor.pass_s(0.1)
    assert [each.partition(" is ")[0] for each in floor.refused] == ["goal: the robot"], "it would be sent otherwise"
    loop.cancel()
    floor.hear[ch.ROBOT_STATE]({"robot": "r-1"}, state)
    floor.hear["r_1/goal_pose"](goal)
    assert floor.relay._goals.qsize() == 1


GRAPH = """
building_name: house
levels:
  L0: {vertices: [[0, 0, {}], [1, 0, {}]], lanes: [[0, 1, {}], [1, 0, {}]]}
  L1:
    vertices: [[0.5, 0.5, {name: a}], [1.5, 0.5, {}], [1.5, 1.5, {}]]
    lanes: [[0, 1, {}], [1, 0, {}], [1, 2, {speed_limit: 0.5}]]
"""


def test_lanes_are_closed_slowed_and_opened_again_for_each_fleet(tmp_path):
    (tmp_path / "0.yaml").write_text(GRAPH)
    lanes = read_graph(tmp_path / "0.yaml", "L1")
    assert [lane.number for lane in lanes] == [2, 3, 4], "numbered after those of the level before"
    traffic, geometry = Traffic(lanes, ["tb", "carts"], "L1"), GridGeometry(40, 40, 0.05, 0.0, 0.0)
    free = np.zeros((40, 40), np.int8)
    closed, slow = free.copy(), free.copy()
    closed[8:12, 18:20], slow[28:32, 28:32] = 100, 30
    assert traffic.update(closed, slow, geometry, 1.0)
    first, second = (sent("l", LANES_TYPE, each) for each in traffic.lane_requests())
    assert (first.fleet_name, second.fleet_name) == ("tb", "carts")
    assert (first.close_lanes.tolist(), first.open_lanes.tolist()) == ([2, 3], [])
    (limit, _) = (sent("l", LIMITS_TYPE, each) for each in traffic.speed_requests())
    assert [(each.lane_index, each.speed_limit) for each in limit.speed_limits] == [(4, 0.3)]
    assert not traffic.update(closed, slow, geometry, 1.2)
    assert traffic.update(closed, slow, geometry, 1.6), "told again, faster than once a second"
    assert traffic.update(free, free, geometry, 1.7)
    assert traffic.lane_requests()[0].open_lanes.tolist() == [2, 3]
    assert traffic.speed_requests()[0].remove_limits.tolist() == [4]
    assert traffic.update(free, free, geometry, 9.0)
    assert traffic.lane_requests()[0].open_lanes.tolist() == [], "only lanes that it has closed are opened, for a while"
    assert type_hash(LANES_TYPE) == "RIHS01_100c4069966b9c5f1643862c4cb47866144395cc30ec51b1a99f0b834c72158e"
    assert type_hash(LIMITS_TYPE) == "RIHS01_a20aaa1e353b1cc0793dad24dfca43d7bd8369c4e5962fb3cc6280d0b6381017"


@pytest.mark.parametrize(
    "text", ["levels: [", "a: 1", "levels: {L2: {}}", "levels: {L1: {vertices: [[1]], lanes: []}}"]
)
def test_navigation_graph_that_is_none_is_refused_with_its_file(tmp_path, text):
    (tmp_path / "0.yaml").write_text(text)
    with pytest.raises(GraphError, match=r"0\.yaml"):
        read_graph(tmp_path / "0.yaml", "L1")


async def test_hazards_and_zones_are_obstacles_of_open_rmf_until_they_are_gone():
    floor = Floor()
    floor.relay._traffic = Traffic([], [], "L1")
    ring = [(0.05, 0.0), (0.1, 0.0), (0.1, 0.1)]
    hazard = AreaHazard(area="hall", state="blocked", severity=3, penalty=254, since=0.0, seq=1, epoch=1, cause="")
    floor.hear[ch.HAZARD]({"area": "hall"}, HazardArea(hazard=hazard, polygon=ring))
    await floor.show(plan(0, 1))
    (told,) = sent("o", OBSTACLES_TYPE, floor.told["rmf_obstacles"][-1]).obstacles
    assert (told.source, told.level_name, told.action, told.lifetime.sec) == ("fognav/L1", "L1", 1, 3)
    assert (told.bbox.center.position.x, told.bbox.size.x) == pytest.approx((0.075, 0.05))
    clear = msgspec.structs.replace(hazard, state="clear", penalty=0)
    floor.hear[ch.HAZARD]({"area": "hall"}, HazardArea(hazard=clear, polygon=ring))
    floor.clock.advance(1.0)
    floor.relay._tell_masks()
    (gone,) = floor.told["rmf_obstacles"][-1].obstacles
    assert (gone.id, gone.action) == (told.id, 2)


@pytest.mark.parametrize("text", ["tb4", "tb4:0", "tb4:3", "4b:0.2", "a/b:0.2", "tb_4:0.2,TB_4:0.3"])
def test_robots_of_others_without_name_or_radius_are_refused(text):
    with pytest.raises(ValueError, match="robot"):
        robot_radii(text)
    assert robot_radii(" tb4:0.2, Carter_1:0.35 ") == {"tb4": 0.2, "Carter_1": 0.35}


# --- With real services -----------------------------------------------------------------------------------------------


class Peer:
    """A node of ROS, as far as zenoh goes: the latest messages of each topic, late joiner included."""

    def __init__(self, port: int) -> None:
        config = zenoh.Config()
        for key, value in (("mode", "peer"), ("connect/endpoints", [f"tcp/127.0.0.1:{port}"]),
                           ("listen/endpoints", []), ("scouting/multicast/enabled", False)):  # fmt: skip
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.told: dict[str, object] = {}
        self._lock = threading.Lock()
        self._held: list[object] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()

    def hear(self, name: str, kind: str, key: str) -> None:
        def on_sample(sample: zenoh.Sample) -> None:
            assert len(sample.attachment.to_bytes()) == 33
            with self._lock:
                self.told[name] = STORE.deserialize_cdr(sample.payload.to_bytes(), kind)

        self._held.append(
            ze.declare_advanced_subscriber(
                self.session, f"{DOMAIN}/{name}/{key}", on_sample, subscriber_detection=True,
                history=ze.HistoryConfig(detect_late_publishers=True, max_samples=1),
                recovery=ze.RecoveryConfig(heartbeat=True),
            )
        )  # fmt: skip

    def mask(self, name: str = "fognav/test/keepout_mask"):
        grid = self.told.get(name)
        return None if grid is None else whole(grid, 120, 160)

    def send(self, name: str, key: str, payload: bytes, attachment: bytes | None) -> None:
        self.session.put(f"{DOMAIN}/{name}/{key}", payload, attachment=attachment)


def encoded(name: str, kind: str, message: object) -> tuple[str, bytes, bytes]:
    """Return key, payload and attachment of a message as it is sent."""
    topic = Topic(name, kind)
    return topic.key(0).removeprefix(f"0/{name}/"), *Writer(topic, "t").encoded(message, time.time_ns())


@pytest.fixture
async def ros2(all_services, tokens, ros_router):
    """Run the console-service and the bridge to ROS 2; yield the fog and the port of ROS's router."""
    urls = {
        f"FOGNAV_{name}_URL": await all_services.ready(module)
        for name, module in (("AGGREGATOR", "hazard_aggregator"), ("MAP", "map_service"), ("PLANNER", "planner"))
    }
    all_services.start("console_service", **urls)
    token = all_services.folder / "ros2-token"
    token.write_text(tokens["operator"]["Authorization"].removeprefix("Bearer "))
    all_services.start(
        "fog_bridges",
        FOGNAV_ADAPTERS="ros2",
        FOGNAV_ROS2_ROUTER=f"tcp/127.0.0.1:{ros_router}",
        FOGNAV_ROS2_DOMAIN=str(DOMAIN),
        FOGNAV_ROS2_ROBOTS="tb4:0.2",
        FOGNAV_CONSOLE_URL=await all_services.ready("console_service"),
        FOGNAV_TOKEN_FILE=str(token),
        FOGNAV_CREDENTIALS_FILE=str(all_services.security.credentials("bridge")),
    )
    await all_services.ready("fog_bridges")
    yield all_services, ros_router
    for module in ("fog_bridges", "console_service"):
        all_services.kill(module)


@pytest.mark.live
async def test_zone_is_on_the_mask_of_a_late_joiner_and_goes_again_and_goals_reach_the_planner(ros2, tokens, until):
    fog, port = ros2
    operator, zone = tokens["operator"], "/api/v1/zones/box"
    async with httpx.AsyncClient(base_url=await fog.ready("map_service"), timeout=30) as client, fog.edges() as edges:
        body = {
            "id": "box",
            "kind": "BLOCKED",
            "shape": {"type": "rectangle", "corner": [2.0, 2.0], "opposite": [3.0, 3.0]},
        }
        assert (await client.post("/api/v1/zones", json=body, headers=operator)).is_success
        with Peer(port) as peer:
            for name in ("keepout_mask", "map"):
                peer.hear(f"fognav/test/{name}", "nav_msgs/msg/OccupancyGrid", GRID)
            await until(
                lambda: len(peer.told) == 2 and peer.mask()[50, 50] == 100,
                "the zone is on the mask",
                lambda: fog.log("fog_bridges")[-3000:],
            )
            assert 400 <= (peer.mask() == 100).sum() <= 484, "20 x 20 cells, and those that its outline touches"
            assert peer.mask("fognav/test/map")[0].tolist() == [100] * 160, "the wall is on the map"
            assert peer.told["fognav/test/map"].info.resolution == pytest.approx(0.05)
            assert (await client.delete(zone, headers=operator)).is_success
            await until(lambda: not peer.mask().any(), "the zone is gone")

            zenoh_edge = edges[1]
            pose = RobotPose(
                x=1.0, y=1.0, theta=0.0, covariance=[0.01] * 9, v=0.0, w=0.0, radius=0.17, height=0.2, stamp=time.time()
            )
            state = RobotState(
                mode="HOLD", reasons=[], enabled=True, battery=0.5, goal_id=None, map_epoch=0, map_seq=0, plan_id=None
            )
            peer.hear("r_1/pose", "geometry_msgs/msg/PoseWithCovarianceStamped", "*/*")

            async def publish() -> None:
                while True:
                    zenoh_edge.publish(ch.ROBOT_STATE, state, robot="r-1")
                    zenoh_edge.publish(ch.ROBOT_POSE, pose, robot="r-1")
                    await asyncio.sleep(0.1)

            publishing = asyncio.create_task(publish())
            planner = httpx.AsyncClient(base_url=await fog.ready("planner"), timeout=30)
            try:
                await until(lambda: "r_1/pose" in peer.told, "the robot's pose is told")
                goal = ros.message(
                    "geometry_msgs/msg/PoseStamped", header=ros.header(time.time()), pose=ros.pose(4.0, 3.0, 1.0)
                )
                payload, attachment = Writer(Topic("r_1/goal_pose", "geometry_msgs/msg/PoseStamped"), "t").encoded(
                    goal, time.time_ns()
                )
                for damaged in ((payload[:20], attachment), (payload, None), (payload, b"x"), (b"", attachment)):
                    peer.send("r_1/goal_pose", GOAL, *damaged)
                peer.send("r_1/goal_pose", "geometry_msgs::msg::dds_::PoseStamped_/RIHS01_other", payload, attachment)
                old = Attachment(9, time.time_ns() - 60 * 10**9, bytes(16))
                peer.send("r_1/goal_pose", GOAL, payload, old.encoded())
                peer.send("r_1/goal_pose", GOAL, payload, attachment)
                mission = partial(planner.get, "/api/v1/robots/r-1/goal", headers=operator)
                async with asyncio.timeout(60.0):
                    while not (answer := await mission()).is_success:  # noqa: ASYNC110  # of another process
                        await asyncio.sleep(0.1)
                assert answer.json()["pose"] == {"x": 4.0, "y": 3.0, "theta": pytest.approx(1.0)}
                metrics = (await planner.get(f"{await fog.url('fog_bridges')}/metrics")).text
                assert 'refused_messages_total{reason="malformed",system="ros2"} 4.0' in metrics
                assert 'refused_messages_total{reason="type_hash",system="ros2"} 1.0' in metrics
                assert 'refused_messages_total{reason="old",system="ros2"} 1.0' in metrics
            finally:
                publishing.cancel()
                await planner.aclose()


@pytest.mark.live
async def test_robot_and_obstacle_of_others_are_on_the_floors_map_and_the_robot_on_no_mask(ros2, until):
    fog, port = ros2
    rmf = "rmf_obstacles", "rmf_obstacle_msgs/msg/Obstacles"
    async with fog.edges() as edges:
        with Peer(port) as peer:
            peer.hear("fognav/test/keepout_mask", "nav_msgs/msg/OccupancyGrid", GRID)
            peer.hear("tb4/fognav/advice", PATH_TYPE, "*/*")
            goal, at = ros.pose(1.0, 1.0, 0.0), ros.pose(5.0, 4.0, 0.0)

            def advice() -> list[tuple[float, float]] | None:
                told = peer.told.get("tb4/fognav/advice")
                return None if told is None else [(p.pose.position.x, p.pose.position.y) for p in told.poses]

            async def send() -> None:
                while True:
                    peer.send("tb4/amcl_pose", *encoded("tb4/amcl_pose", POSE_TYPE, stamped(at)))
                    peer.send(rmf[0], *encoded(*rmf, obstacles(obstacle(1))))
                    await asyncio.sleep(0.2)

            sending = asyncio.create_task(send())
            try:
                await until(lambda: peer.told and peer.mask()[40, 40] == 100, "the obstacle of others is on the mask")
                snapshot = await edges[1].query(ch.MAP_SNAPSHOT, None, MapSnapshot, 10.0)
                assert snapshot is not None
                costs = decode_map(snapshot).layers["cost"]
                assert costs[80, 100] == 254, "the robot of others is on the floor's map"
                assert peer.mask()[80, 100] == 0, "and on no mask, which it follows itself"
                assert advice() is None, "it has told no goal"
                planned = ros.message("geometry_msgs/msg/PoseStamped", header=ros.header(time.time()), pose=goal)
                peer.send("tb4/goal_pose", *encoded("tb4/goal_pose", GOAL_TYPE, planned))
                await until(advice, "it is told a way there", lambda: fog.log("fog_bridges")[-3000:])
                way = advice()
                assert (way[0], way[-1]) == ((5.0, 4.0), (1.0, 1.0))
                corners = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(way)])
                assert np.abs(corners - 2.0).sum(axis=1).min() > 0.8, "round the obstacle, a diamond at (2, 2)"
                at = goal
                await until(lambda: advice() == [], "it has come there")
            finally:
                sending.cancel()
            await until(lambda: not peer.mask().any(), "the obstacle's lifetime is over")


@pytest.mark.live
async def test_malformed_messages_are_counted_one_by_one_and_crash_nothing(ros_router, until):
    count = int(os.environ.get("FOGNAV_ROS2_MESSAGES", "600"))
    floor, session = Floor(), RosSession(zenoh.open(ros_config(f"tcp/127.0.0.1:{ros_router}")), DOMAIN, "test", CLOCK)
    kinds = {
        "tb4/amcl_pose": (POSE_TYPE, stamped(ros.pose(5.0, 4.0, 0.0))),
        "tb4/tf": (TF_TYPE, transforms(("map", "odom", 0.0, 0.0, 0.0), ("odom", "base_link", 1.0, 1.0, 0.0))),
        "rmf_obstacles": (OBSTACLES_TYPE, obstacles(obstacle(1))),
    }
    taken = Counter()

    def take(name: str, message: Any) -> None:
        floor.hear[name](message)
        taken["yes"] += 1

    for name, (kind, _) in kinds.items():
        session.subscribe(Topic(name, kind), partial(take, name))
    before, random = refusals(), Random(1)
    good = {name: encoded(name, *kinds[name]) for name in kinds}
    try:
        with Peer(ros_router) as peer:
            for number in range(count):
                name = list(kinds)[number % 3]
                key, payload, attachment = good[name]
                damaged = bytearray(payload)
                for _ in range(random.randint(1, 8)):
                    damaged[random.randrange(len(damaged))] = random.randrange(256)
                end = random.choice((len(damaged), random.randrange(len(damaged))))
                peer.session.put(
                    f"{DOMAIN}/{name}/{key}", bytes(damaged[:end]), attachment=random.choice((attachment, b"", None)),
                    congestion_control=zenoh.CongestionControl.BLOCK,
                )  # fmt: skip
                if number % 100 == 0:
                    await asyncio.sleep(0)
            await until(lambda: taken["yes"] + refusals() - before >= count, "all are taken or counted")
        assert taken["yes"] + refusals() - before == count
        assert refusals() - before > count / 2
    finally:
        session.close()


def refusals() -> float:
    """How many messages of ROS were refused so far."""
    return sum(each.value for metric in REFUSED.collect() for each in metric.samples if each.name.endswith("_total"))


@pytest.mark.live
async def test_node_whose_protocol_code_is_not_ours_hears_the_mask_and_sends_a_goal(tmp_path, ros_router):
    if PEERS not in os.environ:
        pytest.skip(f"set {PEERS} to a Python that has zenoh-ros2-sdk: pip install zenoh-ros2-sdk==0.1.8")
    loop, goals = asyncio.get_running_loop(), []
    session = RosSession(zenoh.open(ros_config(f"tcp/127.0.0.1:{ros_router}")), DOMAIN, "fognav_test", CLOCK)
    try:
        session.subscribe(Topic("r1/goal_pose", GOAL_TYPE), goals.append)
        script = Path(__file__).with_name("ros2_peer.py")
        peer = await asyncio.create_subprocess_exec(
            os.environ[PEERS], str(script), str(ros_router), str(DOMAIN), "test", "r1", str(tmp_path),
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        values = np.zeros((10, 12), np.int8)
        values[2:4] = 100
        mask = ros.grid(values, GridGeometry(12, 10, 0.05, 0.0, 0.0), 1.0)
        heard, ends = asyncio.create_task(peer.stdout.read()), loop.time() + 60.0
        while not heard.done():
            assert loop.time() < ends
            session.publish(Topic("fognav/test/keepout_mask", MAP_TYPE, latched=True), mask, 1.0)
            await asyncio.wait([heard], timeout=0.5)
        assert json.loads(heard.result()) == {"size": [12, 10], "blocked": 24}
        assert [(goal.pose.position.x, goal.pose.position.y, goal.header.frame_id) for goal in goals] == [(4, 3, "map")]
    finally:
        session.close()


@pytest.mark.live
async def test_whole_floor_becomes_slow_while_nobody_confirms_the_map(ros2, until):
    fog, port = ros2
    with Peer(port) as peer:
        peer.hear("fognav/test/speed_mask", "nav_msgs/msg/OccupancyGrid", GRID)

        def slow() -> float:
            """The share of the floor with a limit as in the mode DEGRADED; none without a mask."""
            mask = peer.mask("fognav/test/speed_mask")
            return float("nan") if mask is None else float((mask == 15).mean())

        await until(lambda: slow() < 1.0, "most of the floor has no limit", lambda: fog.log("fog_bridges")[-2000:])
        fog.kill("map_service")
        await until(lambda: slow() == 1.0, "the floor is slow")
        fog.start("map_service")
        await until(lambda: slow() < 1.0, "most of the floor has no limit")
