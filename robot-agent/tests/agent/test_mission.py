from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.bus import roundtrip
from fog_contracts.geometry import PATH_SPACING_M, sampled
from fog_contracts.messages import Pose, Refusal, RobotGoal, RobotPath, RobotRelease
from robot_agent.agent.mission import Mission

GOAL = RobotGoal(goal_id="g1", pose=Pose(x=5.0, y=0.0, theta=0.0))
PATH = RobotPath(
    plan_id=5, planner_epoch=3, goal_id="g1", points=[(0.0, 0.0), (5.0, 0.0)], map_epoch=7, map_seq=0,
    released_length=2.0,
)  # fmt: skip


def changed(message, **changes):
    return msgspec.structs.replace(message, **changes)


@pytest.fixture
def mission():
    mission = Mission()
    assert mission.on_goal(GOAL, 1.0)
    assert mission.on_path(PATH, 2.0)
    return mission


def test_a_new_robot_has_no_mission():
    mission = Mission()
    assert (mission.active, mission.goal_id, mission.reached, mission.path_id) == (False, None, False, None)
    assert mission.planner_age(10.0) == float("inf")
    assert mission.cancel() is None
    assert not mission.on_path(PATH, 1.0)
    assert mission.path is None


def test_planner_age_counts_from_its_last_new_goal_or_path(mission):
    assert mission.planner_age(3.0) == 1.0
    mission.on_path(PATH, 3.5)
    assert mission.planner_age(4.0) == 0.5
    mission.on_goal(GOAL, 9.0)  # the same goal again says nothing about the path
    assert mission.planner_age(10.0) == 6.5


def release(path=PATH, **changes):
    fields = {name: getattr(path, name) for name in RobotRelease.__struct_fields__}
    return RobotRelease(**fields | changes)


@pytest.mark.parametrize("repeated", [False, True])
def test_a_release_extends_the_path_as_its_repetition_does_and_keeps_the_progress(mission, repeated):
    mission.follower.advance(1.0, 0.0, 2.0)
    follower = mission.follower
    if repeated:
        assert not mission.on_path(changed(PATH, released_length=4.0, map_seq=9), 3.0)
    else:
        mission.on_release(release(released_length=4.0, map_seq=9), 3.0)
    assert mission.follower is follower
    assert follower.released_remaining == pytest.approx(3.0)
    assert (mission.path.released_length, mission.path.map_seq) == (4.0, 9)
    assert mission.planner_age(4.0) == 1.0


def test_a_release_keeps_a_refusal_alive(mission):
    refusal = changed(PATH, plan_id=6, points=[], refusal=Refusal(code=208, reason="cut off", causes=[]))
    mission.on_path(refusal, 3.0)
    mission.on_release(release(refusal, map_seq=3, released_length=0.0), 9.0)
    assert (mission.follower, mission.path.map_seq, mission.planner_age(9.5)) == (None, 3, 0.5)


def test_planner_age_counts_from_when_path_and_releases_were_sent_by_their_delay(mission):
    mission.on_release(release(sent=(9, 100.0)), 3.0)
    assert mission.planner_age(3.0) == 0.0
    mission.on_release(release(sent=(9, 101.0)), 6.0)
    assert mission.planner_age(6.0) == pytest.approx(2.0, abs=0.01)
    mission.on_path(changed(PATH, plan_id=6, sent=(9, 102.0)), 8.0)
    assert mission.planner_age(8.0) == pytest.approx(3.0, abs=0.01)
    # The clock of another host, of which nothing is known yet.
    mission.on_release(release(plan_id=6, sent=(4, 55.0)), 9.0)
    assert mission.planner_age(9.0) == 0.0


METRES = st.floats(-20, 20)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(METRES, METRES), min_size=1, max_size=5))
def test_the_followed_line_is_the_planners_to_the_last_bit(corners):
    sent = roundtrip(ch.ROBOT_PATH, changed(PATH, points=corners))
    mission = Mission()
    mission.on_goal(GOAL, 1.0)
    mission.on_path(sent, 2.0)
    points = mission.follower.points
    assert points.tolist() == sampled(np.array(corners), PATH_SPACING_M).tolist()
    steps = np.hypot(*np.diff(points, axis=0).T)
    assert steps.max(initial=0.0) <= PATH_SPACING_M + 1e-9
    assert {tuple(corner) for corner in corners} <= {tuple(point) for point in points.tolist()}


@pytest.mark.parametrize(
    ("changes", "followed"),
    [
        ({"plan_id": 4}, False),
        ({"planner_epoch": 2, "plan_id": 99}, False),
        ({"plan_id": 6}, True),
        ({"planner_epoch": 4, "plan_id": 1}, True),
        ({"plan_id": 6, "goal_id": "g0"}, False),
    ],
)
def test_only_a_newer_path_of_the_same_goal_replaces_the_one_followed(mission, changes, followed):
    other = changed(PATH, **changes)
    assert mission.on_path(other, 3.0) == followed
    assert (mission.path is other) == followed


def test_refusal_drops_the_path_and_the_next_path_is_a_new_one(mission):
    refusal = changed(PATH, points=[], refusal=Refusal(code=208, reason="cut off", causes=[]))
    assert not mission.on_path(refusal, 3.0)
    assert mission.follower is None
    assert mission.active
    assert mission.on_path(PATH, 4.0)


def test_the_same_goal_at_another_place_keeps_the_path_until_the_planner_sends_another(mission):
    assert not mission.on_goal(changed(GOAL, pose=Pose(x=6.0, y=0.0, theta=0.0)), 3.0)
    assert mission.path is PATH


@pytest.mark.parametrize("end", [Mission.reach, Mission.cancel])
def test_ended_mission_starts_again_only_with_another_goal(mission, end):
    end(mission)
    assert not mission.active
    assert mission.path is None
    assert mission.goal_id == "g1"
    assert mission.reached == (end is Mission.reach)
    assert not mission.on_goal(GOAL, 3.0)
    assert not mission.active
    assert mission.on_goal(changed(GOAL, goal_id="g2"), 4.0)
    assert mission.active
    assert not mission.reached


def test_withdrawn_goal_ends_the_mission_and_its_path(mission):
    assert mission.on_goal(changed(GOAL, pose=None), 3.0), "the path is followed no more"
    assert (mission.path_id, mission.follower) == (None, None)
    assert (mission.active, mission.goal_id, mission.cancel()) == (False, None, None)
