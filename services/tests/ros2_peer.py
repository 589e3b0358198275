"""A node of ROS 2 by `zenoh-ros2-sdk`, whose protocol code is not ours: hears a mask, then sends a goal.

    python ros2_peer.py ROUTER_PORT DOMAIN SITE ROBOT FOLDER

It prints what it heard as JSON. FOLDER gets the definitions of the messages, which the package would fetch otherwise.
"""

import json
import sys
import time
from pathlib import Path

from rosbags.typesys import Stores, get_typestore
from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber
from zenoh_ros2_sdk.message_registry import get_registry

port, domain, site, robot, folder = int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:6]
store = get_typestore(Stores.ROS2_JAZZY)
for kind in ("nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/MapMetaData", "std_msgs/msg/Header", "geometry_msgs/msg/Pose",
             "builtin_interfaces/msg/Time", "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion",
             "geometry_msgs/msg/PoseStamped"):  # fmt: skip
    package, _, name = kind.split("/")
    file = Path(folder) / package / "msg" / f"{name}.msg"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(store.generate_msgdef(kind, ros_version=2)[0].partition("=" * 80)[0])
get_registry(folder)
heard: list = []
subscriber = ROS2Subscriber(
    f"/fognav/{site}/keepout_mask", "nav_msgs/msg/OccupancyGrid", heard.append, domain_id=domain, router_port=port
)
end = time.monotonic() + 60.0
while not heard:
    assert time.monotonic() < end, "no mask arrived"
    time.sleep(0.05)
mask = heard[-1]
publisher = ROS2Publisher(f"/{robot}/goal_pose", "geometry_msgs/msg/PoseStamped", domain_id=domain, router_port=port)
point = store.types["geometry_msgs/msg/Point"](x=4.0, y=3.0, z=0.0)
turned = store.types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
stamp = store.types["builtin_interfaces/msg/Time"](sec=1, nanosec=0)
publisher.publish(
    header=store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="map"),
    pose=store.types["geometry_msgs/msg/Pose"](position=point, orientation=turned),
)
told = {"size": [mask.info.width, mask.info.height], "blocked": int((mask.data == 100).sum())}
sys.stdout.write(json.dumps(told))
sys.stdout.flush()
time.sleep(1.0)  # a session that ends at once takes its message with it
publisher.close()
subscriber.close()
subscriber.session_mgr.session.close()
