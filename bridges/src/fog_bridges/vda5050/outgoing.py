"""What VDA 5050 3.0, 2.1, 2.0 and 1.1 have a robot tell, and a fleet control of its zones. Pure.

Messages are made with the names of 3.0; `of_version` gives them those of earlier versions. Rules and units as in
`incoming`.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
from msgspec import UNSET, UnsetType

from fog_bridges.vda5050.incoming import OLDEST

if TYPE_CHECKING:
    from fog_bridges.vda5050.incoming import Version


class _Out(msgspec.Struct, frozen=True, kw_only=True, rename="camel"):
    pass


class Reference(_Out, frozen=True, kw_only=True):
    """What an error is about."""

    reference_key: str
    reference_value: str


Level = Literal["WARNING", "URGENT", "CRITICAL", "FATAL"]


class Error(_Out, frozen=True, kw_only=True):
    """What is the matter."""

    error_type: str
    error_level: Level
    error_description: str
    error_references: list[Reference] = []
    error_hint: str | UnsetType = UNSET


class Info(_Out, frozen=True, kw_only=True):
    """What people may want to know."""

    info_type: str
    info_level: Literal["INFO", "DEBUG"]
    info_descriptor: str


ActionStatus = Literal["WAITING", "INITIALIZING", "RUNNING", "PAUSED", "RETRIABLE", "FINISHED", "FAILED"]


class ActionState(_Out, frozen=True, kw_only=True):
    """What became of an action."""

    action_id: str
    action_type: str
    action_status: ActionStatus
    action_result: str = ""


class NodeAt(_Out, frozen=True, kw_only=True):
    """Where a node is that lies ahead."""

    x: float
    y: float
    map_id: str
    theta: float | UnsetType = UNSET


class NodeState(_Out, frozen=True, kw_only=True):
    """A node that lies ahead."""

    node_id: str
    sequence_id: int
    released: bool
    node_position: NodeAt | UnsetType = UNSET


class EdgeState(_Out, frozen=True, kw_only=True):
    """An edge that lies ahead."""

    edge_id: str
    sequence_id: int
    released: bool


class Position(_Out, frozen=True, kw_only=True):
    """Where the robot is; `deviation_range` (m) is how far from there it may be."""

    x: float
    y: float
    theta: float
    map_id: str
    localized: bool
    deviation_range: float


class Velocity(_Out, frozen=True, kw_only=True):
    """How fast it moves, in its own frame (m/s, rad/s)."""

    vx: float
    vy: float
    omega: float


class Point(_Out, frozen=True, kw_only=True):
    """A point (m)."""

    x: float
    y: float


class Trajectory(_Out, frozen=True, kw_only=True):
    """A NURBS; of degree 1 it is the polyline of its control points."""

    degree: int
    knot_vector: list[float]
    control_points: list[Point]


class PlannedPath(_Out, frozen=True, kw_only=True):
    """The path from where the robot stands, and the nodes on it."""

    trajectory: Trajectory
    traversed_nodes: list[str] = []


class Waypoint(_Out, frozen=True, kw_only=True):
    """A point, and when the robot expects to be there."""

    x: float
    y: float
    eta: str


class IntermediatePath(_Out, frozen=True, kw_only=True):
    """The next metres of the path."""

    polyline: list[Waypoint]


class PowerSupply(_Out, frozen=True, kw_only=True):
    """The battery: percent, V, A (negative while it is discharged)."""

    state_of_charge: float
    charging: bool
    battery_voltage: float | UnsetType = UNSET
    battery_current: float | UnsetType = UNSET


class SafetyState(_Out, frozen=True, kw_only=True):
    """Whether somebody has to acknowledge a stop at the robot, and whether something is in its protective field."""

    active_emergency_stop: Literal["MANUAL", "REMOTE", "NONE"]
    field_violation: bool


OperatingMode = Literal["STARTUP", "AUTOMATIC", "SEMIAUTOMATIC", "INTERVENED", "MANUAL", "SERVICE", "TEACH_IN"]


class State(_Out, frozen=True, kw_only=True):
    """All about a robot."""

    order_id: str
    order_update_id: int
    last_node_id: str
    last_node_sequence_id: int
    node_states: list[NodeState]
    edge_states: list[EdgeState]
    driving: bool
    paused: bool
    new_base_request: bool
    action_states: list[ActionState]
    instant_action_states: list[ActionState]
    power_supply: PowerSupply
    operating_mode: OperatingMode
    errors: list[Error]
    information: list[Info]
    safety_state: SafetyState
    mobile_robot_position: Position | UnsetType = UNSET
    velocity: Velocity | UnsetType = UNSET
    planned_path: PlannedPath | UnsetType = UNSET
    intermediate_path: IntermediatePath | UnsetType = UNSET


class Visualization(_Out, frozen=True, kw_only=True):
    """Where a robot is and goes, more often than its state."""

    reference_state_header_id: int
    mobile_robot_position: Position | UnsetType = UNSET
    velocity: Velocity | UnsetType = UNSET
    planned_path: PlannedPath | UnsetType = UNSET
    intermediate_path: IntermediatePath | UnsetType = UNSET


class Zone(_Out, frozen=True, kw_only=True):
    """A zone, with the parameter that its type needs."""

    zone_id: str
    zone_type: Literal["BLOCKED", "SPEED_LIMIT", "PENALTY"]
    zone_descriptor: str
    vertices: list[Point]
    maximum_speed: float | UnsetType = UNSET
    penalty_factor: float | UnsetType = UNSET


class ZoneSet(_Out, frozen=True, kw_only=True):
    """The zones of a map; what has this id never changes."""

    map_id: str
    zone_set_id: str
    zones: list[Zone]


def timestamp(stamp: float) -> str:
    """Return a time (s since 1970) as the norm writes it, in ms."""
    return datetime.fromtimestamp(stamp, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def of_version(topic: str, message: msgspec.Struct | dict[str, Any], version: Version) -> dict[str, Any]:
    """Return a message of 3.0 as JSON of a version."""
    content: dict[str, Any] = msgspec.to_builtins(message)
    if version == "3.0":
        return content
    if version in OLDEST:  # there a node that lies ahead has a heading, or no position
        for node in content.get("nodeStates", ()):
            if "theta" not in node.get("nodePosition", ()):
                node.pop("nodePosition", None)
    return _EARLIER.get(topic, dict)(content)


def _renamed(content: dict[str, Any], names: dict[str, str]) -> dict[str, Any]:
    return {names.get(name, name): value for name, value in content.items()}


def _earlier_visualization(content: dict[str, Any]) -> dict[str, Any]:
    """Return position and velocity: earlier versions tell no paths."""
    found = {name: content[name] for name in ("velocity",) if name in content}
    if "mobileRobotPosition" in content:
        found["agvPosition"] = _renamed(content["mobileRobotPosition"], {"localized": "positionInitialized"})
    return found


_ERRORS: Final = {
    "VALIDATION_FAILURE": "validationError", "UNSUPPORTED_PARAMETER": "orderError",
    "INVALID_ORDER_ACTION": "orderError", "OTHER_ORDER_ACTIVE": "orderError", "UNKNOWN_MAP_ID": "orderError",
    "START_NODE_OUT_OF_RANGE": "orderError", "NO_ROUTE_TO_TARGET": "orderError",
    "MOBILE_ROBOT_NOT_AVAILABLE": "orderError", "OUTDATED_ORDER_UPDATE": "orderUpdateError",
    "SAME_ORDER_UPDATE_ID": "orderUpdateError", "ORDER_UPDATE_FOLLOWING_CANCEL": "orderUpdateError",
}  # fmt: skip
"""What 2.1 and 2.0 call errors of orders; they leave others to the maker, who writes them in its style."""


def earlier_error(name: str) -> str:
    """Return the error type of 2.1 and 2.0 for one of 3.0."""
    first, *rest = name.lower().split("_")
    return _ERRORS.get(name, first + "".join(part.title() for part in rest))


def _earlier_state(content: dict[str, Any]) -> dict[str, Any]:
    drawn = _earlier_visualization(content)
    for name in ("mobileRobotPosition", "velocity", "plannedPath", "intermediatePath"):
        content.pop(name, None)
    power, safety = content.pop("powerSupply"), content.pop("safetyState")
    mode = content["operatingMode"]
    actions = content.pop("actionStates") + content.pop("instantActionStates")
    return {
        **content, **drawn,
        "operatingMode": {"TEACH_IN": "TEACHIN", "STARTUP": "MANUAL", "INTERVENED": "MANUAL"}.get(mode, mode),
        "actionStates": [_renamed(each, {"actionResult": "resultDescription"}) for each in actions],
        "batteryState": {
            "batteryCharge": power["stateOfCharge"], "charging": power["charging"],
            **{name: power[name] for name in ("batteryVoltage",) if name in power},
        },
        "safetyState": {"eStop": safety["activeEmergencyStop"], "fieldViolation": safety["fieldViolation"]},
        "errors": [
            {**each, "errorType": earlier_error(each["errorType"]),
             "errorLevel": "FATAL" if each["errorLevel"] == "FATAL" else "WARNING"}
            for each in content["errors"]
        ],
        "information": [_renamed(each, {"infoDescriptor": "infoDescription"}) for each in content["information"]],
    }  # fmt: skip


def _earlier_connection(content: dict[str, Any]) -> dict[str, Any]:
    return {"connectionState": content["connectionState"].replace("_", "")}


_EARLIER: Final = {
    "state": _earlier_state, "visualization": _earlier_visualization, "connection": _earlier_connection,
}  # fmt: skip
