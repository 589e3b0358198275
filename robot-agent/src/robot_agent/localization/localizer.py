"""Where the robot is: a particle filter over the likelihood field of the static map, fed by odometry and lidar turns.

Frames: `odom` is where the wheels believe to be since they were switched on, `map` is the site's, `base` the robot's
centre. Between filter updates the pose follows the odometry, so it is smooth and never older than the last feedback.
Pure: times are arguments, randomness comes from the seed.

Methods: Monte Carlo localization with augmented recovery (Thrun, Burgard and Fox 2005, chapters 8.2 and 8.3), sample
size by KLD (Fox 2003); global search coarse to fine over the likelihood field (in the manner of Olson 2009).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np

from fog_kernels import amcl
from fog_kernels.distance import squared_distance_capped
from fog_kernels.likelihood import likelihood_field
from fog_kernels.raycast import cast
from robot_agent.config import LocalizationConfig

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from robot_agent.hardware import LaserScan
    from robot_agent.safety.gate import Localization

_HISTORY_S: Final = 3.0
_EXTRAPOLATE_S: Final = 0.15
_TWIST_OVER_S: Final = 0.15
_TWIST_LEAST_S: Final = 0.03
_OCCUPIED: Final = 254
_FREE: Final = 0
_CHUNK: Final = 40_000
"""Candidate poses that one turn's share of a global search scores: some 10 ms."""
_NEAR_M: Final = 0.25
"""A beam that ends this near to a wall of the map agrees with it."""
_DOUBT: Final = 0.2
"""Share of contradicting beams from which the pose is doubted."""
_DOUBT_AT_FIRST: Final = 0.08
"""The same for a pose that has not proved itself yet: corridors look alike, a wrong one may fit by nine tenths."""
_DOUBTED_TURNS: Final = 25
"""As many turns in a row (some 4.5 s) with doubt and the pose is lost, however the rest fits."""
_SHALLOW_M: Final = 0.40
"""Range difference from which a beam is called short or long."""


class Pose2(NamedTuple):
    """A pose (m, m, rad) in the frame that its holder says."""

    x: float
    y: float
    theta: float

    def then(self, step: Pose2) -> Pose2:
        """Return the pose that is `step` away, seen from this one."""
        cos, sin = math.cos(self.theta), math.sin(self.theta)
        return Pose2(
            self.x + cos * step.x - sin * step.y, self.y + sin * step.x + cos * step.y, wrap(self.theta + step.theta)
        )

    def seen_from(self, origin: Pose2) -> Pose2:
        """Return this pose in the frame of `origin`."""
        dx, dy = self.x - origin.x, self.y - origin.y
        cos, sin = math.cos(origin.theta), math.sin(origin.theta)
        return Pose2(cos * dx + sin * dy, -sin * dx + cos * dy, wrap(self.theta - origin.theta))


def wrap(angle: float) -> float:
    """Return the angle in -pi..pi (rad)."""
    return math.remainder(angle, 2.0 * math.pi)


class SavedPose(msgspec.Struct, frozen=True, kw_only=True):
    """What survives a restart: the pose in `map` of a site (m, rad) with its standard deviations."""

    site: str
    x: float
    y: float
    theta: float
    sigma_xy: float
    sigma_theta: float


@dataclass(frozen=True, slots=True)
class Sweep:
    """A turn without its skew: points (n, 2) in m, frame `base` as it stood in `odom` at the turn's end."""

    points: NDArray[np.float64]
    odom: Pose2
    at: float


@dataclass(frozen=True, slots=True)
class Fit:
    """How a scan fits the map at a pose, as shares of the beams.

    agree: end at a wall of the map, of those that tell something. explained: the same, of all. contradict: share of
    agreeing and overlong beams that look through a wall, which no unknown object can cause. informative: number of
    beams that met the map or should have, as opposed to unknown things before it.
    """

    agree: float
    explained: float
    contradict: float
    informative: int


class _Search:
    """A global search under way: candidates still to be scored, and the best so far."""

    def __init__(self, candidates: NDArray[np.float64], points: NDArray[np.float64], odom: Pose2) -> None:
        self.candidates = candidates
        self.scores = np.zeros(len(candidates))
        self.done = 0
        self.points = points
        self.odom = odom


class Localizer:
    """One robot's pose; feed it odometry and turns in order of time."""

    def __init__(self, config: LocalizationConfig | None = None, seed: int = 0) -> None:
        self._config = config or LocalizationConfig()
        self._state = amcl.rng_state(seed)
        self._rng = np.random.default_rng(seed)
        self._history: deque[tuple[float, float, float, float]] = deque()
        self._geometry: GridGeometry | None = None
        self._occupied: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._faces: NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
        self._field: NDArray[np.float32] = np.zeros((0, 0), np.float32)
        self._coarse: NDArray[np.float32] = np.zeros((0, 0), np.float32)
        self._best_score = 1.0
        self._wall_distance: NDArray[np.float32] = np.zeros((0, 0), np.float32)
        self._free: NDArray[np.float64] = np.zeros((0, 2))
        self._x: NDArray[np.float32] = np.zeros(0, np.float32)
        self._y: NDArray[np.float32] = np.zeros(0, np.float32)
        self._theta: NDArray[np.float32] = np.zeros(0, np.float32)
        self._weights: NDArray[np.float64] = np.zeros(0)
        self._estimate: Pose2 | None = None
        self._covariance: NDArray[np.float64] = np.zeros((3, 3))
        self._anchor = Pose2(0.0, 0.0, 0.0)
        self._slow = self._fast = 0.0
        self._settle: tuple[float, float] | None = None
        self._checking = 0
        self._doubted = 0
        self._proven = False
        self._search: _Search | None = None
        self._search_again_at = -math.inf
        self._verdicts: deque[Localization] = deque(maxlen=9)
        self._status: Localization = "none"
        self._detail = "no pose was given yet"
        self.sweep: Sweep | None = None
        """The newest turn, without its skew."""
        self.fit: Fit | None = None
        """How the newest turn fits the map."""

    # --- what goes in ---

    def load_map(self, static: NDArray[np.uint8], geometry: GridGeometry) -> None:
        """Take the static map (h, w; 0 free, 254 occupied, 255 unknown); the pose stays."""
        config = self._config
        occupied = np.ascontiguousarray(static == _OCCUPIED).astype(np.uint8)
        if self._geometry == geometry and np.array_equal(occupied, self._occupied):
            return
        self._geometry, self._occupied = geometry, occupied
        # A beam ends at the face of a wall; the inside of solid blocks must attract none.
        self._faces = occupied & ~_eroded(occupied)
        self._field = self._make_field(config.sigma_hit)
        self._coarse = self._make_field(2.0 * config.sigma_hit)
        self._best_score = (config.z_hit + config.z_rand / config.range_max) ** 3
        cap = max(1, math.ceil(1.0 / geometry.resolution))
        squared = squared_distance_capped(self._faces, cap)
        self._wall_distance = (np.sqrt(squared) * geometry.resolution).astype(np.float32)
        rows, columns = np.nonzero((static == _FREE) & (self._wall_distance >= 0.15))
        self._free = np.column_stack(
            (
                geometry.origin_x + (columns + 0.5) * geometry.resolution,
                geometry.origin_y + (rows + 0.5) * geometry.resolution,
            )
        )

    def on_odometry(self, at: float, x: float, y: float, theta: float) -> None:
        """Take the pose in `odom` (m, rad; theta not wrapped) that arrived at `at` (s)."""
        if self._history and at <= self._history[-1][0]:
            return
        self._history.append((at, x, y, theta))
        while self._history[0][0] < at - _HISTORY_S:
            self._history.popleft()

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Take a whole scan of the lidar: correct the pose when the robot moved, judge how well it fits."""
        self.sweep = self._deskewed(scan)
        if self.sweep is None or self._geometry is None:
            return
        if self._search is not None:
            self._continue_search(now)
            return
        if self._estimate is None:
            if self._status == "lost" and now >= self._search_again_at and self._standing():
                self.global_localization()
            return
        if self._settle is not None:
            self._settle_down(self.sweep)
        else:
            self._update(self.sweep)
        self._judge(now)

    def initial_pose(self, x: float, y: float, theta: float, sigma_xy: float = 0.5, sigma_theta: float = 0.35) -> None:
        """Start at a pose in `map` (m, rad) that someone gave; the next turn refines it within 3 sigma."""
        self._search = None
        self._start(Pose2(x, y, theta), sigma_xy, sigma_theta, "checking the given pose")
        self._checking = 0

    def restore(self, saved: SavedPose) -> None:
        """Start at a saved pose, less sure of it; if the next turns don't fit it, search everywhere."""
        self._search = None
        pose = Pose2(saved.x, saved.y, saved.theta)
        self._start(pose, max(0.3, 2.0 * saved.sigma_xy), max(0.2, 2.0 * saved.sigma_theta), "checking the saved pose")
        self._checking = 8

    def global_localization(self) -> bool:
        """Search the whole map, a share with each turn, while the robot stands; False: no map or no turn yet."""
        if self._geometry is None or self.sweep is None or not len(self._free) or len(self.sweep.points) < 10:
            return False
        spacing = 0.3
        keys = np.unique(np.floor(self._free / spacing).astype(np.int64), axis=0, return_index=True)[1]
        places = self._free[keys]
        headings = np.arange(36) * (2.0 * math.pi / 36)
        candidates = np.column_stack((np.repeat(places, len(headings), axis=0), np.tile(headings, len(places))))
        self._search = _Search(candidates, self._beams(self.sweep.points), self.sweep.odom)
        self._estimate = None
        self._detail = "searching the whole map"
        if self._status != "lost":
            self._status = "none"
        return True

    # --- what comes out ---

    @property
    def status(self) -> Localization:
        """How far the pose can be trusted."""
        return self._status

    @property
    def detail(self) -> str:
        """Why, in words; empty when good."""
        return self._detail

    @property
    def searching(self) -> bool:
        """Whether a global search is under way."""
        return self._search is not None

    @property
    def particles(self) -> int:
        """How many particles there are."""
        return int(self._x.size)

    def odom_at(self, at: float) -> Pose2 | None:
        """Pose in `odom` at a time (s), interpolated; extrapolated by at most 0.15 s. None before the first."""
        if not self._history:
            return None
        x, y, theta = self._odom_at(np.array([at]))
        return Pose2(float(x[0]), float(y[0]), float(theta[0]))

    def pose(self, at: float) -> Pose2 | None:
        """Pose in `map` at a time (s) not older than 3 s; None while nothing is known."""
        odom = self.odom_at(at)
        if self._estimate is None or odom is None:
            return None
        return self._estimate.then(odom.seen_from(self._anchor))

    def covariance(self) -> NDArray[np.float64]:
        """Covariance (3, 3) over (x, y, theta) in `map`, as of the last filter update."""
        return self._covariance

    def twist(self) -> tuple[float, float]:
        """Measured forward speed (m/s) and turning rate (rad/s) over the last 0.15 s or more; zeros without that.

        Readings that were held up arrive together: between them no time passes, so a stretch must not begin within
        such a bunch.
        """
        if len(self._history) < 2:
            return 0.0, 0.0
        at, x, y, theta = self._history[-1]
        earlier = (entry for entry in reversed(self._history) if entry[0] <= at - _TWIST_OVER_S)
        old = next(earlier, self._history[0])
        span = at - old[0]
        if span < _TWIST_LEAST_S:
            return 0.0, 0.0
        heading = 0.5 * (theta + old[3])
        forward = (x - old[1]) * math.cos(heading) + (y - old[2]) * math.sin(heading)
        return forward / span, (theta - old[3]) / span

    def points_in_map(self) -> NDArray[np.float64] | None:
        """Return the newest turn's points (n, 2) in m, frame `map`; None without pose or turn."""
        at = self.seen_from()
        return None if at is None or self.sweep is None else _transform(self.sweep.points, at)

    def seen_from(self) -> Pose2 | None:
        """Return where the robot was, frame `map`, when the newest turn ended; None without pose or turn."""
        if self.sweep is None or self._estimate is None:
            return None
        return self._estimate.then(self.sweep.odom.seen_from(self._anchor))

    def wall_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance (m, at most 1) of points (n, 2) in `map` to the nearest occupied cell of the map; 1 off it."""
        return self._look_up(points)

    def save(self, site: str, at: float) -> SavedPose | None:
        """Return what to store for a restart; None unless the pose is trusted."""
        pose = self.pose(at)
        if pose is None or self._status not in {"good", "weak"}:
            return None
        sigma_xy, sigma_theta = self._sigmas()
        return SavedPose(site=site, x=pose.x, y=pose.y, theta=pose.theta, sigma_xy=sigma_xy, sigma_theta=sigma_theta)

    def judge_fit(self, pose: Pose2, points: NDArray[np.float64]) -> Fit:
        """Compare points (n, 2; frame `base`) seen at a pose in `map` with what the static map would show there."""
        assert self._geometry is not None
        g = self._geometry
        seen = _transform(points, pose)
        near = self._look_up(seen) <= _NEAR_M
        offset_x, offset_y = seen[:, 0] - pose.x, seen[:, 1] - pose.y
        ranges = np.hypot(offset_x, offset_y)
        expected = cast(
            self._occupied,
            g.resolution,
            g.origin_x,
            g.origin_y,
            pose.x,
            pose.y,
            np.arctan2(offset_y, offset_x),
            self._config.range_max + 1.0,
        )
        agree = near & (np.abs(ranges - expected) < 3.0 * _SHALLOW_M)
        # Grazing beams end near a wall yet far from where the ray first meets one: they tell nothing.
        long = ~near & (ranges > expected + _SHALLOW_M)
        short = ~near & (ranges < expected - _SHALLOW_M)
        n_agree, n_long, n_short = int(agree.sum()), int(long.sum()), int(short.sum())
        told = n_agree + n_long
        return Fit(
            agree=n_agree / max(told + n_short, 1),
            explained=n_agree / max(len(points), 1),
            contradict=n_long / told if told else 1.0,
            informative=told,
        )

    # --- inside ---

    def _make_field(self, sigma: float) -> NDArray[np.float32]:
        assert self._geometry is not None
        c = self._config
        return likelihood_field(
            self._faces, self._geometry.resolution, sigma, c.field_reach, c.z_hit, c.z_rand, c.range_max
        )

    def _look_up(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        g = self._geometry
        out = np.ones(len(points))
        if g is None:
            return out
        columns = np.floor((points[:, 0] - g.origin_x) / g.resolution).astype(np.int64)
        rows = np.floor((points[:, 1] - g.origin_y) / g.resolution).astype(np.int64)
        inside = (columns >= 0) & (rows >= 0) & (columns < g.width) & (rows < g.height)
        out[inside] = self._wall_distance[rows[inside], columns[inside]]
        return out

    def _odom_at(
        self, times: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        known = np.array(self._history)
        x, y, theta = (np.interp(times, known[:, 0], known[:, i]) for i in (1, 2, 3))
        late = np.clip(times - known[-1, 0], 0.0, _EXTRAPOLATE_S)
        if late.any():
            v, w = self.twist()
            heading = known[-1, 3] + 0.5 * w * late
            x, y, theta = x + v * late * np.cos(heading), y + v * late * np.sin(heading), theta + w * late
        return x, y, theta

    def _deskewed(self, scan: LaserScan) -> Sweep | None:
        """Move each beam by the robot's motion between its own time and the turn's end."""
        if not self._history or self._history[0][0] > scan.ended_at:
            return None
        c = self._config
        ranges = np.asarray(scan.ranges_m, dtype=np.float64)
        valid = np.isfinite(ranges) & (ranges >= c.range_min) & (ranges <= c.range_max)
        count = len(ranges)
        times = scan.started_at + (scan.ended_at - scan.started_at) * np.arange(count) / max(count - 1, 1)
        directions = np.asarray(scan.angles_rad)[valid] + c.lidar_yaw
        base_x = c.lidar_x + ranges[valid] * np.cos(directions)
        base_y = c.lidar_y + ranges[valid] * np.sin(directions)
        x, y, theta = self._odom_at(times[valid])
        end = self.odom_at(scan.ended_at)
        assert end is not None
        odom_x = x + np.cos(theta) * base_x - np.sin(theta) * base_y - end.x
        odom_y = y + np.sin(theta) * base_x + np.cos(theta) * base_y - end.y
        cos, sin = math.cos(end.theta), math.sin(end.theta)
        points = np.column_stack((cos * odom_x + sin * odom_y, -sin * odom_x + cos * odom_y))
        return Sweep(points, end, scan.ended_at)

    def _beams(self, points: NDArray[np.float64], count: int | None = None) -> NDArray[np.float64]:
        wanted = count or self._config.beams
        if len(points) <= wanted:
            return points
        return points[np.linspace(0, len(points) - 1, wanted).astype(np.int64)]

    def _start(self, pose: Pose2, sigma_xy: float, sigma_theta: float, detail: str) -> None:
        odom = self.odom_at(self._history[-1][0]) if self._history else None
        self._anchor = odom or Pose2(0.0, 0.0, 0.0)
        self._estimate = pose
        self._covariance = np.diag([sigma_xy**2, sigma_xy**2, sigma_theta**2])
        self._settle = (sigma_xy, sigma_theta)
        self._verdicts.clear()
        self._doubted = 0
        self._proven = False
        self._slow = self._fast = 0.0
        self._status, self._detail = "none", detail
        self._spread(pose, sigma_xy, sigma_theta, self._config.particles_start)

    def _spread(self, pose: Pose2, sigma_xy: float, sigma_theta: float, count: int) -> None:
        self._x = (pose.x + sigma_xy * self._rng.standard_normal(count)).astype(np.float32)
        self._y = (pose.y + sigma_xy * self._rng.standard_normal(count)).astype(np.float32)
        self._theta = (pose.theta + sigma_theta * self._rng.standard_normal(count)).astype(np.float32)
        self._weights = np.full(count, 1.0 / count)

    def _score(
        self, poses: NDArray[np.float64], points: NDArray[np.float64], field: NDArray[np.float32]
    ) -> NDArray[np.float64]:
        assert self._geometry is not None
        g = self._geometry
        angles, ranges = np.arctan2(points[:, 1], points[:, 0]), np.hypot(points[:, 0], points[:, 1])
        return amcl.score_poses(
            poses[:, 0], poses[:, 1], poses[:, 2], field, g.resolution, g.origin_x, g.origin_y, angles, ranges
        )

    def _settle_down(self, sweep: Sweep) -> None:
        """Find the best pose within the stated doubt by search; weighing once would leave too few particles alive."""
        assert self._estimate is not None
        assert self._settle is not None
        pose = self._estimate.then(sweep.odom.seen_from(self._anchor))
        self._anchor = sweep.odom
        points = self._beams(sweep.points)
        if len(points) < 5:
            self._estimate = pose
            return
        sigma_xy, sigma_theta = self._settle
        for field in (self._coarse, self._field, self._field, self._field):
            count = 4000
            tried = np.array(pose) + self._rng.standard_normal((count, 3)) * (sigma_xy, sigma_xy, sigma_theta)
            tried[0] = pose
            pose = Pose2(*(float(v) for v in tried[int(np.argmax(self._score(tried, points, field)))]))
            sigma_xy, sigma_theta = 0.4 * sigma_xy, 0.4 * sigma_theta
        self._settle = None
        self._take(Pose2(pose.x, pose.y, wrap(pose.theta)), 0.08, 0.04)

    def _take(self, pose: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        self._estimate = pose
        self._covariance = np.diag([sigma_xy**2, sigma_xy**2, sigma_theta**2])
        self._spread(pose, sigma_xy, sigma_theta, self._config.particles_start)

    def _update(self, sweep: Sweep) -> None:
        assert self._geometry is not None
        c, g = self._config, self._geometry
        step = sweep.odom.seen_from(self._anchor)
        if math.hypot(step.x, step.y) < c.update_distance and abs(step.theta) < c.update_angle:
            return
        delta = amcl.odometry_delta(self._anchor, sweep.odom)
        amcl.motion_update(self._x, self._y, self._theta, *delta, c.alphas, self._state)
        self._anchor = sweep.odom
        points = self._beams(sweep.points)
        average = 0.0
        if len(points):
            poses = np.column_stack((self._x, self._y, self._theta)).astype(np.float64)
            scores = self._score(poses, points, self._field) / self._best_score
            average = float(self._weights @ scores)
            # AMCL's weight, 1 + sum of p^3, spans one order of magnitude at most and leaves the cloud three times as
            # wide as need be at this odometry noise. The exponent here is linear in the same sum.
            self._weights = self._weights * np.exp(c.sharpness * (scores - scores.max()))
            self._weights /= self._weights.sum()
        self._slow += (c.recovery_slow if self._slow else 1.0) * (average - self._slow)
        self._fast += (c.recovery_fast if self._fast else 1.0) * (average - self._fast)
        random_share = 0.0
        if self._status != "good" and self._slow > 0.0:
            # Unknown things lower the average too: guesses are scattered only while the map contradicts the pose.
            random_share = min(0.1, max(0.0, 1.0 - self._fast / self._slow))
        found = amcl.estimate(self._x, self._y, self._theta, self._weights)
        self._estimate = Pose2(found.x, found.y, found.theta)
        self._covariance = np.asarray(found.covariance)
        fresh = amcl.resample(
            self._x,
            self._y,
            self._theta,
            self._weights,
            c.particles_min,
            c.particles_max,
            c.kld_error,
            self._state,
            kld_z=c.kld_z,
            bin_xy=c.bin_xy,
            bin_theta=c.bin_theta,
            random_share=random_share,
            free_xy=self._free if random_share else None,
            jitter=g.resolution,
        )
        self._x, self._y, self._theta, self._weights = fresh

    def _sigmas(self) -> tuple[float, float]:
        return (
            math.sqrt(max(0.0, self._covariance[0, 0] + self._covariance[1, 1])),
            math.sqrt(max(0.0, self._covariance[2, 2])),
        )

    def _judge(self, now: float) -> None:
        assert self.sweep is not None
        assert self._estimate is not None
        pose = self._estimate.then(self.sweep.odom.seen_from(self._anchor))
        self.fit = fit = self.judge_fit(pose, self._beams(self.sweep.points, 120))
        sigma_xy, sigma_theta = self._sigmas()
        verdict, why = _verdict(fit, sigma_xy, sigma_theta)
        if verdict == "good" and not self._proven and fit.contradict > _DOUBT_AT_FIRST:
            verdict, why = "weak", f"{fit.contradict:.0%} of the beams look through walls of the map"
        self._doubted = self._doubted + 1 if fit.contradict > _DOUBT else 0
        if self._doubted >= _DOUBTED_TURNS:
            verdict = "lost"
        self._verdicts.append(verdict)
        recent = list(self._verdicts)
        # A single bad turn (somebody leans over the lidar) is no loss: five of the last nine are.
        if recent.count("lost") >= 5 or self._doubted >= _DOUBTED_TURNS:
            status: Localization = "lost"
        elif recent[-2:] == ["good", "good"]:
            status, why = "good", ""
            self._proven = True
        elif self._status in {"none", "lost"}:
            status = self._status
            why = why or self._detail
        elif recent[-3:].count("good") == 0 and len(recent) >= 3:
            status = "weak"
        else:
            status, why = self._status, self._detail
        if self._status == "none" and not self._checking and fit.contradict <= _DOUBT and recent[-4:] == ["weak"] * 4:
            status = "weak"
        self._status, self._detail = status, why
        if self._checking:
            self._checking -= 1
            if status == "good":
                self._checking = 0
            elif self._checking == 0 or status == "lost":
                self._checking = 0
                self.global_localization()
        elif status == "lost" and now >= self._search_again_at and self._standing():
            self._search_again_at = now + 10.0
            self.global_localization()

    def _standing(self) -> bool:
        v, w = self.twist()
        return abs(v) < 0.01 and abs(w) < 0.02

    def _continue_search(self, now: float) -> None:
        search = self._search
        assert search is not None
        if search.done < len(search.candidates):
            part = slice(search.done, search.done + _CHUNK)
            search.scores[part] = self._score(search.candidates[part], search.points, self._coarse)
            search.done += _CHUNK
            return
        self._search = None
        kept = np.argsort(-search.scores, kind="stable")[:400]
        poses = search.candidates[kept]
        step = np.array([0.15, 0.15, math.radians(5.0)])
        shifts = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.float64)
        scores = search.scores[kept]
        for field in (self._coarse, self._field, self._field, self._field):
            tried = (poses[:, None, :] + shifts[None, :, :] * step).reshape(-1, 3)
            table = self._score(tried, search.points, field).reshape(len(poses), -1)
            best = table.argmax(axis=1)
            poses = tried.reshape(len(poses), -1, 3)[np.arange(len(poses)), best]
            scores = table[np.arange(len(poses)), best]
            step *= 0.6
        self._conclude_search(poses, scores, search, now)

    def _conclude_search(
        self, poses: NDArray[np.float64], scores: NDArray[np.float64], search: _Search, now: float
    ) -> None:
        """Keep the best place unless another one, elsewhere, explains the scan nearly as well."""
        places: list[tuple[float, Pose2]] = []
        for index in np.argsort(-scores, kind="stable"):
            pose = Pose2(float(poses[index, 0]), float(poses[index, 1]), wrap(float(poses[index, 2])))
            if all(
                math.hypot(pose.x - other.x, pose.y - other.y) > 0.6 or abs(wrap(pose.theta - other.theta)) > 0.5
                for _, other in places
            ):
                places.append((float(scores[index]), pose))
            if len(places) == 8:
                break
        judged = [(score, pose, self.judge_fit(pose, search.points)) for score, pose in places]
        fitting = [entry for entry in judged if entry[2].contradict < 0.2 and entry[2].agree > 0.4]
        self._search_again_at = now + 10.0
        if not fitting:
            self._status, self._detail = "lost", "the lidar's view fits no place of the map: give the initial pose"
            self._estimate = None
            return
        value = [score * (1.0 - fit.contradict) * fit.explained for score, _, fit in fitting]
        order = sorted(range(len(fitting)), key=lambda i: -value[i])
        if len(order) > 1 and value[order[1]] > 0.85 * value[order[0]]:
            self._status = "lost"
            self._detail = "several places of the map look like this one: give the initial pose"
            self._estimate = None
            return
        self._anchor = search.odom
        self._verdicts.clear()
        self._doubted = 0
        self._proven = False
        self._slow = self._fast = 0.0
        self._settle = None
        self._take(fitting[order[0]][1], 0.1, 0.05)


def _eroded(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return 1 where a cell and its eight neighbours are all 1; beyond the border counts as 1."""
    padded = np.pad(cells, 1, constant_values=1)
    height, width = cells.shape
    out = np.ones_like(cells)
    for row in range(3):
        for column in range(3):
            out &= padded[row : row + height, column : column + width]
    return out


def _transform(points: NDArray[np.float64], pose: Pose2) -> NDArray[np.float64]:
    cos, sin = math.cos(pose.theta), math.sin(pose.theta)
    return np.column_stack(
        (pose.x + cos * points[:, 0] - sin * points[:, 1], pose.y + sin * points[:, 0] + cos * points[:, 1])
    )


def _verdict(fit: Fit, sigma_xy: float, sigma_theta: float) -> tuple[Localization, str]:
    # On maps and random poses, a right pose is contradicted by 0.1 at most, also in a crowd; a wrong one by 0.3 in the
    # median, and then few beams agree.
    contradicted = f"{fit.contradict:.0%} of the beams look through walls of the map"
    if fit.contradict > 0.45 or (fit.contradict > _DOUBT and fit.agree < 0.4):
        return "lost", contradicted
    if sigma_xy > 1.0:
        return "lost", f"the position is uncertain by {sigma_xy:.1f} m"
    if fit.contradict > _DOUBT:
        return "weak", contradicted
    if fit.informative < 8:
        return "weak", "too few beams reach a wall of the map"
    if sigma_xy > 0.35 or sigma_theta > 0.3:
        return "weak", f"the pose is uncertain by {sigma_xy:.2f} m and {sigma_theta:.2f} rad"
    return "good", ""
