"""A robot of Fognav as a fleet control sees it, and what that may have it do. Pure.

The fleet drives the robot by missions that only replace its own. What an operator of Fognav does wins: a stop, another
mission, taking out of service or by hand end the fleet's order, and the operating mode says that the fleet is not in
control (6.6.6) until the robot is free for it again. Nothing of the fleet enables or resets a robot.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, Literal
from uuid import uuid4

from fog_bridges.floor import Request
from fog_bridges.vda5050.charging import Charging, drop_done, remember_action
from fog_bridges.vda5050.orders import Orders, Situation, Where, about_error, goal_of, is_within, remember
from fog_bridges.vda5050.uncertain import UNCERTAIN, UNSEEN_S, Uncertain
from fog_bridges.vda5050.watched import Doings, Watched, mode_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_bridges.floor import Answer
    from fog_bridges.vda5050.incoming import Action, InstantActions, MessageError, Node, Order
    from fog_bridges.vda5050.outgoing import ActionState, Error, OperatingMode

SPEED_M_S: Final = 0.3
"""The highest speed of a robot of Fognav."""
RETRY_S: Final = 1.0
REFUSED_S: Final = 5.0
"""Without any path for so long, the robot gives up a node, as the norm wants: the fleet decides."""
TAKEN_S: Final = 2.0
"""How long the operating mode says that an operator has ended a mission."""
Wish = Literal["state", "factsheet"]
"""What is to be published as an instant action asks for it."""


class FleetRobot(Watched):
    """One robot under a fleet control."""

    def __init__(self, robot: str, map_id: str) -> None:
        super().__init__()
        self.robot = robot
        self.map_id = map_id
        self.orders = Orders()
        self.charging = Charging(robot)
        self.places: Mapping[str, Where] = {}
        self.paused = False
        self.pending: Order | None = None
        """The order whose nodes are being looked for on the map."""
        self.waiting: list[Order] = []
        """The orders after it, in which a cancel counts as well."""
        self.instant: dict[str, ActionState] = {}
        self._about_errors: dict[str, Error] = {}
        self._instant_error: Error | None = None
        self._unavailable: Error | None = None
        self._unreachable: Error | None = None
        self._goal = ""
        """The fleet's mission, by its id; empty without one."""
        self._goal_node: Node | None = None
        """Where it leads: a node of the order, or of one before it, which may have had the same sequenceIds."""
        self._own: dict[str, bool] = {}
        """The fleet's latest missions, and whether they are certainly over."""
        self._shown_at = -math.inf
        """When its mission was last shown, accepted, or could be shown again."""
        self._asked_at = -math.inf
        self._ends: dict[str, bool] = {}
        """Missions of the robot that are told to have ended, and whether they were reached."""
        self._asking: Request | None = None
        self._asked_for: Node | None = None
        self._unsure: Uncertain | None = None
        """A mission that may have been accepted: asked for again, by the same key, as long as its node is wanted."""
        self._sent_at = -math.inf
        """When the request was sent whose answer is waited for."""
        self._retry_at = -math.inf
        self._refused_since: float | None = None
        self._taken_until = -math.inf
        self._mode: OperatingMode = "STARTUP"

    # --- What the floor tells -----------------------------------------------------------------------------------------

    def on_robot(self, view: dict[str, Any], now: float) -> None:
        """Take in the robot's state, mission and plan."""
        self.watch(view, now)
        if (state := self.state).get("goal_reached") and state.get("goal_id"):
            remember(self._ends, state["goal_id"], value=True)
        self.advance(now)

    def on_end(self, mission: str, now: float, *, reached: bool) -> None:
        """Take in from the audit trail that a mission has ended: the state that says so may have been left out."""
        remember(self._ends, mission, value=reached or self._ends.get(mission, False))
        self.advance(now)

    def on_known(self, now: float) -> None:
        """Take in that the floor's state is known, after it was not."""
        self.is_known, self._shown_at = True, now
        self.advance(now)

    def on_pose(self, pose: dict[str, Any], now: float) -> None:
        """Take in where the robot is."""
        self.pose = pose
        self.advance(now)

    @property
    def _is_asking(self) -> bool:
        """Whether a mission may be the fleet's before it is known by its id."""
        return self._asking is not None or self._unsure is not None

    def _may_be_own(self, goal: dict[str, Any]) -> bool:
        """Whether a mission that is shown may be the one that the fleet asks for, whose id is not known yet."""
        request = self._asking if self._unsure is None else self._unsure.request
        if request is None or request.method != "PUT" or request.body is None:
            return False
        wanted, found = request.body["pose"], goal["pose"]
        return math.dist((wanted["x"], wanted["y"]), (found["x"], found["y"])) < 0.01

    @property
    def _way_home(self) -> str:
        """The planner's own mission to where the robot stays, while it is to wait for the fleet; empty without one."""
        goal = self.view["goal"] or {}
        return goal["goal_id"] if goal.get("idle") and (self.paused or not self.orders.is_idle) else ""

    def mode(self, now: float) -> tuple[OperatingMode, str]:
        """Return the operating mode, and in words why the fleet is not in control; empty if it is."""
        goal = self.view["goal"]
        is_own = goal is None or goal.get("idle") or goal["goal_id"] in self._own or self._may_be_own(goal)
        is_foreign = not is_own and not self.charging.is_way(self.view)
        doings = Doings(is_foreign, bool(self._goal), self.charging.kind, now < self._taken_until)
        return mode_of(self.view, doings)

    # --- Orders -------------------------------------------------------------------------------------------------------

    def situation(self, now: float) -> Situation:
        """Return what an order has to fit."""
        mode, words = self.mode(now)
        unavailable = "" if mode == "AUTOMATIC" else f"the fleet is not in control ({mode}): {words}"
        if not self.is_known or not self.is_there(now):
            unavailable = "the robot is not there"
        elif self.charging.kind and self.orders.is_idle:
            unavailable = unavailable or f"{self.charging.kind} comes first: cancelOrder ends it"
        height = 0.0 if self.pose is None else self.pose["height"]
        dock = self.has_dock, bool(self.state.get("docked"))
        return Situation(unavailable, self.at, self.map_id, self.places, SPEED_M_S, height, *dock)

    def checked(self, order: Order, now: float) -> Error | None:
        """Return why an order is rejected by what is known here, and remember that for the state."""
        error = self.orders.why_not(order, self.situation(now))
        if error is not None:
            self.reject(error)
        return error

    def accept(self, order: Order) -> None:
        """Take over an order."""
        self.orders.accept(order)
        self._about_errors.clear()
        self._unreachable = self._unavailable = self._refused_since = None
        if self._instant_error is not None and self._instant_error.error_type == "NO_ORDER_TO_CANCEL":
            self._instant_error = None

    def reject(self, error: Error) -> None:
        """Show that an order was rejected: the latest one by each reason."""
        if error.error_type == "MOBILE_ROBOT_NOT_AVAILABLE":
            self._unavailable = error
        else:
            self._about_errors[error.error_type] = error

    def on_malformed(self, topic: str, error: MessageError) -> None:
        """Show that a message could not be read."""
        update = "" if error.update is None else str(error.update)
        about = {"topic": topic, "orderId": error.order, "orderUpdateId": update}
        found = about_error("VALIDATION_FAILURE", str(error), {name: value for name, value in about.items() if value})
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
                remember_action(self.instant, action.action_id, action.action_type, "FAILED", words)
                self._instant_error = about_error(kind, words, {"actionId": action.action_id})
        self.advance(now)
        return wishes

    def _act(self, action: Action, now: float, wishes: list[Wish]) -> tuple[str, str] | None:
        """Carry out an action; return error type and words of why that can't be."""
        kind, mode = action.action_type, self.mode(now)
        if kind in ("stateRequest", "factsheetRequest", "clearInstantActions"):
            wishes += ["factsheet"] if kind == "factsheetRequest" else []
            if kind == "clearInstantActions":
                drop_done(self.instant)
            remember_action(self.instant, action.action_id, kind, "FINISHED")
        elif kind == "cancelOrder":
            if not self._cancel(action.parameter("orderId")):
                return "NO_ORDER_TO_CANCEL", "there is no such active order"
            remember_action(self.instant, action.action_id, kind, "RUNNING")
        elif kind in ("startPause", "stopPause"):
            if mode[0] != "AUTOMATIC":
                return "INVALID_INSTANT_ACTION", f"the fleet is not in control: {mode[1]}"
            if kind == "startPause" and self.charging.kind:
                return "INVALID_INSTANT_ACTION", f"{self.charging.kind} can't pause: cancelOrder ends it"
            self._pause(action)
        else:
            is_ordered = self.pending is not None or not self.orders.is_idle
            if words := self.charging.why_not(kind, mode, has_dock=self.has_dock, is_ordered=is_ordered):
                return "INVALID_INSTANT_ACTION", words
            remember_action(self.instant, action.action_id, kind, "RUNNING")
            self.charging.begin(self.instant, action.action_id, kind)
        return None

    def _pause(self, action: Action) -> None:
        self.paused = action.action_type == "startPause"
        for name, each in list(self.instant.items()):
            if not self.paused and each.action_type == "startPause" and each.action_status == "RUNNING":
                remember_action(self.instant, name, each.action_type, "FAILED", "stopPause came first")
        remember_action(self.instant, action.action_id, action.action_type, "RUNNING" if self.paused else "FINISHED")

    def _cancel(self, wanted: object) -> bool:
        """End the orders of an id, or all (None); return whether there were any."""
        waiting, active = self.waiting, self.orders.order_id if self.pending is None else self.pending.order_id
        self.waiting = [order for order in waiting if wanted not in (None, order.order_id)]
        is_busy = self.pending is not None or not self.orders.is_idle or bool(self.charging.kind)
        if is_active := is_busy and wanted in (None, active):
            self.pending = self._unreachable = None
            self.orders.clear()
            self.charging.cancel()
        return is_active or len(self.waiting) < len(waiting)

    # --- The mission that the order needs -----------------------------------------------------------------------------

    def advance(self, now: float) -> None:
        """Follow what has become of the mission and of the fleet's control, while the floor tells of both."""
        if not self.is_known or not self.state:
            return
        self._judge(now)
        self.charging.advance(self.state, now)
        mode, words = self.mode(now)
        if mode != "AUTOMATIC":
            if self.state.get("wants_dock") and not self.orders.is_idle:
                self._tell_end(f"the fleet is not in control, which has ended the order: {words}")
            self.orders.clear()
            self.charging.end("FAILED", f"the fleet is not in control: {words}")
            self.paused, self.pending = False, None
        else:
            self._unavailable = None
        if mode in ("SERVICE", "STARTUP"):
            self.orders.last_node_id = ""
        self._mode = mode
        self._pass_nodes()
        if (due := self.orders.due) is not None and not self.paused and not self.charging.kind:
            self.charging.begin(self.orders.actions, due.action_id, due.action_type)
            self.charging.advance(self.state, now)
        if not (self.is_driving or self._goal or self._way_home or self.charging.kind):
            self._end_instant(now)

    def _end_instant(self, now: float) -> None:
        """Tell what became of the actions that wait for the robot to stand, once it is known, or has long not been."""
        doubt = self.charging.doubt
        if self._unsure is not None and (self.paused or self.orders.is_idle):
            doubt = doubt or self._unsure.doubt(now)
        if self._is_asking and not doubt:
            return
        self.charging.doubt = ""
        for name, each in list(self.instant.items()):
            if each.action_status == "RUNNING":
                remember_action(self.instant, name, each.action_type, "FAILED" if doubt else "FINISHED", doubt)

    def _judge(self, now: float) -> None:
        """Find out whether the mission was reached, or ended by somebody else: only the robot's word is proof.

        The state that says "reached" stands for a moment only, so it may come late, or by the audit trail alone.
        """
        if not self._goal or self._is_asking:
            return
        goal, end = self.view["goal"] or {"goal_id": ""}, self._ends.get(self._goal)
        shown = goal["goal_id"]
        is_foreign = shown not in ("", *self._own) and not goal.get("idle")
        if end:
            self._drop(is_over=True)
            if (node := self._ahead(self._goal_node)) is not None:
                self.orders.traversed(node.sequence_id)
        elif shown == self._goal:
            self._shown_at = now
        elif end is False or is_foreign or now - self._shown_at >= UNSEEN_S:
            self._drop(is_over=end is False)
            if self.orders.is_idle or self._goal_node is None:
                return  # it was to end
            self._taken_until = now + TAKEN_S
            self._tell_end("an operator of Fognav has ended the mission, and so the order")
            self.orders.clear()
        self._watch_plan(now)

    def _tell_end(self, words: str) -> None:
        self._about_errors["ORDER_ENDED"] = about_error("ORDER_ENDED", words, {"orderId": self.orders.order_id})

    def _drop(self, *, is_over: bool) -> None:
        """Take the mission for ended; `is_over`: it can't be shown again but by what was told before its end."""
        remember(self._own, self._goal, value=is_over)
        self._goal = ""

    def _watch_plan(self, now: float) -> None:
        plan = self.view.get("plan") or {}
        refusal = plan.get("refusal") if self._goal else None
        if refusal is None:
            self._refused_since = None
        elif self._refused_since is None:
            self._refused_since = now
        elif now - self._refused_since > REFUSED_S and (node := self._ahead(self._goal_node)) is not None:
            self._give_up(node, refusal["reason"])

    def _give_up(self, node: Node, words: str) -> None:
        self._unreachable = about_error("NODE_UNREACHABLE", words, {"nodeId": node.node_id}, "CRITICAL")

    def _ahead(self, node: Node | None) -> Node | None:
        """Return a node if it still is the order's, and lies ahead."""
        return next((each for each in self.orders.nodes if each is node), None)

    def _pass_nodes(self) -> None:
        """Traverse nodes that more of the base follows as soon as the robot is within their deviation: it drives on."""
        while (node := self.orders.target) is not None and self.at is not None and not self.paused:
            goal = goal_of(node, self.places)
            follows = any(each.released and each.sequence_id > node.sequence_id for each in self.orders.nodes)
            if goal is None or not follows or node.actions or not is_within(node, goal, self.at):
                return
            self.orders.traversed(node.sequence_id)

    def step(self, now: float) -> Request | None:
        """Return the next request to the floor; None: there is nothing to ask, or an answer is waited for."""
        if self._asking is not None or now < self._retry_at:
            return None
        node = self.orders.target
        if self._mode != "AUTOMATIC" or self.paused or self._unreachable is not None:
            node = None
        if self._unsure is not None and node is not None and node is self._unsure.node:
            return self._ask(self._unsure.request, node, now)
        if node is None and self._way_home and self._way_home not in self._own:
            remember(self._own, self._way_home, value=False)  # to be ended as one of the fleet's that nobody wants
        self._adopt(now)
        if self._unsure is not None or (self._goal and self._goal_node is None):
            node = None  # first the mission that it has, or may have, is ended
        goal = None if node is None else goal_of(node, self.places)
        path = f"/api/v1/robots/{self.robot}/goal"
        if node is None or goal is None:
            return self._step_aside(path, now)
        if not self.state or (self._goal and self._goal_node is node):
            return None
        pose = {"x": goal.x, "y": goal.y} | ({} if goal.theta is None else {"theta": goal.theta})
        headers = {"If-Match": f'"{self._goal}"'} if self._goal else {"If-None-Match": "*"}
        self._asked_at = now
        return self._ask(Request("PUT", path, {"pose": pose}, headers | {"Idempotency-Key": uuid4().hex}), node, now)

    def _step_aside(self, path: str, now: float) -> Request | None:
        """Return what is to be asked while the robot needs no mission: end the one that it has, or may have."""
        if self._goal:
            request: Request | None = Request("DELETE", path, headers={"If-Match": f'"{self._goal}"'})
        elif self._unsure is not None:
            request = self._unsure.question
        else:
            request = None if self.paused else self.charging.request(self.view, now)
        return None if request is None else self._ask(request, None, now)

    def _ask(self, request: Request, node: Node | None, now: float) -> Request:
        self._asking, self._asked_for, self._sent_at = request, node, now
        return request

    def _adopt(self, now: float) -> None:
        """Take over the mission that is shown if it is the fleet's, though it was taken for ended or not answered for.

        One that may have been accepted, and is not wanted any more, is asked for without beginning it.
        """
        goal = self.view["goal"] or {"goal_id": ""}
        is_new = goal["goal_id"] not in ("", *self._own)
        if self._unsure is not None and is_new and not self._unsure.is_denied and self._may_be_own(goal):
            remember(self._own, goal["goal_id"], value=False)
            self._unsure.mission = goal["goal_id"]
        is_over, is_long_ago = self._own.get(goal["goal_id"]), now - max(self._shown_at, self._asked_at) >= UNSEEN_S
        if not self._goal and (is_over is False or (is_over and is_long_ago)):
            self._goal, self._goal_node, self._shown_at = goal["goal_id"], None, now
            if self._unsure is not None and self._unsure.mission == self._goal:
                self._unsure = None

    def on_answer(self, answer: Answer, now: float) -> None:
        """Take in the answer to the request that `step` returned."""
        request, node = self._asking, self._asked_for
        self._asking = None
        if request is None:
            return
        if self._goal or request.method == "PUT":
            self._on_answer(request, node, answer, now)
        else:
            self.charging.on_answer(request, answer, now)
        self.advance(now)

    def _on_answer(self, request: Request, node: Node | None, answer: Answer, now: float) -> None:
        unsure = self._unsure
        # Of an order that goes on it has to be known who ended its mission: an operator ends the order.
        was_to_end = self.orders.is_idle or unsure is not None or self._goal_node is None
        is_gone = answer.problem in ("no_mission", "mission_changed") and was_to_end
        if request.method == "PUT" and "goal_id" in answer.body:
            if self._goal:
                self._drop(is_over=True)
            self._goal, self._goal_node, self._unsure = answer.body["goal_id"], node, None
            remember(self._own, self._goal, value=False)
            self._shown_at, self._refused_since = now, None
        elif request.method == "DELETE" and (not answer.refusal or is_gone):
            self._drop(is_over=True)
            if unsure is not None and not answer.refusal and unsure.replaces(request):
                self._unsure = None  # there is no mission any more that it might replace
        elif unsure is not None and request.method == "PUT":
            self._retry_at = now + RETRY_S
            unsure.on_refusal(answer, self._sent_at, now)
            if unsure.is_over:
                self._unsure = None
        elif request.method == "PUT" and answer.problem in UNCERTAIN and node is not None:
            self._retry_at = now + RETRY_S
            self._unsure = Uncertain(request, node, self._sent_at)
        elif answer.problem != "goal_refused":
            self._retry_at = now + RETRY_S
        if answer.problem == "goal_refused" and node is not None and self._ahead(node) is not None:
            self._give_up(node, answer.refusal)

    @property
    def goal_node(self) -> Node | None:
        """The node that the robot drives to, if it drives to one."""
        return self._ahead(self._goal_node) if self._goal else None

    def errors(self) -> list[Error]:
        """Return what the fleet has to know of its messages."""
        own = (self._unavailable, self._instant_error, self._unreachable)
        return [*self._about_errors.values(), *(each for each in own if each is not None)]
