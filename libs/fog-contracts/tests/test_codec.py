import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_contracts.codec import ContractError, decode, decode_text, encode

CHANNELS = [c for c in ch.CHANNELS.values() if c.message is not None]


def reading(**changes):
    good = {"seq": 1, "boot": 2, "uptime_ms": 3, "range_m": [1.5, None], "status": ["ok", "no_echo"], "state": "clear"}
    return msgspec.json.encode({**good, **changes})


def pose(**changes):
    good = {
        "x": 1.0, "y": 2.0, "theta": 0.5, "covariance": [0.0] * 9, "v": 0.1, "w": 0.0, "radius": 0.17, "height": 0.3,
        "stamp": 1.0,
    }  # fmt: skip
    return msgspec.msgpack.encode({**good, **changes})


@given(
    ranges=st.lists(st.none() | st.floats(0.01, 20.0), min_size=1, max_size=8),
    seq=st.integers(0, 2**53),
    state=st.sampled_from(["blocked", "clear", "unknown"]),
)
def test_reading_survives_the_wire(ranges, seq, state):
    status = ["no_echo" if r is None else "ok" for r in ranges]
    message = m.NodeReading(seq=seq, boot=1, uptime_ms=5, range_m=ranges, status=status, state=state)
    assert decode(ch.NODE_READING, encode(ch.NODE_READING, message), m.NodeReading) == message


def test_unknown_fields_are_ignored():
    assert decode(ch.NODE_READING, reading(colour="red"), m.NodeReading).seq == 1


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"range_m": [0.0, None]}, "range_m"),
        ({"range_m": [-1.0, None]}, "range_m"),
        ({"range_m": [20.1, None]}, "range_m"),
        ({"range_m": []}, "range_m"),
        ({"range_m": [1.0]}, "range_m has 1 entries but status has 2"),
        ({"status": ["ok", "fine"]}, "status"),
        ({"state": "maybe"}, "state"),
        ({"seq": -1}, "seq"),
        ({"seq": 2**54}, "seq"),
        ({"seq": 1.5}, "seq"),
        ({"seq": "1"}, "seq"),
        ({"rssi": 500}, "rssi"),
        ({"fw": "x" * 65}, "fw"),
    ],
)
def test_field_out_of_range_is_refused_by_name(changes, field):
    with pytest.raises(ContractError, match=field):
        decode(ch.NODE_READING, reading(**changes), m.NodeReading)


@pytest.mark.parametrize("field", ["seq", "boot", "uptime_ms", "range_m", "status", "state"])
def test_missing_field_is_refused_by_name(field):
    given_fields = msgspec.json.decode(reading())
    del given_fields[field]
    with pytest.raises(ContractError, match=field):
        decode(ch.NODE_READING, msgspec.json.encode(given_fields), m.NodeReading)


@pytest.mark.parametrize("field", ["x", "y", "theta", "v", "w", "radius", "height", "stamp"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_number_of_a_pose_can_be_nan_or_infinite(field, value):
    with pytest.raises(ContractError, match=field):
        decode(ch.ROBOT_POSE, pose(**{field: value}), m.RobotPose)


def test_no_covariance_can_be_nan():
    with pytest.raises(ContractError, match="covariance"):
        decode(ch.ROBOT_POSE, pose(covariance=[0.0] * 8 + [math.nan]), m.RobotPose)


@pytest.mark.parametrize("name", ["a1", "x" * 32, "0-0"])
def test_good_ids_pass(name):
    assert decode(ch.NODE_VALUE, value(name), m.NodeValue).kind == name


@pytest.mark.parametrize("name", ["", "-a", "A", "x" * 33, "a b", "a/b", "a\n", "a\x00", "é", "+", "#"])
def test_bad_ids_are_refused(name):
    with pytest.raises(ContractError, match="kind"):
        decode(ch.NODE_VALUE, value(name), m.NodeValue)


def value(kind):
    return msgspec.json.encode({"seq": 1, "boot": 1, "kind": kind, "value": 1.0, "unit": "C"})


@given(junk=st.binary(max_size=300), channel=st.sampled_from(CHANNELS))
def test_arbitrary_bytes_give_a_message_or_a_contract_error(junk, channel):
    try:
        message = decode(channel, junk, channel.message)
    except ContractError as error:
        assert error.channel == channel.name  # noqa: PT017  # both ends are right
    else:
        assert isinstance(message, channel.message)


@given(flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=5))
def test_damaged_messages_never_escape_the_contract(flips):
    data = bytearray(pose())
    for position, byte in flips:
        data[position % len(data)] = byte
    try:
        got = decode(ch.ROBOT_POSE, bytes(data), m.RobotPose)
    except ContractError:
        return
    assert all(math.isfinite(v) for v in (got.x, got.y, got.theta, got.v, got.w, got.stamp, *got.covariance))


@pytest.mark.parametrize("channel", [ch.AREA_DEFINITION, ch.ROBOT_STATE], ids=lambda c: c.name)
def test_endless_nesting_is_refused(channel):
    data = b'{"x":' + b"[" * 30_000 if channel.encoding == "json" else b"\x81\xa1x" + b"\x91" * 16_000
    with pytest.raises(ContractError):
        decode(channel, data, channel.message)


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda c: c.name)
def test_size_is_judged_before_the_content(channel):
    with pytest.raises(ContractError, match="over the limit"):
        decode(channel, b"\x00" * (channel.limit + 1), channel.message)


def test_encoding_refuses_the_wrong_type_and_too_much():
    with pytest.raises(ContractError, match="RobotPose"):
        encode(ch.ROBOT_POSE, m.RobotGoal(goal_id="g", pose=None))
    with pytest.raises(ContractError, match="over the limit"):
        encode(ch.NODE_VALUE, m.NodeValue(seq=1, boot=1, kind="x", value=1.0, unit="x" * 2000))
    with pytest.raises(ContractError, match="NodeValue"):
        decode(ch.NODE_READING, b"{}", m.NodeValue)


def test_replies_have_their_own_type_and_limit():
    reply = m.CommandReply(accepted=False, reason="no")
    data = encode(ch.ROBOT_COMMAND, reply, reply=True)
    assert decode(ch.ROBOT_COMMAND, data, m.CommandReply, reply=True) == reply
    with pytest.raises(ContractError):
        decode(ch.ROBOT_COMMAND, data, m.CommandReply)


def test_text_is_bounded_utf8():
    assert decode_text(ch.NODE_AVAILABILITY, b"online") == "online"
    with pytest.raises(ContractError, match="UTF-8"):
        decode_text(ch.NODE_AVAILABILITY, b"\xff")
    with pytest.raises(ContractError, match="limit"):
        decode_text(ch.NODE_AVAILABILITY, b"x" * 17)


def test_map_geometry_is_bounded():
    good = {"width": 5000, "height": 5000, "resolution": 0.05, "origin_x": 0.0, "origin_y": 0.0}
    assert msgspec.convert(good, m.MapGeometry).width == 5000
    with pytest.raises(msgspec.ValidationError, match="cells"):
        msgspec.convert({**good, "width": 65_535}, m.MapGeometry)
