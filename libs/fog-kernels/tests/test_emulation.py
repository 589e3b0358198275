"""What emulated sensors measure: the kernels against the same in numpy, bit by bit."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest

from fog_kernels.emulation import (
    FULL_CIRCLE_Q6,
    Beams,
    Drawn,
    RecordedErrors,
    disturb,
    disturb_as_recorded,
    edge_ranges,
    encode_nodes,
    nearest_occupied,
    node_angles,
    set_in_sectors,
)
from fog_kernels.lidar import decode_nodes

if TYPE_CHECKING:
    from numpy.typing import NDArray


@pytest.mark.parametrize(("position", "step"), [(0.159, 0.00275), (3.9999, 0.00275), (12.0, 0.1)])
def test_head_turns_evenly_and_each_rotation_starts_once(position: float, step: float) -> None:
    count = 1000
    made = node_angles(position, step, count)
    rotation = position + np.arange(1, count + 1) * step
    assert made.position == rotation[-1]
    assert (made.angle_q6 == np.floor(rotation % 1.0 * FULL_CIRCLE_Q6).astype(np.int64) % FULL_CIRCLE_Q6).all()
    assert made.start.sum() == math.floor(rotation[-1]) - math.floor(position)
    assert (np.diff(made.angle_q6)[~made.start[1:]] > 0).all()


def test_nodes_decode_to_what_was_encoded() -> None:
    ranges = np.array([0.1499, 0.15, 1.0, 6.0, 11.99, 12.0, 12.01, math.nan, math.inf])
    angle = np.linspace(0, FULL_CIRCLE_Q6 - 1, ranges.size).astype(np.int64)
    start = np.arange(ranges.size) % 3 == 0
    decoded = decode_nodes(encode_nodes(angle, start, ranges, 0.15, 12.0).tobytes())
    assert (decoded.start == start).all()
    assert (decoded.angle_q6 == angle).all()
    assert decoded.distance_q2.tolist() == [0, 600, 4000, 24000, 47960, 48000, 0, 0, 0]
    assert decoded.quality.tolist() == [0, 15, 15, 15, 5, 5, 0, 0, 0]


def test_errors_are_those_of_the_drawn_numbers() -> None:
    generator = np.random.default_rng(3)
    true = np.where(generator.random(500) < 0.1, np.inf, generator.uniform(0.0, 13.0, 500))
    normal, uniform = generator.standard_normal(500), generator.random(500)
    measured = true.copy()
    disturb(measured, normal, uniform, sigma=0.008, share=0.004, dropout=0.2, low=0.15, high=12.0)
    expected = true + (0.008 + 0.004 * np.where(np.isfinite(true), true, 0.0)) * normal
    returned = (expected >= 0.15) & (expected <= 12.0) & (uniform >= 0.2)
    assert 0 < returned.sum() < 500
    assert np.array_equal(measured, np.where(returned, expected, np.nan), equal_nan=True)


RECORDED = RecordedErrors(
    noise=np.array(((0.0, 0.0016), (2.0, 0.0018), (2.5, 0.0030), (12.0, 0.054))),
    loss=np.array(((0.0, 0.20), (0.45, 0.05), (4.0, 0.01), (12.0, 0.06))),
    tail=0.15,
    tail_sigmas=4.0,
    outliers=0.1,
    low=0.15,
    high=12.0,
)


def test_errors_as_recorded_are_those_of_numpy() -> None:
    generator, n = np.random.default_rng(4), 4000
    patches, dead = np.array(((1.0, 1.0, 4.0, 0.3), (-3.0, 2.0, 5.0, 0.5))), np.array(((-1.0, -0.5), (3.0, -3.0)))
    true = np.where(generator.random(n) < 0.1, np.inf, generator.uniform(0.0, 14.0, n))
    true[:4] = (0.0, 2.0, 2.5, 12.0)
    angle = generator.uniform(-math.pi, math.pi, n)
    beams = Beams(angle, np.cos(angle + 0.7), np.sin(angle + 0.7))
    drawn = Drawn(generator.random(n), generator.standard_normal(n), generator.random((5, n)))
    measured = true.copy()
    disturb_as_recorded(measured, beams, drawn, RECORDED, (0.3, -0.2), patches, dead)

    known = np.where(np.isfinite(true), true, 12.0)
    sigma = np.interp(known, *RECORDED.noise.T) * np.where(drawn.tail < 0.15, 4.0, 1.0)
    expected = np.where(drawn.uniform[0] < 0.1, 0.15 + (12.0 - 0.15) * drawn.uniform[1], true + sigma * drawn.normal)
    lost = drawn.uniform[2] < np.interp(known, *RECORDED.loss.T)
    for (x, y, radius, returned), uniform in zip(patches, drawn.uniform[3:], strict=True):
        inside = np.hypot(0.3 + known * beams.cos - x, -0.2 + known * beams.sin - y) < radius
        lost |= inside & (uniform >= returned)
    for begin, end in dead:
        lost |= (angle - begin) % math.tau <= (end - begin) % math.tau
    seen = (expected >= 0.15) & (expected <= 12.0) & ~lost
    assert 0 < seen.sum() < n
    assert np.array_equal(measured, np.where(seen, expected, np.nan), equal_nan=True)


def test_ranges_in_sectors_are_set() -> None:
    angle = np.linspace(-7.0, 7.0, 1000)
    sectors = np.array(((-1.0, -0.5), (3.0, -3.0), (6.0, 6.2)))
    measured = np.ones(angle.size)
    set_in_sectors(measured, angle, sectors, 0.16)
    inside = [(angle - begin) % math.tau <= (end - begin) % math.tau for begin, end in sectors]
    assert np.array_equal(measured, np.where(np.any(inside, axis=0), 0.16, 1.0))


def _edges_by_numpy(
    edges: NDArray[np.float64], x: float, y: float, cos: NDArray[np.float64], sin: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    cos, sin = cos[:, None], sin[:, None]
    ax, ay = edges[:, 0] - x, edges[:, 1] - y
    ex, ey = edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]
    across = cos * ey - sin * ex
    safe = np.where(across == 0, 1.0, across)
    along_ray, along_edge = (ax * ey - ay * ex) / safe, (ax * sin - ay * cos) / safe
    hit = (across != 0) & (along_ray >= 0) & (along_edge >= 0) & (along_edge <= 1)
    ranges = np.where(hit, along_ray, np.inf)
    nearest, rows = np.argmin(ranges, axis=1), np.arange(len(ranges))
    squareness = np.abs(across) / np.maximum(np.hypot(ex, ey), 1e-12)
    return ranges[rows, nearest], np.clip(squareness[rows, nearest], 0.0, 1.0)


@pytest.mark.parametrize("place", [(-2.0, 0.3), (0.5, 0.5), (1.0, 0.0), (3.0, 1.0)])
def test_rays_meet_the_nearest_edge_of_a_box(place: tuple[float, float]) -> None:
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    edges = np.hstack((corners, np.roll(corners, -1, axis=0)))
    directions = np.concatenate((np.arange(4) * math.pi / 2, np.random.default_rng(1).uniform(-4, 4, 200)))
    cos, sin = np.cos(directions), np.sin(directions)
    cos[1], sin[0] = 0.0, 0.0  # along an edge, exactly
    ranges, squareness = edge_ranges(edges, np.ones(4), *place, cos, sin)
    expected = _edges_by_numpy(edges, *place, cos, sin)
    assert np.isfinite(ranges).any()
    assert np.array_equal(ranges, expected[0])
    assert np.array_equal(squareness, expected[1])


def test_nearest_occupied_cell_is_found_by_its_square() -> None:
    occupied = np.zeros((40, 60), np.uint8)
    occupied[10, 20], occupied[30, 25] = 254, 1
    point = (-1.0 + 23.5 * 0.05, 2.0 + 10.4 * 0.05)
    found = nearest_occupied(occupied, (23, 10), 13, 0.05, (-1.0, 2.0), point)
    assert found is not None
    squared, dx, dy = found
    assert dy == 0.0
    assert dx == pytest.approx(-2.5 * 0.05)
    assert squared == dx * dx
    assert nearest_occupied(occupied, (59, 0), 13, 0.05, (-1.0, 2.0), (1.9, 2.0)) is None


def test_arrays_that_do_not_fit_are_refused() -> None:
    one, two = np.zeros(1), np.zeros(2)
    with pytest.raises(ValueError, match="n ranges and errors"):
        disturb(one, two, one, sigma=0.0, share=0.0, dropout=0.0, low=0.0, high=1.0)
    with pytest.raises(ValueError, match="n ranges and angles"):
        set_in_sectors(one, two, np.zeros((1, 2)), 0.0)
    drawn = Drawn(one, one, np.zeros((2, 1)))
    with pytest.raises(ValueError, match="1 ranges and 0 patches do not fit"):
        disturb_as_recorded(one, Beams(one, one, one), drawn, RECORDED, (0.0, 0.0), np.zeros((0, 4)), np.zeros((0, 2)))
    with pytest.raises(ValueError, match="n angles, starts and ranges"):
        encode_nodes(np.zeros(1, np.int64), np.zeros(1, np.bool_), two, 0.1, 1.0)
    with pytest.raises(ValueError, match="k edges and lengths"):
        edge_ranges(np.zeros((3, 4)), two, 0.0, 0.0, one, one)
