"""The robot's own global costmap: floor plan, what its lidar sees, and the closed places it is told of; inflated.

The layers are those of the ROS navigation stack (static, obstacle and inflation layer, and the layer that the thesis
added to them); what did not change is not computed again.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION, FREE, INSCRIBED, LETHAL, Inflation
from fog_contracts.grid import Window
from fog_contracts.replica import Replica, Version
from fog_kernels.inflation import inflate, inflate_window, inflation_table
from fog_kernels.spans import raise_costs
from robot_agent.onboard.marks import Marks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import PointXY
    from fog_contracts.raster import Spans
    from robot_agent.localization.pose import Pose2

    Cells = NDArray[np.int64]

_NOWHERE: Final = Window(0, 0, 0, 0)
_NO_POINTS: Final = np.zeros((0, 2))


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
        self._marks = Marks(self.geometry)
        self._touching = _touching(self.geometry.resolution, inscribed_radius)
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
        self._raw[self._marks.cells[:, 1], self._marks.cells[:, 0]] = LETHAL
        self._inflate(changed)

    def observe(
        self,
        seen_from: Pose2,
        points: NDArray[np.float64],
        unexplained: NDArray[np.bool_],
        impassable: NDArray[np.float64] = _NO_POINTS,
    ) -> None:
        """Mark what a scan shows and the floor plan does not explain; free the marked cells that it sees to be free.

        points: (n, 2) m, frame `map`, of all beams that returned, from the pose `seen_from`. unexplained: (n,).
        impassable: (n, 2) m, a place that the robot could not pass although the scan may show nothing there.
        """
        occupied = self._cells(np.concatenate((points[unexplained], impassable)))
        self._update(*self._marks.observe(seen_from, points, occupied))

    def doubt(self, around: PointXY | None = None) -> bool:
        """Forget what was only seen from far away, all or near a place (m); return whether there was any.

        If so, only what is seen from near is marked there from then on until `believe`.
        """
        forgotten = self._marks.doubt(around)
        self._update(self._marks.cells[:0], forgotten)
        return len(forgotten) > 0

    def believe(self) -> None:
        """Mark everywhere again what is seen from as far as the lidar sees."""
        self._marks.believe()

    def _update(self, fresh: Cells, freed: Cells) -> None:
        """Write cells (n, 2) that are marked now and were not, and those that no longer are."""
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

    def _inflate(self, window: Window) -> None:
        """Inflate a window in which cells changed, and count a version."""
        cost, version = self.replica.cost, self.replica.version
        assert version is not None
        inflate_window(self._raw, self._table, window.x, window.y, window.width, window.height, cost)
        self._keep_clear_of_marks(cost)
        self.replica.version = Version(version.epoch, version.seq + 1, 0)

    def _keep_clear_of_marks(self, cost: NDArray[np.uint8]) -> None:
        """Keep the robot's centre off the cells where its body might reach what a mark stands for."""
        around = (self._marks.cells[:, np.newaxis] + self._touching).reshape(-1, 2)
        around = around[((around >= 0) & (around < (self.geometry.width, self.geometry.height))).all(axis=1)]
        columns, rows = around.T
        cost[rows, columns] = np.maximum(cost[rows, columns], INSCRIBED)


def _touching(resolution: float, inscribed_radius: float) -> Cells:
    """Return the cells (n, 2; column, row) around one in which something was seen that the body might touch there.

    It may be anywhere in its cell. On a grid of 0.1 m a gap of three cells between two marks would else be open for a
    body that is wider than that.
    """
    radius = inscribed_radius + math.sqrt(0.5) * resolution
    reach = math.floor(radius / resolution)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    near = np.hypot(rows, columns) * resolution <= radius
    return np.column_stack((columns[near], rows[near])).astype(np.int64)
