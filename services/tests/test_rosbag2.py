"""A recording becomes a rosbag2 that readers of others open."""

import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from typer.testing import CliRunner

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, HazardArea, RobotObstacles, RobotPath, RobotPose, RobotState, View
from fog_runtime.record import Recorder
from fognav.__main__ import app

BEGIN_NS = 1_795_000_000_000_000_000
POSE = RobotPose(
    x=2.0, y=1.0, theta=np.pi / 2, covariance=[0.01] * 9, v=0.0, w=0.0, radius=0.17, height=0.2, stamp=1_795_000_000.25
)
HAZARD = HazardArea(
    hazard=AreaHazard(area="hall", state="blocked", severity=3, penalty=254, since=1.0, seq=1, epoch=1, cause="a box"),
    polygon=[(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)],
)  # fmt: skip


def recorded(file):
    """Record one message of each kind, a tenth of a second after the other."""
    robot = {"robot": "r-1"}
    told = [
        (ch.HAZARD, {"area": "hall"}, HAZARD),
        (ch.ROBOT_POSE, robot, POSE),
        (ch.ROBOT_PATH, robot, RobotPath(
            plan_id=1, planner_epoch=1, goal_id="g", points=[(0.0, 0.0), (1.0, 0.0)], map_epoch=1, map_seq=1,
            released_length=1.0)),
        (ch.ROBOT_STATE, robot, RobotState(
            mode="HOLD", reasons=[], enabled=False, battery=0.5, goal_id=None, map_epoch=0, map_seq=0, plan_id=None)),
        (ch.ROBOT_OBSTACLES, robot, RobotObstacles(
            points=[], stamp=POSE.stamp, ttl=1.0, view=View(x=2.0, y=1.0, reach=bytes([20, 0] * 90)))),
        (ch.BRIDGE_AVAILABILITY, {}, "online"),
    ]  # fmt: skip
    with Recorder(file, site="test") as recorder:
        for number, (channel, ids, message) in enumerate(told):
            recorder.write(channel, ids, message, BEGIN_NS + number * 100_000_000)
    return file


def test_recording_opens_in_a_reader_of_others_with_a_schema_for_each_message(tmp_path):
    with recorded(tmp_path / "drive.mcap").open("rb") as file:
        found = [(schema, channel, json.loads(message.data)) for schema, channel, message in
                 make_reader(file).iter_messages()]  # fmt: skip
    assert len(found) == 6
    for schema, channel, message in found:
        described = json.loads(schema.data)
        assert (schema.encoding, channel.message_encoding, described["type"]) == ("jsonschema", "json", "object")
        assert message.keys() <= described["properties"].keys()


def test_rosbag2_has_the_robot_s_messages_and_the_hazards_as_ros_reads_them(tmp_path):
    bag = tmp_path / "bag"
    done = CliRunner().invoke(app, ["rosbag", str(recorded(tmp_path / "drive.mcap")), str(bag), "--json"])
    assert done.exit_code == 0, done.output
    counts = {"/fognav/hazards": 1, "/r_1/battery_state": 1, "/r_1/plan": 1, "/r_1/pose": 1, "/r_1/scan": 1, "/tf": 2}
    assert json.loads(done.stdout)["messages"] == counts
    (file,) = bag.glob("*.mcap")
    told, times = {}, {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            told.setdefault(channel.topic, []).append(decoded)
            times[channel.topic] = message.log_time
    assert {topic: len(messages) for topic, messages in told.items()} == counts
    (pose,) = told["/r_1/pose"]
    assert times["/r_1/pose"] == BEGIN_NS + 100_000_000
    assert (pose.header.stamp.sec, pose.header.frame_id) == (1_795_000_000, "map")
    assert (pose.pose.pose.position.x, pose.pose.covariance[35]) == (2.0, 0.01)
    assert [each.transforms[0].child_frame_id for each in told["/tf"]] == ["r_1/base_footprint", "r_1/view"]
    assert told["/r_1/scan"][0].ranges[0] == pytest.approx(1.0)
    assert told["/r_1/battery_state"][0].percentage == 0.5
    assert [each.pose.position.x for each in told["/r_1/plan"][0].poses] == [0.0, 1.0]
    assert "hall: blocked" in [marker.text for marker in told["/fognav/hazards"][0].markers]
    with Reader(bag) as reader:
        assert (reader.message_count, reader.duration) == (7, 400_000_001)


def test_folder_that_is_there_and_file_that_is_no_recording_are_refused_with_the_remedy(tmp_path):
    (tmp_path / "bag").mkdir()
    for file, folder, words in (
        (recorded(tmp_path / "drive.mcap"), "bag", "Name a new folder"),
        (__file__, "other", "is not an MCAP file"),
    ):
        done = CliRunner().invoke(app, ["rosbag", str(file), str(tmp_path / folder)])
        assert (done.exit_code, words in " ".join(done.output.split())) == (2, True), done.output
