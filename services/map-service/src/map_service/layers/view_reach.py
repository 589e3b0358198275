"""Which places a robot's view reaches, and which it reaches beyond. Pure."""

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
BEYOND_M: Final = 0.5
"""So much farther off (m) than a view reaches, or a view from its robot's pose, nothing is reported."""
_BESIDE: Final = 2
"""The view of a cell is the widest of its sector and so many to both sides: one beam may end at something before it."""
_UNSEEN_M: Final = 1.0
"""Without an echo a view says nothing, and the robot may report what it could not pass, this near (m)."""
_WHOLE_M: Final = REACH_UNIT_M * 255


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
