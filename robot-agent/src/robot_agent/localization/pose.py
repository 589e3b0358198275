"""Poses in the plane: transformations between frames, their certainty, absolute observations, and saved ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from fog_kernels.scans import into_frame, out_of_frame

if TYPE_CHECKING:
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


class Uncertainty(NamedTuple):
    """Standard deviations of a pose: along and across its least certain direction (m), and of the heading (rad).

    In a corridor without features, `along` is the direction of the corridor. axis: that direction in `map`, a unit
    vector of either sign.
    """

    along: float
    across: float
    heading: float
    axis: tuple[float, float] = (1.0, 0.0)


def uncertainty(covariance: NDArray[np.float64]) -> Uncertainty:
    """Return the standard deviations of a covariance (3, 3) over (x, y, theta)."""
    (least, most), vectors = np.linalg.eigh(covariance[:2, :2])
    return Uncertainty(
        math.sqrt(max(0.0, most)),
        math.sqrt(max(0.0, least)),
        math.sqrt(max(0.0, covariance[2, 2])),
        (float(vectors[0, 1]), float(vectors[1, 1])),
    )


@dataclass(frozen=True, slots=True, eq=False)
class AbsoluteObservation:
    """Where `base` was in `map`, with the covariance (3, 3) over (x, y, theta) (m, rad), at `stamp` (s).

    Observed by what measures the pose without the lidar and is believed (`AgentCore.on_absolute_observation`): the
    contacts of the dock, a person with a tape measure. A marker may hang elsewhere: its sightings are weighed first
    (`markers`). The pose is fused with the estimate at the odometry of that time, so it may be as late as odometry is
    kept (`OdometryBuffer`).

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


class SavedPose(msgspec.Struct, frozen=True, kw_only=True):
    """A pose to restore after a restart, in `map` of a site (m, rad), with its standard deviations.

    base: number of the base's feedback then, and its wheels' counters (m, left and right); None: unknown. guardian: the
    id of the guardian's run that numbered it.
    """

    site: str
    x: float
    y: float
    theta: float
    sigma_xy: float
    sigma_theta: float
    base: tuple[int, float, float] | None = None
    guardian: str = ""
