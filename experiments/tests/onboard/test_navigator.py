"""When a robot that plans for itself searches, and what it makes of a refusal."""

from __future__ import annotations

import numpy as np

from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import Pose, RobotGoal
from fog_contracts.replica import MasterMap, Replica
from fognav_experiments.onboard.navigator import OnboardNavigator
from robot_agent.localization.pose import Pose2
from robot_agent.motion.path_follower import PathFollower

GEOMETRY = GridGeometry(160, 60, 0.05, 0.0, 0.0)
START = Pose2(1.0, 1.5, 0.0)
GOAL = RobotGoal(goal_id="g", pose=Pose(x=7.0, y=1.5, theta=0.0), planner_epoch=3, any_heading=True)


def navigator():
    """Return a navigator on an empty floor of 8 x 3 m."""
    static, floor = np.zeros(GEOMETRY.shape, np.uint8), Replica()
    floor.load(MasterMap("hall", GEOMETRY, static, static, epoch=3).snapshot())
    return OnboardNavigator(floor, 0.17)


def followed(path):
    return PathFollower(np.array(path.points), path.released_length)


def mark(onboard, seen_from, *points):
    onboard._costmap.observe(seen_from, np.array(points), np.ones(len(points), np.bool_))


def test_after_a_refusal_that_is_doubted_a_robot_with_a_free_path_searches_again_at_once():
    onboard = navigator()
    follower = followed(onboard.path(onboard.search(GOAL, START, None, 0.0).run(), None, Moment(0.0, 0.0)))
    assert onboard.search(GOAL, START, follower, 0.2) is None
    mark(onboard, START, (7.0, 1.5))
    found = onboard.search(GOAL, START, follower, 0.4).run()
    assert found.refusal.code == 206
    assert onboard.path(found, follower, Moment(0.4, 0.4)) is None
    # What the path may lead round has been forgotten: a shorter one may be free now.
    again = onboard.search(GOAL, START, follower, 0.6)
    assert again is not None
    assert again.run().refusal is None
    assert onboard.search(GOAL, START, follower, 0.8) is None


def test_a_refusal_by_what_was_seen_from_near_is_one():
    onboard = navigator()
    follower = followed(onboard.path(onboard.search(GOAL, START, None, 0.0).run(), None, Moment(0.0, 0.0)))
    near = Pose2(5.0, 1.5, 0.0)
    mark(onboard, near, (7.0, 1.5))
    refusal = onboard.path(onboard.search(GOAL, near, follower, 0.4).run(), follower, Moment(0.4, 0.4))
    assert refusal.refusal.code == 206
    assert onboard.search(GOAL, near, None, 0.6) is None
    assert onboard.search(GOAL, near, None, 1.5) is not None
