"""Which orders of a fleet control a robot takes over, and how far it has come. Pure.

The decisions are those of VDA 5050 3.0, sections 6.1.2 to 6.1.4 (figure 8), with the error types of its table 9.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_bridges.vda5050.charging import COMMANDS, NO_DOCK, told
from fog_bridges.vda5050.incoming import NODES_MAX
from fog_bridges.vda5050.outgoing import ActionState, EdgeState, Error, Level, NodeAt, NodeState, Reference

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_bridges.vda5050.incoming import Action, Edge, Node, Order

START_M: Final = 0.3
"""So near a robot has to be to the first node of a new order that allows no deviation, or a smaller one."""
HEADING_RAD: Final = 0.12
"""So exactly a robot of Fognav turns to a heading: no node can ask for more."""
MISSIONS_MAX: Final = 32
ORDER_ACTIONS_MAX: Final = 100
"""Actions that an order may have in all: its state tells of each."""
_SPEED_MARGIN: Final = 1e-3
_STRAIGHT_M2: Final = 1e-6
"""Twice the area of three points of a path, 5 cm apart, that lie on one line."""


class Where(NamedTuple):
    """A pose (m, rad, frame `map`); no `theta`: any heading will do."""

    x: float
    y: float
    theta: float | None = None


class Situation(NamedTuple):
    """What an order has to fit: `unavailable` is why the robot takes none, empty if it does."""

    unavailable: str
    at: Where | None
    map_id: str
    places: Mapping[str, Where]
    speed: float
    """The robot's highest speed (m/s)."""
    height: float
    has_dock: bool = False
    is_docked: bool = False


class Leg(NamedTuple):
    """The path between two nodes that follow on each other, as the planner would have it now (m)."""

    start: Node
    end: Node
    points: list[tuple[float, float]]


def corners_of(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a line without the points on its straight parts (m)."""
    bends = [
        b
        for a, b, c in zip(points, points[1:], points[2:], strict=False)
        if abs((b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])) > _STRAIGHT_M2
    ]
    return [points[0], *bends, points[-1]]


def rejection(order: Order, kind: str, words: str, level: Level = "WARNING", **references: str) -> Error:
    """Return the error by which an order is rejected."""
    about = {"orderId": order.order_id, "orderUpdateId": str(order.order_update_id), **references}
    return about_error(kind, words, about, level)


def about_error(kind: str, words: str, about: Mapping[str, str], level: Level = "WARNING") -> Error:
    """Return an error about things, by what they are called."""
    found = [Reference(reference_key=key, reference_value=value) for key, value in about.items()]
    return Error(error_type=kind, error_level=level, error_description=words[:500], error_references=found)


class Orders:
    """The order that a robot has: what lies ahead of it, and where it was last."""

    def __init__(self) -> None:
        self.order_id = ""
        self.update_id = 0
        self.last_node_id = ""
        self.last_sequence = 0
        self.nodes: list[Node] = []
        """Those ahead, base and horizon."""
        self.edges: list[Edge] = []
        self._decision: tuple[str, int] = ("", 0)
        """The last node of the base, where an update goes on."""
        self._is_ended = False
        """Whether it was cancelled or cleared: it gets no updates any more."""
        self._latest: Order | None = None
        self.actions: dict[str, ActionState] = {}
        """What becomes of the order's actions, by their ids."""
        self.beyond: list[Leg] = []
        """Paths from node to node, as they were looked for last."""
        self._at: dict[str, int] = {}
        """On which node each of them is to be done."""

    @property
    def is_idle(self) -> bool:
        """Whether nothing lies ahead, no horizon waits for its release, and all actions are done."""
        return not self.nodes and not self.edges and self._next_action is None

    @property
    def target(self) -> Node | None:
        """The next node of the base; None: there is none, an update is waited for, or an action comes first."""
        action = self._next_action
        if action is not None and self._at[action.action_id] <= self.last_sequence:
            return None
        return next((node for node in self.nodes if node.released), None)

    @property
    def _next_action(self) -> ActionState | None:
        return next((each for each in self.actions.values() if each.action_status in ("WAITING", "RUNNING")), None)

    @property
    def due(self) -> ActionState | None:
        """The action that is to be begun on the node where the robot is."""
        action = self._next_action
        is_due = action is not None and action.action_status == "WAITING"
        return action if action is not None and is_due and self._at[action.action_id] <= self.last_sequence else None

    @property
    def wants_base(self) -> bool:
        """Whether the robot will soon stand because the horizon is not released."""
        return sum(node.released for node in self.nodes) <= 1 and any(not node.released for node in self.nodes)

    def legs(self, node: Node | None) -> list[Leg]:
        """Return the paths that lead on from a node, to nodes of the base, as far as they are known."""
        found = []
        for leg in self.beyond:
            if leg.start is node and any(leg.end is each and each.released for each in self.nodes):
                found.append(leg)
                node = leg.end
        return found

    def is_known(self, order: Order) -> bool:
        """Whether it has this very order: then a repetition of it is ignored."""
        return self._latest is not None and is_repeated(self._latest, order)

    def why_not(self, order: Order, now: Situation) -> Error | None:
        """Return why an order can't be taken over; None: it can, if its nodes can be reached."""
        if now.unavailable:
            return rejection(order, "MOBILE_ROBOT_NOT_AVAILABLE", now.unavailable)
        return self._sequence_error(order) or _content_error(order, now) or self._start_error(order, now)

    def _sequence_error(self, order: Order) -> Error | None:
        if order.order_id != self.order_id:
            if not self.is_idle:
                words = f"order {self.order_id} is active: cancel it first, or wait until it is done"
                return rejection(order, "OTHER_ORDER_ACTIVE", words)
            if order.order_update_id != 0:
                return rejection(order, "VALIDATION_FAILURE", "a new order has the orderUpdateId 0")
            return None
        return self._update_error(order)

    def _update_error(self, order: Order) -> Error | None:
        if order.order_update_id < self.update_id:
            return rejection(order, "OUTDATED_ORDER_UPDATE", f"the robot has update {self.update_id} already")
        if order.order_update_id == self.update_id:
            return rejection(order, "SAME_ORDER_UPDATE_ID", "the robot has another order of these ids")
        if self._is_ended:
            words = "the order was cancelled, or ended as an operator took over: send a new one"
            return rejection(order, "ORDER_UPDATE_FOLLOWING_CANCEL", words)
        first = order.nodes[0]
        if (first.node_id, first.sequence_id) != self._decision:
            node, sequence = self._decision
            words = f"an update goes on at the last released node, {node} with the sequenceId {sequence}"
            return rejection(order, "VALIDATION_FAILURE", words, nodeId=first.node_id)
        ahead = sum(node.released for node in self.nodes) + len(order.nodes) - 1
        actions = len(self.actions.keys() | {action.action_id for action in _actions(order)})
        if ahead > NODES_MAX or actions > ORDER_ACTIONS_MAX:
            words = (
                f"{ahead} nodes would lie ahead of the robot, and {NODES_MAX} may; of {actions} actions of an order "
                f"{ORDER_ACTIONS_MAX} may be"
            )
            return rejection(order, "VALIDATION_FAILURE", words)
        return None

    def _start_error(self, order: Order, now: Situation) -> Error | None:
        first = order.nodes[0]
        goal = goal_of(first, now.places)
        is_same = first.node_id == self.last_node_id
        if order.order_id == self.order_id or (is_same and now.is_docked and now.at is not None):
            return None  # the dock stands beside the node at which the robot began to charge
        if now.at is None:
            words = "the robot does not know where it is"
        elif goal is None:
            if is_same:
                return None
            words = f"node {first.node_id} has no position, and is no place of Fognav"
        elif math.dist(goal[:2], now.at[:2]) <= START_M or is_within(first, goal, now.at):
            return None
        else:
            words = (
                f"the robot is {math.dist(goal[:2], now.at[:2]):.2f} m from node {first.node_id}, where it may be "
                f"{START_M} m, or within the deviations of position and heading that the node allows"
            )
        return rejection(order, "START_NODE_OUT_OF_RANGE", words, nodeId=first.node_id)

    def accept(self, order: Order) -> None:
        """Take over an order of which `why_not` finds nothing."""
        if order.order_id == self.order_id:
            self.nodes = [node for node in self.nodes if node.released]
            self.edges = [edge for edge in self.edges if edge.released]
            for name in [name for name in self.actions if self._at[name] > self._decision[1]]:
                del self.actions[name]  # another horizon comes
        else:
            self.nodes, self.edges, self.actions, self._at = [], [], {}, {}
            self.last_node_id, self.last_sequence = order.nodes[0].node_id, order.nodes[0].sequence_id
        self.order_id, self.update_id, self._latest, self._is_ended = (
            order.order_id,
            order.order_update_id,
            order,
            False,
        )
        self.nodes += order.nodes[1:]
        self.edges += order.edges
        for node in order.nodes:
            for action in node.actions:
                if action.action_id not in self.actions:  # those of the decision point may be sent again
                    self._at[action.action_id] = node.sequence_id
                    told(self.actions, action.action_id, action.action_type, "WAITING")
        last = [node for node in order.nodes if node.released][-1]
        self._decision = last.node_id, last.sequence_id

    def traversed(self, sequence: int) -> None:
        """Take in that the robot has come to a node."""
        for node in self.nodes:
            if node.sequence_id == sequence:
                self.last_node_id, self.last_sequence = node.node_id, sequence
        self.nodes = [node for node in self.nodes if node.sequence_id > sequence]
        self.edges = [edge for edge in self.edges if edge.sequence_id > sequence]

    def clear(self) -> None:
        """End the order; its ids stay, as the norm wants."""
        self._is_ended = self._is_ended or not self.is_idle
        self.nodes, self.edges = [], []
        for name, each in self.actions.items():
            if each.action_status == "WAITING":
                told(self.actions, name, each.action_type, "FAILED", "the order ended before")

    def states(self) -> tuple[list[NodeState], list[EdgeState]]:
        """Return what lies ahead."""
        nodes = []
        for node in self.nodes:
            state = NodeState(node_id=node.node_id, sequence_id=node.sequence_id, released=node.released)
            if (at := node.node_position) is not None:
                found = NodeAt(x=at.x, y=at.y, map_id=at.map_id, **({} if at.theta is None else {"theta": at.theta}))
                state = NodeState(
                    node_id=state.node_id, sequence_id=state.sequence_id, released=state.released, node_position=found
                )
            nodes.append(state)
        edges = [EdgeState(edge_id=e.edge_id, sequence_id=e.sequence_id, released=e.released) for e in self.edges]
        return nodes, edges


def is_repeated(order: Order, other: Order) -> bool:
    """Whether two orders are the same, sent twice."""
    return (order.order_id, order.order_update_id, order.nodes, order.edges) == (
        other.order_id, other.order_update_id, other.nodes, other.edges
    )  # fmt: skip


def remember(known: dict[str, bool], mission: str, *, value: bool) -> None:
    """Remember something of a mission, and of the latest ones only."""
    known.pop(mission, None)
    known[mission] = value
    if len(known) > MISSIONS_MAX:
        del known[next(iter(known))]


def goal_of(node: Node, places: Mapping[str, Where]) -> Where | None:
    """Return where a node is: its position, else the place of its id; None if there is neither."""
    at = node.node_position
    return places.get(node.node_id) if at is None else Where(at.x, at.y, at.theta)


def goals_of(order: Order, places: Mapping[str, Where]) -> list[tuple[Node, Where]]:
    """Return the nodes that an order releases anew, and where they are."""
    found = [(node, goal_of(node, places)) for node in order.nodes[1:] if node.released]
    return [(node, goal) for node, goal in found if goal is not None]


def is_within(node: Node, goal: Where, at: Where) -> bool:
    """Whether a robot is within the deviation that a node allows; none is allowed where it names none."""
    position = node.node_position
    allowed = None if position is None else position.allowed_deviation_xy
    if position is None or allowed is None:
        return False
    dx, dy = at.x - goal.x, at.y - goal.y
    if isinstance(allowed, float | int):
        inside = math.hypot(dx, dy) <= allowed
    else:
        along = dx * math.cos(allowed.theta) + dy * math.sin(allowed.theta)
        across = dy * math.cos(allowed.theta) - dx * math.sin(allowed.theta)
        inside = min(allowed.a, allowed.b) > 0.0 and (along / allowed.a) ** 2 + (across / allowed.b) ** 2 <= 1.0
    if not inside or goal.theta is None or at.theta is None:
        return inside
    turned = abs((at.theta - goal.theta + math.pi) % math.tau - math.pi)
    return turned <= max(abs(position.allowed_deviation_theta or 0.0), HEADING_RAD)


def _actions(order: Order) -> list[Action]:
    return [action for node in order.nodes for action in node.actions]


def _action_error(order: Order, now: Situation) -> Error | None:
    on_nodes, on_edges = _actions(order), [action for edge in order.edges for action in edge.actions]
    unknown = [action for action in on_nodes if action.action_type not in COMMANDS]
    names = [action.action_id for action in on_nodes]
    if wrong := on_edges + unknown:
        words = f"a robot of Fognav does {' and '.join(COMMANDS)} on nodes, and no {wrong[0].action_type} there"
    elif wrong := [] if now.has_dock else on_nodes:
        words = NO_DOCK
    elif wrong := [action for action in on_nodes if names.count(action.action_id) > 1]:
        words = "two actions have this actionId"
    elif wrong := on_nodes[ORDER_ACTIONS_MAX:]:
        words = f"an order has {ORDER_ACTIONS_MAX} actions at most"
    else:
        return None
    return rejection(order, "INVALID_ORDER_ACTION", words, actionId=wrong[0].action_id)


def _content_error(order: Order, now: Situation) -> Error | None:
    if (error := _action_error(order, now)) is not None:
        return error
    maps = {node.node_position.map_id for node in order.nodes if node.node_position is not None}
    if unknown := sorted(maps - {now.map_id}):
        return rejection(order, "UNKNOWN_MAP_ID", f"there is no map {unknown[0]}, only {now.map_id}", mapId=unknown[0])
    fields = [(edge.edge_id, name) for edge in order.edges for name in _beyond(edge, now)]
    if order.zone_set_id:
        fields.append((order.order_id, "zoneSetId"))
    if fields:
        owner, name = fields[0]
        words = f"{name} of {owner} can't be obeyed: the robot finds its way between nodes itself"
        return rejection(
            order, "UNSUPPORTED_PARAMETER", words, "CRITICAL", parameter=", ".join(sorted({n for _, n in fields}))
        )
    for node in order.nodes[1:]:
        if goal_of(node, now.places) is None:
            words = f"node {node.node_id} has no position, and is no place of Fognav"
            return rejection(order, "NO_ROUTE_TO_TARGET", words, nodeId=node.node_id)
    return None


def _beyond(edge: Edge, now: Situation) -> list[str]:
    """Return the fields of an edge that ask for more than a robot that drives freely does anyway."""
    slow = now.speed - _SPEED_MARGIN
    low = now.height
    asks = {
        "trajectory": edge.trajectory is not None,
        "corridor": edge.corridor is not None,
        "maximumSpeed": edge.maximum_speed is not None and edge.maximum_speed < slow,
        "maxSpeed": edge.max_speed is not None and edge.max_speed < slow,
        "maximumMobileRobotHeight": edge.maximum_mobile_robot_height is not None
        and edge.maximum_mobile_robot_height < low,
        "maxHeight": edge.max_height is not None and edge.max_height < low,
        "minimumLoadHandlingDeviceHeight": bool(edge.minimum_load_handling_device_height),
        "minHeight": bool(edge.min_height),
        "orientation": edge.orientation is not None,
        "direction": bool(edge.direction),
        "reachOrientationBeforeEntering": edge.reach_orientation_before_entering is True,
        "rotationAllowed": edge.rotation_allowed is False,
        "maxRotationSpeed": edge.max_rotation_speed is not None,
    }
    return [name for name, asked in asks.items() if asked]
