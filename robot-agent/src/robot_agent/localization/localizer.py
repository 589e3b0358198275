"""The robot's localization: odometry and lidar scans in, the pose in `map` and its status out.

Frames: `odom` is the frame of the wheels' odometry since start, `map` is the site's, `base` the robot's centre. Between
corrections the pose follows the odometry, so it is smooth and never older than the last feedback.
Pure: times are arguments, randomness comes from the seed. The parts are modules of their own: `odometry_buffer`,
`deskew`, `map_fields`, `particle_filter`, `fit` (how a scan fits the map, and the status) and `global_search`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from robot_agent.config import LocalizationConfig
from robot_agent.localization.deskew import DeskewedScan, deskew
from robot_agent.localization.fit import FitMonitor, evaluate_fit
from robot_agent.localization.global_search import GlobalSearch
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.odometry_buffer import OdometryBuffer
from robot_agent.localization.particle_filter import ParticleFilter
from robot_agent.localization.pose import Pose2

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from robot_agent.hardware import LaserScan
    from robot_agent.safety.gate import Localization

_FIT_BEAMS: Final = 120
_SEARCH_POINTS_MIN: Final = 10
_SEARCH_EVERY_S: Final = 10.0
_TRIAL_SCANS: Final = 8
"""A saved pose must become good within so many scans."""
_FOUND_SIGMAS: Final = (0.1, 0.05)
"""Standard deviations (m, rad) of a pose that a global search found."""


class SavedPose(msgspec.Struct, frozen=True, kw_only=True):
    """A pose to restore after a restart, in `map` of a site (m, rad), with its standard deviations."""

    site: str
    x: float
    y: float
    theta: float
    sigma_xy: float
    sigma_theta: float


class Localizer:
    """Estimates one robot's pose from odometry and scans in order of time."""

    def __init__(self, config: LocalizationConfig | None = None, seed: int = 0) -> None:
        self._config = config or LocalizationConfig()
        self._odometry = OdometryBuffer()
        self._filter = ParticleFilter(self._config, seed)
        self._monitor = FitMonitor()
        self._fields: MapFields | None = None
        self._search: GlobalSearch | None = None
        self._search_again_at = -math.inf
        self.scan: DeskewedScan | None = None
        """The newest scan, without its skew."""

    # --- inputs ---

    def load_map(self, static: NDArray[np.uint8], geometry: GridGeometry) -> None:
        """Load the static map (h, w; 0 free, 254 occupied, 255 unknown); the pose is kept."""
        if self._fields is None or not self._fields.matches(static, geometry):
            self._fields = map_fields(static, geometry, self._config)

    def on_odometry(self, timestamp: float, x: float, y: float, theta: float) -> None:
        """Add the pose in `odom` (m, rad; theta not wrapped) that arrived at `timestamp` (s)."""
        self._odometry.add(timestamp, x, y, theta)

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Process a whole scan: correct the pose when the robot has moved, and evaluate the fit."""
        self.scan = deskew(scan, self._odometry, self._config)
        if self.scan is None or self._fields is None:
            return
        if self._search is not None:
            self._continue_search(self._search, self._fields, now)
        elif self._filter.has_pose:
            self._filter.add(self.scan, self._fields, recover=self._monitor.status != "good")
            self._evaluate(self.scan, self._fields, now)
        elif self._may_search(now):
            self.global_localization()

    def initial_pose(self, x: float, y: float, theta: float, sigma_xy: float = 0.5, sigma_theta: float = 0.35) -> None:
        """Start at a pose in `map` (m, rad) given by an operator; the next scan refines it within 3 sigma."""
        self._start(Pose2(x, y, theta), sigma_xy, sigma_theta)
        self._monitor.begin("checking the given pose")

    def restore(self, saved: SavedPose) -> None:
        """Start at a saved pose with larger deviations; if the next scans don't fit it, search the whole map."""
        pose = Pose2(saved.x, saved.y, saved.theta)
        self._start(pose, max(0.3, 2.0 * saved.sigma_xy), max(0.2, 2.0 * saved.sigma_theta))
        self._monitor.begin("checking the saved pose", _TRIAL_SCANS)

    def global_localization(self) -> bool:
        """Search the whole map, a share with each scan, at rest; False: no map or no scan yet."""
        scan, fields = self.scan, self._fields
        if fields is None or scan is None or not len(fields.free_places) or len(scan.points) < _SEARCH_POINTS_MIN:
            return False
        self._search = GlobalSearch(fields, scan.beams(self._config.beams), scan.odom, self._config.range_max)
        self._filter.forget()
        self._monitor.begin_search()
        return True

    # --- outputs ---

    @property
    def status(self) -> Localization:
        """Status of the pose."""
        return self._monitor.status

    @property
    def detail(self) -> str:
        """Reason of the status; empty when good."""
        return self._monitor.detail

    @property
    def searching(self) -> bool:
        """Whether a global search is in progress."""
        return self._search is not None

    @property
    def particles(self) -> int:
        """Number of particles."""
        return self._filter.size

    def odom_at(self, timestamp: float) -> Pose2 | None:
        """Pose in `odom` at a time (s), interpolated; extrapolated by at most 0.15 s. None before the first."""
        return self._odometry.pose(timestamp)

    def pose(self, timestamp: float) -> Pose2 | None:
        """Pose in `map` at a time (s) not older than 3 s; None while it is unknown."""
        odom = self._odometry.pose(timestamp)
        return None if odom is None else self._filter.pose(odom)

    def covariance(self) -> NDArray[np.float64]:
        """Covariance (3, 3) over (x, y, theta) in `map`, as of the last filter update."""
        return self._filter.covariance

    def twist(self) -> tuple[float, float]:
        """Measured forward speed (m/s) and turning rate (rad/s) over the last 0.15 s or more; zeros without that."""
        return self._odometry.twist()

    def points_in_map(self) -> NDArray[np.float64] | None:
        """Return the newest scan's points (n, 2) in m, frame `map`; None without pose or scan."""
        pose = self.scan_pose()
        return None if pose is None or self.scan is None else pose.transform(self.scan.points)

    def scan_pose(self) -> Pose2 | None:
        """Return where the robot was, frame `map`, when the newest scan ended; None without pose or scan."""
        return None if self.scan is None else self._filter.pose(self.scan.odom)

    def wall_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance (m, at most 1) of points (n, 2) in `map` to the nearest occupied cell of the map; 1 off it."""
        return np.ones(len(points)) if self._fields is None else self._fields.wall_distances(points)

    def save(self, site: str, timestamp: float) -> SavedPose | None:
        """Return the pose to store for a restart; None unless its status is good or weak."""
        pose = self.pose(timestamp)
        if pose is None or self.status not in {"good", "weak"}:
            return None
        sigma_xy, sigma_theta = self._filter.sigmas()
        return SavedPose(site=site, x=pose.x, y=pose.y, theta=pose.theta, sigma_xy=sigma_xy, sigma_theta=sigma_theta)

    # --- internals ---

    def _start(self, pose: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        self._search = None
        odom = self._odometry.latest() or Pose2(0.0, 0.0, 0.0)
        self._filter.start(pose, odom, sigma_xy, sigma_theta)

    def _evaluate(self, scan: DeskewedScan, fields: MapFields, now: float) -> None:
        """Evaluate how the scan fits at the corrected pose; search the whole map when the pose is lost."""
        pose = self._filter.pose(scan.odom)
        assert pose is not None
        fit = evaluate_fit(fields, pose, scan.beams(_FIT_BEAMS), self._config.range_max)
        self._monitor.add(fit, *self._filter.sigmas())
        if self._monitor.trial_failed:
            self.global_localization()
        elif self._may_search(now):
            self._search_again_at = now + _SEARCH_EVERY_S
            self.global_localization()

    def _may_search(self, now: float) -> bool:
        """Whether the pose is lost, the robot is at rest, and the last search is long enough ago."""
        v, w = self._odometry.twist()
        at_rest = abs(v) < 0.01 and abs(w) < 0.02
        return self._monitor.status == "lost" and now >= self._search_again_at and at_rest

    def _continue_search(self, search: GlobalSearch, fields: MapFields, now: float) -> None:
        result = search.advance(fields)
        if result is None:
            return
        self._search = None
        self._search_again_at = now + _SEARCH_EVERY_S
        if result.pose is None:
            self._monitor.lose(result.detail)
            return
        self._monitor.restart()
        self._filter.place(result.pose, search.odom, *_FOUND_SIGMAS)
