"""What a fleet control is told of a robot: state, visualization, factsheet. Pure."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

from msgspec import UNSET, structs

from fog_bridges.vda5050 import outgoing as out
from fog_bridges.vda5050.charging import COMMANDS, INSTANT_MAX, START
from fog_bridges.vda5050.incoming import ACTIONS_MAX, ID_MAX, MESSAGE_MAX, NODES_MAX
from fog_bridges.vda5050.robot import SPEED_M_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_bridges.vda5050.incoming import Version
    from fog_bridges.vda5050.robot import FleetRobot

STATE_S: Final = 30.0
"""The longest time between two states."""
CHANGED_S: Final = 0.2
"""The shortest one."""
VISUALIZATION_S: Final = 1.0
UNMEASURED_CHARGE: Final = 80.0
"""The charge (%) of a robot that does not measure it: the norm's word for a battery of which only "good" is known."""
NEXT_M: Final = 3.0
"""How far the intermediate path reaches."""
_UNLOCALIZED: Final = ("pose_unknown", "pose_lost")
_PASSING: Final = (
    "just_started", "not_enabled", "on_dock", "docking", "maneuver", "maneuver_ended", "plan_awaited", "path_awaited",
    "recovering", *_UNLOCALIZED,
)  # fmt: skip
"""Reasons that are no errors: what is normal, passes within a second, or is told by the mode or an error of its own."""


def state(robot: FleetRobot, now: float, stamp: float) -> out.State:
    """Return all about a robot; `now` is monotonic, `stamp` (s since 1970) is what its times count from."""
    orders, told = robot.orders, robot.state
    mode, words = robot.mode(now)
    nodes, edges = orders.states()
    picture = _picture(robot, stamp)
    is_fault = told.get("mode") == "FAULT"
    facts = [("MODE", told.get("mode", "unknown"))] + [("REASON", reason) for reason in told.get("reasons", ())]
    if told.get("battery") is None:
        facts.append(("BATTERY_NOT_MEASURED", f"nobody measures the charge: {UNMEASURED_CHARGE:g} % stands for that"))
    if words:
        facts.append(("NOT_IN_CONTROL", words))
    return out.State(
        order_id=orders.order_id,
        order_update_id=orders.update_id,
        last_node_id=orders.last_node_id,
        last_node_sequence_id=orders.last_sequence,
        node_states=nodes,
        edge_states=edges,
        driving=robot.is_driving,
        paused=robot.paused,
        new_base_request=orders.wants_base,
        action_states=list(orders.actions.values()),
        instant_action_states=list(robot.instant.values()),
        power_supply=_power(told),
        operating_mode=mode,
        errors=[*robot.errors(), *_conditions(robot)],
        information=[out.Info(info_type=kind, info_level="INFO", info_descriptor=fact) for kind, fact in facts],
        safety_state=out.SafetyState(
            active_emergency_stop="MANUAL" if is_fault else "NONE",
            field_violation=told.get("mode") == "PROTECTIVE_STOP" or (is_fault and "bumper" in told.get("codes", ())),
        ),
        mobile_robot_position=picture.mobile_robot_position,
        velocity=picture.velocity,
        planned_path=picture.planned_path,
        intermediate_path=picture.intermediate_path,
    )


def lasting(told: out.State) -> out.State:
    """Return what of a state must be told at once when it changes: all but what always changes."""
    power = out.PowerSupply(state_of_charge=0.0, charging=told.power_supply.charging)
    return structs.replace(
        told, mobile_robot_position=UNSET, velocity=UNSET, planned_path=UNSET, intermediate_path=UNSET,
        power_supply=power, information=[],
    )  # fmt: skip


def visualization(robot: FleetRobot, header: int, stamp: float) -> out.Visualization:
    """Return where the robot is and goes; `header` is the number of its last state."""
    return structs.replace(_picture(robot, stamp), reference_state_header_id=header)


def _picture(robot: FleetRobot, stamp: float) -> out.Visualization:
    pose = robot.pose
    if pose is None:
        return out.Visualization(reference_state_header_id=0)
    spread = 2.0 * math.sqrt(max(pose["covariance"][0], pose["covariance"][4], 0.0))
    theta = (pose["theta"] + math.pi) % math.tau - math.pi
    goal = robot.goal_node
    path = _ahead(robot.path, (pose["x"], pose["y"])) if goal is not None else []
    legs = robot.orders.legs(goal) if path else []
    nodes = [node.node_id for node in (goal, *(leg.end for leg in legs)) if node is not None]
    whole = path + [point for leg in legs for point in leg.points[1:]]
    return out.Visualization(
        reference_state_header_id=0,
        mobile_robot_position=out.Position(
            x=round(pose["x"], 3), y=round(pose["y"], 3), theta=round(theta, 4), map_id=robot.map_id,
            localized=pose["localized"], deviation_range=round(spread, 3),
        ),
        velocity=out.Velocity(vx=round(pose["v"], 3), vy=0.0, omega=round(pose["w"], 3)),
        planned_path=planned(whole, nodes) if path else UNSET,
        intermediate_path=_next_metres(path, stamp) if path else UNSET,
    )  # fmt: skip


def _ahead(path: Sequence[tuple[float, float]], at: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the rest of a path from where the robot is: from the foot of its perpendicular on."""
    best, rest = math.inf, list(path)
    for n, ((ax, ay), (bx, by)) in enumerate(pairwise(path)):
        length = (bx - ax) ** 2 + (by - ay) ** 2
        share = (
            0.0 if length == 0.0 else max(0.0, min(1.0, ((at[0] - ax) * (bx - ax) + (at[1] - ay) * (by - ay)) / length))
        )
        away = math.hypot(ax + share * (bx - ax) - at[0], ay + share * (by - ay) - at[1])
        if away <= best:
            best, rest = away, list(path[n + 1 :])
    return [at, *rest] if rest else []


def planned(path: Sequence[tuple[float, float]], nodes: list[str]) -> out.PlannedPath:
    """Return a polyline to `nodes` as a NURBS of degree 1: its knots are the shares of its length at its corners."""
    lengths = [0.0]
    for a, b in pairwise(path):
        lengths.append(lengths[-1] + math.dist(a, b))
    total = lengths[-1] or 1.0
    inner = [round(length / total, 6) for length in lengths[1:-1]]
    return out.PlannedPath(
        trajectory=out.Trajectory(
            degree=1,
            knot_vector=[0.0, 0.0, *inner, 1.0, 1.0],
            control_points=[out.Point(x=round(x, 3), y=round(y, 3)) for x, y in path],
        ),
        traversed_nodes=nodes,
    )


def _next_metres(path: Sequence[tuple[float, float]], stamp: float) -> out.IntermediatePath:
    """Return the corners of the next metres, at the robot's usual speed; at least the next one."""
    points, driven = [path[0]], [0.0]
    for a, b in pairwise(path):
        points.append(b)
        driven.append(driven[-1] + math.dist(a, b))
        if driven[-1] >= NEXT_M:
            break
    return out.IntermediatePath(
        polyline=[
            out.Waypoint(x=round(x, 3), y=round(y, 3), eta=out.timestamp(stamp + length / SPEED_M_S))
            for (x, y), length in zip(points, driven, strict=True)
        ]
    )


def _power(told: dict[str, Any]) -> out.PowerSupply:
    power = told.get("power") or {}
    charge = told.get("battery")
    measured = {"battery_voltage": power.get("voltage_v"), "battery_current": power.get("current_a")}
    return out.PowerSupply(
        state_of_charge=UNMEASURED_CHARGE if charge is None else round(100.0 * charge, 1),
        charging=power.get("charging") in ("reconditioning", "bulk", "trickle"),
        **{name: value for name, value in measured.items() if value is not None},
    )


def _conditions(robot: FleetRobot) -> list[out.Error]:
    """Return what keeps the robot or slows it down, by its own reasons."""
    told, found = robot.state, []
    codes = told.get("codes", ())
    if told and (robot.at is None or any(code in _UNLOCALIZED for code in codes)):
        words = "the robot does not know where it is: an operator of Fognav tells it"
        found.append(out.Error(error_type="LOCALIZATION_ERROR", error_level="FATAL", error_description=words))
    for code, reason in zip(codes, told.get("reasons", ()), strict=False):
        if code in _PASSING:
            continue
        level: out.Level = "FATAL" if told["mode"] == "FAULT" else "WARNING"
        kind = code.upper()
        if code == "in_blocked":
            kind, level = "BLOCKED_ZONE_VIOLATION", "CRITICAL"
        elif code == "battery_low" and level == "WARNING":
            level = "URGENT"
        hint = "an operator of Fognav looks at the robot and resets it" if level == "FATAL" else UNSET
        found.append(out.Error(error_type=kind, error_level=level, error_description=reason, error_hint=hint))
    return found


ACTIONS: Final[tuple[tuple[str, list[dict[str, Any]]], ...]] = (
    ("cancelOrder", [{"key": "orderId", "valueDataType": "STRING", "isOptional": True}]),
    ("startPause", []), ("stopPause", []), ("stateRequest", []), ("factsheetRequest", []), ("clearInstantActions", []),
)  # fmt: skip


def factsheet(robot: FleetRobot, version: Version) -> dict[str, Any]:
    """Return what the robot is and can, in a version's own names: they differ in nearly all."""
    pose = robot.pose or {"radius": 0.17, "height": 0.1}
    width, height = round(2.0 * pose["radius"], 3), pose["height"]
    is_new = version == "3.0"
    lengths = {"order.nodes": NODES_MAX, "order.edges": NODES_MAX - 1, "edge.actions": 0,
               "node.actions": ACTIONS_MAX if robot.has_dock else 0, "instantActions": ACTIONS_MAX}  # fmt: skip
    if is_new:
        lengths["state.instantActionStates"] = INSTANT_MAX
    timing = {"defaultStateInterval": STATE_S, "visualizationInterval": VISUALIZATION_S}
    actions = [
        {"actionType": kind, "actionScopes": ["INSTANT"], "actionParameters": parameters}
        | ({"blockingTypes": ["NONE"], "pauseAllowed": False, "cancelAllowed": False} if is_new else {})
        for kind, parameters in ACTIONS
        if is_new or kind != "clearInstantActions"
    ]
    actions += [
        {"actionType": kind, "actionScopes": ["INSTANT", "NODE"], "actionParameters": []}
        | ({"blockingTypes": ["HARD"], "pauseAllowed": False, "cancelAllowed": kind == START} if is_new else {})
        for kind in COMMANDS
        if robot.has_dock
    ]
    kind = {"seriesName": "Fognav", "localizationTypes": ["NATURAL"]}
    load: dict[str, Any] = {"loadPositions": [], "loadSets": []}
    if is_new:
        return {
            "typeSpecification": kind | {
                "mobileRobotKinematics": "DIFFERENTIAL", "mobileRobotClass": "CARRIER", "maximumLoadMass": 0,
                "navigationTypes": ["FREELY_NAVIGATING"], "supportedZones": [],
            },
            "physicalParameters": {
                "minimumSpeed": 0.0, "maximumSpeed": SPEED_M_S, "maximumAcceleration": 0.5, "maximumDeceleration": 1.0,
                "minimumHeight": height, "maximumHeight": height, "width": width, "length": width,
            },
            "protocolLimits": {
                "maximumStringLengths": {"maximumMessageLength": MESSAGE_MAX, "maximumIdLength": ID_MAX},
                "maximumArrayLengths": lengths,
                "timing": timing | {"minimumOrderInterval": 1.0, "minimumStateInterval": CHANGED_S},
            },
            "protocolFeatures": {"optionalParameters": [], "mobileRobotActions": actions},
            "mobileRobotGeometry": {}, "loadSpecification": load,
        }  # fmt: skip
    return {
        "typeSpecification": kind | {
            "agvKinematic": "DIFF", "agvClass": "CARRIER", "maxLoadMass": 0, "navigationTypes": ["AUTONOMOUS"],
        },
        "physicalParameters": {
            "speedMin": 0.0, "speedMax": SPEED_M_S, "accelerationMax": 0.5, "decelerationMax": 1.0,
            "heightMin": height, "heightMax": height, "width": width, "length": width,
        },
        "protocolLimits": {
            "maxStringLens": {"msgLen": MESSAGE_MAX, "idLen": ID_MAX}, "maxArrayLens": lengths,
            "timing": timing | {"minOrderInterval": 1.0, "minStateInterval": CHANGED_S},
        },
        "protocolFeatures": {"optionalParameters": [], "agvActions": actions},
        "agvGeometry": {}, "loadSpecification": load,
    }  # fmt: skip
