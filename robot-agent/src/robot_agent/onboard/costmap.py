"""The robot's own global costmap: floor plan, what its lidar sees, and the closed places it is told of; inflated.

The layers are those of the ROS navigation stack (static, obstacle and inflation layer, and the layer that the thesis
added to them); what did not change is not computed again.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION, FREE, LETHAL, Inflation
from fog_contracts.grid import Window
from fog_contracts.replica import Replica, Version
from fog_kernels.inflation import inflate, inflate_window, inflation_table
from fog_kernels.spans import raise_costs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.raster import Spans
    from robot_agent.localization.pose import Pose2

    Cells = NDArray[np.int64]

_SECTORS: Final = 360
_SEEN_BEYOND_M: Final = 0.2
"""A cell is seen to be free when the lidar sees this much farther in its direction."""
_NOWHERE: Final = Window(0, 0, 0, 0)


class OnboardCostmap:
    """A costmap that only this robot writes and reads.

    `replica` holds it in the form in which the fog's map comes, with a version that grows by one with each change.
    """

    def __init__(self, floor: Replica, inscribed_radius: float) -> None:
        """Begin with the floor plan of a loaded map; `inscribed_radius` (m) is the robot's."""
        assert floor.geometry is not None
        assert floor.version is not None
        self.geometry: GridGeometry = floor.geometry
        inflation = Inflation(
            inscribed_radius=inscribed_radius,
            inflation_radius=DEFAULT_INFLATION.inflation_radius,
            cost_scaling=DEFAULT_INFLATION.cost_scaling,
        )
        self._table = inflation_table(self.geometry.resolution, inflation)
        self._static = floor.static
        self._raw = floor.static.copy()
        self._marked: Cells = np.zeros((0, 2), np.int64)
        """Cells (n, 2; column, row) in which the lidar saw an obstacle that the floor plan does not have."""
        self._closed: dict[str, Spans] = {}
        self.replica = Replica()
        self.replica.site, self.replica.geometry, self.replica.static = floor.site, floor.geometry, floor.static
        self.replica.layers = {
            "cost": inflate(self._raw, self._table),
            "speed": np.zeros(self.geometry.shape, np.uint8),
        }
        self.replica.version = Version(floor.version.epoch, 0, 0)
        self.replica.needs_snapshot = False

    def close(self, places: Mapping[str, Spans]) -> None:
        """Close exactly these places, each by a name that stands for the same cells as before."""
        if places.keys() == self._closed.keys():
            return
        changed = _NOWHERE
        for name in places.keys() ^ self._closed.keys():
            changed = changed.union((places.get(name) or self._closed[name]).window)
        self._closed = dict(places)
        part = self._static[changed.rows, changed.columns].copy()
        raise_costs([(spans, LETHAL) for spans in places.values()], changed.x, changed.y, part)
        self._raw[changed.rows, changed.columns] = part
        self._raw[self._marked[:, 1], self._marked[:, 0]] = LETHAL
        self._inflate(changed)

    def observe(self, seen_from: Pose2, points: NDArray[np.float64], unexplained: NDArray[np.bool_]) -> None:
        """Mark what a scan shows and the floor plan does not explain; free the marked cells beyond which it sees.

        points: (n, 2) m, frame `map`, of all beams that returned, from the pose `seen_from`. unexplained: (n,).
        """
        marks = self._cells(points[unexplained])
        gone = self._marked[self._is_free(self._marked, seen_from, points)]
        width = self.geometry.width
        # What the same scan marks is there, whatever its other beams pass by.
        freed = gone[~_contains(marks, gone, width)]
        fresh = marks[~_contains(self._marked, marks, width)]
        self._marked = np.concatenate((self._marked[~_contains(freed, self._marked, width)], fresh))
        changed = np.concatenate((fresh, freed))
        if not len(changed):
            return
        self._raw[fresh[:, 1], fresh[:, 0]] = LETHAL
        self._raw[freed[:, 1], freed[:, 0]] = self._static[freed[:, 1], freed[:, 0]]
        low, high = changed.min(axis=0), changed.max(axis=0) + 1
        window = Window(int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
        part = np.ascontiguousarray(self._raw[window.rows, window.columns])
        raise_costs([(spans, LETHAL) for spans in self._closed.values()], window.x, window.y, part)
        self._raw[window.rows, window.columns] = part
        self._inflate(window)

    def _cells(self, points: NDArray[np.float64]) -> Cells:
        """Return the cells of points (n, 2; m) that lie on known, free floor, each once."""
        cells, inside = self.geometry.cells(points)
        cells = cells[inside]
        return np.unique(cells[self._static[cells[:, 1], cells[:, 0]] == FREE], axis=0)

    def _is_free(self, cells: Cells, seen_from: Pose2, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return beyond which of the cells (n, 2) the scan sees: by its nearest return of each direction."""
        dx, dy = points[:, 0] - seen_from.x, points[:, 1] - seen_from.y
        reach = np.full(_SECTORS, np.inf)
        np.minimum.at(reach, _sectors(dx, dy), np.hypot(dx, dy))
        reach[np.isinf(reach)] = 0.0
        # A beam that only just passes an obstacle's edge says nothing of the cell beside it.
        reach = np.minimum(reach, np.minimum(np.roll(reach, 1), np.roll(reach, -1)))
        centres = self.geometry.centres(cells)
        cx, cy = centres[:, 0] - seen_from.x, centres[:, 1] - seen_from.y
        free: NDArray[np.bool_] = np.hypot(cx, cy) + _SEEN_BEYOND_M < reach[_sectors(cx, cy)]
        return free

    def _inflate(self, window: Window) -> None:
        """Inflate a window in which cells changed, and count a version."""
        cost, version = self.replica.cost, self.replica.version
        assert version is not None
        inflate_window(self._raw, self._table, window.x, window.y, window.width, window.height, cost)
        self.replica.version = Version(version.epoch, version.seq + 1, 0)


def _sectors(dx: NDArray[np.float64], dy: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the sector of each direction, counted counter-clockwise from the map's x axis."""
    return np.floor(np.arctan2(dy, dx) % math.tau * (_SECTORS / math.tau)).astype(np.int64) % _SECTORS


def _contains(cells: Cells, wanted: Cells, width: int) -> NDArray[np.bool_]:
    """Return which of the wanted cells (n, 2) are among the cells (m, 2) of a grid of this width."""
    found: NDArray[np.bool_] = np.isin(wanted[:, 1] * width + wanted[:, 0], cells[:, 1] * width + cells[:, 0])
    return found
