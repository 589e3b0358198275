"""The demo's robots of others: what they read of others' messages, and how they are led round what these block."""

import math
import struct

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fognav_sim import guest
from fognav_sim.guest import Grid, Guest, LaneGuest, lattice, plan
from fognav_sim.guest_vda5050 import ZoneSets

STORE = get_typestore(Stores.ROS2_JAZZY)


def grid(cells: np.ndarray) -> Grid:
    return Grid(cells.astype(np.int8), 0.05, 0.0, 0.0)


def house() -> tuple[np.ndarray, np.ndarray]:
    """A floor of 12 x 8 m whose wall has two doors, and a mask that closes the nearer one."""
    floor, mask = np.zeros((160, 240), np.int8), np.zeros((160, 240), np.int8)
    floor[[0, -1]] = floor[:, [0, -1]] = 100
    floor[:, 120:124] = 100
    floor[20:50, 120:124] = floor[110:140, 120:124] = 0
    mask[15:55, 116:128] = 100
    return floor, mask


def test_grid_and_pose_are_read_and_written_as_others_do():
    kinds = STORE.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="map")
    where = kinds["geometry_msgs/msg/Pose"](
        position=kinds["geometry_msgs/msg/Point"](x=-1.5, y=2.5, z=0.0),
        orientation=kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    info = kinds["nav_msgs/msg/MapMetaData"](map_load_time=stamp, resolution=0.05, width=3, height=2, origin=where)
    cells = np.array([0, 100, -1, 1, 2, 3], np.int8)
    sent = kinds["nav_msgs/msg/OccupancyGrid"](header=header, info=info, data=cells)
    read = Grid.decoded(bytes(STORE.serialize_cdr(sent, "nav_msgs/msg/OccupancyGrid")))
    assert (read.cells.tolist(), read.x, read.y) == ([[0, 100, -1], [1, 2, 3]], -1.5, 2.5)
    assert read.resolution == pytest.approx(0.05)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    data = guest._encoded_pose(3.0, 4.0, math.pi / 2, 7.5)
    told = STORE.deserialize_cdr(data, kind)
    assert (told.pose.pose.position.y, told.header.frame_id, told.header.stamp.nanosec) == (4.0, "map", 500_000_000)
    assert guest._pose_of(bytes(STORE.serialize_cdr(told, kind))) == (3.0, 4.0)
    assert struct.calcsize("<43d") == 43 * 8


def test_guest_is_led_through_the_other_door_as_soon_as_a_mask_closes_the_nearer_one():
    floor, mask = house()
    robot = Guest((2.0, 1.5), (10.0, 1.5))
    robot.floor, robot.host = grid(floor), (8.0, 7.0)
    robot.on_keepout(grid(np.zeros_like(mask)))
    for step in range(100):
        robot.step(0.1, 0.1 * step)
    assert max(y for _, y in robot.plans[0]) < 3.0, "its own way leads through the nearer door"
    robot.on_keepout(grid(mask))
    for step in range(100, 1500):
        robot.step(0.1, 0.1 * step)
    assert robot.has_arrived
    assert len(robot.plans) == 2
    entered = [(x, y) for _, x, y in robot.trail if mask[int(y / 0.05), int(x / 0.05)]]
    assert entered == []


def lanes(closed=(), opened=(), fleet: str = "guest") -> bytes:
    """A LaneRequest as ROS 2 sends it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "rmf_fleet_msgs/msg/LaneRequest"
    store.register(get_types_from_msg("string fleet_name\nuint64[] open_lanes\nuint64[] close_lanes\n", kind))
    numbers = (np.array(sorted(each), np.uint64) for each in (opened, closed))
    return bytes(store.serialize_cdr(store.types[kind](fleet, *numbers), kind))


def test_guest_of_open_rmf_is_led_through_the_other_door_by_lanes_that_are_closed():
    floor, mask = house()
    graph = lattice(grid(floor))
    robot = LaneGuest((2.0, 1.5), (10.0, 1.5), graph, "guest")
    robot.floor, robot.host = grid(floor), (8.0, 7.0)
    ends = [[graph["vertices"][n][:2] for n in lane[:2]] for lane in graph["lanes"]]
    closed = {
        n for n, lane in enumerate(ends)
        if any(mask[int(y / 0.05), int(x / 0.05)] for x, y in (*lane, np.mean(lane, axis=0)))
    }  # fmt: skip
    robot.on_lanes(lanes())
    for step in range(100):
        robot.step(0.1, 0.1 * step)
    assert max(y for _, y in robot.plans[0]) < 3.0, "its own way leads through the nearer door"
    robot.on_lanes(lanes(closed, fleet="another"))
    assert robot.masks == 1, "this is for others"
    robot.on_lanes(lanes(closed))
    for step in range(100, 1700):
        robot.step(0.1, 0.1 * step)
    assert robot.has_arrived
    assert [(x, y) for _, x, y in robot.trail if mask[int(y / 0.05), int(x / 0.05)]] == []
    robot.on_lanes(lanes(opened=closed))
    assert max(y for _, y in robot._way_from((2.0, 1.5))) < 3.0


def test_guest_of_another_maker_uses_the_zone_set_that_is_enabled():
    floor, mask = house()
    robot = Guest((2.0, 1.5), (10.0, 1.5))
    robot.floor = grid(floor)
    sets = ZoneSets(robot, "lab")
    door = [{"x": x, "y": y} for x, y in ((5.8, 0.75), (6.4, 0.75), (6.4, 2.75), (5.8, 2.75))]
    slow = {"zoneType": "SPEED_LIMIT", "vertices": door, "maximumSpeed": 0.15}
    for name, zones in (("first", []), ("second", [{"zoneType": "BLOCKED", "vertices": door}, slow])):
        sets.on_zone_set({"zoneSet": {"mapId": "lab", "zoneSetId": name, "zones": zones}})
    sets.on_zone_set({"zoneSet": {"mapId": "elsewhere", "zoneSetId": "third", "zones": []}})

    def act(kind: str, name: str) -> None:
        parameters = [{"key": "zoneSetId", "value": name}]
        sets.on_actions(
            {"actions": [{"actionId": f"{kind} {name}", "actionType": kind, "actionParameters": parameters}]}
        )

    for kind, name in (("enableZoneSet", "second"), ("deleteZoneSet", "first"), ("enableZoneSet", "third")):
        act(kind, name)
    assert robot.keepout is not None
    assert np.array_equal(robot.keepout.cells == 100, mask == 100)
    assert robot.speed is not None
    assert robot.speed.at((6.0, 1.0)) == 15
    state = sets.state()
    assert [(each["zoneSetId"], each["zoneSetStatus"]) for each in state["zoneSets"]] == [("second", "ENABLED")]
    assert [each["actionStatus"] for each in state["instantActionStates"]] == ["FINISHED", "FINISHED", "FAILED"]


def test_guest_stands_behind_the_other_robot_and_without_a_way():
    floor, mask = house()
    robot = Guest((2.0, 1.5), (10.0, 1.5))
    robot.floor, robot.host = grid(floor), (2.0, 4.0)
    robot.on_keepout(grid(np.zeros_like(mask)))
    robot.step(0.1, 0.1)
    robot.host = (3.2, 1.5)
    before = robot.at
    robot.step(0.1, 0.2)
    assert robot.at == before
    mask[:, 116:128] = 100
    assert plan(grid(floor), grid(mask), (2.0, 1.5), (10.0, 1.5)) == []
