"""Scans in the plane: the kernels against the same in numpy, or against what geometry says."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from compiler import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_kernels.amcl import score_poses
from fog_kernels.distance import likelihood_field, squared_distance_capped
from fog_kernels.raycast import cast
from fog_kernels.scans import Mounting, Tolerances, Track, climb, compared, into_frame, out_of_frame, placed, smoothed

RESOLUTION = 0.05
ORIGIN = (-1.0, 0.5)
LIDAR = Mounting(0.1, -0.05, 0.4)
TOLERANCES = Tolerances(near=0.25, on=0.12, range=0.4)
STEPS = np.array([(0.05, 0.05, 0.02), (0.012, 0.012, 0.005)])
BOUND = np.array((0.3, 0.3, 0.15))


def room() -> np.ndarray:
    """A room of 4 m by 3 m with a pillar, in cells."""
    occupied = np.zeros((60, 80), np.uint8)
    occupied[[0, -1], :] = occupied[:, [0, -1]] = 1
    occupied[20:26, 50:54] = 1
    return occupied


ROOM = room()
WALL_DISTANCE = (np.sqrt(squared_distance_capped(ROOM, 20)) * RESOLUTION).astype(np.float32)
FIELD = likelihood_field(ROOM, RESOLUTION, 0.14, 0.6, 1.0, 0.0)
PLACE = (1.0, 2.0, 0.7)


def points_at(pose: tuple[float, float, float], count: int = 90, longer: float = 0.0) -> np.ndarray:
    """What a lidar in the middle of the robot measures in the room, as points in `base`."""
    angles = np.linspace(-math.pi, math.pi, count, endpoint=False)
    ranges = cast(ROOM, RESOLUTION, *ORIGIN, pose[0], pose[1], angles + pose[2], 12.0) + 0.02 + longer
    return np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles)))


def moved(track: Track, time: float) -> tuple[float, float, float]:
    """Where a track says that the robot was at a time, by numpy."""
    known = track.entries
    x, y, theta = (float(np.interp(time, known[:, 0], known[:, axis])) for axis in (1, 2, 3))
    late = min(max(time - known[-1, 0], 0.0), track.ahead)
    heading = theta + 0.5 * track.w * late
    return x + track.v * late * math.cos(heading), y + track.v * late * math.sin(heading), theta + track.w * late


@settings(max_examples=examples(100))
@given(
    times=st.lists(st.floats(0.0, 1.0).map(lambda time: round(time, 3)), min_size=1, max_size=6, unique=True),
    span=st.tuples(st.floats(-0.5, 1.5), st.floats(0.0, 0.5)),
    ranges=st.lists(st.one_of(st.just(math.nan), st.floats(0.0, 5.0)), max_size=12),
    seed=st.integers(0, 99),
)
def test_each_return_is_seen_from_where_the_robot_was_at_its_time(times, span, ranges, seed):
    rng = np.random.default_rng(seed)
    track = Track(np.column_stack((sorted(times), rng.normal(size=(len(times), 3)))), 0.3, -0.8, 0.15)
    angles = rng.uniform(-math.pi, math.pi, len(ranges))
    begin, end = span[0], span[0] + span[1]
    found = placed(angles, np.array(ranges), begin, end, track, LIDAR, 0.5, 4.0)
    at = [begin + (end - begin) * i / max(len(ranges) - 1, 1) for i in range(len(ranges))]
    expected = []
    for time, angle, distance in zip(at, angles, ranges, strict=True):
        if not 0.5 <= distance <= 4.0:
            continue
        x, y, theta = moved(track, time)
        base = complex(LIDAR.x, LIDAR.y) + distance * np.exp(1j * (angle + LIDAR.yaw))
        point = complex(x, y) + base * np.exp(1j * theta)
        expected.append((point.real, point.imag, time))
    assert np.column_stack((found.points, found.times)) == pytest.approx(np.array(expected).reshape(-1, 3), abs=1e-9)


@settings(max_examples=examples(100))
@given(st.lists(st.tuples(st.floats(0.0, 0.3), st.floats(0.0, 0.3)), max_size=20))
def test_smoothed_points_are_the_means_with_their_near_neighbours_within_the_limit(points):
    ring = np.array(points).reshape(-1, 2)
    following = np.roll(ring, -1, axis=0) - ring
    joined = np.hypot(following[:, 0], following[:, 1]) < 0.06
    towards_next = np.where(joined[:, None], following, 0.0)
    shift = (towards_next - np.roll(towards_next, 1, axis=0)) / (1.0 + joined + np.roll(joined, 1))[:, None]
    shift /= np.maximum(np.hypot(shift[:, 0], shift[:, 1]) / 0.01, 1.0)[:, None]
    assert smoothed(ring, 0.06, 0.01) == pytest.approx(ring + shift, abs=1e-12)


@settings(max_examples=examples(100))
@given(
    st.lists(st.tuples(st.floats(-9.0, 9.0), st.floats(-9.0, 9.0)), max_size=20),
    st.tuples(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0), st.floats(-7.0, 7.0)),
)
def test_points_in_a_frame_and_out_of_it_are_numpys_to_the_bit(points, pose):
    given_points = np.array(points).reshape(-1, 2)
    x, y, cos, sin = pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2])
    px, py = given_points.T
    out = np.column_stack((x + cos * px - sin * py, y + sin * px + cos * py))
    assert np.array_equal(out_of_frame(given_points, *pose), out)
    dx, dy = px - x, py - y
    assert np.array_equal(into_frame(given_points, *pose), np.column_stack((cos * dx + sin * dy, -sin * dx + cos * dy)))
    assert into_frame(out, *pose) == pytest.approx(given_points, abs=1e-9)


@settings(max_examples=examples(60))
@given(
    pose=st.tuples(st.floats(-0.5, 2.5), st.floats(0.8, 3.2), st.floats(-3.0, 3.0)),
    reach=st.sampled_from([1.5, 13.0]),
    longer=st.floats(-1.0, 1.0),
)
def test_beams_are_counted_as_agreeing_long_or_short_by_map_and_expected_range(pose, reach, longer):
    points = points_at(PLACE, longer=longer)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    ends = points @ np.array(((cos, sin), (-sin, cos))) + pose[:2]
    cells = np.floor((ends - ORIGIN) / RESOLUTION).astype(int)
    inside = ((cells >= 0) & (cells < (80, 60))).all(axis=1)
    distances = np.ones(len(points))
    distances[inside] = WALL_DISTANCE[cells[inside, 1], cells[inside, 0]]
    offset = ends - pose[:2]
    expected = cast(ROOM, RESOLUTION, *ORIGIN, pose[0], pose[1], np.arctan2(offset[:, 1], offset[:, 0]), reach)
    ranges, near = np.hypot(offset[:, 0], offset[:, 1]), distances <= TOLERANCES.near
    agree = near & (np.abs(ranges - expected) < 1.2)
    found = compared(points, pose, ROOM, WALL_DISTANCE, RESOLUTION, ORIGIN, 1.0, reach, TOLERANCES)
    # A beam that ends on the border of two cells may count either way.
    assert found == pytest.approx(
        (
            agree.sum(),
            (~near & (ranges > expected + 0.4)).sum(),
            (~near & (ranges < expected - 0.4)).sum(),
            (distances[agree] > TOLERANCES.on).sum(),
        ),
        abs=2,
    )


def test_all_beams_of_the_right_pose_agree_and_none_ends_beside_its_wall():
    points = points_at(PLACE)
    found = compared(points, PLACE, ROOM, WALL_DISTANCE, RESOLUTION, ORIGIN, 1.0, 13.0, TOLERANCES)
    assert found == (len(points), 0, 0, 0)


def test_a_scan_without_points_says_nothing():
    nothing = np.zeros((0, 2))
    assert compared(nothing, PLACE, ROOM, WALL_DISTANCE, RESOLUTION, ORIGIN, 1.0, 13.0, TOLERANCES) == (0, 0, 0, 0)
    assert not climb(nothing, PLACE, np.eye(3), FIELD, RESOLUTION, ORIGIN, 40.0, STEPS, BOUND, 12).any()


def climbed(points: np.ndarray, pose: tuple[float, float, float], prior: np.ndarray) -> np.ndarray:
    """The climb by numpy."""
    shifts = np.array(list(itertools.product((-1, 0, 1), repeat=3)), float)
    best = np.zeros(3)
    angles, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
    for step in STEPS:
        for _ in range(12):
            tried = best + shifts * step
            fit = score_poses(*(np.array(pose) + tried).T, FIELD, RESOLUTION, *ORIGIN, angles, ranges)
            values = 40.0 * fit - 0.5 * np.einsum("ni,ij,nj->n", tried, prior, tried)
            values[(np.abs(tried) > BOUND).any(axis=1)] = -np.inf
            highest = int(np.argmax(values))
            if values[highest] <= values[13] + 1e-9:
                break
            best = tried[highest]
    return best


@pytest.mark.parametrize("offset", [(0.1, -0.08, 0.05), (0.0, 0.0, 0.0), (-0.2, 0.15, -0.1), (0.9, 0.0, 0.0)])
def test_climbing_ends_where_it_ends_in_numpy(offset):
    pose = tuple(float(value) for value in np.array(PLACE) + offset)
    points, prior = points_at(PLACE), np.diag((4.0, 9.0, 30.0))
    found = climb(points, pose, prior, FIELD, RESOLUTION, ORIGIN, 40.0, STEPS, BOUND, 12)
    assert found == pytest.approx(climbed(points, pose, prior), abs=1e-9)


def test_climbing_finds_the_true_pose_from_nearby_and_keeps_within_its_bound():
    points = points_at(PLACE)
    near = (PLACE[0] + 0.1, PLACE[1] - 0.08, PLACE[2] + 0.05)
    found = climb(points, near, np.eye(3), FIELD, RESOLUTION, ORIGIN, 40.0, STEPS, BOUND, 12)
    assert np.array(near) + found == pytest.approx(np.array(PLACE), abs=0.03)
    far = (PLACE[0] + 0.6, PLACE[1], PLACE[2])
    assert (np.abs(climb(points, far, np.eye(3), FIELD, RESOLUTION, ORIGIN, 40.0, STEPS, BOUND, 12)) <= BOUND).all()


def test_wrong_arrays_are_refused_by_name():
    track = Track(np.zeros((1, 4)), 0.0, 0.0, 0.15)
    with pytest.raises(ValueError, match="one length, not 2 and 3"):
        placed(np.zeros(2), np.ones(3), 0.0, 0.1, track, LIDAR, 0.1, 5.0)
    with pytest.raises(ValueError, match="k >= 1"):
        placed(np.zeros(2), np.ones(2), 0.0, 0.1, Track(np.zeros((0, 4)), 0.0, 0.0, 0.15), LIDAR, 0.1, 5.0)
    with pytest.raises(ValueError, match=r"points must have shape \(n, 2\)"):
        smoothed(np.zeros((4, 3)), 0.06, 0.01)
    for change in (into_frame, out_of_frame):
        with pytest.raises(ValueError, match=r"points must have shape \(n, 2\)"):
            change(np.zeros((4, 3)), 0.0, 0.0, 0.0)
    points = points_at(PLACE)
    with pytest.raises(ValueError, match="one shape"):
        compared(points, PLACE, ROOM, WALL_DISTANCE[1:], RESOLUTION, ORIGIN, 1.0, 13.0, TOLERANCES)
    with pytest.raises(ValueError, match="finite"):
        compared(points, (math.nan, 0.0, 0.0), ROOM, WALL_DISTANCE, RESOLUTION, ORIGIN, 1.0, 13.0, TOLERANCES)
    with pytest.raises(ValueError, match="finite"):
        compared(np.full((4, 2), math.inf), PLACE, ROOM, WALL_DISTANCE, RESOLUTION, ORIGIN, 1.0, 13.0, TOLERANCES)
    with pytest.raises(ValueError, match="prior must have shape"):
        climb(points, PLACE, np.eye(2), FIELD, RESOLUTION, ORIGIN, 40.0, STEPS, BOUND, 12)
