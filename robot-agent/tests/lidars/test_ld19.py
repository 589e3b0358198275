from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.lidars.ld19.driver import SAMPLES_TIMEOUT_S, Ld19Driver, Ld19Options, Parser, ScanAssembler

# A few values of the checksum's table, as the maker's header file has them.
KNOWN_CRC = {1: 0x4D, 2: 0x9A, 64: 0x3E, 255: 0xA8}


def crc8(data: bytes) -> int:
    """CRC-8 by polynomial division of the whole message: by another method than driver and emulator."""
    message = int.from_bytes(data, "big") << 8
    for place in range(8 * len(data) - 1, -1, -1):
        if message >> (place + 8) & 1:
            message ^= 0x14D << place
    return message


def packet(start: int, distances, *, speed=3600, span=880, intensity=200, stamp=0) -> bytes:
    """A packet by the data sheet: angles in degrees / 100, distances in mm."""
    body = b"\x54\x2c" + speed.to_bytes(2, "little") + (start % 36_000).to_bytes(2, "little")
    for distance in distances:
        body += distance.to_bytes(2, "little") + bytes((intensity,))
    body += ((start + span) % 36_000).to_bytes(2, "little") + stamp.to_bytes(2, "little")
    return body + bytes((crc8(body),))


def scan_bytes(distance=2000, *, begin=0, packets=38) -> bytes:
    """A whole scan and a little more, 960 hundredths of a degree from packet to packet."""
    return b"".join(packet(begin + 960 * number, [distance] * 12) for number in range(packets))


def drain(parser: Parser):
    """All samples so far: angle, distance, intensity."""
    found = []
    while (packets := parser.next_event()) is not None:
        found += zip(packets.angle, packets.distance_mm, packets.intensity, strict=True)
    return found


def parse(data: bytes):
    parser = Parser()
    parser.receive_data(data)
    return drain(parser)


def test_the_checksum_is_the_makers():
    assert {value: crc8(bytes((value,))) for value in KNOWN_CRC} == KNOWN_CRC


def test_a_packet_is_twelve_samples_on_a_line_of_angles():
    samples = parse(packet(35_500, range(100, 112), span=880))
    assert len(samples) == 12
    assert [distance for _, distance, _ in samples] == list(range(100, 112))
    assert [angle for angle, _, _ in samples] == pytest.approx([(35_500 + 80 * k) % 36_000 for k in range(12)])
    assert {intensity for _, _, intensity in samples} == {200}


def test_distances_of_two_bytes_are_little_endian():
    assert parse(packet(0, [0x1234] * 12))[0][1] == 0x1234


@settings(deadline=None)
@given(st.lists(st.sampled_from(["packet", "broken", "noise", "headers"]), max_size=8), st.randoms())
def test_any_chunking_gives_the_same_samples_and_counts(pieces, rng):
    stream = bytearray()
    for number, piece in enumerate(pieces):
        part = bytearray(packet(960 * number, [number + 1] * 12))
        if piece == "broken":
            part[rng.randrange(len(part))] ^= 1 << rng.randrange(8)
        elif piece == "noise":
            part = bytearray(rng.randbytes(rng.randrange(100)))
        elif piece == "headers":
            part = bytearray(b"\x54\x2c" * rng.randrange(1, 30))
        stream += part
    whole, single = Parser(), Parser()
    whole.receive_data(bytes(stream))
    for byte in stream:
        single.receive_data(bytes((byte,)))
    assert drain(whole) == drain(single)
    assert (whole.corrupted, whole.skipped_bytes) == (single.corrupted, single.skipped_bytes)


@settings(derandomize=True, deadline=None)  # a checksum of 8 bits lets some garbage pass
@given(st.binary(max_size=300), st.integers(1, 60))
def test_garbage_never_raises_and_the_packets_after_it_come_through(garbage, cut):
    parser = Parser()
    good = b"".join(packet(960 * number, [7] * 12) for number in range(3))
    data = garbage + good
    for at in range(0, len(data), cut):
        parser.receive_data(data[at : at + cut])
    # Garbage may end in a false header that swallows one packet, never the one after it.
    assert drain(parser)[-24:] == parse(good)[-24:]


def test_no_damaged_byte_passes_and_each_one_is_counted():
    before, original, after = (packet(960 * number, [1000 + number] * 12) for number in range(3))
    for place in range(len(original)):
        for flip in range(1, 256):
            damaged = bytearray(original)
            damaged[place] ^= flip
            parser = Parser()
            parser.receive_data(before + bytes(damaged) + after)
            assert {distance for _, distance, _ in drain(parser)} <= {1000, 1002}, (place, flip)
            assert parser.corrupted >= 1, (place, flip)


def test_a_packet_whose_angles_the_head_could_not_have_is_dropped():
    # At 3600 degrees a second twelve samples span 9.6 degrees; half as much again is the limit.
    assert len(parse(packet(0, [1] * 12, span=1440))) == 12
    for wrong in (packet(0, [1] * 12, span=1450), packet(0, [1] * 12, span=-80)):
        assert parse(wrong) == []


def test_an_angle_beyond_the_full_turn_is_dropped():
    body = bytearray(packet(0, [1] * 12)[:-1])
    body[4:6] = (36_000).to_bytes(2, "little")
    assert parse(bytes(body) + bytes((crc8(bytes(body)),))) == []


# --- scans ---


def scans_of(data: bytes, **options):
    driver = Ld19Driver(Ld19Options(**options))
    driver.begin(0.0)
    found = []
    for number, at in enumerate(range(0, len(data), 47 * 4)):
        found += driver.receive(data[at : at + 47 * 4], 0.01 * (number + 1)).scans
    return found, driver


def test_a_scan_has_counter_clockwise_angles_and_metres():
    (scan,), _ = scans_of(scan_bytes(2500, begin=35_900, packets=40))
    assert (scan.ranges_m == 2.5).all()
    assert (scan.angles_rad.dtype, scan.ranges_m.dtype, scan.quality.dtype) == (np.float64, np.float64, np.uint8)
    assert -np.pi < scan.angles_rad.min() < scan.angles_rad.max() <= np.pi
    # The head scans clockwise: from straight ahead to the right, which is negative.
    assert scan.angles_rad[0] == pytest.approx(-np.deg2rad(0.6), abs=0.01)
    assert (np.diff(np.unwrap(scan.angles_rad)) < 0).all()
    assert np.ptp(np.unwrap(scan.angles_rad)) == pytest.approx(2 * np.pi, abs=0.02)


def test_a_wall_on_the_right_is_at_a_negative_angle():
    data = b"".join(packet(960 * n, [1000 if 8000 < 960 * n % 36_000 < 10_000 else 4000] * 12) for n in range(76))
    (scan,), _ = scans_of(data)
    near = scan.angles_rad[scan.ranges_m == 1.0]
    assert near.size > 12
    assert near.mean() == pytest.approx(-np.pi / 2, abs=0.05)


def test_no_return_is_nan_and_so_is_a_weak_one_where_asked_for():
    data = b"".join(packet(960 * n, [0 if n % 2 else 500] * 12, intensity=90) for n in range(76))
    (scan,), _ = scans_of(data)
    assert np.isnan(scan.ranges_m).mean() == pytest.approx(0.5, abs=0.05)
    (weak,), _ = scans_of(data, intensity_min=91)
    assert np.isnan(weak.ranges_m).all()


def test_a_scan_with_a_gap_is_thrown_away_and_counted():
    begin, hole = scan_bytes(packets=40), scan_bytes(packets=12, begin=960 * 62)
    found, driver = scans_of(begin + hole + scan_bytes(begin=960 * 74, packets=40))
    assert driver._assembler.incomplete == 1
    assert all(np.ptp(np.unwrap(scan.angles_rad)) > 6.2 for scan in found)


def test_identical_scans_are_counted():
    one = b"".join(packet(1000 * number, [2000] * 12) for number in range(36))
    found, _ = scans_of(one * 4 + one[:47])
    assert [scan.repeats for scan in found] == [1, 2, 3]


def test_start_and_end_of_a_scan_are_times_of_arrival():
    found, _ = scans_of(scan_bytes(packets=120))
    for scan in found:
        assert scan.ended_at - scan.started_at == pytest.approx(37.5 / 4 * 0.01, abs=0.003)


def test_an_assembler_that_was_reset_needs_a_whole_scan_again():
    assembler, parser = ScanAssembler(), Parser()
    parser.receive_data(scan_bytes(packets=60))
    assembler.feed(parser.next_event(), 0.0)
    assembler.reset()
    parser.receive_data(scan_bytes(begin=960 * 60, packets=30))
    assert assembler.feed(parser.next_event(), 0.1) == []


# --- the driver ---


def test_silent_lidar_is_a_problem_until_it_sends_a_packet():
    driver = Ld19Driver()
    assert driver.begin(5.0) == b""
    assert driver.tick(5.0 + SAMPLES_TIMEOUT_S) == b""
    assert driver.problem == ""
    driver.tick(5.1 + SAMPLES_TIMEOUT_S)
    assert driver.problem.code == "no_packets"
    assert not driver.receive(b"\x54\x2c nothing that counts", 7.0).samples
    assert driver.problem
    assert driver.receive(packet(0, [1] * 12), 7.1).samples
    assert driver.problem == ""


def test_serial_settings_and_empty_stop_command():
    driver = Ld19Driver()
    assert (driver.serial.baud, driver.serial.dtr, driver.stop_command) == (230_400, None, b"")
