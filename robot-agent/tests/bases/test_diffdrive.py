from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_runtime.configuration.robot_file import parse_robot
from robot_agent.bases.diffdrive import driver as diffdrive
from robot_agent.bases.diffdrive.driver import DiffDriveDriver, DiffDriveOptions, Flag, Status, StatusParser
from robot_agent.bases.diffdrive.signature import STOP
from robot_agent.config import StopFieldConfig
from robot_agent.footprint import Footprint
from robot_agent.localization.odometry import Motion, Odometry
from robot_agent.registry import make_base
from robot_agent.safety.stop_field import StopField

EXAMPLE = b"$S,17,1024,-5,0001,11870*71FE\n"
statuses = st.builds(
    Status,
    number=st.integers(0, 255),
    left=st.integers(-(2**31), 2**31 - 1),
    right=st.integers(-(2**31), 2**31 - 1),
    flags=st.integers(0, 0x1FF).map(Flag),
    battery_mv=st.integers(0, 0xFFFF),
)


def crc(body: bytes) -> int:
    """CRC-16 by polynomial division of the whole message: by another method than driver and emulator."""
    message = int.from_bytes(body + b"\0\0", "big") ^ 0xFFFF << 8 * len(body)
    for place in range(8 * len(body) - 1, -1, -1):
        if message >> (place + 16) & 1:
            message ^= 0x11021 << place
    return message


def line_of(status: Status) -> bytes:
    body = f"S,{status.number},{status.left},{status.right},{status.flags.value:04X},{status.battery_mv}".encode()
    return b"$" + body + f"*{crc(body):04X}\n".encode()


def drain(parser: StatusParser) -> list[Status]:
    found = []
    while (status := parser.next_event()) is not None:
        found.append(status)
    return found


def parse(data: bytes) -> list[Status]:
    parser = StatusParser()
    parser.receive_data(data)
    return drain(parser)


def numbered(count: int) -> list[Status]:
    return [Status(n % 256, 7 * n, -3 * n, Flag(n % 512), 12_000 + n) for n in range(count)]


# --- lines ---


def test_the_checksum_is_the_one_of_the_specification():
    assert crc(b"123456789") == 0x29B1
    assert diffdrive.line(b"123456789") == b"$123456789*29B1\n"


def test_commands_are_the_lines_of_the_specification():
    assert diffdrive.enable() == b"$E*F991\n"
    assert diffdrive.line(b"X") == b"$X*3A0D\n"
    assert diffdrive.velocity(300, -250) == f"$V,300,-250*{crc(b'V,300,-250'):04X}\n".encode()
    assert STOP.stop == (b"\n" + diffdrive.velocity(0, 0) + diffdrive.line(b"X")) * 2
    assert STOP.hold == b"\n" + diffdrive.velocity(0, 0)
    assert STOP.baud == diffdrive.BAUD


def test_example_of_the_specification_is_decoded():
    assert parse(EXAMPLE) == [Status(17, 1024, -5, Flag.ENABLED, 11_870)]


@pytest.mark.parametrize("speeds", [(2001, 0), (0, -2001)])
def test_speeds_beyond_the_protocol_are_refused(speeds):
    with pytest.raises(ValueError, match="2000"):
        diffdrive.velocity(*speeds)


@settings(deadline=None)
@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(0.1, 2.0))
def test_scaled_wheel_speeds_fit_and_keep_the_curve(left, right, fastest_m_s):
    body = diffdrive.wheels(left, right, fastest_m_s)[1:].split(b"*")[0]
    sent_left, sent_right = (int(field) for field in body.split(b",")[1:])
    fastest = max(abs(left), abs(right))
    scale = 1000.0 if fastest <= fastest_m_s else 1000.0 * fastest_m_s / fastest
    assert sent_left == pytest.approx(left * scale, abs=0.51)
    assert sent_right == pytest.approx(right * scale, abs=0.51)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_speed_that_is_not_finite_is_refused(bad):
    with pytest.raises(ValueError, match="finite"):
        diffdrive.wheels(0.0, bad, 0.5)


# --- status ---


@settings(deadline=None)
@given(statuses)
def test_every_status_is_decoded_as_sent(status):
    assert parse(line_of(status)) == [status]


@settings(deadline=None)
@given(st.lists(st.sampled_from(["line", "broken", "noise", "long", "dollars"]), max_size=8), st.randoms())
def test_any_chunking_gives_the_same_statuses_and_counts(pieces, rng):
    stream = bytearray()
    for number, piece in enumerate(pieces):
        line = bytearray(line_of(numbered(number + 1)[-1]))
        if piece == "broken":
            line[rng.randrange(len(line))] ^= 1 << rng.randrange(8)
        elif piece == "noise":
            line = bytearray(rng.randbytes(rng.randrange(30)))
        elif piece == "long":
            line = bytearray(b"x" * rng.randrange(60, 200)) + line
        elif piece == "dollars":
            line = bytearray(b"$" * rng.randrange(1, 70)) + line
        stream += line
    whole, single = StatusParser(), StatusParser()
    whole.receive_data(bytes(stream))
    for byte in stream:
        single.receive_data(bytes((byte,)))
    assert drain(whole) == drain(single)
    assert whole.corrupted == single.corrupted


@settings(deadline=None)
@given(st.binary(max_size=300), st.integers(1, 40))
def test_garbage_never_raises_and_the_lines_after_it_come_through(garbage, cut):
    parser = StatusParser()
    data = garbage + b"".join(line_of(status) for status in numbered(3))
    for at in range(0, len(data), cut):
        parser.receive_data(data[at : at + cut])
    assert drain(parser)[-3:] == numbered(3)


def test_no_damaged_byte_passes_and_each_one_is_counted():
    first, damaged, last = numbered(3)
    good = line_of(damaged)
    for place in range(len(good)):
        for value in range(256):
            if value == good[place]:
                continue
            parser = StatusParser()
            parser.receive_data(line_of(first))
            parser.receive_data(good[:place] + bytes((value,)) + good[place + 1 :] + line_of(last))
            assert drain(parser) == [first, last], (place, value)
            assert parser.corrupted >= 1, (place, value)


@settings(deadline=None)
@given(statuses, st.integers(0, 200), st.integers(1, 0xFFFF))
def test_no_burst_of_sixteen_bits_passes(status, place, pattern):
    good = line_of(status)
    at = 1 + place % (len(good) - 8)  # within the body, which the checksum protects
    damaged = (int.from_bytes(good[at : at + 2], "big") ^ pattern).to_bytes(2, "big")
    assert parse(good[:at] + damaged + good[at + 2 :]) == []


@settings(derandomize=True, deadline=None)  # a checksum of 16 bits may let one in 65,536 such lines pass
@given(statuses, st.data())
def test_a_line_that_lost_bytes_does_not_pass(status, data):
    good = line_of(status)
    begin = data.draw(st.integers(0, len(good) - 2))
    end = data.draw(st.integers(begin + 1, len(good) - 1))
    assert parse(good[:begin] + good[end:]) == []


def test_lost_line_feed_loses_one_line_and_is_counted():
    first, second, third = numbered(3)
    parser = StatusParser()
    parser.receive_data(line_of(first) + line_of(second)[:-1] + line_of(third))
    assert drain(parser) == [first, third]
    assert parser.corrupted == 1


def test_repeated_line_is_counted_as_corrupted():
    parser = StatusParser()
    parser.receive_data(EXAMPLE * 5)
    assert len(drain(parser)) == 1
    assert parser.corrupted == 4


def test_partial_line_before_the_first_good_one_is_not_counted():
    parser = StatusParser()
    parser.receive_data(b"24,-5,0001,11870*71FE\n" + EXAMPLE)
    assert len(drain(parser)) == 1
    assert parser.corrupted == 0


@pytest.mark.parametrize(
    "body",
    [b"S,256,0,0,0001,0", b"S,1,2147483648,0,0001,0", b"S,1,0,0,01,0", b"S,1,0,0,0001,65536", b"S,1,+1,0,0001,0"],
)
def test_invalid_status_with_a_right_checksum_is_dropped(body):
    assert parse(diffdrive.line(body)) == []


# --- the base ---


def reading(status: Status, **options):
    driver = DiffDriveDriver(DiffDriveOptions(**options))
    driver.receive_data(line_of(status), 0.0)
    return driver.next_event()


def test_every_flag_is_decoded():
    names = {
        Flag.BUMPER_LEFT: "bumper_left",
        Flag.BUMPER_RIGHT: "bumper_right",
        Flag.CLIFF: "cliff",
        Flag.WHEEL_DROP: "wheel_drop",
        Flag.OVERCURRENT: "overcurrent",
        Flag.CHARGER: "charging",
    }
    for flag, name in names.items():
        status = reading(Status(0, 0, 0, Flag.ENABLED | flag, 12_000)).status
        assert {other for other in names.values() if getattr(status, other)} == {name}
        assert status.mode_problem is None


@pytest.mark.parametrize(
    ("flags", "code"), [(Flag(0), "motors_off"), (Flag.EMERGENCY_STOP, "emergency_button"), (Flag.ENABLED, "")]
)
def test_mode_problem_has_its_identifier(flags, code):
    status = reading(Status(0, 0, 0, flags, 0)).status
    assert (status.mode_code, status.mode_problem is None) == (code, not code)


@pytest.mark.parametrize(("millivolts", "charge"), [(0, None), (9_000, 0.0), (11_550, 0.5), (13_000, 1.0)])
def test_charge_is_computed_from_the_voltage(millivolts, charge):
    assert reading(Status(0, 0, 0, Flag.ENABLED, millivolts)).status.battery == (
        None if charge is None else pytest.approx(charge)
    )


def test_travel_is_in_metres_by_the_options_and_survives_the_wrap():
    driver = DiffDriveDriver(DiffDriveOptions(counts_per_turn=1000, wheel_diameter_m=0.1))
    odometry = Odometry(driver.drive_train)
    edge = 2**31 - 1
    motion = None
    for number, (left, right) in enumerate([(edge - 10, -edge), (edge - 10 + 100 - 2**32, -edge + 100)]):
        driver.receive_data(line_of(Status(number, left, right, Flag.ENABLED, 0)), 0.02 * number)
        motion = odometry.update(driver.next_event().odometry, 0.02 * number)
    assert isinstance(motion, Motion)
    assert (motion.left_m, motion.right_m) == pytest.approx((0.1 * math.pi * 0.1, 0.1 * math.pi * 0.1), abs=1e-6)


def test_battery_full_v_below_battery_empty_v_is_refused():
    with pytest.raises(ValueError, match="battery_full_v"):
        DiffDriveOptions(battery_full_v=9.0)


def test_robot_keeps_more_distance_where_its_wheels_need_longer_to_come_to_rest():
    ahead = np.array([(0.40, 0.0)])
    limited = {}
    for deceleration in (0.3, 1.0, 3.0):
        options = f"{{ deceleration_m_s2 = {deceleration} }}"
        text = f'[base]\ndriver = "diffdrive"\noptions = {options}\n[lidar]\ndriver = "ld19"\n'
        drive = make_base(parse_robot(text, Path("robot.toml"), {})).drive_train
        assert drive.deceleration_m_s2 == deceleration
        field = StopField(Footprint.circle(0.17), drive, StopFieldConfig())
        limited[deceleration] = field.limit((0.6, 0.6), ahead).wheels[0]
    assert limited[0.3] < limited[1.0] < limited[3.0]
