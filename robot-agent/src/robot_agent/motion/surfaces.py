"""Surfaces in the points of a lidar: neighbouring beams that met the same thing. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_kernels import scans

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_SURFACE_M: Final = 0.06
"""Neighbours in a scan that are nearer than this may lie on one surface."""
SHIFT_MAX_M: Final = 0.01
"""No point is moved farther: noise is of this size, and half the stop field's margin remains if it was none."""


def smoothed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a scan's points (n, 2; m, in the order of its beams), each moved towards the mean with its neighbours.

    Noise of single beams would close a gap: the nearest of some hundred points on its sides is three standard
    deviations too near. But neighbours may also be a thin leg and the wall close behind it, or the two sides of an
    edge, so a point moves by `SHIFT_MAX_M` at most: whatever is measured to a point, it grows by no more than that.
    """
    return scans.smoothed(points, _SURFACE_M, SHIFT_MAX_M)
