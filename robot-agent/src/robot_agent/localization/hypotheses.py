"""Places where the robot may be, kept from scan to scan until one of them explains the scans clearly best.

A search compares candidates on a raster by one scan, and keeps the best two dozen places. Where more look alike, the
robot's own may be missing, and what later scans leave over is a wrong one. So the map is searched again with a later
scan, and what is found there (`Rivals`) is weighed by all scans that counted, from that one to the newest and back to
the first.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from robot_agent.localization.fit import Fit, confirms, evaluate_fit, shows_place, tells_place
from robot_agent.localization.pose import Pose2, wrap
from robot_agent.localization.scans import information_of, matched_pose

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.scans import DeskewedScan
    from robot_agent.safety.conditions import Localization

_AMBIGUOUS: Final = 0.85
"""A second place that explains the scans this well, as a share of the best, leaves the search ambiguous."""
AMBIGUOUS_LATER: Final = 0.6
"""The same after more than one scan, for the product over all scans."""
_CARRIED: Final = math.log(0.03)
"""A robot was carried only if another place explains the scans so much better than any that it came to by itself."""
_HOPELESS: Final = math.log(1e-3)
"""A place that explains the scans so much worse than the best one is dropped."""
_APART_M: Final = 0.6
_APART_RAD: Final = 0.5
_MISFITS_MAX: Final = 2
"""A place that so many scans in a row contradict is dropped."""
_NEWS_M: Final = 0.2
_NEWS_RAD: Final = 0.2
"""Scans count as independent when the robot has moved this far between them."""
_PLACES_MAX: Final = 48
_MATCHED: Final = information_of(np.diag(np.square((0.2, 0.2, 0.1))))
_BEAMS: Final = 180
_FOLLOWED_M: Final = 2.0
"""A pose that was good for so long a way is kept against places that explain the scans better, while each scan shows
what the one before it did: nobody carried the robot, opened doors are more likely than such a way to a wrong place."""
_NEAR_M: Final = 2.5
"""So far from where its pose was good last a robot may be that was pushed or turned, or whose wheel was held."""


class Near(NamedTuple):
    """Where the pose was good last, in `map`, and how far the robot may have come since (m)."""

    x: float
    y: float
    radius: float

    def holds(self, pose: Pose2) -> bool:
        """Whether the robot may have come to a pose, as it does that slips, or is pushed or turned."""
        return math.hypot(pose.x - self.x, pose.y - self.y) <= self.radius


class History:
    """How the pose was come by: what says more of it than the newest scan does, or less."""

    def __init__(self) -> None:
        self.tracked = False
        """Whether the pose was good once, or was given, and was followed by wheels and scans since."""
        self.saved = False
        """Whether the pose is a saved one that was not good yet, ..."""
        self.contested = False
        """... and whether a search has found a better place."""
        self.continuous = False
        """Whether the newest scan shows what the one before it did."""
        self.followed_m = 0.0
        """How far the robot has driven with a good pose, while each scan showed what the one before it did."""
        self.near: Near | None = None
        """Where the robot may have come to by itself since its pose was good; None before that."""
        self._last_odom: Pose2 | None = None

    def restart(self) -> None:
        """Forget the pose before this one, which was given, or saved."""
        self.saved = self.contested = False
        self.restart_at_found()

    def restart_at_found(self) -> None:
        """Forget the pose before this one, which a search has found."""
        self.tracked = False
        self.followed_m = 0.0
        self.near = None

    def follow(self, odom: Pose2, status: Localization, *, shaken: bool) -> None:
        """Follow the pose to the newest scan, with the status before it; `shaken`: it is not the same pose any more."""
        good = status == "good"
        self.tracked = not shaken and (self.tracked or good)
        if not self.tracked or not self.continuous:
            self.followed_m = 0.0
        elif good:
            self.followed_m += self._way(odom)

    def judge(self, pose: Pose2, odom: Pose2, status: Localization) -> None:
        """Take note of what the newest scan, which ended at `odom`, makes of the pose."""
        if status == "good":
            self.near = Near(pose.x, pose.y, _NEAR_M)
            self.saved = self.contested = False
        else:
            self.come(self._way(odom))
        self._last_odom = odom

    def come(self, distance: float) -> None:
        """Take note that the robot may have come so far (m) by itself."""
        if self.near is not None:
            self.near = self.near._replace(radius=self.near.radius + distance)

    def keeps(self, fit: Fit) -> bool:
        """Whether the way from a good pose to this one says more than a place that explains the scans better."""
        return self.tracked and (tells_place(fit) or (shows_place(fit) and self.followed_m > _FOLLOWED_M))

    def _way(self, odom: Pose2) -> float:
        if self._last_odom is None:
            return 0.0
        step = odom.relative_to(self._last_odom)
        return math.hypot(step.x, step.y)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A pose in `map`, the product (as logarithm) of how well it explains the scans, and the misfits in a row.

    near: the robot may have come there from where its pose was good last, and the scans confirm it; to all other
    places somebody has carried it. unconfirmed: number of the last scans in a row that do not confirm a near place.
    """

    pose: Pose2
    log_quality: float
    misfits: int = 0
    near: bool = False
    unconfirmed: int = 0


def quality(score: float, fit: Fit) -> float:
    """Return how well a place explains a scan, from the beams' mean likelihood and the fit."""
    return score * (1.0 - fit.contradict) * fit.explained


def fits(fit: Fit) -> bool:
    """Whether a place is possible at all, by how a scan fits there."""
    return fit.contradict < 0.2 and fit.agree > 0.4


def apart(pose: Pose2, other: Pose2) -> bool:
    """Whether two poses are different places, as opposed to two estimates of one."""
    far = math.hypot(pose.x - other.x, pose.y - other.y) > _APART_M
    return far or abs(wrap(pose.theta - other.theta)) > _APART_RAD


def weighed(place: Hypothesis, pose: Pose2, scan: DeskewedScan, fields: MapFields, range_max: float) -> Hypothesis:
    """Return a place weighed by one scan more, at which the robot was at about `pose`; it is matched to the scan."""
    points = scan.beams(_BEAMS)
    matched = matched_pose(fields, pose, _MATCHED, points)
    fit = evaluate_fit(fields, matched, points, range_max)
    score = float(fields.agreements(np.array([matched]), points, fields.fine)[0])
    log_quality = place.log_quality + math.log(max(quality(score, fit), 1e-3))
    misfits = 0 if fits(fit) else place.misfits + 1
    unconfirmed = 0 if confirms(fit) else place.unconfirmed + 1
    return Hypothesis(matched, log_quality, misfits, place.near and unconfirmed < _MISFITS_MAX, unconfirmed)


class Hypotheses:
    """The places that are left, each tied to the odometry of the last scan that counted."""

    def __init__(self, places: Iterable[Hypothesis], odom: Pose2, *, complete: bool = True) -> None:
        """`complete`: whether no place that fits was left out because there are too many."""
        self.complete = complete
        self._places = sorted(places, key=lambda place: -place.log_quality)
        self.scans = 1
        """Number of scans that counted."""
        self.odom = odom
        """Pose in `odom` to which the poses belong."""

    @property
    def best(self) -> Hypothesis:
        """The best place; there must be one."""
        return self._places[0]

    @property
    def places(self) -> list[Hypothesis]:
        """The places, best first."""
        return list(self._places)

    @property
    def contenders(self) -> list[Hypothesis]:
        """The best place, and those that explain the scans nearly as well; best first.

        And the best of the near ones, with those nearly as good as that, until they explain the scans much worse: a
        robot slips more often than it is carried to a place that looks alike, and things that the map lacks spoil the
        fit of its own place.
        """
        if not self._places:
            return []
        limit = math.log(_AMBIGUOUS if self.scans == 1 else AMBIGUOUS_LATER)
        best = self._places[0].log_quality
        near = max((place.log_quality for place in self._places if place.near), default=-math.inf)
        least = best if near <= best + _CARRIED else near
        return [place for place in self._places if place.log_quality > (least if place.near else best) + limit]

    @property
    def decided(self) -> Pose2 | None:
        """The pose of the best place, if no other explains the scans nearly as well."""
        contenders = self.contenders
        return contenders[0].pose if len(contenders) == 1 and contenders[0].misfits == 0 else None

    def add(self, scan: DeskewedScan, fields: MapFields, range_max: float) -> bool:
        """Weigh the places by a scan; False: it does not count, since the robot has not moved since the last one."""
        step = scan.odom.relative_to(self.odom)
        if math.hypot(step.x, step.y) < _NEWS_M and abs(step.theta) < _NEWS_RAD:
            return False
        moved = (weighed(place, place.pose.compose(step), scan, fields, range_max) for place in self._places)
        left: list[Hypothesis] = []
        for place in sorted(moved, key=lambda one: -one.log_quality):
            possible = place.misfits < _MISFITS_MAX and self._is_possible(place, left)
            if possible and all(apart(place.pose, other.pose) for other in left):
                left.append(place)
        self._places, self.odom = left, scan.odom
        self.scans += 1
        return True

    def join(self, places: Iterable[Hypothesis]) -> None:
        """Add places, weighed by the same scans, that belong to the odometry of the last one."""
        new = [place for place in places if all(apart(place.pose, known.pose) for known in self._places)]
        self._places = sorted((*self._places, *new), key=lambda place: -place.log_quality)[:_PLACES_MAX]

    @staticmethod
    def _is_possible(place: Hypothesis, better: list[Hypothesis]) -> bool:
        return not better or place.log_quality > better[0].log_quality + _HOPELESS


_SHARE: Final = 8
"""Places weighed in one share of the work: some 5 ms."""


class Rivals:
    """A comparison in progress of the best place with those that a further search has found."""

    def __init__(self, best: Hypothesis, found: Hypotheses, scans: Sequence[DeskewedScan], range_max: float) -> None:
        """Begin; the scans come in order of time, one of them is what was searched with; range_max: as for a fit.

        The best place belongs to the newest scan.
        """
        self._best = best
        self._open = found.places
        self._scans = list(scans)
        self._searched = next(number for number, scan in enumerate(scans) if scan.odom == found.odom)
        self._range_max = range_max
        self._quality: float | None = None
        """Logarithm of how well the best place explains the scans."""
        self._rivals: list[Hypothesis] = []

    def advance(self, fields: MapFields) -> list[Hypothesis] | None:
        """Do one share of the work; return the places that explain the scans nearly as well, once all are weighed."""
        if self._quality is None:
            self._quality = self._explained(self._best, len(self._scans) - 1, -math.inf, fields).log_quality
        # No scan makes a place better: one that is too bad by some of the scans need not be weighed by the others.
        least = self._quality + math.log(AMBIGUOUS_LATER)
        for place in self._open[:_SHARE]:
            rival = self._explained(place, self._searched, least, fields)
            if rival.log_quality >= least and apart(rival.pose, self._best.pose):
                relative = self._best.log_quality + rival.log_quality - self._quality
                self._rivals.append(Hypothesis(rival.pose, relative))
        self._open = self._open[_SHARE:]
        return None if self._open else self._rivals

    def _explained(self, place: Hypothesis, number: int, least: float, fields: MapFields) -> Hypothesis:
        """Return a place that belongs to a scan at the newest one, weighed by all or until it is worse than `least`."""
        first = weighed(Hypothesis(place.pose, 0.0), place.pose, self._scans[number], fields, self._range_max)
        newest = self._followed(first, self._scans[number:], least, fields)
        back = Hypothesis(first.pose, newest.log_quality)
        oldest = self._followed(back, self._scans[number::-1], least, fields)
        return Hypothesis(newest.pose, oldest.log_quality)

    def _followed(
        self, place: Hypothesis, scans: Sequence[DeskewedScan], least: float, fields: MapFields
    ) -> Hypothesis:
        """Return a place that belongs to the first scan at the last one, weighed by those that follow the first."""
        for before, scan in itertools.pairwise(scans):
            if place.log_quality < least:
                break
            pose = place.pose.compose(scan.odom.relative_to(before.odom))
            place = weighed(place, pose, scan, fields, self._range_max)
        return place
