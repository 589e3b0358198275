"""The simulated lift: rides with its door closed, serves one session, and tells it in Open-RMF's words."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.messages import LiftRequest
from fognav_sim.lift import DOOR_S, OPEN_S, TRAVEL_S, SimLift

FLOORS = ("ground", "first", "second")


def call(floor: str, session: str = "r1/1", kind: str = "AGV_MODE") -> LiftRequest:
    return LiftRequest(session_id=session, request_type=kind, destination_floor=floor)  # type: ignore[arg-type]  # drawn


def test_it_closes_its_door_before_it_rides_and_opens_it_there() -> None:
    lift = SimLift(FLOORS)
    lift.ask(call("ground"), 0.0)
    assert lift.state(DOOR_S).serves("r1/1", "ground")
    lift.ask(call("second"), DOOR_S)
    told = [(state.door_state, state.motion_state) for state in (lift.state(DOOR_S + 0.1 * n) for n in range(1, 200))]
    assert [each for each, _ in itertools.groupby(told)] == [
        ("MOVING", "STOPPED"), ("CLOSED", "UP"), ("CLOSED", "STOPPED"), ("MOVING", "STOPPED"), ("OPEN", "STOPPED"),
    ]  # fmt: skip
    assert lift.state(100.0).serves("r1/1", "second")
    assert 2 * TRAVEL_S < 200 * 0.1


def test_another_session_waits_for_the_end_of_the_first_and_people_get_out() -> None:
    lift = SimLift(FLOORS)
    lift.ask(call("ground"), 0.0)
    lift.ask(call("second", "r2/7"), 5.0)
    lift.ask(call("ground", "r2/7", "END_SESSION"), 5.0)
    assert lift.state(5.0).session_id == "r1/1"
    lift.ask(call("ground", kind="END_SESSION"), 6.0)
    assert (lift.state(6.5).door_state, lift.state(6.5).current_mode) == ("OPEN", "HUMAN")
    assert lift.state(7.0 + OPEN_S + DOOR_S).door_state == "CLOSED"
    lift.ask(call("second", "r2/7"), 20.0)
    assert lift.state(40.0).serves("r2/7", "second")


@given(st.lists(st.tuples(st.sampled_from(FLOORS), st.booleans(), st.floats(0.0, 5.0)), max_size=40))
def test_it_never_moves_with_its_door_open(calls: list[tuple[str, bool, float]]) -> None:
    lift, now = SimLift(FLOORS), 0.0
    for floor, ends, wait in calls:
        lift.ask(call(floor, kind="END_SESSION" if ends else "AGV_MODE"), now)
        now += wait
        state = lift.state(now)
        assert state.motion_state == "STOPPED" or state.door_state == "CLOSED"


@pytest.mark.parametrize("floor", ["attic"])
def test_a_floor_that_it_does_not_serve_is_ignored(floor: str) -> None:
    lift = SimLift(FLOORS)
    lift.ask(call(floor), 0.0)
    assert lift.state(10.0).session_id == ""
