"""The robot's localization: odometry and lidar scans in, the pose in `map` and its status out.

Frames: `odom` is the frame of the wheels' odometry since start, `map` is the site's, `base` the robot's centre. Between
corrections the pose follows the odometry, so it is smooth and never older than the last feedback.
Pure: times are arguments, randomness comes from the seed. The parts are modules of their own: `odometry`, `scans`,
`map_fields`, `particle_filter`, `fit` (how a scan fits the map, and the status), and `relocalization` with `hypotheses`
for a robot that does not know where it is. What is left is long, so that all that may change the pose or its status is
read in one class.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from robot_agent.config import LocalizationConfig
from robot_agent.localization.fit import (
    NO_FIT,
    Doubt,
    FitMonitor,
    confirms,
    differs_by_doors,
    evaluate_fit,
    tells_place,
)
from robot_agent.localization.hypotheses import History, apart
from robot_agent.localization.map_fields import MapFields, map_fields
from robot_agent.localization.markers import Found, Fused, Markers, Place, place_by_scan
from robot_agent.localization.odometry import OdometryBuffer
from robot_agent.localization.particle_filter import ParticleFilter
from robot_agent.localization.pose import Pose2, SavedPose, wrap
from robot_agent.localization.relocalization import Relocalization
from robot_agent.localization.scans import DeskewedScan, deskew, follows
from robot_agent.localization.unobserved import OdometryScale

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from fog_kernels.scans import Track
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.hypotheses import Hypothesis
    from robot_agent.localization.markers import Sighting
    from robot_agent.localization.pose import AbsoluteObservation, Uncertainty
    from robot_agent.localization.relocalization import Outcome
    from robot_agent.safety.conditions import Localization

_FIT_BEAMS: Final = 120
_SAVED: Final = "checking the saved pose"
_TRIAL_SCANS: Final = 8
"""A saved pose must become good within so many scans."""
_NEW_MAP: Final = "the map is a new one: checking the pose on it"
_SAVED_SIGMAS: Final = (0.3, 0.2)
"""Least standard deviations (m, rad) of a saved pose."""
_FOUND_SIGMAS: Final = (0.2, 0.1)
"""Standard deviations (m, rad) of a place that a search found, which the next scan narrows."""
_LOCAL_SIGMAS: Final = (1.0, 0.5)
"""Standard deviations (m, rad) within which a lost robot is looked for first."""
_VERIFY_EVERY_S: Final = 5.0
"""Least time between two searches of the whole map that only confirm the pose, as while a door stands open."""
_TURNED_RAD: Final = 0.5
_SAVED_OR_FOUND: Final = (
    "the scan fits the saved pose but for a few beams, as beside an opened door, and another place better: let the "
    "robot advance (`fognav robot advance`), or give the initial pose"
)
_CHECKED_WITHIN_S: Final = 1.0
"""A scan that was made so much earlier or later checks no sighting: a resting robot may have been carried meanwhile."""
_LOCAL_SCANS: Final = 5
"""After this many scans that do not fit there either, the whole map is searched."""


class Localizer:
    """Estimates one robot's pose from odometry and scans in order of time."""

    def __init__(self, config: LocalizationConfig | None = None, seed: int = 0) -> None:
        self._config = config or LocalizationConfig()
        self._odometry = OdometryBuffer()
        self._scale = OdometryScale()
        self._filter = ParticleFilter(self._config, seed)
        self._monitor = FitMonitor()
        self._fields: MapFields | None = None
        self._relocalization = Relocalization(self._config)
        self.markers = Markers(self._config.markers)
        """What the markers on the walls have said."""
        self._local_scans = 0
        """Scans since a lost robot was looked for near its last pose; 0 while it is not lost."""
        self._doubt = Doubt()
        self._verify_again_at = -math.inf
        self._fit = NO_FIT
        """Of the newest scan at the pose."""
        self._history = History()
        self.scan: DeskewedScan | None = None
        """The newest scan, without its skew."""

    # --- inputs ---

    def fields_of(self, static: NDArray[np.uint8], geometry: GridGeometry) -> MapFields:
        """Return the fields of a static map (h, w; 0 free, 254 occupied, 255 unknown); the present ones if they fit.

        It takes some 0.4 s for 2000 x 1200 cells and changes nothing: it may run on any thread.
        """
        known = self._fields
        if known is not None and known.matches(static, geometry):
            return known
        return map_fields(static, geometry, self._config)

    def load_map(self, fields: MapFields) -> None:
        """Load a static map by its fields.

        After another map the pose is no more than a saved one: its frame may lie elsewhere in the building. If the next
        scans don't fit it, the whole map is searched.
        """
        if fields is self._fields:
            return
        changed, self._fields = self._fields is not None, fields
        self._relocalization.cancel()
        odom = self._odometry.latest()
        pose = None if odom is None else self._filter.pose(odom)
        if changed and pose is not None:
            self._start(pose, *_SAVED_SIGMAS)
            self._history.saved = True
            self._monitor.begin(_NEW_MAP, _TRIAL_SCANS)

    def on_odometry(self, timestamp: float, x: float, y: float, theta: float) -> None:
        """Add the pose in `odom` (m, rad; theta not wrapped) that arrived at `timestamp` (s)."""
        self._odometry.add(timestamp, *self._scale.calibrated(x, y, theta))

    def on_unmeasured_motion(self, distance: float, angle: float, detail: str) -> None:
        """Take notice that the robot may have moved this far (m, rad) without its odometry; `detail` says why.

        The pose is weak until scans prove it.
        """
        odom = self._odometry.latest()
        if odom is not None and self._filter.has_pose:
            self._filter.widen(odom, distance, angle)
            self.markers.forget_support()
            self._history.come(distance)
            self._scale.forget_anchor()
            self._history.tracked = False
            self._monitor.doubt(detail)

    def on_absolute_observation(self, observation: AbsoluteObservation) -> bool:
        """Fuse a pose that was measured without the scanner; False: there is no odometry from its time.

        One that contradicts the estimate replaces it. Scans decide whether the pose is good.
        """
        if not self._odometry.reaches_back_to(observation.stamp):
            return False
        odom = self._odometry.pose(observation.stamp)
        assert odom is not None
        self._relocalization.cancel()
        self._scale.forget_anchor()
        if not self._filter.observe(observation.pose, observation.covariance, odom):
            self._monitor.begin("checking the pose that was measured")
            self.markers.forget_support()
            self._doubt.restart()
            self._history.tracked = False
            self._history.near = None
        return True

    def on_sighting(self, sighting: Sighting, now: float) -> None:
        """Weigh what a marker says of the pose; one from before the odometry, or that no scan can check, is dropped."""
        scan, fields, odom = self.scan, self._fields, self._odometry.pose(sighting.stamp)
        if scan is None or fields is None or odom is None or not self._odometry.reaches_back_to(sighting.stamp):
            return
        if abs(sighting.stamp - scan.timestamp) > _CHECKED_WITHIN_S:
            return
        pose, good = self._filter.pose(odom), self.status == "good"
        known = None if pose is None or self.status not in {"good", "weak"} else Place(pose, self._filter.covariance)
        confirmed = partial(place_by_scan, odom=odom, scan=scan, fields=fields, range_max=self._config.range_max)
        word = self.markers.weigh(sighting, odom, known, confirmed, good=good)
        if isinstance(word, Fused):
            if word.place is not None:
                self._scale.forget_anchor()
                self._filter.observe(*word.place, odom)
            self._doubt.verify()
        elif isinstance(word, Found):
            self._relocalization.cancel()
            if known is not None:
                self._monitor.lose("a marker shows that the robot is elsewhere: it was carried, or its pose was wrong")
                self._monitor.restart()
            else:
                self._monitor.begin("a marker shows where the robot is: the next scans have to prove it")
            self._start_at_found(word.pose, scan.odom, now, word.sigmas)

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Process a whole scan: correct the pose when the robot has moved, and evaluate the fit."""
        before, self.scan = self.scan, deskew(scan, self._odometry, self._config)
        self._history.continuous = before is not None and self.scan is not None and follows(self.scan, before)
        if self.scan is None or self._fields is None:
            return
        if self._filter.has_pose:
            self._filter.add(self.scan, self._fields, self._scale.sigma)
            self._evaluate(self.scan, self._fields, now)
        if self._relocalization.active:
            shaken = self._monitor.shaken
            self._relocalization.on_scan(self.scan, self._fields, self._history.near, shaken=shaken)
            self._settle(self.scan, self._fields, now)
        elif not self._filter.has_pose and self._may_search(self.scan, now):
            self.global_localization()

    def initial_pose(self, x: float, y: float, theta: float, sigma_xy: float = 0.5, sigma_theta: float = 0.35) -> None:
        """Start at a pose in `map` (m, rad) given by an operator, with its standard deviations.

        The next scan narrows them in the directions that it observes.
        """
        self._start(Pose2(x, y, theta), sigma_xy, sigma_theta)
        self._history.tracked = True  # an operator's pose, too, says more than an opened door does
        self._monitor.begin("checking the given pose")

    def restore(self, saved: SavedPose) -> None:
        """Start at a saved pose with larger deviations; if the next scans don't fit it, search the whole map."""
        pose = Pose2(saved.x, saved.y, saved.theta)
        xy, theta = _SAVED_SIGMAS
        self._start(pose, max(xy, 2.0 * saved.sigma_xy), max(theta, 2.0 * saved.sigma_theta))
        self._history.saved = True
        self._monitor.begin(_SAVED, _TRIAL_SCANS)

    def follow_saved(self, saved: SavedPose) -> None:
        """Trust where a saved pose that no scan has tried yet has led like a pose that was followed, as it was."""
        if self._monitor.on_trial:
            self.restore(saved)
            self._history.tracked = True
            self._monitor.begin(_SAVED)

    def global_localization(self) -> bool:
        """Search the whole map, a share with each scan, keeping the estimate; False: no map or no scan yet."""
        if self._fields is None or self.scan is None:
            return False
        if not self._relocalization.begin(self.scan, self._fields, self._history.near):
            return False
        self._monitor.begin_search()
        return True

    def continue_search(self, now: float) -> None:
        """Do one more share of a search in progress, between scans."""
        if self._fields is None or self.scan is None or not self.searching:
            return
        self._relocalization.advance(self._fields)
        self._settle(self.scan, self._fields, now)

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
        return self._relocalization.searching

    @property
    def hypotheses(self) -> list[Hypothesis]:
        """Places between which the scans so far do not decide; empty outside of a relocalization."""
        return self._relocalization.places

    @property
    def particles(self) -> int:
        """Number of particles."""
        return self._filter.size

    def odom_at(self, timestamp: float) -> Pose2 | None:
        """Pose in `odom` at a time (s), interpolated; extrapolated by at most 0.15 s. None before the first."""
        return self._odometry.pose(timestamp)

    def latest_odom(self) -> Pose2 | None:
        """Pose in `odom` by the newest reading of the wheels, however old it is; None before the first."""
        return self._odometry.latest()

    def odom_track(self, since: float) -> Track:
        """Return where the robot was in `odom` from a time (s) on, as `odom_at` does; there must be a pose."""
        return self._odometry.track(since)

    def pose(self, timestamp: float) -> Pose2 | None:
        """Pose in `map` at a time (s) not older than 3 s; None while it is unknown."""
        odom = self._odometry.pose(timestamp)
        return None if odom is None else self._filter.pose(odom)

    def covariance(self) -> NDArray[np.float64]:
        """Covariance (3, 3) over (x, y, theta) in `map`, as of the last filter update."""
        return self._filter.covariance

    @property
    def uncertainty(self) -> Uncertainty:
        """Standard deviations of the pose along and across its least certain direction, as of the last update."""
        return self._filter.uncertainty

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
        spread = self._filter.uncertainty
        return SavedPose(
            site=site, x=pose.x, y=pose.y, theta=pose.theta, sigma_xy=spread.along, sigma_theta=spread.heading
        )

    # --- internals ---

    def _start(self, pose: Pose2, sigma_xy: float, sigma_theta: float) -> None:
        self._relocalization.cancel()
        self.markers.forget_support()
        self._local_scans = 0
        self._history.restart()
        self._doubt.restart()
        odom = self._odometry.latest() or Pose2(0.0, 0.0, 0.0)
        self._scale.forget_anchor()
        self._filter.start(pose, odom, sigma_xy, sigma_theta)

    def _evaluate(self, scan: DeskewedScan, fields: MapFields, now: float) -> None:
        """Evaluate how the scan fits at the corrected pose; look for the robot when the pose is lost."""
        pose = self._filter.pose(scan.odom)
        assert pose is not None
        fit = evaluate_fit(fields, pose, scan.beams(_FIT_BEAMS), self._config.range_max)
        self._fit = fit
        if self.markers.doubt and confirms(fit):
            self.markers.try_other_place(scan, fields, self._config.range_max)
        shaken = self._filter.jumped or self._monitor.shaken
        self._history.follow(scan.odom, self._monitor.status, shaken=shaken)
        rivalled = not self._history.tracked and len(self._relocalization.places) > 1
        self._doubt.add(fit, scan.odom, jumped=self._filter.jumped, rivalled=rivalled)
        self._monitor.add(
            fit, self._filter.uncertainty, doubt=self._doubt.reason or self.markers.doubt, kept=self._history.keeps(fit)
        )
        self._history.judge(pose, scan.odom, self._monitor.status)
        if self._history.contested and differs_by_doors(fit):
            self._monitor.lose(_SAVED_OR_FOUND)
            return
        if self._monitor.status == "lost":
            self._relocalization.verifies = False
            self._look_nearby(scan, now)
            return
        self._local_scans = 0
        if self._filter.jumped:
            self._scale.forget_anchor()
        elif self._monitor.status in {"good", "weak"} and tells_place(self._fit):
            self._scale.observe(pose, self._filter.covariance, scan.odom, self._filter.unseen)
        if self._monitor.trial_failed:
            self.global_localization()
        elif self._monitor.status in {"good", "weak"}:
            if not self._doubt.to_verify:
                self._relocalization.cancel()
            elif self._may_verify(now):
                self._relocalization.begin(scan, fields, self._history.near, verifies=True)

    def _look_nearby(self, scan: DeskewedScan, now: float) -> None:
        """Look for a lost robot near its last pose, since most slipped or were pushed; then on the whole map."""
        self._local_scans += 1
        if self._local_scans == 1:
            self._filter.widen(scan.odom, *_LOCAL_SIGMAS)
            self.markers.forget_support()
            self._scale.forget_anchor()
            self._monitor.restart()
            self._doubt.begin(scan.odom)
            self._history.tracked = False
        elif self._local_scans > _LOCAL_SCANS and not self._relocalization.active and self._may_search(scan, now):
            self.global_localization()

    def _may_verify(self, now: float) -> bool:
        """Whether the last search of the whole map for places that look like that of the pose is long enough ago."""
        ready = not self._relocalization.active and not self._monitor.shaken and now >= self._verify_again_at
        return ready and self._relocalization.may_begin(now)

    def _may_search(self, scan: DeskewedScan, now: float) -> bool:
        """Whether the pose is lost, and the last search is long enough ago or was made elsewhere."""
        return self._monitor.status == "lost" and self._relocalization.may_begin(now, scan.odom)

    def _settle(self, scan: DeskewedScan, fields: MapFields, now: float) -> None:
        """Start at the place that the relocalization has decided for, if it has."""
        outcome = self._relocalization.outcome(now)
        if outcome is None:
            return
        fits_again = self._doubt.to_verify and self._monitor.status == "weak"
        if outcome.pose is None:
            # The particles of a lost robot may slide to one of several places alike: that decides for none of them.
            if self._relocalization.active and fits_again and self._may_be_turned(outcome.odom):
                self._relocalization.verifies = False
            undecided = self._relocalization.active and not self._relocalization.verifies
            if undecided or not fits_again:
                self._monitor.lose(outcome.detail)
            return
        pose = self._filter.pose(outcome.odom)
        if pose is not None and self._keeps(pose, outcome, now, fits_again=fits_again):
            return
        weighed = pose is not None and any(not apart(pose, other) for other in outcome.beaten)
        if fits_again and confirms(self._fit) and self._history.near is not None and not weighed:
            # A door stood open, or people hid the walls, when the search left out the place that the scan confirms now.
            self._relocalization.begin(scan, fields, self._history.near, verifies=True)
            return
        if fits_again:
            self._monitor.lose("the robot was found elsewhere on the map: it was carried, or its pose was wrong")
            self._monitor.restart()
        else:
            self._monitor.begin_found()
        self._start_at_found(outcome.pose, outcome.odom, now)

    def _keeps(self, pose: Pose2, outcome: Outcome, now: float, *, fits_again: bool) -> bool:
        """Whether the pose is not given up for the place that was found."""
        assert outcome.pose is not None
        same = not apart(pose, outcome.pose)
        if self._history.saved and differs_by_doors(self._fit) and outcome.by_one_scan and not same:
            # A door was opened beside a robot that only started again; or somebody has carried it.
            self._history.contested = True
            self._relocalization.cancel()
            self._monitor.lose(_SAVED_OR_FOUND)
            return True
        if not fits_again:
            return False
        if same:
            self._doubt.verify()
        if same or self._history.keeps(self._fit):
            # Where a door was opened, a place without that door elsewhere explains every scan better than the
            # robot's own. Wheels that have counted all the way say more than that.
            self._relocalization.cancel()
            self._verify_again_at = now + _VERIFY_EVERY_S
            return True
        return False

    def _start_at_found(
        self, pose: Pose2, odom: Pose2, now: float, sigmas: tuple[float, float] = _FOUND_SIGMAS
    ) -> None:
        scan, fields = self.scan, self._fields
        assert scan is not None
        assert fields is not None
        self._doubt.restart()
        self.markers.forget_support()
        self._local_scans = 1
        self._history.restart_at_found()
        self._scale.forget_anchor()
        self._filter.start(pose, odom, *sigmas)
        self._filter.add(scan, fields)
        self._evaluate(scan, fields, now)

    def _may_be_turned(self, odom: Pose2) -> bool:
        """Whether a lost robot that fits again near its last pose fits there in another direction as well.

        Whoever turned it by hand did no more than one who pushed it. Far places that look alike are less likely: with
        those the robot drives on, slowly.
        """
        pose = None if self._history.keeps(self._fit) else self._filter.pose(odom)
        return pose is not None and any(
            place.near and abs(wrap(place.pose.theta - pose.theta)) > _TURNED_RAD
            for place in self._relocalization.places
        )
