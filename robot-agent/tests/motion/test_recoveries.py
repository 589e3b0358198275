"""What the recovery of a robot sees: its path's direction, its trail, how slowly it may go. Limits are literal here."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_agent.localization.pose import Pose2
from robot_agent.motion.path_follower import PathFollower
from robot_agent.motion.recovery import Recoveries

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
