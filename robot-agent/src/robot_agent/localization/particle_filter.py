"""Monte Carlo localization over the likelihood field of the static map.

Methods: Monte Carlo localization (Thrun, Burgard and Fox 2005, chapter 8.2), sample size by KLD (Fox 2003), the
estimate refined by scan matching. The particles never see the refinement: it would make them too sure. No random
particles are added: a robot that is lost is looked for by a search (`relocalization`), and in a plain corridor nothing
would contradict them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels import amcl
from robot_agent.localization.pose import Pose2, Uncertainty, uncertainty, wrap
from robot_agent.localization.scans import match_scan
from robot_agent.localization.unobserved import ALONG_LEAST_M, Along, least_certain, moved_to, observed, shifts_along

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.scans import DeskewedScan

_SPREAD_SAMPLES: Final = 16_000
"""Poses drawn around a given or doubtful pose: enough that some hundred of them fit."""
_SPREAD_JITTER: Final = 0.15
"""Their noise between the coarse and the fine field, as a share of the smallest spread."""
_MEAN_OF_TWICE_U2: Final = 2.0 / 3.0
_MEAN_OF_U4: Final = 1.0 / 5.0
"""Means of 2 u^2 and u^4, for the variance of what is drawn."""
_STILL_UNSEEN: Final = 0.5
"""Share of the variance that was drawn from which on the scan has not observed that direction."""
_SPREAD_SHARPNESS: Final = 3.0
"""Their weights are this many times as sharp as those of an update: one scan must do what many updates do."""
_SPREAD_BEAMS_MIN: Final = 5
_WIDEN_FROM: Final = (0.1, 0.1, 0.05)
"""Least standard deviations (m, m, rad) of an estimate in doubt."""
_MATCH_BEAMS: Final = 180
_STEPS_MAX: Final = 20
_SKIP_M: Final = 0.5
"""A beam that ends farther than this from any wall of the map hit something unknown, ..."""
_SKIP_SHARE_MAX: Final = 0.6
"""... unless that holds for more than this share of the beams: then the pose is wrong."""
_OTHER_CLUSTER: Final = 1.5
"""The estimate moves to another cluster of particles when that weighs this many times as much as its own."""
_SAME_CLUSTER_M: Final = 0.75
_ALL_M: Final = 10.0
"""Size of bins that put the one cloud along a corridor into one cluster: they must not tear off its sparse ends."""
_RESAMPLE_BELOW: Final = 0.5
"""Share of the particles that must carry the weight where scans do not tell how far along a corridor the robot is."""
_SMOOTHING: Final = 0.2
"""Noise along the corridor, as a share of the deviation there: some 500 particles ask for a quarter."""
_JUMP_M: Final = 1.0
_JUMP_SIGMAS: Final = 3.0
"""The estimate jumps when it moves farther than this, and than so many of its standard deviations."""
_STRAIGHT_RAD: Final = 1e-6
_SHRINK_MOST: Final = 0.5
"""Driving back takes back what the scale has done, but of the variance no more than this share at once."""
_SEEN_BELOW: Final = 0.97
"""A scan that leaves more of the variance has not seen how far the robot is: its curvature there is noise."""
_CREDIT: Final = 0.2
"""Share that counts of the little that a scan along a plain corridor tells of how far the robot is. Walls of a map are
bent by some centimetres: scan after scan sees the same bends, which are not where the walls really have theirs."""
_GATE: Final = 11.345
"""Squared Mahalanobis distance (0.99 quantile, 3 degrees of freedom) beyond which two poses contradict each other."""


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
        self._spread: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        """Smallest and largest standard deviations (m, m, rad) around the estimate that no scan has narrowed yet."""
        self.unseen = np.zeros(2)
        """Way (m, `map`) since scans observed how far the robot is: the odometry's scale is wrong by a share of it."""
        self.jumped = False
        """Whether the last update moved the estimate to another place."""
        self.covariance: NDArray[np.float64] = np.zeros((3, 3))
        """Over (x, y, theta) in `map` (m, rad), as of the last update; replaced, and never changed in place."""
        self._last_pose: tuple[Pose2, Pose2, Pose2, Pose2] | None = None
        """The last result of `pose`, after what it was made of: odometry, estimate, anchor."""
        self._last_uncertainty: tuple[NDArray[np.float64], Uncertainty] | None = None
        """The last result of `uncertainty`, after the covariance that it is of."""

    @property
    def size(self) -> int:
        """Number of particles."""
        return int(self._x.size)

    @property
    def has_pose(self) -> bool:
        """Whether there is an estimate."""
        return self._estimate is not None

    @property
    def uncertainty(self) -> Uncertainty:
        """Standard deviations of the pose as of the last update."""
        last = self._last_uncertainty
        if last is None or last[0] is not self.covariance:
            last = self._last_uncertainty = (self.covariance, uncertainty(self.covariance))
        return last[1]

    def pose(self, odom: Pose2) -> Pose2 | None:
        """Return the pose in `map` when the odometry says `odom`; None without an estimate."""
        estimate, anchor, last = self._estimate, self._anchor, self._last_pose
        if estimate is None:
            return None
        # Asked for about the same moment several times in a row.
        if last is None or last[0] is not odom or last[1] is not estimate or last[2] is not anchor:
            last = self._last_pose = (odom, estimate, anchor, estimate.compose(odom.relative_to(anchor)))
        return last[3]

    def start(self, pose: Pose2, odom: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        """Start at a pose in `map` with these standard deviations (m, rad), which the next scan narrows."""
        sigmas = np.array((sigma_xy, sigma_xy, sigma_theta))
        self._start(pose, odom, sigmas, sigmas)

    def widen(self, odom: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        """Let the estimate be wrong by up to these standard deviations (m, rad), which the next scan narrows again.

        Smaller errors stay as likely as they were: the cause may have moved the robot or not.
        """
        pose = self.pose(odom)
        if pose is not None:
            sigmas = np.maximum(np.sqrt(np.diag(self.covariance)), _WIDEN_FROM)
            self._start(pose, odom, sigmas, np.hypot(sigmas, (sigma_xy, sigma_xy, sigma_theta)))

    def _start(self, pose: Pose2, odom: Pose2, least: NDArray[np.float64], most: NDArray[np.float64]) -> None:
        self._anchor, self._estimate = odom, pose
        self._spread = (least, most)
        self.unseen = np.zeros(2)
        self.covariance = np.diag(most**2)
        self._set_particles(np.array(pose) + self._rng.standard_normal((self._config.particles_start, 3)) * most)

    def observe(self, pose: Pose2, covariance: NDArray[np.float64], odom: Pose2) -> bool:
        """Fuse a pose in `map` with its covariance (3, 3), measured at `odom`, without the scanner.

        False: there was no estimate, or it contradicted the measured pose, which has replaced it.
        """
        mine, agrees = self.pose(odom), False
        if mine is not None:
            offset = np.array((pose.x - mine.x, pose.y - mine.y, wrap(pose.theta - mine.theta)))
            total = self.covariance + covariance
            agrees = bool(offset @ np.linalg.solve(total, offset) <= _GATE)
            if agrees:
                gain = np.linalg.solve(total, self.covariance).T
                pose = Pose2(*(float(v) for v in np.array(mine) + gain @ offset))
                covariance = self.covariance - gain @ self.covariance
        self._anchor, self._estimate = odom, Pose2(pose.x, pose.y, wrap(pose.theta))
        self._spread = None
        self.unseen = np.zeros(2)
        self.covariance = 0.5 * (covariance + covariance.T)
        count = self._config.particles_start
        self._set_particles(self._rng.multivariate_normal(np.array(self._estimate), self.covariance, count))
        return agrees

    def add(self, scan: DeskewedScan, fields: MapFields, scale_sigma: float = 0.0) -> None:
        """Correct the estimate by a scan when the robot moved since the last one; there must be an estimate.

        `scale_sigma`: standard deviation of the share by which the odometry counts too far, all the time.
        """
        self.jumped = False
        if self._spread is not None:
            self._narrow(scan, fields, *self._spread)
        else:
            self._update(scan, fields, scale_sigma)

    def _set_particles(self, poses: NDArray[np.float64]) -> None:
        self._x, self._y, self._theta = (np.ascontiguousarray(poses[:, i], np.float32) for i in range(3))
        self._weights = np.full(len(poses), 1.0 / len(poses))

    def _narrow(
        self, scan: DeskewedScan, fields: MapFields, least: NDArray[np.float64], most: NDArray[np.float64]
    ) -> None:
        """Weight many poses within the given deviations by a scan.

        What the scan does not observe keeps the deviation that it was given with.
        """
        pose = self.pose(scan.odom)
        assert pose is not None
        self._anchor, self._estimate = scan.odom, pose
        points = scan.beams(self._config.beams)
        if len(points) < _SPREAD_BEAMS_MIN:
            return
        sharpness = self._config.sharpness
        # Each direction by itself: else a scan that sees two walls would rule out what it can't see along them.
        spread = least + (most - least) * self._rng.random((_SPREAD_SAMPLES, 3)) ** 2
        poses = np.array(pose) + self._rng.standard_normal((_SPREAD_SAMPLES, 3)) * spread
        poses = _drawn(self._rng, poses, sharpness * fields.agreements(poses, points, fields.coarse))
        poses += self._rng.standard_normal(poses.shape) * (_SPREAD_JITTER * least)
        log_weights = _SPREAD_SHARPNESS * sharpness * fields.agreements(poses, points, fields.fine)
        self._spread = None
        self._set_particles(poses)
        self._weights = np.exp(log_weights - log_weights.max())
        self._weights /= self._weights.sum()
        kept = least_certain(self._x, self._y, self._weights)
        if kept is not None:
            difference = most[0] - least[0]
            drawn = least[0] ** 2 + least[0] * difference * _MEAN_OF_TWICE_U2 + difference**2 * _MEAN_OF_U4
            if kept.variance > _STILL_UNSEEN * drawn:
                kept = kept._replace(variance=float(most[0] ** 2))
                self._move_along(kept)
        self._conclude(scan, fields, one_cloud=kept is not None)
        self._resample()

    def _update(self, scan: DeskewedScan, fields: MapFields, scale_sigma: float) -> None:
        config = self._config
        step = scan.odom.relative_to(self._anchor)
        length, angle = math.hypot(step.x, step.y), abs(step.theta)
        if length < config.update_distance and angle < config.update_angle:
            return
        before = self._estimate
        self._move(scan.odom, max(length / config.update_distance, angle / config.update_angle))
        self._estimate = self.pose(scan.odom)
        self._anchor = scan.odom
        prior = self._spread_by_scale(before, self._estimate, scale_sigma)
        predicted, reach = self._estimate, max(_JUMP_M, _JUMP_SIGMAS * self.uncertainty.along)
        log_likelihoods = self._log_likelihoods(scan, fields)
        kept = self._weigh(log_likelihoods)
        self._conclude(scan, fields, one_cloud=kept is not None)
        self._see(prior)
        self.jumped = _distance(predicted, self._estimate) > reach
        # Each draw makes the cloud along a plain corridor more ragged: there it waits until few particles carry the
        # weight (Grisetti, Stachniss and Burgard 2007).
        if kept is None or self._effective < _RESAMPLE_BELOW * self.size:
            self._resample()
            self._smooth_along(kept)
            self._move_along(kept)

    def _move(self, odom: Pose2, steps: float) -> None:
        """Move the particles along the odometry, in steps of the size that the noise is given for."""
        for before, length, after in _chords(self._anchor, odom, min(max(1, round(steps)), _STEPS_MAX)):
            amcl.motion_update(self._x, self._y, self._theta, before, length, after, self._config.alphas, self._state)

    def _spread_by_scale(self, before: Pose2 | None, after: Pose2 | None, sigma: float) -> NDArray[np.float64]:
        """Spread the particles along a step by what the odometry's scale may be wrong; return their covariance (2, 2).

        The scale is wrong by the same share all the way, so the deviation grows with the way, not with its root.
        """
        assert before is not None
        assert after is not None
        step = np.array((after.x - before.x, after.y - before.y))
        length = math.hypot(*step)
        covariance = self._covariance_xy()
        if length > 0.0:
            cos, sin = (float(value) for value in step / length)
            variance = cos * cos * covariance[0, 0] + 2.0 * cos * sin * covariance[0, 1] + sin * sin * covariance[1, 1]
            growth = sigma * sigma * length * (2.0 * float(self.unseen @ step) / length + length)
            mean = float(self._weights @ (cos * self._x + sin * self._y))
            wanted = Along((cos, sin), mean, max(variance + growth, _SHRINK_MOST * variance))
            self._x, self._y = moved_to(wanted, self._x, self._y, self._weights)
            self.unseen = self.unseen + step
            covariance = self._covariance_xy()
        return covariance

    def _covariance_xy(self) -> NDArray[np.float64]:
        # What `numpy.cov` does, with a third of its calls: twice an update.
        places, total = np.array((self._x, self._y), np.float64), self._weights.sum()
        places -= ((places * self._weights).sum(axis=1) / total)[:, None]
        return np.asarray(np.dot(places, (places * self._weights).T) * (1.0 / total))

    def _see(self, prior: NDArray[np.float64]) -> None:
        """Forget of the way what the scan has observed, by the covariances (2, 2) of the position before and after."""
        before, after = (
            float(self.unseen @ covariance[:2, :2] @ self.unseen) for covariance in (prior, self.covariance)
        )
        if after < _SEEN_BELOW * before:
            self.unseen = self.unseen * (after / before)

    def _log_likelihoods(self, scan: DeskewedScan, fields: MapFields) -> NDArray[np.float64]:
        """Return the logarithms (n) of the particles' likelihoods by a scan, but for a constant."""
        config = self._config
        points = self._explained(scan.beams(config.beams), fields)
        agreements = np.zeros(self.size)
        if len(points):
            poses = np.column_stack((self._x, self._y, self._theta)).astype(np.float64)
            agreements = fields.agreements(poses, points, fields.fine)
        # AMCL's weight, 1 + sum of p^3, spans one order of magnitude at most and leaves the cloud three times as
        # wide as need be at this odometry noise. The exponent here is linear in the same sum.
        return np.asarray(config.sharpness * (agreements - agreements.max()))

    def _weigh(self, log_likelihoods: NDArray[np.float64]) -> Along | None:
        """Weight the particles; return what they keep along the direction that the scan hardly observes, if any."""
        # Where matching the last scan left no doubt, the weights of this one may speak for themselves.
        unseen = self.uncertainty.along >= ALONG_LEAST_M
        before = least_certain(self._x, self._y, self._weights) if unseen else None
        kept = before and observed(before, (self._x, self._y, self._theta), self._weights, log_likelihoods, _CREDIT)
        self._weights = self._weights * np.exp(log_likelihoods)
        self._weights /= self._weights.sum()
        self._move_along(kept)
        return kept

    def _move_along(self, kept: Along | None) -> None:
        if kept is not None:
            self._x, self._y = moved_to(kept, self._x, self._y, self._weights)

    def _smooth_along(self, kept: Along | None) -> None:
        """Draw copies of one particle apart, as a regularized filter does (Musso, Oudjane and Le Gland 2001).

        Odometry with little noise leaves them together: after 80 m the cloud lay in clumps, one of which was taken for
        the robot's place.
        """
        if kept is not None:
            noise = _SMOOTHING * math.sqrt(kept.variance) * self._rng.standard_normal(self.size)
            self._x += (kept.direction[0] * noise).astype(np.float32)
            self._y += (kept.direction[1] * noise).astype(np.float32)

    @property
    def _effective(self) -> float:
        """Number of equally weighted particles that would tell as much."""
        return 1.0 / float(self._weights @ self._weights)

    def _explained(self, points: NDArray[np.float64], fields: MapFields) -> NDArray[np.float64]:
        """Return the beams (n, 2) without those that end far from every wall: persons and other unknown objects.

        The end of a long corridor is neither, however uncertain it is where the robot will see it.
        """
        assert self._estimate is not None
        ends = self._estimate.transform(points)
        near = np.zeros(len(points), np.bool_)
        for shift in shifts_along(self.covariance):
            near |= fields.wall_distances(ends + shift) <= _SKIP_M
        return points[near] if near.sum() > (1.0 - _SKIP_SHARE_MAX) * len(points) else points

    def _conclude(self, scan: DeskewedScan, fields: MapFields, *, one_cloud: bool = False) -> None:
        """Estimate pose and covariance from the weighted particles, and refine them by matching the scan.

        one_cloud: the particles are one cloud along a corridor (`least_certain`), however ragged its ends are.
        """
        mean = self._cluster(one_cloud=one_cloud)
        matched = match_scan(fields, Pose2(mean.x, mean.y, mean.theta), mean.covariance, scan.beams(_MATCH_BEAMS))
        self._estimate, self.covariance = matched

    def _cluster(self, *, one_cloud: bool) -> amcl.Estimate:
        """Return the cluster of particles around the estimate, or the heaviest one if that weighs clearly more."""
        config = self._config
        bin_xy = _ALL_M if one_cloud else config.bin_xy
        groups = amcl.clusters(self._x, self._y, self._theta, self._weights, bin_xy, config.bin_theta)
        heaviest, before = groups[0], self._estimate
        assert before is not None
        for group in groups:
            place = Pose2(group.estimate.x, group.estimate.y, group.estimate.theta)
            if _distance(place, before) < _SAME_CLUSTER_M and heaviest.share < _OTHER_CLUSTER * group.share:
                return group.estimate
        return heaviest.estimate

    def _resample(self) -> None:
        config = self._config
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
        )


def _chords(begin: Pose2, end: Pose2, count: int) -> Iterator[tuple[float, float, float]]:
    """Yield rotation, translation and rotation (rad, m, rad) of equal chords of one arc between two odometry poses.

    The first rotation aims the arc so that it ends where the odometry does.
    """
    rot1, trans, rot2 = amcl.odometry_delta(begin, end)
    turn = wrap(rot1 + rot2)
    half = turn / (2.0 * count)
    aim = rot1 - 0.5 * turn
    length = trans * math.sin(half) / math.sin(0.5 * turn) if abs(turn) > _STRAIGHT_RAD else trans / count
    for number in range(count):
        yield half + (aim if number == 0 else 0.0), length, half - (aim if number == count - 1 else 0.0)


def _drawn(
    rng: np.random.Generator, poses: NDArray[np.float64], log_weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return as many poses (n, 3), drawn with low variance by their weights."""
    cumulated = np.cumsum(np.exp(log_weights - log_weights.max()))
    targets = (np.arange(len(poses)) + rng.random()) * (cumulated[-1] / len(poses))
    return np.asarray(poses[np.minimum(np.searchsorted(cumulated, targets), len(poses) - 1)])


def _distance(one: Pose2 | None, other: Pose2 | None) -> float:
    assert one is not None
    assert other is not None
    return math.hypot(one.x - other.x, one.y - other.y)
