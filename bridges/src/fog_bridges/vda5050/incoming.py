"""What VDA 5050 3.0, 2.1, 2.0 and 1.1 have a robot receive: orders and instant actions, checked. Pure.

Names and rules: "VDA 5050 - Interface for the Communication between Mobile Robots and a Fleet Control", version 3.0.0,
section 7, and version 2.1.0, section 6. Lengths are in m, angles in rad, in the project's frame: Fognav's `map`.
"""

from __future__ import annotations

import re
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

Version = Literal["3.0", "2.1", "2.0", "1.1"]
RELEASES: Final[dict[Version, str]] = {"3.0": "3.0.0", "2.1": "2.1.0", "2.0": "2.0.0", "1.1": "1.1.0"}
"""What a header says of a version."""
OLDEST: Final[tuple[Version, ...]] = ("2.0", "1.1")
"""Those with other names for instant actions and nodes ahead; 1.1 has no factsheet, and else the same."""
MESSAGE_MAX: Final = 256 * 1024
"""Bytes of the longest message that is read."""
NODES_MAX: Final = 100
ID_MAX: Final = 200
ACTIONS_MAX: Final = 20

Text = Annotated[str, Meta(max_length=ID_MAX)]
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]
Size = Annotated[float, Meta(ge=0.0, le=1e6)]
Angle = Annotated[float, Meta(ge=-3.14159265359, le=3.14159265359)]
Count = Annotated[int, Meta(ge=0, le=2**32 - 1)]


class MessageError(ValueError):
    """A message can't be used; `order` and `update` are those of the order in it, as far as it has them."""

    def __init__(self, words: str, order: str = "", update: int | None = None) -> None:
        super().__init__(words)
        self.order = order
        self.update = update


class _In(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    """What the norm does not know is no error: other versions have more."""


class Parameter(_In, frozen=True, kw_only=True):
    """A parameter of an action."""

    key: Text
    value: Any


class Action(_In, frozen=True, kw_only=True):
    """An action on a node or edge, or an instant one."""

    action_type: Text
    action_id: Text
    blocking_type: Literal["NONE", "SOFT", "SINGLE", "HARD"]
    action_parameters: Annotated[list[Parameter], Meta(max_length=50)] = []

    def parameter(self, key: str) -> object:
        """Return a parameter; None without it."""
        return next((each.value for each in self.action_parameters if each.key == key), None)


Actions = Annotated[list[Action], Meta(max_length=ACTIONS_MAX)]


class Ellipse(_In, frozen=True, kw_only=True):
    """Half axes and direction of how far from a node a robot may be (3.0; earlier versions have a radius)."""

    a: Size
    b: Size
    theta: Annotated[float, Meta(ge=-1.570796327, le=1.570796327)]


class NodePosition(_In, frozen=True, kw_only=True):
    """Where a node is, and how precisely a robot has to be there."""

    x: Number
    y: Number
    map_id: Text
    theta: Angle | None = None
    allowed_deviation_xy: Ellipse | Size | None = msgspec.field(default=None, name="allowedDeviationXY")
    allowed_deviation_theta: Annotated[float, Meta(ge=-3.141592654, le=3.141592654)] | None = None


class Node(_In, frozen=True, kw_only=True):
    """A node of an order; without a position it is a place of Fognav by its id."""

    node_id: Text
    sequence_id: Count
    released: bool
    actions: Actions
    node_position: NodePosition | None = None


class Edge(_In, frozen=True, kw_only=True):
    """An edge of an order. A freely navigating robot finds its way itself, so it can obey few of these fields."""

    edge_id: Text
    sequence_id: Count
    released: bool
    actions: Actions
    start_node_id: Text | None = None
    end_node_id: Text | None = None
    maximum_speed: Size | None = None
    max_speed: Size | None = None
    maximum_mobile_robot_height: Size | None = None
    max_height: Size | None = None
    minimum_load_handling_device_height: Size | None = None
    min_height: Size | None = None
    orientation: Angle | None = None
    orientation_type: Text | None = None
    direction: Text | None = None
    reach_orientation_before_entering: bool | None = None
    rotation_allowed: bool | None = None
    max_rotation_speed: Size | None = None
    trajectory: dict[str, Any] | None = None
    corridor: dict[str, Any] | None = None
    length: Size | None = None


class _Header(_In, frozen=True, kw_only=True):
    header_id: Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
    timestamp: Text
    version: Text
    manufacturer: Text
    serial_number: Text


class Order(_Header, frozen=True, kw_only=True):
    """Nodes and edges in the sequence in which they are to be traversed; those that are released come first."""

    order_id: Text
    order_update_id: Count
    nodes: Annotated[list[Node], Meta(min_length=1, max_length=NODES_MAX)]
    edges: Annotated[list[Edge], Meta(max_length=NODES_MAX)]
    zone_set_id: Text | None = None

    def __post_init__(self) -> None:
        """Raise `ValueError` for a sequence that is none."""
        nodes, edges = self.nodes, self.edges
        if len(edges) != len(nodes) - 1:
            raise ValueError(f"{len(nodes)} nodes need {len(nodes) - 1} edges, and there are {len(edges)}")
        parts: list[Node | Edge] = [*nodes, *edges]
        parts[::2], parts[1::2] = nodes, edges
        first = nodes[0].sequence_id
        wrong = next((n for n, part in enumerate(parts) if part.sequence_id != first + n), None)
        if first % 2 or wrong is not None:
            number = parts[wrong or 0].sequence_id
            raise ValueError(f"sequenceId {number}: those of nodes are even, and those of nodes and edges follow on")
        released = [part.released for part in parts]
        if not released[0] or released != sorted(released, reverse=True):
            raise ValueError("the first node is released, and nothing behind what is not")


class InstantActions(_Header, frozen=True, kw_only=True):
    """Actions to be done at once."""

    actions: Actions


class _EarlyActions(_Header, frozen=True, kw_only=True):
    """Those of 2.0, whose schema and whose implementations (`vda-5050-lib` 1.4) name them differently."""

    actions: Actions = []
    instant_actions: Actions = []


class ReportedZoneSet(_In, frozen=True, kw_only=True):
    """A zone set that a robot has."""

    zone_set_id: Text
    map_id: Text
    zone_set_status: Literal["ENABLED", "DISABLED"]


class ReportedConnection(_In, frozen=True, kw_only=True):
    """Whether a robot is there."""

    connection_state: Text


class ReportedState(_In, frozen=True, kw_only=True):
    """What is read of other makers' robots' states."""

    zone_sets: Annotated[list[ReportedZoneSet], Meta(max_length=1000)] = []


_TOPICS: Final[dict[str, type[_Header]]] = {"order": Order, "instantActions": InstantActions}
_ORDER = re.compile(rb'"orderId"\s*:\s*"([^"\\]{1,200})"')
_UPDATE = re.compile(rb'"orderUpdateId"\s*:\s*(\d{1,9})\b')


def decoded(topic: str, payload: bytes, version: Version, serial: str) -> Order | InstantActions:
    """Return a message on a topic of robot `serial`; raises `MessageError`."""
    if len(payload) > MESSAGE_MAX:  # before anything that takes the longer, the longer it is
        raise MessageError(f"{len(payload)} bytes are over the limit of {MESSAGE_MAX}")
    order, update = _ORDER.search(payload), _UPDATE.search(payload)
    named = order[1].decode("utf-8", "replace") if order else "", int(update[1]) if update else None
    kind = _EarlyActions if topic == "instantActions" and version in OLDEST else _TOPICS[topic]
    try:
        message = msgspec.json.decode(payload, type=kind)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError(str(error), *named) from error
    if message.version.partition(".")[0] != version.partition(".")[0]:
        raise MessageError(f"version {message.version[:20]!r} on a topic of {RELEASES[version]}", *named)
    if message.serial_number != serial:
        raise MessageError(f"serialNumber {message.serial_number[:40]!r} on the topic of {serial}", *named)
    if isinstance(message, Order | InstantActions):
        return message
    if not isinstance(message, _EarlyActions):
        raise TypeError(topic)
    return InstantActions(
        header_id=message.header_id, timestamp=message.timestamp, version=message.version,
        manufacturer=message.manufacturer, serial_number=message.serial_number,
        actions=[*message.actions, *message.instant_actions],
    )  # fmt: skip
