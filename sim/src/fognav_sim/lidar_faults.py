"""A lidar that errs as recorded ones do: what it loses has structure, and its noise depends on the range. Pure.

The figures are those of recordings of an RPLidar A1 (several series in living rooms, some 690,000 measurements).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels.emulation import Beams, Drawn, RecordedErrors, disturb_as_recorded

if TYPE_CHECKING:
    from numpy.typing import NDArray

LIDAR_MIN_M: Final = 0.15
LIDAR_MAX_M: Final = 12.0
_ERRORS: Final = RecordedErrors(
    noise=np.array(((0.0, 0.0016), (2.0, 0.0018), (2.5, 0.0030), (12.0, 0.054))),
    loss=np.array(((0.0, 0.20), (0.3, 0.15), (0.45, 0.05), (1.0, 0.01), (4.0, 0.01), (8.0, 0.03), (12.0, 0.06))),
    tail=0.15,
    tail_sigmas=4.0,
    outliers=4e-4,
    low=LIDAR_MIN_M,
    high=LIDAR_MAX_M,
)
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

    @cached_property
    def _patches(self) -> NDArray[np.float64]:
        return np.array(self.patches).reshape(-1, 4)

    @cached_property
    def _dead(self) -> NDArray[np.float64]:
        return np.array(self.dead).reshape(-1, 2)

    def disturb(
        self,
        ranges: NDArray[np.float64],
        angles: NDArray[np.float64],
        place: tuple[float, float],
        directions: NDArray[np.float64],
        generator: np.random.Generator,
    ) -> None:
        """Turn these true ranges (m) into what is measured of them, nan for no return.

        `angles` are those of the beams in the lidar's frame, `directions` those on the floor (rad); it is at `place`.
        """
        drawn = Drawn(
            generator.random(ranges.size),
            generator.standard_normal(ranges.size),
            generator.random((3 + len(self.patches), ranges.size)),
        )
        dead = self._dead
        if dead.size:
            dead = dead + _FLICKER_RAD * generator.standard_normal(dead.shape)
        beams = Beams(angles, np.cos(directions), np.sin(directions))
        disturb_as_recorded(ranges, beams, drawn, _ERRORS, place, self._patches, dead)
