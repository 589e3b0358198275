""""""

from __future__ import annotations

import math
import re

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts import channels
from fog_contracts import channels as ch
from fog_contracts.channels import (
    CHANNELS,
    DURABILITIES,
    MAP_DELTA,
    NODE_READING,
    ROBOT_POSE,
    ROLES,
    THESIS_AREA,
    THESIS_WSN,
)
from fog_contracts.codec import encode
from fog_contracts.commands import signed_command
from fog_contracts.messages import (
    STOPS_MAX,
    VIEW_SECTORS,
    FloorGoal,
    HandOver,
    Pose,
    RobotObstacles,
    RobotPath,
    RobotRelease,
    Stop,
    Tour,
    UnknownPolicy,
    View,
)

ids = st.from_regex(r"[a-z0-9][a-z0-9-]{0,31}", fullmatch=True)
numbers = st.from_regex(r"[0-9]{1,4}", fullmatch=True)


def matches(pattern, key):
    """Whether a key matches a pattern with MQTT's or zenoh's one-level wildcards."""
    parts, levels = pattern.split("/"), key.split("/")
    return len(parts) == len(levels) and all(p in {"+", "*", k} for p, k in zip(parts, levels, strict=True))


@given(data=st.data(), channel=st.sampled_from(list(CHANNELS.values())))
def test_matching_a_key_returns_the_ids_that_it_was_made_from(data, channel):
    drawn = {"number": numbers, "robot_device": ids.map("robot_{}".format)}
    channel_ids = {name: data.draw(drawn.get(name, ids)) for name in channel.fields}
    key = channel.key(**channel_ids)
    assert channel.match(key) == channel_ids
    if "number" not in channel_ids:
        assert matches(channel.pattern(), key)
        some = dict(list(channel_ids.items())[:1])
        assert matches(channel.pattern(**some), key)


@given(key=st.text(max_size=60))
def test_a_key_belongs_to_at_most_one_channel(key):
    for transport in ("mqtt", "zenoh"):
        assert sum(c.transport == transport and c.match(key) is not None for c in CHANNELS.values()) <= 1


@pytest.mark.parametrize("bad", ["", "A", "a/b", "+", "#", "*", "**", "a b", "a\n", "-a", "x" * 33, "é"])
def test_malformed_id_is_refused_in_a_key_and_does_not_match(bad):
    with pytest.raises(ValueError, match="node"):
        NODE_READING.key(site="lab", node=bad)
    assert NODE_READING.match(f"fog/v1/lab/nodes/{bad}/reading") is None
    assert NODE_READING.match(f"fog/v1/{bad}/nodes/n1/reading") is None


def test_missing_and_unknown_ids_are_refused_by_name():
    with pytest.raises(ValueError, match=re.escape("['robot', 'site']")):
        ROBOT_POSE.key(robot="r1")
    with pytest.raises(ValueError, match="colour"):
        MAP_DELTA.key(site="lab", colour="red")


def test_thesis_topics_are_those_of_the_thesis():
    assert THESIS_AREA.key(number="3") == "area 3"
    assert THESIS_WSN.key() == "WSN"
    with pytest.raises(ValueError, match="wildcard"):
        THESIS_AREA.pattern()


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=lambda c: c.name)
def test_channel_row_is_consistent(channel):
    assert CHANNELS[channel.name] is channel is getattr(channels, channel.name.upper())
    assert channel.publishers
    assert channel.subscribers
    assert {*channel.publishers, *channel.subscribers} <= set(ROLES)
    assert channel.durability in DURABILITIES
    assert channel.message or channel.reply or channel.about, "the row does not describe its payload"
    assert (channel.reply is None) == (channel.reply_limit == 0) == (channel.kind != "query")
    assert (channel.limit > 0) == (channel.message is not None or channel.encoding == "text")
    assert bool(channel.message) == (channel.encoding != "text") or channel.kind != "pub"
    assert all(len(value) <= channel.limit for value in channel.values)
    if channel.transport == "zenoh":
        assert channel.template.startswith("fog/{site}/")
        assert channel.encoding == "msgpack"
        assert not channel.retained
        assert channel.qos == 0
    else:
        assert channel.kind == "pub"
        assert channel.durability != "recovered"
        of_others = channel.template.startswith("homeassistant/")  # their topics, in which a site is only a name
        assert channel.template.startswith("fog/v1/{site}/") or of_others or "site" not in channel.fields
        assert channel.qos == 1 or not channel.retained, "a lost retained message stays lost"
    if channel.rate_hz is not None:
        assert channel.period_s == pytest.approx(1 / channel.rate_hz)
        assert channel.max_age_s > channel.period_s, "stale between two messages of the normal rate"
        assert channel.max_age_s > channel.idle_period_s >= channel.period_s
    else:
        assert channel.period_s == math.inf


def test_every_channel_of_the_module_is_in_the_table_once():
    rows = [value for value in vars(channels).values() if isinstance(value, channels.Channel)]
    assert {id(row) for row in rows} == {id(row) for row in CHANNELS.values()}
    assert len({(row.transport, row.template) for row in rows}) == len(rows) == len(CHANNELS)


def test_every_role_publishes_or_subscribes():
    used = {role for row in CHANNELS.values() for role in (*row.publishers, *row.subscribers)}
    assert used | {"recorder"} == set(ROLES)


def test_default_silence_limit_of_an_area_is_the_maximum_age_of_readings():
    assert NODE_READING.max_age_s == UnknownPolicy().silent_after_s


LARGEST = 2**53


def test_a_report_of_obstacles_is_a_quarter_of_a_kilobyte_with_a_whole_view_and_20_bytes_more_per_point() -> None:
    view = View(x=12.34, y=56.78, reach=bytes(range(VIEW_SECTORS)))
    without = RobotObstacles(points=[], stamp=1.8e9, ttl=10.0, view=view)
    points = msgspec.structs.replace(without, points=[(0.05 + i / 10, 3.05) for i in range(10)])
    assert len(encode(ch.ROBOT_OBSTACLES, without)) <= 256
    assert len(encode(ch.ROBOT_OBSTACLES, points)) <= 256 + 10 * 20


def test_a_release_is_below_120_bytes_with_the_largest_numbers() -> None:
    release = RobotRelease(
        plan_id=2**32 - 1, planner_epoch=LARGEST, released_length=1234.5678, map_epoch=LARGEST, map_seq=LARGEST,
        sent=(2**32 - 1, 1e6 / 3),
    )  # fmt: skip
    assert len(encode(ch.ROBOT_RELEASE, release)) < 120
    assert len(encode(ch.ROBOT_RELEASE, msgspec.structs.replace(release, plan_id=LARGEST))) <= ch.ROBOT_RELEASE.limit


def test_a_robot_can_be_handed_over_with_the_longest_mission() -> None:
    longest = Stop(pose=Pose(x=1 / 3, y=2 / 3, theta=0.3), place="p" * 32, floor="f" * 32)
    tour = Tour(
        id="t" * 16, leg=99, reached=(longest,) * (STOPS_MAX - 1), ahead=(longest,), who="w" * 100, deadline=1e9 / 3
    )
    given = HandOver(
        origin="o" * 32, floor="f" * 32, epoch=LARGEST, lift="l" * 32, goal=FloorGoal(place="p" * 32), who="w" * 100,
        id="i" * 16, mission=tour,
    )  # fmt: skip
    command = signed_command(
        "hand_over", robot="r" * 32, operator="w" * 100, nonce="n" * 32, boot="b" * 16, issued_at=1e9 / 3,
        key=b"k" * 32, given=given,
    )  # fmt: skip
    assert len(encode(ch.ROBOT_COMMAND, command)) > 1024


PATH = RobotPath(
    plan_id=5, planner_epoch=3, goal_id="g", points=[(0.0, 0.0), (9.0, 0.0)], map_epoch=7, map_seq=1,
    released_length=2.0,
)  # fmt: skip
RELEASE = RobotRelease(plan_id=5, planner_epoch=3, released_length=4.0, map_epoch=8, map_seq=2)


def test_a_release_of_a_path_changes_its_released_length_and_map_version_only() -> None:
    after = PATH.after(RELEASE)
    assert (after.released_length, after.map_epoch, after.map_seq) == (4.0, 8, 2)
    assert msgspec.structs.replace(after, released_length=2.0, map_epoch=7, map_seq=1) == PATH


@pytest.mark.parametrize("other", [{"plan_id": 6}, {"plan_id": 4}, {"planner_epoch": 4}])
def test_a_release_of_another_path_changes_nothing(other: dict[str, int]) -> None:
    assert PATH.after(msgspec.structs.replace(RELEASE, **other)) is PATH
