"""Scans: corrected for the robot's motion during the revolution, compared, matched with the map, and collected.

Method of the matching: correlative matching (Olson 2009) reduced to a hill climb around the estimate, whose Gaussian is
the prior; the covariance is that of the prior and of the curvature of the scan's likelihood together. Directions that
the scan does not observe have no curvature, so the prior alone decides there.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels import scans
from fog_kernels.scans import climb
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.odometry import OdometryBuffer


_COMPARED: Final = 120
_COMPARED_LEAST: Final = 20
_BESIDE_RAD: Final = 0.04
"""A beam is compared with those of the scan before that went this near to its direction."""
_ALIKE_M: Final = 0.1
_ALIKE_SHARE: Final = 0.05
"""Ranges differ by no more than this, and this share of them: along a wall that is seen at a low angle by most."""
_ALIKE_BEAMS: Final = 0.7
"""Share of the beams that must be alike."""


@dataclass(frozen=True, slots=True)
class DeskewedScan:
    """A scan whose samples are moved to the robot's pose at its end.

    points: (n, 2) m, frame `base` at the scan's end, without samples that have no return or exceed the rated range.
    odom: pose of `base` in `odom` at that time. timestamp: that time (s).
    """

    points: NDArray[np.float64]
    odom: Pose2
    timestamp: float

    def beams(self, count: int) -> NDArray[np.float64]:
        """Return at most `count` of the points, evenly spread over the revolution."""
        return spread(self.points, count)


def spread(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return at most `count` of the points (n, 2), evenly spread over them."""
    if len(points) <= count:
        return points
    return points[np.arange(count) * (len(points) - 1) // max(count - 1, 1)]


def follows(scan: DeskewedScan, before: DeskewedScan) -> bool:
    """Whether a scan shows what the one before it showed, from where the wheels say that the robot is since.

    If it does not, somebody has carried or turned the robot, or stands around it. The map is not asked: so a door that
    was opened since it was made, which spoils how scans fit the map, says nothing here.
    """
    seen = before.odom.inverse_transform(scan.odom.transform(scan.beams(_COMPARED)))
    order = np.argsort(angles := np.arctan2(before.points[:, 1], before.points[:, 0]))
    if not len(order):
        return False
    bearings, ranges = angles[order], np.hypot(before.points[:, 0], before.points[:, 1])[order]
    bearing, distance = np.arctan2(seen[:, 1], seen[:, 0]), np.hypot(seen[:, 0], seen[:, 1])
    beside = (np.searchsorted(bearings, bearing)[:, None] + np.arange(-2, 2)) % len(order)
    turned = np.abs((bearings[beside] - bearing[:, None] + np.pi) % (2.0 * np.pi) - np.pi)
    compared = turned < _BESIDE_RAD
    alike = compared & (np.abs(ranges[beside] - distance[:, None]) < _ALIKE_M + _ALIKE_SHARE * distance[:, None])
    count = int(compared.any(axis=1).sum())
    return count >= _COMPARED_LEAST and int(alike.any(axis=1).sum()) >= _ALIKE_BEAMS * count


def deskew(scan: LaserScan, odometry: OdometryBuffer, config: LocalizationConfig) -> DeskewedScan | None:
    """Move each sample by the robot's motion between its own time and the scan's end.

    None when no odometry is as old as the scan's end. The lidar's pose in `base` and its rated range are the config's.
    """
    end = odometry.pose(scan.ended_at)
    if end is None or not odometry.reaches_back_to(scan.ended_at):
        return None
    seen = scans.placed(
        scan.angles_rad,
        scan.ranges_m,
        scan.started_at,
        scan.ended_at,
        odometry.track(scan.started_at),
        scans.Mounting(config.lidar_x, config.lidar_y, config.lidar_yaw),
        config.range_min,
        config.range_max,
    )
    return DeskewedScan(end.inverse_transform(seen.points), end, scan.ended_at)


_INFORMATION: Final = 40.0
"""Logarithm of the likelihood ratio between a pose that all beams fit and one that none fits. The beams of one scan are
not independent: their errors come from the same wall, map cell and moment."""
_STEPS: Final = np.array([(0.05, 0.05, 0.02), (0.025, 0.025, 0.01), (0.012, 0.012, 0.005), (0.006, 0.006, 0.0025)])
_CLIMBS_MAX: Final = 12
"""Moves with each size of step."""
_BOUND: Final = np.array((0.3, 0.3, 0.15))
"""A match moves no estimate farther (m, m, rad): what lies beyond may be another place."""
_CURVATURE_STEP: Final = (0.06, 0.06, 0.025)
_LEAST_SIGMAS: Final = (0.02, 0.02, 0.007)
"""No pose is more certain than this (m, m, rad): half a cell of the map, and what the map's own errors allow."""
_SHIFTS: Final = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.float64)
_SECOND_ORDER: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_QUADRATIC: Final = np.linalg.pinv(
    np.column_stack((np.ones(len(_SHIFTS)), _SHIFTS, *(_SHIFTS[:, i] * _SHIFTS[:, j] for i, j in _SECOND_ORDER)))
)
"""From values at the shifts to the coefficients of the quadratic function that fits them best."""


class Match(NamedTuple):
    """The best pose in `map`, and its covariance (3, 3) over (x, y, theta)."""

    pose: Pose2
    covariance: NDArray[np.float64]


def match_scan(fields: MapFields, pose: Pose2, covariance: NDArray[np.float64], points: NDArray[np.float64]) -> Match:
    """Refine an estimate with its covariance (3, 3) by a scan's points (n, 2; m, frame `base`)."""
    information = information_of(covariance)
    matched = matched_pose(fields, pose, information, points)
    fit = fields.scores(np.array(matched) + _SHIFTS * _CURVATURE_STEP, points, fields.sharp)
    return Match(matched, _posterior_covariance(_INFORMATION * fit, information))


def information_of(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information (3, 3) of a prior with this covariance over (x, y, theta), of which none is exact."""
    return np.linalg.inv(covariance + np.diag(np.square(_LEAST_SIGMAS)))


def matched_pose(
    fields: MapFields, pose: Pose2, information: NDArray[np.float64], points: NDArray[np.float64]
) -> Pose2:
    """Return the pose of `match_scan` alone, which takes a third of the time; information: (3, 3) of the estimate."""
    g = fields.geometry
    best = climb(
        points,
        pose,
        information,
        fields.sharp,
        g.resolution,
        (g.origin_x, g.origin_y),
        _INFORMATION,
        _STEPS,
        _BOUND,
        _CLIMBS_MAX,
    )
    x, y, theta = (float(value) for value in np.array(pose) + best)
    return Pose2(x, y, wrap(theta))


def _posterior_covariance(values: NDArray[np.float64], prior: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance from log-likelihoods at the shifts around the maximum, and the prior's information."""
    curvature = np.zeros((3, 3))
    for (i, j), coefficient in zip(_SECOND_ORDER, (_QUADRATIC @ values)[4:], strict=True):
        curvature[i, j] = curvature[j, i] = -coefficient * (2.0 if i == j else 1.0)
    steps = np.array(_CURVATURE_STEP)
    observed = curvature / np.outer(steps, steps)
    eigenvalues, vectors = np.linalg.eigh(observed)
    observed = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
    covariance = np.linalg.inv(observed + prior) + np.diag(np.square(_LEAST_SIGMAS))
    return np.asarray(0.5 * (covariance + covariance.T))


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
    """The newest scans of one lidar, placed by odometry relative to the newest one. Times: s, monotonic.

    Together they leave no gap that noise opened: what one scan saw near stays near. Nor does noise close one:
    neighbouring beams that met the same surface are smoothed.
    """

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
