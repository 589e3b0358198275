"""Particle filter: moments of the motion model, weights by definition, convergence, repeatability."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import compiled_only, examples
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_kernels.amcl import (
    clusters,
    estimate,
    motion_update,
    odometry_delta,
    resample,
    rng_state,
    score_poses,
)
from fog_kernels.distance import likelihood_field
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from numpy.typing import NDArray

RESOLUTION = 0.05
BEAMS = np.linspace(-math.pi, math.pi, 60, endpoint=False)


def building() -> NDArray[np.bool_]:
    """Return a 12 x 8 m floor of unequal rooms."""
    occupied = np.zeros((160, 240), bool)
    occupied[[0, -1]] = True
    occupied[:, [0, -1]] = True
    occupied[60, :90] = occupied[60, 110:200] = True
    occupied[60:130, 100] = True
    occupied[:40, 170] = True
    occupied[100:110, 30:50] = True
    occupied[20:24, 60:90] = True
    occupied[90, 150:] = True
    return occupied


OCCUPIED = building()
FIELD = likelihood_field(OCCUPIED, RESOLUTION)
ALPHAS = (0.2, 0.2, 0.2, 0.2)


def scan(x: float, y: float, theta: float) -> NDArray[np.float64]:
    ranges = cast(OCCUPIED, RESOLUTION, 0.0, 0.0, x, y, BEAMS + theta, 12.0)
    return np.where(np.isfinite(ranges), ranges, np.nan)


def cloud(n: int, x: float, y: float, theta: float) -> list[NDArray[np.float32]]:
    return [np.full(n, value, np.float32) for value in (x, y, theta)]


def test_likelihood_field_is_the_cubed_mixture_of_the_distance() -> None:
    occupied = np.zeros((1, 50), bool)
    occupied[0, 0] = True
    field = likelihood_field(occupied, 0.1, sigma_hit=0.2, max_distance=2.0, z_hit=0.5, z_rand=0.5, range_max=10.0)
    for column in (0, 3, 19, 20, 49):
        distance = min(column * 0.1, 2.0)
        expected = (0.5 * math.exp(-(distance**2) / 0.08) + 0.05) ** 3
        assert field[0, column] == pytest.approx(expected, rel=1e-5)


def test_motion_noise_has_the_mean_and_variance_of_the_model() -> None:
    n = 40_000
    x, y, theta = cloud(n, 1.0, 2.0, 0.5)
    motion_update(x, y, theta, 0.3, 1.0, -0.1, (0.04, 0.01, 0.02, 0.03), rng_state(1))
    spread_1 = math.sqrt(0.04 * 0.09 + 0.01)
    spread_2 = math.sqrt(0.04 * 0.01 + 0.01)
    spread_t = math.sqrt(0.02 + 0.03 * (0.09 + 0.01))
    assert theta.mean() == pytest.approx(0.7, abs=0.01)
    assert theta.std() == pytest.approx(math.hypot(spread_1, spread_2), rel=0.02)
    travelled = np.hypot(x - 1.0, y - 2.0)
    assert travelled.std() == pytest.approx(spread_t, rel=0.02)
    assert travelled.mean() == pytest.approx(1.0, abs=0.01)
    bearing = np.arctan2(y - 2.0, x - 1.0)
    assert bearing.mean() == pytest.approx(0.8, abs=0.01)
    assert bearing.std() == pytest.approx(spread_1, rel=0.02)
    normal = (bearing - bearing.mean()) / bearing.std()
    assert (normal**4).mean() == pytest.approx(3.0, abs=0.15)


def test_particles_move_alike_without_noise() -> None:
    x, y, theta = cloud(3, 0.0, 0.0, math.pi / 2)
    step = odometry_delta((5.0, 5.0, 1.0), (5.0 + math.cos(1.2), 5.0 + math.sin(1.2), 1.5))
    assert step == pytest.approx((0.2, 1.0, 0.3))
    motion_update(x, y, theta, *step, (0, 0, 0, 0), rng_state(1))
    assert x == pytest.approx(np.full(3, math.cos(math.pi / 2 + 0.2)), abs=1e-6)
    assert y == pytest.approx(np.full(3, math.sin(math.pi / 2 + 0.2)), abs=1e-6)
    assert theta == pytest.approx(np.full(3, math.pi / 2 + 0.5), abs=1e-6)


def test_reversing_has_the_noise_of_driving_forward() -> None:
    step = odometry_delta((0.0, 0.0, 0.0), (-0.5, 0.0, 0.0))
    assert abs(step[0]) == pytest.approx(math.pi)
    backward, forward = (cloud(5000, 0.0, 0.0, 0.0) for _ in range(2))
    motion_update(*backward, *step, ALPHAS, rng_state(1))
    motion_update(*forward, 0.0, 0.5, 0.0, ALPHAS, rng_state(1))
    assert backward[0].std() == pytest.approx(forward[0].std(), rel=1e-3)
    assert backward[2].std() == pytest.approx(forward[2].std(), rel=1e-3)
    assert odometry_delta((0.0, 0.0, 0.0), (0.001, 0.002, 0.3)) == pytest.approx((0.0, math.hypot(1, 2) / 1000, 0.3))


@settings(max_examples=examples(25), deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_scores_equal_their_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 20
    x = rng.uniform(-1, 13, n).astype(np.float32)
    y = rng.uniform(-1, 9, n).astype(np.float32)
    theta = rng.uniform(-4, 4, n).astype(np.float32)
    ranges = scan(3.0, 2.0, 0.3)
    ranges[::7] = np.nan
    ranges[1] = math.inf
    sums = np.zeros(n)
    valid = np.isfinite(ranges)
    for i in range(n):
        for angle, distance in zip(BEAMS[valid], ranges[valid], strict=True):
            end_x = x[i] + distance * math.cos(theta[i] + angle)
            end_y = y[i] + distance * math.sin(theta[i] + angle)
            column, row = math.floor(end_x / RESOLUTION), math.floor(end_y / RESOLUTION)
            if 0 <= column < 240 and 0 <= row < 160:
                sums[i] += FIELD[row, column]
    scores = score_poses(x, y, theta, FIELD, RESOLUTION, 0.0, 0.0, BEAMS, ranges)
    # Rounding to float32 may put an end into the neighbouring cell: a few beams' worth of difference.
    assert np.abs(scores * valid.sum() - sums).max() < 0.12


def test_scan_without_valid_beams_scores_zero() -> None:
    particles = cloud(4, 1.0, 1.0, 0.0)
    scores = score_poses(*particles, FIELD, RESOLUTION, 0.0, 0.0, [0.0, 1.0], [math.nan, math.inf])
    assert scores.tolist() == [0.0, 0.0, 0.0, 0.0]


def test_resampling_keeps_proportions_with_low_variance() -> None:
    x = np.array([1.0, 2.0, 3.0, 4.0], np.float32)
    zero = np.zeros(4, np.float32)
    weights = np.array([0.5, 0.0, 0.3, 0.2])
    result = resample(x, zero, zero, weights, 1000, 1000, 0.05, rng_state(3))
    counts = [int((result.x == value).sum()) for value in x]
    assert counts[1] == 0
    assert np.abs(np.array(counts) - 1000 * weights).max() <= 1
    assert result.weights.sum() == pytest.approx(1.0)


def test_number_of_particles_grows_with_their_spread() -> None:
    rng = np.random.default_rng(0)
    n = 5000
    weights = np.full(n, 1.0 / n)
    sizes = []
    for spread in (0.01, 0.15, 3.0):
        x, y, theta = (rng.normal(0.09, spread, n).astype(np.float32) for _ in range(3))  # inside one bin
        result = resample(x, y, theta, weights, 100, 3000, 0.05, rng_state(1))
        sizes.append(len(result.x))
        assert len(result.x) == len(result.y) == len(result.theta) == len(result.weights)
    assert sizes[0] == 100
    assert sizes[0] < sizes[1] < sizes[2] == 3000


def test_number_of_particles_equals_foxs_formula() -> None:
    x = np.array([0.1, 1.1, 2.1, 3.1], np.float32)
    zero = np.zeros(4, np.float32)
    result = resample(x, zero, zero, np.full(4, 0.25), 10, 10_000, 0.02, rng_state(5))
    k, z = 4, 2.326
    bound = (k - 1) / 0.04 * (1 - 2 / (9 * (k - 1)) + math.sqrt(2 / (9 * (k - 1))) * z) ** 3
    assert len(result.x) == math.ceil(bound)


def test_estimate_is_the_circular_mean_of_the_cluster_with_the_highest_weight() -> None:
    rng = np.random.default_rng(4)
    x = np.concatenate([rng.normal(2, 0.1, 300), rng.normal(9, 0.1, 700)]).astype(np.float32)
    y = np.concatenate([rng.normal(3, 0.1, 300), rng.normal(1, 0.2, 700)]).astype(np.float32)
    theta = np.concatenate([rng.normal(0, 0.1, 300), rng.normal(math.pi, 0.1, 700)]).astype(np.float32)
    weights = np.concatenate([np.full(300, 0.7 / 300), np.full(700, 0.3 / 700)])
    groups = clusters(x, y, theta, weights)
    assert [group.share for group in groups] == pytest.approx([0.7, 0.3])
    mean = estimate(x, y, theta, weights)
    assert (mean.x, mean.y, mean.theta) == pytest.approx((x[:300].mean(), y[:300].mean(), theta[:300].mean()), abs=1e-4)
    assert mean.covariance == pytest.approx(np.cov(np.stack([x, y, theta])[:, :300], bias=True), abs=1e-5)
    other = groups[1].estimate
    assert abs(math.remainder(other.theta - math.pi, 2 * math.pi)) < 0.02
    assert other.covariance[2, 2] == pytest.approx(0.01, rel=0.2)
    assert np.array_equal(other.covariance, other.covariance.T)


@settings(max_examples=examples(40), deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 60), st.sampled_from([0.3, 1.0, 3.0]))
def test_clusters_are_the_connected_groups_of_bins_with_circular_means(seed: int, n: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    x, y = (rng.normal(0.0, spread, n).astype(np.float32) for _ in range(2))
    theta = rng.normal(3.0, 0.3 * spread, n).astype(np.float32)
    weights = rng.uniform(0.1, 1.0, n)
    bins = np.floor(np.column_stack((x / 0.5, y / 0.5)).astype(np.float64)).astype(int)
    headings = np.floor(np.mod(theta.astype(np.float64) / (2 * math.pi), 1.0) * 36).astype(int)
    groups = list(range(n))
    for i in range(n):
        for j in range(i):
            turn = (headings[i] - headings[j]) % 36
            if np.abs(bins[i] - bins[j]).max() <= 1 and turn in {0, 1, 35} and groups[i] != groups[j]:
                groups = [groups[i] if group == groups[j] else group for group in groups]
    expected = []
    for group in set(groups):
        own = np.array(groups) == group
        mean = np.exp(1j * theta[own].astype(np.float64)) @ weights[own]
        expected.append((weights[own].sum() / weights.sum(), np.average(x[own], weights=weights[own]), np.angle(mean)))
    found = clusters(x, y, theta, weights)
    assert len(found) == len(expected)
    for cluster, (share, mean_x, mean_theta) in zip(found, sorted(expected, reverse=True), strict=True):
        assert cluster.share == pytest.approx(share, rel=1e-6)
        assert cluster.estimate.x == pytest.approx(mean_x, abs=1e-5)
        assert abs(math.remainder(cluster.estimate.theta - mean_theta, 2 * math.pi)) < 5e-3


def test_scores_do_not_depend_on_how_many_poses_are_scored_together() -> None:
    rng = np.random.default_rng(1)
    poses = [rng.uniform(low, high, 5000) for low, high in ((0.0, 12.0), (0.0, 8.0), (-3.0, 3.0))]
    ranges = scan(3.0, 2.0, 0.3)
    together = score_poses(*poses, FIELD, RESOLUTION, 0.0, 0.0, BEAMS, ranges)
    for part in (slice(0, 1), slice(2040, 2060), slice(4990, 5000)):
        alone = score_poses(*(values[part] for values in poses), FIELD, RESOLUTION, 0.0, 0.0, BEAMS, ranges)
        assert np.array_equal(together[part], alone)


def track(seed: int, steps: int) -> tuple[list[NDArray[np.float32]], tuple[float, float, float], list[float]]:
    """Drive a loop with drifting odometry from an uncertain start; return particles, true pose and errors."""
    state = rng_state(seed)
    n = 2000
    truth = [1.0, 1.0, 0.2]
    odometry = [0.0, 0.0, 0.0]
    rng = np.random.default_rng(7)
    x = (truth[0] + rng.normal(0, 0.4, n)).astype(np.float32)
    y = (truth[1] + rng.normal(0, 0.4, n)).astype(np.float32)
    theta = (truth[2] + rng.normal(0, 0.3, n)).astype(np.float32)
    weights = np.full(n, 1.0 / n)
    errors = []
    for step in range(steps):
        before = tuple(odometry)
        for pose, drift in ((truth, 0.0), (odometry, 0.01)):
            turn = 0.06 * math.sin(step / 6) + drift
            pose[2] += turn
            pose[0] += 0.2 * math.cos(pose[2])
            pose[1] += 0.2 * math.sin(pose[2])
        motion_update(x, y, theta, *odometry_delta(before, tuple(odometry)), ALPHAS, state)
        ranges = scan(*truth) + rng.normal(0, 0.02, BEAMS.size)
        weights *= 1.0 + BEAMS.size * score_poses(x, y, theta, FIELD, RESOLUTION, 0.0, 0.0, BEAMS, ranges)
        weights /= weights.sum()
        mean = estimate(x, y, theta, weights)
        errors.append(math.hypot(mean.x - truth[0], mean.y - truth[1]))
        x, y, theta, weights = resample(x, y, theta, weights, 500, 2000, 0.05, state)
    return [x, y, theta], (truth[0], truth[1], truth[2]), errors


@compiled_only
def test_filter_converges_and_tracks_the_pose() -> None:
    particles, truth, errors = track(11, 40)
    assert max(errors[10:]) < 0.15
    assert np.median(errors[10:]) < 0.06
    assert abs(math.remainder(float(particles[2].mean()) - truth[2], 2 * math.pi)) < 0.1
    assert len(particles[0]) < 2000


@compiled_only
def test_same_seed_gives_the_same_particles_and_another_seed_does_not() -> None:
    first, second, other = track(11, 12)[0], track(11, 12)[0], track(12, 12)[0]
    for a, b in zip(first, second, strict=True):
        assert a.tobytes() == b.tobytes()
    assert first[0].tobytes() != other[0].tobytes()


@compiled_only
def test_scoring_poses_on_the_whole_map_finds_the_true_pose() -> None:
    truth = (9.2, 1.6, 2.0)
    ranges = scan(*truth)
    grid = np.array(
        [
            (x, y, t)
            for x in np.arange(0.2, 12, 0.2)
            for y in np.arange(0.2, 8, 0.2)
            for t in np.arange(-math.pi, math.pi, math.radians(10))
        ]
    )
    scores = score_poses(grid[:, 0], grid[:, 1], grid[:, 2], FIELD, RESOLUTION, 0.0, 0.0, BEAMS, ranges)
    best = grid[np.argmax(scores)]
    assert math.hypot(best[0] - truth[0], best[1] - truth[1]) < 0.25
    assert abs(math.remainder(best[2] - truth[2], 2 * math.pi)) < 0.2


def test_invalid_arrays_and_generator_states_are_refused_by_name() -> None:
    x, y, theta = cloud(3, 0.0, 0.0, 0.0)
    weights = np.full(3, 1 / 3)
    with pytest.raises(TypeError, match="theta must be float32"):
        motion_update(x, y, theta.astype(np.float64), 0, 0, 0, ALPHAS, rng_state(1))
    with pytest.raises(ValueError, match="rng_state"):
        motion_update(x, y, theta, 0, 0, 0, ALPHAS, np.zeros(4, np.uint64))
    with pytest.raises(ValueError, match="weights"):
        estimate(x, y, theta, np.zeros(3))
    with pytest.raises(ValueError, match="n_min"):
        resample(x, y, theta, weights, 5, 4, 0.05, rng_state(1))
