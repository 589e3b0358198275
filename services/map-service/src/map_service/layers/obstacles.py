"""What robots' lidars see and the map doesn't know, until a lidar sees that it is gone.

A thing that stands in a corridor is out of sight as soon as the robot turns back, so it must be remembered for longer
than the way around takes; one that was only passing by must be forgotten as soon as somebody looks there again. Hence
the memory is long, and a look that reaches beyond a cell twice in a row ends it, as clearing by ray tracing does in
layered costmaps (Lu, Hershberger, Smart 2014).

A point becomes a small lethal disc. Points under or beside a robot are that robot and are left out: a robot must never
shut another one in by having looked at it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import ShapeMask
from fog_contracts.grid import Window
from fog_contracts.messages import VIEW_SECTORS, Cause
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
"""How far (m) around a robot's rim points count as the robot: its inscribed radius and what localization may be off."""
MAX_CELLS: Final = 20_000
"""How many cells may be held; a broken lidar must not fill the memory."""
LOOKS_TO_CLEAR: Final = 2
"""So many looks in a row must reach beyond a cell: one echo may have slipped past something thin."""
BEYOND_M: Final = 0.2
"""How far behind a cell a look must reach: the cell's size, and what localization may be off."""
CELL_HALF_WIDTH_M: Final = 0.06
VIEW_RANGE_M: Final = 6.0
"""Beyond this the beams of a small lidar lie farther apart than a cell is wide."""
_PATCH: Final = 64


class ObstaclesLayer(CostLayer):
    """Holds cells that were seen, each with the time until which it counts."""

    def __init__(self, geometry: GridGeometry) -> None:
        super().__init__()
        self._geometry = geometry
        self._until: dict[tuple[int, int], float] = {}
        self._looks: dict[tuple[int, int], int] = {}  # how many looks in a row reached beyond the cell
        self._next_end = float("inf")
        self._poses: dict[str, tuple[float, RobotPose]] = {}
        reach = round(DISC_RADIUS / geometry.resolution)
        span = range(-reach, reach + 1)
        self._disc = [(dx, dy) for dy in span for dx in span if dx * dx + dy * dy <= reach * reach]
        self._reach = reach
        # How many discs cover a cell: with overlapping discs, a cell is free again only when the last one is gone.
        self._cover = np.zeros(geometry.shape, dtype=np.int16)
        self.refused = 0

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handlers of robots' obstacles and poses."""
        return {ch.ROBOT_OBSTACLES: self._on_obstacles, ch.ROBOT_POSE: self._on_pose}

    def _on_obstacles(self, ids: Ids, seen: RobotObstacles, at: Moment) -> list[Publication]:
        robot, now = ids["robot"], at.now
        robots = [pose for at, pose in self._poses.values() if now - at <= ch.ROBOT_POSE.max_age_s]
        end = now + seen.ttl
        added: list[tuple[int, int]] = []
        there = {self._geometry.cell(x, y) for x, y in seen.points}
        for x, y in seen.points:
            cell = self._geometry.cell(x, y)
            if not self._geometry.contains_cell(*cell):
                continue
            self._looks.pop(cell, None)
            if cell in self._until:
                self._until[cell] = max(self._until[cell], end)
                continue
            if any(_beside(pose, x, y) for pose in robots):
                continue
            if len(self._until) >= MAX_CELLS:
                self.refused += 1
                continue
            self._until[cell] = end
            added.append(cell)
        self._next_end = min(self._next_end, end)
        self._change(added, 1, Cause(kind="obstacle", id=robot, state="seen"))
        if seen.view is not None:
            self._clear_seen_through(robot, seen.view, there)
        return []

    def _clear_seen_through(self, robot: str, view: View, there: set[tuple[int, int]]) -> None:
        """Forget cells that a robot's lidar has looked through, but none that the same turn saw (`there`)."""
        doubtful = [cell for cell in self._until if cell not in there]
        if not doubtful:
            return
        cells = np.array(doubtful, dtype=np.int64)
        dx, dy = (self._geometry.centres(cells) - (view.x, view.y)).T
        distance = np.hypot(dx, dy)
        near = (distance > 2 * CELL_HALF_WIDTH_M) & (distance <= VIEW_RANGE_M)
        cells, distance, bearing = cells[near], distance[near], np.arctan2(dy[near], dx[near])
        half = np.arcsin(CELL_HALF_WIDTH_M / distance)
        per_radian = VIEW_SECTORS / (2.0 * np.pi)
        first = np.floor((bearing - half) * per_radian).astype(np.int64)
        last = np.floor((bearing + half) * per_radian).astype(np.int64)
        reach = np.array(view.reach_cm) / 100.0
        gone: list[tuple[int, int]] = []
        for (column, row), away, begin, end in zip(cells.tolist(), distance, first, last, strict=True):
            ends = reach[np.arange(begin, end + 1) % VIEW_SECTORS]
            ends = ends[ends > 0.0]
            cell = (column, row)
            if not ends.size or ends.min() <= away + BEYOND_M:
                # Hidden, or still there as far as anybody can tell: only looks in a row count.
                self._looks.pop(cell, None)
                continue
            self._looks[cell] = self._looks.get(cell, 0) + 1
            if self._looks[cell] >= LOOKS_TO_CLEAR:
                gone.append(cell)
        self._drop(gone, Cause(kind="obstacle", id=robot, state="gone"))

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> list[Publication]:
        """Forget what was seen where a robot is: it was the robot."""
        robot = ids["robot"]
        self._poses[robot] = (at.now, pose)
        if not self._until:
            return []
        reach = pose.radius + ROBOT_MARGIN
        window = self._geometry.window_around(pose.x - reach, pose.y - reach, pose.x + reach, pose.y + reach)
        if window.empty or not self._cover[window.rows, window.columns].any():
            return []
        cells = [
            (column, row)
            for row in range(window.y, window.y + window.height)
            for column in range(window.x, window.x + window.width)
            if (column, row) in self._until and _beside(pose, *self._geometry.centre(column, row))
        ]
        self._drop(cells, Cause(kind="obstacle", id=robot, state="robot"))
        return []

    def tick(self, at: Moment) -> list[Publication]:
        """Forget what has not been seen for its time."""
        if at.now < self._next_end:
            return []
        over = [cell for cell, end in self._until.items() if end <= at.now]
        self._drop(over, Cause(kind="obstacle", id="lidar", state="gone"))
        self._next_end = min(self._until.values(), default=float("inf"))
        return []

    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:  # noqa: ARG002  # they limit no speed
        """Write the discs; they set no speed limit."""
        mask = self._cover[window.rows, window.columns] > 0
        if mask.any():
            write_cost(ShapeMask(window, mask), window, cost, LETHAL)

    def _drop(self, cells: list[tuple[int, int]], cause: Cause) -> None:
        for cell in cells:
            del self._until[cell]
            self._looks.pop(cell, None)
        self._change(cells, -1, cause)

    def _change(self, cells: list[tuple[int, int]], step: int, cause: Cause) -> None:
        patches: dict[tuple[int, int], Window] = {}
        for column, row in cells:
            for dx, dy in self._disc:
                if self._geometry.contains_cell(column + dx, row + dy):
                    self._cover[row + dy, column + dx] += np.int16(step)
            window = Window(column, row, 1, 1).grown(self._reach)
            key = (column // _PATCH, row // _PATCH)
            patches[key] = patches[key].union(window) if key in patches else window
        for window in patches.values():
            self.mark_updated(self._geometry.clip(window), cause)


def _beside(pose: RobotPose, x: float, y: float) -> bool:
    reach = pose.radius + ROBOT_MARGIN
    return (x - pose.x) ** 2 + (y - pose.y) ** 2 <= reach * reach


LAYER = LayerFactory(options=NoOptions, make=lambda plan, _options: ObstaclesLayer(plan.geometry))
