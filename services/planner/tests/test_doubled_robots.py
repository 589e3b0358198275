"""Two agents that use one robot's id are found, and a restarted agent is not taken for two."""

from hypothesis import given
from hypothesis import strategies as st

from planner.doubled_robots import REMEMBERED_S, DoubledRobots


def test_two_agents_of_one_id_are_found_until_one_is_switched_off():
    robots = DoubledRobots()
    finds = [robots.on_state("r1", "ab"[number % 2], 0.5 * number) for number in range(10)]
    assert (finds.count(True), finds.index(True)) == (1, 4), "a, b, a, b, a"
    assert robots.found(5.0) == ["r1"]
    assert not robots.is_doubled("r2", 5.0)
    now = 5.0
    while robots.is_doubled("r1", now):
        robots.on_state("r1", "a", now)
        now += 1.0
        assert now <= 5.0 + REMEMBERED_S + 1.0, "the agent that was switched off is not forgotten"
    robots.on_state("r1", "b", now)
    assert not robots.is_doubled("r1", now), "the other one came back, alone"


@given(runs=st.lists(st.lists(st.floats(0.05, 5.0), min_size=1, max_size=20), max_size=12), late=st.integers(0, 20))
def test_agent_that_is_restarted_ever_so_often_is_one_robot_though_a_state_comes_late(runs, late):
    robots, now = DoubledRobots(), 0.0
    for number, pauses in enumerate(runs):
        for index, pause in enumerate(pauses):
            now += pause
            robots.on_state("r1", f"run-{number}", now)
            if number > 0 and (number, index) == (late, 0):
                robots.on_state("r1", f"run-{number - 1}", now)
    assert robots.found(now) == []


def test_agent_that_does_not_tell_its_run_is_not_judged():
    robots = DoubledRobots()
    assert not any(robots.on_state("r1", "", now * 0.5) for now in range(20))
