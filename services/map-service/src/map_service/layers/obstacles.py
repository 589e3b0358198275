"""Obstacles that robots' lidars see and the map does not contain, until a lidar sees that they are gone.

An obstacle in a corridor is out of sight as soon as the robot turns back, so it must be kept for longer than the detour
takes; a passing person must be cleared as soon as a lidar covers the place again. Hence obstacles expire late, and a
cell is cleared when the free view of two consecutive reports reaches beyond it, as clearing by ray tracing does in
layered costmaps (Lu, Hershberger, Smart 2014).

A point becomes a small lethal disc. Points on or near a robot belong to that robot and are left out: a robot must never
enclose another one by having seen it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.grid import Window
from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS, Cause
from fog_contracts.raster import ShapeMask
from map_service.layers.base import CostLayer, LayerFactory, NoOptions, write_cost

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Final

    from fog_contracts.channels import Channel
    from fog_contracts.grid import GridGeometry
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import RobotObstacles, RobotPose, View
    from map_service.layers.base import Grid

DISC_RADIUS: Final = 0.05
"""Radius (m) of the disc that a point becomes."""
ROBOT_MARGIN: Final = 0.22
"""Points this close (m) to a robot's rim belong to the robot: its inscribed radius plus the localization error."""
MAX_CELLS: Final = 20_000
"""Most cells that are held; a broken lidar must not fill the memory."""
VIEWS_TO_CLEAR: Final = 2
"""How many consecutive views must reach beyond a cell to clear it: one beam may have missed something thin."""
CLEARING_MARGIN_M: Final = 0.2
"""How far behind a cell a view must reach to clear it: the cell's size plus the localization error."""
CELL_HALF_WIDTH_M: Final = 0.06
VIEW_RANGE_M: Final = 6.0
"""Views clear up to this distance (m): beyond it, a small lidar's beams are farther apart than a cell is wide."""
_PATCH_CELLS: Final = 64
"""Changed cells are marked as updated in patches of this size, so that windows stay small."""


class ObstaclesLayer(CostLayer):
    """Holds the cells of obstacles, each with its expiry time."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._expiry: dict[tuple[int, int], float] = {}
        self._views_beyond: dict[tuple[int, int], int] = {}  # consecutive views that reached beyond the cell
        self._next_expiry = float("inf")
        self._poses: dict[str, tuple[float, RobotPose]] = {}
        reach = round(DISC_RADIUS / geometry.resolution)
        span = range(-reach, reach + 1)
        self._disc = [(dx, dy) for dy in span for dx in span if dx * dx + dy * dy <= reach * reach]
        self._reach = reach
        # How many discs cover a cell: where discs overlap, a cell is free only once the last one is removed.
        self._disc_count = np.zeros(geometry.shape, dtype=np.int16)

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handlers of robots' obstacles and poses."""
        return {ch.ROBOT_OBSTACLES: self._on_obstacles, ch.ROBOT_POSE: self._on_pose}

    def _on_obstacles(self, ids: Ids, seen: RobotObstacles, at: Moment) -> list[Publication]:
        robot, now = ids["robot"], at.now
        robots = [pose for received, pose in self._poses.values() if now - received <= ch.ROBOT_POSE.max_age_s]
        expiry = now + seen.ttl
        added: list[tuple[int, int]] = []
        seen_cells = {self._geometry.cell(x, y) for x, y in seen.points}
        for x, y in seen.points:
            cell = self._geometry.cell(x, y)
            if not self._geometry.contains_cell(*cell):
                continue
            self._views_beyond.pop(cell, None)
            if cell in self._expiry:
                self._expiry[cell] = max(self._expiry[cell], expiry)
                continue
            if any(_is_near_robot(pose, x, y) for pose in robots):
                continue
            if len(self._expiry) >= MAX_CELLS:
                self.refused += 1
                continue
            self._expiry[cell] = expiry
            added.append(cell)
        self._next_expiry = min(self._next_expiry, expiry)
        self._update_discs(added, 1, Cause(kind="obstacle", id=robot, state="seen"))
        if seen.view is not None:
            self._clear_seen_through(robot, seen.view, seen_cells)
        return []

    def _clear_seen_through(self, robot: str, view: View, seen_cells: set[tuple[int, int]]) -> None:
        """Remove the cells that consecutive views have reached beyond, except those that the same scan saw."""
        candidates = [cell for cell in self._expiry if cell not in seen_cells]
        if not candidates:
            return
        cells = np.array(candidates, dtype=np.int64)
        dx, dy = (self._geometry.centres(cells) - (view.x, view.y)).T
        distance = np.hypot(dx, dy)
        near = (distance > 2 * CELL_HALF_WIDTH_M) & (distance <= VIEW_RANGE_M)
        cells, distance, bearing = cells[near], distance[near], np.arctan2(dy[near], dx[near])
        half_angle = np.arcsin(CELL_HALF_WIDTH_M / distance)
        sectors_per_radian = VIEW_SECTORS / (2.0 * np.pi)
        first = np.floor((bearing - half_angle) * sectors_per_radian).astype(np.int64)
        last = np.floor((bearing + half_angle) * sectors_per_radian).astype(np.int64)
        reach = REACH_UNIT_M * np.frombuffer(view.reach, np.uint8)
        cleared: list[tuple[int, int]] = []
        for (column, row), cell_distance, begin, end in zip(cells.tolist(), distance, first, last, strict=True):
            ranges = reach[np.arange(begin, end + 1) % VIEW_SECTORS]
            ranges = ranges[ranges > 0.0]
            cell = (column, row)
            if not ranges.size or ranges.min() <= cell_distance + CLEARING_MARGIN_M:
                # Hidden, or possibly still occupied: only consecutive views count.
                self._views_beyond.pop(cell, None)
                continue
            self._views_beyond[cell] = self._views_beyond.get(cell, 0) + 1
            if self._views_beyond[cell] >= VIEWS_TO_CLEAR:
                cleared.append(cell)
        self._remove(cleared, Cause(kind="obstacle", id=robot, state="gone"))

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> list[Publication]:
        """Remove the obstacle cells at a robot's position: they were the robot."""
        robot = ids["robot"]
        self._poses[robot] = (at.now, pose)
        if not self._expiry:
            return []
        reach = pose.radius + ROBOT_MARGIN
        window = self._geometry.window_around(pose.x - reach, pose.y - reach, pose.x + reach, pose.y + reach)
        if window.empty or not self._disc_count[window.rows, window.columns].any():
            return []
        cells = [
            (column, row)
            for row in range(window.y, window.y + window.height)
            for column in range(window.x, window.x + window.width)
            if (column, row) in self._expiry and _is_near_robot(pose, *self._geometry.centre(column, row))
        ]
        self._remove(cells, Cause(kind="obstacle", id=robot, state="robot"))
        return []

    def tick(self, at: Moment) -> list[Publication]:
        """Remove expired cells."""
        if at.now < self._next_expiry:
            return []
        expired = [cell for cell, expiry in self._expiry.items() if expiry <= at.now]
        self._remove(expired, Cause(kind="obstacle", id="lidar", state="gone"))
        self._next_expiry = min(self._expiry.values(), default=float("inf"))
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:  # noqa: ARG002  # obstacles limit no speed
        """Write the discs, which set no speed limit."""
        mask = self._disc_count[window.rows, window.columns] > 0
        if mask.any():
            write_cost(ShapeMask(window, mask), window, cost, LETHAL)

    def _remove(self, cells: list[tuple[int, int]], cause: Cause) -> None:
        for cell in cells:
            del self._expiry[cell]
            self._views_beyond.pop(cell, None)
        self._update_discs(cells, -1, cause)

    def _update_discs(self, cells: list[tuple[int, int]], step: int, cause: Cause) -> None:
        patches: dict[tuple[int, int], Window] = {}
        for column, row in cells:
            for dx, dy in self._disc:
                if self._geometry.contains_cell(column + dx, row + dy):
                    self._disc_count[row + dy, column + dx] += np.int16(step)
            window = Window(column, row, 1, 1).grown(self._reach)
            key = (column // _PATCH_CELLS, row // _PATCH_CELLS)
            patches[key] = patches[key].union(window) if key in patches else window
        for window in patches.values():
            self.mark_updated(self._geometry.clip(window), cause)


def _is_near_robot(pose: RobotPose, x: float, y: float) -> bool:
    reach = pose.radius + ROBOT_MARGIN
    return (x - pose.x) ** 2 + (y - pose.y) ** 2 <= reach * reach


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ObstaclesLayer(plan.geometry))
