"""Messages of a fleet control by VDA 5050, and a robot of Fognav on a floor that takes missions as the planner does."""

from __future__ import annotations

import json
import os
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from fog_bridges.floor import Answer, Request
from fog_bridges.vda5050 import telling
from fog_bridges.vda5050.connection import Sender, Setup
from fog_bridges.vda5050.incoming import RELEASES, InstantActions, decoded
from fog_bridges.vda5050.robot import FleetRobot
from fog_bridges.vda5050.uncertain import NOBODYS
from fog_runtime.transports.mqtt_connection import Broker

SCHEMAS = os.environ.get("FOGNAV_VDA5050_SCHEMAS", "")
"""A checkout of VDA5050/VDA5050 with the schemas of 3.0 (its branch main: the tag 3.0.0 has no valid JSON), and in its
`2.1.0` and `2.0.0` those of these tags."""
VERSIONS = ("3.0", "2.1", "2.0")


@cache
def schema(version: str, topic: str) -> jsonschema_rs.Validator:
    """Return the published schema of a topic."""
    if not SCHEMAS:
        pytest.skip("needs the schemas: git clone github.com/VDA5050/VDA5050 V, FOGNAV_VDA5050_SCHEMAS=V "
                    "(for 2.1 and 2.0 the tags 2.1.0 and 2.0.0 in V/2.1.0 and V/2.0.0)")  # fmt: skip
    folder = Path(SCHEMAS) / ("" if version == "3.0" else RELEASES[version]) / "json_schemas"
    return jsonschema_rs.validator_for(json.loads(next(folder.glob(f"{topic}.*")).read_text("utf-8")))


def header(version: str = "3.0") -> dict[str, Any]:
    return {"headerId": 1, "timestamp": "2026-01-02T03:04:05.678Z", "version": RELEASES[version],
            "manufacturer": "fognav", "serialNumber": "r1"}  # fmt: skip


def node(name: str, sequence: int, x: float, y: float, *, released: bool = True, **more: Any) -> dict[str, Any]:
    position = {"x": x, "y": y, "mapId": "lab"} | more.pop("position", {})
    return {
        "nodeId": name,
        "sequenceId": sequence,
        "released": released,
        "actions": [],
        "nodePosition": position,
    } | more


def order(*nodes: dict[str, Any], update: int = 0, name: str = "o1", edge: dict[str, Any] | None = None,
          version: str = "3.0", **more: Any) -> dict[str, Any]:  # fmt: skip
    edges = [
        {"edgeId": f"e{a['sequenceId'] + 1}", "sequenceId": a["sequenceId"] + 1, "released": b["released"],
         "actions": [], "startNodeId": a["nodeId"], "endNodeId": b["nodeId"], **(edge or {})}
        for a, b in pairwise(nodes)
    ]  # fmt: skip
    return header(version) | {"orderId": name, "orderUpdateId": update, "nodes": list(nodes), "edges": edges} | more


def read(message: dict[str, Any], topic: str = "order", version: str = "3.0") -> Any:
    return decoded(topic, json.dumps(message).encode(), version, "r1")


def instant(kind: str, name: str = "a1", **parameters: Any) -> InstantActions:
    found = [{"key": key, "value": value} for key, value in parameters.items()]
    action = {"actionType": kind, "actionId": name, "blockingType": "NONE", "actionParameters": found}
    return read(header() | {"actions": [action]}, "instantActions")


def action(kind: str, name: str) -> dict[str, Any]:
    return {"actionType": kind, "actionId": name, "blockingType": "HARD", "actionParameters": []}


DOCK = {"dock": {"x": 4.7, "y": 1.0, "theta": 0.0}}
SETUP = Setup(
    site="lab", broker=Broker.of("mqtt://localhost"), version="3.0", interface="vda5050", manufacturer="fognav",
    map_id="lab", robots=["r1"], zones=[],
)  # fmt: skip
STATE = {"mode": "NORMAL", "enabled": True, "reasons": [], "codes": [], "battery": 0.5, "goal_id": None,
         "goal_reached": False, "awaits_operator": False, "wants_dock": False, "power": {"charging": "no"}}  # fmt: skip


def _about(body: dict[str, Any]) -> list[str]:
    pose = body.get("pose", {})
    return [body["kind"]] if "kind" in body else [f"{pose[name]:g}" for name in ("x", "y") if name in pose]


class Floorplan:
    """A robot on a floor that takes missions as the planner does."""

    def __init__(self) -> None:
        self.robot = FleetRobot("r1", "lab")
        self.goal: dict[str, Any] | None = None
        self.asked: list[Request] = []
        self.begun: dict[str, dict[str, Any]] = {}
        """Missions by the keys of their requests."""
        self.state: dict[str, Any] = dict(STATE)
        self.more: dict[str, Any] = {}
        self.now = 100.0
        self.robot.on_known(self.now)
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
        """Let the floor answer all that is asked; return it: PUT with the goal, POST with the command, DELETE."""
        first = len(self.asked)
        while (request := self.robot.step(self.now)) is not None:
            self.asked.append(request)
            if answer is not None:
                self.robot.on_answer(answer, self.now)
                break
            if request.method == "PUT":
                key = request.headers["Idempotency-Key"]
                if key not in self.begun and request.headers.get("If-Match") == NOBODYS:
                    self.robot.on_answer(Answer("robot r1 has no mission", "mission_changed"), self.now)
                    continue
                if key not in self.begun:
                    self.begin(request)
                self.robot.on_answer(Answer("", body=self.begun[key]), self.now)
            elif request.method == "DELETE":
                has_it = self.goal is not None and request.headers["If-Match"] == f'"{self.goal["goal_id"]}"'
                self.goal = None if has_it else self.goal
                self.robot.on_answer(Answer("") if has_it else Answer("it has none", "mission_changed"), self.now)
            else:
                self.robot.on_answer(Answer(""), self.now)
        self.tell(0.1)
        return [" ".join([request.method, *_about(request.body or {})]) for request in self.asked[first:]]

    def begin(self, request: Request) -> None:
        """Let the mission begin that a request has asked for."""
        self.goal = {"goal_id": f"g{len(self.asked)}", "pose": request.body["pose"]}
        self.begun[request.headers["Idempotency-Key"]] = self.goal
        self.state |= {"goal_id": self.goal["goal_id"], "goal_reached": False}

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
        return json.loads(Sender(SETUP, version, "fognav", "r1").message("state", state, 1.7e9))

    def errors(self) -> dict[str, str]:
        """Return the types and levels of the state's errors."""
        return {each["errorType"]: each["errorLevel"] for each in self.said()["errors"]}


A, B, C = node("a", 0, 1.0, 1.0), node("b", 2, 4.0, 1.0), node("c", 4, 7.0, 1.0)


def driving() -> Floorplan:
    """A robot under way, with a path, errors and actions."""
    floor = Floorplan()
    floor.more = DOCK
    floor.tell()
    charge = [action("startCharging", "c")]
    floor.take(order(A, node("b", 2, 4.0, 1.0, position={"theta": 1.0}), C | {"released": False, "actions": charge}))
    floor.drive()
    floor.at(1.5, 1.1, v=0.3)
    floor.robot.on_path([(1.0, 1.0), (3.0, 1.0), (4.0, 1.0)])
    floor.robot.on_instant(instant("startPause", "p"), floor.now)
    floor.robot.on_instant(instant("nonsense", "n"), floor.now)
    floor.take(order(A, B, name="o2"))
    floor.tell(0.1, codes=["battery_low"], reasons=["empty soon"], power={"voltage_v": 14.4, "current_a": -0.8})
    return floor


RING = [[1.0, 1.0], [2.0, 1.0], [2.0, 2.0]]


def area(state: str | None, penalty: int = 0, on_map: dict[str, Any] | str | None = "the same") -> dict[str, Any]:
    """An area as the console tells of it; `on_map`: what the map-service shows, None while nobody knows."""
    hazard = None if state is None else {"state": state, "penalty": penalty}
    if on_map == "the same":
        on_map = None if hazard is None else {**hazard, "confirmed": True}
    return {"definition": {"polygon": RING, "unknown": {"penalty": 200}}, "hazard": hazard, "on_map": on_map}
