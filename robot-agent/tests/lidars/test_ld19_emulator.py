from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from robot_agent.lidars.ld19.emulator import Ld19Emulator, crc8


def box(angles, now):
    """Walls of a room 6 m by 4 m, a door without return straight ahead."""
    ranges = 1.0 / np.maximum(np.abs(np.cos(angles)) / 3.0, np.abs(np.sin(angles)) / 2.0)
    return np.where(np.abs(angles) < 0.1, np.nan, ranges)


def sent(lidar: Ld19Emulator, seconds: float, begin: float = 0.0) -> np.ndarray:
    """Packets of so many seconds as rows of 47 bytes."""
    data = b"".join(lidar.outgoing(begin + 0.01 * number) for number in range(round(seconds / 0.01) + 1))
    assert len(data) % 47 == 0
    return np.frombuffer(data, np.uint8).reshape(-1, 47).astype(int)


def u16(packets: np.ndarray, column: int) -> np.ndarray:
    return packets[:, column] | packets[:, column + 1] << 8


def test_lidar_sends_from_power_on_375_packets_a_second_with_right_checksums():
    packets = sent(Ld19Emulator(box), 2.0)
    assert len(packets) == pytest.approx(750, abs=1)
    assert (packets[:, 0] == 0x54).all()
    assert (packets[:, 1] == 0x2C).all()
    assert all(crc8(bytes(row[:46].tolist())) == row[46] for row in packets[:50])


def test_the_checksum_is_the_makers():
    assert [crc8(bytes((value,))) for value in (1, 2, 64, 255)] == [0x4D, 0x9A, 0x3E, 0xA8]


def test_angles_run_clockwise_about_ten_times_a_second():
    packets = sent(Ld19Emulator(box), 4.0)
    start = u16(packets, 4)
    assert (np.diff(start) < 0).sum() == pytest.approx(40, abs=1)
    assert set(np.diff(start) % 36_000) <= {962, 963}
    assert (u16(packets, 2) == 3611).all()
    assert ((u16(packets, 42) - start) % 36_000 == 883).all()


def test_distances_are_those_of_the_world_at_counter_clockwise_angles():
    def wedge(angles, now):
        return np.where((angles > 0.5) & (angles < 0.6), 1.0, np.nan)

    packets = sent(Ld19Emulator(wedge), 0.5)
    angle = np.deg2rad((u16(packets, 4)[:, None] + 883 * np.arange(12) / 11) % 36_000 / 100).reshape(-1)
    samples = packets[:, 6:42].reshape(-1, 3)
    distance, strength = samples[:, 0] | samples[:, 1] << 8, samples[:, 2]
    hit = distance > 0
    assert hit.sum() > 10
    assert (distance[hit] == 1000).all()
    assert (strength[hit] > 200).all()
    assert (strength[~hit] == 0).all()
    # Clockwise on the wire: the wedge to the left of the nose shows near 330 degrees.
    assert ((2 * math.pi - angle[hit] > 0.5) & (2 * math.pi - angle[hit] < 0.6)).all()


def test_ranges_outside_the_rated_ones_give_no_return():
    for metres in (0.01, 12.5, math.inf, math.nan):
        packets = sent(Ld19Emulator(lambda angles, _, m=metres: np.full(len(angles), m)), 0.1)
        assert (packets[:, 6:42] == 0).all()


def test_a_resting_robot_never_sees_two_identical_scans():
    packets = sent(Ld19Emulator(box), 2.0)
    begins = np.flatnonzero(np.diff(u16(packets, 4)) < 0) + 1
    scans = [packets[a:b, :46].tobytes() for a, b in itertools.pairwise(begins)]
    assert len(scans) > 15
    assert all(a != b for a, b in itertools.pairwise(scans))


def test_bytes_from_the_host_have_no_effect():
    lidar, commanded = Ld19Emulator(box), Ld19Emulator(box)
    commanded.receive(b"\xa5\x25 stop!", 0.0)
    assert (sent(lidar, 0.1) == sent(commanded, 0.1)).all()


def test_a_stalled_head_is_silent_and_goes_on_without_a_burst():
    lidar = Ld19Emulator(box)
    sent(lidar, 0.2)
    lidar.stalled = True
    assert lidar.outgoing(0.4) == b""
    lidar.stalled = False
    assert len(lidar.outgoing(0.41)) <= 47 * 5
    assert lidar.outgoing(50.0) == b"", "a pause gives no burst"
