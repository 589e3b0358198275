from __future__ import annotations

import msgspec
import numpy as np
import pytest

from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import Pose, RobotGoal, RobotPath
from fog_contracts.replica import MasterMap, Replica, Version
from robot_agent.agent.mission import Mission
from robot_agent.agent.path_monitor import MAP_GRACE_S, PLANNER_GRACE_S, PathMonitor

GEOMETRY = GridGeometry(200, 20, 0.1, 0.0, 0.0)
PATH = RobotPath(
    plan_id=1, planner_epoch=3, goal_id="g1", points=[(1.05, 1.05), (15.05, 1.05)], map_epoch=7, map_seq=0,
    released_length=99.0,
)  # fmt: skip


class Rig:
    def __init__(self):
        free = np.zeros(GEOMETRY.shape, np.uint8)
        self.master = MasterMap("lab", GEOMETRY, free, free, epoch=7)
        self.replica = Replica()
        self.replica.load(self.master.snapshot())
        self.mission = Mission()
        self.mission.on_goal(RobotGoal(goal_id="g1", pose=Pose(x=15.05, y=1.05, theta=0.0)), 0.0)
        self.monitor = PathMonitor()
        self.follow(PATH)

    def follow(self, path, now=0.0):
        assert self.mission.on_path(path, now)
        self.mission.follower.advance(1.05, 1.05, now)
        self.monitor.begin()

    def set(self, x, cost, *, publish=True):
        """Give all cells at x (m) a cost."""
        window = Window(round(x / 0.1), 0, 1, 20)
        deltas = self.master.write([("cost", window, np.full((20, 1), cost, np.uint8))], [], [])
        for delta in deltas if publish else ():
            self.replica.apply(delta)

    def problem(self, now):
        self.monitor.check(self.mission, self.replica, now)
        return self.monitor.problem(self.mission, self.replica.version, now)


@pytest.fixture
def rig():
    return Rig()


def test_a_free_path_has_no_problem(rig):
    assert rig.problem(0.0) is None
    assert rig.problem(99.0) is None


def test_path_of_a_map_version_that_the_robot_does_not_get_is_a_problem_after_a_second(rig):
    rig.follow(msgspec.structs.replace(PATH, plan_id=2, map_seq=2))
    assert rig.problem(1.0) is None
    assert rig.problem(1.0 + MAP_GRACE_S) is None
    assert "planned on version 2 of the map; the robot has version 0" in rig.problem(1.1 + MAP_GRACE_S)
    rig.set(12.0, 100)
    assert "version 1" in rig.problem(2.2)
    rig.set(12.0, 101)
    assert rig.problem(2.3) is None
    assert rig.problem(99.0) is None


def test_path_on_the_robots_own_map_is_driven_although_an_earlier_one_was_on_a_newer_map(rig):
    rig.follow(msgspec.structs.replace(PATH, plan_id=2, map_seq=9))
    rig.problem(0.0)
    assert rig.problem(5.0) is not None
    rig.follow(msgspec.structs.replace(PATH, plan_id=3), 5.0)
    assert rig.problem(5.0) is None
    rig.follow(msgspec.structs.replace(PATH, plan_id=4, map_seq=9), 6.0)
    assert rig.problem(6.0) is None


def test_map_that_follows_the_paths_within_a_second_is_no_problem_however_often_they_change(rig):
    for cycle in range(20):
        now = 0.6 * cycle
        rig.follow(msgspec.structs.replace(PATH, plan_id=2 + cycle, map_seq=cycle + 2), now)
        assert rig.problem(now) is None
        rig.set(12.0, 100 + cycle)
        assert rig.problem(now + 0.1) is None
    assert rig.problem(now + 0.2 + MAP_GRACE_S) is not None


def test_blockage_becomes_near_as_the_robot_approaches(rig):
    rig.set(5.0, 254)
    assert rig.problem(1.0) is None
    rig.mission.follower.advance(2.5, 1.05, 1.1)
    assert rig.problem(1.1) is not None


def test_new_path_that_is_blocked_too_gets_no_new_grace_period(rig):
    rig.set(8.0, 254)
    assert rig.problem(1.0) is None
    rig.follow(msgspec.structs.replace(PATH, plan_id=2), 1.8)
    assert rig.problem(1.8) is None
    assert rig.problem(1.1 + PLANNER_GRACE_S) is not None


def test_a_planner_that_knew_the_map_may_lead_the_robot_out_of_a_lethal_cell(rig):
    rig.set(1.2, 254)
    assert rig.problem(1.0) is not None
    rig.follow(msgspec.structs.replace(PATH, plan_id=2, map_seq=1), 1.1)
    assert rig.problem(1.1) is None


def test_path_of_a_newer_map_is_checked_when_the_replica_has_caught_up(rig):
    rig.set(2.0, 254, publish=False)
    rig.follow(msgspec.structs.replace(PATH, plan_id=2, map_seq=2), 1.0)
    assert rig.problem(1.0) is None
    rig.set(9.0, 254, publish=False)
    rig.replica.load(rig.master.snapshot())
    assert rig.problem(1.1) is not None


def test_path_of_another_map_is_a_problem_after_a_grace_period(rig):
    other = Version(8, 0, 0)
    assert rig.monitor.problem(rig.mission, other, 1.0) is None
    assert rig.monitor.problem(rig.mission, other, 1.0 + PLANNER_GRACE_S) is None
    assert "another map" in rig.monitor.problem(rig.mission, other, 1.1 + PLANNER_GRACE_S)
    assert rig.monitor.problem(rig.mission, rig.replica.version, 3.0) is None
    assert rig.monitor.problem(rig.mission, other, 3.1) is None


def test_ended_mission_has_no_problem(rig):
    rig.set(2.0, 254)
    assert rig.problem(1.0) is not None
    rig.mission.cancel()
    rig.monitor.reset()
    assert rig.problem(1.1) is None
