"""The points of the last few scans together, so that noise can't open a gap: what one scan saw near stays near."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from robot_agent.localization.pose import Pose2
from robot_agent.motion.surfaces import smoothed

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.deskew import DeskewedScan

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
