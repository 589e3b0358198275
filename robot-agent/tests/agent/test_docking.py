"""The wish for the dock: who may have it, what ends it, and when the base may look for the dock."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from little_world import AGENT

from fog_contracts.costs import LETHAL
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import Pose, RobotGoal
from robot_agent.agent.maneuvers import Straight
from robot_agent.agent.mission import Mission
from robot_agent.agent.power import Docking
from robot_agent.hardware import BaseStatus
from robot_agent.localization.pose import Pose2
from robot_agent.safety.gate import SafetyState

DOCK, STAGING = Pose(x=2.0, y=1.0, theta=0.0), Pose(x=1.3, y=1.0, theta=0.0)
CONFIG = replace(AGENT, dock=DOCK, staging=STAGING, finds_dock=True, dock_below=0.3)
FRONT = Pose2(1.3, 1.0, 0.0)
ENABLED = SafetyState(mode="NORMAL", enabled=True)
WALL = [(2.0 + 0.28, y) for y in np.arange(0.4, 1.6, 0.02)]


class Localizer:
    """A localizer that knows its pose, and what the lidar sees."""

    def __init__(self, pose=FRONT, points=WALL) -> None:
        self._pose, self._points = pose, points

    def pose(self, _now):
        return self._pose

    def points_in_map(self):
        return None if self._points is None else np.array(self._points, dtype=np.float64).reshape(-1, 2)


def replica(*lethal):
    cost = np.zeros((40, 80), np.uint8)
    for x, y in lethal:
        cost[round(y / 0.05), round(x / 0.05)] = LETHAL
    return SimpleNamespace(geometry=GridGeometry(80, 40, 0.05, 0.0, 0.0), cost=cost)


def docking(config=CONFIG, **given) -> Docking:
    return Docking(config, Localizer(**given))


def mission(pose=STAGING, goal_id="g") -> Mission:
    made = Mission()
    made.on_goal(RobotGoal(goal_id=goal_id, pose=pose, stamp=0.0), 1.0)
    return made


# --- who may have it ---


@pytest.mark.parametrize(
    ("config", "state", "docked", "words"),
    [
        (replace(CONFIG, dock=None, staging=None), ENABLED, False, "gives this robot no dock"),
        (replace(CONFIG, finds_dock=False), ENABLED, False, "does not drive into a dock by itself"),
        (CONFIG, ENABLED, True, "is on its dock"),
        (CONFIG, SafetyState(), False, "enable it first"),
        (CONFIG, SafetyState(mode="FAULT", enabled=True), False, "enable it first"),
    ],
)
def test_robot_that_can_not_go_to_its_dock_refuses(config, state, docked, words):
    wish = docking(config)
    assert words in wish.order(state, Mission(), docked=docked, now=5.0)
    assert not wish.ordered
    assert not wish.wants_goal(Mission())


def test_robot_wants_its_goal_until_it_has_reached_it_and_asks_the_gate_at_rest():
    wish = docking()
    assert wish.order(ENABLED, Mission(), docked=False, now=5.0) is None
    assert wish.wants_goal(Mission())
    under_way = mission()
    assert wish.wants_goal(under_way)
    assert not wish.is_due(ENABLED, under_way, 60.0, at_rest=True)
    under_way.reach()
    assert not wish.wants_goal(under_way)
    assert not wish.is_due(ENABLED, under_way, 61.0, at_rest=False)
    assert wish.is_due(ENABLED, under_way, 61.0, at_rest=True)
    wish.on_begun("a chair", 61.0)
    assert (wish.ordered, wish.given_up) == (False, "a chair")
    wish.order(ENABLED, under_way, docked=False, now=70.0)
    assert wish.given_up == ""
    wish.on_begun(None, 71.0)
    assert (wish.ordered, wish.given_up) == (False, "")


def end(found: Mission) -> None:
    """End its goal as the planner does: when it hears that the robot has reached it, or when somebody cancels it."""
    found.on_goal(RobotGoal(goal_id="g", pose=None), 60.0)


def test_robot_that_has_arrived_goes_on_to_its_dock_when_the_planner_ends_the_goal_before_it_is_at_rest():
    wish, arrived = docking(), mission()
    wish.order(ENABLED, Mission(), docked=False, now=5.0)
    assert not wish.is_due(ENABLED, arrived, 40.0, at_rest=False)
    arrived.reach()
    assert not wish.is_due(ENABLED, arrived, 41.0, at_rest=False)
    end(arrived)
    assert not wish.wants_goal(arrived)
    assert not wish.is_due(ENABLED, arrived, 41.05, at_rest=False)
    assert wish.is_due(ENABLED, arrived, 41.1, at_rest=True)


# --- what ends it ---


@pytest.mark.parametrize("state", [SafetyState(), SafetyState(mode="FAULT", enabled=True)])
def test_disabled_or_faulty_robot_wishes_no_more(state):
    wish = docking()
    wish.order(ENABLED, Mission(), docked=False, now=5.0)
    assert not wish.is_due(state, mission(), 6.0, at_rest=True)
    assert (wish.ordered, wish.given_up) == (False, "")


def test_cancelled_or_other_goal_or_none_ends_it_with_the_reason():
    cancelled = mission()
    cancelled.cancel()
    for found, now, words in (
        (cancelled, 6.0, "its goal was cancelled"),
        (mission(Pose(x=9.0, y=9.0, theta=0.0), "other"), 6.0, "another goal"),
        (Mission(), 15.1, "gives it no goal"),
    ):
        wish = docking()
        wish.order(ENABLED, Mission(), docked=False, now=5.0)
        assert not wish.is_due(ENABLED, found, now, at_rest=True)
        assert not wish.ordered
        assert words in wish.given_up


def test_goal_that_was_given_and_is_cancelled_at_the_planner_is_not_asked_for_again():
    wish, cancelled = docking(), mission()
    wish.order(ENABLED, Mission(), docked=False, now=5.0)
    assert not wish.is_due(ENABLED, cancelled, 6.0, at_rest=True)
    end(cancelled)
    assert not wish.is_due(ENABLED, cancelled, 6.1, at_rest=True)
    assert not wish.wants_goal(cancelled)
    assert wish.given_up == "its goal was cancelled"


def test_goal_that_it_had_before_ends_it_only_when_the_planner_does_not_replace_it():
    before = mission(Pose(x=9.0, y=9.0, theta=0.0), "before")
    wish = docking()
    wish.order(ENABLED, before, docked=False, now=5.0)
    assert not wish.is_due(ENABLED, before, 14.9, at_rest=True)
    assert wish.ordered
    wish.is_due(ENABLED, before, 15.1, at_rest=True)
    assert not wish.ordered


# --- a low battery ---


def test_low_battery_orders_again_after_people_have_ended_it_once_the_robot_was_disabled_or_docked():
    wish = docking()
    low = BaseStatus(battery=0.29)
    for status in (BaseStatus(), BaseStatus(battery=0.3), BaseStatus(battery=0.2, charging=True)):
        wish.order_if_low(status, ENABLED, Mission(), 5.0)
        assert not wish.ordered
    wish.order_if_low(low, ENABLED, mission(), 5.0)
    assert not wish.ordered, "its mission comes first"
    wish.order_if_low(low, SafetyState(), Mission(), 5.0)
    assert not wish.ordered
    for again in (SafetyState(), ENABLED):
        wish.order_if_low(low, ENABLED, Mission(), 6.0)
        assert wish.ordered
        wish.give_up("x")
        wish.order_if_low(low, ENABLED, Mission(), 7.0)
        assert not wish.ordered
        wish.order_if_low(BaseStatus(battery=0.2, charging=True, docked=again.enabled), again, Mission(), 8.0)


# --- may the base look for it? ---


def test_robot_in_front_of_its_dock_that_sees_only_the_wall_behind_it_may():
    assert docking().problem(replica(), 5.0, running=False) is None


@pytest.mark.parametrize(
    ("given", "cells", "words"),
    [
        ({"pose": None}, (), "does not know"),
        ({"points": None}, (), "does not know"),
        ({"pose": Pose2(1.09, 1.0, 0.0)}, (), "not in front"),
        ({"pose": Pose2(1.3, 1.0, 0.4)}, (), "not in front"),
        ({"points": [(1.8, 1.2)]}, (), "something between"),
        ({"points": [(1.8, 0.8)]}, (), "something between"),
        ({}, [(1.7, 1.0)], "is blocked"),
    ],
)
def test_anything_in_between_or_another_place_forbids_it(given, cells, words):
    assert words in docking(**given).problem(replica(*cells), 5.0, running=False)


def test_points_beside_the_way_and_of_the_dock_itself_do_not_matter():
    wish = docking(points=[(1.8, 1.23), (1.8, 0.77), (2.13, 1.0), (1.0, 1.0)])
    assert wish.problem(replica(), 5.0, running=False) is None
    seen = np.array([(0.82, 0.0), (0.83, 0.29), (0.81, 0.0), (0.83, 0.31)])
    assert wish.without_dock(seen, FRONT) == pytest.approx(seen[2:])
    assert len(wish.without_dock(np.zeros((0, 2)), FRONT)) == 0
    none = docking(replace(CONFIG, dock=None, staging=None))
    assert none.without_dock(seen, FRONT) is seen
    assert "does not know" in none.problem(replica(), 5.0, running=False)


def test_robot_that_seeks_may_be_anywhere_near_its_dock_but_not_off_the_map_or_farther_away():
    assert docking(pose=Pose2(1.6, 1.1, 1.0)).problem(replica(), 5.0, running=True) is None
    assert "moved away" in docking(pose=Pose2(0.79, 1.0, 0.0)).problem(replica(), 5.0, running=True)
    unknown = SimpleNamespace(geometry=None)
    assert "is blocked" in docking().problem(unknown, 5.0, running=True)


def test_limits_of_the_place_in_front_of_the_dock_and_of_the_way_to_it():
    for given, words in (
        ({"pose": Pose2(1.101, 1.0, 0.0)}, None),
        ({"pose": Pose2(1.3, 1.0, 0.345)}, None),
        ({"pose": Pose2(1.3, 1.0, 0.36)}, "not in front"),
        ({"points": [(1.8, 1.218)]}, "something between"),
        ({"points": [(1.8, 1.222)]}, None),
        ({"points": [(2.117, 1.0)]}, "something between"),
        ({"points": [(2.123, 1.0)]}, None),
        ({"points": [(1.29, 1.0)]}, None),
    ):
        found = docking(**given).problem(replica(), 5.0, running=False)
        assert found is None if words is None else words in str(found)
    for away, problem in ((1.19, False), (1.21, True)):
        assert bool(docking(pose=Pose2(2.0 - away, 1.0, 0.0)).problem(replica(), 5.0, running=True)) == problem


def test_goal_is_the_one_in_front_of_the_dock_within_a_centimetre():
    for off, ours in ((0.0095, True), (0.0105, False)):
        wish = docking()
        wish.order(ENABLED, Mission(), docked=False, now=5.0)
        wish.is_due(ENABLED, mission(Pose(x=1.3 + off, y=1.0, theta=0.0)), 6.0, at_rest=True)
        assert wish.ordered == ours


def test_order_resumes_the_mission_to_the_front_of_the_dock_and_no_other():
    for pose, resumed in ((STAGING, True), (Pose(x=9.0, y=9.0, theta=0.0), False)):
        held = mission(pose)
        held.cancel()
        assert docking().order(ENABLED, held, docked=False, now=5.0) is None
        assert held.active == resumed


def test_robot_waits_for_its_goal_for_ten_seconds():
    wish = docking()
    assert wish.given_up == ""
    wish.order(ENABLED, Mission(), docked=False, now=5.0)
    wish.is_due(ENABLED, Mission(), 15.0, at_rest=True)
    assert wish.ordered


# --- the pose that the contacts tell ---


def test_contacts_tell_the_pose_once_for_each_time_that_they_close():
    wish = docking()
    assert wish.observation(None, 5.0) is None
    assert wish.observation(0.99, 6.0) is None
    seen = wish.observation(1.0, 7.0)
    assert (seen.pose, seen.stamp) == (Pose2(2.0, 1.0, 0.0), 7.0)
    assert np.sqrt(np.diag(seen.covariance)) == pytest.approx((0.03, 0.03, 0.05))
    assert wish.observation(2.0, 8.0) is None
    wish.observation(None, 9.0)
    assert wish.observation(1.0, 10.0) is not None


def test_robot_that_was_carried_to_another_dock_is_not_told_to_be_on_its_own():
    assert docking(pose=Pose2(3.01, 1.0, 0.0)).observation(5.0, 5.0) is None
    assert docking(pose=None).observation(5.0, 5.0) is not None
    assert docking(replace(CONFIG, dock=None)).observation(5.0, 5.0) is None


def test_way_straight_back_is_measured_along_the_robots_own_axis():
    back = Straight(-0.3, 0.1)
    assert back.remaining(Pose2(0.0, 0.0, 0.0)) == float("inf")
    back.begin(Pose2(1.0, 1.0, np.pi / 2))
    assert back.remaining(Pose2(1.2, 0.9, np.pi / 2)) == pytest.approx(0.2)
    assert back.remaining(None) == float("inf")
    assert back.wheels == (-0.1, -0.1)
