"""The limits of a recovery in numbers, and how it follows trail, path and decisions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from little_world import AGENT
from open_floor import LONG, PADDING, ROUND, around

from fog_contracts.costs import UNKNOWN
from fog_contracts.grid import GridGeometry
from robot_agent.localization.pose import Pose2
from robot_agent.motion.local_planner import Job, decide
from robot_agent.motion.path_follower import PathFollower
from robot_agent.motion.recovery import (
    Attempt,
    Recoveries,
    Recovery,
    RecoveryMove,
    Situation,
    Trail,
    clearances,
    recovery_speeds,
    step,
)

HERE = Pose2(1.5, 1.5, 0.0)
STUCK = Situation(place=(0.0, 0.0), stuck_for=4.0, error=0.5, trail=0.5)
ALONG = STUCK._replace(error=0.0)


# --- the turning rate ---


@pytest.mark.parametrize("rate", [0.2, 0.5, 2.75])
@pytest.mark.parametrize(
    "move", [RecoveryMove(heading=2.0), RecoveryMove(heading=-2.0), RecoveryMove(trail=np.array([[1.36, 1.54]]))]
)
def test_recovery_turns_no_faster_than_the_robot_may_and_keeps_its_arc(rate, move):
    window = GridGeometry(width=60, height=60, resolution=0.05, origin_x=0.0, origin_y=0.0)
    motion = replace(AGENT.motion, limits=replace(AGENT.motion.limits, w_max=rate))
    made = decide(
        Job(
            plan_id=1, planner_epoch=1, made_at=0.0, pose=HERE, v=0.0, w=0.0, path=np.array([[1.5, 1.5], [2.5, 1.5]]),
            ends_here=False, goal_theta=None, arrived=False, cap=0.3, cost=np.zeros(window.shape, np.uint8),
            window=window, lidar_points=np.zeros((0, 2)), footprint=AGENT.footprint, config=motion, recovery=move,
        )
    )  # fmt: skip
    v, w = recovery_speeds(move, HERE, around([]), ROUND, PADDING, 0.3)
    assert abs(w) > 0.2
    share = min(1.0, rate / abs(w))
    assert (made.v, made.w) == pytest.approx((v * share, w * share))
    assert (made.right - made.left) / motion.limits.axle == pytest.approx(w * share)


# --- the machine ---


def test_series_turns_backs_up_15_cm_turns_and_backs_up_30_cm():
    state, now, moves = Recovery(), 0.0, []
    for _ in range(4):
        state, now = step(state, STUCK._replace(trail=0.6), now), now + 0.2
        moves.append((state.running, round(state.until, 6)))
        state, now = step(state, STUCK._replace(refused=True), now), now + 0.2
    assert moves == [
        (Attempt("turn"), 0.6), (Attempt("back", 0.15), 0.45), (Attempt("turn"), 0.6), (Attempt("back", 0.3), 0.3)
    ]  # fmt: skip
    assert step(state, STUCK, now).running is None


@pytest.mark.parametrize(("stuck_for", "moves"), [(3.99, False), (4.0, True)])
def test_robot_waits_4_s(stuck_for, moves):
    assert (step(Recovery(), STUCK._replace(stuck_for=stuck_for), 9.0).running is not None) == moves


@pytest.mark.parametrize(("later", "goes_on"), [(4.99, True), (5.0, False)])
def test_move_takes_5_s_at_most(later, goes_on):
    assert (step(step(Recovery(), STUCK, 10.0), STUCK, 10.0 + later).running is not None) == goes_on


@pytest.mark.parametrize(("error", "kind"), [(0.24, "back"), (0.26, "turn"), (-0.24, "back"), (-0.26, "turn")])
def test_turn_of_less_than_a_quarter_of_a_radian_is_left_out(error, kind):
    assert step(Recovery(), STUCK._replace(error=error), 10.0).running.kind == kind


@pytest.mark.parametrize(("error", "done"), [(0.11, False), (0.09, True), (-0.11, False), (-0.09, True)])
def test_turn_ends_within_a_tenth_of_a_radian(error, done):
    assert (step(step(Recovery(), STUCK, 10.0), STUCK._replace(error=error), 10.2).running is None) == done


@pytest.mark.parametrize(("trail", "moves"), [(0.055, False), (0.065, True)])
def test_trail_of_less_than_6_cm_is_not_worth_backing_up(trail, moves):
    state = step(Recovery(), ALONG._replace(trail=trail), 10.0)
    assert (state.running is not None) == moves
    assert state.until == 0.0
    assert state.origin == (0.0, 0.0)


@pytest.mark.parametrize(("away", "anew"), [(0.59, False), (0.61, True)])
def test_another_place_is_60_cm_away(away, anew):
    done = Recovery(begun=4, origin=(0.0, 0.0))
    assert (step(done, STUCK._replace(place=(0.0, away)), 10.0) == Recovery()) == anew
    state = Recovery(begun=1, origin=(0.1, 0.0))
    assert step(state, ALONG._replace(place=(0.2, 0.0)), 10.0).origin == (0.1, 0.0)


# --- the moves ---


def back(*behind, theta=0.0):
    """Backing up along points in `base` of a robot at HERE."""
    pose = Pose2(HERE.x, HERE.y, theta)
    return RecoveryMove(trail=pose.transform(np.array(behind))), pose


def test_robot_backs_up_at_8_cm_a_second_and_no_faster_than_it_may():
    move, pose = back((-0.1, 0.0), (-0.2, 0.0))
    assert recovery_speeds(move, pose, around([]), ROUND, PADDING, 0.3) == pytest.approx((-0.08, 0.0))
    assert recovery_speeds(move, pose, around([]), ROUND, PADDING, 0.05) == pytest.approx((-0.05, 0.0))


def test_robot_backs_up_on_the_arc_through_the_first_point_15_cm_behind():
    move, pose = back((-0.1, 0.05), (-0.149, 0.01), (-0.16, 0.04), (-0.3, 0.2))
    v, w = recovery_speeds(move, pose, around([]), ROUND, PADDING, 0.3)
    assert w == pytest.approx(v * 2.0 * 0.04 / (0.16**2 + 0.04**2))
    # With less of a trail, its last point.
    move, pose = back((-0.05, 0.0), (-0.1, 0.02))
    v, w = recovery_speeds(move, pose, around([]), ROUND, PADDING, 0.3)
    assert w == pytest.approx(v * 2.0 * 0.02 / (0.1**2 + 0.02**2))


@pytest.mark.parametrize(("aside", "turns"), [(0.29, False), (0.31, True), (-0.29, False), (-0.31, True)])
def test_robot_whose_trail_leads_aside_first_turns_its_back_on_it(aside, turns):
    move, pose = back((-0.2 * math.cos(aside), -0.2 * math.sin(aside)))
    v, w = recovery_speeds(move, pose, around([]), ROUND, PADDING, 0.3)
    assert (v == 0.0) == turns
    if turns:
        assert w == pytest.approx(math.copysign(0.6, aside))


@pytest.mark.parametrize(
    ("error", "rate"), [(0.2, 0.4), (-0.2, -0.4), (0.299, 0.598), (2.0, 0.6), (-2.0, -0.6), (3e-4, 0.0), (7e-4, 1.4e-3)]
)
def test_turn_is_twice_the_error_a_second_and_at_most_0_6(error, rate):
    found = recovery_speeds(RecoveryMove(heading=error), HERE, around([]), ROUND, PADDING, 0.3)
    assert found == pytest.approx((0.0, rate))


@pytest.mark.parametrize(("gap", "moves"), [(0.095, False), (0.115, True)])
def test_10_cm_behind_the_robot_must_be_free(gap, moves):
    wall = [(1.5 - 0.17 - PADDING - gap, y) for y in np.arange(1.2, 1.8, 0.01)]
    move, pose = back((-0.2, 0.0))
    assert (recovery_speeds(move, pose, around(wall), ROUND, PADDING, 0.3) is not None) == moves


@pytest.mark.parametrize("body", [ROUND, LONG])
@pytest.mark.parametrize("theta", [0.0, 0.5, 2.0, -2.5])
@pytest.mark.parametrize("side", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
def test_body_reaches_into_unknown_cells_with_each_of_its_sides(body, theta, side):
    discs = body.discs if len(body.discs) else np.array([(0.0, 0.0, 0.17)])
    cos, sin = math.cos(theta), math.sin(theta)
    x, y, radius = discs.T
    extent = float(((cos * x - sin * y) * side[0] + (sin * x + cos * y) * side[1] + radius).max())
    field = around([])
    centres = field.resolution * (np.arange(len(field.cost)) + 0.5) - 1.5
    beyond = (field.origin_x + centres)[None, :] * side[0] + (field.origin_y + centres)[:, None] * side[1]
    pose = (np.array([1.5]), np.array([1.5]), np.array([theta]))
    for border, free in ((extent - 0.04, False), (extent + 0.04, True)):
        unknown = field._replace(cost=np.where(beyond > border, UNKNOWN, field.cost).astype(np.uint8))
        assert (clearances(unknown, body, pose)[0] > 0.0) == free


@pytest.mark.parametrize(("x", "y"), [(0.15, 1.5), (2.85, 1.5), (1.5, 0.15), (1.5, 2.85)])
def test_body_that_reaches_over_the_border_of_the_map_has_no_room(x, y):
    field, inwards = around([], x=x, y=y), 0.05
    pose = (np.array([x]), np.array([y]), np.array([0.0]))
    assert clearances(field, ROUND, pose)[0] == 0.0
    moved = (pose[0] + inwards * np.sign(1.5 - x), pose[1] + inwards * np.sign(1.5 - y), pose[2])
    assert clearances(field, ROUND, moved)[0] > 0.0


# --- the trail, and all together ---


def test_trail_keeps_60_cm_in_steps_of_2_cm():
    trail = Trail()
    for x in np.arange(0.0, 1.5, 0.05):
        trail.add(Pose2(float(x), 0.0, 0.0))
    assert trail.length == pytest.approx(0.6)
    behind = trail.behind(Pose2(1.45, 0.0, 0.0))
    assert -np.diff(behind[:, 0]) == pytest.approx(np.full(30, 0.02))
    trail.add(Pose2(1.455, 0.0, 0.0))
    assert len(trail.behind(HERE)) == 31


def recovering(pose, points, *, cap=0.3, stuck_s=4.1):
    """A robot that came along x, and has stood at a pose for a time; the move that is due then."""
    recoveries, follower = Recoveries(), PathFollower(np.array(points), math.inf)
    for x in np.arange(0.0, pose.x, 0.02):
        recoveries.due(follower, Pose2(x, pose.y, 0.0), Pose2(x, pose.y, 0.0), cap, 0.0)
    follower.advance(pose.x, pose.y, 0.0)
    follower.restart_progress_timer(0.0)
    return recoveries, follower, recoveries.due(follower, pose, pose, cap, stuck_s)


def test_stuck_robot_turns_to_the_point_of_its_path_30_cm_ahead_and_its_timer_starts_anew():
    recoveries, follower, move = recovering(Pose2(1.0, 0.0, 0.0), [(0.0, 0.0), (1.0, 0.0), (1.0, 2.0)])
    assert move.heading == pytest.approx(math.pi / 2)
    assert move.trail is None
    assert follower.stuck_for(4.1) == 0.0
    bent = recovering(Pose2(1.0, 0.0, -1.0), [(0.0, 0.0), (1.1, 0.0), (1.1, 2.0)])[2]
    assert bent.heading == pytest.approx(math.atan2(0.2, 0.1))
    assert recoveries.due(follower, Pose2(1.0, 0.0, 1.5), Pose2(1.0, 0.0, 1.5), 0.3, 4.3) is None


def test_robot_that_heads_along_its_path_backs_up_along_its_trail_in_the_map():
    move = recovering(Pose2(1.0, 0.0, 0.0), [(0.0, 0.0), (3.0, 0.0)])[2]
    assert move.heading is None
    assert move.trail[:, 0] == pytest.approx(np.linspace(0.98, 0.4, len(move.trail)), abs=0.03)
    assert move.trail[:, 1] == pytest.approx(np.zeros(len(move.trail)))


@pytest.mark.parametrize(
    ("cap", "stuck_s", "due"), [(0.3, 4.1, True), (0.1, 4.1, True), (0.05, 7.9, False), (0.05, 8.1, True)]
)
def test_robot_that_must_drive_slowly_gets_longer(cap, stuck_s, due):
    move = recovering(Pose2(1.0, 0.0, 0.0), [(0.0, 0.0), (3.0, 0.0)], cap=cap, stuck_s=stuck_s)[2]
    assert (move is not None) == due


@pytest.mark.parametrize(("blocked", "goes_on"), [(None, True), ("no room", False)])
def test_move_that_finds_no_room_ends_and_a_reset_forgets_the_trail(blocked, goes_on):
    pose = Pose2(1.0, 0.0, 0.0)
    recoveries, follower, _ = recovering(pose, [(0.0, 0.0), (3.0, 0.0)])
    recoveries.on_decision(blocked)
    assert (recoveries.due(follower, pose, pose, 0.3, 4.3) is not None) == goes_on
    recoveries.reset()
    assert recoveries.due(follower, pose, pose, 0.3, 30.0) is None
