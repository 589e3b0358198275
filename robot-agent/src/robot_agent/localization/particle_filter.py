"""Monte Carlo localization over the likelihood field of the static map.

Methods: augmented recovery (Thrun, Burgard and Fox 2005, chapters 8.2 and 8.3), sample size by KLD (Fox 2003).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels import amcl
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.deskew import DeskewedScan
    from robot_agent.localization.map_fields import MapFields

_REFINE_SAMPLES: Final = 4000
"""Poses tried per round of refining a given pose, ..."""
_REFINE_SHRINK: Final = 0.4
"""... each round within this share of the spread of the one before."""
_REFINE_BEAMS_MIN: Final = 5
_REFINED_SIGMAS: Final = (0.08, 0.04)
"""Standard deviations (m, rad) of a refined pose."""
_RANDOM_SHARE_MAX: Final = 0.1


class ParticleFilter:
    """The estimate of the pose in `map`, tied to the odometry at which it was made; pure but for its seeded generators.

    Feed it deskewed scans in order of time. Between updates the pose follows the odometry.
    """

    def __init__(self, config: LocalizationConfig, seed: int) -> None:
        self._config = config
        self._state = amcl.rng_state(seed)
        self._rng = np.random.default_rng(seed)
        self._x: NDArray[np.float32] = np.zeros(0, np.float32)
        self._y: NDArray[np.float32] = np.zeros(0, np.float32)
        self._theta: NDArray[np.float32] = np.zeros(0, np.float32)
        self._weights: NDArray[np.float64] = np.zeros(0)
        self._estimate: Pose2 | None = None
        self._anchor = Pose2(0.0, 0.0, 0.0)
        """Odometry at which the estimate was made."""
        self._unrefined_sigmas: tuple[float, float] | None = None
        """Standard deviations (m, rad) of a given pose that no scan has refined yet."""
        self._slow = self._fast = 0.0
        self.covariance: NDArray[np.float64] = np.zeros((3, 3))
        """Over (x, y, theta) in `map` (m, rad), as of the last update."""

    @property
    def size(self) -> int:
        """Number of particles."""
        return int(self._x.size)

    @property
    def has_pose(self) -> bool:
        """Whether there is an estimate."""
        return self._estimate is not None

    def pose(self, odom: Pose2) -> Pose2 | None:
        """Return the pose in `map` when the odometry says `odom`; None without an estimate."""
        return None if self._estimate is None else self._estimate.compose(odom.relative_to(self._anchor))

    def sigmas(self) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad)."""
        return (
            math.sqrt(max(0.0, self.covariance[0, 0] + self.covariance[1, 1])),
            math.sqrt(max(0.0, self.covariance[2, 2])),
        )

    def start(self, pose: Pose2, odom: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        """Start at a pose in `map` with these standard deviations (m, rad), which the next scan refines by search."""
        self.place(pose, odom, sigma_xy, sigma_theta)
        self._unrefined_sigmas = (sigma_xy, sigma_theta)

    def place(self, pose: Pose2, odom: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        """Start at a pose in `map` that was found by search, with these standard deviations (m, rad)."""
        self._anchor = odom
        self._unrefined_sigmas = None
        self._slow = self._fast = 0.0
        self._spread(pose, sigma_xy, sigma_theta)

    def forget(self) -> None:
        """Discard the estimate."""
        self._estimate = None

    def add(self, scan: DeskewedScan, fields: MapFields, *, recover: bool) -> None:
        """Correct the estimate by a scan when the robot moved since the last one; there must be an estimate.

        `recover`: whether random particles may be added over the map when scans fit less and less.
        """
        if self._unrefined_sigmas is not None:
            self._refine(scan, fields)
        else:
            self._update(scan, fields, recover=recover)

    def _spread(self, pose: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        count = self._config.particles_start
        self._estimate = pose
        self.covariance = np.diag([sigma_xy**2, sigma_xy**2, sigma_theta**2])
        self._x = (pose.x + sigma_xy * self._rng.standard_normal(count)).astype(np.float32)
        self._y = (pose.y + sigma_xy * self._rng.standard_normal(count)).astype(np.float32)
        self._theta = (pose.theta + sigma_theta * self._rng.standard_normal(count)).astype(np.float32)
        self._weights = np.full(count, 1.0 / count)

    def _refine(self, scan: DeskewedScan, fields: MapFields) -> None:
        """Search the best pose within the given deviations; a single weighting would leave too few particles."""
        pose = self.pose(scan.odom)
        assert pose is not None
        assert self._unrefined_sigmas is not None
        self._anchor = scan.odom
        points = scan.beams(self._config.beams)
        if len(points) < _REFINE_BEAMS_MIN:
            self._estimate = pose
            return
        sigma_xy, sigma_theta = self._unrefined_sigmas
        for field in (fields.coarse, fields.fine, fields.fine, fields.fine):
            noise = self._rng.standard_normal((_REFINE_SAMPLES, 3)) * (sigma_xy, sigma_xy, sigma_theta)
            tried = np.array(pose) + noise
            tried[0] = pose
            pose = Pose2(*(float(v) for v in tried[int(np.argmax(fields.scores(tried, points, field)))]))
            sigma_xy, sigma_theta = _REFINE_SHRINK * sigma_xy, _REFINE_SHRINK * sigma_theta
        self._unrefined_sigmas = None
        self._spread(Pose2(pose.x, pose.y, wrap(pose.theta)), *_REFINED_SIGMAS)

    def _update(self, scan: DeskewedScan, fields: MapFields, *, recover: bool) -> None:
        config = self._config
        step = scan.odom.relative_to(self._anchor)
        if math.hypot(step.x, step.y) < config.update_distance and abs(step.theta) < config.update_angle:
            return
        delta = amcl.odometry_delta(self._anchor, scan.odom)
        amcl.motion_update(self._x, self._y, self._theta, *delta, config.alphas, self._state)
        self._anchor = scan.odom
        random_share = self._update_weights(scan, fields)
        if not recover:
            # Unknown objects lower the average too: random particles are added only while the pose is not good.
            random_share = 0.0
        found = amcl.estimate(self._x, self._y, self._theta, self._weights)
        self._estimate = Pose2(found.x, found.y, found.theta)
        self.covariance = np.asarray(found.covariance)
        self._x, self._y, self._theta, self._weights = amcl.resample(
            self._x,
            self._y,
            self._theta,
            self._weights,
            config.particles_min,
            config.particles_max,
            config.kld_error,
            self._state,
            kld_z=config.kld_z,
            bin_xy=config.bin_xy,
            bin_theta=config.bin_theta,
            random_share=random_share,
            free_xy=fields.free_places if random_share else None,
            jitter=fields.geometry.resolution,
        )

    def _update_weights(self, scan: DeskewedScan, fields: MapFields) -> float:
        """Weight the particles by a scan; return the share of random ones that augmented recovery asks for."""
        config = self._config
        points = scan.beams(config.beams)
        average = 0.0
        if len(points):
            poses = np.column_stack((self._x, self._y, self._theta)).astype(np.float64)
            scores = fields.scores(poses, points, fields.fine) / fields.best_likelihood
            average = float(self._weights @ scores)
            # AMCL's weight, 1 + sum of p^3, spans one order of magnitude at most and leaves the cloud three times as
            # wide as need be at this odometry noise. The exponent here is linear in the same sum.
            self._weights = self._weights * np.exp(config.sharpness * (scores - scores.max()))
            self._weights /= self._weights.sum()
        self._slow += (config.recovery_slow if self._slow else 1.0) * (average - self._slow)
        self._fast += (config.recovery_fast if self._fast else 1.0) * (average - self._fast)
        if self._slow <= 0.0:
            return 0.0
        return min(_RANDOM_SHARE_MAX, max(0.0, 1.0 - self._fast / self._slow))
