"""The points of the last few scans together, so that noise can't open a gap: what one scan saw near stays near.

Nor close one: neighbouring beams that met the same surface are smoothed.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels import scans
from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.scans import DeskewedScan

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


SCANS: Final = 4
"""With the newest scan alone a robot beside an obstacle waits for the scan whose noise shows it farthest away, moves,
and waits again, until it touches."""
MAX_AGE_S: Final = 1.0
"""What has moved away since is in the way no longer than this."""


class RecentScans:
    """The newest scans of one lidar, placed by odometry relative to the newest one. Times: s, monotonic."""

    def __init__(self) -> None:
        self._newest: DeskewedScan | None = None
        self._scans: deque[tuple[float, NDArray[np.float64]]] = deque(maxlen=SCANS)
        """Time and points in `odom` of each."""
        self._odom = Pose2(0.0, 0.0, 0.0)
        """Pose in `odom` of the newest."""

    def add(self, scan: DeskewedScan, now: float) -> None:
        """Add the newest scan; the same one again is ignored."""
        if self._newest is not scan:
            self._newest = scan
            self._odom = scan.odom
            self._scans.append((now, scan.odom.transform(smoothed(scan.points))))

    def points(self, newest: Pose2, now: float) -> NDArray[np.float64]:
        """Return all points (n, 2; m) in the frame in which `newest` is the pose of the newest scan."""
        while self._scans and now - self._scans[0][0] > MAX_AGE_S:
            self._scans.popleft()
        if not self._scans:
            return np.zeros((0, 2))
        origin = newest.compose(Pose2(0.0, 0.0, 0.0).relative_to(self._odom))
        return origin.transform(np.concatenate([points for _, points in self._scans]))
