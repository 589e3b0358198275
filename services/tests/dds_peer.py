"""A robot of ROS 2 on DDS that hears a keepout mask and sends a goal, by Cyclone DDS's own serializer.

Usage: dds_peer.py DOMAIN SITE ROBOT. Prints what it heard of each mask as a line of JSON.
"""

import json
import sys
import time
from dataclasses import dataclass

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.idl.annotations import final
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@final
@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: idl.int32
    nanosec: idl.uint32


@final
@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@final
@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: idl.float64
    y: idl.float64
    z: idl.float64


@final
@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: idl.float64
    y: idl.float64
    z: idl.float64
    w: idl.float64


@final
@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@final
@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@final
@dataclass
class MapMetaData(IdlStruct, typename="nav_msgs::msg::dds_::MapMetaData_"):
    map_load_time: Time
    resolution: idl.float32
    width: idl.uint32
    height: idl.uint32
    origin: Pose


@final
@dataclass
class OccupancyGrid(IdlStruct, typename="nav_msgs::msg::dds_::OccupancyGrid_"):
    header: Header
    info: MapMetaData
    data: idl.sequence[idl.int8]


def main() -> None:
    domain, site, robot = int(sys.argv[1]), *sys.argv[2:4]
    participant = DomainParticipant(domain)
    reliable = Policy.Reliability.Reliable(max_blocking_time=duration(seconds=1))
    latched = Qos(reliable, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))
    masks = DataReader(participant, Topic(participant, f"rt/fognav/{site}/keepout_mask", OccupancyGrid), qos=latched)
    goals = DataWriter(
        participant, Topic(participant, f"rt/{robot}/goal_pose", PoseStamped),
        qos=Qos(reliable, Policy.Durability.Volatile, Policy.History.KeepLast(10)),
    )  # fmt: skip
    while True:
        for mask in masks.take(10):
            told = {"frame": mask.header.frame_id, "size": [mask.info.width, mask.info.height]}
            sys.stdout.write(json.dumps(told | {"blocked": sum(value == 100 for value in mask.data)}) + "\n")
            sys.stdout.flush()
        at = Header(Time(int(time.time()), 0), "map")
        goals.write(PoseStamped(at, Pose(Point(4.0, 3.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))))
        time.sleep(0.2)


if __name__ == "__main__":
    main()
