"""Robots under a fleet control by VDA 5050, and robots of others that are told of zones: cores, and a real broker."""

from __future__ import annotations

import asyncio
import json
import math
import os
import random
from contextlib import asynccontextmanager
from functools import cache
from pathlib import Path
from typing import Any

import aiomqtt
import jsonschema_rs
import msgspec
import pytest

from fog_bridges.floor import Answer, Request
from fog_bridges.vda5050 import telling
from fog_bridges.vda5050.bridge import Sender, Setup, Vda5050Bridge
from fog_bridges.vda5050.incoming import RELEASES, InstantActions, MessageError, Order, ReportedZoneSet, decoded
from fog_bridges.vda5050.robot import REFUSED_S, FleetRobot
from fog_bridges.vda5050.zones import AGAIN_S, ZoneSets, ZoneUser
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.transports.mqtt_connection import Broker

SCHEMAS = os.environ.get("FOGNAV_VDA5050_SCHEMAS", "")
"""A checkout of VDA5050/VDA5050, `json_schemas` of which are of 3.0 (its branch main; those of the tag 3.0.0 are no valid
JSON); and beside it, in `2.1.0`, one of the tag 2.1.0."""
DAMAGED = int(os.environ.get("FOGNAV_DAMAGED_ORDERS", "2000"))
VERSIONS = ("3.0", "2.1")


@cache
def schema(version: str, topic: str) -> jsonschema_rs.Validator:
    """Return the published schema of a topic."""
    if not SCHEMAS:
        pytest.skip("needs the schemas: git clone github.com/VDA5050/VDA5050 V, FOGNAV_VDA5050_SCHEMAS=V "
                    "(for 2.1 the tag 2.1.0 in V/2.1.0)")  # fmt: skip
    folder = Path(SCHEMAS) / ("json_schemas" if version == "3.0" else "2.1.0/json_schemas")
    return jsonschema_rs.validator_for(json.loads((folder / f"{topic}.schema").read_text("utf-8")))


def header(version: str = "3.0") -> dict[str, Any]:
    return {"headerId": 1, "timestamp": "2026-01-02T03:04:05.678Z", "version": RELEASES[version],
            "manufacturer": "fognav", "serialNumber": "r1"}  # fmt: skip


def node(name: str, sequence: int, x: float, y: float, *, released: bool = True, **more: Any) -> dict[str, Any]:
    position = {"x": x, "y": y, "mapId": "lab"} | more.pop("position", {})
    return {"nodeId": name, "sequenceId": sequence, "released": released, "actions": [], "nodePosition": position} | more


def order(*nodes: dict[str, Any], update: int = 0, name: str = "o1", edge: dict[str, Any] | None = None,
          version: str = "3.0", **more: Any) -> dict[str, Any]:  # fmt: skip
    edges = [
        {"edgeId": f"e{a['sequenceId'] + 1}", "sequenceId": a["sequenceId"] + 1, "released": b["released"],
         "actions": [], "startNodeId": a["nodeId"], "endNodeId": b["nodeId"], **(edge or {})}
        for a, b in zip(nodes, nodes[1:], strict=False)
    ]  # fmt: skip
    return header(version) | {"orderId": name, "orderUpdateId": update, "nodes": list(nodes), "edges": edges} | more


def read(message: dict[str, Any], topic: str = "order", version: str = "3.0") -> Any:
    return decoded(topic, json.dumps(message).encode(), version, "r1")


def instant(kind: str, name: str = "a1", **parameters: Any) -> InstantActions:
    found = [{"key": key, "value": value} for key, value in parameters.items()]
    action = {"actionType": kind, "actionId": name, "blockingType": "NONE", "actionParameters": found}
    return read(header() | {"actions": [action]}, "instantActions")


STATE = {"mode": "NORMAL", "enabled": True, "reasons": [], "codes": [], "battery": 0.5, "goal_id": None,
         "goal_reached": False, "awaits_operator": False, "wants_dock": False, "power": {"charging": "no"}}  # fmt: skip


class Floorplan:
    """A robot on a floor that takes missions as the planner does."""

    def __init__(self) -> None:
        self.robot = FleetRobot("r1", "lab")
        self.goal: dict[str, Any] | None = None
        self.asked: list[Request] = []
        self.state: dict[str, Any] = dict(STATE)
        self.more: dict[str, Any] = {}
        self.now = 100.0
        self.at(1.0, 1.0)
        self.tell()

    def at(self, x: float, y: float, v: float = 0.0) -> None:
        """Put the robot there."""
        self.robot.on_pose(
            {"x": x, "y": y, "theta": 0.0, "v": v, "w": 0.0, "covariance": [1e-4] * 9, "radius": 0.17, "height": 0.1,
             "localized": True}, self.now,
        )  # fmt: skip

    def tell(self, seconds: float = 1.0, **state: Any) -> None:
        """Let the robot tell its state, `seconds` later."""
        self.now += seconds
        self.state |= {"stamp": self.now, **state}
        self.robot.on_robot({"state": dict(self.state), "goal": self.goal, **self.more}, self.now)

    def drive(self, answer: Answer | None = None) -> list[str]:
        """Let the floor answer all that is asked; return it: PUT with the goal, DELETE."""
        first = len(self.asked)
        while (request := self.robot.step(self.now)) is not None:
            self.asked.append(request)
            if answer is not None:
                self.robot.on_answer(answer, self.now)
                break
            if request.method == "PUT":
                self.goal = {"goal_id": f"g{len(self.asked)}"}
                self.state |= {"goal_id": self.goal["goal_id"], "goal_reached": False}
                self.robot.on_answer(Answer("", body=self.goal), self.now)
            else:
                self.goal = None
                self.robot.on_answer(Answer(""), self.now)
        self.tell(0.1)
        bodies = [request.body["pose"] if request.body else None for request in self.asked[first:]]
        return [request.method if body is None else f"{request.method} {body['x']:g} {body['y']:g}"
                for request, body in zip(self.asked[first:], bodies, strict=True)]  # fmt: skip

    def reach(self, x: float, y: float) -> None:
        """Let the robot reach its goal, and the planner end the mission."""
        self.at(x, y)
        self.tell(goal_reached=True)
        self.goal = None
        self.tell(goal_id=None, goal_reached=False)

    def take(self, message: dict[str, Any]) -> str:
        """Give an order to the robot; return the error type by which it is rejected."""
        found = read(message)
        error = self.robot.checked(found, self.now)
        if error is None:
            self.robot.accept(found)
        return "" if error is None else error.error_type

    def said(self, version: str = "3.0") -> dict[str, Any]:
        """Return the robot's state as it is published."""
        state = telling.state(self.robot, self.now, 1.7e9)
        setup = Setup(site="lab", broker=Broker.of("mqtt://localhost"), version=version, interface="vda5050",
                      manufacturer="fognav", map_id="lab", robots=["r1"], zones=[])  # fmt: skip
        return json.loads(Sender(setup, version, "fognav", "r1").message("state", state, 1.7e9))

    def errors(self) -> dict[str, str]:
        """Return the types and levels of the state's errors."""
        return {each["errorType"]: each["errorLevel"] for each in self.said()["errors"]}


A, B, C = node("a", 0, 1.0, 1.0), node("b", 2, 4.0, 1.0), node("c", 4, 7.0, 1.0)

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


def test_new_order_has_to_begin_where_the_robot_is():
    floor = Floorplan()
    assert floor.take(order(node("a", 0, 1.4, 1.0), B)) == "START_NODE_OUT_OF_RANGE"
    wide = {"allowedDeviationXY": {"a": 0.5, "b": 0.5, "theta": 0.0}}
    assert floor.take(order(node("a", 0, 1.4, 1.0, position=wide), B, update=2)) == "VALIDATION_FAILURE"
    assert floor.take(order(node("a", 0, 1.4, 1.0, position=wide), B)) == ""


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
    floor.goal = {"goal_id": "g9"}
    floor.tell(2.0)
    assert floor.said()["operatingMode"] == "AUTOMATIC", "it may be the fleet's own"
    assert floor.drive(Answer("", body=floor.goal)) == ["PUT 4 1"]
    assert floor.asked[0] == floor.asked[1]
    assert (floor.said()["operatingMode"], floor.robot.goal_node) == ("AUTOMATIC", "b")


# --- Operators and instant actions ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mode", "state", "view"),
    [
        ("MANUAL", {"enabled": False, "mode": "HOLD"}, {}), ("MANUAL", {"awaits_operator": True, "mode": "FAULT"}, {}),
        ("MANUAL", {"mode": "TELEOP"}, {}), ("MANUAL", {"wants_dock": True}, {}), ("STARTUP", {"mode": "INIT"}, {}),
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
    floor.tell(**state)
    said = floor.said()
    assert (said["operatingMode"], said["nodeStates"], said["orderId"]) == (mode, [], "o1")
    assert any("fleet" in each["infoDescriptor"] or each["infoType"] == "NOT_IN_CONTROL" for each in said["information"])
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


def test_requests_are_answered_and_unknown_actions_fail():
    floor = Floorplan()
    assert floor.robot.on_instant(instant("factsheetRequest", "f"), floor.now) == ["state", "factsheet"]
    floor.robot.on_instant(instant("enableZoneSet", "z", zoneSetId="x"), floor.now)
    assert (actions(floor), floor.errors()) == ({"f": "FINISHED", "z": "FAILED"}, {"INVALID_INSTANT_ACTION": "WARNING"})
    for n in range(100):
        floor.robot.on_instant(instant("stateRequest", f"s{n}"), floor.now)
    assert (len(actions(floor)), floor.errors()) == (50, {})


# --- The norm's messages ----------------------------------------------------------------------------------------------


def driving() -> Floorplan:
    """A robot under way, with a path, errors and actions."""
    floor = Floorplan()
    floor.take(order(A, node("b", 2, 4.0, 1.0, position={"theta": 1.0}), C | {"released": False}))
    floor.drive()
    floor.at(1.5, 1.1, v=0.3)
    floor.robot.on_path([(1.0, 1.0), (3.0, 1.0), (4.0, 1.0)])
    floor.robot.on_instant(instant("startPause", "p"), floor.now)
    floor.robot.on_instant(instant("nonsense", "n"), floor.now)
    floor.take(order(A, B, name="o2"))
    floor.tell(0.1, codes=["battery_low"], reasons=["empty soon"], power={"voltage_v": 14.4, "current_a": -0.8})
    return floor


@pytest.mark.parametrize("version", VERSIONS)
def test_all_that_is_told_fits_the_published_schemas(version):
    floor = driving()
    schema(version, "state").validate(floor.said(version))
    schema(version, "state").validate(Floorplan().said(version))
    setup = Setup(site="lab", broker=Broker.of("mqtt://localhost"), version=version, interface="vda5050",
                  manufacturer="fognav", map_id="lab", robots=["r1"], zones=[])  # fmt: skip
    sender = Sender(setup, version, "fognav", "r1")
    told = {
        "factsheet": telling.factsheet(floor.robot, version),
        "visualization": telling.visualization(floor.robot, 3, 1.7e9),
        **{"connection": {"connectionState": word} for word in ("ONLINE", "OFFLINE", "CONNECTION_BROKEN")},
    }
    for topic, content in told.items():
        schema(version, topic).validate(json.loads(sender.message(topic, content, 1.7e9)))


def test_state_has_the_path_as_a_nurbs_from_where_the_robot_is_and_2_1_its_own_words():
    said = driving().said()
    assert said["plannedPath"]["traversedNodes"] == ["b"]
    path = said["plannedPath"]["trajectory"]
    assert path["controlPoints"] == [{"x": 1.5, "y": 1.1}, {"x": 3.0, "y": 1.0}, {"x": 4.0, "y": 1.0}]
    assert len(path["knotVector"]) == len(path["controlPoints"]) + path["degree"] + 1
    assert path["knotVector"] == sorted(path["knotVector"])
    old = driving().said("2.1")
    assert {"plannedPath", "instantActionStates", "powerSupply"}.isdisjoint(old)
    assert (old["agvPosition"]["positionInitialized"], old["batteryState"]["batteryCharge"]) == (True, 50.0)
    assert {each["errorType"] for each in old["errors"]} == {"orderError", "invalidInstantAction", "batteryLow"}


def damaged(rng: random.Random, message: dict[str, Any]) -> bytes:
    """Return a message with a few of its parts lost, replaced or repeated, or with damaged bytes."""
    rubbish = ("null", "true", "-1", str(2**70), "1e300", "0.5", '""', '"NaN"', '"\\u0000"', "[]", "[[]]", "{}", '{"x": {}}',
               json.dumps("x" * 300))  # fmt: skip

    def parts(value: Any) -> list[tuple[Any, Any]]:
        keys = value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        return [(value, key) for key in keys] + [part for key in keys for part in parts(value[key])]

    found = json.loads(json.dumps(message))
    for _ in range(rng.randint(1, 3)):
        if not (places := parts(found)):
            break
        holder, key = rng.choice(places)
        if rng.random() < 0.3:
            del holder[key]
        elif rng.random() < 0.2 and isinstance(holder, list):
            holder += [holder[key]] * rng.choice([1, 3, 200])
        else:
            holder[key] = json.loads(rng.choice(rubbish))
    data = bytearray(json.dumps(found).encode())
    for _ in range(rng.choice([0, 0, 1, 5])):
        data[rng.randrange(len(data))] = rng.randrange(256)
    return bytes(data[: rng.randrange(len(data))] if rng.random() < 0.1 else data)


def test_damaged_orders_and_actions_are_rejected_one_by_one_and_none_ends_anything():
    rng, floor, refused = random.Random(7), driving(), 0
    whole = order(A, B, C, edge={"maximumSpeed": 1.0, "orientation": 0.0}, zoneSetId="z")
    actions = header() | {"actions": [{"actionType": "cancelOrder", "actionId": "a", "blockingType": "NONE",
                                       "actionParameters": [{"key": "orderId", "value": "o1"}]}]}  # fmt: skip
    for n in range(DAMAGED):
        topic, message = ("order", whole) if n % 2 else ("instantActions", actions)
        try:
            found = decoded(topic, damaged(rng, message), rng.choice(VERSIONS), "r1")
        except MessageError as error:
            refused += 1
            floor.robot.on_malformed(topic, error)
        else:
            if isinstance(found, Order):
                floor.robot.checked(found, floor.now)
            else:
                floor.robot.on_instant(found, floor.now)
        if n % 100 == 0:
            floor.said(), floor.said("2.1")
    assert refused > DAMAGED * 0.6
    assert len(floor.said()["errors"]) < 12, "the latest of each type"


@pytest.mark.parametrize("version", VERSIONS)
def test_what_the_schema_of_orders_refuses_is_refused_but_for_null_in_place_of_what_may_be_left_out(version):
    rng, whole = random.Random(3), order(A, B, C, version=version)
    known = schema(version, "order")
    if version == "3.0":
        known.validate(whole)
    accepted = 0
    for _ in range(min(DAMAGED, 5000)):
        data = damaged(rng, whole)
        try:
            decoded("order", data, version, "r1")
        except MessageError:
            continue
        accepted += 1
        found = json.loads(data)
        lost = [e for e in known.iter_errors(found) if "NodeId" not in e.message and not e.message.startswith("null")]
        assert not lost, (lost[0], data)
    assert accepted
