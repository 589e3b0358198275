"""A robot that gets no further waits, turns, backs up and gives up, without touching anything; and when each is due."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from little_world import AGENT
from open_floor import LONG, PADDING, ROUND, around

from fog_contracts.costs import UNKNOWN
from fog_contracts.grid import GridGeometry
from fog_kernels.robot import cover
from robot_agent.footprint import Footprint
from robot_agent.localization.pose import Pose2
from robot_agent.motion.local_planner import Job, decide
from robot_agent.motion.path_follower import PathFollower
from robot_agent.motion.recovery import (
    LENGTH_M,
    MOVE_MAX_S,
    PATIENCE_S,
    SERIES,
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

DT = 0.2
STUCK = Situation(place=(0.0, 0.0), stuck_for=PATIENCE_S, error=0.5, trail=0.5)
HERE = Pose2(1.5, 1.5, 0.0)
WIDE = cover(Footprint(((-0.1, -0.1), (0.12, -0.1), (0.12, 0.3), (-0.1, 0.3))).polygon)
"""Reaches farther to the left of its axle than to the right."""
ROUNDING = 0.007
"""What distances lose between the field's cells, and between the poses of an arc that are looked at (m)."""


def distance(body, pose, points):
    """Return the exact distance of points (n, 2) from a body at a pose; below 0 inside."""
    if not len(body.discs):
        return np.hypot(*(points - pose[:2]).T).min() - body.circumscribed
    seen = pose.inverse_transform(points)
    return (np.hypot(*(seen[:, None] - body.discs[None, :, :2]).transpose(2, 0, 1)) - body.discs[:, 2]).min()


# --- the machine ---


def exhausted(state):
    return state.running is None and state.begun == len(SERIES)


def test_robot_waits_before_it_moves_at_all():
    assert step(Recovery(), STUCK._replace(stuck_for=PATIENCE_S - 0.1), 10.0) == Recovery()
    assert step(Recovery(), STUCK, 10.0).running == SERIES[0]


def test_robot_that_heads_along_its_path_backs_up_instead_of_turning():
    assert step(Recovery(), STUCK._replace(error=0.1), 10.0).running.kind == "back"
    assert exhausted(step(Recovery(), STUCK._replace(error=0.1, trail=0.02), 10.0))


def test_turn_ends_at_the_path_and_backing_up_after_its_length():
    turning = step(Recovery(), STUCK, 10.0)
    assert step(turning, STUCK, 10.2).running
    assert step(turning, STUCK._replace(error=-0.05), 10.4).running is None
    backing = step(Recovery(), STUCK._replace(error=0.0), 10.0)
    length = SERIES[1].length
    assert step(backing, STUCK._replace(error=0.0, trail=0.5 - length + 0.02), 11.0).running
    assert step(backing, STUCK._replace(error=0.0, trail=0.5 - length), 11.0).running is None


@pytest.mark.parametrize(
    ("later", "seen"), [(0.2, STUCK._replace(refused=True)), (MOVE_MAX_S, STUCK)], ids=["no room", "too long"]
)
def test_move_that_is_not_possible_is_given_up(later, seen):
    assert step(step(Recovery(), STUCK, 10.0), seen, 10.0 + later).running is None


@given(st.lists(st.tuples(st.floats(0.0, 30.0), st.floats(-3.0, 3.0), st.floats(0.0, 0.6), st.booleans())))
def test_moves_at_one_place_have_an_end(seen):
    state, begun, now = Recovery(), 0, 0.0
    for stuck_for, error, trail, refused in seen:
        before, now = state, now + DT
        state = step(state, Situation((0.1, 0.2), stuck_for, error, trail, refused), now)
        begun += state.running is not None and state.running != before.running
        assert state.running is None or now - state.since <= MOVE_MAX_S
    assert begun <= len(SERIES)


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


def test_series_begins_anew_elsewhere_only():
    done = Recovery(begun=len(SERIES), origin=(0.0, 0.0))
    assert exhausted(step(done, STUCK._replace(place=(0.5, 0.0)), 10.0))
    assert not exhausted(step(done, STUCK._replace(place=(0.7, 0.0)), 10.0))


# --- the trail ---


def test_trail_is_taken_up_on_the_way_back():
    trail, x = Trail(), 0.0
    for x in np.arange(0.0, 1.0, 0.013):
        trail.add(Pose2(x, 0.0, 0.0))
    assert trail.length == pytest.approx(LENGTH_M)
    behind = trail.behind(Pose2(x, 0.0, 0.0))
    assert behind[0] == pytest.approx((0.0, 0.0), abs=0.02)
    assert behind[-1] == pytest.approx((-LENGTH_M, 0.0), abs=0.03)
    for back in np.arange(0.0, 0.3, 0.013):
        trail.add(Pose2(x - back, 0.003, 0.0))
    assert trail.length == pytest.approx(LENGTH_M - 0.3, abs=0.05)
    trail.clear()
    assert trail.length == 0.0
    assert len(trail.behind(Pose2(0.0, 0.0, 0.0))) == 0


# --- the moves ---


def drive(move_of, pose, points, body, seconds):
    """Make a move in a closed loop; return the poses, the last one where it ended."""
    poses = [pose]
    for _ in range(round(seconds / DT)):
        move = move_of(poses[-1])
        chosen = None if move is None else recovery_speeds(
            move, poses[-1], around(points, body, *poses[-1][:2]), body, PADDING, 0.3
        )  # fmt: skip
        if chosen is None:
            break
        x, y, theta = poses[-1]
        v, w = chosen
        poses.append(
            Pose2(x + v * DT * math.cos(theta + w * DT / 2), y + v * DT * math.sin(theta + w * DT / 2), theta + w * DT)
        )
    return poses


def test_turn_leads_to_the_path_where_there_is_room():
    walls = [(1.5 + 0.19 * math.cos(a), 1.5 + 0.19 * math.sin(a)) for a in np.arange(0.0, 6.2, 0.1)]
    poses = drive(lambda _: RecoveryMove(heading=2.0), Pose2(1.5, 1.5, -0.5), walls, ROUND, 8.0)
    assert poses[-1].theta == pytest.approx(2.0, abs=0.05)
    assert poses[-1][:2] == (1.5, 1.5)


def test_long_body_does_not_turn_its_tail_into_a_wall():
    wall = [(x, 1.5 - 0.16) for x in np.arange(1.0, 2.0, 0.02)]
    poses = drive(lambda _: RecoveryMove(heading=1.5), Pose2(1.5, 1.5, 0.0), wall, LONG, 8.0)
    assert poses[-1].theta < 0.5
    assert min(distance(LONG, pose, np.array(wall)) for pose in poses) > 0.0


def test_robot_backs_up_along_its_curved_trail():
    trail = Trail()
    for angle in np.arange(0.0, 1.0, 0.02):
        trail.add(Pose2(1.5 + 0.6 * math.sin(angle), 1.5 + 0.6 * (1.0 - math.cos(angle)), angle))
    end = Pose2(1.5 + 0.6 * math.sin(0.98), 1.5 + 0.6 * (1.0 - math.cos(0.98)), 0.98)

    def move(pose):
        trail.add(pose)
        return RecoveryMove(trail=pose.transform(trail.behind(pose))) if trail.length > 0.25 else None

    poses = drive(move, end, [], ROUND, 20.0)
    off = [abs(math.dist(pose[:2], (1.5, 2.1)) - 0.6) for pose in poses]
    assert max(off) < 0.02
    assert math.dist(poses[-1][:2], end[:2]) > 0.25


@given(
    st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), min_size=1, max_size=8),
    st.floats(-3.1, 3.1),
    st.floats(-1.5, 1.5),
    st.sampled_from([ROUND, LONG]),
    st.booleans(),
)
def test_no_move_brings_the_body_nearer_to_anything_than_its_padding(things, theta, bend, body, back):
    pose = Pose2(1.5, 1.5, theta)
    points = np.array([(1.5 + x, 1.5 + y) for x, y in things])
    begin = distance(body, pose, points)
    if begin < 0.0:
        return
    behind = np.array([(-s * math.cos(bend * s), -s * math.sin(bend * s)) for s in np.arange(0.02, 0.6, 0.02)])
    move = RecoveryMove(trail=pose.transform(behind)) if back else RecoveryMove(heading=theta + 2.0 * bend)
    poses = drive(lambda _: move, pose, points, body, 1.6)
    for reached in poses:
        assert distance(body, reached, points) >= min(begin, PADDING) - 0.006


def backing(*behind, pose=HERE, body=ROUND, things=()):
    """Return the speeds of backing up along points in `base` of a robot at a pose."""
    move = RecoveryMove(trail=pose.transform(np.array(behind)))
    return recovery_speeds(move, pose, around(list(things), body, *pose[:2]), body, PADDING, 0.3)


def nearest(body, poses, points):
    """Return the exact distance of each point (n, 2) from a body along poses (m, 3); below 0 inside."""
    discs = body.discs if len(body.discs) else np.array([(0.0, 0.0, body.circumscribed)])
    x, y, theta = (values[:, None] for values in np.array(poses).T)
    ahead, left, radius = discs.T
    centre_x = x + np.cos(theta) * ahead - np.sin(theta) * left
    centre_y = y + np.sin(theta) * ahead + np.cos(theta) * left
    away = np.hypot(points[:, 0] - centre_x[..., None], points[:, 1] - centre_y[..., None]) - radius[:, None]
    return away.min(axis=(0, 1))


def arc(pose, v, w, seconds, steps=60):
    """Return the poses of an arc, by small steps."""
    poses, dt = [pose], seconds / steps
    for _ in range(steps):
        x, y, theta = poses[-1]
        middle = theta + 0.5 * w * dt
        poses.append(Pose2(x + v * dt * math.cos(middle), y + v * dt * math.sin(middle), theta + w * dt))
    return poses


def first_at(body, poses, candidates, away):
    """Return the point (1, 2) after the last one that is nearer than `away` m; they lead away from the robot.

    Not the first one that is farther: a body is covered by discs along its rim, so its inside may seem to be far.
    """
    return candidates[np.flatnonzero(nearest(body, poses, candidates) < away)[-1] + 1][None]


@pytest.mark.parametrize("body", [ROUND, LONG, WIDE], ids=["round", "long", "wide"])
@given(
    theta=st.floats(-3.1, 3.1),
    bend=st.sampled_from([-3.0, -1.0, 0.0, 0.5, 2.0]),
    place=st.floats(-3.1, 3.1),
    away=st.floats(-0.02, 0.06),
)
@settings(deadline=None, max_examples=25)  # the field is made anew for each
def test_robot_backs_up_exactly_where_the_next_10_cm_keep_the_padding(body, theta, bend, place, away):
    pose = Pose2(1.5, 1.5, theta)
    behind = np.array([(-math.sin(bend * s) / bend if bend else -s, -(1.0 - math.cos(bend * s)) / bend if bend else 0.0)
                       for s in np.arange(0.02, 0.3, 0.02)])  # fmt: skip
    free = backing(*behind, pose=pose, body=body)
    assert free is not None
    v, w = free
    poses = arc(pose, v, w, 0.1 / abs(v) if v else 0.35 / abs(w))
    # A thing beside the way, and nearer to its begin or to its end.
    rays = np.arange(0.0, 0.8, 0.002)[:, None] * (math.cos(place), math.sin(place)) + (1.5, 1.5)
    thing = first_at(body, poses, rays, away)
    kept, begin = nearest(body, poses[1:], thing)[0], nearest(body, poses[:1], thing)[0]
    found = backing(*behind, pose=pose, body=body, things=thing)
    if begin >= PADDING + ROUNDING and kept >= PADDING + ROUNDING:
        assert found == free
    if begin >= PADDING + ROUNDING and kept < PADDING - ROUNDING:
        assert found is None


def test_robot_that_is_too_near_to_a_thing_may_go_away_from_it_but_not_nearer():
    thing = (1.5 + 0.17 + 0.5 * PADDING, 1.5)
    assert backing((-0.2, 0.0), things=[thing]) == pytest.approx((-0.08, 0.0))
    assert backing((-0.2, 0.0), pose=Pose2(1.5, 1.5, math.pi), things=[thing]) is None


@pytest.mark.parametrize(("outwards", "room"), [(-0.01, True), (0.01, False)])
@pytest.mark.parametrize("side", [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
def test_body_may_reach_to_the_border_of_the_map_and_not_beyond(side, outwards, room):
    field = around([])
    half = 0.5 * len(field.cost) * field.resolution
    away = half - 0.17 + outwards
    x, y = field.origin_x + half + away * side[0], field.origin_y + half + away * side[1]
    assert (clearances(field, ROUND, (np.array([x]), np.array([y]), np.array([0.0])))[0] > 0.0) == room


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


@pytest.mark.parametrize("theta", [0.0, 3.1])
def test_trail_that_ends_where_the_robot_stands_gives_no_move(theta):
    pose = Pose2(1.5, 1.5, theta)
    for here in ([(1.5, 1.5)], [(1.503, 1.5)], np.zeros((0, 2))):
        move = RecoveryMove(trail=np.array(here, dtype=np.float64).reshape(-1, 2))
        assert recovery_speeds(move, pose, around([]), ROUND, PADDING, 0.3) == (0.0, 0.0)
    # The sign of a zero decides what the arc's formula divides by.
    there = Pose2(0.0, 0.0, math.pi)
    move = RecoveryMove(trail=np.array([(0.0, 0.0)]))
    assert recovery_speeds(move, there, around([], x=0.0, y=0.0), ROUND, PADDING, 0.3) == (0.0, 0.0)


@pytest.mark.parametrize(("body", "front", "rear"), [(ROUND, 0.17, 0.17), (LONG, 0.15, 0.3)])
def test_places_that_nobody_knows_are_not_free_under_any_part_of_the_body(body, front, rear):
    field = around([])
    cost = field.cost.copy()
    east = field.origin_x + field.resolution * np.arange(cost.shape[1])
    cost[:, east > 2.0] = UNKNOWN
    field = field._replace(cost=cost)
    middle, ahead = np.array([1.5]), np.array([0.0])
    beside = np.array([2.05 - 0.8 * front])
    assert clearances(field, body, (middle, middle, ahead))[0] > 0.1
    assert clearances(field, body, (beside, middle, ahead))[0] == 0.0
    back = RecoveryMove(trail=np.array([(1.9 + step, 1.5) for step in np.arange(0.02, 0.5, 0.02)]))
    pose = Pose2(2.0 - rear - 0.04, 1.5, math.pi)
    assert recovery_speeds(back, pose, field, body, PADDING, 0.3) is None


def test_unknown_places_are_not_free():
    field = around([])
    free, off = (np.array([value]) for value in (1.5, 9.0))
    assert clearances(field, ROUND, (free, free, free))[0] > 0.3
    assert clearances(field, ROUND, (off, free, free))[0] == 0.0


FAST = 0.3
BLOCKED = "no room"


class Stuck:
    """A robot that stands at (2, 3) of the map, beside a path which leads to the upper left, and gets no further.

    Its odometry calls the place (10, 20), and it has come there straight ahead.
    """

    def __init__(self, theta: float = 0.0, came: float = 0.5, corners=((2.0, 3.0), (1.0, 4.0), (1.0, 9.0))) -> None:
        self.recoveries = Recoveries()
        self.follower = PathFollower(np.array(corners), math.inf)
        self.pose, self.odom = Pose2(2.0, 3.0, theta), Pose2(10.0, 20.0, 0.0)
        self.follower.advance(2.0, 3.0, 100.0)
        for back in np.arange(came, 0.0, -0.02):
            assert self.due(100.0, odom=self.odom._replace(x=self.odom.x - back)) is None

    def due(self, now: float, cap: float = FAST, odom: Pose2 | None = None):
        return self.recoveries.due(self.follower, self.pose, odom or self.odom, cap, now)


def test_robot_turns_to_the_point_of_its_path_that_is_0_3_m_ahead():
    stuck = Stuck()
    assert stuck.due(103.9) is None
    move = stuck.due(104.0)
    assert move.heading == pytest.approx(math.radians(135.0))
    near = Stuck(corners=((2.0, 3.0), (2.0, 3.2), (1.0, 3.2)))
    assert near.due(104.0).heading == pytest.approx(math.atan2(0.2, -0.1), abs=1e-6)


def test_robot_that_heads_along_its_path_backs_up_along_its_trail_as_it_lies_in_the_map():
    stuck = Stuck(theta=math.radians(135.0))
    move = stuck.due(104.0)
    assert move.heading is None
    # The trail lies behind it: towards the lower right of the map.
    step = 0.02 * math.sqrt(0.5)
    assert move.trail[:2] == pytest.approx(np.array([(2.0, 3.0), (2.0 + step, 3.0 - step)]), abs=0.015)
    assert move.trail[-1] == pytest.approx((2.0 + 0.5 * math.sqrt(0.5), 3.0 - 0.5 * math.sqrt(0.5)), abs=0.03)


def test_error_of_the_heading_is_the_shorter_way_round():
    stuck = Stuck(theta=math.radians(135.0 + 355.0))
    assert stuck.due(104.0).heading is None, "5 degrees are not worth a turn"


@pytest.mark.parametrize(("cap", "after"), [(0.3, 4.0), (0.1, 4.0), (0.05, 8.0), (0.02, 20.0)])
def test_robot_that_must_drive_more_slowly_than_0_1_m_s_gets_longer_before_it_is_stuck(cap, after):
    stuck = Stuck()
    assert stuck.due(100.0 + after - 0.01, cap) is None
    assert stuck.due(100.0 + after + 0.01, cap) is not None


def test_time_of_a_move_is_no_time_without_progress():
    stuck = Stuck()
    stuck.due(104.0)
    assert stuck.follower.stuck_for(104.5) == 0.5
    waiting = Stuck()
    waiting.due(103.0)
    assert waiting.follower.stuck_for(104.5) == 4.5


def test_move_that_can_not_be_made_is_given_up_and_one_that_can_goes_on():
    stuck = Stuck()
    assert stuck.due(104.0) is not None
    stuck.recoveries.on_decision(None)
    assert stuck.due(104.2) is not None
    stuck.recoveries.on_decision(BLOCKED)
    assert stuck.due(104.4) is None
    # The next one is not given up for the same reason.
    assert stuck.due(108.4).heading is None
    assert stuck.due(108.6) is not None


def test_decision_on_the_path_that_finds_no_room_refuses_no_later_move():
    stuck = Stuck()
    stuck.recoveries.on_decision(BLOCKED)
    assert stuck.due(104.0) is not None
    assert stuck.due(104.2) is not None


def test_robot_that_was_stopped_has_no_trail_and_no_move_and_begins_the_series_anew():
    stuck = Stuck()
    assert stuck.due(104.0) is not None
    stuck.recoveries.on_decision(BLOCKED)
    stuck.recoveries.reset()
    assert stuck.due(104.2) is None
    assert stuck.due(108.2).heading is not None, "the first move of the series again"
    assert stuck.due(108.4) is not None
    straight = Stuck(theta=math.radians(135.0))
    straight.recoveries.reset()
    assert straight.due(104.0) is None, "it has no trail to back up along"


def test_series_at_one_place_counts_by_odometry_and_begins_anew_0_6_m_on():
    stuck = Stuck(came=0.0)
    assert stuck.due(104.0) is not None
    stuck.recoveries.on_decision(BLOCKED)
    stuck.due(104.2)
    elsewhere = stuck.odom._replace(y=20.7)
    stuck.due(104.4, odom=elsewhere)
    assert stuck.due(112.0, odom=elsewhere).heading is not None
