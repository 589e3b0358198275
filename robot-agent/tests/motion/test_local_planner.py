"""Following a path: progress, the inputs of a decision, detours around obstacles, and the middle of narrow places.

Noise can't open a gap that an earlier scan saw closed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.grid import GridGeometry
from fog_kernels.clearance import clearance
from fog_kernels.course import distances
from fog_kernels.dwa import DwaLimits, DwaSettings
from fog_kernels.robot import cover
from robot_agent.config import MotionConfig
from robot_agent.footprint import Footprint
from robot_agent.localization.pose import Pose2
from robot_agent.localization.scans import DeskewedScan, RecentScans
from robot_agent.motion.local_planner import course, decide, give_way, make_job, twist, wheels
from robot_agent.motion.path_follower import PathFollower, detour, first_blocked

GRID = GridGeometry(200, 120, 0.05, 0.0, 0.0)
CONFIG = MotionConfig(limits=DwaLimits(axle=0.235, wheel_max=0.5))
EIGHT = np.array([(1.0, 1.0), (4.0, 4.0), (4.0, 1.0), (1.0, 4.0)])


def job(follower, pose, *, cost=None, speed=None, lidar_points=(), cap=0.3, speeds=(0.2, 0.0), theta=None):  # noqa: PLR0913  # each has a default
    return make_job(
        follower,
        plan_id=1,
        planner_epoch=1,
        now=0.0,
        pose=pose,
        speeds=speeds,
        goal_theta=theta,
        cap=cap,
        cost=np.zeros(GRID.shape, np.uint8) if cost is None else cost,
        speed_limits=np.zeros(GRID.shape, np.uint8) if speed is None else speed,
        geometry=GRID,
        lidar_points=np.array(lidar_points, dtype=np.float64).reshape(-1, 2),
        footprint=Footprint.circle(0.17),
        config=CONFIG,
    )


@given(st.floats(-0.3, 0.3), st.floats(-2.0, 2.0))
def test_wheels_and_twist_are_each_others_inverse(v, w):
    assert twist(*wheels(v, w, 0.235), 0.235) == pytest.approx((v, w), abs=1e-12)


def test_progress_does_not_jump_where_a_path_crosses_itself():
    follower = PathFollower(EIGHT, math.inf)
    progress = []
    for along in np.linspace(0.0, follower.length, 200):
        x, y = (np.interp(along, follower.along, EIGHT[:, i]) for i in (0, 1))
        follower.advance(x, y, 0.0)
        progress.append(follower.progress)
    assert np.diff(progress).min() > -1e-9
    assert np.abs(np.array(progress) - np.linspace(0.0, follower.length, 200)).max() < 0.01


def test_only_the_released_part_of_the_path_is_returned():
    follower = PathFollower(np.array([(1.0, 1.0), (9.0, 1.0)]), 3.0)
    follower.advance(3.5, 1.0, 0.0)
    points, ends = follower.released_ahead(2.5)
    assert points[-1] == pytest.approx((4.0, 1.0))
    assert not ends
    assert follower.released_remaining == pytest.approx(0.5)
    follower.release(100.0)
    points, ends = follower.released_ahead(2.5)
    assert points[-1] == pytest.approx((6.0, 1.0))
    assert follower.released_ahead(50.0)[1]


def test_released_path_does_not_lead_back_after_overshooting_its_end():
    follower = PathFollower(np.array([(1.0, 1.0), (9.0, 1.0)]), 2.0)
    follower.advance(3.3, 1.0, 0.0)
    points, _ = follower.released_ahead(2.5)
    assert np.ptp(points[:, 0]) == pytest.approx(0.0)
    assert follower.released_remaining == 0.0


def test_stuck_time_is_counted_from_the_last_progress():
    follower = PathFollower(np.array([(1.0, 1.0), (9.0, 1.0)]), math.inf)
    follower.advance(1.0, 1.0, 0.0)
    follower.advance(2.0, 1.0, 5.0)
    follower.advance(2.05, 1.0, 9.0)
    assert follower.stuck_for(15.0) == 10.0
    follower.restart_progress_timer(15.0)
    assert follower.stuck_for(16.0) == 1.0


def test_a_decision_never_exceeds_the_cap_nor_the_speed_layer():
    follower = PathFollower(np.array([(2.0, 3.0), (9.0, 3.0)]), math.inf)
    pose = Pose2(2.5, 3.0, 0.0)
    follower.advance(pose.x, pose.y, 0.0)
    assert decide(job(follower, pose)).v == pytest.approx(0.3, abs=0.01)
    assert decide(job(follower, pose, cap=0.15, speeds=(0.1, 0.0))).v <= 0.15
    limited = np.zeros(GRID.shape, np.uint8)
    limited[50:70, 40:60] = 8
    assert decide(job(follower, pose, speed=limited, speeds=(0.05, 0.0))).v <= 0.08 + 1e-9


def test_no_job_off_the_map():
    follower = PathFollower(np.array([(2.0, 3.0), (9.0, 3.0)]), math.inf)
    assert job(follower, Pose2(-1.0, 3.0, 0.0)) is None


@given(st.floats(-math.pi, math.pi), st.floats(0.16, 0.5), st.floats(0.0, 0.3))
def test_no_decision_drives_into_a_lidar_point(bearing, distance, v):
    follower = PathFollower(np.array([(2.0, 3.0), (9.0, 3.0)]), math.inf)
    pose = Pose2(4.0, 3.0, 0.0)
    follower.advance(pose.x, pose.y, 0.0)
    obstacle = np.array([(pose.x + distance * math.cos(bearing), pose.y + distance * math.sin(bearing))])
    decision = decide(job(follower, pose, lidar_points=obstacle, speeds=(v, 0.0)))
    ahead = abs(bearing) < math.radians(20) and distance < 0.2
    if ahead:
        assert decision.v <= 0.11
    assert max(abs(decision.left), abs(decision.right)) <= 0.5 + 1e-9
    turned, x, y = 0.0, pose.x, pose.y
    nearest = math.inf
    for _ in range(20):
        turned += decision.w * 0.01
        x, y = x + decision.v * 0.01 * math.cos(turned), y + decision.v * 0.01 * math.sin(turned)
        nearest = min(nearest, math.hypot(x - obstacle[0, 0], y - obstacle[0, 1]))
    assert nearest >= min(distance, 0.12) - 0.045


def test_detour_leads_around_and_back_and_without_one_the_path_stays():
    follower = PathFollower(np.array([(2.0, 3.0), (9.0, 3.0)]), math.inf)
    follower.advance(2.5, 3.0, 0.0)
    path, _ = follower.released_ahead(2.5)
    costs = np.zeros(GRID.shape, np.uint8)
    costs[50:70, 70:76] = 254
    around = detour(path, costs, GRID, Pose2(2.5, 3.0, 0.0))
    assert first_blocked(costs, GRID, PathFollower(around, math.inf), skip=0.0) is None
    assert around[-1] == pytest.approx(path[-1])
    costs[:, 70:76] = 254
    assert detour(path, costs, GRID, Pose2(2.5, 3.0, 0.0)) is path


def test_first_blocked_cell_is_found_and_an_inscribed_start_is_tolerated():
    follower = PathFollower(np.array([(2.0, 3.0), (9.0, 3.0)]), math.inf)
    follower.advance(2.0, 3.0, 0.0)
    costs = np.zeros(GRID.shape, np.uint8)
    assert first_blocked(costs, GRID, follower) is None
    costs[:, 40:48] = 253
    assert first_blocked(costs, GRID, follower) is None
    costs[:, 100] = 253
    assert first_blocked(costs, GRID, follower) == pytest.approx(3.0, abs=0.05)
    costs[:, 45] = 254
    assert first_blocked(costs, GRID, follower) == pytest.approx(0.25, abs=0.05)


def test_goal_counts_as_reached_only_at_its_heading():
    follower = PathFollower(np.array([(2.0, 3.0), (5.0, 3.0)]), math.inf)
    follower.advance(4.97, 3.0, 0.0)
    pose = Pose2(4.97, 3.0, 0.0)
    assert decide(job(follower, pose, speeds=(0.0, 0.0))).at_goal
    turning = decide(job(follower, pose, speeds=(0.0, 0.0), theta=1.5))
    assert not turning.at_goal
    assert turning.v == 0.0
    assert turning.w > 0.0


def test_wholly_released_path_ends_at_its_goal_despite_rounded_points():
    points = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 2.0)])
    follower = PathFollower(points, released_length=4.9996)
    follower.advance(3.0, 1.9, 0.0)
    assert follower.released_ahead(2.5)[1]
    follower.release(4.5)
    assert not follower.released_ahead(2.5)[1]


def test_robot_that_has_arrived_turns_to_its_heading_whatever_the_noise_of_its_pose_says():
    follower = PathFollower(np.array([(1.0, 1.0), (3.0, 1.0)]), math.inf)
    pose = Pose2(2.925, 1.0, 1.0)  # outside the tolerance of 0.06 m, but where a robot that has arrived stays
    follower.advance(pose.x, pose.y, 0.0)
    coming = decide(job(follower, pose, speeds=(0.0, 0.0), theta=2.0))
    assert not coming.arrived
    assert coming.v > 0.0 or coming.w < 0.0
    there = decide(replace(job(follower, pose, speeds=(0.0, 0.0), theta=2.0), arrived=True))
    assert there.arrived
    assert there.w > 0.0
    assert not there.at_goal
    moved = Pose2(2.9, 1.0, 1.0)
    assert not decide(replace(job(follower, moved, speeds=(0.0, 0.0), theta=2.0), arrived=True)).arrived


BODY = cover(Footprint.circle(0.17).polygon)
PATH = np.array([(1.0, 1.0), (3.0, 1.0)])


def around(points):
    return clearance(
        np.zeros((60, 60), np.uint8), 0.05, 0.0, 0.0, points, 1.2, 1.0, BODY, DEFAULT_INFLATION,
        DwaLimits(axle=0.235, wheel_max=0.5), DwaSettings(), at_least=1.0,
    )  # fmt: skip


def walls(*heights):
    return [(x, y) for x in np.arange(0.0, 3.0, 0.02) for y in heights]


def test_path_beside_one_wall_moves_away_until_there_is_room():
    field = around(walls(0.78))
    pushed = give_way(course(PATH, field), field, 0.30).path
    middle = pushed[(pushed[:, 0] > 1.3) & (pushed[:, 0] < 1.9)]
    assert middle[:, 1] == pytest.approx(np.full(len(middle), 1.08), abs=0.02)
    assert pushed[0] == pytest.approx(PATH[0])
    assert pushed[-1] == pytest.approx(PATH[-1])


def test_path_between_two_walls_moves_to_the_middle_and_stays_there():
    field = around(walls(0.82, 1.26))
    pushed = give_way(course(PATH, field), field, 0.30).path
    middle = pushed[(pushed[:, 0] > 1.3) & (pushed[:, 0] < 1.9)]
    assert middle[:, 1] == pytest.approx(np.full(len(middle), 1.04), abs=0.015)
    assert distances(field, middle).min() > 0.2


@pytest.mark.parametrize("beside", [-0.03, 0.01, 0.03])
@pytest.mark.parametrize("leaf", [0.0, 0.5, 1.0])
def test_path_beside_the_middle_of_a_gap_is_bent_onto_its_middle(leaf, beside):
    # A post, or the edge of a door of which the leaf leads away at an angle, 21 cm from the middle; a post opposite.
    edge = [(1.5 + 0.5 * t * leaf, 1.21 + t) for t in (np.arange(0.0, 0.8, 0.01) if leaf else (0.0,))]
    field = around([*edge, (1.5, 0.79)])
    bent = give_way(course(PATH + np.array((0.0, beside)), field), field, 0.29).path
    assert np.interp(1.5, *bent.T) == pytest.approx(1.0, abs=0.0005)


def test_path_with_room_on_both_sides_is_left_alone():
    field = around(walls(0.5, 1.5))
    assert give_way(course(PATH, field), field, 0.30).path is PATH


def test_points_of_earlier_scans_are_placed_by_odometry_and_forgotten_after_a_second():
    scans = RecentScans()
    ahead = np.array([(1.0, 0.0)])
    first, second = (DeskewedScan(ahead, Pose2(x, 0.0, 0.0), x) for x in (0.0, 0.3))
    scans.add(first, 10.0)
    scans.add(first, 10.1)
    scans.add(second, 10.2)
    # In `map` the robot looks along y.
    found = scans.points(Pose2(5.0, 5.0, np.pi / 2), 10.2)
    assert found == pytest.approx(np.array([(5.0, 5.7), (5.0, 6.0)]))
    assert len(scans.points(Pose2(5.0, 5.0, 0.0), 11.1)) == 1
    assert len(scans.points(Pose2(5.0, 5.0, 0.0), 11.3)) == 0
