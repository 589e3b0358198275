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
def test_decoding_an_encoded_reading_returns_it(ranges, seq, state):
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
def test_nan_or_infinity_in_a_pose_is_refused_by_name(field, value):
    with pytest.raises(ContractError, match=field):
        decode(ch.ROBOT_POSE, pose(**{field: value}), m.RobotPose)


def test_nan_in_a_covariance_is_refused():
    with pytest.raises(ContractError, match="covariance"):
        decode(ch.ROBOT_POSE, pose(covariance=[0.0] * 8 + [math.nan]), m.RobotPose)


@pytest.mark.parametrize("name", ["a1", "x" * 32, "0-0"])
def test_valid_id_is_accepted(name):
    assert decode(ch.NODE_VALUE, value(name), m.NodeValue).kind == name


@pytest.mark.parametrize("name", ["", "-a", "A", "x" * 33, "a b", "a/b", "a\n", "a\x00", "é", "+", "#"])
def test_malformed_id_is_refused(name):
    with pytest.raises(ContractError, match="kind"):
        decode(ch.NODE_VALUE, value(name), m.NodeValue)


def value(kind):
    return msgspec.json.encode({"seq": 1, "boot": 1, "kind": kind, "value": 1.0, "unit": "C"})


@given(data=st.binary(max_size=300), channel=st.sampled_from(CHANNELS))
def test_arbitrary_bytes_decode_to_a_message_or_raise_contract_error(data, channel):
    try:
        message = decode(channel, data, channel.message)
    except ContractError as error:
        assert error.channel == channel.name  # noqa: PT017  # a message and an error are both correct
    else:
        assert isinstance(message, channel.message)


@given(flips=st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), min_size=1, max_size=5))
def test_damaged_pose_raises_contract_error_or_has_finite_numbers(flips):
    data = bytearray(pose())
    for position, byte in flips:
        data[position % len(data)] = byte
    try:
        decoded = decode(ch.ROBOT_POSE, bytes(data), m.RobotPose)
    except ContractError:
        return

    numbers = [decoded.x, decoded.y, decoded.theta, decoded.v, decoded.w, decoded.stamp, *decoded.covariance]
    assert all(math.isfinite(number) for number in numbers)


@pytest.mark.parametrize("channel", [ch.AREA_DEFINITION, ch.ROBOT_STATE], ids=lambda c: c.name)
def test_deeply_nested_unknown_field_is_refused(channel):
    data = b'{"x":' + b"[" * 30_000 if channel.encoding == "json" else b"\x81\xa1x" + b"\x91" * 16_000
    with pytest.raises(ContractError):
        decode(channel, data, channel.message)


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda c: c.name)
def test_oversized_payload_is_refused_before_decoding(channel):
    with pytest.raises(ContractError, match="over the limit"):
        decode(channel, b"\x00" * (channel.limit + 1), channel.message)


def test_encoding_refuses_wrong_type_and_oversized_message():
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


def test_reply_of_an_older_robot_has_no_identifiers():
    old = msgspec.msgpack.encode({"accepted": False, "reason": "no"})
    reply = decode(ch.ROBOT_COMMAND, old, m.CommandReply, reply=True)
    assert (reply.reason, reply.code, reply.causes) == ("no", "", [])


def test_text_that_is_too_long_or_not_utf8_is_refused():
    assert decode_text(ch.NODE_AVAILABILITY, b"online") == "online"
    with pytest.raises(ContractError, match="UTF-8"):
        decode_text(ch.NODE_AVAILABILITY, b"\xff")
    with pytest.raises(ContractError, match="limit"):
        decode_text(ch.NODE_AVAILABILITY, b"x" * 17)


def test_map_geometry_with_too_many_cells_is_refused():
    good = {"width": 5000, "height": 5000, "resolution": 0.05, "origin_x": 0.0, "origin_y": 0.0}
    assert msgspec.convert(good, m.MapGeometry).width == 5000
    with pytest.raises(msgspec.ValidationError, match="cells"):
        msgspec.convert({**good, "width": 65_535}, m.MapGeometry)
