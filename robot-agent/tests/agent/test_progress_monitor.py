"""No progress along the path for 10 s is a problem until a new plan or goal; the place ahead is reported."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from fog_contracts.messages import Pose, Reason, ReasonCode, Refusal, RobotGoal, RobotPath
from robot_agent.agent.mission import Mission
from robot_agent.agent.path_monitor import ProgressMonitor
from robot_agent.safety.gate import SafetyOutputs

GOAL = RobotGoal(goal_id="g1", pose=Pose(x=5.0, y=1.0, theta=0.0))
PATH = RobotPath(
    plan_id=1, planner_epoch=3, goal_id="g1", points=[(1.0, 1.0), (5.0, 1.0)], map_epoch=7, map_seq=0,
    released_length=99.0,
)  # fmt: skip
FREE = None
NEAR = Reason(ReasonCode.OBSTACLE_NEAR, "an obstacle is so near that no arc is free")
BLIND = Reason(ReasonCode.LIDAR_BLIND, "the lidar sees nothing ahead")
SENTENCE = "no progress along the path for 10 s"


def outputs(mode="NORMAL", stop="none"):
    return SafetyOutputs(mode=mode, reasons=(), cap=0.3, stop=stop, changed=False, refusal=None)


class Rig:
    """A mission with a path of 4 m along x, and a robot at its start at 100 s."""

    def __init__(self, path=PATH, radius=0.17):
        self.mission, self.now, self.x = Mission(), 100.0, 1.0
        self.monitor = ProgressMonitor(10.0, radius)
        self.mission.on_goal(GOAL, self.now)
        self.follow(path)

    def follow(self, path):
        self.mission.on_path(path, self.now)
        self.advance()

    def advance(self):
        if self.mission.follower is not None:
            self.mission.follower.advance(self.x, 1.0, self.now)

    def run(self, seconds, hindrance=FREE, *, by=0.0, safety=None):
        """Return the problem after a time in which the robot is moved by some metres, decided on 20 times a second."""
        steps = round(seconds / 0.05)
        problem = None
        for _ in range(steps):
            self.now += 0.05
            self.x += by / steps
            self.advance()
            problem = self.monitor.problem(self.mission, hindrance, safety or outputs(), self.now)
        return problem

    @property
    def bar(self):
        return self.monitor.impassable(self.now).round(3).tolist()


@pytest.fixture
def rig():
    return Rig()


@pytest.fixture
def stuck(rig):
    assert rig.run(10.1, NEAR) is not None
    return rig


def test_ten_seconds_without_progress_are_a_problem_and_not_a_moment_less(rig):
    assert rig.run(9.95) is None
    assert rig.bar == []
    assert rig.run(0.1) == SENTENCE


def test_problem_tells_what_hindered_the_wheels_last_and_nothing_from_before(rig):
    assert rig.run(1.0, BLIND) is None
    assert rig.run(1.0, NEAR) is None
    assert rig.run(8.1) == f"{SENTENCE}: an obstacle is so near that no arc is free"
    other = Rig()
    assert other.run(2.0, NEAR) is None
    assert other.run(8.0, by=1.0) is None
    assert other.run(10.1) == SENTENCE


def test_robot_that_moves_a_little_all_the_time_gets_on(rig):
    assert rig.run(60.0, by=0.8) is None


def test_robot_that_moves_to_and_fro_gets_no_further(rig):
    for _ in range(4):
        rig.run(1.25, by=0.08)
        problem = rig.run(1.25, by=-0.08)
    assert problem is None
    assert rig.run(0.2) == SENTENCE


def test_problem_stays_although_the_robot_is_pushed_on_or_the_same_path_is_repeated(stuck):
    assert stuck.run(5.0, by=1.0) is not None
    stuck.follow(msgspec.structs.replace(PATH, map_seq=4))
    assert stuck.run(1.0) is not None
    # The gate stops the robot for it, which makes it no younger.
    assert stuck.run(30.0, safety=outputs("HOLD", "ramp")) is not None


@pytest.mark.parametrize("change", [{"plan_id": 2}, {"planner_epoch": 4}])
def test_new_plan_ends_it_and_has_ten_seconds_of_its_own(stuck, change):
    stuck.follow(msgspec.structs.replace(PATH, **change))
    assert stuck.run(9.9) is None
    assert stuck.run(0.2) is not None


def test_refusal_new_goal_or_cancelled_goal_ends_it(stuck):
    refusal = Refusal(code=208, reason="no way", causes=[])
    stuck.follow(msgspec.structs.replace(PATH, plan_id=2, points=[], refusal=refusal))
    assert stuck.run(20.0) is None
    for end in (lambda m: m.on_goal(msgspec.structs.replace(GOAL, goal_id="g2"), 0.0), Mission.cancel, Mission.reach):
        rig = Rig()
        assert rig.run(10.1) is not None
        end(rig.mission)
        assert rig.run(20.0) is None


def test_operator_who_disables_the_robot_ends_it(stuck):
    assert stuck.run(1.0, safety=outputs("INIT", "immediate")) is None
    assert stuck.run(9.9) is None
    assert stuck.run(0.2) is not None


@pytest.mark.parametrize(
    ("mode", "stop"),
    [("INIT", "immediate"), ("HOLD", "ramp"), ("PROTECTIVE_STOP", "immediate"), ("FAULT", "immediate")],
)
def test_robot_that_must_not_drive_is_not_stuck(rig, mode, stop):
    assert rig.run(60.0, safety=outputs(mode, stop)) is None
    assert rig.run(9.9) is None
    assert rig.run(0.2) == SENTENCE


def test_robot_that_drives_slowly_because_of_the_gate_is_watched_as_well(rig):
    assert rig.run(10.1, safety=outputs("DEGRADED")) == SENTENCE


def test_robot_without_a_goal_or_path_is_not_stuck():
    mission, monitor = Mission(), ProgressMonitor(10.0, 0.17)
    assert [monitor.problem(mission, FREE, outputs(), now) for now in (0.0, 50.0)] == [None, None]
    mission.on_goal(GOAL, 50.0)
    assert [monitor.problem(mission, FREE, outputs(), now) for now in (50.0, 99.0)] == [None, None]


def test_robot_at_the_end_of_what_is_released_waits_and_one_before_it_is_stuck():
    rig = Rig(msgspec.structs.replace(PATH, released_length=1.0))
    assert rig.run(4.0, by=0.75) is None
    assert rig.run(60.0) is None
    before = Rig(msgspec.structs.replace(PATH, released_length=1.0))
    before.run(4.0, by=0.6)
    assert before.run(10.1) == SENTENCE


def test_robot_that_never_gets_right_to_its_goal_holds():
    rig = Rig()
    rig.run(20.0, by=3.85)
    assert rig.run(10.1) == SENTENCE
    assert rig.bar == []


# --- the place ---


def test_place_is_a_bar_across_the_path_45_cm_ahead(stuck):
    assert stuck.bar == [[1.45, y] for y in (0.8, 0.9, 1.0, 1.1, 1.2)]


def test_place_lies_on_the_path_behind_a_corner():
    rig = Rig(msgspec.structs.replace(PATH, points=[(1.0, 1.0), (1.2, 1.0), (1.2, 5.0)]))
    rig.run(10.1)
    assert rig.bar == [[x, 1.25] for x in (1.4, 1.3, 1.2, 1.1, 1.0)]


def test_larger_robot_reports_a_place_outside_its_own_body():
    rig = Rig(radius=0.4)
    rig.run(10.1)
    assert {x for x, _ in rig.bar} == {1.68}


def test_place_is_reported_for_two_minutes_whatever_the_planner_does(stuck):
    place = stuck.bar
    stuck.follow(msgspec.structs.replace(PATH, plan_id=2))
    stuck.run(119.0, by=3.8)
    assert stuck.bar == place
    stuck.run(1.2)
    assert stuck.bar == []


def test_lidar_that_does_not_see_makes_the_robot_hold_and_blames_no_place(rig):
    assert rig.run(10.1, BLIND) == f"{SENTENCE}: the lidar sees nothing ahead"
    assert rig.bar == []


def test_path_of_one_point_has_no_place_ahead():
    rig = Rig(msgspec.structs.replace(PATH, points=[(1.0, 1.0)]))
    assert rig.run(10.1) == SENTENCE
    assert np.shape(rig.monitor.impassable(rig.now)) == (0, 2)
