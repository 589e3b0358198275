"""What a floor tells, as messages of ROS 2 (REP 103 and 105: metres, radians, frame `map`). Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_bridges.ros2.wire import TYPES, RosMessage
from fog_contracts.channels import ROBOT_OBSTACLES
from fog_contracts.costs import LETHAL, UNKNOWN, penalty_cost
from fog_contracts.grid import Window
from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS, Power
from fog_contracts.shapes import polygon_spans, shape_spans

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import HazardArea, RobotPath, RobotPose, RobotState, Shape, View, Zone

MAP_FRAME: Final = "map"
KEEPOUT: Final = 0
SPEED: Final = 2
"""Kinds of Nav2's costmap filters: keepout, and speed limits in m/s."""
SPEED_STEP: Final = 0.01
"""What one unit of a speed mask is (m/s)."""
FULL: Final = 100
_LINE_STRIP: Final = 4
_LINE_LIST: Final = 5
_TEXT: Final = 9
_DELETE_ALL: Final = 3
_LINE_WIDTH: Final = 0.08
_TEXT_HEIGHT: Final = 0.4
_COLOURS: Final = {
    "blocked": (0.84, 0.15, 0.16),
    "unknown": (1.0, 0.6, 0.0),
    "BLOCKED": (0.55, 0.1, 0.55),
    "PENALTY": (0.3, 0.45, 0.75),
    "SPEED_LIMIT": (0.2, 0.6, 0.6),
    "RELEASE": (0.75, 0.6, 0.1),
}
_STRIPE_ROWS: Final = 4
_NEVER: Final = float("nan")
_CHARGING: Final = {"no": 2, "waiting": 3, "bulk": 1, "trickle": 1, "reconditioning": 1}
"""Fognav's words for what a charger does, as power supply status of sensor_msgs."""


def message(kind: str, **fields: object) -> RosMessage:
    """Return a message of a type such as `nav_msgs/msg/Path`, whose package may be left out for a nested one."""
    made: RosMessage = TYPES.types[kind]
    return made(**fields)


def ros_name(name: str) -> str:
    """Return an id as a part of a topic: without hyphens, which ROS does not allow, and not beginning with a digit."""
    found = name.replace("-", "_")
    return f"_{found}" if found[:1].isdigit() else found


def header(stamp: float, frame: str = MAP_FRAME) -> RosMessage:
    """Return a header; `stamp` in s since 1970."""
    seconds = math.floor(stamp)
    # ROS's seconds have 31 bits; at another speed than 1 stamps count from no epoch, and may have more.
    time = message("builtin_interfaces/msg/Time", sec=seconds % 2**31, nanosec=int((stamp - seconds) * 1e9))
    return message("std_msgs/msg/Header", stamp=time, frame_id=frame)


def pose(x: float, y: float, theta: float, z: float = 0.0) -> RosMessage:
    """Return a pose in the plane."""
    return message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=_turned(theta),
    )


def _turned(theta: float) -> RosMessage:
    return message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0))


def heading(orientation: RosMessage) -> float | None:
    """Return the yaw of a quaternion (rad), None for one that is none (all zero, say: no heading is asked for)."""
    x, y, z, w = orientation.x, orientation.y, orientation.z, orientation.w
    if not 0.9 < math.hypot(x, y, z, w) < 1.1:
        return None
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


# --- The map and the masks of Nav2's costmap filters ------------------------------------------------------------------


def grid(values: NDArray[np.int8], geometry: GridGeometry, stamp: float, window: Window | None = None) -> RosMessage:
    """Return an OccupancyGrid of values (height, width), row 0 at the bottom, as in ROS; of a `window` of them only."""
    told, part = header(stamp), geometry.whole if window is None else window
    info = message(
        "nav_msgs/msg/MapMetaData",
        map_load_time=told.stamp,
        resolution=geometry.resolution,
        width=part.width,
        height=part.height,
        origin=pose(
            geometry.origin_x + part.x * geometry.resolution, geometry.origin_y + part.y * geometry.resolution, 0.0
        ),
    )
    return message("nav_msgs/msg/OccupancyGrid", header=told, info=info, data=values[part.rows, part.columns].ravel())


def covering(values: NDArray[np.int8], window: Window | None) -> Window | None:
    """Return the smallest window from cell (0, 0) on that has all of `window`, and all values that are not 0.

    From there, because Nav2's filter draws as many cells of its costmap anew as a mask has, counted from the costmap's
    own corner, wherever the mask lies (`KeepoutFilter::updateBounds`, navigation2@a3a97043).
    """
    rows, columns = (np.flatnonzero(values.any(axis=axis)) for axis in (1, 0))
    if not rows.size:
        return window
    before = window or Window(0, 0, 0, 0)
    return Window(0, 0, max(before.width, int(columns[-1]) + 1), max(before.height, int(rows[-1]) + 1))


def map_values(static: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return the floor plan as occupancy: 100 a wall, 0 free, -1 unknown."""
    values = np.where(static == LETHAL, FULL, 0).astype(np.int8)
    values[static == UNKNOWN] = -1
    return values


def keepout_values(cost: NDArray[np.uint8], static: NDArray[np.uint8]) -> NDArray[np.int8]:
    """Return the mask of what is lethal on the costmap and no wall of the plan: 100 there, 0 elsewhere.

    The robot's own costmap knows the walls, and has to inflate the mask by its own radius.
    """
    lethal: NDArray[np.int8] = ((cost == LETHAL) & (static != LETHAL)).view(np.int8) * np.int8(FULL)
    return lethal


def speed_values(speed: NDArray[np.uint8], limit: float | None = None) -> NDArray[np.int8]:
    """Return the mask of speed limits (`SPEED_STEP`): those of a layer in cm/s, 0 none; `limit` (m/s) holds everywhere.

    A limit of more than 1 m/s counts as 1 m/s: a mask's values end at 100.
    """
    values = np.minimum(speed, FULL)
    if limit is not None:
        everywhere = np.uint8(round(limit / SPEED_STEP))
        values = np.where(values == 0, everywhere, np.minimum(values, everywhere))
    return values.astype(np.int8)


def penalty_values(zones: Iterable[Zone], geometry: GridGeometry) -> NDArray[np.int8]:
    """Return what penalty zones cost (height, width) in the units of a keepout mask, which has costs below lethal, too.

    Nav2 makes `value * 254 / 100` of a value, the cost that the zone has on Fognav's own map. Empty without any.
    """
    found = [zone for zone in zones if zone.kind == "PENALTY" and zone.factor is not None]
    values = np.zeros(geometry.shape if found else (0, 0), np.int8)
    for zone in found:
        window, cells = shape_spans(zone.shape, geometry).to_mask()
        part = values[window.rows, window.columns]
        part[cells] = np.maximum(part[cells], round(penalty_cost(zone.factor or 1.0) * FULL / LETHAL))
    return values


def closed_cells(hazards: Iterable[HazardArea], zones: Iterable[Zone], geometry: GridGeometry) -> NDArray[np.bool_]:
    """Return which cells (height, width) hazards and no-go zones close, whatever stands there."""
    closed = np.zeros(geometry.shape, np.bool_)
    spans = [polygon_spans(each.polygon, geometry) for each in hazards if each.hazard.penalty >= LETHAL]
    spans += [shape_spans(zone.shape, geometry) for zone in zones if zone.kind == "BLOCKED"]
    for window, cells in (each.to_mask() for each in spans):
        closed[window.rows, window.columns] |= cells
    return closed


def filter_info(kind: int, mask_topic: str, stamp: float) -> RosMessage:
    """Return what a costmap filter must know of its mask."""
    return message(
        "nav2_msgs/msg/CostmapFilterInfo",
        header=header(stamp),
        type=kind,
        filter_mask_topic=f"/{mask_topic}",
        base=0.0,
        multiplier=1.0 if kind == KEEPOUT else SPEED_STEP,
    )


# --- Markers ----------------------------------------------------------------------------------------------------------


def markers(
    hazards: Mapping[str, HazardArea], zones: Sequence[Zone], geometry: GridGeometry | None, stamp: float
) -> RosMessage:
    """Return the hazards as outlines and the zones in force as stripes, with words; replaces all markers before.

    Zones are drawn by their cells, of whatever shape they are, once the map's `geometry` is known.
    """
    found = [_marker("all", 0, _DELETE_ALL, stamp)]
    for area, hazard in sorted(hazards.items()):
        if (state := hazard.hazard.state) in _COLOURS:
            ring = [(float(x), float(y)) for x, y in (*hazard.polygon, hazard.polygon[0])]
            found += _drawn("hazards", len(found), ring, state, f"{hazard.label or area}: {state}", stamp)
    for zone in zones:
        if geometry is not None and (lines := _stripes(zone.shape, geometry)):
            words = f"{zone.id}: {zone.reason}" if zone.reason else zone.id
            found += _drawn("zones", len(found), lines, zone.kind, words, stamp)
    return message("visualization_msgs/msg/MarkerArray", markers=found)


def _stripes(shape: Shape, geometry: GridGeometry) -> list[tuple[float, float]]:
    """Return the begins and ends of lines through a shape's cells."""
    spans, size = shape_spans(shape, geometry), geometry.resolution
    lines: list[tuple[float, float]] = []
    for row, start, stop in zip(spans.rows, spans.starts, spans.stops, strict=True):
        if (row - spans.window.y) % _STRIPE_ROWS == 0:
            y = geometry.origin_y + (float(row) + 0.5) * size
            lines += [(geometry.origin_x + float(column) * size, y) for column in (start, stop)]
    return lines


def _drawn(
    namespace: str, number: int, points: Sequence[tuple[float, float]], colour: str, words: str, stamp: float
) -> Iterator[RosMessage]:
    """Yield lines, those of hazards in one piece, and words in their middle."""
    kind = _LINE_STRIP if namespace == "hazards" else _LINE_LIST
    line = _marker(namespace, number, 0, stamp, kind=kind, colour=_COLOURS[colour])
    line.points = [message("geometry_msgs/msg/Point", x=x, y=y, z=0.0) for x, y in points]
    yield line
    x, y = np.mean(points, axis=0)
    yield _marker(
        namespace, number + 1, 0, stamp, kind=_TEXT, colour=_COLOURS[colour], at=(float(x), float(y)), text=words
    )


def _marker(  # noqa: PLR0913  # what markers differ in
    namespace: str, number: int, action: int, stamp: float, *, kind: int = 0,
    colour: tuple[float, float, float] = (0.0, 0.0, 0.0), at: tuple[float, float] = (0.0, 0.0), text: str = "",
) -> RosMessage:  # fmt: skip
    red, green, blue = colour
    size = _TEXT_HEIGHT if kind == _TEXT else _LINE_WIDTH
    empty = np.zeros(0, dtype=np.uint8)
    stopped = message("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    return message(
        "visualization_msgs/msg/Marker",
        header=header(stamp), ns=namespace, id=number, type=kind, action=action,
        pose=pose(*at, 0.0, z=0.1), scale=message("geometry_msgs/msg/Vector3", x=size, y=size, z=size),
        color=message("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
        lifetime=message("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=False, points=[], colors=[],
        texture_resource="",
        texture=message(
            "sensor_msgs/msg/CompressedImage",
            header=message("std_msgs/msg/Header", stamp=stopped, frame_id=""), format="", data=empty,
        ),
        uv_coordinates=[], text=text,
        mesh_resource="", mesh_file=message("visualization_msgs/msg/MeshFile", filename="", data=empty),
        mesh_use_embedded_materials=False,
    )  # fmt: skip


# --- Robots -----------------------------------------------------------------------------------------------------------


def robot_pose(told: RobotPose) -> RosMessage:
    """Return a robot's pose with its covariance (x, y, z, roll, pitch, yaw)."""
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = np.reshape(told.covariance, (3, 3))
    return message(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(told.stamp),
        pose=message(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=pose(told.x, told.y, told.theta),
            covariance=covariance.ravel(),
        ),
    )


def transform(x: float, y: float, theta: float, child: str, stamp: float) -> RosMessage:
    """Return the transform of a frame in `map`: of a robot's base, or where its lidar sees from."""
    return message(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            message(
                "geometry_msgs/msg/TransformStamped",
                header=header(stamp),
                child_frame_id=child,
                transform=message(
                    "geometry_msgs/msg/Transform",
                    translation=message("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0),
                    rotation=_turned(theta),
                ),
            )
        ],
    )


def scan(view: View, robot: str, stamp: float) -> RosMessage:
    """Return what a robot's lidar sees as a scan in the frame `ROBOT/view`, which is turned as the map is.

    Each of its ranges is the nearest of a sector of 2 degrees; NaN: nothing is known of that direction.
    """
    width = 2.0 * math.pi / VIEW_SECTORS
    units = np.frombuffer(view.reach, np.uint8)
    return message(
        "sensor_msgs/msg/LaserScan",
        header=header(stamp, f"{ros_name(robot)}/view"),
        angle_min=0.5 * width, angle_max=(VIEW_SECTORS - 0.5) * width, angle_increment=width,
        time_increment=0.0, scan_time=ROBOT_OBSTACLES.period_s, range_min=0.0, range_max=255 * REACH_UNIT_M,
        ranges=np.where(units > 0, REACH_UNIT_M * units, np.nan).astype(np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )  # fmt: skip


def path(told: RobotPath | None, stamp: float) -> RosMessage:
    """Return a robot's path by its corners; empty while there is none."""
    return way([], stamp) if told is None else way(told.points, stamp, told.goal_theta)


def way(points: Sequence[tuple[float, float]], stamp: float, goal_theta: float | None = None) -> RosMessage:
    """Return a path by its corners, each turned towards the next, and the last to `goal_theta`, if it is given."""
    poses = []
    for index, (x, y) in enumerate(points):
        begin, end = (points[index], points[index + 1]) if index + 1 < len(points) else points[-2:] or (points[0],) * 2
        theta = math.atan2(end[1] - begin[1], end[0] - begin[0])
        if index + 1 == len(points) and goal_theta is not None:
            theta = goal_theta
        poses.append(message("geometry_msgs/msg/PoseStamped", header=header(stamp), pose=pose(x, y, theta)))
    return message("nav_msgs/msg/Path", header=header(stamp), poses=poses)


def battery(told: RobotState, stamp: float) -> RosMessage:
    """Return a robot's battery (what is not measured is NaN, as sensor_msgs says)."""
    nothing = np.zeros(0, dtype=np.float32)
    known = told.power or Power()

    def measured(value: float | None) -> float:
        return _NEVER if value is None else value

    return message(
        "sensor_msgs/msg/BatteryState",
        header=header(stamp, ""),
        voltage=measured(known.voltage_v), temperature=measured(known.temperature_c),
        current=measured(known.current_a), charge=measured(known.charge_ah), capacity=measured(known.capacity_ah),
        design_capacity=_NEVER, percentage=measured(told.battery),
        power_supply_status=_CHARGING.get(known.charging or "", 0), power_supply_health=0, power_supply_technology=0,
        present=True, cell_voltage=nothing, cell_temperature=nothing, location="", serial_number="",
    )  # fmt: skip
