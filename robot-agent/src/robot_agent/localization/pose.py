"""Poses in the plane, and transformations between frames."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from fog_kernels.scans import into_frame, out_of_frame

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def wrap(angle: float) -> float:
    """Return the angle in -pi..pi (rad)."""
    return math.remainder(angle, 2.0 * math.pi)


class Pose2(NamedTuple):
    """A pose (m, m, rad) in the frame that its owner documents."""

    x: float
    y: float
    theta: float

    def compose(self, step: Pose2) -> Pose2:
        """Return the pose that is `step` away, as seen from this one."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        return Pose2(
            self.x + cos * step.x - sin * step.y, self.y + sin * step.x + cos * step.y, wrap(self.theta + step.theta)
        )

    def relative_to(self, origin: Pose2) -> Pose2:
        """Return this pose in the frame of `origin`, so that `origin.compose` of it is this pose."""
        dx, dy = self.x - origin.x, self.y - origin.y
        cos, sin = math.cos(origin.theta), math.sin(origin.theta)
        return Pose2(cos * dx + sin * dy, -sin * dx + cos * dy, wrap(self.theta - origin.theta))

    def transform(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return points (n, 2; m) that are given in the frame of this pose in the frame that the pose itself is in."""
        return out_of_frame(points, *self)

    def inverse_transform(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undo `transform`: return points (n, 2; m) of the frame that this pose is in as seen from it."""
        return into_frame(points, *self)
