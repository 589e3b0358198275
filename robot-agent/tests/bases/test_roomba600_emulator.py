from __future__ import annotations

import json
import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robot_agent.bases.roomba600.emulator import BOOT_TEXT, FULL, OFF, PASSIVE, SAFE, Battery, RoombaEmulator

DRIVE_300 = bytes((145, 1, 44, 1, 44))
POWER = 133
"""The robot sleeps then, and hears nothing that follows."""


def awake(mode: int = SAFE) -> RoombaEmulator:
    roomba = RoombaEmulator(left_encoder=4047, right_encoder=61558)
    roomba.receive(bytes((128, *{PASSIVE: (), SAFE: (131,), FULL: (132,)}[mode])), 0.0)
    return roomba


def ask(roomba: RoombaEmulator, packet_id: int) -> bytes:
    roomba.receive(bytes((142, packet_id)), 0.0)
    return roomba.outgoing(0.0)


def test_off_mode_accepts_only_start_and_reset():
    roomba = RoombaEmulator()
    roomba.receive(bytes((131, 132, 142, 7, 148, 1, 7)) + DRIVE_300, 0.0)
    assert (roomba.mode, roomba.outgoing(1.0), roomba.wheel_speeds_m_s) == (OFF, b"", (0.0, 0.0))
    roomba.receive(b"\x80", 0.0)
    assert roomba.mode == PASSIVE


@pytest.mark.parametrize(
    ("opcode", "mode"),
    [(128, PASSIVE), (131, SAFE), (130, SAFE), (132, FULL), (133, PASSIVE), (135, PASSIVE), (143, PASSIVE), (173, OFF),
     (7, OFF)],
)  # fmt: skip
@pytest.mark.parametrize("before", [PASSIVE, SAFE, FULL])
def test_mode_commands_lead_to_their_mode_and_only_driving_modes_keep_the_wheels(before, opcode, mode):
    roomba = awake(before)
    roomba.receive(DRIVE_300, 0.0)
    roomba.receive(bytes((opcode,)), 0.0)
    assert roomba.mode == mode
    assert roomba.wheel_speeds_m_s == ((0.3, 0.3) if before != PASSIVE and mode in {SAFE, FULL} else (0.0, 0.0))
    assert roomba.seeking_dock == (opcode == 143)


def test_button_clean_wakes_a_sleeping_roomba_then_lets_it_drive_until_it_is_pressed_again():
    roomba = awake()
    roomba.receive(bytes((POWER,)), 0.0)
    driven = []
    for _ in range(3):
        roomba.press_clean()
        roomba.tick(1.0, 0.01)
        driven.append((roomba.asleep, roomba.cleaning, roomba.wheel_speeds_m_s))
    assert driven == [(False, False, (0.0, 0.0)), (False, True, (0.3, 0.3)), (False, False, (0.0, 0.0))]


def test_schedule_wakes_a_sleeping_roomba_and_lets_it_drive():
    roomba = awake()
    roomba.receive(bytes((POWER,)), 0.0)
    roomba.clean()
    roomba.tick(1.0, 0.01)
    assert (roomba.asleep, roomba.wheel_speeds_m_s) == (False, (0.3, 0.3))


@pytest.mark.parametrize("mode", [SAFE, FULL])
def test_button_clean_does_nothing_while_the_host_has_control(mode):
    roomba = awake(mode)
    roomba.press_clean()
    roomba.tick(1.0, 0.01)
    assert (roomba.mode, roomba.wheel_speeds_m_s) == (mode, (0.0, 0.0))


@pytest.mark.parametrize("opcode", [134, 135, 136])
def test_commanded_cleaning_leaves_the_dock_backwards_and_drives_in_passive_mode(opcode):
    roomba = awake()
    roomba.set_dock(0.0, 0.0, 0.0)
    roomba.receive(bytes((opcode,)), 0.0)
    roomba.tick(1.0, 0.01)
    assert (roomba.mode, roomba.wheel_speeds_m_s) == (PASSIVE, (-0.1, -0.1))
    roomba.set_dock(-0.05, 0.0, 0.0)
    roomba.tick(1.01, 0.01)
    assert roomba.wheel_speeds_m_s == (0.3, 0.3)


@pytest.mark.parametrize("ends", [bytes((128,)), bytes((131,)), DRIVE_300, "wheel_drop_left", "cliff_left"])
def test_cleaning_ends_by_start_or_safe_and_by_what_the_firmware_sees_but_not_by_wheel_speeds(ends):
    roomba = awake(PASSIVE)
    roomba.press_clean()
    roomba.tick(1.0, 0.01)
    setattr(roomba.world, ends, True) if isinstance(ends, str) else roomba.receive(ends, 1.0)
    roomba.tick(1.01, 0.01)
    assert roomba.wheel_speeds_m_s == ((0.3, 0.3) if ends == DRIVE_300 else (0.0, 0.0))


def test_passive_does_not_drive():
    roomba = awake(PASSIVE)
    roomba.receive(DRIVE_300, 0.0)
    assert roomba.wheel_speeds_m_s == (0.0, 0.0)


@pytest.mark.parametrize(
    ("command", "speeds"),
    [
        (bytes((145, 255, 56, 1, 244)), (0.5, -0.2)),
        (bytes((145, 3, 232, 252, 24)), (-0.5, 0.5)),  # +-1000 mm/s requested
        (bytes((137, 0, 200, 128, 0)), (0.2, 0.2)),
        (bytes((137, 0, 200, 127, 255)), (0.2, 0.2)),
        (bytes((137, 0, 200, 0, 1)), (-0.2, 0.2)),
        (bytes((137, 0, 200, 255, 255)), (0.2, -0.2)),
        (bytes((137, 0, 200, 1, 244)), (0.153, 0.247)),  # 500 mm to the left
        (bytes((137, 255, 56, 1, 244)), (-0.153, -0.247)),
        (bytes((146, 0, 255, 255, 1)), (-0.5, 0.5)),
    ],
)
def test_drive_commands_turn_into_wheel_speeds(command, speeds):
    roomba = awake()
    roomba.receive(command, 0.0)
    assert roomba.wheel_speeds_m_s == speeds


def test_the_last_speed_is_kept_while_the_host_is_silent():
    roomba = awake()
    roomba.receive(DRIVE_300, 0.0)
    for step in range(1000):
        roomba.tick(step * 0.1, 0.1)
    assert roomba.wheel_speeds_m_s == (0.3, 0.3)


@pytest.mark.parametrize(
    "danger",
    ["cliff_left", "cliff_front_left", "cliff_front_right", "cliff_right", "wheel_drop_left", "wheel_drop_right",
     "charger", "home_base"],
)  # fmt: skip
def test_safe_mode_stops_for_danger_and_full_mode_does_not(danger):
    for mode, after in ((SAFE, PASSIVE), (FULL, FULL)):
        roomba = awake(mode)
        roomba.receive(DRIVE_300, 0.0)
        setattr(roomba.world, danger, True)
        roomba.tick(0.015, 0.015)
        assert roomba.mode == after
        assert roomba.wheel_speeds_m_s == ((0.3, 0.3) if mode == FULL else (0.0, 0.0))


def test_safe_mode_does_not_stop_for_the_bumper():
    roomba = awake()
    roomba.receive(DRIVE_300, 0.0)
    roomba.world.bump_left = roomba.world.bump_right = True
    roomba.tick(0.015, 0.015)
    assert (roomba.mode, roomba.wheel_speeds_m_s) == (SAFE, (0.3, 0.3))
    assert ask(roomba, 7) == b"\x03"


def test_safe_mode_lets_the_robot_back_away_from_a_cliff_that_it_sees():
    roomba = awake()
    roomba.receive(bytes((145, 255, 156, 255, 156)), 0.0)
    roomba.world.cliff_right = True
    roomba.tick(0.015, 0.015)
    assert (roomba.mode, roomba.wheel_speeds_m_s) == (SAFE, (-0.1, -0.1))


def test_safe_mode_is_refused_while_a_wheel_hangs():
    roomba = awake(PASSIVE)
    roomba.world.wheel_drop_left = True
    roomba.receive(b"\x83", 0.0)
    assert roomba.mode == PASSIVE


@given(
    st.lists(st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)), max_size=200),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF),
)
def test_encoders_add_up_fractions_and_wrap(steps, left, right):
    roomba = RoombaEmulator(left_encoder=left, right_encoder=right)
    for step in steps:
        roomba.add_wheel_travel(*step)
    per_metre = 508.8 / (math.pi * 0.072)
    for reading, begin, travel in zip(
        roomba.encoders, (left, right), (sum(s[0] for s in steps), sum(s[1] for s in steps)), strict=True
    ):
        assert 0 <= reading <= 0xFFFF
        error = (reading - begin - travel * per_metre + 0x8000) % 0x10000 - 0x8000
        assert -1.001 <= error <= 0.001


def test_sensor_answers_are_big_endian_and_of_the_right_size():
    roomba = awake()
    assert ask(roomba, 43) == (4047).to_bytes(2, "big")
    roomba.receive(bytes((145, 255, 56, 1, 44)), 0.0)
    assert ask(roomba, 41) == b"\xff\x38"
    assert ask(roomba, 42) == b"\x01\x2c"
    roomba.receive(bytes((149, 3, 35, 43, 9)), 0.0)
    assert roomba.outgoing(0.0) == b"\x02" + (4047).to_bytes(2, "big") + b"\x00"
    assert ask(roomba, 59) == b""


@pytest.mark.data
def test_every_packet_and_group_has_the_size_of_the_collected_tables(data_dir):
    roomba = awake()
    for line in (data_dir / "roomba" / "oi_packets.csv").read_text().splitlines()[1:]:
        packet_id, _, _, size = line.split(",")[:4]
        assert len(ask(roomba, int(packet_id))) == int(size)
    for group, facts in json.loads((data_dir / "roomba" / "oi_groups.json").read_text()).items():
        assert len(ask(roomba, int(group))) == facts["bytes"]


@pytest.mark.data
def test_every_opcode_takes_its_arguments(data_dir):
    # If an opcode's length were wrong, the sensor request after it would be taken for its data or its data for opcodes.
    answer = (4047).to_bytes(2, "big")
    commands = json.loads((data_dir / "roomba" / "roombex_vectors.json").read_text())["commands"]
    for _, raw in commands:
        roomba = awake()
        roomba.receive(bytes(raw) + bytes((142, 43)), 0.0)
        assert roomba.outgoing(0.0) == (b"" if raw[0] == POWER else answer)
    for line in (data_dir / "roomba" / "oi_opcodes.csv").read_text().splitlines()[1:]:
        if line.startswith("#"):
            continue
        opcode, name, rest = line.split(",", 2)
        size = rest.split('"')[1].split(" ")[0] if '"' in rest else rest.split(",")[0]
        if not size.isdigit() or name in {"RESET", "STOP", "SENSORS"}:
            continue
        roomba = awake()
        roomba.receive(bytes((int(opcode), *([0] * int(size)), 142, 43)), 0.0)
        assert roomba.outgoing(0.0) == (b"" if int(opcode) == POWER else answer), name


def test_the_stream_comes_every_15_ms_with_a_sum_of_zero():
    roomba = awake()
    roomba.receive(bytes((148, 2, 43, 35)), 0.0)
    assert roomba.outgoing(0.0149) == b""
    frame = roomba.outgoing(0.0151)
    assert frame[:-1] == bytes((19, 5, 43, 15, 207, 35, 2))
    assert sum(frame) % 256 == 0
    assert len(roomba.outgoing(0.1501)) == 9 * 8
    roomba.receive(bytes((150, 0)), 0.2)
    roomba.outgoing(0.2)
    assert roomba.outgoing(0.5) == b""
    roomba.receive(bytes((150, 1)), 0.5)
    assert len(roomba.outgoing(0.5301)) == 2 * 8


def test_no_burst_after_a_pause_of_the_simulation():
    roomba = awake()
    roomba.receive(bytes((148, 1, 35)), 0.0)
    assert len(roomba.outgoing(100.0)) == 5


def test_stream_reports_the_change_to_passive():
    roomba = awake()
    roomba.receive(bytes((148, 1, 35)), 0.0)
    roomba.receive(DRIVE_300, 0.0)
    roomba.world.cliff_left = True
    roomba.tick(0.016, 0.016)
    assert roomba.outgoing(0.016)[3] == PASSIVE


def test_reset_prints_text_and_forgets_encoders_and_stream():
    roomba = awake()
    roomba.receive(bytes((148, 1, 35)), 0.0)
    roomba.receive(b"\x07", 0.0)
    assert roomba.outgoing(1.0) == BOOT_TEXT
    assert (roomba.mode, roomba.encoders) == (OFF, (0, 0))


def test_the_battery_falls_faster_while_driving_and_fills_on_the_dock():
    idle, driving, docked = awake(FULL), awake(FULL), awake(PASSIVE)
    driving.receive(DRIVE_300, 0.0)
    docked.world.home_base = True
    begin = idle.battery.charge_mah
    for step in range(600):
        for roomba in (idle, driving, docked):
            roomba.tick(step * 1.0, 1.0)
    assert driving.battery.charge_mah < idle.battery.charge_mah < begin < docked.battery.charge_mah
    assert driving.battery.voltage_mv < idle.battery.voltage_mv < docked.battery.voltage_mv
    assert int.from_bytes(ask(driving, 23), "big", signed=True) < 0
    assert ask(docked, 21) in {b"\x02", b"\x03"}
    assert ask(docked, 34) == b"\x02"


def test_an_empty_battery_switches_the_robot_off():
    roomba = RoombaEmulator(battery=Battery(charge_mah=0.1))
    roomba.receive(b"\x80\x83" + DRIVE_300, 0.0)
    for step in range(10):
        roomba.tick(step * 1.0, 1.0)
    assert (roomba.mode, roomba.wheel_speeds_m_s) == (OFF, (0.0, 0.0))


@given(st.binary(max_size=300), st.lists(st.integers(1, 40), max_size=12))
@example(b"\x85\xad", [1])  # Power, then Stop, which a sleeping robot does not hear
def test_any_bytes_in_any_pieces_have_the_same_effect_and_never_raise(data, sizes):
    whole, cut = awake(), awake()
    whole.receive(data, 0.0)
    at = 0
    for size in sizes:
        cut.receive(data[at : at + size], 0.0)
        at += size
    cut.receive(data[at:], 0.0)
    whole.tick(0.1, 0.1)
    cut.tick(0.1, 0.1)
    assert whole.outgoing(0.1) == cut.outgoing(0.1)
    assert (whole.mode, whole.wheel_speeds_m_s) == (cut.mode, cut.wheel_speeds_m_s)
    assert all(abs(speed) <= 0.5 for speed in whole.wheel_speeds_m_s)
