"""Obstacles that robots' lidars see: lethal until a lidar sees that they are gone.

An obstacle in a corridor is out of sight as soon as the robot turns back, so it must be kept for longer than the detour
takes; a passing person must be cleared as soon as a lidar covers the place again. Hence obstacles expire late, and a
cell is cleared when the free view of two consecutive reports reaches beyond it, as clearing by ray tracing does in
layered costmaps (Lu, Hershberger, Smart 2014). What a watched area was blocked by is gone when its sensors say so.

A point becomes a small lethal disc. Points on or near a robot belong to that robot and are left out: a robot must never
enclose another one by having seen it. A robot is believed what it can see from the pose that it reports, and a report
takes a few milliseconds, whatever it says: the map's heartbeat waits for it.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import normalized_polygon
from fog_contracts.grid import Window
from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS, Cause, CircleShape, RobotPose
from fog_contracts.shapes import ShapeMask, rasterize
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Final

    from numpy.typing import NDArray

    from fog_contracts.channels import Channel
    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import HazardArea, Reported, RobotObstacles, View
    from map_service.layers.base import Grid

MARGIN_M: Final = 0.2
"""How far behind a cell a view must reach to clear it: the cell's size plus the localization error."""
CELL_HALF_WIDTH_M: Final = 0.06
RANGE_M: Final = 6.0
"""Views clear up to this distance (m): beyond it, a small lidar's beams are farther apart than a cell is wide."""
BEYOND_M: Final = 0.5
"""So much farther off (m) than a view reaches, or a view from its robot's pose, nothing is reported."""
_BESIDE: Final = 2
"""The view of a cell is the widest of its sector and so many to both sides: one beam may end at something before it."""
_UNSEEN_M: Final = 1.0
"""Without an echo a view says nothing, and the robot may report what it could not pass, this near (m)."""
_WHOLE_M: Final = REACH_UNIT_M * 255
_REPORTED_RADIUS_MAX: Final = 1.0
"""No robot of others explains what a lidar sees farther (m) from its centre."""


def within(view: View | None, offsets: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each point, by its offset ((n, 2), m) from the view's origin, whether it may be seen from there.

    Without a view, whether it is within the range of one.
    """
    distance = np.hypot(*offsets.T)
    if view is None:
        near: NDArray[np.bool_] = distance <= _WHOLE_M
        return near
    sectors = np.floor(np.arctan2(*offsets.T[::-1]) * (VIEW_SECTORS / (2.0 * np.pi))).astype(np.int64)
    units = np.frombuffer(view.reach, np.uint8)
    reach = np.where(units > 0, REACH_UNIT_M * units + BEYOND_M, _UNSEEN_M)
    widest = np.max([np.roll(reach, shift) for shift in range(-_BESIDE, _BESIDE + 1)], axis=0)
    seen: NDArray[np.bool_] = distance <= np.minimum(widest[sectors % VIEW_SECTORS], _WHOLE_M)
    return seen


def sees_beyond(view: View, offsets: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return for each cell whether the view reaches beyond it in every direction in which it was measured.

    `offsets` ((n, 2), m) are the cells' centres as seen from the view's origin, at least two half widths away.
    """
    dx, dy = offsets.T
    distance, bearing = np.hypot(dx, dy), np.arctan2(dy, dx)
    half_angle = np.arcsin(CELL_HALF_WIDTH_M / distance)
    sectors_per_radian = VIEW_SECTORS / (2.0 * np.pi)
    first = np.floor((bearing - half_angle) * sectors_per_radian).astype(np.int64)
    last = np.floor((bearing + half_angle) * sectors_per_radian).astype(np.int64)
    units = np.frombuffer(view.reach, np.uint8)
    reach = np.where(units > 0, REACH_UNIT_M * units, np.inf)  # 0: not measured
    shortest = _lowest(reach, first % VIEW_SECTORS, last - first + 1)
    beyond: NDArray[np.bool_] = np.isfinite(shortest) & (shortest > distance + MARGIN_M)
    return beyond


def _lowest(values: NDArray[np.float64], first: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the lowest of the `count` (>= 1) values from `first` on, round the circle, for each of many ranges.

    Of each range two halves of a power of two are looked up, which may overlap.
    """
    lowest = [values]
    while 2 ** len(lowest) <= count.max(initial=1):
        lowest.append(np.minimum(lowest[-1], np.roll(lowest[-1], -(2 ** (len(lowest) - 1)))))
    table = np.stack(lowest)
    level = np.frexp(count.astype(np.float64))[1] - 1
    found: NDArray[np.float64] = np.minimum(table[level, first], table[level, (first + count - 2**level) % len(values)])
    return found


DISC_RADIUS: Final = 0.05
"""Radius (m) of the disc that a point becomes."""
ROBOT_MARGIN: Final = 0.22
"""Points this close (m) to a robot's rim belong to the robot: its inscribed radius plus the localization error.

Of points that were seen from farther away than `RANGE_M` it grows with the distance, as the heading's error does.
"""
MAX_CELLS: Final = 20_000
"""Most cells that are held; a broken lidar must not fill the memory."""
MAX_OF_ROBOT: Final = 4_000
"""Most of them that one robot has added, so that its broken lidar takes no other robot's room, nor the whole floor.

Cells of 0.1 m, which are what robots report, on both sides of its way for as long as they last: 600 s at 0.3 m/s.
"""
VIEWS_TO_CLEAR: Final = 2
"""How many consecutive views must reach beyond a cell to clear it: one beam may have missed something thin."""
AREA_LATE_S: Final = 10.0
"""What robots saw in an area at most so long before its sensors agreed that it is blocked may be what blocks it."""
_PATCH_CELLS: Final = 64
"""Changed cells are marked as updated in patches of this size, so that windows stay small."""


class _Seen(NamedTuple):
    """When an obstacle expires and was first seen (s, monotonic), and by which robot."""

    expiry: float
    robot: str
    first: float


class ObstaclesLayer(CostLayer):
    """Holds the cells of obstacles, each with its expiry time. Cells are numbered row by row."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._seen: dict[int, _Seen] = {}
        self._held: Counter[str] = Counter()
        # 0: no obstacle; else one more than the consecutive views that reached beyond it.
        self._views = np.zeros(geometry.shape, dtype=np.uint8)
        self._next_expiry = float("inf")
        self._blocked: dict[str, float] = {}
        """Since when (s) the sensors of each area have said that it is blocked; until they say that it is clear."""
        self._poses: dict[str, tuple[float, RobotPose]] = {}
        reach = round(DISC_RADIUS / geometry.resolution)
        span = range(-reach, reach + 1)
        self._disc = [(dx, dy) for dy in span for dx in span if dx * dx + dy * dy <= reach * reach]
        self._reach = reach
        # How many discs cover a cell: where discs overlap, a cell is free only once the last one is removed.
        self._disc_count = np.zeros(geometry.shape, dtype=np.int16)

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handlers of robots' obstacles and poses, and of where robots of others are."""
        return {
            ch.ROBOT_OBSTACLES: self._on_obstacles,
            ch.ROBOT_POSE: self._on_pose,
            ch.REPORTED: self._on_reported,
        }

    def _on_obstacles(self, ids: Ids, seen: RobotObstacles, at: Moment) -> list[Publication]:
        robot, seen_until = ids["robot"], _Seen(at.now + seen.ttl, ids["robot"], at.now)
        points = np.array(seen.points, dtype=np.float64).reshape(-1, 2)
        origin = self._seen_from(robot, seen.view, at.now)
        if origin is None:
            self.refused += len(points)
            return []
        visible = within(seen.view, points - origin)
        self.refused += len(points) - int(visible.sum())
        points = points[visible]
        cells, inside = self._geometry.cells(points)
        points, numbers = points[inside], self._numbers(cells[inside])
        known = self._views.flat[numbers] > 0
        self._views.flat[numbers[known]] = 1
        for number in numbers[known].tolist():
            self._seen[number] = self._seen[number]._replace(expiry=max(self._seen[number].expiry, seen_until.expiry))
        added = np.unique(numbers[~known & ~self._near_robots(points, seen.view, at.now)])
        room = min(MAX_CELLS - len(self._seen), MAX_OF_ROBOT - self._held[robot])
        self.refused += max(0, len(added) - room)
        self._add(added[:room], seen_until)
        if seen.view is not None:
            self._clear_seen_through(robot, seen.view, numbers)
        return []

    def _add(self, numbers: NDArray[np.int64], seen: _Seen) -> None:
        self._seen.update(dict.fromkeys(numbers.tolist(), seen))
        self._held[seen.robot] += len(numbers)
        self._views.flat[numbers] = 1
        self._next_expiry = min(self._next_expiry, seen.expiry)
        self._update_discs(numbers, 1, Cause(kind="obstacle", id=seen.robot, state="seen"))

    def _clear_seen_through(self, robot: str, view: View, seen: NDArray[np.int64]) -> None:
        """Remove the cells that consecutive views have reached beyond, except those that the same scan saw."""
        x, y = view.x, view.y
        cells = self._obstacles_in(self._geometry.window_around(x - RANGE_M, y - RANGE_M, x + RANGE_M, y + RANGE_M))
        cells = cells[~np.isin(self._numbers(cells), seen)]
        offsets = self._geometry.centres(cells) - (x, y)
        distance = np.hypot(*offsets.T)
        near = (distance > 2 * CELL_HALF_WIDTH_M) & (distance <= RANGE_M)
        numbers, beyond = self._numbers(cells[near]), sees_beyond(view, offsets[near])
        # Hidden, or possibly still occupied: only consecutive views count.
        self._views.flat[numbers[~beyond]] = 1
        through = numbers[beyond]
        self._views.flat[through] += np.uint8(1)
        cleared = through[self._views.flat[through] > VIEWS_TO_CLEAR]
        self._remove(cleared, Cause(kind="obstacle", id=robot, state="gone"))

    def on_area(self, area: HazardArea, at: Moment) -> None:
        """Remove what was seen in an area while it was blocked, once its sensors say that it is clear.

        Else robots would keep away for minutes from what is gone, and so none would see that it is.
        """
        hazard = area.hazard
        if hazard.override is not None:
            return
        if hazard.state == "blocked":
            self._blocked.setdefault(hazard.area, at.now)
        elif hazard.state == "clear" and area.confirmed and hazard.area in self._blocked:
            begun = self._blocked.pop(hazard.area) - AREA_LATE_S
            window, mask = rasterize(normalized_polygon(area.polygon), self._geometry)
            cells = self._obstacles_in(window)
            numbers = self._numbers(cells[mask[cells[:, 1] - window.y, cells[:, 0] - window.x]])
            gone = [number for number in numbers.tolist() if self._seen[number].first >= begun]
            self._remove(np.array(gone, dtype=np.int64), Cause(kind="obstacle", id=hazard.area, state="gone"))

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> list[Publication]:
        """Remove the obstacle cells at a robot's position: they were the robot."""
        robot = ids["robot"]
        self._poses[robot] = (at.now, pose)
        reach = pose.radius + ROBOT_MARGIN
        cells = self._obstacles_in(
            self._geometry.window_around(pose.x - reach, pose.y - reach, pose.x + reach, pose.y + reach)
        )
        near = np.hypot(*(self._geometry.centres(cells) - (pose.x, pose.y)).T) <= reach
        self._remove(self._numbers(cells[near]), Cause(kind="obstacle", id=robot, state="robot"))
        return []

    def _on_reported(self, ids: Ids, told: Reported, at: Moment) -> list[Publication]:
        """Take the position of a robot of others: what lidars see there is that robot, which has a layer of its own."""
        if told.kind != "robot" or not isinstance(told.shape, CircleShape):
            return []
        x, y = told.shape.centre
        pose = RobotPose(
            x=x, y=y, theta=told.theta, v=told.v, w=0.0, covariance=[0.0] * 9, stamp=0.0, height=told.height,
            radius=min(told.shape.radius, _REPORTED_RADIUS_MAX),
        )  # fmt: skip
        # No id of a robot has a blank: nobody speaks for a robot of ours.
        return self._on_pose({"robot": f"other {ids['thing']}"}, pose, at)

    def tick(self, at: Moment) -> list[Publication]:
        """Remove expired cells, and forget old poses."""
        oldest = at.now - ch.ROBOT_POSE.max_age_s
        self._poses = {robot: known for robot, known in self._poses.items() if known[0] >= oldest}
        if at.now < self._next_expiry:
            return []
        expired = [number for number, seen in self._seen.items() if seen.expiry <= at.now]
        self._remove(np.array(expired, dtype=np.int64), Cause(kind="obstacle", id="lidar", state="gone"))
        self._next_expiry = min((seen.expiry for seen in self._seen.values()), default=float("inf"))
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:  # noqa: ARG002  # obstacles limit no speed
        """Write the discs, which set no speed limit."""
        mask = self._disc_count[window.rows, window.columns] > 0
        if mask.any():
            write_cost(ShapeMask(window, mask), window, cost, LETHAL)

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _numbers(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of cells ((n, 2), each (column, row))."""
        numbers: NDArray[np.int64] = cells[:, 1] * self._geometry.width + cells[:, 0]
        return numbers

    def _obstacles_in(self, window: Window) -> NDArray[np.int64]:
        """Return the cells ((n, 2), each (column, row)) of obstacles inside a window."""
        rows, columns = np.nonzero(self._views[window.rows, window.columns])
        return np.stack([columns + window.x, rows + window.y], axis=1).astype(np.int64)

    def _seen_from(self, robot: str, view: View | None, now: float) -> tuple[float, float] | None:
        """Return where a robot has seen its obstacles from; None if it can't have been there, by its latest pose."""
        received, pose = self._poses.get(robot, (-math.inf, None))
        if pose is None or now - received > ch.ROBOT_POSE.max_age_s:
            return None
        if view is None:
            return pose.x, pose.y
        return (view.x, view.y) if math.hypot(view.x - pose.x, view.y - pose.y) <= BEYOND_M else None

    def _near_robots(self, points: NDArray[np.float64], view: View | None, now: float) -> NDArray[np.bool_]:
        """Return which points ((n, 2), m) of a report are on or near a robot; `view`: where they were seen from."""
        near = np.zeros(len(points), dtype=np.bool_)
        away = np.zeros(len(points)) if view is None else np.hypot(*(points - (view.x, view.y)).T)
        margin = ROBOT_MARGIN * np.maximum(1.0, away / RANGE_M)
        for received, pose in self._poses.values():
            if now - received <= ch.ROBOT_POSE.max_age_s:
                near |= np.hypot(*(points - (pose.x, pose.y)).T) <= pose.radius + margin
        return near

    def _remove(self, numbers: NDArray[np.int64], cause: Cause) -> None:
        for number in numbers.tolist():
            self._held[self._seen.pop(number).robot] -= 1
        self._views.flat[numbers] = 0
        self._update_discs(numbers, -1, cause)

    def _update_discs(self, numbers: NDArray[np.int64], step: int, cause: Cause) -> None:
        """Add or remove the discs of distinct cells, and mark what they cover as updated, patch by patch."""
        if not len(numbers):
            return
        rows, columns = np.divmod(numbers, self._geometry.width)
        height, width = self._geometry.shape
        for dx, dy in self._disc:
            x, y = columns + dx, rows + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            self._disc_count[y[inside], x[inside]] += np.int16(step)
        patches = rows // _PATCH_CELLS * (width // _PATCH_CELLS + 1) + columns // _PATCH_CELLS
        order = np.argsort(patches, kind="stable")
        _, starts = np.unique(patches[order], return_index=True)
        sides = [extreme.reduceat(of[order], starts) for of in (columns, rows) for extreme in (np.minimum, np.maximum)]
        for left, right, bottom, top in np.stack(sides, axis=1).tolist():
            window = Window(left, bottom, right - left + 1, top - bottom + 1).grown(self._reach)
            self.mark_updated(self._geometry.clip(window), cause)


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ObstaclesLayer(plan.geometry))
