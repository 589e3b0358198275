"""A robot of Fognav as a fleet control sees it, and what that may have it do. Pure.

The fleet drives the robot by missions that only replace its own. What an operator of Fognav does wins: a stop, another
mission, taking out of service or by hand end the fleet's order, and the operating mode says that the fleet is not in
control (6.6.6) until the robot is free for it again. Nothing of the fleet enables or resets a robot.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any, Final, Literal
from uuid import uuid4

from fog_bridges.floor import Request
from fog_bridges.vda5050.orders import START_M, Orders, Situation, Where, about_error, goal_of, is_within, rejection
from fog_bridges.vda5050.outgoing import ActionState, Error, OperatingMode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_bridges.floor import Answer
    from fog_bridges.vda5050.incoming import Action, InstantActions, MessageError, Node, Order

SPEED_M_S: Final = 0.3
"""The highest speed of a robot of Fognav."""
SILENT_S: Final = 5.0
"""A robot that tells no state for so long is not there."""
RETRY_S: Final = 1.0
UNSEEN_S: Final = 5.0
"""A mission that was accepted and is not told of for so long has ended already."""
REFUSED_S: Final = 5.0
"""Without any path for so long, the robot gives up a node, as the norm wants: the fleet decides."""
TAKEN_S: Final = 2.0
"""How long the operating mode says that an operator has ended a mission."""
STILL: Final = (0.01, 0.05)
"""A robot that moves no faster (m/s, rad/s) stands."""
INSTANT_MAX: Final = 50
Wish = Literal["state", "factsheet"]
"""What is to be published as an instant action asks for it."""
_UNCERTAIN: Final = ("", "service_silent", "store_uncertain")
"""Problems of requests that may have been carried out."""
_BY_HAND: Final = {
    "TELEOP": "it is driven by hand", "DOCK": "it docks", "EGRESS": "it leaves a blocked area on an operator's command",
}  # fmt: skip


class FleetRobot:
    """One robot under a fleet control."""

    def __init__(self, robot: str, map_id: str) -> None:
        self.robot = robot
        self.map_id = map_id
        self.orders = Orders()
        self.view: dict[str, Any] = {"state": None, "goal": None}
        self.pose: dict[str, Any] | None = None
        self.path: list[tuple[float, float]] = []
        self.places: Mapping[str, Where] = {}
        self.paused = False
        self.pending: Order | None = None
        """The order whose nodes are being looked for on the map."""
        self.instant: dict[str, ActionState] = {}
        self.path_changes = 0
        self._about_errors: dict[str, Error] = {}
        self._instant_error: Error | None = None
        self._unavailable: Error | None = None
        self._unreachable: Error | None = None
        self._heard = -math.inf
        self._goal = ""
        """The fleet's mission, by its id; empty without one."""
        self._goal_node = -1
        self._own: deque[str] = deque(maxlen=32)
        self._is_seen = False
        self._asked_at = -math.inf
        self._asking: Request | None = None
        self._asked_for: Node | None = None
        self._unsure: tuple[Request, Node | None] | None = None
        """A mission that may have been accepted: asked for again, by the same key, before anything else."""
        self._retry_at = -math.inf
        self._refused_since: float | None = None
        self._taken_until = -math.inf
        self._mode: OperatingMode = "STARTUP"

    # --- What the floor tells -----------------------------------------------------------------------------------------

    def on_robot(self, view: dict[str, Any], now: float) -> None:
        """Take in the robot's state, mission and plan."""
        before = (self.view["state"] or {}).get("stamp")
        if (view["state"] or {}).get("stamp") != before:
            self._heard = now
        self.view = view
        self.advance(now)

    def on_pose(self, pose: dict[str, Any], now: float) -> None:
        """Take in where the robot is."""
        self.pose = pose
        self.advance(now)

    def on_path(self, points: list[tuple[float, float]]) -> None:
        """Take in the robot's path (m)."""
        self.path = points
        self.path_changes += 1

    def is_there(self, now: float) -> bool:
        """Whether the robot itself is heard of."""
        return now - self._heard < SILENT_S

    @property
    def state(self) -> dict[str, Any]:
        """The robot's own state; empty before the first one."""
        return self.view["state"] or {}

    @property
    def at(self) -> Where | None:
        """Where the robot is, if it knows."""
        pose = self.pose
        return None if pose is None or not pose["localized"] else Where(pose["x"], pose["y"], pose["theta"])

    @property
    def _is_asking(self) -> bool:
        """Whether a mission may be the fleet's before it is known by its id."""
        return self._asking is not None or self._unsure is not None

    @property
    def is_driving(self) -> bool:
        """Whether it moves."""
        return self.pose is not None and (abs(self.pose["v"]) > STILL[0] or abs(self.pose["w"]) > STILL[1])

    def mode(self, now: float) -> tuple[OperatingMode, str]:
        """Return the operating mode, and in words why the fleet is not in control; empty if it is."""
        state, goal, out = self.state, self.view["goal"], self.view.get("out_of_service")
        if not state:
            return "STARTUP", "it has not told its state yet"
        is_foreign = goal is not None and goal["goal_id"] not in self._own and not self._is_asking
        reasons: tuple[tuple[bool, OperatingMode, str], ...] = (
            (out is not None, "SERVICE", f"an operator has taken it out of service: {(out or {}).get('reason')}"),
            (is_foreign, "MANUAL", "it has a mission of an operator of Fognav"),
            (state["mode"] == "INIT", "STARTUP", "it is starting, and does not know where it is"),
            (state["mode"] in _BY_HAND, "MANUAL", _BY_HAND.get(state["mode"], "")),
            (bool(state.get("wants_dock")), "MANUAL", "it is on its way to its dock"),
            (bool(state.get("docked")), "MANUAL", "it stands on its dock: an operator of Fognav undocks it"),
            (
                bool(state.get("awaits_operator")) or not state["enabled"],
                "MANUAL",
                "it waits for an operator of Fognav, who enables it",
            ),
            (now < self._taken_until, "MANUAL", "an operator of Fognav has ended its mission"),
        )
        return next(((mode, words) for holds, mode, words in reasons if holds), ("AUTOMATIC", ""))

    # --- Orders -------------------------------------------------------------------------------------------------------

    def situation(self, now: float) -> Situation:
        """Return what an order has to fit."""
        mode, words = self.mode(now)
        unavailable = "" if mode == "AUTOMATIC" else f"the fleet is not in control ({mode}): {words}"
        if not self.is_there(now):
            unavailable = "the robot is not there"
        height = 0.0 if self.pose is None else self.pose["height"]
        return Situation(unavailable, self.at, self.map_id, self.places, SPEED_M_S, height)

    def checked(self, order: Order, now: float) -> Error | None:
        """Return why an order is rejected by what is known here, and remember that for the state."""
        error = self.orders.why_not(order, self.situation(now))
        if error is not None:
            self.reject(error)
        return error

    def goals(self, order: Order) -> list[tuple[Node, Where]]:
        """Return the nodes that an order releases anew, and where they are."""
        found = [(node, goal_of(node, self.places)) for node in order.nodes[1:] if node.released]
        return [(node, goal) for node, goal in found if goal is not None]

    def accept(self, order: Order) -> None:
        """Take over an order."""
        self.orders.accept(order)
        self._about_errors.clear()
        self._unreachable = self._unavailable = None
        if self._instant_error is not None and self._instant_error.error_type == "NO_ORDER_TO_CANCEL":
            self._instant_error = None
        self._refused_since = None

    def reject(self, error: Error) -> None:
        """Show that an order was rejected: the latest one by each reason."""
        if error.error_type == "MOBILE_ROBOT_NOT_AVAILABLE":
            self._unavailable = error
        else:
            self._about_errors[error.error_type] = error

    def reject_route(self, order: Order, node: Node, words: str) -> None:
        """Reject an order that has a node which can't be reached."""
        self.reject(rejection(order, "NO_ROUTE_TO_TARGET", f"node {node.node_id}: {words}", nodeId=node.node_id))

    def on_malformed(self, topic: str, error: MessageError) -> None:
        """Show that a message could not be read."""
        about = {"topic": topic} | ({"orderId": error.order} if error.order else {})
        if error.update is not None:
            about["orderUpdateId"] = str(error.update)
        found = about_error("VALIDATION_FAILURE", str(error), about)
        if topic == "order":
            self.reject(found)
        else:
            self._instant_error = found

    # --- Instant actions ----------------------------------------------------------------------------------------------

    def on_instant(self, message: InstantActions, now: float) -> list[Wish]:
        """Carry out instant actions; return what is to be published."""
        wishes: list[Wish] = ["state"]
        for action in message.actions:
            if action.action_id in self.instant:
                continue  # sent again
            refused = self._act(action, now, wishes)
            if refused is None:
                if self._instant_error is not None and self._instant_error.error_type != "NO_ORDER_TO_CANCEL":
                    self._instant_error = None
            else:
                kind, words = refused
                self._set(action.action_id, action.action_type, "FAILED", words)
                self._instant_error = about_error(kind, words, {"actionId": action.action_id})
        self.advance(now)
        return wishes

    def _act(self, action: Action, now: float, wishes: list[Wish]) -> tuple[str, str] | None:
        """Carry out an action; return error type and words of why that can't be."""
        kind, mode = action.action_type, self.mode(now)
        if kind == "stateRequest":
            self._set(action.action_id, kind, "FINISHED")
        elif kind == "factsheetRequest":
            wishes.append("factsheet")
            self._set(action.action_id, kind, "FINISHED")
        elif kind == "clearInstantActions":
            self.instant = {name: each for name, each in self.instant.items() if each.action_status == "RUNNING"}
            self._set(action.action_id, kind, "FINISHED")
        elif kind == "cancelOrder":
            wanted = action.parameter("orderId")
            order = self.pending.order_id if self.pending is not None else self.orders.order_id
            if (self.orders.is_idle and self.pending is None) or wanted not in (None, order):
                return "NO_ORDER_TO_CANCEL", "there is no such active order"
            self.pending = None
            self.orders.clear()
            self._unreachable = None
            self._set(action.action_id, kind, "RUNNING")
        elif kind in ("startPause", "stopPause"):
            if mode[0] != "AUTOMATIC":
                return "INVALID_INSTANT_ACTION", f"the fleet is not in control: {mode[1]}"
            self.paused = kind == "startPause"
            for name, each in list(self.instant.items()):
                if each.action_type == "startPause" and each.action_status == "RUNNING":
                    self._set(name, each.action_type, "FAILED", "stopPause came first")
            self._set(action.action_id, kind, "RUNNING" if self.paused else "FINISHED")
        else:
            return "INVALID_INSTANT_ACTION", f"a robot of Fognav can't {kind[:60]}"
        return None

    def _set(self, name: str, kind: str, status: Literal["RUNNING", "FINISHED", "FAILED"], result: str = "") -> None:
        self.instant.pop(name, None)
        self.instant[name] = ActionState(action_id=name, action_type=kind, action_status=status, action_result=result)
        if len(self.instant) > INSTANT_MAX:
            done = (key for key, each in self.instant.items() if each.action_status != "RUNNING")
            self.instant.pop(next(done, next(iter(self.instant))))

    # --- The mission that the order needs -----------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Follow what has become of the mission and of the fleet's control."""
        self._judge(now)
        mode, _ = self.mode(now)
        if mode != "AUTOMATIC" and not self.orders.is_idle:
            self.orders.clear()
        if mode != "AUTOMATIC":
            self.paused, self.pending = False, None
        else:
            self._unavailable = None
        if mode in ("SERVICE", "STARTUP"):
            self.orders.last_node_id = ""
        self._mode = mode
        self._pass_nodes()
        if not self.is_driving and not self._goal and not self._is_asking:
            for name, each in list(self.instant.items()):
                if each.action_status == "RUNNING":
                    self._set(name, each.action_type, "FINISHED")

    def _judge(self, now: float) -> None:
        """Find out whether the mission was reached, or ended by somebody else."""
        if not self._goal or self._is_asking:
            return
        goal, state = self.view["goal"], self.state
        is_reached = state.get("goal_id") == self._goal and bool(state.get("goal_reached"))
        if goal is not None and goal["goal_id"] == self._goal:
            self._is_seen = True
        elif not self._is_seen and now - self._asked_at < UNSEEN_S:
            return  # what is told is older than the mission
        elif not is_reached and not self._is_near():
            self._goal = ""
            self._taken_until = now + TAKEN_S
            words = "an operator of Fognav has ended the mission, and so the order"
            self._about_errors["ORDER_ENDED"] = about_error("ORDER_ENDED", words, {"orderId": self.orders.order_id})
            self.orders.clear()
            return
        else:
            is_reached = True
        if is_reached:
            self._goal = ""
            self.orders.traversed(self._goal_node)
        self._watch_plan(now)

    def _watch_plan(self, now: float) -> None:
        plan = self.view.get("plan") or {}
        refusal = plan.get("refusal") if self._goal else None
        if refusal is None:
            self._refused_since = None
        elif self._refused_since is None:
            self._refused_since = now
        elif now - self._refused_since > REFUSED_S and (node := self._node(self._goal_node)) is not None:
            self._give_up(node, refusal["reason"])

    def _give_up(self, node: Node, words: str) -> None:
        self._unreachable = about_error("NODE_UNREACHABLE", words, {"nodeId": node.node_id}, "CRITICAL")

    def _node(self, sequence: int) -> Node | None:
        return next((node for node in self.orders.nodes if node.sequence_id == sequence), None)

    def _is_near(self) -> bool:
        node, at = self._node(self._goal_node), self.at
        goal = None if node is None else goal_of(node, self.places)
        return goal is not None and at is not None and math.dist(goal[:2], at[:2]) <= START_M

    def _pass_nodes(self) -> None:
        """Traverse nodes that more of the base follows as soon as the robot is within their deviation: it drives on."""
        while (node := self.orders.target) is not None and self.at is not None and not self.paused:
            goal = goal_of(node, self.places)
            follows = any(each.released and each.sequence_id > node.sequence_id for each in self.orders.nodes)
            if goal is None or not follows or not is_within(node, goal, self.at):
                return
            self.orders.traversed(node.sequence_id)

    def step(self, now: float) -> Request | None:
        """Return the next request to the floor; None: there is nothing to ask, or an answer is waited for."""
        if self._asking is not None or now < self._retry_at:
            return None
        if self._unsure is not None:
            (self._asking, self._asked_for), self._asked_at = self._unsure, now
            return self._asking
        node = self.orders.target
        if self._mode != "AUTOMATIC" or self.paused or self._unreachable is not None:
            node = None
        goal = None if node is None else goal_of(node, self.places)
        path = f"/api/v1/robots/{self.robot}/goal"
        if node is None or goal is None:
            if not self._goal:
                return None
            request = Request("DELETE", path, headers={"If-Match": f'"{self._goal}"'})
        elif self._goal and self._goal_node == node.sequence_id:
            return None
        else:
            pose = {"x": goal.x, "y": goal.y} | ({} if goal.theta is None else {"theta": goal.theta})
            headers = {"If-Match": f'"{self._goal}"'} if self._goal else {"If-None-Match": "*"}
            request = Request("PUT", path, {"pose": pose}, headers | {"Idempotency-Key": uuid4().hex})
        self._asking, self._asked_for, self._asked_at = request, node, now
        return request

    def on_answer(self, answer: Answer, now: float) -> None:
        """Take in the answer to the request that `step` returned."""
        request, node = self._asking, self._asked_for
        self._asking = self._unsure = None
        if request is None:
            return
        if request.method == "PUT" and "goal_id" in answer.body and node is not None:
            self._goal, self._goal_node = answer.body["goal_id"], node.sequence_id
            self._own.append(self._goal)
            self._is_seen, self._refused_since = False, None
        elif request.method == "DELETE" and (not answer.refusal or answer.problem in ("no_mission", "mission_changed")):
            self._goal = ""
        elif answer.problem == "goal_refused" and node is not None:
            self._give_up(node, answer.refusal)
        else:
            self._retry_at = now + RETRY_S
            if request.method == "PUT" and answer.problem in _UNCERTAIN:
                self._unsure = request, node
        self.advance(now)

    @property
    def goal_node(self) -> str:
        """The node that the robot drives to; empty if it drives to none."""
        node = self._node(self._goal_node) if self._goal else None
        return "" if node is None else node.node_id

    def errors(self) -> list[Error]:
        """Return what the fleet has to know of its messages."""
        own = (self._unavailable, self._instant_error, self._unreachable)
        return [*self._about_errors.values(), *(each for each in own if each is not None)]
