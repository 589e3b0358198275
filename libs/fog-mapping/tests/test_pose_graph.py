"""The pose graph: what was measured exactly is found exactly, and wrong loops change nothing."""

from __future__ import annotations

import numpy as np
import pytest

from fog_mapping.pose_graph import Certainty, solve
from fog_mapping.poses import Edge, between, compose

SIGMAS = np.array((0.02, 0.02, 0.006))
INFORMATION = np.diag(SIGMAS**-2.0)


def rounds(count: int = 240) -> np.ndarray:
    """Poses three times round a square of 15 m, 0.75 m apart."""
    poses = [np.zeros(3)]
    for i in range(1, count):
        poses.append(compose(poses[-1], np.array((0.75, 0.0, np.pi / 2 if i % 20 == 0 else 0.0))))
    return np.array(poses)


def graph(truth: np.ndarray, rng: np.random.Generator, false_share: float) -> list[Edge]:
    def measured(first: int, second: int) -> np.ndarray:
        return between(truth[first], truth[second]) + SIGMAS * rng.standard_normal(3)

    edges = [Edge(i - 1, i, measured(i - 1, i), INFORMATION) for i in range(1, len(truth))]
    loops = [
        Edge(first, second, measured(first, second), INFORMATION, loop=True)
        for first in range(0, 80, 4) for second in (first + 80, first + 159)
    ]  # fmt: skip
    for i in rng.choice(len(loops), round(false_share * len(loops)), replace=False):
        wrong = rng.uniform((1.0, -5.0, -0.6), (5.0, -1.0, 0.6))
        loops[i] = loops[i]._replace(step=loops[i].step + wrong)
    return edges + loops


def dead_reckoned(edges: list[Edge], count: int) -> np.ndarray:
    poses = [np.zeros(3)]
    for edge in edges[: count - 1]:
        poses.append(compose(poses[-1], edge.step))
    return np.array(poses)


def rms(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(((poses - truth)[:, :2] ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("false_share", [0.05, 0.2])
def test_wrong_loops_are_found_out_and_change_nothing(seed, false_share):
    truth = rounds()
    right = graph(truth, np.random.default_rng(seed), 0.0)
    start = dead_reckoned(right, len(truth))
    good = solve(start, right)
    assert rms(good.poses, truth) < 0.5 * rms(start, truth)
    edges = graph(truth, np.random.default_rng(seed), false_share)
    found = solve(dead_reckoned(edges, len(truth)), edges)
    wrong = np.array(
        [edge.loop and np.abs(between(truth[edge.first], truth[edge.second]) - edge.step).max() > 0.5 for edge in edges]
    )
    assert wrong.any()
    assert found.weights[wrong].max() < 0.05
    assert (found.weights[~wrong] > 0.25).mean() > 0.97
    assert np.abs(found.poses - good.poses)[:, :2].max() < 0.15


def test_exact_measurements_give_exact_poses():
    truth = rounds(60)
    edges = [Edge(i - 1, i, between(truth[i - 1], truth[i]), INFORMATION) for i in range(1, 60)]
    found = solve(truth + 0.01 * np.sin(np.arange(180.0)).reshape(60, 3) * (np.arange(60) > 0)[:, None], edges)
    assert np.abs(found.poses - truth).max() < 1e-6


def test_a_heading_that_is_off_makes_what_follows_uncertain_by_the_whole_way_to_it():
    way = np.array([(0.5 * i, 0.0, 0.0) for i in range(201)])
    edges = [Edge(i, i + 1, np.array((0.5, 0.0, 0.0)), np.diag((1e4, 1e4, 1e6))) for i in range(200)]
    seen = Certainty(way, np.array((0, 50, 200)), edges, np.ones(200)).seen_from(np.array((0, 2)))
    levers = 0.5 * np.arange(200)
    assert seen[0, 2] == pytest.approx(np.diag((0.02, 0.02, 2e-4)) + np.array((
        (0.0, 0.0, 0.0), (0.0, (1e-6 * levers**2).sum(), (1e-6 * levers).sum()), (0.0, (1e-6 * levers).sum(), 0.0)
    )), rel=1e-3, abs=1e-9)  # fmt: skip
    assert seen[1, 0, 1, 1] == pytest.approx(seen[0, 2, 1, 1], rel=0.02), "as seen from its end, the whole way lies off"
    assert seen[0, 0] == pytest.approx(np.zeros((3, 3)), abs=1e-9)


def test_a_way_of_many_scans_between_joints_makes_as_uncertain_as_all_its_steps_and_a_loop_less_so():
    rng, truth, joints = np.random.default_rng(1), rounds(60), np.array((0, 7, 12, 13, 20, 48, 59))
    ends = [(i, i + 1) for i in range(59)] + [(0, 20), (48, 12)]
    edges = []
    for first, second in ends:
        root = rng.normal(size=(3, 3))
        edges.append(Edge(first, second, np.zeros(3), root @ root.T + np.eye(3) * 50.0, second != first + 1))
    weights = np.append(np.ones(60), 0.4)
    joined = Certainty(truth, joints, edges, weights).seen_from(np.arange(7))
    each = Certainty(truth, np.arange(60), edges, weights).seen_from(joints)
    assert joined == pytest.approx(each[:, joints], rel=1e-6, abs=1e-9)
    open_way = Certainty(truth, joints, edges[:59], weights[:59]).seen_from(np.arange(7))
    assert joined[4, 0].trace() < 0.5 * open_way[4, 0].trace()


def test_pose_that_nothing_reaches_is_an_error():
    with pytest.raises(RuntimeError, match="singular"):
        solve(np.zeros((3, 3)), [Edge(0, 1, np.array((1.0, 0.0, 0.0)), INFORMATION)])


def test_the_least_squares_are_those_that_gtsam_finds():
    """Another solver, by other people: `uv pip install gtsam` (4.3 or later) for this test."""
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed")
    truth, rng = rounds(), np.random.default_rng(1)
    edges = [edge._replace(loop=False) for edge in graph(truth, rng, 0.0)]
    start = dead_reckoned(edges, len(truth))
    found = solve(start, edges)
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-9)))
    noise = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    for edge in edges:
        factors.add(gtsam.BetweenFactorPose2(edge.first, edge.second, gtsam.Pose2(*edge.step), noise))
    for i, pose in enumerate(start):
        values.insert(i, gtsam.Pose2(*pose))
    theirs = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    poses = np.array([(p.x(), p.y(), p.theta()) for p in map(theirs.atPose2, range(len(truth)))])
    assert np.abs(found.poses - poses)[:, :2].max() < 1e-3
    assert found.squares.sum() == pytest.approx(2.0 * factors.error(theirs), rel=1e-3)
