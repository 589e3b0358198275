"""A robot of others for the demo: it knows of Fognav only what messages of ROS 2 say. `python -m fognav_sim.guest`.

As one of Open-RMF's it knows which lanes of its navigation graph are closed, and drives along the others. Else it has a
keepout and a speed mask, and a planner of its own (Dijkstra on cells of 0.2 m, with its own inflation). It knows where
Fognav's robot is, all over the wire of rmw_zenoh, read and written here by itself; its wheels do what they are told,
and no sensor of it sees anything. At its goal, or when it is ended, it writes its drive as one JSON object.
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
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

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
LANE_M: Final = 0.8
"""The length of the lanes that a robot of Open-RMF's drives along."""
_CELL_M: Final = 0.2
_LETHAL: Final = 100
"""What Nav2 makes a lethal cell of."""
_KEEP_OFF_M: Final = 0.3
STEP_S: Final = 0.1
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


def lattice(floor: Grid) -> dict[str, list[Any]]:
    """Return a level of a navigation graph of Open-RMF over a floor: vertices `LANE_M` apart, lanes both ways."""
    blocked, every = blocked_cells(floor, None), round(LANE_M / _CELL_M)
    free = [(int(r), int(c)) for r, c in np.argwhere(~blocked) if r % every == 0 and c % every == 0]
    numbers = {cell: number for number, cell in enumerate(free)}
    lanes = []
    for (row, column), number in numbers.items():
        for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
            other = numbers.get((row + every * dy, column + every * dx))
            if other is not None and not any(blocked[row + n * dy, column + n * dx] for n in range(every)):
                lanes += [[number, other, {}], [other, number, {}]]
    vertices = [[floor.x + (c + 0.5) * _CELL_M, floor.y + (r + 0.5) * _CELL_M, {}] for r, c in free]
    return {"vertices": vertices, "lanes": lanes}


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
        way = self._way_from(self.at)
        if not self.plans or abs(_length([self.at, *self._way]) - _length(way)) > _CHANGED_M:
            self.plans.append(way)
        self._way = way[1:]

    def _way_from(self, at: Point) -> list[Point]:
        assert self.floor is not None
        return plan(self.floor, self.keepout, at, self.goal)

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
        near = (point for point in self._way if math.dist(point, self.at) >= 1.0)
        return next(near, self._way[-1])

    def report(self) -> dict[str, object]:
        """Return what became of its drive."""
        return {
            "reached": self.has_arrived, "driven_m": round(self.driven_m, 1), "stood_s": round(self.stood_s, 1),
            "masks": self.masks, "plans": self.plans, "trail": self.trail,
        }  # fmt: skip


class LaneGuest(Guest):
    """A robot of Open-RMF's: it drives along lanes, and along none that is closed."""

    def __init__(self, start: Point, goal: Point, graph: dict[str, list[Any]], fleet: str) -> None:
        super().__init__(start, goal)
        self._vertices: list[Point] = [(x, y) for x, y, _ in graph["vertices"]]
        self._lanes, self._fleet = [(a, b) for a, b, _ in graph["lanes"]], fleet
        self._closed: set[int] | None = None

    def on_lanes(self, data: bytes) -> None:
        """Take a LaneRequest: the fleet's name, lanes to open and lanes to close."""
        (length,) = struct.unpack_from("<I", data, 4)
        fleet, at, numbers = data[8 : 7 + length].decode(), 8 + length, []
        for _ in range(2):
            (count,) = struct.unpack_from("<I", data, at := _aligned(at, 4))
            at = _aligned(at + 4, 8) if count else at + 4
            numbers.append(set(struct.unpack_from(f"<{count}Q", data, at)))
            at += 8 * count
        closed = ((self._closed or set()) - numbers[0]) | numbers[1]
        if fleet == self._fleet and closed != self._closed and self.floor is not None:
            self._closed = closed
            self.on_keepout(self.floor._replace())  # another one: a reason to plan anew

    def _way_from(self, at: Point) -> list[Point]:
        ends: dict[int, list[int]] = {}
        for number, (a, b) in enumerate(self._lanes):
            if number not in (self._closed or ()):
                ends.setdefault(a, []).append(b)
        first, last = (
            min(range(len(self._vertices)), key=lambda n: math.dist(self._vertices[n], point))
            for point in (at, self.goal)
        )
        cost, before, waiting = {first: 0.0}, {first: first}, [(0.0, first)]
        while waiting:
            spent, vertex = heapq.heappop(waiting)
            if vertex == last:
                break
            for other in ends.get(vertex, ()):
                longer = spent + math.dist(self._vertices[vertex], self._vertices[other])
                if longer < cost.get(other, math.inf):
                    cost[other], before[other] = longer, vertex
                    heapq.heappush(waiting, (longer, other))
        if last not in before:
            return []
        found = [last]
        while found[-1] != first:
            found.append(before[found[-1]])
        return [at, *(self._vertices[n] for n in reversed(found)), self.goal]


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
        if not isinstance(guest, LaneGuest):
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
    if isinstance(guest, LaneGuest):
        lanes = "0/lane_closure_requests/rmf_fleet_msgs::msg::dds_::LaneRequest_/*"
        heard = [*heard, session.declare_subscriber(lanes, lambda sample: guest.on_lanes(sample.payload.to_bytes()))]
    assert heard
    number = 0
    while not ended.wait(STEP_S) and not guest.has_arrived:
        guest.step(STEP_S * speed, time.monotonic() * speed)
        if not guest.is_driving:
            continue
        number += 1
        attachment = struct.pack("<qqB", number, time.time_ns(), 16) + bytes(16)
        pose = _encoded_pose(*guest.at, guest.theta, time.time())
        session.put(f"0/{NAME}/amcl_pose/{kind}/{_POSE_HASH}", pose, attachment=attachment)


def main() -> None:
    """Drive as the command line says: ROUTER SITE HOST START_X START_Y GOAL_X GOAL_Y SPEED [GRAPH FLEET]."""
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
    if len(sys.argv) > 9:  # with the two that may be left out
        graph = json.loads(Path(sys.argv[9]).read_text("utf-8"))["levels"]
        guest = LaneGuest((x, y), (goal_x, goal_y), next(iter(graph.values())), sys.argv[10])
    with zenoh.open(config) as session:
        drive(guest, session, site, host, speed, ended)
    sys.stdout.write(json.dumps(guest.report()) + "\n")


if __name__ == "__main__":
    main()
