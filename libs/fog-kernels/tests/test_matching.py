"""Matching of scans: the search misses no better pose, the refinement is exact, and beams count once."""

from __future__ import annotations

import math

import numpy as np
import pytest
from compiler import compiled_only
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_kernels.matching import BeamCounts, Excluded, Reference, normals

GATES = np.array([0.45] * 4 + [0.2] * 4 + [0.1] * 4)
TURN = math.radians(2.0)


def walls(*lines: tuple[float, float, float, float], every: float = 0.08) -> tuple[np.ndarray, np.ndarray]:
    """Points along lines (x1, y1, x2, y2), and their normals."""
    points, across = [], []
    for x1, y1, x2, y2 in lines:
        length = math.dist((x1, y1), (x2, y2))
        share = np.linspace(0.0, 1.0, round(length / every) + 1)[:, None]
        points.append((1.0 - share) * (x1, y1) + share * (x2, y2))
        across.append(np.tile(((y1 - y2) / length, (x2 - x1) / length), (len(share), 1)))
    return np.concatenate(points), np.concatenate(across)


ROOM = walls((0, 0, 6, 0), (6, 0, 6, 4), (6, 4, 2, 4), (2, 4, 2, 2.5), (2, 2.5, 0, 2.5), (0, 2.5, 0, 0))


def seen_from(pose: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    x, y, theta = pose
    turn = np.array(((math.cos(theta), -math.sin(theta)), (math.sin(theta), math.cos(theta))))
    return (ROOM[0] - (x, y)) @ turn, ROOM[1] @ turn


@compiled_only  # tens of thousands of poses
@settings(max_examples=25, deadline=None)
@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.integers(-4, 4), st.integers(0, 2**32 - 1), st.floats(0.2, 1.0))
def test_search_finds_the_best_of_all_poses_in_its_window(x, y, turn, seed, half):
    rng = np.random.default_rng(seed)
    points = seen_from((3.0, 1.5, 0.2))[0][rng.random(len(ROOM[0])) < 0.5]
    points = points + 0.1 * rng.standard_normal(points.shape)
    reference = Reference(*ROOM)
    guess = (3.0 + x, 1.5 + y, 0.2 + turn * TURN)
    found = reference.search(points, guess, half, 3 * TURN, TURN, 0.0)
    assert found is not None
    assert abs(found.pose[0] - guess[0]) <= half + 0.05
    assert abs(found.pose[1] - guess[1]) <= half + 0.05
    steps = np.arange(-math.ceil(half / 0.05), math.ceil(half / 0.05) + 1) * 0.05
    every = max(
        (one.score
         for k in range(-3, 4) for dx in steps for dy in steps[:: max(1, len(steps) // 5)]
         if (one := reference.search(points, (guess[0] + dx, guess[1] + dy, guess[2] + k * TURN), 0.0, 0.0, 1.0, 0.0))),
        default=0.0,
    )  # fmt: skip
    assert found.score >= every - 1e-9


def test_search_leaves_out_what_it_is_told_to_and_finds_nothing_below_its_least_score():
    points, _ = seen_from((3.0, 1.5, 0.0))
    reference = Reference(*ROOM)
    best = reference.search(points, (3.1, 1.4, 0.0), 0.5, 0.2, TURN, 0.5)
    assert best is not None
    assert best.pose == pytest.approx((3.0, 1.5, 0.0), abs=0.03)
    other = reference.search(points, (3.1, 1.4, 0.0), 0.5, 0.2, TURN, 0.0, Excluded(best.pose, 0.3, 0.5))
    assert other is not None
    assert math.dist(other.pose[:2], best.pose[:2]) > 0.3
    assert other.score < best.score
    assert reference.search(points, (3.1, 1.4, 0.0), 0.5, 0.2, TURN, 0.999) is None


@given(st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), st.floats(-0.08, 0.08))
@settings(max_examples=40, deadline=None)
def test_refinement_ends_at_the_exact_pose(x, y, turn):
    truth = (3.0, 1.5, 0.7)
    start = (truth[0] + x, truth[1] + y, truth[2] + turn)
    found = Reference(*ROOM).align(*seen_from(truth), start, start, 1e-3 * np.eye(3), GATES)
    assert found.pose == pytest.approx(truth, abs=1e-3)
    assert found.share > 0.99
    assert found.residual < 1e-3


def test_refinement_knows_that_a_corridor_says_nothing_along_itself_and_stays_where_the_prior_is():
    corridor = walls((0, 0, 20, 0), (0, 2, 20, 2))
    points = corridor[0][(corridor[0][:, 0] > 6.0) & (corridor[0][:, 0] < 14.0)] - (10.0, 1.0)
    lines = np.tile((0.0, 1.0), (len(points), 1))
    start = (10.2, 1.05, 0.02)
    found = Reference(*corridor).align(points, lines, start, start, np.eye(3), GATES)
    assert found.pose[0] == pytest.approx(10.2, abs=0.01)
    assert found.pose[1:] == pytest.approx((1.0, 0.0), abs=1e-3)
    assert found.information[0, 0] < 1e-6 * found.information[1, 1]


def test_normals_are_those_of_the_walls_and_none_at_what_is_no_line():
    points, across = walls((0, 0, 4, 1))
    assert np.abs((normals(points, 0.3) * across).sum(axis=1)) == pytest.approx(1.0)
    scattered = np.random.default_rng(1).uniform(0.0, 0.3, (20, 2))
    assert (normals(scattered, 0.5) == 0.0).all(axis=1).mean() > 0.5
    assert (normals(10.0 * scattered, 0.01) == 0.0).all()


def test_normals_beside_a_step_of_a_wall_are_those_of_the_wall():
    bearings = np.radians(np.arange(30.0, 150.0))
    away = np.where(1.0 / np.tan(bearings) < 0.4, 1.0, 1.1)  # m; the wall to the left of a robot, with a shallow niche
    points = np.column_stack((away / np.tan(bearings), away))
    assert np.abs(normals(points, 0.4)[:, 1]).min() > math.cos(math.radians(0.5))


def test_each_scan_counts_once_in_a_cell_as_hit_if_any_beam_ends_there():
    counts = BeamCounts((20, 40), 0.05, 0.0, 0.0)
    ends = np.array(((1.52, 0.52), (1.53, 0.53), (1.52, 0.77)))
    counts.add(0.27, 0.52, ends)
    assert (counts.hits[10, 30], counts.passes[10, 30]) == (1, 0)
    assert counts.passes[10, 6:29].tolist() == [1] * 23
    assert counts.hits.sum() == 2
    counts.add(0.27, 0.52, np.array(((1.72, 0.52),)))
    assert (counts.hits[10, 30], counts.passes[10, 30]) == (1, 1), "the second looks through it"
    assert counts.passes[10, 20] == 2


def test_reference_without_points_is_refused():
    with pytest.raises(ValueError, match="needs points"):
        Reference(np.empty((0, 2)), np.empty((0, 2)))
