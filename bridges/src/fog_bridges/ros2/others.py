"""What nodes of ROS 2 say stands on a floor: robots of others, and obstacles, as reports for the map. Pure.

A robot is where its localization says: by `/ROBOT/amcl_pose`, or by `/ROBOT/tf`, from `map` to its base. Localization
sends the former while the robot moves only, the latter always. An obstacle is one of `rmf_obstacle_msgs`. The mask of
what is blocked leaves these robots out: who is on it can't drive off it, and they see each other by their own lidars.
"""

from __future__ import annotations

import math
import re
import zlib
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_bridges.ros2.messages import MAP_FRAME, heading
from fog_bridges.ros2.wire import RosMessage, WireError
from fog_contracts.messages import CircleShape, PolygonShape, Reported
from fog_contracts.shapes import shape_spans

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry

OTHERS_MAX_AGE_S: Final = 3.0
"""A robot of others that says nothing for so long vanishes from the map."""
PERIOD_S: Final = 0.2
"""The shortest time between two reports of one robot."""
LIFETIME_S: Final = 60.0
"""An obstacle lasts for its lifetime, and so long at most: who still sees it sends it again."""
SIZE_MAX_M: Final = 20.0
RADIUS_MAX_M: Final = 1.0
OBSTACLES_MAX: Final = 150
"""The map takes 200 things: some are left for robots."""
OWN_SOURCE: Final = "fognav"
"""The source of the obstacles that this bridge tells others of."""
_FRAMES_MAX: Final = 200
_FRAME_NAME_MAX: Final = 200
_DEPTH_MAX: Final = 8
_BASES: Final = ("base_footprint", "base_link")
_ADD, _DELETE, _DELETE_ALL = 1, 2, 3
_AROUND_M: Final = 0.2
"""So far round a robot the map may show it: its disc is drawn anew only once it has moved."""
_TRAIL: Final = 16
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")


def robot_radii(text: str) -> dict[str, float]:
    """Return the names of robots of others, and their radii (m), of `tb4:0.2, carter:0.35`; raises `ValueError`."""
    radii: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, number = part.partition(":")
        try:
            radius = float(number)
        except ValueError:
            radius = math.nan
        if not _NAME.fullmatch(name) or not 0.0 < radius <= RADIUS_MAX_M:
            raise ValueError(
                f"{part!r} names no robot: give its namespace and its radius (up to {RADIUS_MAX_M:g} m), as in tb4:0.2"
            )
        radii[name] = radius
    if len({thing_id(name) for name in radii}) < len(radii):
        raise ValueError(f"{text!r} names two robots that differ by capitals or _ only: Fognav can't tell them apart")
    return radii


def thing_id(name: str) -> str:
    """Return a namespace of ROS as an id of Fognav."""
    return name.lower().replace("_", "-")


class _Transform(NamedTuple):
    parent: str
    x: float
    y: float
    theta: float
    at: float
    """When it arrived (s, monotonic)."""


class _Obstacle(NamedTuple):
    source: str
    end: float
    told: float


class Others:
    """Robots of others by their namespaces, and obstacles; times are those of a monotonic clock (s)."""

    def __init__(self, radii: Mapping[str, float], level: str = "") -> None:
        """`radii` (m) of the robots; `level`: obstacles of other levels of the building are left out."""
        self.radii = radii
        self._level = level
        self._frames: dict[str, dict[str, _Transform]] = {name: {} for name in radii}
        self._reported: dict[str, float] = {}
        self._trails: dict[str, deque[tuple[float, CircleShape]]] = {name: deque(maxlen=_TRAIL) for name in radii}
        self._obstacles: dict[str, _Obstacle] = {}

    # --- Robots -----------------------------------------------------------------------------------------------------

    def on_pose(self, name: str, told: RosMessage, now: float) -> Reported | None:
        """Return the report of a robot's pose, None if it is too early for one; raises `WireError`."""
        check_frame(told.header.frame_id)
        pose = told.pose.pose
        return self._report(name, pose.position.x, pose.position.y, heading(pose.orientation) or 0.0, now)

    def on_transforms(self, name: str, told: RosMessage, now: float) -> Reported | None:
        """Return the report of a robot whose transforms lead from `map` to its base; None while they don't."""
        frames = self._frames[name]
        if len(frames) + len(told.transforms) > _FRAMES_MAX:
            frames = {child: found for child, found in frames.items() if now - found.at <= OTHERS_MAX_AGE_S}
            self._frames[name] = frames
        if len(told.transforms) > _FRAMES_MAX:
            raise WireError(f"{len(told.transforms)} transforms in one message, and {_FRAMES_MAX} is the limit")
        for each in told.transforms:
            child, parent = _bare(each.child_frame_id, name), _bare(each.header.frame_id, name)
            moved, turned = each.transform.translation, heading(each.transform.rotation)
            if max(len(child), len(parent)) > _FRAME_NAME_MAX:
                raise WireError(f"a frame with a name of {max(len(child), len(parent))} letters")
            if turned is None or not is_finite(moved.x, moved.y, turned):
                raise WireError(f"the transform of {child[:40]!r} is none")
            if child in frames or len(frames) < _FRAMES_MAX:
                frames[child] = _Transform(parent, moved.x, moved.y, turned, now)
        found = next((pose for base in _BASES if (pose := self._in_map(frames, base, now)) is not None), None)
        return None if found is None else self._report(name, *found, now)

    def _in_map(self, frames: Mapping[str, _Transform], frame: str, now: float) -> tuple[float, float, float] | None:
        x, y, theta = 0.0, 0.0, 0.0
        for _ in range(_DEPTH_MAX):
            found = frames.get(frame)
            if found is None or now - found.at > OTHERS_MAX_AGE_S:
                return None
            cos, sin = math.cos(found.theta), math.sin(found.theta)
            x, y, theta = found.x + cos * x - sin * y, found.y + sin * x + cos * y, theta + found.theta
            if (frame := found.parent) == MAP_FRAME:
                return x, y, math.remainder(theta, math.tau)
        return None

    def _report(self, name: str, x: float, y: float, theta: float, now: float) -> Reported | None:
        if not is_finite(x, y, theta):
            raise WireError(f"a robot at ({x}, {y})")
        if now - self._reported.get(name, -math.inf) < PERIOD_S:
            return None
        self._reported[name] = now
        shape = CircleShape(centre=(x, y), radius=self.radii[name])
        self._trails[name].append((now, shape))
        return Reported(kind="robot", shape=shape, ttl=OTHERS_MAX_AGE_S, theta=theta)

    def at(self, name: str, now: float) -> tuple[float, float] | None:
        """Return where a robot is, None if it has not said so for a while."""
        told_at, shape = self._trails[name][-1] if self._trails[name] else (-math.inf, None)
        return None if shape is None or now - told_at > OTHERS_MAX_AGE_S else shape.centre

    def moves_away(self, now: float) -> bool:
        """Forget where robots were when the map has forgotten it, too; return whether there was anything to forget."""
        gone = False
        for trail in self._trails.values():
            while trail and now - trail[0][0] > OTHERS_MAX_AGE_S + 1.0:
                trail.popleft()
                gone = True
        return gone

    def without_robots(
        self, mask: NDArray[np.int8], geometry: GridGeometry, closed: NDArray[np.bool_]
    ) -> NDArray[np.int8]:
        """Return a mask without what is blocked by robots of others alone; hazards and zones (`closed`) stay."""
        result = mask
        for name, trail in self._trails.items():
            for _, shape in trail:
                grown = CircleShape(centre=shape.centre, radius=self.radii[name] + _AROUND_M)
                window, disc = shape_spans(grown, geometry).to_mask()
                result = result.copy() if result is mask else result
                part = (window.rows, window.columns)
                result[part][disc & ~closed[part]] = 0
        return result

    # --- Obstacles --------------------------------------------------------------------------------------------------

    def on_obstacles(
        self, told: RosMessage, now: float, refuse: Callable[[WireError], object]
    ) -> Iterator[tuple[str, Reported]]:
        """Yield the reports of obstacles with their ids, and `refuse` those that are none; raises `WireError`."""
        if len(told.obstacles) > OBSTACLES_MAX:
            raise WireError(f"{len(told.obstacles)} obstacles in one message, and {OBSTACLES_MAX} is the limit")
        self._obstacles = {thing: known for thing, known in self._obstacles.items() if known.end > now}
        for each in told.obstacles:
            if each.source.startswith(OWN_SOURCE) or (self._level and each.level_name not in ("", self._level)):
                continue
            thing = f"rmf-{zlib.crc32(each.source.encode()):08x}-{each.id & 0xFFFF_FFFF}"
            try:
                if each.action == _DELETE_ALL:
                    for known in [name for name, found in self._obstacles.items() if found.source == each.source]:
                        yield known, self._gone(known)
                elif each.action == _DELETE:
                    yield thing, self._gone(thing)
                elif each.action != _ADD:
                    raise WireError(f"an obstacle with the action {each.action}")  # noqa: TRY301  # counted as the others
                elif (added := self._added(thing, each, told.header.frame_id, now)) is not None:
                    yield thing, added
            except WireError as error:
                refuse(error)

    def _added(self, thing: str, told: RosMessage, frame: str, now: float) -> Reported | None:
        """Return the report of an obstacle, None if it is too early for one."""
        check_frame(told.header.frame_id or frame)
        centre, size = told.bbox.center, told.bbox.size
        x, y, width, height = centre.position.x, centre.position.y, size.x, size.y
        if not is_finite(x, y) or not (0.0 < width <= SIZE_MAX_M and 0.0 < height <= SIZE_MAX_M):
            raise WireError(f"an obstacle of {width} x {height} m at ({x}, {y})")
        known = self._obstacles.get(thing)
        if known is not None and now - known.told < PERIOD_S:
            return None
        if known is None and len(self._obstacles) >= OBSTACLES_MAX:
            raise WireError(f"{OBSTACLES_MAX} obstacles are there already", "too_many")
        theta = heading(centre.orientation) or 0.0
        cos, sin = math.cos(theta), math.sin(theta)
        corners = [(0.5 * a * width, 0.5 * b * height) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        points = [(x + cos * dx - sin * dy, y + sin * dx + cos * dy) for dx, dy in corners]
        lifetime = told.lifetime.sec + told.lifetime.nanosec / 1e9
        ttl = min(lifetime, LIFETIME_S) if lifetime > 0.0 else LIFETIME_S
        self._obstacles[thing] = _Obstacle(told.source, now + ttl, now)
        return Reported(kind="obstacle", shape=PolygonShape(points=points), ttl=ttl)

    def _gone(self, thing: str) -> Reported:
        self._obstacles.pop(thing, None)
        return Reported(kind="obstacle", shape=None, ttl=1.0)


def _bare(frame: str, name: str) -> str:
    return frame.removeprefix("/").removeprefix(f"{name}/")


def check_frame(frame: str) -> None:
    """Raise `WireError` for a frame that is not the map's."""
    if frame.removeprefix("/") not in ("", MAP_FRAME):
        raise WireError(f"a pose in the frame {frame[:40]!r}: send it in {MAP_FRAME!r}", "frame")


def is_finite(*values: float) -> bool:
    """Whether these are numbers that a floor may have."""
    return all(abs(value) < 1e5 for value in values)  # as the messages' type `Metres`; no NaN is
