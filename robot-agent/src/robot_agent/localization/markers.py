"""Markers on the walls: what a sighting of one says of the robot's place, and which of them hang elsewhere by now.

A marker tells where the robot is by itself, also where two places look alike to the lidar. But anybody can move it, or
hang up another one of its pattern. So no single marker outweighs a pose that the scans support, unless they support the
place that it tells as well, and no marker has supported the pose since it was found. Pure.
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.messages import Reason, ReasonCode
from robot_agent.localization.fit import confirms, evaluate_fit
from robot_agent.localization.hypotheses import apart
from robot_agent.localization.pose import Pose2, wrap
from robot_agent.localization.scans import match_scan

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from fog_contracts.site import MarkerSite
    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.scans import DeskewedScan

    Confirmed = Callable[["Place"], Pose2 | None]

_HUNG_SIGMAS: Final = (0.05, 0.05, 0.03)
"""Standard deviations (m, m, rad) of a marker's place in the site's file: somebody has measured it with a tape."""
_WIDEST: Final = (1.0, 0.5)
"""A sighting that leaves the robot's place less certain than this (m, rad) is of no use."""
_GATE: Final = 11.345
"""Squared Mahalanobis distance (0.99 quantile, 3 degrees of freedom) up to which a sighting agrees with a pose."""
_APART: Final = (0.3, 0.25)
"""Nearer (m, rad) to the pose no sighting contradicts it: then the marker hangs a little beside its place."""
_NEAR: Final = (3.0, 0.5)
"""A marker that is off by less (m, rad) was rather moved than the robot carried so far without a sign of it."""
_SIGHTINGS: Final = 2
"""One picture may be misread: so many of them must tell of the same place before the robot takes it for its own."""
_REPORT_AFTER: Final = 3
_NEWS: Final = (0.2, 0.2)
"""A marker that contradicts a good pose from so many places, so far (m, rad) apart, hangs elsewhere."""
_FOUND_SIGMAS: Final = (0.2, 0.1)
"""Least standard deviations (m, rad) of a place that was found, which the next scan narrows."""
_MISFITS: Final = 5
"""A place that so many scans in a row do not confirm, while they confirm the pose, is not the robot's."""
_FOLLOWED_COVARIANCE: Final = np.diag(np.square((0.2, 0.2, 0.1)))
_CHECKED_BEAMS: Final = 120
_MATCHED_BEAMS: Final = 60
_STEPS: Final = (np.linspace(-2.0, 2.0, 9), np.linspace(-1.5, 1.5, 5), np.linspace(-1.5, 1.5, 3))
"""Places tried along the axes of a sighting's uncertainty, longest first, in standard deviations."""


class Sighting(NamedTuple):
    """A marker in a picture that was taken at `stamp` (s, on the clock of odometry and scans).

    pose: of the marker's centre in frame `base` (m), its theta (rad) where its face looks. covariance: (3, 3) over it.
    """

    marker: int
    pose: Pose2
    covariance: NDArray[np.float64]
    stamp: float


class Place(NamedTuple):
    """The robot's pose in `map` by a sighting, with its covariance (3, 3) over (x, y, theta)."""

    pose: Pose2
    covariance: NDArray[np.float64]


class Fused(NamedTuple):
    """A sighting agrees with the pose; the place to fuse with it, None if that tells nothing new."""

    place: Place | None


class Found(NamedTuple):
    """The robot is elsewhere than its pose says: where, at the newest scan, and how certain (m, rad)."""

    pose: Pose2
    sigmas: tuple[float, float]


def robot_place(marker: Pose2, sighting: Sighting) -> Place:
    """Return where the robot is that sees a marker, which hangs at a pose in `map`."""
    x, y, theta = sighting.pose
    heading = wrap(marker.theta - theta)
    cos, sin = math.cos(heading), math.sin(heading)
    dx, dy = cos * x - sin * y, sin * x + cos * y
    by_sighting = np.array([[-cos, sin, -dy], [-sin, -cos, dx], [0.0, 0.0, -1.0]])
    by_marker = np.array([[1.0, 0.0, dy], [0.0, 1.0, -dx], [0.0, 0.0, 1.0]])
    hung = by_marker @ np.diag(np.square(_HUNG_SIGMAS)) @ by_marker.T
    covariance = by_sighting @ sighting.covariance @ by_sighting.T + hung
    return Place(Pose2(marker.x - dx, marker.y - dy, heading), 0.5 * (covariance + covariance.T))


def agrees(place: Place, known: Place) -> bool:
    """Whether a place and the estimate of the pose at the same time are alike by their covariances."""
    offset = np.array((*np.subtract(place.pose[:2], known.pose[:2]), wrap(place.pose.theta - known.pose.theta)))
    return bool(offset @ np.linalg.solve(place.covariance + known.covariance, offset) <= _GATE)


def narrows(place: Place, known: Place) -> bool:
    """Whether a place is more certain in some direction than the estimate.

    Else it is left alone: sightings of one marker share the error of its place, and must not add up.
    """
    return bool(np.linalg.eigvals(np.linalg.solve(place.covariance, known.covariance)).real.max() > 1.0)


def place_by_scan(place: Place, odom: Pose2, scan: DeskewedScan, fields: MapFields, range_max: float) -> Pose2 | None:
    """Return the pose around a place that a scan confirms, at the scan's time; None if it confirms none.

    odom: what the odometry said at the place's time. range_max: the lidar's rated range (m).
    """
    step = scan.odom.relative_to(odom)
    values, vectors = np.linalg.eigh(place.covariance)
    axes = (vectors * np.sqrt(np.maximum(values, 0.0))).T[::-1]
    shifts = np.array([np.array(by) @ axes for by in itertools.product(*_STEPS)])
    around = [Pose2(*shifted).compose(step) for shifted in (np.array(place.pose) + shifts).tolist()]
    best = int(np.argmax(fields.agreements(np.array(around), scan.beams(_MATCHED_BEAMS), fields.coarse)))
    points = scan.beams(_CHECKED_BEAMS)
    pose = match_scan(fields, around[best], place.covariance, points).pose
    return pose if confirms(evaluate_fit(fields, pose, points, range_max)) else None


class _Rival(NamedTuple):
    """A place other than that of the pose, when the odometry said `odom`, and the markers that tell of it.

    markers: with where the pose says that each hangs. far: the robot was carried there, or a marker was moved to where
    it tells of a place that looks the same. misfits: scans in a row that confirm the pose, and not this place.
    """

    pose: Pose2
    odom: Pose2
    markers: dict[int, Pose2]
    sightings: int = 0
    far: bool = False
    misfits: int = 0


class Markers:
    """The markers of a site, and what their sightings have said of one another and of the pose."""

    def __init__(self, markers: Sequence[MarkerSite]) -> None:
        self._hung = {one.id: Pose2(one.x, one.y, one.theta) for one in markers}
        self._support: set[int] = set()
        """Markers that have agreed with the pose since it was found, and nobody can have carried the robot."""
        self._agreed: set[int] = set()
        """Those that ever agreed with a pose."""
        self._rival: _Rival | None = None
        self._against: dict[int, list[Pose2]] = {}
        """By marker, the odometry at its contradictions in a row."""
        self.problems: dict[int, Reason] = {}
        """By marker, why it is not believed any more."""

    def forget_support(self) -> None:
        """Take notice that the robot may have been carried, or that its pose is another one."""
        self._support.clear()

    @property
    def doubt(self) -> str:
        """Why the pose is not good though scans fit it; empty if no marker speaks against it."""
        rival = self._rival
        if rival is None or not rival.far or rival.sightings < _SIGHTINGS:
            return ""
        named = " and ".join(map(str, sorted(rival.markers)))
        return (
            f"marker {named} tells of another place that looks like this one: another marker or the way has to decide"
        )

    def weigh(
        self, sighting: Sighting, odom: Pose2, known: Place | None, confirmed: Confirmed, *, good: bool
    ) -> Fused | Found | None:
        """Return what a sighting, when the odometry said `odom`, changes; None for nothing.

        known: the estimate of the pose then, None while the robot does not know where it is; good: its status is good.
        confirmed: returns the pose around a place that the newest scan confirms, at the time of that scan.
        """
        place = self._place(sighting)
        if place is None:
            return None
        if known is not None and agrees(place, known):
            return Fused(place if narrows(place, known) else None) if self._agree(sighting.marker) else None
        if known is not None and _within(place.pose, known.pose, _APART):
            return None
        found = confirmed(place)
        far = known is None or not _within(place.pose, known.pose, _NEAR)
        if found is not None and self._moves(sighting, known, found, odom, far=far):
            sigmas = _sigma_xy(place), math.sqrt(place.covariance[2, 2])
            return Found(found, (max(sigmas[0], _FOUND_SIGMAS[0]), max(sigmas[1], _FOUND_SIGMAS[1])))
        if known is not None and good and (found is None or not far):
            self._contradict(sighting, known.pose, odom)
        return None

    def try_other_place(self, scan: DeskewedScan, fields: MapFields, range_max: float) -> None:
        """Let a scan that confirms the pose try the other place, of which a doubt tells; range_max: the lidar's (m).

        That place follows the odometry and the scans, as a hypothesis does.
        """
        rival = self._rival
        if rival is None or not self.doubt or _within(scan.odom, rival.odom, _NEWS):
            return
        points, followed = scan.beams(_CHECKED_BEAMS), rival.pose.compose(scan.odom.relative_to(rival.odom))
        pose = match_scan(fields, followed, _FOLLOWED_COVARIANCE, points).pose
        misfits = 0 if confirms(evaluate_fit(fields, pose, points, range_max)) else rival.misfits + 1
        self._rival = rival._replace(pose=pose, odom=scan.odom, misfits=misfits)
        if misfits >= _MISFITS:
            self._report_rival()

    def _place(self, sighting: Sighting) -> Place | None:
        """Return the robot's place by a sighting; None for an unknown marker, or one that is seen too badly."""
        hung = self._hung.get(sighting.marker)
        place = None if hung is None else robot_place(hung, sighting)
        if place is None or _sigma_xy(place) > _WIDEST[0] or place.covariance[2, 2] > _WIDEST[1] ** 2:
            return None
        return place

    def _agree(self, marker: int) -> bool:
        """Take notice of a sighting that agrees with the pose; return whether the marker is believed."""
        if marker not in self.problems and self.doubt:
            self._report_rival()
        if marker in self.problems:
            return False
        self._support.add(marker)
        self._agreed.add(marker)
        self._against.pop(marker, None)
        self._rival = None
        return True

    def _moves(self, sighting: Sighting, known: Place | None, found: Pose2, odom: Pose2, *, far: bool) -> bool:
        """Return whether the robot is where a marker says, which does not agree with its pose or knows it first.

        The other place is followed by the odometry of the pictures: that of the scans but for some centimetres.
        """
        rival = self._rival
        if rival is None or apart(rival.pose.compose(odom.relative_to(rival.odom)), found):
            rival = _Rival(found, odom, {})
        seen = (found if known is None else known.pose).compose(sighting.pose)
        markers = rival.markers | {sighting.marker: seen}
        needed = 2 if known is not None and (self._support or not far) else 1
        self._rival = rival = _Rival(found, odom, markers, rival.sightings + 1, far and needed > 1, rival.misfits)
        # One that was found to hang elsewhere counts only beside another one, which says that it hangs right after all.
        believed = markers.keys() if needed > 1 else markers.keys() - self.problems.keys()
        if rival.sightings < _SIGHTINGS or len(believed) < needed:
            return False
        for one in markers:
            self.problems.pop(one, None)
            self._against.pop(one, None)
        self._rival = None
        return True

    def _contradict(self, sighting: Sighting, pose: Pose2, odom: Pose2) -> None:
        """Take notice that a sighting contradicts a good pose, when the odometry said `odom`."""
        against = self._against.setdefault(sighting.marker, [])
        if not against or not _within(odom, against[-1], _NEWS):
            against.append(odom)
        if len(against) >= _REPORT_AFTER:
            self._report(sighting.marker, pose.compose(sighting.pose))

    def _report_rival(self) -> None:
        """Believe no more what tells of another place, which is none."""
        if self._rival is not None:
            for marker, seen in self._rival.markers.items():
                self._report(marker, seen)
        self._rival = None

    def _report(self, marker: int, seen: Pose2) -> None:
        """Believe a marker no more, which was seen at a place of the map where it does not hang."""
        if marker in self.problems:
            return
        hung = self._hung[marker]
        where = f"was seen at ({seen.x:.1f}, {seen.y:.1f})"
        twice = ", and at its own place before: there are two of it, or it was moved" if marker in self._agreed else ""
        self.problems[marker] = Reason(
            ReasonCode.MARKER_MISPLACED,
            f"marker {marker} {where}, not at ({hung.x:.1f}, {hung.y:.1f}) as the site says{twice}; it is ignored: "
            "hang it back, or correct site.toml, and restart the agent",
        )


def _sigma_xy(place: Place) -> float:
    return math.sqrt(float(np.linalg.eigvalsh(place.covariance[:2, :2])[-1]))


def _within(pose: Pose2, other: Pose2, limits: tuple[float, float]) -> bool:
    near = math.hypot(pose.x - other.x, pose.y - other.y) < limits[0]
    return near and abs(wrap(pose.theta - other.theta)) < limits[1]
