"""Robots of ROS 2 by DDS: the other side is Cyclone DDS with its own serializer; Fast DDS and dora-rs, if installed."""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from fog_bridges.floor import REFUSED
from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.advice import GOAL_TYPE
from fog_bridges.ros2.bridge import GOAL_MAX_AGE_S, MAP_TYPE
from fog_bridges.ros2.wire import Topic
from fog_contracts.grid import GridGeometry
from fog_runtime.clock import SystemClock

dds = pytest.importorskip("fog_bridges.ros2.dds", reason="on x86-64: requirements/fog-bridges.txt")
pytestmark = pytest.mark.live

DOMAIN = 20 + os.getpid() % 80
"""Of these tests alone."""
LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>
<Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
MASK = Topic("fognav/test/keepout_mask", MAP_TYPE, latched=True)
GOAL = Topic("r1/goal_pose", GOAL_TYPE)
CLOCK = SystemClock()


@pytest.fixture(scope="module")
def wire():
    """DDS within this computer, apart from whatever else runs here."""
    before = os.environ.get("CYCLONEDDS_URI")
    os.environ["CYCLONEDDS_URI"] = LOOPBACK.replace("\n", "")
    yield dds.DdsWire(DOMAIN)
    del os.environ["CYCLONEDDS_URI"]
    if before is not None:
        os.environ["CYCLONEDDS_URI"] = before


@pytest.fixture(scope="module")
def fast_dds(tmp_path_factory) -> list[str]:
    """The command of a robot on Fast DDS."""
    if not Path("/usr/include/fastdds/dds/topic/TopicDataType.hpp").exists() or shutil.which("g++") is None:
        pytest.skip("needs Fast DDS 2 and a compiler: apt-get install libfastrtps-dev libfastcdr-dev g++")
    program = tmp_path_factory.mktemp("fast") / "robot"
    source = Path(__file__).with_name("fast_dds_peer.cpp")
    subprocess.run(
        ["g++", "-std=c++17", "-Wall", "-Werror", source, "-o", program, "-lfastrtps", "-lfastcdr"], check=True
    )
    return [str(program)]


@pytest.fixture
def dora(tmp_path) -> list[str]:
    """The command of a robot on dora-rs."""
    python = os.environ.get("FOGNAV_ROS2_DORA")
    if python is None:
        pytest.skip("set FOGNAV_ROS2_DORA to a Python that has dora-rs: pip install dora-rs==1.1.0 pyarrow rosbags")
    return [python, str(Path(__file__).with_name("dora_peer.py")), str(tmp_path)]


CYCLONE = [sys.executable, str(Path(__file__).with_name("dds_peer.py"))]


@contextlib.asynccontextmanager
async def robot(command=CYCLONE, domain=DOMAIN):
    """Run a robot of others; yield it."""
    process = await asyncio.create_subprocess_exec(*command, str(domain), "test", "r1", stdout=asyncio.subprocess.PIPE)
    try:
        yield process
    finally:
        process.kill()
        await process.communicate()


def mask(rows: int, width: int = 12, height: int = 10):
    values = np.zeros((height, width), np.int8)
    values[:rows] = 100
    return ros.grid(values, GridGeometry(width, height, 0.05, 0.0, 0.0), 1.0)


def goal(frame: str):
    header = ros.header(1.0, frame)
    return ros.message("geometry_msgs/msg/PoseStamped", header=header, pose=ros.pose(4.0, 3.0, 0.0))


def refusals() -> Counter[str]:
    """How many messages of ROS were refused so far, by reason."""
    values = (each for metric in REFUSED.collect() for each in metric.samples if each.name.endswith("_total"))
    return Counter({each.labels["reason"]: int(each.value) for each in values})


@pytest.mark.parametrize("middleware", ["cyclone", "fast_dds", "dora"])
async def test_robot_that_joins_late_is_given_the_mask_and_its_goal_arrives(
    wire, until, request, monkeypatch, middleware
):
    command, domain = CYCLONE if middleware == "cyclone" else request.getfixturevalue(middleware), DOMAIN
    if middleware == "dora":  # it finds others by multicast only
        monkeypatch.delenv("CYCLONEDDS_URI")
        domain += 100
        wire = dds.DdsWire(domain)
    node, goals = await wire.opened("fognav_test", CLOCK), []
    try:
        node.publish(MASK, mask(2), CLOCK.stamp())
        node.subscribe(GOAL, goals.append, GOAL_MAX_AGE_S)
        async with robot(command, domain) as peer:
            heard = json.loads(await asyncio.wait_for(peer.stdout.readline(), 60.0))
            assert heard == {"frame": "map", "size": [12, 10], "blocked": 24}
            await until(lambda: goals, "the goal has arrived")
        assert (goals[0].pose.position.x, goals[0].pose.position.y, goals[0].header.frame_id) == (4.0, 3.0, "map")
    finally:
        node.close()


async def test_robot_that_has_stopped_keeps_no_mask_from_the_others(wire):
    node = await wire.opened("fognav_test", CLOCK)
    try:
        async with robot() as stopped, robot() as other:
            node.publish(MASK, mask(1), CLOCK.stamp())
            for each in (stopped, other):
                assert json.loads(await asyncio.wait_for(each.stdout.readline(), 60.0))["blocked"] == 12
            stopped.send_signal(signal.SIGSTOP)
            for rows in range(300, 310):  # of a size that does not fit into what the kernel keeps for a socket
                node.publish(MASK, mask(rows, 1000, 600), CLOCK.stamp())
                await asyncio.sleep(0)
            async with asyncio.timeout(60.0):
                while json.loads(await other.stdout.readline())["blocked"] != 309_000:
                    pass
            stopped.send_signal(signal.SIGCONT)
    finally:
        node.close()


async def test_message_that_is_too_long_is_counted_and_the_next_one_read(wire, until):
    """What is malformed Cyclone takes from nobody: neither its writer nor its reader."""
    node, other = [await wire.opened(name, CLOCK) for name in ("fognav_test", "other")]
    before, taken = refusals()["too_long"], []
    try:
        node.subscribe(GOAL, taken.append)

        def counted() -> bool:
            other.publish(GOAL, goal("m" * 100_000), CLOCK.stamp())
            return refusals()["too_long"] > before

        await until(counted, "it is counted")
        other.publish(GOAL, goal("map"), CLOCK.stamp())
        await until(lambda: [each.header.frame_id for each in taken] == ["map"], "the next one is read")
    finally:
        node.close()
        other.close()


@pytest.mark.parametrize(
    ("hash_", "age", "reason"), [("RIHS01_0", 0.0, "type_hash"), (None, GOAL_MAX_AGE_S + 1.0, "old")]
)
async def test_message_of_another_definition_or_from_long_ago_is_refused(wire, until, monkeypatch, hash_, age, reason):
    node, other = [await wire.opened(name, CLOCK) for name in ("fognav_test", "other")]
    before, taken = refusals()[reason], []
    try:
        node.subscribe(GOAL, taken.append, GOAL_MAX_AGE_S)
        with monkeypatch.context() as changed:
            if hash_ is not None:
                changed.setattr(dds, "type_hash", lambda _: hash_)
            other.publish(GOAL, goal("map"), CLOCK.stamp() - age)

        def refused() -> bool:
            other.publish(GOAL, goal("map"), CLOCK.stamp() - age)
            return refusals()[reason] > before

        await until(refused, "it is refused")
        assert taken == []
    finally:
        node.close()
        other.close()


def test_configuration_of_no_use_is_named():
    words = "from fog_bridges.ros2.dds import DdsWire; DdsWire(78)"
    done = subprocess.run(
        [sys.executable, "-c", words], env=os.environ | {"CYCLONEDDS_URI": "<CycloneDDS><Nothing/></CycloneDDS>"},
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "DDS can't be used in domain 78" in done.stderr
    assert "CYCLONEDDS_URI: '<CycloneDDS><Nothing/>" in done.stderr
