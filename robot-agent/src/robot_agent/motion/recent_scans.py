"""The points of the last few scans together, so that noise can't open a gap: what one scan saw near stays near."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from robot_agent.motion.surfaces import smoothed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.deskew import DeskewedScan
    from robot_agent.localization.pose import Pose2

SCANS: Final = 4
"""With the newest scan alone a robot beside an obstacle waits for the scan whose noise shows it farthest away, moves,
and waits again, until it touches."""
MAX_AGE_S: Final = 1.0
"""What has moved away since is in the way no longer than this."""


class RecentScans:
    """The newest scans of one lidar, placed by odometry relative to the newest one. Times: s, monotonic."""

    def __init__(self) -> None:
        self._newest: DeskewedScan | None = None
        self._scans: deque[tuple[float, Pose2, NDArray[np.float64]]] = deque(maxlen=SCANS)
        """Time, pose in `odom` and points in `base` of each."""

    def add(self, scan: DeskewedScan, now: float) -> None:
        """Add the newest scan; the same one again is ignored."""
        if self._newest is not scan:
            self._newest = scan
            self._scans.append((now, scan.odom, smoothed(scan.points)))

    def points(self, newest: Pose2, now: float) -> NDArray[np.float64]:
        """Return all points (n, 2; m) in the frame in which `newest` is the pose of the newest scan."""
        while self._scans and now - self._scans[0][0] > MAX_AGE_S:
            self._scans.popleft()
        if not self._scans:
            return np.zeros((0, 2))
        last = self._scans[-1][1]
        return np.vstack([newest.compose(odom.relative_to(last)).transform(points) for _, odom, points in self._scans])
