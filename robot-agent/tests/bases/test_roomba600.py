from __future__ import annotations

import csv
import itertools
import json
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.bases.roomba600 import open_interface as oi
from robot_agent.bases.roomba600.signature import STOP


def frame_bytes(pairs: list[tuple[int, bytes]]) -> bytes:
    body = b"".join(bytes((packet_id,)) + data for packet_id, data in pairs)
    head = bytes((19, len(body))) + body
    return head + bytes((-sum(head) & 0xFF,))


def guardian_frame(rng: random.Random) -> bytes:
    return frame_bytes([(packet_id, rng.randbytes(oi.data_size(packet_id))) for packet_id in oi.GUARDIAN_STREAM])


def frame_of(stream: tuple[int, ...], contacts: int) -> bytes:
    sizes = {packet_id: bytes(oi.data_size(packet_id)) for packet_id in stream}
    return frame_bytes([*{**sizes, 34: bytes((contacts,))}.items()])


def drain(parser: oi.StreamParser) -> list[dict[int, int]]:
    frames = []
    while (frame := parser.next_event()) is not None:
        frames.append(dict(frame.packets))
    return frames


def parse(data: bytes, cuts: list[int] | None = None, ids: tuple[int, ...] | None = None) -> list[dict[int, int]]:
    parser = oi.StreamParser(ids)
    edges = [0, *sorted(cuts or []), len(data)]
    for begin, end in itertools.pairwise(edges):
        parser.receive_data(data[begin:end])
    return drain(parser)


# --- commands ---


def test_commands_have_the_bytes_of_the_specification():
    assert oi.start() == bytes([128])
    assert oi.safe() == bytes([131])
    assert oi.power() == bytes([133])
    assert oi.stop() == bytes([173])
    assert oi.reset() == bytes([7])
    assert oi.seek_dock() == bytes([143])
    assert oi.drive_direct(-200, 500) == bytes([145, 255, 56, 1, 244])
    assert oi.sensors(100) == bytes([142, 100])
    assert oi.query_list([7, 43, 44]) == bytes([149, 3, 7, 43, 44])
    assert oi.stream([29, 13]) == bytes([148, 2, 29, 13])
    assert oi.pause_stream() == bytes([150, 0])
    assert oi.resume_stream() == bytes([150, 1])


@pytest.mark.parametrize("stream", [oi.GUARDIAN_STREAM, oi.SLOW_STREAM])
def test_charger_is_known_by_the_newest_whole_frame_of_the_stream(stream):
    off, dock, cable = (frame_of(stream, contacts) for contacts in (0, 2, 1))
    assert STOP.charging(off[9:] + off + dock + off[:-1])
    assert STOP.charging(cable)
    assert not STOP.charging(dock + off)
    assert not STOP.charging(dock[:-1] + bytes((dock[-1] ^ 1,)))
    assert not STOP.charging(dock[:-1])


@pytest.mark.parametrize("speeds", [(501, 0), (0, -501), (-32768, 0), (70000, 0)])
def test_speeds_above_500_mm_s_are_refused(speeds):
    with pytest.raises(ValueError, match="500"):
        oi.drive_direct(*speeds)


@given(st.floats(-50, 50), st.floats(-50, 50))
def test_scaled_wheel_speeds_fit_and_keep_the_curvature(left, right):
    command = oi.drive_wheels(left, right)
    sent_right, sent_left = (int.from_bytes(command[i : i + 2], "big", signed=True) for i in (1, 3))
    assert max(abs(sent_left), abs(sent_right)) <= 500
    fastest = max(abs(left), abs(right))
    scale = 1000.0 if fastest <= 0.5 else 500.0 / fastest
    assert sent_left == pytest.approx(left * scale, abs=2.51)
    assert sent_right == pytest.approx(right * scale, abs=2.51)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_speed_that_is_not_finite_is_refused(bad):
    with pytest.raises(ValueError, match="finite"):
        oi.drive_wheels(bad, 0.0)


def test_a_stream_that_does_not_fit_into_15_ms_is_refused():
    assert oi.stream_frame_size(oi.GUARDIAN_STREAM) <= 172
    with pytest.raises(ValueError, match="15 ms"):
        oi.stream([100, 100, 100])


@pytest.mark.parametrize("build", [oi.stream, oi.query_list])
def test_a_packet_that_does_not_exist_is_refused(build):
    with pytest.raises(ValueError, match="59"):
        build([7, 59])


# --- packet table ---


@pytest.mark.data
def test_sizes_and_signs_agree_with_the_collected_tables(data_dir):
    with (data_dir / "roomba" / "oi_packets.csv").open() as lines:
        rows = {int(row["packet_id"]): row for row in csv.DictReader(lines)}
    assert set(rows) == set(oi.PACKETS)
    for packet_id, row in rows.items():
        assert oi.PACKETS[packet_id].size == int(row["bytes"])
        if packet_id != 58:
            assert oi.PACKETS[packet_id].signed == bool(int(row["signed_in_ros_struct"]))
    groups = json.loads((data_dir / "roomba" / "oi_groups.json").read_text())
    assert {int(group) for group in groups} == set(oi.GROUPS)
    for group, facts in groups.items():
        assert oi.GROUPS[int(group)] == (facts["first"], facts["last"])
        assert oi.data_size(int(group)) == facts["bytes"]


@pytest.mark.data
def test_recorded_sensor_values_decode(data_dir):
    vectors = json.loads((data_dir / "roomba" / "roombex_vectors.json").read_text())
    names = {"off": 0, "passive": 1, "safe": 2, "full": 3, "trickle_charging": 3, "bump_right": 1, "bump_left": 2}
    for packet_id, raw, expected in vectors["sensors"]:
        value = oi.decode_packets([packet_id], bytes(raw))[packet_id]
        if isinstance(expected, int) or expected in names:
            assert value == names.get(expected, expected)
        else:
            assert [value] == raw
    builders = {"start": oi.start, "safe": oi.safe, "power": oi.power}
    commands = {name: bytes(raw) for name, raw in vectors["commands"]}
    for name, build in builders.items():
        assert build() == commands[name]


def test_truncated_answer_is_refused():
    with pytest.raises(ValueError, match="truncated"):
        oi.decode_packets([43, 44], b"\x01\x02\x03")


# --- stream ---


@pytest.mark.data
def test_recorded_stream_frames_decode(data_dir):
    for vector in json.loads((data_dir / "roomba" / "stream_vectors.json").read_text())["vectors"]:
        expected = [{int(key): value for key, value in f["packets"].items()} for f in vector["valid_frames"]]
        assert parse(bytes(vector["raw"])) == expected


def test_every_flag_has_its_own_bit():
    def frame(packet_id: int, value: int) -> oi.Frame:
        return oi.Frame({packet_id: value})

    bits = {1: "bump_right", 2: "bump_left", 4: "wheel_drop_right", 8: "wheel_drop_left"}
    for bit, name in bits.items():
        assert [getattr(frame(7, bit), other) for other in bits.values()] == [other == name for other in bits.values()]
        assert frame(7, bit).bumped == (bit < 4)
        assert frame(7, bit).wheel_dropped == (bit >= 4)
    for packet_id, name in {9: "left", 10: "front_left", 11: "front_right", 12: "right"}.items():
        cliffs = oi.Frame({9: 0, 10: 0, 11: 0, 12: 0} | {packet_id: 1})
        assert getattr(cliffs, f"cliff_{name}")
        assert cliffs.cliff
    assert not oi.Frame({9: 0, 10: 0, 11: 0, 12: 0}).cliff
    assert [frame(14, 1 << bit).wheel_overcurrent for bit in range(5)] == [False, False, False, True, True]


def test_values_come_in_si_units():
    frame = oi.Frame({21: 2, 22: 14400, 23: -250, 25: 1300, 26: 2600, 34: 2, 35: 2, 41: -200, 42: 300, 43: 1, 44: 2})
    assert (frame.voltage_v, frame.current_a, frame.charge_fraction) == (14.4, -0.25, 0.5)
    assert frame.charging_state is oi.ChargingState.FULL_CHARGING
    assert frame.on_charger
    assert frame.mode is oi.Mode.SAFE
    assert frame.requested_wheels_m_s == (0.3, -0.2)
    assert frame.encoders == (1, 2)
    assert math.isnan(oi.Frame({25: 0, 26: 0}).charge_fraction)


def test_unknown_mode_is_returned_as_an_int():
    assert oi.Frame({35: 32}).mode == 32


def test_access_to_a_packet_that_is_not_streamed_names_it():
    with pytest.raises(oi.MissingPacketError, match="oi_mode"):
        _ = oi.Frame({7: 0}).mode


@given(st.data())
def test_any_chunking_gives_the_same_frames_and_counts(data):
    rng = random.Random(data.draw(st.integers(0, 2**32)))
    pieces = data.draw(st.lists(st.sampled_from(["frame", "broken", "noise", "headers"]), max_size=8))
    stream = bytearray()
    for piece in pieces:
        if piece == "noise":
            stream += rng.randbytes(rng.randrange(30))
        elif piece == "headers":
            stream += bytes((19, 2, 7)) * rng.randrange(1, 6)
        else:
            frame = bytearray(frame_bytes([(7, b"\x00"), (43, rng.randbytes(2)), (44, rng.randbytes(2))]))
            if piece == "broken":
                frame[rng.randrange(len(frame))] ^= 1 << rng.randrange(8)
            stream += frame
    whole, single = oi.StreamParser(), oi.StreamParser()
    whole.receive_data(bytes(stream))
    for byte in stream:
        single.receive_data(bytes((byte,)))
    assert drain(whole) == drain(single)
    assert (whole.frames, whole.corrupted, whole.skipped_bytes) == (
        single.frames,
        single.corrupted,
        single.skipped_bytes,
    )


@given(st.binary(max_size=400), st.lists(st.integers(0, 400), max_size=6))
def test_garbage_never_raises_and_the_next_frames_come_through(garbage, cuts):
    good = guardian_frame(random.Random(1))
    # Garbage may end in the header of a frame that would swallow one good frame, never the one after it.
    frames = parse(garbage + good * 7, cuts, oi.GUARDIAN_STREAM)
    assert len(frames) >= 6
    assert frames[-1] == parse(good)[0]
    parse(garbage, cuts)


def test_garbage_does_not_hide_the_first_frame_with_known_ids():
    good = frame_bytes([(7, b"\x00"), (35, b"\x02")])
    assert parse(b"\x13\xff\x13" + good, ids=(7, 35)) == [{7: 0, 35: 2}]


def test_only_frames_with_the_expected_packets_pass():
    other = frame_bytes([(7, b"\x00"), (35, b"\x03")])
    expected = frame_bytes([(35, b"\x02"), (7, b"\x00")])
    assert parse(other + expected + other, ids=(35, 7)) == [{35: 2, 7: 0}]


def test_group_in_the_stream_is_split_into_its_packets():
    raw = bytes(range(28))
    frame = parse(frame_bytes([(101, raw)]))[0]
    assert frame == oi.decode_packets([101], raw)
    assert frame[43] == 0x0001


def test_each_damaged_frame_is_counted_and_the_good_ones_between_are_received():
    rng = random.Random(3)
    stream, sent = bytearray(), []
    for index in range(200):
        frame = bytearray(guardian_frame(rng))
        if index % 2:
            frame[rng.randrange(3, len(frame))] ^= 0x55
        else:
            sent.append(parse(bytes(frame))[0])
        stream += frame
    parser = oi.StreamParser(oi.GUARDIAN_STREAM)
    parser.receive_data(bytes(stream))
    assert drain(parser) == sent
    # The last damaged frame may still be waiting for its end.
    assert parser.corrupted in {99, 100}


def test_a_hundred_thousand_damaged_frames_pass_no_more_often_than_the_checksum_allows():
    rng = random.Random(20)
    ids = (7, 35, 43, 44)
    damaged, harmless = 100_000, 0
    parser = oi.StreamParser(ids)
    passed = 0
    for _ in range(damaged):
        frame = bytearray(frame_bytes([(i, rng.randbytes(oi.data_size(i))) for i in ids]))
        before = bytes(frame)
        for _ in range(rng.randrange(2, 6)):
            frame[rng.randrange(len(frame))] = rng.randrange(256)
        harmless += bytes(frame) == before
        parser.receive_data(bytes(frame))
        passed += len(drain(parser))
    # Damage to length or ids is always seen; damage to the data alone passes an eight-bit sum once in 256.
    assert passed - harmless < damaged / 256
    assert damaged * len(before) - passed * len(before) - parser.skipped_bytes < len(before)


def test_a_single_damaged_byte_never_passes():
    rng = random.Random(5)
    good = guardian_frame(rng)
    for place in range(len(good)):
        for value in range(256):
            if value != good[place]:
                assert parse(good[:place] + bytes((value,)) + good[place + 1 :], ids=oi.GUARDIAN_STREAM) == []
