from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.bases.diffdrive.emulator import DiffDriveEmulator, crc16


def line(body: str) -> bytes:
    return b"$%b*%04X\n" % (body.encode(), crc16(body.encode()))


def awake() -> DiffDriveEmulator:
    board = DiffDriveEmulator()
    board.receive(line("E"), 0.0)
    return board


def fields(board: DiffDriveEmulator, now: float) -> list[str]:
    """Fields of the last status that the board sent up to now."""
    last = board.outgoing(now).splitlines()[-1]
    body, check = last[1:].split(b"*")
    assert check == b"%04X" % crc16(body)
    return body.decode().split(",")


def test_the_checksum_is_the_one_of_the_specification():
    assert crc16(b"123456789") == 0x29B1


def test_board_does_not_drive_before_it_is_enabled():
    board = DiffDriveEmulator()
    board.receive(line("V,300,300"), 0.0)
    assert board.wheel_speeds_m_s == (0.0, 0.0)
    board.receive(line("E") + line("V,300,-200"), 0.0)
    assert board.wheel_speeds_m_s == (0.3, -0.2)
    board.receive(line("X"), 0.1)
    assert (board.enabled, board.wheel_speeds_m_s) == (False, (0.0, 0.0))


def test_enable_sets_zero_speed():
    board = awake()
    board.receive(line("V,300,300") + line("E"), 0.0)
    assert board.wheel_speeds_m_s == (0.0, 0.0)


@pytest.mark.parametrize(
    "wrong", [b"$V,300,300*0000\n", line("V,2001,0"), line("V,1"), line("V,+1,0"), line("Z"), b"V,300,300\n"]
)
def test_invalid_command_is_refused_and_counted(wrong):
    board = awake()
    board.receive(wrong, 0.0)
    assert (board.refused, board.wheel_speeds_m_s) == (1, (0.0, 0.0))


def test_a_dollar_sign_begins_a_new_line():
    board = awake()
    board.receive(b"$V,99" + line("V,200,200"), 0.0)
    assert (board.refused, board.wheel_speeds_m_s) == (0, (0.2, 0.2))


def test_a_status_comes_every_20_ms_with_a_number_of_its_own():
    board = awake()
    board.outgoing(0.0)
    assert len(board.outgoing(0.2001).splitlines()) == 10
    assert fields(board, 0.2201)[1] == "11"
    board.outgoing(100.0)
    assert len(board.outgoing(100.0201).splitlines()) == 1, "a pause gives no burst"


def test_timeout_stops_the_wheels_and_is_reported_until_the_next_command():
    board = awake()
    board.receive(line("V,300,300"), 0.0)
    board.tick(0.29, 0.29)
    assert board.wheel_speeds_m_s == (0.3, 0.3)
    board.tick(0.31, 0.02)
    assert board.wheel_speeds_m_s == (0.0, 0.0)
    assert int(fields(board, 0.34)[4], 16) == 0b1000001
    board.receive(line("V,100,100"), 0.4)
    assert board.wheel_speeds_m_s == (0.1, 0.1)
    assert int(fields(board, 0.44)[4], 16) == 1


def test_the_emergency_button_switches_off_and_keeps_off():
    board = awake()
    board.receive(line("V,300,300"), 0.0)
    board.emergency_button = True
    board.tick(0.01, 0.01)
    board.receive(line("E"), 0.02)
    assert (board.enabled, board.wheel_speeds_m_s) == (False, (0.0, 0.0))
    board.emergency_button = False
    board.receive(line("E"), 0.03)
    assert board.enabled


@pytest.mark.parametrize(
    ("name", "bit"),
    [("bump_left", 1), ("bump_right", 2), ("cliff", 3), ("wheel_drop", 4), ("overcurrent", 5), ("charger", 7),
     ("emergency_button", 8)],
)  # fmt: skip
def test_each_sensor_has_its_bit(name, bit):
    board = DiffDriveEmulator()
    setattr(board, name, True)
    assert int(fields(board, 0.0)[4], 16) == 1 << bit


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), max_size=50))
def test_counters_add_up_fractions(steps):
    board = DiffDriveEmulator()
    for step in steps:
        board.add_wheel_travel(*step)
    per_metre = 1440 / (3.141592653589793 * 0.09)
    for count, side in zip(board.counts, (0, 1), strict=True):
        assert -1.001 <= count - per_metre * sum(step[side] for step in steps) <= 0.001


def test_counters_wrap_at_32_bits():
    board = DiffDriveEmulator()
    per_metre = 1440 / (3.141592653589793 * 0.09)
    board.add_wheel_travel((2**31 + 5.5) / per_metre, -(2**31 + 5.5) / per_metre)
    left, right = board.counts
    assert (left, right) == (-(2**31) + 5, 2**31 - 6)


@settings(deadline=None)
@given(st.binary(max_size=200), st.lists(st.integers(1, 30), max_size=8))
def test_any_bytes_in_any_pieces_have_the_same_effect_and_never_raise(data, sizes):
    data = line("V,100,200") + data
    whole, cut = awake(), awake()
    whole.receive(data, 0.0)
    at = 0
    for size in sizes:
        cut.receive(data[at : at + size], 0.0)
        at += size
    cut.receive(data[at:], 0.0)
    assert whole.outgoing(0.05) == cut.outgoing(0.05)
    assert (whole.refused, whole.wheel_speeds_m_s) == (cut.refused, cut.wheel_speeds_m_s)
