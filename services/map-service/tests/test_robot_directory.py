"""Which robots Prometheus is sent to."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.messages import RobotState
from map_service.core import ALIVE_S, RobotDirectory


def state(metrics):
    return RobotState(
        mode="HOLD", reasons=[], enabled=False, battery=None, goal_id=None, map_epoch=0, map_seq=0, plan_id=None,
        metrics=metrics,
    )  # fmt: skip


@pytest.fixture
def directory():
    return RobotDirectory()


def addresses(directory, now):
    return {target.labels["robot"]: target.targets for target in directory.targets(now)}


def test_living_robot_is_a_target_with_its_id(directory):
    directory.heard("r1", state("192.0.2.7:9100"), 10.0)
    assert addresses(directory, 10.0) == {"r1": ["192.0.2.7:9100"]}


def test_silent_robot_is_no_target_any_more(directory):
    directory.heard("r1", state("192.0.2.7:9100"), 10.0)
    assert addresses(directory, 10.0 + ALIVE_S)
    assert addresses(directory, 10.1 + ALIVE_S) == {}


def test_robot_with_a_new_address_is_found_there(directory):
    directory.heard("r1", state("192.0.2.7:9100"), 10.0)
    directory.heard("r1", state("192.0.2.8:9100"), 11.0)
    assert addresses(directory, 11.0) == {"r1": ["192.0.2.8:9100"]}


def test_robot_that_nobody_can_scrape_is_no_target(directory):
    directory.heard("r1", state(""), 10.0)
    assert addresses(directory, 10.0) == {}


@given(st.lists(st.tuples(st.sampled_from(["r1", "r2", "r3"]), st.floats(0.0, 30.0)), max_size=40))
def test_targets_are_the_robots_heard_within_the_time(steps):
    directory, last, now = RobotDirectory(), {}, 0.0
    for robot, pause in steps:
        now += pause
        directory.heard(robot, state(f"{robot}:1"), now)
        last[robot] = now
    expected = {robot: [f"{robot}:1"] for robot, at in last.items() if now - at <= ALIVE_S}
    assert addresses(directory, now) == expected
