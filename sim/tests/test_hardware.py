"""Base and lidar as bytes: drive commands move the robot, and no line is faster than its baud rate."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.grid import GridGeometry
from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite
from fognav_sim import devices
from fognav_sim.floor import Floor
from fognav_sim.hardware import Hardware, Line
from fognav_sim.world import World

BAUD = 115_200
TICK_M = np.pi * 0.072 / 508.8
DRIVE_200 = bytes([128, 131, 145, 0, 200, 0, 200])
STREAM = bytes([148, 3, 7, 43, 44])
SCAN = bytes([0xA5, 0x20])


def hall():
    geometry = GridGeometry(120, 80, 0.05, 0.0, 0.0)
    cells = np.zeros(geometry.shape, np.uint8)
    cells[:2], cells[-2:], cells[:, :2], cells[:, -2:] = 254, 254, 254, 254
    return World(
        Floor(geometry, cells),
        RobotSite(id="r1", start=Pose(x=1.0, y=2.0, theta=0.0), radius=0.17),
        seed=1,
        axle_m=0.235,
    )


def hardware_in(world, start=0.0, **more):
    return Hardware(world, devices.make_base("roomba600"), devices.make_lidar("rplidar-a1", world.lidar), start, **more)


@given(chunks=st.lists(st.integers(0, 400), min_size=1, max_size=60))
def test_line_delivers_bytes_in_order_and_never_faster_than_its_rate(chunks):
    line, delivered, queued, now = Line(BAUD), b"", b"", 0.0
    for size in chunks:
        data = bytes(len(queued) + n & 0xFF for n in range(size))
        queued += data
        delivered += line.send(data, 0.01)
        now += 0.01
        assert len(delivered) <= BAUD / 10 * now + 1e-6
        assert delivered == queued[: len(delivered)] or line.lost_bytes
    if not line.lost_bytes:
        for _ in range(1000):
            delivered += line.send(b"", 0.01)
        assert delivered == queued


def test_line_that_is_too_slow_drops_the_oldest_bytes_and_counts_them():
    line = Line(BAUD)
    data = bytes(6000)
    line.send(data, 0.0)
    assert line.lost_bytes == 6000 - 4096


def test_command_waits_for_what_the_host_wrote_before_it():
    hardware = hardware_in(hall())
    hardware.receive(bytes(BAUD // 10 // 10) + DRIVE_200, b"")  # a tenth of a second of the line
    for _ in range(10):
        hardware.step()
    assert hardware.base.wheel_speeds_m_s == (0.0, 0.0)
    hardware.step()
    assert hardware.base.wheel_speeds_m_s == (0.2, 0.2)


def test_drive_direct_moves_the_robot_and_its_encoders():
    world = hall()
    hardware = hardware_in(world, 5.0, initial_wheel_travel_m=(65_500 * TICK_M, 0.0))
    hardware.receive(DRIVE_200, b"")
    for _ in range(200):
        hardware.step()
    assert hardware.now == pytest.approx(7.0)
    assert world.distance == pytest.approx(0.4, abs=0.02)
    ticks = (hardware.base.encoders[0] - 65_500) & 0xFFFF
    assert ticks == pytest.approx(0.4 * 508.8 / (np.pi * 0.072), rel=0.05)


def test_wall_stops_the_robot_as_one_contact_and_shows_in_the_bumper_bits():
    world = hall()
    hardware = hardware_in(world)
    hardware.receive(DRIVE_200 + STREAM, b"")
    received = b""
    for _ in range(3000):
        received += hardware.step()[0]
    assert world.contacts == 1
    assert world.pose[0] < 6.0 - 0.1 - 0.17 + 0.01
    frame = received[received.rindex(b"\x13\x08\x07") :]
    assert frame[3] & 3 == 3  # both halves: it drove straight into the wall
    x_at_wall = world.pose[0]
    hardware.receive(bytes([145, 0xFF, 0x38, 0xFF, 0x38]), b"")
    for _ in range(200):
        hardware.step()
    assert world.pose[0] < x_at_wall - 0.2
    assert (world.contacts, world.bumpers) == (1, (False, False))


def test_scans_and_sensor_stream_fit_on_their_lines():
    hardware = hardware_in(hall())
    hardware.receive(DRIVE_200 + STREAM, SCAN)
    base, lidar = 0, 0
    for _ in range(1000):
        from_base, from_lidar = hardware.step()
        base, lidar = base + len(from_base), lidar + len(from_lidar)
    assert hardware.base_line.lost_bytes == hardware.lidar_line.lost_bytes == 0
    assert base == pytest.approx(10.0 / 0.015 * 11, rel=0.02)
    assert lidar == pytest.approx(10.0 * 10_000, rel=0.02)
