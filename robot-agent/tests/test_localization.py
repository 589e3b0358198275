"""The localizer alone: deskewing, propagation, and its robustness."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from little_world import L_ROOMS, grid_of

from fog_kernels.raycast import cast
from robot_agent.config import LocalizationConfig
from robot_agent.hardware import LaserScan
from robot_agent.localization.localizer import Localizer
from robot_agent.localization.pose import Pose2, SavedPose, wrap

STATIC, GEOMETRY = grid_of(L_ROOMS, 15.0, 12.0)
SOLID = (STATIC == 254).astype(np.uint8)
MOST_STEPS = 10_000
"""A search that takes more steps than this has no end."""
PLACES = [Pose2(5.0, 2.0, 1.0), Pose2(12.0, 8.0, -2.0), Pose2(3.5, 3.5, 0.3), Pose2(9.0, 1.5, 3.0)]


def measure_scan(pose_at, begin, end, *, solid=SOLID, noise=0.0, seed=0, repeats=1):  # noqa: PLR0913  # each has a default
    """Return a scan, clockwise, each beam cast from the robot's pose at its own time."""
    rng = np.random.default_rng(seed)
    times = np.linspace(begin, end, 360)
    angles = -np.arange(360) * 2 * math.pi / 360
    ranges = np.empty(360)
    for i, (at, angle) in enumerate(zip(times, angles, strict=True)):
        x, y, theta = pose_at(at)
        g = GEOMETRY
        ranges[i] = cast(solid, g.resolution, g.origin_x, g.origin_y, x, y, np.array([theta + angle]), 12.0)[0]
    ranges[~np.isfinite(ranges)] = math.nan
    ranges += noise * rng.standard_normal(360)
    return LaserScan(
        angles_rad=np.array([wrap(a) for a in angles]),
        ranges_m=ranges,
        quality=np.full(360, 40, np.uint8),
        started_at=begin,
        ended_at=end,
        repeats=repeats,
    )


def standing(pose, *, scans=8, localizer=None, solid=SOLID, start=0.0, prepare=None, on=(STATIC, GEOMETRY)):  # noqa: PLR0913  # each has a default
    localizer = localizer or Localizer(seed=3)
    localizer.load_map(localizer.fields_of(*on))
    for i in range(scans):
        begin = start + 0.18 * i
        for j in range(5):
            localizer.on_odometry(begin + 0.04 * j, 0.0, 0.0, 0.0)
        localizer.on_scan(
            measure_scan(lambda _: pose, begin, begin + 0.16, solid=solid, noise=0.01, seed=i), begin + 0.17
        )
        if i == 0 and prepare is not None:
            prepare(localizer)
    return localizer, start + 0.18 * scans


def error_of(localizer, at, pose):
    estimate = localizer.pose(at)
    return math.hypot(estimate.x - pose.x, estimate.y - pose.y), abs(wrap(estimate.theta - pose.theta))


poses = st.builds(Pose2, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))


@given(poses, poses)
def test_relative_to_and_compose_are_inverse(a, b):
    again = b.compose(a.relative_to(b))
    assert (again.x, again.y) == pytest.approx((a.x, a.y), abs=1e-9)
    assert wrap(again.theta - a.theta) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("v", "w"), [(0.3, 0.0), (0.0, 1.5), (0.25, -0.8)])
def test_scan_taken_in_motion_is_deskewed(v, w):
    def pose_at(at):
        theta = 0.4 + w * at
        if w == 0.0:
            return Pose2(5.0 + v * at * math.cos(0.4), 2.0 + v * at * math.sin(0.4), theta)
        return Pose2(
            5.0 + v / w * (math.sin(theta) - math.sin(0.4)), 2.0 - v / w * (math.cos(theta) - math.cos(0.4)), theta
        )

    localizer = Localizer()
    localizer.load_map(localizer.fields_of(STATIC, GEOMETRY))
    origin = pose_at(0.0)
    for i in range(9):
        localizer.on_odometry(0.025 * i, *(pose_at(0.025 * i).relative_to(origin)))
    localizer.on_scan(measure_scan(pose_at, 0.0, 0.18), 0.18)
    still = Localizer()
    still.load_map(still.fields_of(STATIC, GEOMETRY))
    still.on_odometry(0.0, 0.0, 0.0, 0.0)
    still.on_scan(measure_scan(pose_at, 0.0, 0.18), 0.18)
    end = pose_at(0.18)
    fits = [one.wall_distance(end.transform(one.scan.points)).mean() for one in (localizer, still)]
    assert fits[0] < 0.04
    assert fits[0] < fits[1]


@pytest.mark.parametrize("place", PLACES)
def test_a_given_pose_is_refined_and_trusted(place):
    localizer, now = standing(
        place, prepare=lambda one: one.initial_pose(place.x + 0.4, place.y - 0.3, place.theta + 0.25)
    )
    assert localizer.status == "good"
    xy, theta = error_of(localizer, now, place)
    assert xy < 0.06
    assert theta < 0.03


def test_a_given_pose_that_is_wrong_is_not_trusted():
    localizer, _ = standing(PLACES[0], prepare=lambda one: one.initial_pose(12.0, 6.0, 0.0), scans=5)
    assert localizer.status != "good"


@pytest.mark.parametrize("place", PLACES)
def test_global_localization_finds_the_robot_anywhere(place):
    localizer, now = standing(place, prepare=lambda one: one.global_localization(), scans=12)
    assert localizer.status == "good"
    xy, theta = error_of(localizer, now, place)
    assert xy < 0.08
    assert theta < 0.04


def test_pose_counts_as_unknown_on_a_new_map_until_scans_fit_there():
    localizer, now = standing(PLACES[0], prepare=lambda one: one.initial_pose(*PLACES[0]))
    assert localizer.status == "good"
    static = STATIC.copy()
    column, row = GEOMETRY.cell(8.0, 2.5)
    assert static[row, column] == 0
    static[row, column] = 254  # a new pillar, in the frame of before
    localizer.load_map(localizer.fields_of(static, GEOMETRY))
    assert (localizer.status, "map is a new one" in localizer.detail) == ("none", True)
    _, now = standing(PLACES[0], localizer=localizer, start=now, scans=4, on=(static, GEOMETRY))
    assert localizer.status == "good"
    assert error_of(localizer, now, PLACES[0])[0] < 0.06


def test_robot_finds_itself_on_a_new_map_that_lies_elsewhere():
    localizer, now = standing(PLACES[0], prepare=lambda one: one.initial_pose(*PLACES[0]))
    moved = msgspec.structs.replace(GEOMETRY, origin_x=GEOMETRY.origin_x + 3.0, origin_y=GEOMETRY.origin_y - 2.0)
    statuses = []
    for _ in range(40):
        _, now = standing(PLACES[0], localizer=localizer, start=now, scans=1, on=(STATIC, moved))
        statuses.append(localizer.status)
    assert "good" not in statuses[:2]
    assert statuses[-1] == "good"
    x, y, theta = PLACES[0]
    assert error_of(localizer, now, Pose2(x + 3.0, y - 2.0, theta))[0] < 0.08


def test_global_localization_fails_when_places_look_alike():
    static, geometry = grid_of([(1, 1, 4, 4), (6, 1, 9, 4)], 10, 5)
    localizer = Localizer()
    localizer.load_map(localizer.fields_of(static, geometry))
    localizer.on_odometry(0.0, 0.0, 0.0, 0.0)
    solid = (static == 254).astype(np.uint8)
    angles = np.arange(360) * 2 * math.pi / 360
    ranges = cast(solid, geometry.resolution, 0.0, 0.0, 2.0, 2.2, angles, 12.0)
    scan = LaserScan(
        angles_rad=angles, ranges_m=ranges, quality=np.zeros(360, np.uint8), started_at=0.0, ended_at=0.0, repeats=1,
    )  # fmt: skip
    localizer.on_scan(scan, 0.0)
    assert localizer.global_localization()
    for _ in range(MOST_STEPS):
        if not localizer.searching:
            break
        localizer.on_scan(scan, 0.1)
    assert not localizer.searching, f"the search has no end: {localizer.detail}"
    assert localizer.status == "lost"
    assert "look like this one" in localizer.detail
    assert len(localizer.hypotheses) > 1


def test_start_that_fits_no_place_is_tried_again_from_the_next_spot_without_a_pause():
    """Among the visitors of a recorded museum, starts failed since ten seconds and several scans passed."""
    localizer = Localizer(seed=1)
    localizer.load_map(localizer.fields_of(STATIC, GEOMETRY))
    crowd = np.random.default_rng(1).uniform(0.5, 9.0, 360)
    localizer.on_odometry(0.0, 0.0, 0.0, 0.0)
    seen = measure_scan(lambda _: PLACES[0], 0.0, 0.0)
    localizer.on_scan(replace(seen, ranges_m=crowd), 0.0)
    assert localizer.global_localization()
    for _ in range(MOST_STEPS):
        if not localizer.searching:
            break
        localizer.continue_search(0.0)
    assert not localizer.searching, f"the search has no end: {localizer.detail}"
    assert "fits no place" in localizer.detail
    for at, turned in ((1.0, 0.3), (2.0, 0.6)):
        localizer.on_odometry(at, 0.0, 0.0, turned)
        place = PLACES[0].compose(Pose2(0.0, 0.0, turned))
        localizer.on_scan(measure_scan(lambda _, place=place: place, at, at), at)
        assert localizer.searching == (turned > 0.5)


def people_around(place, angles):
    solid = SOLID.copy()
    for angle in angles:
        column, row = GEOMETRY.cell(place.x + 0.7 * math.cos(angle), place.y + 0.7 * math.sin(angle))
        solid[row - 3 : row + 4, column - 3 : column + 4] = 1
    return solid


def test_pose_that_the_search_found_elsewhere_is_judged_by_what_is_usual_there():
    """Where the robot was before, more beams agreed: there was no crowd."""
    before, place = PLACES[0], PLACES[1]
    localizer, now = standing(before, prepare=lambda each: each.initial_pose(*before), scans=15)
    assert localizer.status == "good"
    crowd = people_around(place, (0.3, 1.5, 2.9, 4.4))
    for _ in range(6):
        localizer, now = standing(place, localizer=localizer, solid=crowd, start=now, scans=15)
    assert localizer.status == "good", localizer.detail
    assert error_of(localizer, now, place)[0] < 0.1


def test_pose_stays_good_while_people_gather_around_the_robot():
    place, angles = PLACES[1], (0.3, 1.5, 2.9, 4.4)
    localizer, now = standing(place, prepare=lambda one: one.initial_pose(*place))
    for count in range(1, len(angles) + 1):
        _, now = standing(
            place, localizer=localizer, solid=people_around(place, angles[:count]), start=now, scans=15
        )  # fmt: skip
        assert localizer.status == "good"


def test_robot_that_is_suddenly_surrounded_is_weak_but_never_lost_and_good_again_without_the_crowd():
    place = PLACES[1]
    localizer, now = standing(place, prepare=lambda one: one.initial_pose(*place))
    crowd = people_around(place, (0.3, 1.5, 2.9, 4.4))
    for _ in range(10):
        _, now = standing(place, localizer=localizer, solid=crowd, start=now, scans=3)
        assert localizer.status == "weak"
        assert "something stands before them" in localizer.detail
        assert error_of(localizer, now, place)[0] < 0.06
    standing(place, localizer=localizer, start=now, scans=3)
    assert localizer.status == "good"


@pytest.mark.parametrize("open_beams", [0, 4])
def test_robot_that_people_surround_whole_is_weak_and_good_again_where_it_stood(open_beams):
    """It was lost for passing through walls, and searched the whole map, until somebody let it drive."""
    place = PLACES[1]
    localizer, now = standing(place, prepare=lambda one: one.initial_pose(*place))
    seen = []
    for number in range(60):
        scan = measure_scan(lambda _: place, now, now + 0.16, noise=0.01, seed=number)
        ranges = np.where(np.arange(360) < open_beams, scan.ranges_m, np.fmin(scan.ranges_m, 0.6))
        localizer.on_odometry(now + 0.16, 0.0, 0.0, 0.0)
        localizer.on_scan(replace(scan, ranges_m=ranges), now + 0.17)
        seen.append(localizer.status)
        now += 0.18
    assert set(seen) == {"weak"}
    assert "too few beams reach a wall" in localizer.detail
    assert error_of(localizer, now, place)[0] < 0.06
    standing(place, localizer=localizer, start=now, scans=3)
    assert localizer.status == "good"


def carried(localizer, now, place, *, scans):
    """Let the robot stand at another place than its odometry says; return (pose, status, searching) after each scan."""
    seen = []
    for _ in range(scans):
        _, now = standing(place, localizer=localizer, start=now, scans=1)
        seen.append((localizer.pose(now), localizer.status, localizer.searching))
    return seen


def test_lost_robot_is_found_near_its_last_pose_before_the_whole_map_is_searched():
    place = PLACES[1]
    localizer, now = standing(place, prepare=lambda one: one.initial_pose(*place))
    pushed = Pose2(place.x - 0.3, place.y + 0.3, place.theta + 0.3)
    seen = carried(localizer, now, pushed, scans=30)
    lost = [status for _, status, _ in seen].index("lost")
    found = next(n for n, (pose, _, _) in enumerate(seen) if math.dist(pose[:2], pushed[:2]) < 0.1)
    assert lost < found <= lost + 2
    assert not any(searching for _, _, searching in seen[lost : found + 1])


def test_lost_robot_keeps_its_estimate_while_the_whole_map_is_searched():
    place = PLACES[0]
    localizer, now = standing(place, prepare=lambda one: one.initial_pose(*place))
    seen = carried(localizer, now, PLACES[1], scans=40)
    searching = [pose for pose, _, searches in seen if searches]
    assert searching, "the whole map was never searched"
    assert all(pose is not None and math.dist(pose[:2], place[:2]) < 3.0 for pose in searching)
    assert math.dist(seen[-1][0][:2], PLACES[1][:2]) < 0.1


def test_saved_pose_is_restored_if_it_fits_else_the_map_is_searched():
    saved = SavedPose(site="s", x=5.2, y=1.9, theta=1.1, sigma_xy=0.1, sigma_theta=0.05)
    localizer, now = standing(PLACES[0], prepare=lambda one: one.restore(saved), scans=4)
    assert localizer.status == "good"
    assert error_of(localizer, now, PLACES[0])[0] < 0.06
    localizer, now = standing(PLACES[1], prepare=lambda one: one.restore(saved), scans=25)
    assert localizer.status == "good"
    assert error_of(localizer, now, PLACES[1])[0] < 0.08


def test_pose_is_saved_only_when_it_is_trusted():
    assert Localizer().save("s", 0.0) is None
    localizer, now = standing(PLACES[0], prepare=lambda one: one.initial_pose(*PLACES[0]))
    saved = localizer.save("s", now)
    assert (saved.x, saved.y) == pytest.approx((5.0, 2.0), abs=0.06)


def test_between_scans_the_pose_follows_the_odometry():
    localizer, now = standing(PLACES[0], prepare=lambda one: one.initial_pose(*PLACES[0]))
    before = localizer.pose(now)
    localizer.on_odometry(now + 0.05, 0.1, 0.0, 0.2)
    after = localizer.pose(now + 0.05)
    assert after.relative_to(before) == pytest.approx((0.1, 0.0, 0.2), abs=1e-6)


def test_number_of_particles_stays_within_its_bounds_and_the_seed_repeats_everything():
    def drive(seed):
        localizer = Localizer(LocalizationConfig(), seed)
        localizer.load_map(localizer.fields_of(STATIC, GEOMETRY))
        counts, found = [], []
        localizer.on_odometry(0.0, 0.0, 0.0, 0.0)
        localizer.initial_pose(2.0, 2.0, 0.0, 0.1, 0.05)
        for i in range(1, 25):
            at = 0.18 * i
            localizer.on_odometry(at, 0.3 * i, 0.0, 0.0)
            scan = measure_scan(lambda _, i=i: Pose2(2.0 + 0.3 * i, 2.0, 0.0), at, at, seed=i, noise=0.01)
            localizer.on_scan(scan, at)
            counts.append(localizer.particles)
            found.append(tuple(localizer.pose(at)))
        assert error_of(localizer, at, Pose2(2.0 + 0.3 * 24, 2.0, 0.0))[0] < 0.1
        return counts, found

    counts, found = drive(7)
    assert min(counts) >= 500
    assert max(counts) <= 2000
    assert drive(7) == (counts, found)
    assert drive(8)[1] != found


def test_delayed_readings_that_arrive_together_give_the_true_speed():
    localizer = Localizer(seed=1)
    for i in range(20):
        localizer.on_odometry(0.015 * i, 0.3 * 0.015 * i, 0.0, 0.0)
    begin, moved = 0.015 * 19, 0.3 * 0.015 * 19
    for i in range(1, 41):  # 0.6 s of motion, read within 4 ms
        localizer.on_odometry(begin + 0.6 + 0.0001 * i, moved + 0.3 * 0.015 * i, 0.0, 0.0)
    assert localizer.twist()[0] == pytest.approx(0.3, rel=0.02)
    late = localizer.odom_at(begin + 0.7)
    assert late is not None
    assert late.x == pytest.approx(moved + 0.3 * 0.7, abs=0.02)


def test_burst_of_readings_without_history_gives_zero_speed():
    localizer = Localizer(seed=1)
    for i in range(40):
        localizer.on_odometry(0.0001 * i, 0.3 * 0.015 * i, 0.0, 0.0)
    assert localizer.twist() == (0.0, 0.0)
