"""Places that an operator keeps for one robot at a time: zones of the kind RELEASE. Pure.

At most one robot's lease leads into such a place. A robot whose body is in it has it; others wait before it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import GeometryError
from fog_contracts.grid import GridGeometry
from fog_contracts.shapes import rasterize_shape, shape_box
from fog_kernels.distance import squared_distance_capped
from planner.leases.corridors import SPACING_M, Disc

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from fog_contracts.messages import Zone
    from planner.leases.corridors import Corridor, Floats

BEFORE_M: Final = 0.15
"""So far from the place a robot's rim stays while another one has it ..."""
HELD_M: Final = 0.02
"""... and so near its rim has it."""
_CELL_M: Final = 0.05
_MOST_CELLS: Final = 1000
"""A side of the grid that a place is looked at on; of a larger place the cells are larger."""
_AROUND_M: Final = 1.5
_NEARER_M: Final = 0.02


class NarrowPlace:
    """A place for one robot at a time."""

    def __init__(self, zone: Zone) -> None:
        """Rasterize the zone; raises `GeometryError` for a shape without cells, which the map-service refuses."""
        self.zone = zone
        left, bottom, right, top = shape_box(zone.shape)
        size = max(right - left, top - bottom) + 2.0 * _AROUND_M
        if not math.isfinite(size):
            raise GeometryError(f"zone {zone.id} has no box around it")
        cell = max(_CELL_M, size / _MOST_CELLS)
        width, height = (math.ceil((side + 2.0 * _AROUND_M) / cell) for side in (right - left, top - bottom))
        self._geometry = GridGeometry(width, height, cell, left - _AROUND_M, bottom - _AROUND_M)
        window, mask = rasterize_shape(zone.shape, self._geometry)
        cells = np.zeros(self._geometry.shape, np.bool_)
        cells[window.rows, window.columns] = mask
        self._apart = np.sqrt(squared_distance_capped(cells, math.ceil(_AROUND_M / cell))) * cell
        rows, columns = np.nonzero(cells)
        rows, columns = rows[::3], columns[::3]
        x, y = self._geometry.origin_x + (columns + 0.5) * cell, self._geometry.origin_y + (rows + 0.5) * cell
        self._inside = np.column_stack((x, y))

    def apart(self, points: Floats) -> Floats:
        """Return how far (m) points ((n, 2), m) are from the place: 0 inside, at most 1.5."""
        geometry = self._geometry
        found = np.full(len(points), _AROUND_M)
        with np.errstate(invalid="ignore"):
            cells = np.floor((points - (geometry.origin_x, geometry.origin_y)) / geometry.resolution)
            on = ((cells >= 0) & (cells < (geometry.width, geometry.height))).all(axis=1)
        columns, rows = cells[on].astype(np.int64).T
        found[on] = self._apart[rows, columns]
        return found

    def apart_along(self, me: Corridor) -> Floats:
        """Return how far (m) each point of a robot's path is from the place."""
        known = me.apart.get(self)
        if known is None or known[0] is not me.points:
            known = me.apart[self] = me.points, self.apart(me.points)
        return known[1]

    def entry(self, me: Corridor, begin: int, end: int) -> int:
        """Return the first point between two of a robot's path where it gets into the place; `end` without one.

        Who begins in it may drive on, but not come back; who begins near it may not get nearer.
        """
        apart, reach = self.apart_along(me)[begin:end], me.radius + BEFORE_M
        if not len(apart) or apart.min() > reach:
            return end
        first = 0
        if apart[0] == 0.0:
            outside = np.flatnonzero(apart > reach)
            if not len(outside):
                return end
            first = int(outside[0])
        near = np.flatnonzero(apart[first:] <= min(reach, apart[first] - _NEARER_M))
        return begin + first + int(near[0]) if len(near) else end

    def taken(self, me: Corridor) -> NDArray[np.bool_]:
        """Return which points of its path have a robot in the place."""
        found: NDArray[np.bool_] = self.apart_along(me) <= me.radius + HELD_M
        return found

    def holds(self, me: Corridor, lines: Iterable[Floats]) -> bool:
        """Whether a robot is in the place somewhere on lines."""
        return any(len(line) > 0 and self.apart(line).min() <= me.radius + HELD_M for line in lines)

    def passes(self, me: Corridor, begin: int) -> bool:
        """Whether a robot gets into the place on its way from a point of its path."""
        last = me.last
        return me.drives and self.entry(me, begin, last) < last

    def has_body(self, me: Corridor) -> bool:
        """Whether a robot is in the place."""
        return self.holds(me, [me.at])

    def disc(self, me: Corridor) -> Disc:
        """Return the place as one that a robot's new path avoids."""
        return Disc(self._inside, me.radius + BEFORE_M + SPACING_M)
