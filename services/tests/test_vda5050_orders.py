"""A robot under a fleet control by VDA 5050: orders, instant actions, and whose word counts."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import msgspec
import pytest
from manual_clock import ManualClock
from vda5050_floor import DOCK, SETUP, STATE, A, B, C, Floorplan, action, header, instant, node, order, read

from fog_bridges.floor import ORDERS, Answer, Request
from fog_bridges.vda5050 import telling
from fog_bridges.vda5050.bridge import RobotLink, Vda5050Bridge
from fog_bridges.vda5050.charging import IDLE_S
from fog_bridges.vda5050.incoming import NODES_MAX
from fog_bridges.vda5050.robot import REFUSED_S
from fog_bridges.vda5050.uncertain import LATE_S, UNSEEN_S

# --- Orders -----------------------------------------------------------------------------------------------------------


def test_robot_drives_from_node_to_node_and_its_state_says_what_lies_ahead():
    floor = Floorplan()
    assert floor.take(order(A, B, C)) == ""
    assert floor.drive() == ["PUT 4 1"]
    said = floor.said()
    assert (said["orderId"], said["lastNodeId"]) == ("o1", "a")
    assert [each["nodeId"] for each in said["nodeStates"]] == ["b", "c"]
    assert [each["edgeId"] for each in said["edgeStates"]] == ["e1", "e3"]
    floor.reach(4.0, 1.0)
    assert floor.drive() == ["PUT 7 1"]
    assert (floor.said()["lastNodeId"], floor.said()["lastNodeSequenceId"]) == ("b", 2)
    floor.reach(7.0, 1.0)
    assert floor.drive() == []
    said = floor.said()
    assert (said["nodeStates"], said["edgeStates"], said["lastNodeId"], said["errors"]) == ([], [], "c", [])
    assert floor.take(order(node("c", 0, 7.0, 1.0), B, name="o2")) == "", "it is idle"


def test_node_within_its_deviation_is_passed_without_a_stop_and_the_mission_is_replaced_only_if_it_is_the_fleets():
    floor = Floorplan()
    floor.take(order(A, node("b", 2, 4.0, 1.0, position={"allowedDeviationXY": {"a": 0.5, "b": 0.2, "theta": 0.0}}), C))
    floor.drive()
    floor.at(3.7, 1.25, v=0.3)
    assert floor.drive() == [], "outside of the ellipse"
    floor.at(3.6, 1.05, v=0.3)
    assert floor.drive() == ["PUT 7 1"]
    assert floor.asked[0].headers["If-None-Match"] == "*"
    assert floor.asked[1].headers["If-Match"] == '"g1"'
    assert floor.said()["lastNodeId"] == "b"


def test_robot_waits_at_the_end_of_the_base_and_an_update_leads_on():
    floor = Floorplan()
    floor.take(order(A, B, C | {"released": False}))
    floor.drive()
    assert floor.said()["newBaseRequest"]
    floor.reach(4.0, 1.0)
    assert floor.drive() == []
    assert [each["released"] for each in floor.said()["nodeStates"]] == [False]
    assert floor.take(order(C, update=1)) == "VALIDATION_FAILURE", "it does not go on at the decision point"
    other = node("d", 4, 4.0, 4.0)
    assert floor.take(order(B, other, update=1)) == ""
    assert floor.drive() == ["PUT 4 4"]
    assert [each["nodeId"] for each in floor.said()["nodeStates"]] == ["d"], "the horizon is replaced"


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (order(A, B, name="o2"), "OTHER_ORDER_ACTIVE"), (order(A, B, update=3), "OUTDATED_ORDER_UPDATE"),
        (order(A, C | {"sequenceId": 2}, update=4), "SAME_ORDER_UPDATE_ID"),
        (order(A, B, update=5), "VALIDATION_FAILURE"),
        (order(B, C | {"actions": [{"actionType": "pick", "actionId": "x", "blockingType": "HARD"}]}, update=5),
         "INVALID_ORDER_ACTION"),
        (order(B, node("c", 4, 7.0, 1.0, position={"mapId": "moon"}), update=5), "UNKNOWN_MAP_ID"),
        (order(B, C, update=5, edge={"trajectory": {"controlPoints": []}}), "UNSUPPORTED_PARAMETER"),
        (order(B, C, update=5, edge={"maximumSpeed": 0.1}), "UNSUPPORTED_PARAMETER"),
        (order(B, {k: v for k, v in C.items() if k != "nodePosition"}, update=5), "NO_ROUTE_TO_TARGET"),
        (order(B, C, update=5, edge={"maximumSpeed": 1.5, "length": 3.0}), ""),
    ],
)  # fmt: skip
def test_order_that_does_not_fit_the_active_one_is_rejected_by_the_norms_error_and_changes_nothing(message, error):
    floor = Floorplan()
    assert floor.take(order(A)) == ""
    assert floor.take(order(A, B, C | {"released": False}, update=4)) == ""
    assert floor.take(message) == error
    if error:
        assert floor.errors() == {error: "CRITICAL" if error == "UNSUPPORTED_PARAMETER" else "WARNING"}
        assert floor.said()["orderUpdateId"] == 4
        assert floor.take(order(B, C, update=6)) == ""
    assert floor.errors() == {}, "until an order is accepted"


def test_updates_lengthen_an_order_up_to_the_limit_of_nodes_only():
    floor = Floorplan()
    row = [node(f"n{n}", 2 * n, 1.0 + 0.1 * n, 1.0) for n in range(NODES_MAX + 2)]
    assert floor.take(order(*row[:60])) == ""
    assert floor.take(order(*row[59:], update=1)) == "VALIDATION_FAILURE"
    assert floor.take(order(*row[59 : NODES_MAX + 1], update=1)) == ""


def test_new_order_has_to_begin_where_the_robot_is():
    floor = Floorplan()
    assert floor.take(order(node("a", 0, 1.4, 1.0), B)) == "START_NODE_OUT_OF_RANGE"
    wide = {"allowedDeviationXY": {"a": 0.5, "b": 0.5, "theta": 0.0}}
    assert floor.take(order(node("a", 0, 1.4, 1.0, position=wide), B, update=2)) == "VALIDATION_FAILURE"
    assert floor.take(order(node("a", 0, 1.4, 1.0, position=wide | {"theta": 0.2}), B)) == "START_NODE_OUT_OF_RANGE"
    turned = wide | {"theta": 0.2, "allowedDeviationTheta": 0.3}
    assert floor.take(order(node("a", 0, 1.4, 1.0, position=turned), B)) == ""
    for position in (wide, wide | {"theta": 0.1}):  # no deviation of the heading: as exactly as the robot can
        floor = Floorplan()
        assert floor.take(order(node("a", 0, 1.4, 1.0, position=position), B)) == ""


def test_same_order_again_is_ignored():
    floor = Floorplan()
    floor.take(order(A, B))
    assert floor.robot.orders.is_known(read(order(A, B)))
    assert not floor.robot.orders.is_known(read(order(A, C | {"sequenceId": 2})))


def test_node_that_gets_no_path_is_given_up_and_reported_until_the_fleet_decides():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.more = {"plan": {"refusal": {"reason": "every path is blocked"}}}
    floor.tell(1.0)
    assert floor.drive() == []
    floor.tell(REFUSED_S + 1.0)
    assert floor.drive() == ["DELETE"]
    assert floor.errors() == {"NODE_UNREACHABLE": "CRITICAL"}
    floor.more = {}
    assert floor.drive() == [], "the way is free again, and the fleet decides"
    floor.robot.on_instant(instant("cancelOrder"), floor.now)
    floor.tell()
    assert floor.errors() == {}


def test_mission_that_may_have_been_accepted_is_asked_for_again_by_the_same_key():
    floor = Floorplan()
    floor.take(order(A, B))
    assert floor.drive(Answer("the floor can't be reached")) == ["PUT 4 1"]
    floor.begin(floor.asked[0])
    floor.tell(2.0)
    assert floor.said()["operatingMode"] == "AUTOMATIC", "it may be the fleet's own"
    assert floor.drive() == ["PUT 4 1"]
    assert floor.asked[0] == floor.asked[1]
    assert (floor.said()["operatingMode"], floor.robot.goal_node.node_id) == ("AUTOMATIC", "b")


LOST = Answer("the floor can't be reached")


@pytest.mark.parametrize("word", ["cancel", "operator"])
def test_mission_that_may_have_been_accepted_and_is_not_wanted_any_more_is_ended_when_it_appears(word):
    floor = Floorplan()
    floor.take(order(A, B))
    assert floor.drive(LOST) == ["PUT 4 1"]
    if word == "cancel":
        floor.robot.on_instant(instant("cancelOrder", "c"), floor.now)
    floor.tell(2.0, enabled=word == "cancel")
    floor.begin(floor.asked[0])
    floor.tell(1.0)
    assert floor.drive() == ["DELETE"]
    assert floor.asked[-1].headers == {"If-Match": '"g1"'}
    floor.tell()
    assert word == "operator" or actions(floor) == {"c": "FINISHED"}


@pytest.mark.parametrize("silent_s", [3, 25])
def test_cancel_is_finished_only_once_the_floor_says_that_no_mission_has_begun_nor_will(silent_s):
    floor = Floorplan()
    floor.take(order(A, B))
    assert floor.drive(LOST) == ["PUT 4 1"]
    floor.robot.on_instant(instant("cancelOrder", "c"), floor.now)
    for _ in range(silent_s):
        floor.tell()
        floor.drive(Answer("Redis does not answer", "store_uncertain"))
    sent = floor.asked[1:]
    assert {(each.headers["If-Match"], each.headers["Idempotency-Key"]) for each in sent} == {
        ('"none"', floor.asked[0].headers["Idempotency-Key"])
    }, "the question begins none"
    assert (actions(floor), {each.body["pose"]["x"] for each in sent}) == ({"c": "RUNNING"}, {4.0})
    waited = 0
    while actions(floor) == {"c": "RUNNING"}:
        floor.tell()
        assert set(floor.drive()) <= {"PUT 4 1"}
        waited += 1
    assert (actions(floor), waited >= max(UNSEEN_S, silent_s)) == ({"c": "FINISHED"}, True), "a packet sent again"
    assert floor.goal is None


@pytest.mark.parametrize("shows", [True, False])
def test_mission_that_begins_long_after_its_request_was_given_up_is_ended_and_the_cancel_waits_for_that(shows):
    floor = Floorplan()
    floor.take(order(A, B))
    assert floor.drive(LOST) == ["PUT 4 1"]
    floor.robot.on_instant(instant("cancelOrder", "c"), floor.now)
    for _ in range(20):
        floor.tell()
        floor.drive(LOST)
    assert actions(floor) == {"c": "RUNNING"}
    floor.tell()
    if not shows:
        assert floor.drive() == ["PUT 4 1"], "not so far"
    floor.begin(floor.asked[0])
    mission = floor.goal
    if not shows:
        floor.goal = None
    floor.at(1.2, 1.0, v=0.3)
    floor.tell(1.0)
    assert floor.said()["operatingMode"] == "AUTOMATIC"
    assert floor.drive() == (["DELETE"] if shows else ["PUT 4 1", "DELETE"])
    assert floor.asked[-1].headers == {"If-Match": f'"{mission["goal_id"]}"'}
    assert actions(floor) == {"c": "RUNNING"}
    floor.at(1.3, 1.0)
    floor.tell()
    assert actions(floor) == {"c": "FINISHED"}


def test_cancel_has_failed_when_nobody_says_for_long_what_has_become_of_the_mission_which_is_ended_all_the_same():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive(LOST)
    floor.robot.on_instant(instant("cancelOrder", "c"), floor.now)
    for _ in range(int(LATE_S) + 1):
        floor.tell()
        floor.drive(LOST)
    (told,) = floor.said()["instantActionStates"]
    assert (told["actionStatus"], "does not say" in told["actionResult"]) == ("FAILED", True)
    floor.begin(floor.asked[0])
    floor.tell(1.0)
    assert floor.drive() == ["DELETE"]
    assert floor.take(order(A, B, name="o2")) == ""
    floor.robot.on_instant(instant("cancelOrder", "d"), floor.now)
    assert actions(floor) == {"c": "FAILED", "d": "FINISHED"}


def test_mission_that_may_have_been_accepted_and_never_appears_delays_the_next_order_only():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive(LOST)
    floor.robot.on_instant(instant("cancelOrder"), floor.now)
    assert floor.take(order(A, C | {"sequenceId": 2}, name="o2")) == ""
    floor.tell(2.0)
    assert floor.drive() == ["PUT 4 1"]
    assert floor.goal is None
    floor.tell(UNSEEN_S)
    assert floor.drive() == ["PUT 4 1"]
    floor.tell(1.0)
    assert floor.drive() == ["PUT 7 1"]
    assert floor.goal["pose"]["x"] == 7.0


def test_mission_that_may_have_been_accepted_is_the_fleets_though_its_repetition_is_refused():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive(LOST)
    floor.tell(2.0)
    assert floor.drive(Answer("robot r1 has another mission", "mission_changed")) == ["PUT 4 1"]
    floor.begin(floor.asked[0])
    floor.tell(2.0)
    assert floor.said()["operatingMode"] == "AUTOMATIC"
    mission = floor.goal["goal_id"]
    assert floor.drive() == ["PUT 4 1", "DELETE", "PUT 4 1"], "asked for, ended, and begun anew"
    assert floor.asked[-2].headers["If-Match"] == f'"{mission}"'


def test_mission_that_has_begun_unanswered_and_that_an_operator_has_ended_since_ends_no_later_order():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive(LOST)
    floor.robot.on_instant(instant("cancelOrder", "c"), floor.now)
    assert floor.take(order(A, C | {"sequenceId": 2}, name="o2")) == ""
    floor.begin(floor.asked[0])
    floor.goal = None
    floor.tell(2.0, goal_id=None)
    assert floor.drive() == ["PUT 4 1", "DELETE", "PUT 7 1"]
    floor.tell(UNSEEN_S)
    assert (floor.errors(), floor.robot.goal_node.node_id) == ({}, "c")


def test_request_that_the_floor_could_not_carry_out_is_sent_again_by_the_same_key():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive(LOST)
    for _ in range(20):
        floor.tell()
        assert floor.drive(Answer("the planner does not run", "service_away")) == ["PUT 4 1"]
    floor.tell()
    assert floor.drive() == ["PUT 4 1"]
    assert (len(set(map(str, floor.asked))), floor.robot.goal_node.node_id) == (1, "b")


def test_cancel_ends_the_mission_whose_replacement_may_have_been_accepted_at_once():
    floor = Floorplan()
    wide = {"allowedDeviationXY": {"a": 0.5, "b": 0.5, "theta": 0.0}}
    floor.take(order(A, node("b", 2, 4.0, 1.0, position=wide), C))
    floor.drive()
    floor.at(3.8, 1.0, v=0.3)
    assert floor.drive(Answer("the floor can't be reached")) == ["PUT 7 1"]
    floor.robot.on_instant(instant("cancelOrder"), floor.now)
    floor.tell(2.0)
    assert floor.drive() == ["DELETE"]
    assert floor.asked[-1].headers == {"If-Match": '"g1"'}


def test_operators_mission_is_told_from_one_that_the_fleet_may_have_begun():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive(Answer("the floor can't be reached"))
    floor.goal = {"goal_id": "theirs", "pose": {"x": 9.0, "y": 9.0, "theta": 0.0}}
    floor.tell(2.0)
    assert floor.said()["operatingMode"] == "MANUAL"
    floor.tell(UNSEEN_S)
    assert floor.drive() == ["PUT 4 1"]
    assert (floor.asked[-1].headers["If-Match"], floor.goal["goal_id"]) == ('"none"', "theirs")


# --- What the floor tells late, or not at all -------------------------------------------------------------------------


def test_mission_that_an_operator_ends_near_its_node_is_not_taken_for_reached():
    floor = Floorplan()
    floor.take(order(A, B, C))
    floor.drive()
    floor.at(3.8, 1.0)
    floor.goal = None
    floor.tell(goal_id=None)
    assert floor.drive() == [], "the robot's word may come late"
    floor.tell(UNSEEN_S)
    assert floor.drive() == []
    assert floor.errors() == {"ORDER_ENDED": "WARNING"}
    said = floor.said()
    assert (said["lastNodeId"], said["nodeStates"], said["operatingMode"]) == ("a", [], "MANUAL")


@pytest.mark.parametrize("reached", [True, False])
def test_end_of_a_mission_is_known_by_the_audit_trail_if_the_state_that_tells_it_was_left_out(reached):
    floor = Floorplan()
    floor.take(order(A, B, C))
    floor.drive()
    floor.at(3.9, 1.0)
    floor.goal = None
    floor.tell(goal_id=None)
    floor.robot.on_end("g1", floor.now, reached=reached)
    assert floor.drive() == (["PUT 7 1"] if reached else [])
    assert floor.errors() == ({} if reached else {"ORDER_ENDED": "WARNING"})


def test_order_outlives_a_restart_of_the_console_which_tells_of_the_mission_a_little_later():
    floor = Floorplan()
    floor.take(order(A, B, C))
    floor.drive()
    floor.now += 60.0
    floor.robot.forget()
    floor.robot.on_known(floor.now)
    floor.robot.on_robot({"state": None, "goal": None}, floor.now)
    floor.robot.advance(floor.now)
    goal, floor.goal = floor.goal, None
    floor.tell(1.0)
    assert floor.drive() == []
    floor.goal = goal
    floor.at(2.0, 1.0)
    floor.tell(1.0)
    assert floor.drive() == []
    assert (floor.errors(), floor.robot.goal_node.node_id) == ({}, "b")
    floor.robot.on_instant(instant("cancelOrder"), floor.now)
    assert floor.drive() == ["DELETE"]


def test_nothing_is_concluded_while_the_floors_state_is_not_known():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.robot.is_known = False
    goal, floor.goal = floor.goal, None
    floor.tell(60.0)
    floor.goal = goal
    floor.tell(1.0)
    floor.robot.on_known(floor.now)
    assert (floor.robot.goal_node.node_id, floor.robot.errors()) == ("b", [])
    floor.robot.is_known = False
    assert floor.take(order(A, B, name="o2")) == "MOBILE_ROBOT_NOT_AVAILABLE"


def test_mission_of_the_fleet_that_was_taken_for_ended_is_ended_when_it_appears_again():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    goal, floor.goal = floor.goal, None
    floor.tell(UNSEEN_S + 1.0)
    assert floor.errors() == {"ORDER_ENDED": "WARNING"}
    floor.goal = goal
    floor.tell(3.0)
    assert floor.drive() == ["DELETE"]
    assert floor.asked[-1].headers == {"If-Match": '"g1"'}
    floor.goal = goal
    floor.tell(0.1)
    assert floor.drive() == [], "it is over, and what is told is older"
    floor.goal = goal
    floor.tell(UNSEEN_S)
    assert floor.drive() == ["DELETE"], "but not so much older: the floor has it again"


async def test_floor_that_begins_anew_takes_back_all_that_it_has_told():
    bridge = Vda5050Bridge(SETUP)
    running = asyncio.create_task(bridge.run(None, ManualClock(100.0)))
    await asyncio.sleep(0)
    robot = bridge._links["r1"].core
    pose = {"x": 1.0, "y": 1.0, "theta": 0.0, "localized": True, "v": 0.0, "w": 0.0, "height": 0.1}
    told = [("hello", {"fresh": True}), ("place", {"id": "old", "value": {"x": 4.0, "y": 1.0}}),
            ("pose", {"id": "r1", "value": pose}),
            ("robot", {"id": "r1", "value": {"state": STATE | {"stamp": 1.0}, "goal": None}}),
            ("path", {"id": "r1", "value": {"points": [[1.0, 1.0], [4.0, 1.0]]}}), ("ready", {})]  # fmt: skip
    for event in told:
        bridge.on_event(*event)
    assert robot.situation(100.0).unavailable == "the robot is not there", "its state may be an old one"
    bridge.on_event("robot", {"id": "r1", "value": {"state": STATE | {"stamp": 2.0}, "goal": None}})
    to_place = read(order(A, {name: value for name, value in B.items() if name != "nodePosition"} | {"nodeId": "old"}))
    assert robot.checked(to_place, 100.0) is None
    robot.accept(to_place)
    assert robot.step(100.0).method == "PUT"
    robot.on_answer(Answer("", body={"goal_id": "g1"}), 100.0)
    bridge.on_lost()
    bridge.on_event("hello", {"fresh": True})
    assert (robot.places, robot.at, robot.path, robot.state) == ({}, None, [], {})
    for name, data in told[2:]:
        bridge.on_event(name, data)
    entry = {"kind": "mission", "id": "r1", "action": "reached", "before": {"goal": {"goal_id": "g1"}}, "after": None}
    bridge.on_event("record", entry | {"kind": "place", "before": {"x": 1.0}})
    assert robot.orders.last_node_id == "a"
    bridge.on_event("record", entry)
    assert robot.orders.last_node_id == "old"
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


# --- Operators and instant actions ------------------------------------------------------------------------------------


def test_robot_that_only_drives_where_it_stays_without_a_mission_takes_an_order():
    floor = Floorplan()
    floor.goal = {"goal_id": "home", "pose": {"x": 9.0, "y": 9.0, "theta": 0.0}, "idle": True}
    floor.tell(1.0)
    assert floor.said()["operatingMode"] == "AUTOMATIC"
    assert floor.drive() == [], "without an order it may go there"
    assert floor.take(order(A, B)) == ""
    assert floor.drive() == ["PUT 4 1"]
    assert (floor.asked[0].headers["If-None-Match"], floor.errors()) == ("*", {})


HOME = {"goal_id": "home", "pose": {"x": 9.0, "y": 9.0, "theta": 0.0}, "idle": True}
"""The planner's own mission of a robot that has had none for a while."""


@pytest.mark.parametrize("waits", ["paused", "base", "unreachable"])
def test_robot_that_waits_for_the_fleet_is_not_sent_home_and_its_order_goes_on(waits):
    floor = Floorplan()
    floor.take(order(A, B, C | {"released": waits != "base"}))
    floor.drive()
    if waits == "paused":
        floor.robot.on_instant(instant("startPause", "p"), floor.now)
        assert floor.drive() == ["DELETE"]
    elif waits == "base":
        floor.reach(4.0, 1.0)
    else:
        floor.more = {"plan": {"refusal": {"reason": "every path is blocked"}}}
        floor.tell(1.0)
        floor.tell(REFUSED_S + 1.0)
        assert floor.drive() == ["DELETE"]
        floor.more = {}
    errors = floor.errors()
    for name in ("home", "home again"):
        asked = len(floor.asked)
        floor.goal = HOME | {"goal_id": name}
        floor.tell(30.0, goal_id=name)
        assert floor.drive(LOST) == ["DELETE"]
        floor.tell(2.0)
        assert floor.drive() == ["DELETE"], "once more: nobody knows what became of the first"
        assert {each.headers["If-Match"] for each in floor.asked[asked:]} == {f'"{name}"'}
        floor.tell(0.5, goal_id=None)
        assert (floor.drive(), floor.goal, floor.errors()) == ([], None, errors)
        said = floor.said()
        assert (said["operatingMode"], said["nodeStates"] != []) == ("AUTOMATIC", True)
    if waits == "paused":
        floor.robot.on_instant(instant("stopPause", "q"), floor.now)
        assert floor.drive() == ["PUT 4 1"]
        assert actions(floor) == {"p": "FINISHED", "q": "FINISHED"}
    elif waits == "base":
        assert floor.take(order(B, C, update=1)) == ""
        assert floor.drive() == ["PUT 7 1"]


def test_pause_ends_the_way_of_a_robot_without_an_order_to_where_it_stays_and_is_finished_after_that():
    floor = Floorplan()
    floor.goal = HOME
    floor.at(1.5, 1.0, v=0.3)
    floor.tell(1.0, goal_id="home")
    floor.robot.on_instant(instant("startPause", "p"), floor.now)
    floor.at(1.5, 1.0)
    assert (actions(floor), floor.said()["paused"]) == ({"p": "RUNNING"}, True)
    assert floor.drive() == ["DELETE"]
    assert floor.asked[0].headers == {"If-Match": '"home"'}
    floor.tell(goal_id=None)
    assert (actions(floor), floor.errors(), floor.goal) == ({"p": "FINISHED"}, {}, None)


@pytest.mark.parametrize("kind", ["startCharging", "stopCharging"])
def test_robot_that_waits_at_a_node_for_its_dock_is_not_sent_home(kind):
    floor = Floorplan()
    floor.more = DOCK
    floor.tell(docked=kind == "stopCharging")
    floor.take(order(A | {"actions": [action(kind, "c")]}, B))
    floor.tell()
    assert floor.drive() == [f"POST {'dock' if kind == 'startCharging' else 'undock'}"]
    floor.goal = HOME
    floor.tell(1.0)
    assert floor.drive() == ["DELETE"]
    assert floor.said()["actionStates"][0]["actionStatus"] == "RUNNING", "its command is not cancelled"


def test_order_that_ends_since_the_robot_is_sent_to_its_dock_by_another_is_reported():
    floor = Floorplan()
    floor.more = DOCK
    floor.take(order(A, B, C | {"released": False}))
    floor.drive()
    floor.reach(4.0, 1.0)
    floor.tell(300.0, wants_dock=True)
    (error,) = floor.said()["errors"]
    assert (error["errorType"], "to its dock" in error["errorDescription"]) == ("ORDER_ENDED", True)
    assert (floor.said()["operatingMode"], floor.said()["nodeStates"]) == ("MANUAL", [])
    floor.tell(wants_dock=False)
    assert floor.take(order(B, C, name="o2")) == ""
    assert floor.errors() == {}


@pytest.mark.parametrize(
    ("mode", "state", "view"),
    [
        ("MANUAL", {"enabled": False, "mode": "HOLD"}, {}), ("MANUAL", {"awaits_operator": True, "mode": "FAULT"}, {}),
        ("MANUAL", {"mode": "TELEOP"}, {}), ("MANUAL", {"wants_dock": True}, {}),
        ("MANUAL", {"mode": "DOCK", "wants_dock": True}, {}), ("STARTUP", {"mode": "INIT"}, {}),
        ("SERVICE", {}, {"out_of_service": {"reason": "repair"}}), ("MANUAL", {}, {"goal": {"goal_id": "theirs"}}),
        ("MANUAL", {}, {"goal": None}),
    ],
)  # fmt: skip
def test_operators_word_ends_the_order_and_the_fleet_drives_over_none(mode, state, view):
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.at(2.0, 1.0, v=0.2)
    floor.goal = view.pop("goal", floor.goal)
    floor.more = view
    floor.tell(UNSEEN_S + 0.1 if floor.goal is None else 1.0, **state)
    said = floor.said()
    assert (said["operatingMode"], said["nodeStates"], said["orderId"]) == (mode, [], "o1")
    assert any(
        "fleet" in each["infoDescriptor"] or each["infoType"] == "NOT_IN_CONTROL" for each in said["information"]
    )
    assert floor.take(order(node("s", 0, 2.0, 1.0), B, name="o2")) == "MOBILE_ROBOT_NOT_AVAILABLE"
    assert all(request.headers.get("If-Match", '"g1"') == '"g1"' for request in floor.asked)
    floor.drive()
    assert [request.method for request in floor.asked][1:] in ([], ["DELETE"])
    floor.state, floor.more, floor.goal = dict(STATE), {}, None
    floor.tell(3.0)
    assert floor.said()["operatingMode"] == "AUTOMATIC"
    assert floor.drive() == [], "it stays where the operator left it"
    assert floor.take(order(B, C, update=1)) == "ORDER_UPDATE_FOLLOWING_CANCEL"
    assert floor.take(order(node("s", 0, 2.0, 1.0), B, name="o2")) == ""


def test_hold_and_stops_are_shown_and_end_no_order():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.tell(mode="HOLD", codes=["map_old", "path_awaited"], reasons=["the map is old", "a path is awaited"])
    assert (floor.said()["operatingMode"], floor.errors()) == ("AUTOMATIC", {"MAP_OLD": "WARNING"})
    floor.tell(mode="PROTECTIVE_STOP", codes=["obstacle_near"], reasons=["something is near"])
    assert floor.said()["safetyState"] == {"activeEmergencyStop": "NONE", "fieldViolation": True}
    assert [each["nodeId"] for each in floor.said()["nodeStates"]] == ["b"]
    floor.tell(mode="FAULT", codes=["bumper"], reasons=["it has hit something"], awaits_operator=True)
    assert floor.said()["safetyState"] == {"activeEmergencyStop": "MANUAL", "fieldViolation": True}
    assert floor.errors()["BUMPER"] == "FATAL"


def actions(floor: Floorplan) -> dict[str, str]:
    return {each["actionId"]: each["actionStatus"] for each in floor.said()["instantActionStates"]}


def test_cancelled_order_ends_the_mission_and_is_finished_once_the_robot_stands():
    floor = Floorplan()
    floor.robot.on_instant(instant("cancelOrder", "early"), floor.now)
    assert (actions(floor), floor.errors()) == ({"early": "FAILED"}, {"NO_ORDER_TO_CANCEL": "WARNING"})
    floor.take(order(A, B))
    floor.drive()
    floor.at(2.0, 1.0, v=0.3)
    floor.robot.on_instant(instant("cancelOrder", "other", orderId="o7"), floor.now)
    floor.robot.on_instant(instant("cancelOrder", "c", orderId="o1"), floor.now)
    assert floor.drive() == ["DELETE"]
    assert actions(floor) == {"early": "FAILED", "other": "FAILED", "c": "RUNNING"}
    floor.at(2.1, 1.0)
    floor.tell()
    assert (actions(floor)["c"], floor.said()["nodeStates"], floor.said()["orderId"]) == ("FINISHED", [], "o1")
    assert floor.take(order(B, C, update=1)) == "ORDER_UPDATE_FOLLOWING_CANCEL"


def test_pause_after_an_operator_has_ended_the_mission_does_not_hide_that():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.at(2.0, 1.0)
    floor.goal = None
    floor.tell(goal_id=None)
    floor.robot.on_instant(instant("startPause", "p"), floor.now)
    assert floor.drive(Answer("robot r1 has no mission", "no_mission")) == ["DELETE"]
    floor.robot.on_instant(instant("stopPause", "q"), floor.now)
    floor.tell(UNSEEN_S)
    assert floor.errors() == {"ORDER_ENDED": "WARNING"}
    floor.tell(3.0)
    assert (floor.said()["operatingMode"], floor.drive()) == ("AUTOMATIC", [])


def test_operators_end_of_a_mission_is_noticed_although_the_fleet_keeps_asking_to_replace_it():
    floor = Floorplan()
    wide = {"allowedDeviationXY": {"a": 0.5, "b": 0.5, "theta": 0.0}}
    floor.take(order(A, node("b", 2, 4.0, 1.0, position=wide), C))
    floor.drive()
    floor.goal = None
    floor.at(3.8, 1.0)
    for _ in range(6):
        floor.tell(goal_id=None)
        floor.drive(Answer("robot r1 has no mission", "mission_changed"))
    assert floor.errors() == {"ORDER_ENDED": "WARNING"}


def test_cancel_whose_answer_is_lost_is_no_operators():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.robot.on_instant(instant("cancelOrder", "c"), floor.now)
    assert floor.drive(Answer("the floor can't be reached")) == ["DELETE"]
    floor.goal = None
    floor.robot.on_end("g1", floor.now, reached=False)
    floor.tell()
    assert (floor.errors(), floor.said()["operatingMode"], actions(floor)) == ({}, "AUTOMATIC", {"c": "FINISHED"})


def test_order_that_follows_a_cancel_at_once_is_not_taken_for_the_one_before():
    floor, other = Floorplan(), order(A, C | {"sequenceId": 2}, name="o2")
    floor.take(order(A, B))
    floor.drive()
    floor.robot.on_instant(instant("cancelOrder"), floor.now)
    assert floor.take(other) == ""
    floor.at(4.0, 1.0)
    floor.tell(goal_reached=True)
    assert floor.said()["nodeStates"] != [], "that was the other order's node"
    assert floor.drive() == ["PUT 7 1"]


def test_refusal_of_a_goal_of_an_order_that_was_cancelled_stops_no_other_order():
    floor = Floorplan()
    floor.take(order(A, B))
    assert floor.robot.step(floor.now).method == "PUT"
    floor.robot.on_instant(instant("cancelOrder"), floor.now)
    floor.take(order(A, C | {"sequenceId": 2}, name="o2"))
    floor.robot.on_answer(Answer("a wall", "goal_refused"), floor.now)
    assert (floor.errors(), floor.drive()) == ({}, ["PUT 7 1"])


def test_pause_ends_the_mission_but_not_the_order_and_its_end_leads_on():
    floor = Floorplan()
    floor.take(order(A, B))
    floor.drive()
    floor.at(2.0, 1.0, v=0.3)
    floor.robot.on_instant(instant("startPause", "p"), floor.now)
    assert floor.drive() == ["DELETE"]
    floor.at(2.0, 1.0)
    floor.tell()
    assert (floor.said()["paused"], actions(floor), len(floor.said()["nodeStates"])) == (True, {"p": "FINISHED"}, 1)
    floor.robot.on_instant(instant("stopPause", "q"), floor.now)
    assert floor.drive() == ["PUT 4 1"]
    assert (floor.said()["paused"], actions(floor)["q"]) == (False, "FINISHED")
    floor.at(2.0, 1.0, v=0.3)
    floor.robot.on_instant(instant("startPause", "r"), floor.now)
    floor.robot.on_instant(instant("startPause", "s"), floor.now)
    assert (actions(floor)["r"], actions(floor)["s"]) == ("RUNNING", "RUNNING")
    floor.robot.on_instant(instant("stopPause", "t"), floor.now)
    assert [actions(floor)[name] for name in "rst"] == ["FAILED", "FAILED", "FINISHED"]


def test_requests_are_answered_and_unknown_actions_fail():
    floor = Floorplan()
    assert floor.robot.on_instant(instant("factsheetRequest", "f"), floor.now) == ["state", "factsheet"]
    floor.robot.on_instant(instant("enableZoneSet", "z", zoneSetId="x"), floor.now)
    assert (actions(floor), floor.errors()) == ({"f": "FINISHED", "z": "FAILED"}, {"INVALID_INSTANT_ACTION": "WARNING"})
    for n in range(100):
        floor.robot.on_instant(instant("stateRequest", f"s{n}"), floor.now)
    assert (len(actions(floor)), floor.errors()) == (50, {})


# --- The dock ---------------------------------------------------------------------------------------------------------

TO_DOCK = {"goal_id": "dock", "pose": {"x": 4.0, "y": 1.0, "theta": 0.0}}


def at_a_dock() -> Floorplan:
    """A robot that has driven an order to its last node, and is told to dock there."""
    floor = Floorplan()
    floor.more = DOCK
    floor.tell()
    assert floor.take(order(A, B | {"actions": [action("startCharging", "c")]})) == ""
    assert (floor.drive(), done(floor)) == (["PUT 4 1"], {"c": "WAITING"})
    floor.reach(4.0, 1.0)
    assert (floor.drive(), floor.asked[-1].body) == (["POST dock"], {"kind": "dock"})
    floor.goal = TO_DOCK
    floor.tell(goal_id="dock", wants_dock=True, codes=["docking"], reasons=["on its way"])
    return floor


def done(floor: Floorplan) -> dict[str, str]:
    return {each["actionId"]: each["actionStatus"] for each in floor.said()["actionStates"]}


def test_robot_charges_at_the_node_whose_action_says_so_and_the_next_order_takes_it_off_its_dock():
    floor = at_a_dock()
    assert (floor.said()["operatingMode"], done(floor)) == ("AUTOMATIC", {"c": "RUNNING"})
    assert floor.take(order(A, B, name="o2")) == "OTHER_ORDER_ACTIVE"
    floor.goal = None
    floor.tell(goal_id=None, wants_dock=False, mode="DOCK", codes=[], reasons=[])
    assert done(floor) == {"c": "RUNNING"}
    floor.at(4.7, 1.0)
    floor.tell(mode="HOLD", docked=True, power={"charging": "bulk"})
    assert (done(floor), floor.said()["operatingMode"]) == ({"c": "FINISHED"}, "AUTOMATIC")
    assert floor.said()["powerSupply"]["charging"] is True
    off = B | {"sequenceId": 0, "actions": [action("stopCharging", "d")]}
    assert floor.take(order(off, node("a", 2, 1.0, 1.0), name="o2")) == "", "0.7 m from its first node, on the dock"
    floor.tell()
    assert (floor.drive(), floor.asked[-1].body, done(floor)) == (["POST undock"], {"kind": "undock"}, {"d": "RUNNING"})
    floor.tell(mode="INIT")
    assert floor.said()["operatingMode"] == "AUTOMATIC", "its lidar starts"
    floor.tell(mode="DOCK", docked=False)
    assert floor.drive() == []
    floor.tell(mode="HOLD")
    assert (floor.drive(), done(floor)) == (["PUT 1 1"], {"d": "FINISHED"})


@pytest.mark.parametrize(
    ("end", "mode", "words"),
    [
        ({"wants_dock": False, "codes": ["docking_given_up"], "reasons": ["given up: barred"]}, "AUTOMATIC", "barred"),
        ({"wants_dock": False, "enabled": False, "mode": "INIT"}, "STARTUP", "not in control"),
    ],
)
def test_docking_that_the_robot_or_an_operator_ends_has_failed(end, mode, words):
    floor = at_a_dock()
    floor.goal = None
    floor.tell(IDLE_S + 0.1, goal_id=None, **{"codes": [], "reasons": [], **end})
    assert (floor.said()["actionStates"][0]["actionStatus"], floor.said()["operatingMode"]) == ("FAILED", mode)
    assert words in floor.said()["actionStates"][0]["actionResult"]


def test_operators_other_mission_on_the_way_to_the_dock_is_the_operators():
    floor = at_a_dock()
    floor.goal = {"goal_id": "theirs", "pose": {"x": 9.0, "y": 9.0}}
    floor.tell(goal_id="theirs", wants_dock=False, codes=[], reasons=[])
    assert (floor.said()["operatingMode"], done(floor)) == ("MANUAL", {"c": "FAILED"})


def test_cancel_ends_the_way_to_the_dock_and_its_action_has_failed():
    floor = at_a_dock()
    floor.robot.on_instant(instant("cancelOrder", "x"), floor.now)
    assert floor.drive() == ["DELETE"]
    assert floor.asked[-1].headers == {"If-Match": '"dock"'}
    assert actions(floor) == {"x": "RUNNING"}
    floor.tell(IDLE_S + 0.1, goal_id=None, wants_dock=False, codes=[], reasons=[])
    floor.tell()
    assert (done(floor), actions(floor)) == ({"c": "FAILED"}, {"x": "FINISHED"})
    assert floor.take(order(node("b", 0, 4.0, 1.0), A | {"sequenceId": 2}, name="o2")) == ""


def test_pause_on_the_way_to_the_dock_is_refused_and_a_cancel_that_the_floor_did_not_carry_out_is_asked_again():
    floor = at_a_dock()
    floor.robot.on_instant(instant("startPause", "p"), floor.now)
    assert (actions(floor), floor.said()["paused"]) == ({"p": "FAILED"}, False)
    floor.robot.on_instant(instant("cancelOrder", "x"), floor.now)
    assert floor.drive(Answer("the planner is handing over", "service_away")) == ["DELETE"]
    floor.tell(5.0)
    assert floor.drive() == ["DELETE"]


@pytest.mark.parametrize("answer", [Answer(""), LOST])
def test_docking_has_not_failed_while_its_request_is_under_way_and_a_cancel_waits_for_it(answer):
    floor = Floorplan()
    floor.more = DOCK
    floor.tell()
    floor.robot.on_instant(instant("startCharging", "s"), floor.now)
    assert floor.robot.step(floor.now).body == {"kind": "dock"}
    for _ in range(9):
        floor.tell()
    assert actions(floor) == {"s": "RUNNING"}, "the answer is not there yet"
    floor.robot.on_instant(instant("cancelOrder", "x"), floor.now)
    floor.robot.on_answer(answer, floor.now)
    for _ in range(20 if answer.refusal else 2):
        floor.tell()
        assert floor.drive() == []
    assert actions(floor) == {"s": "RUNNING", "x": "RUNNING"}
    floor.goal = TO_DOCK
    floor.at(1.2, 1.0, v=0.3)
    floor.tell(goal_id="dock", wants_dock=True)
    assert floor.said()["operatingMode"] == "AUTOMATIC"
    assert floor.drive() == ["DELETE"]
    assert floor.asked[-1].headers == {"If-Match": '"dock"'}
    floor.at(1.2, 1.0)
    floor.tell(IDLE_S + 0.1, goal_id=None, wants_dock=False)
    floor.tell()
    assert actions(floor) == {"s": "FAILED", "x": "FINISHED"}


def test_docking_of_which_nobody_knows_whether_the_robot_was_told_has_failed_at_last_and_so_has_its_cancel():
    floor = Floorplan()
    floor.more = DOCK
    floor.tell()
    floor.robot.on_instant(instant("startCharging", "s"), floor.now)
    assert floor.drive(LOST) == ["POST dock"]
    floor.robot.on_instant(instant("cancelOrder", "x"), floor.now)
    for _ in range(int(LATE_S) + 1):
        floor.tell()
        floor.drive()
    found = floor.said()["instantActionStates"]
    assert {each["actionId"]: each["actionStatus"] for each in found} == {"s": "FAILED", "x": "FAILED"}
    assert all("does not say" in each["actionResult"] for each in found)
    assert floor.take(order(A, B)) == ""
    floor.robot.on_instant(instant("cancelOrder", "y"), floor.now)
    assert actions(floor)["y"] == "FINISHED", "that was another action's"


def test_instant_charging_is_refused_with_the_reason_and_else_comes_before_orders():
    floor = Floorplan()
    for refused in ("no dock", "is active"):
        floor.robot.on_instant(instant("startCharging", refused), floor.now)
        assert (
            refused in {each["actionId"]: each["actionResult"] for each in floor.said()["instantActionStates"]}[refused]
        )
        floor.more = DOCK
        floor.tell()
        floor.take(order(A, B, C))
    floor.robot.on_instant(instant("cancelOrder", "x"), floor.now)
    floor.robot.on_instant(instant("startCharging", "c"), floor.now)
    assert floor.take(order(A, B, name="o2")) == "MOBILE_ROBOT_NOT_AVAILABLE"
    assert floor.drive(Answer("the base is asleep", "command_refused")) == ["POST dock"]
    assert (actions(floor)["c"], floor.take(order(A, B, name="o2"))) == ("FAILED", "")
    assert floor.take(order(A, B | {"actions": [action("pick", "p")]}, name="o3")) == "OTHER_ORDER_ACTIVE"


def test_actions_that_a_robot_does_not_do_or_has_no_dock_for_reject_the_order():
    floor = Floorplan()
    for kind, where in (("pick", B), ("startCharging", B)):
        assert floor.take(order(A, where | {"actions": [action(kind, "a")]})) == "INVALID_ORDER_ACTION"
    floor.more = DOCK
    floor.tell()
    twice = [action("startCharging", "a"), action("stopCharging", "a")]
    assert floor.take(order(A, B | {"actions": twice})) == "INVALID_ORDER_ACTION"
    assert floor.take(order(A, B, edge={"actions": twice[:1]})) == "INVALID_ORDER_ACTION"
    named = [(each["actionType"], each["actionScopes"])
             for each in telling.factsheet(floor.robot, "3.0")["protocolFeatures"]["mobileRobotActions"]]  # fmt: skip
    assert ("startCharging", ["INSTANT", "NODE"]) in named


def test_instant_actions_of_2_0_have_two_names():
    action = {"actionType": "stateRequest", "actionId": "a", "blockingType": "NONE"}
    for name in ("actions", "instantActions"):
        found = read(header("2.0") | {name: [action]}, "instantActions", "2.0")
        assert [each.action_type for each in found.actions] == ["stateRequest"]


@pytest.mark.parametrize("word", ["operator", "cancel"])
async def test_order_whose_nodes_are_being_looked_for_gives_way_to_a_cancel_and_to_an_operator(word):
    floor = Floorplan()

    class Slow:
        async def ask(self, _: Request) -> Answer:
            if word == "cancel":
                link.on_message("x/instantActions", msgspec.json.encode(instant("cancelOrder")))
            else:
                floor.tell(enabled=False)
            return Answer("", body={"path": {"refusal": None}})

    link = RobotLink(SETUP, "r1", Slow(), ManualClock())
    link.core = floor.robot
    link.on_message("x/order", json.dumps(order(A, B)).encode())
    taking = asyncio.create_task(link.order_loop())
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    taking.cancel()
    await asyncio.gather(taking, return_exceptions=True)
    assert (floor.said()["orderId"], floor.drive()) == ("", [])
    if word == "cancel":
        assert actions(floor) == {"a1": "FINISHED"}
    else:
        assert floor.errors() == {"MOBILE_ROBOT_NOT_AVAILABLE": "WARNING"}


@pytest.mark.parametrize("wanted", [{}, {"orderId": "o1"}, {"orderId": "o2"}])
async def test_cancel_ends_orders_that_wait_and_one_that_is_sent_again_while_it_waits_is_no_further_one(wanted, caplog):
    floor, asked, found = Floorplan(), asyncio.Event(), asyncio.Event()

    class Slow:
        async def ask(self, _: Request) -> Answer:
            asked.set()
            await found.wait()
            return Answer("", body={"path": {"refusal": None}})

    link = RobotLink(SETUP, "r1", Slow(), ManualClock())
    link.core = floor.robot
    dropped, repeated = (ORDERS.labels("vda5050", word)._value for word in ("dropped", "repeated"))
    before = dropped.get(), repeated.get()
    taking = asyncio.create_task(link.order_loop())
    caplog.set_level("INFO")

    def send(message: dict[str, Any]) -> None:
        link.on_message("x/order", json.dumps(message).encode())

    send(order(A, B))
    await asked.wait()
    for _ in range(30):
        send(order(A, B))
        send(order(A, B, name="o2"))
    assert (repeated.get() - before[1], [each.order_id for each in floor.robot.waiting]) == (59, ["o2"])
    link.on_message("x/instantActions", msgspec.json.encode(instant("cancelOrder", "c", **wanted)))
    assert actions(floor)["c"] != "FAILED"
    assert dropped.get() - before[0] == (wanted != {"orderId": "o1"})
    found.set()
    for _ in range(5):
        await asyncio.sleep(0)
    assert floor.said()["orderId"] == {"o1": "o2", "o2": "o1"}.get(wanted.get("orderId"), "")
    for n in range(50):
        link.on_message("x/instantActions", msgspec.json.encode(instant("stateRequest", f"s{n}")))
        link.on_message("x/instantActions", msgspec.json.encode(instant(f"new{n}", f"n{n}")))
    lines = [each.message for each in caplog.records]
    assert (lines.count("order") <= 5, lines.count("instant_action")) == (True, 3), "a fleet fills no disk"
    taking.cancel()
    await asyncio.gather(taking, return_exceptions=True)
