"""A lidar mounted anywhere, upside down or behind posts gives the scan of one that is mounted plainly."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.robot import BaseSettings, LidarSettings, RobotSettings
from fog_runtime.configuration.robot_file import RobotFile
from fognav_sim.sensors import LidarPlace
from robot_agent.agent.recording.input_log import ScanReceived
from robot_agent.agent.safety_supervisor import LidarSource
from robot_agent.config import LocalizationConfig
from robot_agent.hardware import LaserScan, LidarSamples
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator
from robot_agent.localization.odometry import OdometryBuffer
from robot_agent.localization.scans import deskew
from robot_agent.registry import make_lidar
from robot_agent.scan_builder import MountedLidar, Mounting

ANGLES = np.linspace(-math.pi + 0.001, math.pi, 360)


def scan_of(angles=ANGLES, ranges=None):
    ranges = np.full(angles.size, 2.0) if ranges is None else ranges
    return LaserScan(angles, ranges, np.full(angles.size, 9, np.uint8), started_at=1.0, ended_at=1.18, repeats=1)


def test_a_mask_removes_its_sector_in_the_frame_of_the_robot_also_across_the_back():
    mounting = Mounting(yaw_rad=0.5, masks=((3.0, -3.0), (0.4, 0.6)))
    scan = mounting.apply(scan_of()).unmasked()
    bearings = np.remainder(scan.angles_rad + 0.5 + math.pi, math.tau) - math.pi
    assert not ((bearings > 3.0) | (bearings < -3.0) | ((bearings > 0.4) & (bearings < 0.6))).any()
    lost = ANGLES.size - bearings.size
    assert lost == pytest.approx(360 * (math.tau - 6.0 + 0.2) / math.tau, abs=2)
    assert len(scan.ranges_m) == len(scan.quality) == len(bearings)


def test_masked_samples_move_none_of_the_others_in_time():
    """A wall at y = -1 m, seen by a robot that turns once in four seconds: the masks were cut out of the turn."""
    odometry, times = OdometryBuffer(), np.linspace(1.0, 1.18, ANGLES.size)
    for number in range(60):
        odometry.add(0.9 + 0.005 * number, 0.0, 0.0, 1.5 * 0.005 * number)
    bearings = ANGLES + 1.5 * (times - 0.9)
    with np.errstate(divide="ignore"):
        ranges = np.where(np.sin(bearings) < -0.2, -1.0 / np.sin(bearings), np.nan)
    masked = Mounting(masks=((-3.1, -1.9), (0.1, 2.0))).apply(scan_of(ranges=ranges))
    logged = msgspec.json.decode(msgspec.json.encode(ScanReceived.of(masked, 1.2)), type=ScanReceived)
    for scan in (masked, logged.scan()):
        deskewed = deskew(scan, odometry, LocalizationConfig())
        points = deskewed.odom.transform(deskewed.points)
        assert len(points) > 60
        assert points[:, 1] == pytest.approx(-1.0, abs=1e-3)
        assert np.array_equal(scan.masked, masked.masked)


def test_a_scan_of_a_log_from_before_masks_were_kept_in_place_is_read_as_it_is():
    entry = msgspec.json.decode(msgspec.json.encode(ScanReceived.of(scan_of(), 1.2)))
    del entry["masked"]
    scan = msgspec.convert(entry, ScanReceived, strict=False).scan()
    assert scan.masked is None
    assert np.array_equal(scan.ranges_m, scan_of().ranges_m)
    assert scan.unmasked() is scan


def test_a_lidar_of_which_most_is_masked_does_not_count_as_one_that_sees_nothing():
    masked = Mounting(masks=((0.2, -0.2),)).apply(scan_of())
    source = LidarSource(returns_least=0.5)
    source.on_scan(masked, 1.2)
    assert source.empty_scans == 0
    source.on_scan(Mounting(masks=((0.2, -0.2),)).apply(scan_of(ranges=np.full(ANGLES.size, np.nan))), 1.4)
    assert source.empty_scans == 1


def test_latency_moves_the_times_of_a_scan():
    scan = Mounting(latency_s=0.05).apply(scan_of())
    assert (scan.started_at, scan.ended_at) == pytest.approx((0.95, 1.13))


@given(st.lists(st.floats(-math.pi, math.pi, exclude_min=True), min_size=1, max_size=20))
def test_a_mirrored_scan_keeps_its_angles_in_range_and_twice_mirrored_is_unchanged(angles):
    upside_down = Mounting(mirrored=True)
    once = upside_down.apply(scan_of(np.array(angles)))
    assert ((once.angles_rad > -math.pi) & (once.angles_rad <= math.pi)).all()
    assert upside_down.apply(once).angles_rad == pytest.approx(np.array(angles))


@pytest.mark.parametrize(
    "settings",
    [
        LidarSettings(driver="rplidar-a1", x_m=0.1, y_m=-0.05, yaw_rad=0.7),
        LidarSettings(driver="rplidar-a1", x_m=-0.12, yaw_rad=-2.0, mirrored=True),
    ],
)
def test_walls_stand_where_they_are_however_the_lidar_is_mounted(settings):
    """A wall at x = 3 m, seen by the emulated lidar at its place, through driver, mounting and deskewing."""
    place = LidarPlace(x=settings.x_m, y=settings.y_m, yaw=settings.yaw_rad, mirrored=settings.mirrored)
    x, _, yaw = place.pose((0.0, 0.0, 0.0))

    def measure(angles, _now):
        cosines = np.cos((-angles if place.mirrored else angles) + yaw)
        with np.errstate(divide="ignore"):
            return np.where(cosines > 0.3, (3.0 - x) / cosines, np.nan)

    robot = RobotFile(settings=RobotSettings(base=BaseSettings(driver="roomba600"), lidar=settings))
    driver, device = make_lidar(robot), RplidarEmulator(measure)
    assert isinstance(driver, MountedLidar) is settings.mirrored
    now, scans = 10.0, []
    device.receive(driver.begin(now), now)
    odometry = OdometryBuffer()
    while not scans:
        assert now < 70.0, "the lidar has sent no whole scan in a minute"
        now += 0.02
        odometry.add(now, 0.0, 0.0, 0.0)
        events = driver.receive(device.outgoing(now), now)
        scans += events.scans
        device.receive(events.data + driver.tick(now), now)
    odometry.add(now + 0.1, 0.0, 0.0, 0.0)
    config = LocalizationConfig(lidar_x=settings.x_m, lidar_y=settings.y_m, lidar_yaw=settings.yaw_rad)
    points = deskew(scans[-1], odometry, config).points
    assert len(points) > 50
    assert points[:, 0] == pytest.approx(3.0, abs=0.03)
    assert driver.stop_command
    assert driver.problem == ""


def test_samples_of_the_stop_field_are_mounted_as_the_scans_are_and_masked_ones_have_no_return():
    angles = np.array([-3.0, -0.5, 0.5, 3.0], np.float32)
    samples = LidarSamples(angles, np.full(4, 1.0, np.float32), 5.0, 5.1)
    mounted = Mounting(mirrored=True, latency_s=0.05, masks=((0.4, 0.6),)).apply_to_samples(samples)
    assert mounted.angles_rad == pytest.approx([3.0, 0.5, -0.5, -3.0])
    assert np.isnan(mounted.ranges_m).tolist() == [False, True, False, False]
    assert (mounted.started_at, mounted.ended_at) == pytest.approx((4.95, 5.05))
    assert mounted.angles_rad.dtype == mounted.ranges_m.dtype == np.float32
    behind = LidarSamples(np.array([math.pi], np.float32), np.ones(1, np.float32), 0.0, 0.0)
    assert abs(Mounting(mirrored=True).apply_to_samples(behind).angles_rad[0]) == pytest.approx(math.pi)
