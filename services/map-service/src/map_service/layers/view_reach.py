"""Which places a robot's free view reaches beyond. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS

if TYPE_CHECKING:
    from typing import Final

    from numpy.typing import NDArray

    from fog_contracts.messages import View

MARGIN_M: Final = 0.2
"""How far behind a cell a view must reach to clear it: the cell's size plus the localization error."""
CELL_HALF_WIDTH_M: Final = 0.06
RANGE_M: Final = 6.0
"""Views clear up to this distance (m): beyond it, a small lidar's beams are farther apart than a cell is wide."""


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
