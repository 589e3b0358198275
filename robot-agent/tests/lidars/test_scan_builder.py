"""Batches of samples on their way to scans: what is kept of them, and for how long."""

from __future__ import annotations

import tracemalloc

import numpy as np

from robot_agent.scan_builder import Samples, ScanBuilder


def batch(count: int) -> Samples:
    return Samples(np.zeros(count), np.ones(count), np.ones(count, np.uint8))


def test_empty_batches_are_not_kept():
    builder = ScanBuilder()
    builder.feed(batch(0), (), 0.0)  # loads the compiled code, which stays
    tracemalloc.start()
    try:
        for number in range(2000):
            builder.feed(batch(0), (), 0.01 * number)
            assert builder.take_samples() is None
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 50_000


def test_samples_are_taken_once():
    builder = ScanBuilder()
    builder.feed(batch(0), (), 0.0)
    builder.feed(batch(3), (), 0.01)
    taken = builder.take_samples()
    assert taken is not None
    assert len(taken.ranges_m) == 3
    assert builder.take_samples() is None
