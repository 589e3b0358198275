"""Drivers and emulators share no code; here they must agree."""

from __future__ import annotations

import math
import select
import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fognav_sim.pty_port import PtyPort
from robot_agent.bases.roomba600 import open_interface as oi
from robot_agent.bases.roomba600.driver import Roomba600Driver, Roomba600Options
from robot_agent.bases.roomba600.emulator import SAFE, RoombaEmulator
from robot_agent.lidars.rplidar_a1 import protocol as rplidar
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator
from robot_agent.localization.odometry import EncoderFault, Motion, Odometry
from robot_agent.serial_port import open_port


def box(angles, now):
    """Walls of a room 6 m by 4 m with a door without return ahead."""
    ranges = 1.0 / np.maximum(np.abs(np.cos(angles)) / 3.0, np.abs(np.sin(angles)) / 2.0)
    return np.where(np.abs(angles) < 0.1, np.nan, ranges)


def events(parser):
    while (event := parser.next_event()) is not None:
        yield event


# --- Roomba ---


@pytest.mark.parametrize("packet_id", [*range(7, 59), *oi.GROUPS])
def test_driver_and_emulator_agree_on_the_size_of_every_packet_and_group(packet_id):
    roomba = RoombaEmulator()
    roomba.receive(oi.start() + oi.sensors(packet_id), 0.0)
    oi.decode_packets([packet_id], roomba.outgoing(0.0))


def test_stream_carries_the_state_of_the_world():
    roomba = RoombaEmulator(left_encoder=65530, right_encoder=3)
    parser = oi.StreamParser(oi.GUARDIAN_STREAM)
    roomba.receive(oi.start() + oi.safe() + oi.stream(oi.GUARDIAN_STREAM) + oi.drive_wheels(0.3, -0.2), 0.0)
    roomba.world.bump_right = True
    roomba.world.virtual_wall = True
    roomba.world.overcurrent_left = True
    roomba.add_wheel_travel(0.01, -0.01)
    roomba.tick(0.015, 0.015)
    parser.receive_data(roomba.outgoing(0.015))
    (frame,) = events(parser)
    assert frame.mode is oi.Mode.SAFE
    assert (frame.bump_right, frame.bump_left, frame.wheel_dropped, frame.cliff) == (True, False, False, False)
    assert frame.virtual_wall
    assert frame.wheel_overcurrent
    assert frame.requested_wheels_m_s == (0.3, -0.2)
    assert frame.encoders == ((65530 + 22) & 0xFFFF, (3 - 23) & 0xFFFF)
    assert 12.0 < frame.voltage_v < 17.0
    assert frame.current_a < 0.0
    assert 0.0 < frame.charge_fraction <= 1.0
    assert not frame.on_charger


@pytest.mark.parametrize(
    ("field", "flag"),
    [
        ("bump_left", "bump_left"),
        ("bump_right", "bump_right"),
        ("wheel_drop_left", "wheel_drop_left"),
        ("wheel_drop_right", "wheel_drop_right"),
        ("cliff_left", "cliff_left"),
        ("cliff_front_left", "cliff_front_left"),
        ("cliff_front_right", "cliff_front_right"),
        ("cliff_right", "cliff_right"),
        ("home_base", "on_charger"),
        ("charger", "on_charger"),
    ],
)
def test_each_safety_sensor_sets_its_flag_and_all_but_the_bumper_end_safe_mode(field, flag):
    roomba = RoombaEmulator()
    parser = oi.StreamParser(oi.GUARDIAN_STREAM)
    roomba.receive(oi.start() + oi.safe() + oi.stream(oi.GUARDIAN_STREAM) + oi.drive_wheels(0.2, 0.2), 0.0)
    setattr(roomba.world, field, True)
    roomba.tick(0.02, 0.02)
    parser.receive_data(roomba.outgoing(0.02))
    (frame,) = events(parser)
    flags = {"bump_left", "bump_right", "wheel_drop_left", "wheel_drop_right", "on_charger"} | {
        f"cliff_{side}" for side in ("left", "front_left", "front_right", "right")
    }
    assert {name for name in flags if getattr(frame, name)} == {flag}
    bumper = flag.startswith("bump")
    assert frame.mode is (oi.Mode.SAFE if bumper else oi.Mode.PASSIVE)
    assert frame.requested_wheels_m_s == ((0.2, 0.2) if bumper else (0.0, 0.0))


@settings(max_examples=25)
@given(
    st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)), min_size=1, max_size=8),
    st.integers(0, 0xFFFF),
    st.integers(0, 0xFFFF),
)
def test_odometry_follows_any_drive_through_any_encoder_wrap(legs, left, right):
    roomba = RoombaEmulator(left_encoder=left, right_encoder=right)
    driver = Roomba600Driver(Roomba600Options())
    odometry = Odometry(driver.drive_train)
    roomba.receive(oi.start() + oi.safe() + oi.stream(oi.GUARDIAN_STREAM), 0.0)
    now, pose = 0.0, (0.0, 0.0, 0.0)
    for leg in legs:
        roomba.receive(oi.drive_wheels(*leg), now)
        for _ in range(66):
            now += 0.015
            v_left, v_right = roomba.wheel_speeds_m_s
            if now > 0.03:
                roomba.add_wheel_travel(v_left * 0.015, v_right * 0.015)
                # Independent of the driver's formula: many short straight pieces.
                for _ in range(4):
                    x, y, theta = pose
                    theta += (v_right - v_left) * 0.015 / 4 / 0.235 / 2
                    x += (v_left + v_right) / 2 * 0.015 / 4 * math.cos(theta)
                    y += (v_left + v_right) / 2 * 0.015 / 4 * math.sin(theta)
                    pose = (x, y, theta + (v_right - v_left) * 0.015 / 4 / 0.235 / 2)
            roomba.tick(now, 0.015)
            driver.receive_data(roomba.outgoing(now), now)
            for reading in events(driver):
                assert isinstance(odometry.update(reading.odometry, now), Motion)
    # A tick is 0.44 mm of a wheel, 1.9 mrad of heading.
    assert odometry.pose[2] == pytest.approx(pose[2], abs=0.006)
    assert math.dist(odometry.pose[:2], pose[:2]) < 0.002 + 0.006 * len(legs)


def test_reset_of_the_robot_is_detected_as_an_encoder_fault():
    roomba = RoombaEmulator(left_encoder=30000, right_encoder=30000)
    driver = Roomba600Driver(Roomba600Options())
    odometry = Odometry(driver.drive_train)
    roomba.receive(driver.wake(), 0.0)
    driver.receive_data(roomba.outgoing(0.016), 0.016)
    (reading,) = events(driver)
    odometry.update(reading.odometry, 0.016)
    roomba.receive(oi.reset(), 0.02)
    driver.receive_data(roomba.outgoing(1.0), 1.0)
    assert list(events(driver)) == []
    roomba.receive(driver.wake(), 1.0)
    driver.receive_data(roomba.outgoing(1.016), 1.016)
    (reading,) = events(driver)
    assert isinstance(odometry.update(reading.odometry, 1.016), EncoderFault)


speed = st.integers(-500, 500)


@given(st.lists(st.tuples(speed, speed), min_size=4, max_size=6), st.data())
def test_a_lost_byte_confuses_a_roomba_for_two_wheel_commands_at_most(speeds, data):
    driver, roomba = Roomba600Driver(Roomba600Options()), RoombaEmulator()
    roomba.receive(oi.start() + oi.safe(), 0.0)
    commands = [driver.drive(left / 1000, right / 1000) for left, right in speeds]
    place = data.draw(st.integers(0, len(commands[0]) - 1), label="lost byte of the first command")
    commands[0] = commands[0][:place] + commands[0][place + 1 :]
    for command in commands:
        roomba.receive(command, 0.0)
    obeys = roomba.wheel_speeds_m_s == pytest.approx([speed / 1000 for speed in speeds[-1]], abs=0.0021)
    assert obeys or roomba.mode != SAFE, "a mode that the stream reports"


@given(st.binary(max_size=9))
@example(bytes((0, 145)))
@example(bytes((149, 255)))
@example(bytes((140, 0, 255)))
def test_a_rolling_roomba_obeys_zero_speeds_whatever_bytes_it_has_got(garbage):
    driver, roomba = Roomba600Driver(Roomba600Options()), RoombaEmulator()
    roomba.receive(oi.start() + oi.safe() + driver.drive(0.2, 0.2) + garbage + driver.drive(0.0, 0.0), 0.0)
    assert roomba.wheel_speeds_m_s == (0.0, 0.0) or roomba.cleaning or roomba.seeking_dock, "a mode that is reported"


# --- RPLidar ---


def test_device_info_and_health_are_received():
    lidar, parser = RplidarEmulator(box, serial_number=bytes(range(16, 32))), rplidar.Parser()
    lidar.health, lidar.error_code = 1, 7
    lidar.receive(rplidar.get_info() + rplidar.get_health() + rplidar.get_sample_rate(), 0.0)
    parser.receive_data(lidar.outgoing(0.0))
    answers = [event for event in events(parser) if not isinstance(event, rplidar.Descriptor)]
    assert answers == [
        rplidar.DeviceInfo(24, (1, 29), 7, bytes(range(16, 32)).hex().upper()),
        rplidar.Health(rplidar.HealthStatus.WARNING, 7),
        rplidar.SampleRate(500, 250),
    ]


def scans_of(lidar, request, seconds, step=0.013):
    parser, assembler = rplidar.Parser(), rplidar.ScanAssembler()
    lidar.receive(request, 0.0)
    scans = []
    for number in range(round(seconds / step)):
        parser.receive_data(lidar.outgoing(number * step))
        for event in events(parser):
            if isinstance(event, rplidar.Nodes):
                scans.extend(assembler.feed(event, number * step))
    assert (parser.skipped_bytes, parser.resyncs, parser.corrupted, assembler.incomplete) == (0, 0, 0, 0)
    return scans


@pytest.mark.parametrize(
    ("request_bytes", "nodes"), [(rplidar.scan(), 363.6), (rplidar.express_scan(), 727.3)], ids=["standard", "express"]
)
def test_rplidar_scans_show_the_room(request_bytes, nodes):
    scans = scans_of(RplidarEmulator(box), request_bytes, 2.0)
    assert 9 <= len(scans) <= 11
    for scan in scans:
        assert abs(scan.angles_rad.size - nodes) < 2
        truth = box(scan.angles_rad, 0.0)
        # Angles come in 1/64 degree: at the edges of the door one node may fall to either side.
        edge = np.abs(np.abs(scan.angles_rad) - 0.1) < 0.001
        assert (np.isnan(scan.ranges_m) == np.isnan(truth))[~edge].all()
        returned = ~np.isnan(scan.ranges_m) & ~edge
        np.testing.assert_allclose(scan.ranges_m[returned], truth[returned], atol=0.003)
        assert scan.repeats == 1
        assert scan.ended_at - scan.started_at == pytest.approx(1 / 5.5, abs=0.02)


def test_scan_restarted_in_mid_stream_gives_whole_scans():
    lidar = RplidarEmulator(box)
    parser, assembler = rplidar.Parser(), rplidar.ScanAssembler()
    scans = []
    for number in range(150):
        if number in {0, 75}:
            lidar.receive(rplidar.stop() + rplidar.get_health() + rplidar.scan(), number * 0.01)
        parser.receive_data(lidar.outgoing(number * 0.01))
        for event in events(parser):
            if isinstance(event, rplidar.Descriptor):
                assembler.reset()
            elif isinstance(event, rplidar.Nodes):
                scans += assembler.feed(event, number * 0.01)
    assert parser.resyncs == 0
    assert all(362 <= scan.angles_rad.size <= 365 for scan in scans)
    assert scans[-1].ended_at > 1.2


# --- over real ptys ---


@pytest.mark.live
def test_base_is_driven_over_a_pty_and_stopped_after_a_crash_of_its_host(tmp_path):
    roomba = RoombaEmulator(left_encoder=65000, right_encoder=65000)
    link = tmp_path / "roomba"
    begin = time.monotonic()
    last = begin
    driver = Roomba600Driver(Roomba600Options())
    odometry = Odometry(driver.drive_train)

    def simulate() -> None:
        nonlocal last
        select.select([line], [], [], 0.005)
        now = time.monotonic()
        roomba.receive(line.read(), now)
        left, right = roomba.wheel_speeds_m_s
        roomba.add_wheel_travel(left * (now - last), right * (now - last))
        roomba.tick(now, now - last)
        line.write(roomba.outgoing(now))
        last = now

    with PtyPort(link) as line:
        with open_port(str(link), 115200) as port:
            port.write(oi.start() + oi.safe() + oi.stream(oi.GUARDIAN_STREAM) + oi.drive_wheels(0.2, 0.2))
            while odometry.pose[0] < 0.05:
                assert time.monotonic() - begin < 20.0
                simulate()
                driver.receive_data(port.read_available(), time.monotonic())
                for reading in events(driver):
                    odometry.update(reading.odometry, time.monotonic())
        assert (driver.corrupted, odometry.faults) == (0, 0)
        # The host ended without a stop: the wheels keep turning. The next host stops them.
        simulate()
        assert roomba.wheel_speeds_m_s == (0.2, 0.2)
        with open_port(str(link), 115200) as port:
            port.write(oi.drive_direct(0, 0))
            while roomba.wheel_speeds_m_s != (0.0, 0.0):
                assert time.monotonic() - begin < 20.0
                simulate()
    assert not link.is_symlink()
