"""Absolute observations of the robot's pose: by its dock, a fiducial marker, or a person with a tape measure.

The one input for whatever measures the pose without the lidar: `AgentCore.on_absolute_observation`. The contacts of the
dock use it (`agent/maneuvering/docking.py`). A camera that sees a marker whose place in `map` is known would compose
that place with the measured one, rotate its covariance into `map`, and stamp both with the time of the picture. The
pose is fused with the estimate at the odometry of that time, so a picture may be as late as odometry is kept
(`OdometryBuffer`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.pose import Pose2


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteObservation:
    """Where `base` was in `map`, with the covariance (3, 3) over (x, y, theta) (m, rad), at `stamp` (s).

    `stamp` is on the clock of odometry and scans. Raises ValueError for a covariance that is none.
    """

    pose: Pose2
    covariance: NDArray[np.float64]
    stamp: float

    def __post_init__(self) -> None:
        matrix = np.asarray(self.covariance)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.allclose(matrix, matrix.T):
            raise ValueError("the covariance of an observation must be a symmetric, finite matrix (3, 3)")
        if np.linalg.eigvalsh(matrix)[0] <= 0.0 or not np.isfinite((*self.pose, self.stamp)).all():
            raise ValueError("an observation needs a finite pose and stamp, and a positive definite covariance")
