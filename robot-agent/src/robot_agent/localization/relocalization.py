"""Finding a robot that does not know where it is: a search of the whole map, then the places that it left.

Method of the search: candidate poses all over the map, scored coarse to fine over the likelihood field, after Olson
2009. The work is split into shares, one with each scan, while the robot is at rest.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from robot_agent.localization.fit import confirms, evaluate_fit
from robot_agent.localization.hypotheses import Hypotheses, Hypothesis, Near, Rivals, apart, fits, quality
from robot_agent.localization.pose import (
    Pose2,  # a named tuple's fields are read at run time
    wrap,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import LocalizationConfig
    from robot_agent.localization.map_fields import MapFields
    from robot_agent.localization.scans import DeskewedScan

_CHUNK: Final = 40_000
"""Candidate poses scored with each scan: some 10 ms."""
_SPACING_M: Final = 0.3
_HEADINGS: Final = 36
_REFINED: Final = 400
"""Candidates that are refined."""
_PLACES: Final = 24
"""Places that are compared at the end."""
_REFINED_NEAR: Final = 60
_PLACES_NEAR: Final = 6
"""The same for those near the last good pose, which must not be missing: they are looked at besides."""


class GlobalSearch:
    """A search in progress for the pose at which the robot measured `points`."""

    def __init__(
        self,
        fields: MapFields,
        points: NDArray[np.float64],
        odom: Pose2,
        range_max: float,
        near: Near | None = None,
    ) -> None:
        """Begin; points (n, 2; m, frame `base`) were measured at `odom`; `range_max`: the lidar's rated range (m)."""
        spaced = _spaced(fields.free_places)
        headings = np.arange(_HEADINGS) * (2.0 * math.pi / _HEADINGS)
        self._candidates = np.column_stack((np.repeat(spaced, len(headings), axis=0), np.tile(headings, len(spaced))))
        self._scores = np.zeros(len(self._candidates))
        self._scored = 0
        self._points = points
        self._range_max = range_max
        self._near = near
        self.odom = odom
        """Pose in `odom` to which the result belongs."""

    def advance(self, fields: MapFields) -> Hypotheses | None:
        """Do one share of the work; return the places that explain the scan once all candidates are scored."""
        if self._scored < len(self._candidates):
            part = slice(self._scored, self._scored + _CHUNK)
            self._scores[part] = fields.scores(self._candidates[part], self._points, fields.coarse)
            self._scored += _CHUNK
            return None
        return self._conclude(fields, *self._refined(fields))

    def _refined(self, fields: MapFields) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the best candidates (n, 3), each moved to the best pose around it, and their scores."""
        kept = self._best(np.arange(len(self._scores)), _REFINED)
        if self._near is not None:
            x, y, radius = self._near
            near = np.flatnonzero(np.hypot(self._candidates[:, 0] - x, self._candidates[:, 1] - y) <= radius)
            kept = np.union1d(kept, self._best(near, _REFINED_NEAR))
        poses, scores = self._candidates[kept], self._scores[kept]
        step = np.array([0.15, 0.15, math.radians(5.0)])
        shifts = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.float64)
        for field in (fields.coarse, fields.fine, fields.fine, fields.fine):
            tried = (poses[:, None, :] + shifts[None, :, :] * step).reshape(-1, 3)
            table = fields.scores(tried, self._points, field).reshape(len(poses), -1)
            best = table.argmax(axis=1)
            poses = tried.reshape(len(poses), -1, 3)[np.arange(len(poses)), best]
            scores = table[np.arange(len(poses)), best]
            step *= 0.6
        return poses, scores

    def _best(self, numbers: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Return the numbers of the `count` best of some candidates."""
        if len(numbers) <= count:
            return numbers
        return np.asarray(numbers[np.argpartition(-self._scores[numbers], count)[:count]])

    def _conclude(self, fields: MapFields, poses: NDArray[np.float64], scores: NDArray[np.float64]) -> Hypotheses:
        """Return the places that explain the scan, with how well they do.

        One scan decides for no place that it does not confirm: where people hide the walls, a wrong place may explain
        it clearly better than the robot's own.
        """
        best = self._possible(fields, _places(poses, scores, _PLACES))
        complete = len(best) < _PLACES
        if self._near is not None:
            x, y, radius = self._near
            near = np.hypot(poses[:, 0] - x, poses[:, 1] - y) <= radius
            besides = self._possible(fields, _places(poses[near], scores[near], _PLACES_NEAR))
            best += [one for one in besides if one.near and all(apart(one.pose, other.pose) for other in best)]
        return Hypotheses(best, self.odom, complete=complete)

    def _possible(self, fields: MapFields, places: list[tuple[float, Pose2]]) -> list[Hypothesis]:
        """Return those of the places that are possible at all."""
        possible: list[Hypothesis] = []
        for score, pose in places:
            fit = evaluate_fit(fields, pose, self._points, self._range_max)
            if fits(fit):
                value, confirmed = quality(score / fields.best_likelihood, fit), confirms(fit)
                near = confirmed and self._near is not None and self._near.holds(pose)
                possible.append(Hypothesis(pose, math.log(max(value, 1e-3)), 0 if confirmed else 1, near))
        return possible


def _spaced(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the first of the places (n, 2) in each square of the search's spacing."""
    squares = np.floor((places - places.min(axis=0)) / _SPACING_M).astype(np.int64)
    numbers = squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]
    first = np.full(numbers.max() + 1, -1)
    first[numbers[::-1]] = np.arange(len(places))[::-1]
    return places[first[first >= 0]]


def _places(poses: NDArray[np.float64], scores: NDArray[np.float64], most: int) -> list[tuple[float, Pose2]]:
    """Return the best poses that lie apart, each with its score, best first, and at most so many."""
    places: list[tuple[float, Pose2]] = []
    for index in np.argsort(-scores, kind="stable"):
        pose = Pose2(float(poses[index, 0]), float(poses[index, 1]), wrap(float(poses[index, 2])))
        if all(apart(pose, other) for _, other in places):
            places.append((float(scores[index]), pose))
        if len(places) == most:
            break
    return places


_POINTS_MIN: Final = 10
_SCANS_MAX: Final = 12
"""Scans that are kept, to weigh by them what a second search finds."""
_SEARCH_EVERY_S: Final = 10.0
"""Least time between the end of a search without any place and the next one, ..."""
_SEARCH_EVERY_M: Final = 0.5
_SEARCH_EVERY_RAD: Final = 0.5
"""... unless the robot has moved this far since: somebody may stand in its view no more."""

_CHECKING: Final = "one place is left: the whole map is searched for others that fit as well"


class Outcome(NamedTuple):
    """The pose in `map` that was found, when the odometry said `odom`; or None, and why.

    beaten: near places that the scans confirm, and that explain them much worse all the same. by_one_scan: no other
    place was ever in question.
    """

    pose: Pose2 | None
    odom: Pose2
    detail: str = ""
    beaten: tuple[Pose2, ...] = ()
    by_one_scan: bool = False


class Relocalization:
    """A search of the whole map, and the hypotheses that later scans decide between."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._config = config
        self._search: GlobalSearch | None = None
        self._hypotheses: Hypotheses | None = None
        self._scans: deque[DeskewedScan] = deque(maxlen=_SCANS_MAX)
        """The scans by which the hypotheses are weighed."""
        self._rivals: Rivals | None = None
        self._confirmed = False
        """Whether what the hypotheses decided for was compared with what a further search found."""
        self._again_at = -math.inf
        self._failed_at: Pose2 | None = None
        """Odometry at which the last search ended without any place."""
        self.verifies = False
        """Whether this only looks for places like that of a pose that fits; else the robot is lost until it ends."""

    @property
    def active(self) -> bool:
        """Whether there is a search in progress, or places between which it did not decide."""
        return self._search is not None or self._hypotheses is not None

    @property
    def searching(self) -> bool:
        """Whether a search is in progress, or what it found is being compared."""
        return self._search is not None or self._rivals is not None

    @property
    def places(self) -> list[Hypothesis]:
        """The places between which the scans do not decide, best first."""
        return self._hypotheses.contenders if self._hypotheses is not None else []

    def may_begin(self, now: float, odom: Pose2 | None = None) -> bool:
        """Whether the last search without success is long enough ago, or the robot at `odom` has moved since."""
        if now >= self._again_at:
            return True
        if odom is None or self._failed_at is None:
            return False
        step = odom.relative_to(self._failed_at)
        return math.hypot(step.x, step.y) >= _SEARCH_EVERY_M or abs(step.theta) >= _SEARCH_EVERY_RAD

    def cancel(self) -> None:
        """End the search and forget all places."""
        self._search = self._hypotheses = self._rivals = None

    def begin(self, scan: DeskewedScan, fields: MapFields, near: Near | None = None, *, verifies: bool = False) -> bool:
        """Begin a search with a scan; False if the map has no free place, or the scan too few points.

        near: where the robot may have come to by itself, since its pose was good last.
        """
        if not len(fields.free_places) or len(scan.points) < _POINTS_MIN:
            return False
        self.cancel()
        self.verifies = verifies
        self._scans.clear()
        self._scans.append(scan)
        self._search_with(scan, fields, near)
        return True

    def advance(self, fields: MapFields) -> None:
        """Do one share of the search, or of the comparison of what it found."""
        if self._search is not None:
            found = self._search.advance(fields)
            if found is not None:
                self._search = None
                self._on_found(found)
        elif self._rivals is not None and self._hypotheses is not None:
            rivals = self._rivals.advance(fields)
            if rivals is not None:
                self._rivals = None
                self._join(self._hypotheses, rivals)

    def on_scan(self, scan: DeskewedScan, fields: MapFields, near: Near | None = None, *, shaken: bool = False) -> None:
        """Do one share of the search, and weigh the places by the scan; `near` as for a search that begins.

        shaken: whether the robot was moved otherwise than its wheels say.
        """
        hypotheses = self._hypotheses
        if self.searching:
            self.advance(fields)
        if hypotheses is None or self._rivals is not None:
            return
        if self._confirmed and hypotheses.decided is not None:
            # This share has confirmed a place, which the outcome tells now. Weighed by one scan more, it would have to
            # be confirmed anew, and a robot that moves on would be found only once it stands still.
            return
        if not hypotheses.add(scan, fields, self._config.range_max):
            return
        if not hypotheses.places or (shaken and hypotheses.best.misfits):
            # The places were followed by wheels that the robot did not follow.
            self.begin(scan, fields, near, verifies=self.verifies)
            return
        self._scans.append(scan)
        self._confirmed = False
        if self.searching or hypotheses.best.misfits:
            return
        if hypotheses.decided is not None or not hypotheses.complete:
            self._search_with(scan, fields)

    def _search_with(self, scan: DeskewedScan, fields: MapFields, near: Near | None = None) -> None:
        self._search = GlobalSearch(fields, scan.beams(self._config.beams), scan.odom, self._config.range_max, near)

    def _on_found(self, found: Hypotheses) -> None:
        known = self._hypotheses
        if known is None:
            self._hypotheses, self._confirmed = found, True
        elif known.places and any(scan.odom == found.odom for scan in self._scans):
            known.complete |= found.complete
            self._rivals = Rivals(known.best, found, self._scans, self._config.range_max)

    def _join(self, known: Hypotheses, rivals: list[Hypothesis]) -> None:
        """Add what a further search found. One that has decided is to be confirmed by the next, with another scan."""
        before = known.decided
        known.join(rivals)
        after = known.decided
        self._confirmed = before is not None and after is not None and not apart(before, after)

    def outcome(self, now: float) -> Outcome | None:
        """Return what is known now; None while the first search is in progress or nothing was searched."""
        hypotheses = self._hypotheses
        if hypotheses is None:
            return None
        if not hypotheses.places:
            self._again_at, self._failed_at = now + _SEARCH_EVERY_S, hypotheses.odom
            self.cancel()
            return Outcome(None, hypotheses.odom, "the scan fits no place of the map: give the initial pose")
        found = hypotheses.decided
        if found is None:
            return Outcome(None, hypotheses.odom, _undecided(len(hypotheses.contenders)))
        if not self._confirmed:
            return Outcome(None, hypotheses.odom, _CHECKING if self.searching else _undecided(1))
        self.cancel()
        beaten = tuple(place.pose for place in hypotheses.places if place.near)
        return Outcome(found, hypotheses.odom, beaten=beaten, by_one_scan=hypotheses.scans == 1)


def _undecided(contenders: int) -> str:
    """Return why the scans do not decide; a single place has just been found, or been contradicted by one."""
    alike = f"{contenders} places of the map look like this one"
    why = alike if contenders > 1 else "the last scan does not confirm the only place of the map that is left"
    return f"{why}: let the robot turn or advance (`fognav robot turn`), or give the initial pose"
