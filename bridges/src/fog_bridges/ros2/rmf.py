"""What Open-RMF is told of a floor: hazards and zones as obstacles, and which of its lanes are closed or slow. Pure.

Lanes are numbered as rmf_fleet_adapter numbers those of a navigation graph: level after level, as the file lists them.
Its frame must be Fognav's `map`, in m.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import yaml  # type: ignore[import-untyped]  # its stubs are a package of their own

from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.others import OWN_SOURCE
from fog_contracts.costs import LETHAL
from fog_contracts.shapes import line_spans, shape_spans

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from fog_bridges.ros2.wire import RosMessage
    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import HazardArea, Zone

    Box = tuple[float, float, float, float]

REACH_M: Final = 0.25
"""A lane is closed by what is nearer to its line: as wide as rmf_obstacle_ros2's lane blocker takes lanes."""
REPEAT_S: Final = 0.5
"""How often all is told again: adapters that start late are told nothing of what was."""
LIFETIME_S: Final = 3
_OPEN_S: Final = 5.0
"""So long an opened lane is told as open."""
_ADD, _DELETE = 1, 2


class GraphError(ValueError):
    """A navigation graph can't be used; the text names file, place and remedy."""


class Lane(NamedTuple):
    """A lane of the served level: its number in the graph, and its ends (m)."""

    number: int
    begin: tuple[float, float]
    end: tuple[float, float]


def read_graph(file: Path, level: str) -> list[Lane]:
    """Return the lanes of a level of a navigation graph (`nav_graphs/N.yaml`); raises `GraphError`."""
    try:
        levels: dict[str, dict[str, Any]] = yaml.safe_load(file.read_text("utf-8"))["levels"]
        if level not in levels:
            raise GraphError(f"{file} has no level {level!r}: set rmf_level to one of {', '.join(map(str, levels))}")
        first = 0
        for name, each in levels.items():
            if name == level:
                if any(not 0 <= end < len(each["vertices"]) for lane in each["lanes"] for end in lane[:2]):
                    raise GraphError(f"{file} is no navigation graph: a lane of {level!r} has an end that is no vertex")
                points = [(float(vertex[0]), float(vertex[1])) for vertex in each["vertices"]]
                return [Lane(first + i, points[lane[0]], points[lane[1]]) for i, lane in enumerate(each["lanes"])]
            first += len(each["lanes"])
    except OSError as error:
        raise GraphError(f"the navigation graph {file} can't be read: {error}") from error
    except (yaml.YAMLError, KeyError, IndexError, TypeError, ValueError) as error:
        if isinstance(error, GraphError):
            raise
        raise GraphError(f"{file} is no navigation graph ({error!r}): make it by rmf_building_map_tools") from error
    return []


class Traffic:
    """Which lanes are closed or slow, and what was told of it; times are those of a monotonic clock (s)."""

    def __init__(self, lanes: Sequence[Lane], fleets: Sequence[str], level: str) -> None:
        """`fleets` drive on these lanes, which are on the building's `level`; each level has obstacles of its own."""
        self._source = f"{OWN_SOURCE}/{level}"
        self.lanes, self.fleets, self.level = lanes, fleets, level
        self._geometry: GridGeometry | None = None
        self._cells: dict[int, NDArray[np.int64]] = {}
        self._closed: set[int] = set()
        self._opened: dict[int, float] = {}
        self._limits: dict[int, float] = {}
        self._unlimited: dict[int, float] = {}
        self._obstacles: dict[str, int] = {}
        self._numbers = 0
        self._told_at = -math.inf

    def update(self, keepout: NDArray[np.int8], speed: NDArray[np.int8], geometry: GridGeometry, now: float) -> bool:
        """Take the newest masks (height, width); return whether lanes have changed, or it is time to tell all again."""
        if geometry != self._geometry:
            self._geometry = geometry
            self._cells = {lane.number: _cells(lane, geometry) for lane in self.lanes}
        closed = {number for number, cells in self._cells.items() if (keepout.flat[cells] == ros.FULL).any()}
        limits: dict[int, float] = {}
        for number, cells in self._cells.items():
            found = speed.flat[cells]
            if (slow := found[found > 0]).size:
                limits[number] = round(float(slow.min()) * ros.SPEED_STEP, 2)
        changed = closed != self._closed or limits != self._limits
        if not changed and now - self._told_at < REPEAT_S:
            return False
        self._opened = {n: at for n, at in self._opened.items() if now - at < _OPEN_S and n not in closed}
        self._opened |= dict.fromkeys(self._closed - closed, now)
        self._unlimited = {n: at for n, at in self._unlimited.items() if now - at < _OPEN_S and n not in limits}
        self._unlimited |= dict.fromkeys(self._limits.keys() - limits.keys(), now)
        self._closed, self._limits, self._told_at = closed, limits, now
        return True

    def lane_requests(self) -> list[RosMessage]:
        """Return for each fleet which lanes to close, and which of those that this bridge has closed to open."""
        return [
            ros.message(
                "rmf_fleet_msgs/msg/LaneRequest", fleet_name=fleet, open_lanes=_numbers(self._opened),
                close_lanes=_numbers(self._closed),
            )
            for fleet in self.fleets
        ]  # fmt: skip

    def speed_requests(self) -> list[RosMessage]:
        """Return for each fleet the speed limits (m/s) of lanes, and which of this bridge's to remove."""
        return [
            ros.message(
                "rmf_fleet_msgs/msg/SpeedLimitRequest", fleet_name=fleet, remove_limits=_numbers(self._unlimited),
                speed_limits=[
                    ros.message("rmf_fleet_msgs/msg/SpeedLimitedLane", lane_index=number, speed_limit=limit)
                    for number, limit in sorted(self._limits.items())
                ],
            )
            for fleet in self.fleets
        ]  # fmt: skip

    def obstacles(
        self, hazards: Mapping[str, HazardArea], zones: Iterable[Zone], geometry: GridGeometry, stamp: float
    ) -> RosMessage:
        """Return blocked areas and no-go zones as boxes around them; what is gone since the last call is deleted."""
        found: dict[str, tuple[Box, str]] = {}
        for area, hazard in hazards.items():
            if hazard.hazard.penalty >= LETHAL:
                xs, ys = zip(*hazard.polygon, strict=True)
                found[f"area {area}"] = (min(xs), min(ys), max(xs), max(ys)), "hazard"
        for zone in zones:
            if zone.kind == "BLOCKED":
                window, size = shape_spans(zone.shape, geometry).window, geometry.resolution
                x, y = geometry.origin_x + window.x * size, geometry.origin_y + window.y * size
                found[f"zone {zone.id}"] = (x, y, x + window.width * size, y + window.height * size), "zone"
        told = [self._obstacle(self._number(name), box, kind, _ADD, stamp) for name, (box, kind) in found.items()]
        gone = [number for name, number in self._obstacles.items() if name not in found]
        told += [self._obstacle(number, (0.0, 0.0, 1.0, 1.0), "", _DELETE, stamp) for number in gone]
        self._obstacles = {name: self._number(name) for name in found}
        return ros.message("rmf_obstacle_msgs/msg/Obstacles", header=ros.header(stamp), obstacles=told)

    def _number(self, name: str) -> int:
        if name not in self._obstacles:
            self._numbers += 1
            self._obstacles[name] = self._numbers
        return self._obstacles[name]

    def _obstacle(self, number: int, box: Box, kind: str, action: int, stamp: float) -> RosMessage:
        left, bottom, right, top = box
        return ros.message(
            "rmf_obstacle_msgs/msg/Obstacle", header=ros.header(stamp), id=number, source=self._source,
            level_name=self.level, classification=kind, data_resolution=0.0, data=np.zeros(0, np.int8), action=action,
            bbox=ros.message(
                "rmf_obstacle_msgs/msg/BoundingBox3D",
                center=ros.pose(0.5 * (left + right), 0.5 * (bottom + top), 0.0, z=0.5),
                size=ros.message("geometry_msgs/msg/Vector3", x=right - left, y=top - bottom, z=1.0),
            ),
            lifetime=ros.message("builtin_interfaces/msg/Duration", sec=LIFETIME_S, nanosec=0),
        )  # fmt: skip


def _numbers(lanes: Iterable[int]) -> NDArray[np.uint64]:
    return np.array(sorted(lanes), np.uint64)


def _cells(lane: Lane, geometry: GridGeometry) -> NDArray[np.int64]:
    """Return the numbers of a lane's cells, counted row by row."""
    found = line_spans([lane.begin, lane.end], REACH_M, geometry)
    rows = [
        np.arange(start, stop) + int(row) * geometry.width
        for row, start, stop in zip(found.rows, found.starts, found.stops, strict=True)
    ]
    return np.concatenate(rows) if rows else np.zeros(0, np.int64)
