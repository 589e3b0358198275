"""Recoveries at their limits, to the millimetre: where each begins and ends, and what an arc keeps from a wall."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from open_floor import LONG, PADDING, ROUND, around

from fog_contracts.costs import UNKNOWN
from fog_kernels.robot import cover
from robot_agent.footprint import Footprint
from robot_agent.localization.pose import Pose2
from robot_agent.motion.recovery import (
    Attempt,
    Recovery,
    RecoveryMove,
    Situation,
    Trail,
    clearances,
    recovery_speeds,
    step,
)

HERE = Pose2(1.5, 1.5, 0.0)
ORIGIN = Pose2(0.0, 0.0, 0.0)
STUCK = Situation(place=(0.0, 0.0), stuck_for=4.0, error=0.5, trail=0.5)
WIDE = cover(Footprint(((-0.1, -0.1), (0.12, -0.1), (0.12, 0.3), (-0.1, 0.3))).polygon)
"""Reaches farther to the left of its axle than to the right."""
ROUNDING = 0.007
"""What distances lose between the field's cells, and between the poses of an arc that are looked at (m)."""


# --- the machine ---


def test_limits_themselves():
    done = Recovery(begun=4, origin=(0.0, 0.0))
    assert step(done, STUCK._replace(place=(0.6, 0.0)), 9.0).begun == 4, "60 cm away is the same place"
    assert step(Recovery(), STUCK._replace(error=0.25), 9.0).running == Attempt("turn")
    assert step(Recovery(), STUCK._replace(error=0.0, trail=0.06), 9.0).running == Attempt("back", 0.15)
    turning = step(Recovery(), STUCK, 9.0)
    assert step(turning, STUCK._replace(error=0.1), 9.2).running is None


# --- the moves ---


def backing(*behind, pose=ORIGIN, body=ROUND, things=()):
    """Return the speeds of backing up along points in `base` of a robot at a pose."""
    move = RecoveryMove(trail=pose.transform(np.array(behind)))
    return recovery_speeds(move, pose, around(list(things), body, *pose[:2]), body, PADDING, 0.3)


def at_origin(*trail):
    """Return the speeds of backing up along points, exactly as given, of a robot at the origin."""
    far = around([])._replace(origin_x=-1.5, origin_y=-1.5)
    return recovery_speeds(RecoveryMove(trail=np.array(trail)), ORIGIN, far, ROUND, PADDING, 0.3)


@pytest.mark.parametrize(("behind", "v"), [(0.0049, 0.0), (0.005, -0.08), (0.0052, -0.08)])
def test_point_of_the_trail_nearer_than_5_mm_is_where_the_robot_stands(behind, v):
    assert at_origin((-behind, 0.0)) == pytest.approx((v, 0.0))


def test_robot_aims_at_a_point_exactly_15_cm_behind_it():
    assert at_origin((-0.15, 0.0), (-0.3, 0.05)) == pytest.approx((-0.08, 0.0))


@pytest.mark.parametrize(("error", "rate"), [(4.9e-4, 0.0), (5.2e-4, 1.04e-3), (-5.2e-4, -1.04e-3)])
def test_turn_of_half_a_milliradian_is_none(error, rate):
    found = recovery_speeds(RecoveryMove(heading=error), HERE, around([]), ROUND, PADDING, 0.3)
    assert found == pytest.approx((0.0, rate), abs=1e-9)


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


@pytest.mark.parametrize(("gap", "moves"), [(0.0965, False), (0.1045, True)])
@pytest.mark.parametrize("theta", [0.0, math.pi / 2, math.pi, -math.pi / 2])
def test_10_cm_behind_the_robot_must_be_free_whatever_its_heading(theta, gap, moves):
    pose, away = Pose2(1.5, 1.5, theta), 0.17 + PADDING + gap
    wall = pose.transform(np.array([(-away, y) for y in np.arange(-0.3, 0.3, 0.005)]))
    assert (backing((-0.2, 0.0), pose=pose, things=wall) is not None) == moves


@pytest.mark.parametrize(("turned", "moves"), [(0.33, False), (0.35, True)])
def test_long_body_needs_room_for_a_third_of_a_radian(turned, moves):
    # The tail's corner would keep its padding until the body has turned so far.
    poses = arc(HERE, 0.0, 0.6, turned / 0.6)
    beside = np.column_stack((np.full(600, 1.27), 1.5 - np.arange(0.12, 0.42, 0.0005)))
    thing = first_at(LONG, poses, beside, PADDING)
    found = recovery_speeds(RecoveryMove(heading=1.5), HERE, around(thing, LONG), LONG, PADDING, 0.3)
    assert (found is not None) == moves


def test_robot_that_is_too_near_to_a_thing_may_go_away_from_it_but_not_nearer():
    thing = (1.5 + 0.17 + 0.5 * PADDING, 1.5)
    assert backing((-0.2, 0.0), pose=HERE, things=[thing]) == pytest.approx((-0.08, 0.0))
    assert backing((-0.2, 0.0), pose=Pose2(1.5, 1.5, math.pi), things=[thing]) is None


# --- what is known ---


def with_unknown(column, row):
    field = around([])
    cost = field.cost.copy()
    cost[row, column] = UNKNOWN
    return field._replace(cost=cost)


def cell(field, x, y):
    return int((x - field.origin_x) / field.resolution), int((y - field.origin_y) / field.resolution)


def test_single_unknown_cell_under_the_middle_of_the_body_is_not_free():
    field = with_unknown(*cell(around([]), 1.525, 1.525))
    middle = np.array([1.525])
    assert clearances(field, ROUND, (middle, middle, np.array([0.0])))[0] == 0.0


@pytest.mark.parametrize("border", ["left", "right", "bottom", "top"])
def test_body_may_reach_to_the_border_of_the_map_and_not_beyond(border):
    field = around([])
    low, high = field.origin_x, field.origin_x + len(field.cost) * field.resolution
    for outwards, known in ((-0.01, True), (0.01, False)):
        x = y = 1.5
        match border:
            case "left":
                x = low + 0.17 - outwards
            case "right":
                x = high - 0.17 + outwards
            case "bottom":
                y = low + 0.17 - outwards
            case "top":
                y = high - 0.17 + outwards
        found = clearances(field, ROUND, (np.array([x]), np.array([y]), np.array([0.0])))[0]
        assert (found > 0.0) == known


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("across", [False, True])
def test_first_and_last_cells_of_the_map_are_looked_at_like_others(last, across):
    field = around([])
    end = len(field.cost) - 1 if last else 0
    column, row = cell(field, 1.525, 1.525)
    column, row = (column, end) if across else (end, row)
    low, high = field.origin_x, field.origin_x + len(field.cost) * field.resolution
    near = high - 0.18 if last else low + 0.18
    x, y = (1.525, near) if across else (near, 1.525)
    pose = np.array([x]), np.array([y]), np.array([0.0])
    assert clearances(field, ROUND, pose)[0] > 0.0
    assert clearances(with_unknown(column, row), ROUND, pose)[0] == 0.0


# --- the trail ---


def trail_along(*places):
    trail = Trail()
    for x, y in places:
        trail.add(Pose2(x, y, 0.0))
    return trail


def test_trail_grows_by_a_point_as_soon_as_the_robot_is_2_cm_on():
    assert trail_along((0.0, 0.0), (0.019, 0.0)).length == 0.0
    assert trail_along((0.0, 0.0), (0.02, 0.0)).length == pytest.approx(0.02)
    points = trail_along((0.0, 0.0), (0.05, 0.0)).behind(ORIGIN)
    assert points[:, 0] == pytest.approx([0.04, 0.02, 0.0])


def test_robot_takes_up_its_whole_trail_on_the_way_back_to_its_first_point():
    trail = trail_along((0.0, 0.0), (0.02, 0.0), (0.0, 0.0))
    assert trail.length == 0.0
    assert len(trail.behind(ORIGIN)) == 1


def test_point_that_is_as_near_as_the_one_before_stays():
    assert trail_along((0.0, 0.0), (0.02, 0.0), (0.01, 0.0)).length == pytest.approx(0.02)


def test_way_back_beside_the_trail_adds_nothing_to_it():
    trail = trail_along((0.0, 0.0), (0.2, 0.0))
    trail.add(Pose2(0.1, 0.03, 0.0))
    assert trail.length == pytest.approx(0.1)
    assert trail.behind(ORIGIN)[0] == pytest.approx((0.1, 0.0))
