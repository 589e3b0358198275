"""What tests of the bridges have in common."""

import json

import pytest
import zenoh

from fog_supervisor import net


@pytest.fixture
def ros_router():
    """A router as ROS 2 users start one; yields its port."""
    port = net.free_port()
    config = zenoh.Config()
    for key, value in (("mode", "router"), ("listen/endpoints", [f"tcp/127.0.0.1:{port}"]),
                       ("scouting/multicast/enabled", False)):  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        yield port
