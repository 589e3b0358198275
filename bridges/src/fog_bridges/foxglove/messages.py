"""What a floor tells, as messages of Foxglove's schemas (docs.foxglove.dev/docs/sdk/schemas): metres, frame `map`.

`foxglove-sdk` encodes them. Pure.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from foxglove import messages as fox

from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS
from fog_contracts.shapes import shape_spans

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import HazardArea, RobotObstacles, RobotPath, RobotPose, Zone

FRAME: Final = "map"
_LINE_M: Final = 0.08
_TEXT_M: Final = 0.4
_NOSE_M: Final = 0.05
_STRIPE_ROWS: Final = 4
_COLOURS: Final = {
    "blocked": (0.84, 0.15, 0.16),
    "unknown": (1.0, 0.6, 0.0),
    "BLOCKED": (0.55, 0.1, 0.55),
    "PENALTY": (0.3, 0.45, 0.75),
    "SPEED_LIMIT": (0.2, 0.6, 0.6),
    "RELEASE": (0.75, 0.6, 0.1),
}
_ROBOT: Final = (0.2, 0.4, 0.8)


def _time(stamp: float) -> fox.Timestamp:
    return fox.Timestamp(int(stamp), int(stamp % 1.0 * 1e9))


def _pose(x: float, y: float, theta: float = 0.0, z: float = 0.0) -> fox.Pose:
    return fox.Pose(position=fox.Vector3(x=x, y=y, z=z), orientation=_turned(theta))


def _turned(theta: float) -> fox.Quaternion:
    return fox.Quaternion(x=0.0, y=0.0, z=math.sin(theta / 2.0), w=math.cos(theta / 2.0))


def costmap(cost: NDArray[np.uint8], geometry: GridGeometry, stamp: float) -> bytes:
    """Return a `Grid` of a costmap's costs: 0 free to 254 lethal, 255 unknown."""
    field = fox.PackedElementField(name="cost", offset=0, type=fox.PackedElementFieldNumericType.Uint8)
    return fox.Grid(
        timestamp=_time(stamp),
        frame_id=FRAME,
        pose=_pose(geometry.origin_x, geometry.origin_y),
        column_count=geometry.width,
        cell_size=fox.Vector2(x=geometry.resolution, y=geometry.resolution),
        row_stride=geometry.width,
        cell_stride=1,
        fields=[field],
        data=cost.tobytes(),
    ).encode()


def hazards(areas: Mapping[str, HazardArea], stamp: float) -> bytes:
    """Return a `SceneUpdate` with the outline of each hazard and what it is, in place of all before."""
    found = []
    for area, hazard in sorted(areas.items()):
        if (state := hazard.hazard.state) in _COLOURS:
            words = f"{hazard.label or area}: {state}" + ("" if hazard.confirmed else " (not confirmed)")
            ring = [(float(x), float(y)) for x, y in (*hazard.polygon, hazard.polygon[0])]
            values = {"state": state, "cause": hazard.hazard.cause, "severity": str(hazard.hazard.severity)}
            found.append(_entity(area, [ring], state, words, values, stamp))
    return _scene(found, stamp)


def zones(in_force: Sequence[Zone], geometry: GridGeometry, stamp: float) -> bytes:
    """Return a `SceneUpdate` with stripes over the cells of each zone, in place of all before."""
    found = []
    for zone in in_force:
        if lines := list(_stripes(zone, geometry)):
            words = f"{zone.id}: {zone.reason}" if zone.reason else str(zone.id)
            values = {"kind": str(zone.kind), "author": zone.author or "", "reason": zone.reason}
            found.append(_entity(str(zone.id), lines, zone.kind, words, values, stamp))
    return _scene(found, stamp)


def _stripes(zone: Zone, geometry: GridGeometry) -> Iterator[list[tuple[float, float]]]:
    spans, size = shape_spans(zone.shape, geometry), geometry.resolution
    for row, start, stop in zip(spans.rows, spans.starts, spans.stops, strict=True):
        if (row - spans.window.y) % _STRIPE_ROWS == 0:
            y = geometry.origin_y + (float(row) + 0.5) * size
            yield [(geometry.origin_x + float(column) * size, y) for column in (start, stop)]


def _entity(  # what entities differ in
    name: str,
    lines: Sequence[Sequence[tuple[float, float]]],
    colour: str,
    words: str,
    values: Mapping[str, str],
    stamp: float,
) -> fox.SceneEntity:
    red, green, blue = _COLOURS[colour]
    shown = fox.Color(r=red, g=green, b=blue, a=1.0)
    points = [point for line in lines for point in line]
    middle = [sum(each) / len(points) for each in zip(*points, strict=True)]
    return fox.SceneEntity(
        timestamp=_time(stamp),
        frame_id=FRAME,
        id=name,
        lines=[
            fox.LinePrimitive(
                type=fox.LinePrimitiveLineType.LineStrip,
                pose=_pose(0.0, 0.0, z=0.1),
                thickness=_LINE_M,
                points=[fox.Point3(x=x, y=y, z=0.0) for x, y in line],
                color=shown,
            )
            for line in lines
        ],
        texts=[
            fox.TextPrimitive(
                pose=_pose(middle[0], middle[1], z=0.2), billboard=True, font_size=_TEXT_M, color=shown, text=words
            )
        ],
        metadata=[fox.KeyValuePair(key=key, value=value) for key, value in values.items()],
    )


def _scene(entities: list[fox.SceneEntity], stamp: float) -> bytes:
    every = fox.SceneEntityDeletion(timestamp=_time(stamp), type=fox.SceneEntityDeletionType.All, id="")
    return fox.SceneUpdate(deletions=[every], entities=entities).encode()


def robot_shape(told: RobotPose, robot: str) -> bytes:
    """Return a `SceneUpdate` of a robot as a cylinder in its own frame, with its name."""
    shown = fox.Color(r=_ROBOT[0], g=_ROBOT[1], b=_ROBOT[2], a=0.8)
    size = fox.Vector3(x=2.0 * told.radius, y=2.0 * told.radius, z=told.height)
    entity = fox.SceneEntity(
        timestamp=_time(told.stamp),
        frame_id=robot,
        frame_locked=True,
        id=robot,
        cylinders=[
            fox.CylinderPrimitive(
                pose=_pose(0.0, 0.0, z=told.height / 2.0), size=size, bottom_scale=1.0, top_scale=1.0, color=shown
            )
        ],
        arrows=[
            fox.ArrowPrimitive(
                pose=_pose(0.0, 0.0, z=told.height + _NOSE_M), shaft_length=told.radius, shaft_diameter=_NOSE_M,
                head_length=told.radius / 2.0, head_diameter=2.0 * _NOSE_M, color=shown,
            )
        ],
        texts=[
            fox.TextPrimitive(
                pose=_pose(0.0, 0.0, z=told.height + _TEXT_M), billboard=True, font_size=_TEXT_M / 2.0, color=shown,
                text=robot,
            )
        ],
    )  # fmt: skip
    return fox.SceneUpdate(entities=[entity]).encode()


def pose(told: RobotPose) -> bytes:
    """Return a robot's pose as `PoseInFrame`."""
    return fox.PoseInFrame(timestamp=_time(told.stamp), frame_id=FRAME, pose=_pose(told.x, told.y, told.theta)).encode()


def transform(told: RobotPose, robot: str) -> bytes:
    """Return the `FrameTransform` of a robot's own frame, whose name is its id."""
    return fox.FrameTransform(
        timestamp=_time(told.stamp),
        parent_frame_id=FRAME,
        child_frame_id=robot,
        translation=fox.Vector3(x=told.x, y=told.y, z=0.0),
        rotation=_turned(told.theta),
    ).encode()


def path(told: RobotPath, stamp: float) -> bytes:
    """Return a robot's path by its corners as `PosesInFrame`, each turned towards the next; empty without a path."""
    theta, poses = 0.0, []
    for index, (x, y) in enumerate(told.points):
        if index + 1 < len(told.points):
            next_x, next_y = told.points[index + 1]
            theta = math.atan2(next_y - y, next_x - x)
        poses.append(_pose(x, y, theta))
    return fox.PosesInFrame(timestamp=_time(stamp), frame_id=FRAME, poses=poses).encode()


def scan(told: RobotObstacles) -> bytes:
    """Return what a robot's lidar sees as `LaserScan`: a range for each sector, infinite without an echo.

    Its frame is `map`, turned like it, at where the robot stood.
    """
    view, width = told.view, math.tau / VIEW_SECTORS
    x, y, reach = (0.0, 0.0, b"") if view is None else (view.x, view.y, view.reach)
    return fox.LaserScan(
        timestamp=_time(told.stamp),
        frame_id=FRAME,
        pose=_pose(x, y),
        start_angle=width / 2.0,
        end_angle=math.tau - width / 2.0,
        ranges=[each * REACH_UNIT_M if each else math.inf for each in reach],
    ).encode()
