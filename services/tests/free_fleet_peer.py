"""free_fleet's own adapter for a robot of Nav2, with mocks for ROS and RMF.

`free_fleet_peer.py CHECKOUT ENDPOINT ROBOT`; a line of its input is `navigate X` (to X, 3 m), `update` (it looks what
became of that), or `stop`. It answers each by a line: how often it told RMF that a way is finished, and that it has to
plan anew.
"""

import importlib.abc
import importlib.machinery
import json
import sys
from unittest.mock import MagicMock

import zenoh

CHECKOUT, ENDPOINT, ROBOT = sys.argv[1:]
MOCKED = ("builtin_interfaces", "geometry_msgs", "rclpy", "rmf_adapter", "tf_transformations")


class Mocks(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds a mock for each module of ROS and RMF."""

    def find_spec(self, fullname, _path, _target=None):
        if fullname.partition(".")[0] in MOCKED:
            return importlib.machinery.ModuleSpec(fullname, self, is_package=True)
        return None

    def create_module(self, _spec):
        return MagicMock(__path__=[])

    def exec_module(self, module): ...


sys.meta_path.insert(0, Mocks())
sys.path[:0] = [f"{CHECKOUT}/free_fleet", f"{CHECKOUT}/free_fleet_adapter"]
nav2 = importlib.import_module("free_fleet_adapter.nav2_robot_adapter")
nav2.quaternion_from_euler = lambda *_: (0.0, 0.0, 0.0, 1.0)

config = zenoh.Config()
for key, value in (("mode", "client"), ("connect/endpoints", [ENDPOINT]), ("scouting/multicast/enabled", False)):
    config.insert_json5(key, json.dumps(value))
adapter = nav2.Nav2RobotAdapter.__new__(nav2.Nav2RobotAdapter)  # its constructor waits for RMF
adapter.name, adapter.map_name, adapter.map_frame, adapter.service_call_timeout_sec = ROBOT, "L1", "map", 10.0
adapter.node, adapter.update_handle = MagicMock(), MagicMock()
adapter.node.get_clock().now().seconds_nanoseconds.return_value = (100, 0)
adapter.exec_handle = adapter.nav_issue_ticket = None
adapter.replan_counts = 0
execution = MagicMock()
with zenoh.open(config) as adapter.zenoh_session:
    for line in sys.stdin:
        order, *where = line.split()
        if order == "navigate":
            adapter.navigate(MagicMock(map="L1", position=[float(where[0]), 3.0, 0.0]), execution)
        elif order == "update":
            adapter.update(MagicMock())
        else:
            adapter._request_stop(adapter.exec_handle)
        sys.stdout.write(f"{execution.finished.call_count} {adapter.update_handle.more().replan.call_count}\n")
        sys.stdout.flush()
