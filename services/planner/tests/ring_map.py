"""A map for tests: a ring of corridors with an upper and a lower path from left to right."""

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import (
    AreaHazard,
    AreaState,
    Cause,
    HazardArea,
    MapDelta,
    Pose,
    RobotGoal,
    RobotPath,
    RobotPose,
    Trace,
)
from fog_contracts.replica import MasterMap
from fog_contracts.shapes import rasterize
from fog_kernels.inflation import inflate, inflation_table

Grid = NDArray[np.uint8]
Box = tuple[float, float, float, float]

RES = 0.1


class RingMap:
    """A ring of corridors 2 m wide, 20 x 12 m: an upper and a lower path from left to right."""

    def __init__(self, epoch: int = 1, walls: tuple[Box, ...] = ((2.0, 2.0, 18.0, 10.0),)) -> None:
        self.geometry = GridGeometry(200, 120, RES, 0.0, 0.0)
        self.static = np.zeros(self.geometry.shape, np.uint8)
        self.static[[0, -1], :] = 254
        self.static[:, [0, -1]] = 254
        for wall in walls:
            self.raise_costs(self.static, wall, 254)
        self.table = inflation_table(RES, DEFAULT_INFLATION)
        self.areas: dict[str, Box] = {}
        self.penalties: dict[str, int] = {}
        self.master = MasterMap("test", self.geometry, self.static, inflate(self.static, self.table), epoch)
        self.epoch = epoch

    def raise_costs(self, grid: Grid, box: Box, value: int) -> None:
        window = self.geometry.window_around(box[0], box[1], box[2] - 1e-6, box[3] - 1e-6)
        cells = grid[window.rows, window.columns]
        cells[:] = np.maximum(cells, value)

    def cost(self) -> Grid:
        raw = self.static.copy()
        for name, box in self.areas.items():
            # As the map-service does it: cells at the border belong to the area.
            window, mask = rasterize(polygon(box), self.geometry)
            cells = raw[window.rows, window.columns]
            cells[mask] = np.maximum(cells[mask], self.penalties[name])
        return inflate(raw, self.table)

    def put(self, name: str, box: Box, penalty: int = 254, trace: Trace | None = None) -> list[MapDelta]:
        self.areas[name], self.penalties[name] = box, penalty
        return self._publish(name, trace)

    def clear(self, name: str) -> list[MapDelta]:
        del self.areas[name]
        return self._publish(name, None)

    def _publish(self, name: str, trace: Trace | None) -> list[MapDelta]:
        old, new = self.master.layers["cost"], self.cost()
        rows, columns = np.nonzero(old != new)
        if len(rows) == 0:
            return []
        x, y = int(columns.min()), int(rows.min())
        window = Window(x, y, int(columns.max()) - x + 1, int(rows.max()) - y + 1)
        causes = [Cause(kind="hazard", id=name, state="blocked")]
        cells = np.ascontiguousarray(new[window.rows, window.columns])
        return self.master.write([("cost", window, cells)], causes, [trace] if trace else [])

    def hazard_area(self, name: str, state: AreaState = "blocked") -> HazardArea:
        penalty = 0 if state == "clear" else 254
        hazard = AreaHazard(
            area=name, state=state, severity=2, penalty=penalty, since=0.0, seq=1, epoch=1, cause="test"
        )
        return HazardArea(hazard=hazard, polygon=polygon(self.areas[name]), epoch=self.epoch)


def polygon(box: Box) -> list[tuple[float, float]]:
    x0, y0, x1, y1 = box
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def pose(x: float, y: float, theta: float = 0.0, *, localized: bool = True) -> RobotPose:
    return RobotPose(
        x=x, y=y, theta=theta, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=0.0,
        localized=localized,
    )  # fmt: skip


def goal(x: float, y: float, name: str = "g1") -> RobotGoal:
    return RobotGoal(goal_id=name, pose=Pose(x=x, y=y, theta=0.0))


LEFT, RIGHT = (1.0, 7.0), (19.0, 7.0)  # nearer to the upper corridor
UPPER, LOWER = (9.0, 10.0, 11.0, 12.0), (9.0, 0.0, 11.0, 2.0)


def via(path: RobotPath) -> str:
    return "upper" if max(y for _, y in path.points) > 10.0 else "lower"
