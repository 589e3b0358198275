"""A lidar's measurements: the kernels against the protocol's words, in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_kernels.lidar import batch, decode_nodes, in_metres

NODE = np.dtype([("first", "u1"), ("angle", "<u2"), ("distance", "<u2")])


def node(start, quality, angle_q6, distance_q2):
    first = quality << 2 | (1 if start else 2)
    return bytes([first]) + (angle_q6 << 1 | 1).to_bytes(2, "little") + distance_q2.to_bytes(2, "little")


NODES = st.tuples(st.booleans(), st.integers(0, 63), st.integers(0, 23039), st.integers(0, 65535))


@given(st.lists(NODES, max_size=12), st.binary(max_size=4))
def test_nodes_come_out_as_they_went_in(nodes, rest):
    decoded = decode_nodes(b"".join(node(*fields) for fields in nodes) + rest)
    assert list(zip(*(field.tolist() for field in decoded), strict=True)) == nodes


@given(st.binary(max_size=200))
def test_decoding_ends_before_the_first_invalid_node(data):
    raw = np.frombuffer(data, NODE, len(data) // 5)
    first, angle = raw["first"].astype(int), raw["angle"].astype(int) >> 1
    valid = ((first ^ (first >> 1)) & raw["angle"] & 1).astype(bool) & (angle < 360 * 64)
    good = len(raw) if valid.all() else int(valid.argmin())
    decoded = decode_nodes(data)
    np.testing.assert_array_equal(decoded.start, (first & 1)[:good] == 1)
    np.testing.assert_array_equal(decoded.quality, (first >> 2)[:good])
    np.testing.assert_array_equal(decoded.angle_q6, angle[:good])
    np.testing.assert_array_equal(decoded.distance_q2, raw["distance"][:good])


def test_distance_of_zero_is_no_range():
    clockwise, ranges = in_metres(np.array([0, 90 * 64, 23039], np.uint16), np.array([4000, 0, 65535], np.uint16))
    np.testing.assert_array_equal(clockwise, np.array([0, 90 * 64, 23039]) * np.float64(np.pi / (180.0 * 64.0)))
    np.testing.assert_array_equal(ranges, [1.0, np.nan, 65535 * 0.00025])


@given(st.integers(0, 50), st.floats(0.0, 1e5), st.floats(0.0, 0.5), st.integers(0, 99))
def test_batch_arrived_evenly_and_counts_against_the_clock(count, before, took, seed):
    rng = np.random.default_rng(seed)
    clockwise, ranges = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.0, 12.0, count)
    now = before + took
    made = batch(clockwise, ranges, before, now)
    np.testing.assert_array_equal(made.times, before + (now - before) * np.arange(1, count + 1) / max(count, 1))
    expected = np.where(clockwise < np.pi, 0.0, 2.0 * np.pi) - clockwise
    np.testing.assert_array_equal(made.angles_rad, expected.astype(np.float32))
    np.testing.assert_array_equal(made.ranges_m, ranges.astype(np.float32))
    assert (made.angles_rad.dtype, made.ranges_m.dtype) == (np.float32, np.float32)


def test_other_types_and_sizes_are_refused():
    with pytest.raises(TypeError, match="float64"):
        batch(np.zeros(2, np.float32), np.zeros(2), 0.0, 1.0)
    with pytest.raises(ValueError, match="one size"):
        batch(np.zeros(2), np.zeros(3), 0.0, 1.0)
    with pytest.raises(TypeError, match="uint16"):
        in_metres(np.zeros(2, np.int64), np.zeros(2, np.uint16))
