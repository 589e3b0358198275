"""A lidar that errs as recorded ones do: what it loses has structure, and its noise depends on the range. Pure.

The figures are those of recordings of an RPLidar A1 (several series in living rooms, some 690,000 measurements).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

LIDAR_MIN_M: Final = 0.15
LIDAR_MAX_M: Final = 12.0
_LOSS_RANGES_M: Final = (0.0, 0.3, 0.45, 1.0, 4.0, 8.0, 12.0)
_LOSS: Final = (0.20, 0.15, 0.05, 0.01, 0.01, 0.03, 0.06)
"""Share of single measurements without a return, by range."""
_NOISE_RANGES_M: Final = (0.0, 2.0, 2.5, 12.0)
_NOISE_M: Final = (0.0016, 0.0018, 0.0030, 0.054)
_TAIL: Final = 0.15
_TAIL_SIGMAS: Final = 4.0
_OUTLIERS: Final = 4e-4
_FLICKER_RAD: Final = math.radians(2.0)


@dataclass(frozen=True, kw_only=True)
class LidarFaults:
    """How a lidar errs on a floor, besides its noise.

    `patches`: places (x, y, radius; m, frame `map`) whose surfaces return a beam with this probability only, such as
    black or shiny ones. `dead`: sectors (from, to; rad, counter-clockwise, in the lidar's frame) in which nothing
    returns; their edges flicker.
    """

    patches: tuple[tuple[float, float, float, float], ...] = ()
    dead: tuple[tuple[float, float], ...] = ()

    def disturb(
        self,
        ranges: NDArray[np.float64],
        angles: NDArray[np.float64],
        place: tuple[float, float],
        directions: NDArray[np.float64],
        generator: np.random.Generator,
    ) -> NDArray[np.float64]:
        """Return what is measured of these true ranges (m), nan for no return.

        `angles` are those of the beams in the lidar's frame, `directions` those on the floor (rad); it is at `place`.
        """
        finite = np.where(np.isfinite(ranges), ranges, LIDAR_MAX_M)
        sigma = np.interp(finite, _NOISE_RANGES_M, _NOISE_M)
        sigma = np.where(generator.random(ranges.size) < _TAIL, _TAIL_SIGMAS * sigma, sigma)
        measured = ranges + sigma * generator.standard_normal(ranges.size)
        outliers = generator.random(ranges.size) < _OUTLIERS
        measured = np.where(outliers, generator.uniform(LIDAR_MIN_M, LIDAR_MAX_M, ranges.size), measured)
        lost = generator.random(ranges.size) < np.interp(finite, _LOSS_RANGES_M, _LOSS)
        end_x, end_y = place[0] + finite * np.cos(directions), place[1] + finite * np.sin(directions)
        for x, y, radius, returned in self.patches:
            lost |= (np.hypot(end_x - x, end_y - y) < radius) & (generator.random(ranges.size) >= returned)
        for begin, end in self.dead:
            first, last = np.array((begin, end)) + _FLICKER_RAD * generator.standard_normal(2)
            lost |= (angles - first) % math.tau <= (last - first) % math.tau
        seen = (measured >= LIDAR_MIN_M) & (measured <= LIDAR_MAX_M) & ~lost
        return np.where(seen, measured, np.nan)
