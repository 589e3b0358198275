"""What a ride asks of its lift, and when the robot goes on: each row is a moment of a ride."""

import pytest
from msgspec import structs

from fog_contracts.messages import Berth, HandOver, LiftState, Pose, RobotPose
from fog_contracts.site import LiftSite
from planner.lifts.rides import Facts, cabins_at, inside_of, lift_to, next_act, request
from planner.stops import Ride

RIDE = Ride(lift="north", floor="upstairs", who="anna")
GIVEN = HandOver(origin="ground", floor="upstairs", epoch=3, lift="north")
GROUND = Berth(floor="ground", epoch=2)
LEFT = Berth(floor="upstairs", epoch=3, came_by=GIVEN)
CABIN = frozenset({"north"})
BOARDS = structs.replace(RIDE, boards=True)
LIFTS = [
    LiftSite(id=name, cabin=Pose(x=x, y=0.0, theta=0.0), wait=Pose(x=x - 2.0, y=0.0, theta=0.0), floors=floors)
    for name, x, floors in (("far", 30.0, ["ground", "upstairs"]), ("north", 9.0, ["ground", "upstairs"]),
                            ("cellar", 5.0, ["ground", "cellar"]))
]  # fmt: skip


def lift(floor: str = "ground", session: str = "r1/3", door: str = "OPEN", to: str | None = None) -> LiftState:
    return LiftState(
        available_floors=["ground", "upstairs"], current_floor=floor, destination_floor=to or floor,
        door_state=door,  # type: ignore[arg-type]  # of a row
        motion_state="STOPPED", current_mode="AGV", session_id=session,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("facts", "state", "act"),
    [
        (Facts(GROUND, RIDE), lift(), "wait"),
        (Facts(GROUND, RIDE, at_goal=True), None, "wait"),
        (Facts(GROUND, RIDE, at_goal=True), lift(door="MOVING"), "wait"),
        (Facts(GROUND, RIDE, at_goal=True), lift("upstairs"), "wait"),
        (Facts(GROUND, RIDE, at_goal=True), lift(session="r2/1"), "wait"),
        (Facts(GROUND, RIDE, at_goal=True), lift(session="r1/2"), "wait"),
        (Facts(GROUND, RIDE, at_goal=True), lift(), "board"),
        (Facts(GROUND, structs.replace(RIDE, boards=True), at_goal=False), lift(), "wait"),
        (Facts(GROUND, BOARDS, at_goal=True, inside=CABIN), lift(door="CLOSED"), "wait"),
        (Facts(GROUND, BOARDS, at_goal=True, inside=CABIN), lift(), "leave"),
        (Facts(GROUND, BOARDS, at_goal=True, cabins=CABIN), lift(), "wait"),  # somebody has driven it out
        (Facts(GROUND), lift(), "wait"),
    ],
)
def test_robot_goes_on_only_while_the_lift_stands_open_for_this_ride(facts, state, act):
    assert next_act("r1", facts, state, "ground") == act


@pytest.mark.parametrize(
    ("floor", "facts", "state", "asked"),
    [
        ("ground", Facts(GROUND, RIDE), None, None),
        ("ground", Facts(GROUND, RIDE, at_goal=True), None, ("r1/3", "AGV_MODE", "ground")),
        ("ground", Facts(GROUND, RIDE, at_goal=True), lift(session="r1/2"), ("r1/2", "END_SESSION", "ground")),
        ("ground", Facts(GROUND, structs.replace(RIDE, boards=True)), lift(), ("r1/3", "AGV_MODE", "ground")),
        ("ground", Facts(GROUND), lift(), ("r1/3", "END_SESSION", "ground")),
        ("ground", Facts(GROUND, None, cabins=CABIN), lift(), ("r1/3", "AGV_MODE", "ground")),
        ("ground", Facts(GROUND), lift(session="r2/9"), None),
        ("ground", Facts(LEFT), lift(), ("r1/3", "AGV_MODE", "upstairs")),
        ("ground", Facts(LEFT), lift(to="upstairs"), None),
        ("ground", Facts(LEFT), lift(session=""), None),
        ("ground", Facts(LEFT), lift(session="r1/4"), None),
        ("upstairs", Facts(LEFT), lift(), ("r1/3", "AGV_MODE", "upstairs")),
        ("upstairs", Facts(LEFT, silent=True), lift("upstairs"), ("r1/3", "END_SESSION", "upstairs")),
        ("upstairs", Facts(structs.replace(LEFT, came_by=None)), lift("upstairs"), ("r1/3", "END_SESSION", "upstairs")),
    ],
)
def test_the_lift_is_asked_for_what_the_ride_needs_next_and_given_back_at_its_end(floor, facts, state, asked):
    found = request("north", "r1", facts, state, floor)
    assert (found and (found.session_id, found.request_type, found.destination_floor)) == asked


def test_the_nearest_lift_that_leads_there_is_taken():
    at = RobotPose(
        x=0.0, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=0.0
    )  # fmt: skip
    assert getattr(lift_to(LIFTS, "upstairs", at), "id", None) == "north"
    assert lift_to(LIFTS, "attic", at) is None
    assert cabins_at(LIFTS, LEFT, None) == CABIN
    assert cabins_at(LIFTS, LEFT, at) == frozenset()
    assert cabins_at(LIFTS, GROUND, structs.replace(at, x=8.5)) == CABIN
    deep = [structs.replace(LIFTS[1], wait=Pose(x=5.0, y=0.0, theta=0.0))]
    assert cabins_at(deep, GROUND, structs.replace(at, x=7.2)) == CABIN
    assert cabins_at(deep, GROUND, structs.replace(at, x=6.8)) == frozenset()
    assert inside_of(LIFTS, None) == frozenset()
    assert inside_of(LIFTS, structs.replace(at, x=8.4, localized=True)) == frozenset()
    assert inside_of(LIFTS, structs.replace(at, x=8.6, localized=True)) == CABIN
