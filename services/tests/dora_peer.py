"""A robot of ROS 2 on DDS that hears a keepout mask and sends a goal: dora-rs, whose DDS is RustDDS.

Usage: dora_peer.py FOLDER DOMAIN SITE ROBOT. FOLDER gets the definitions of messages. Prints what it heard of each mask
as a line of JSON. It runs in a Python that has dora-rs, pyarrow and rosbags.
"""

import json
import sys
import time
from pathlib import Path

import dora
import pyarrow as pa
from rosbags.typesys import Stores, get_typestore


def write_definitions(folder: Path) -> None:
    """Write each message as dora wants it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind in ("nav_msgs/msg/OccupancyGrid", "geometry_msgs/msg/PoseStamped"):
        first, *others = store.generate_msgdef(kind, ros_version=2)[0].split("=" * 80 + "\n")
        for name, text in ({kind: first} | dict(each.removeprefix("MSG: ").split("\n", 1) for each in others)).items():
            package, *_, short = name.split("/")
            for each in ("msg", "srv", "action"):
                (folder / package / each).mkdir(parents=True, exist_ok=True)
            (folder / package / "package.xml").write_text(f"<package><name>{package}</name></package>")
            (folder / package / "msg" / f"{short}.msg").write_text(text)


def main() -> None:
    folder, (domain, site, robot) = Path(sys.argv[1]), sys.argv[2:5]
    write_definitions(folder)
    context = dora.Ros2Context(ros_paths=[str(folder)], domain_id=int(domain))
    node = context.new_node("peer", "/", dora.Ros2NodeOptions(rosout=False))
    latched = dora.Ros2QosPolicies(durability=dora.Ros2Durability.TransientLocal, reliable=True, keep_last=1)
    masks = node.create_subscription(
        node.create_topic(f"/fognav/{site}/keepout_mask", "nav_msgs/OccupancyGrid", latched)
    )
    plain = dora.Ros2QosPolicies(reliable=True, keep_last=10)
    goals = node.create_publisher(node.create_topic(f"/{robot}/goal_pose", "geometry_msgs/PoseStamped", plain))
    stamp = pa.struct([("sec", pa.int32()), ("nanosec", pa.uint32())])
    position, orientation = (pa.struct([(name, pa.float64()) for name in names]) for names in ("xyz", "xyzw"))
    kind = pa.struct([
        ("header", pa.struct([("stamp", stamp), ("frame_id", pa.string())])),
        ("pose", pa.struct([("position", position), ("orientation", orientation)])),
    ])  # fmt: skip
    pose = {"position": {"x": 4.0, "y": 3.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    while True:
        if (told := masks.next()) is not None:
            grid = told[0].as_py()
            size, blocked = [grid["info"]["width"], grid["info"]["height"]], sum(each == 100 for each in grid["data"])
            sys.stdout.write(json.dumps({"frame": grid["header"]["frame_id"], "size": size, "blocked": blocked}) + "\n")
            sys.stdout.flush()
        header = {"stamp": {"sec": int(time.time()), "nanosec": 0}, "frame_id": "map"}
        goals.publish(pa.array([{"header": header, "pose": pose}], type=kind))
        time.sleep(0.2)


if __name__ == "__main__":
    main()
