"""A robot of others for the demo: it knows of Fognav only what messages of ROS 2 say. `python -m fognav_sim.guest`.

It has a map, a keepout and a speed mask, and where Fognav's robot is, all over the wire of rmw_zenoh, read and written
here by itself; a planner (Dijkstra on cells of 0.2 m, with its own inflation); and wheels that do what they are told.
No sensor of it sees anything. At its goal, or when it is ended, it writes its drive as one JSON object.
"""

from __future__ import annotations

import heapq
import itertools
import json
import math
import signal
import struct
import sys
import threading
import time
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
import zenoh
import zenoh.ext

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import FrameType

    from numpy.typing import NDArray

    Point = tuple[float, float]

NAME: Final = "guest"
RADIUS_M: Final = 0.2
SPEED_M_S: Final = 0.25
AHEAD_M: Final = 2.0
"""It sets out once Fognav's robot, which starts at the same place, is so far ahead."""
KEEP_M: Final = 1.5
"""It stops this far behind that robot ..."""
ARRIVED_M: Final = 1.8
"""... and is at its goal this far from it: that robot is there already."""
_CELL_M: Final = 0.2
_LETHAL: Final = 100
"""What Nav2 makes a lethal cell of."""
_KEEP_OFF_M: Final = 0.3
_STEP_S: Final = 0.1
_CHANGED_M: Final = 0.6
"""A way whose length differs by more is another one."""
_TRAIL_S: Final = 0.5
_POSE_HASH: Final = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"


class Grid(NamedTuple):
    """An OccupancyGrid: cells (height, width), row 0 at the bottom; resolution and origin in m."""

    cells: NDArray[np.int8]
    resolution: float
    x: float
    y: float

    @classmethod
    def decoded(cls, data: bytes) -> Grid:
        """Read one from CDR, little-endian: its header, geometry and cells."""
        at = _after_header(data)
        _, _, resolution, width, height = struct.unpack_from("<iIfII", data, at)
        at = _aligned(at + 20, 8)
        x, y = struct.unpack_from("<dd", data, at)
        cells = np.frombuffer(data, np.int8, width * height, at + 7 * 8 + 4)
        return cls(cells.reshape(height, width), resolution, x, y)

    def at(self, point: Point) -> int:
        """Return the value at a point (m); -1 off the grid."""
        row, column = int((point[1] - self.y) / self.resolution), int((point[0] - self.x) / self.resolution)
        inside = 0 <= row < self.cells.shape[0] and 0 <= column < self.cells.shape[1]
        return int(self.cells[row, column]) if inside else -1


def _aligned(at: int, size: int) -> int:
    """Return the next offset at which CDR puts a value of a size: it counts from behind its own header, of 4 bytes."""
    return (at - 4 + size - 1) // size * size + 4


def _after_header(data: bytes) -> int:
    """Return where a std_msgs/Header ends: stamp, and a text with its length."""
    (length,) = struct.unpack_from("<I", data, 12)
    return _aligned(16 + int(length), 4)


def _pose_of(data: bytes) -> Point:
    """Return x and y of a PoseWithCovarianceStamped."""
    x, y = struct.unpack_from("<dd", data, _aligned(_after_header(data), 8))
    return float(x), float(y)


def _encoded_pose(x: float, y: float, theta: float, now: float) -> bytes:
    """Return a PoseWithCovarianceStamped in the frame `map`."""
    head = b"\0\1\0\0" + struct.pack("<iII4s", int(now), int(now % 1.0 * 1e9), 4, b"map\0")
    values = (x, y, 0.0, 0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0), *[0.0] * 36)
    return head + bytes(_aligned(len(head), 8) - len(head)) + struct.pack("<43d", *values)


def blocked_cells(floor: Grid, keepout: Grid | None) -> NDArray[np.bool_]:
    """Return which cells of `_CELL_M` the robot's centre must keep off: walls, unknown floor and what is kept out."""
    closed = floor.cells != 0
    if keepout is not None:  # its mask has a part of the floor only
        row, column = (round((a - b) / floor.resolution) for a, b in ((keepout.y, floor.y), (keepout.x, floor.x)))
        height, width = keepout.cells.shape
        closed[row : row + height, column : column + width] |= keepout.cells == _LETHAL
    factor = round(_CELL_M / floor.resolution)
    rows, columns = (size // factor for size in closed.shape)
    coarse = closed[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor).any(axis=(1, 3))
    reach = math.ceil((RADIUS_M + _KEEP_OFF_M) / _CELL_M) - 1
    grown: NDArray[np.bool_] = coarse.copy()
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            grown |= np.roll(coarse, (dy, dx), axis=(0, 1))
    return grown


def plan(floor: Grid, keepout: Grid | None, start: Point, goal: Point) -> list[Point]:
    """Return the shortest way over free cells; empty without any (Dijkstra 1959)."""
    blocked = blocked_cells(floor, keepout)
    first, last = (
        (int((point[1] - floor.y) / _CELL_M), int((point[0] - floor.x) / _CELL_M)) for point in (start, goal)
    )
    cost, before, waiting = {first: 0.0}, {first: first}, [(0.0, first)]
    while waiting:
        spent, cell = heapq.heappop(waiting)
        if cell == last:
            break
        if spent > cost[cell]:
            continue
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            other = cell[0] + dy, cell[1] + dx
            inside = 0 <= other[0] < blocked.shape[0] and 0 <= other[1] < blocked.shape[1]
            # It may leave what is blocked, by a metre, and enter nothing that is.
            leaves = bool(blocked[cell]) and math.dist(other, first) * _CELL_M <= 1.0
            if not inside or (blocked[other] and not leaves):
                continue
            if (longer := spent + math.hypot(dx, dy)) < cost.get(other, math.inf):
                cost[other], before[other] = longer, cell
                heapq.heappush(waiting, (longer, other))
    if last not in before:
        return []
    cells = [last]
    while cells[-1] != first:
        cells.append(before[cells[-1]])
    return [(floor.x + (column + 0.5) * _CELL_M, floor.y + (row + 0.5) * _CELL_M) for row, column in reversed(cells)]


def _length(way: Sequence[Point]) -> float:
    return sum(math.dist(*pair) for pair in itertools.pairwise(way))


class Guest:
    """The robot, and what it was told last; messages arrive on other threads."""

    def __init__(self, start: Point, goal: Point) -> None:
        self.at, self.theta, self.goal = start, 0.0, goal
        self.floor: Grid | None = None
        self.keepout: Grid | None = None
        self.speed: Grid | None = None
        self.host: Point | None = None
        """Where Fognav's robot is."""
        self.plans: list[list[Point]] = []
        self.trail: list[tuple[float, float, float]] = []
        self.masks = 0
        self.stood_s = self.driven_m = 0.0
        self._start = start
        self._way: list[Point] = []
        self._planned_on: object = None
        self.is_driving = False
        """Whether it has set out: before, Fognav's robot stands where it begins."""

    @property
    def has_arrived(self) -> bool:
        """Whether it is at its goal."""
        return math.dist(self.at, self.goal) <= ARRIVED_M

    def on_keepout(self, mask: Grid) -> None:
        """Take a keepout mask."""
        self.keepout, self.masks = mask, self.masks + 1

    def step(self, seconds: float, now: float) -> None:
        """Drive for so long (s)."""
        host = self.host
        if self.floor is None or self.keepout is None or host is None:
            return
        self.is_driving = self.is_driving or math.dist(self._start, host) >= AHEAD_M
        if not self.is_driving:
            return
        if self._planned_on is not self.keepout:
            self._planned_on = self.keepout
            self._replan()
        if not self.trail or now - self.trail[-1][0] >= _TRAIL_S:
            self.trail.append((round(now, 2), round(self.at[0], 3), round(self.at[1], 3)))
        limit = max(0, self.speed.at(self.at)) / 100.0 if self.speed is not None else 0.0
        self._advance(seconds * min(SPEED_M_S, limit or SPEED_M_S), seconds, host)

    def _replan(self) -> None:
        assert self.floor is not None
        way = plan(self.floor, self.keepout, self.at, self.goal)
        if not self.plans or abs(_length([self.at, *self._way]) - _length(way)) > _CHANGED_M:
            self.plans.append(way)
        self._way = way[1:]

    def _advance(self, step: float, seconds: float, host: Point) -> None:
        away = math.dist(self.at, host)
        if not self._way or (away < KEEP_M and math.dist(self._ahead(), host) < away):
            self.stood_s += seconds
            return
        while self._way and step > 0.0:
            target = self._way[0]
            left = math.dist(self.at, target)
            if left > 0.0:
                self.theta = math.atan2(target[1] - self.at[1], target[0] - self.at[0])
            share = min(1.0, step / left) if left > 0.0 else 1.0
            self.at = self.at[0] + share * (target[0] - self.at[0]), self.at[1] + share * (target[1] - self.at[1])
            self.driven_m, step = self.driven_m + min(step, left), step - left
            if share == 1.0:
                self._way.pop(0)

    def _ahead(self) -> Point:
        """Return where it will be soon."""
        return self._way[min(len(self._way) - 1, round(1.0 / _CELL_M))]

    def report(self) -> dict[str, object]:
        """Return what became of its drive."""
        return {
            "reached": self.has_arrived, "driven_m": round(self.driven_m, 1), "stood_s": round(self.stood_s, 1),
            "masks": self.masks, "plans": self.plans, "trail": self.trail,
        }  # fmt: skip


def drive(guest: Guest, session: zenoh.Session, site: str, host: str, speed: float, ended: threading.Event) -> None:
    """Drive until the goal is reached, or the end is asked for; `speed`: simulated seconds per second."""
    base, every = f"0/fognav/{site}", "nav_msgs::msg::dds_::OccupancyGrid_/*"

    def on_map(sample: zenoh.Sample) -> None:
        guest.floor = Grid.decoded(sample.payload.to_bytes())

    def on_speed(sample: zenoh.Sample) -> None:
        guest.speed = Grid.decoded(sample.payload.to_bytes())

    def on_host(sample: zenoh.Sample) -> None:
        guest.host = _pose_of(sample.payload.to_bytes())

    def on_keepout(sample: zenoh.Sample) -> None:
        guest.on_keepout(Grid.decoded(sample.payload.to_bytes()))

    kind = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
    heard: Sequence[object] = [
        *(
            zenoh.ext.declare_advanced_subscriber(
                session, f"{base}/{name}/{every}", handler, history=zenoh.ext.HistoryConfig(detect_late_publishers=True)
            )
            for name, handler in (("map", on_map), ("keepout_mask", on_keepout), ("speed_mask", on_speed))
        ),
        session.declare_subscriber(f"0/{host}/pose/{kind}/*", on_host),
    ]
    assert heard
    number = 0
    while not ended.wait(_STEP_S) and not guest.has_arrived:
        guest.step(_STEP_S * speed, time.monotonic() * speed)
        if not guest.is_driving:
            continue
        number += 1
        attachment = struct.pack("<qqB", number, time.time_ns(), 16) + bytes(16)
        pose = _encoded_pose(*guest.at, guest.theta, time.time())
        session.put(f"0/{NAME}/amcl_pose/{kind}/{_POSE_HASH}", pose, attachment=attachment)


def main() -> None:
    """Drive as the command line says: ROUTER SITE HOST START_X START_Y GOAL_X GOAL_Y SPEED."""
    router, site, host = sys.argv[1:4]
    x, y, goal_x, goal_y, speed = map(float, sys.argv[4:9])
    ended = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        ended.set()

    signal.signal(signal.SIGTERM, on_signal)
    config = zenoh.Config()
    for key, value in (("mode", "client"), ("connect/endpoints", [router]), ("scouting/multicast/enabled", False)):
        config.insert_json5(key, json.dumps(value))
    guest = Guest((x, y), (goal_x, goal_y))
    with zenoh.open(config) as session:
        drive(guest, session, site, host, speed, ended)
    sys.stdout.write(json.dumps(guest.report()) + "\n")


if __name__ == "__main__":
    main()
