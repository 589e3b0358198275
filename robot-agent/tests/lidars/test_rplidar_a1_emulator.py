from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.lidars.rplidar_a1.emulator import BOOT_TEXT, RplidarEmulator

SCAN = bytes.fromhex("a55a0500004081")


def box(angles, now):
    """Walls of a room 6 m by 4 m, the scanner in the middle, a door without return straight ahead."""
    ranges = 1.0 / np.maximum(np.abs(np.cos(angles)) / 3.0, np.abs(np.sin(angles)) / 2.0)
    return np.where(np.abs(angles) < 0.1, np.nan, ranges)


def nodes_of(data: bytes) -> np.ndarray:
    assert len(data) % 5 == 0
    return np.frombuffer(data, np.uint8).reshape(-1, 5).astype(int)


def scanned(lidar: RplidarEmulator, seconds: float, step: float = 0.01) -> bytes:
    lidar.receive(b"\xa5\x20", 0.0)
    assert lidar.outgoing(0.0) == SCAN
    return b"".join(lidar.outgoing(number * step) for number in range(1, round(seconds / step) + 1))


def test_requests_get_their_descriptors():
    lidar = RplidarEmulator(box)
    lidar.receive(b"\xa5\x50", 0.0)
    info = lidar.outgoing(0.0)
    assert info[:7] == bytes.fromhex("a55a1400000004")
    assert len(info) == 27
    lidar.health, lidar.error_code = 1, 0x1234
    lidar.receive(b"\xa5\x52", 0.0)
    assert lidar.outgoing(0.0) == bytes.fromhex("a55a0300000006013412")
    lidar.receive(b"\xa5\x59", 0.0)
    assert lidar.outgoing(0.0) == bytes.fromhex("a55a0400000015") + (500).to_bytes(2, "little") + (250).to_bytes(
        2, "little"
    )
    lidar.receive(b"\xa5\x40", 0.0)
    assert lidar.outgoing(0.0) == BOOT_TEXT


def test_nothing_is_sent_before_a_scan_and_after_stop():
    lidar = RplidarEmulator(box)
    assert lidar.outgoing(5.0) == b""
    scanned(lidar, 0.1)
    lidar.receive(b"\xa5\x25", 0.1)
    assert lidar.outgoing(2.0) == b""
    assert not lidar.scanning


def test_two_thousand_nodes_a_second_with_right_check_bits():
    nodes = nodes_of(scanned(RplidarEmulator(box), 2.0))
    assert len(nodes) == pytest.approx(4000, abs=1)
    assert ((nodes[:, 0] & 1) != (nodes[:, 0] >> 1 & 1)).all()
    assert (nodes[:, 1] & 1).all()


def test_angles_run_clockwise_five_and_a_half_times_a_second():
    nodes = nodes_of(scanned(RplidarEmulator(box), 4.0))
    angle = (nodes[:, 1] >> 1 | nodes[:, 2] << 7) / 64.0
    starts = np.flatnonzero(nodes[:, 0] & 1)
    assert len(starts) == 22
    assert set(np.diff(starts)) <= {363, 364}
    assert (angle[starts] < 1.0).all()
    steps = np.diff(angle) % 360.0
    assert steps.max() < 1.1
    assert angle.max() < 360.0


def test_distances_are_those_of_the_world_at_counter_clockwise_angles():
    def wedge(angles, now):
        return np.where((angles > 0.5) & (angles < 0.6), 1.0, np.nan)

    nodes = nodes_of(scanned(RplidarEmulator(wedge), 0.5))
    angle = np.deg2rad((nodes[:, 1] >> 1 | nodes[:, 2] << 7) / 64.0)
    distance = nodes[:, 3] | nodes[:, 4] << 8
    quality = nodes[:, 0] >> 2
    hit = distance > 0
    assert hit.sum() > 10
    assert (distance[hit] == 4000).all()
    assert (quality[hit] == 15).all()
    assert (quality[~hit] == 0).all()
    # Clockwise on the wire: the wedge to the left of the nose shows near 330 degrees.
    assert ((2 * math.pi - angle[hit] > 0.5) & (2 * math.pi - angle[hit] < 0.6)).all()


def test_the_world_is_measured_in_small_chunks_in_order_of_time():
    calls = []

    def measure(angles, now):
        calls.append((len(angles), now))
        return np.full(len(angles), 2.0)

    scanned(RplidarEmulator(measure), 0.5, step=0.1)
    assert max(count for count, _ in calls) <= 32
    times = [now for _, now in calls]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(0.5, abs=0.001)


def test_ranges_outside_the_rated_ones_give_no_return():
    for metres in (0.1, 12.5, math.inf, math.nan):
        nodes = nodes_of(scanned(RplidarEmulator(lambda angles, _, m=metres: np.full(len(angles), m)), 0.1))
        assert (nodes[:, 3:] == 0).all()


def test_a_resting_robot_never_sees_two_identical_scans():
    nodes = nodes_of(scanned(RplidarEmulator(box), 2.0))
    starts = np.flatnonzero(nodes[:, 0] & 1)
    scans = [nodes[a:b].tobytes() for a, b in itertools.pairwise(starts)]
    assert all(a != b for a, b in itertools.pairwise(scans))


def test_a_stalled_head_is_silent_and_goes_on_without_a_burst():
    lidar = RplidarEmulator(box)
    scanned(lidar, 0.2)
    lidar.stalled = True
    assert lidar.outgoing(0.4) == b""
    lidar.stalled = False
    assert len(lidar.outgoing(0.41)) <= 5 * 21


def test_a_device_in_error_does_not_scan():
    lidar = RplidarEmulator(box)
    lidar.health = 2
    lidar.receive(b"\xa5\x20", 0.0)
    assert lidar.outgoing(1.0) == SCAN


def test_express_capsules_have_sync_nibbles_and_a_right_checksum():
    lidar = RplidarEmulator(box)
    lidar.receive(bytes.fromhex("a58205000000000022"), 0.0)
    assert lidar.outgoing(0.0) == bytes.fromhex("a55a5400004082")
    data = b"".join(lidar.outgoing(number * 0.01) for number in range(1, 101))
    capsules = np.frombuffer(data, np.uint8).reshape(-1, 84)
    assert len(capsules) == 125
    assert (capsules[:, 0] >> 4 == 0xA).all()
    assert (capsules[:, 1] >> 4 == 0x5).all()
    assert (np.bitwise_xor.reduce(capsules[:, 2:], axis=1) == (capsules[:, 0] & 15 | capsules[:, 1] << 4)).all()
    assert [bool(flag) for flag in capsules[:, 3] & 0x80] == [True] + [False] * 124


def test_a_request_with_a_wrong_checksum_is_ignored():
    lidar = RplidarEmulator(box)
    lidar.receive(bytes.fromhex("a58205000000000023") + b"\xa5\x52", 0.0)
    assert lidar.outgoing(0.0)[:7] == bytes.fromhex("a55a0300000006")


def test_more_nodes_than_the_line_carries_are_refused():
    with pytest.raises(ValueError, match="2304"):
        RplidarEmulator(box, nodes_per_s=8000)


@given(st.binary(max_size=200), st.lists(st.integers(1, 30), max_size=8))
def test_any_bytes_in_any_pieces_have_the_same_effect_and_never_raise(data, sizes):
    whole, cut = RplidarEmulator(box), RplidarEmulator(box)
    whole.receive(data, 0.0)
    at = 0
    for size in sizes:
        cut.receive(data[at : at + size], 0.0)
        at += size
    cut.receive(data[at:], 0.0)
    assert whole.outgoing(0.05) == cut.outgoing(0.05)


def test_a_lidar_that_freezes_with_the_first_node_of_a_turn_goes_on():
    lidar, now = RplidarEmulator(box), 0.0
    for _ in range(400):  # a turn has fewer nodes: one of these scans begins with its first
        lidar.frozen = False
        lidar.receive(b"\xa5\x20", now)
        lidar.outgoing(now)
        lidar.outgoing(now := now + 0.00051)
        lidar.frozen = True
        now += 0.0011
        assert nodes_of(lidar.outgoing(now)).size
