"""Global localization: candidate poses all over the map, scored coarse to fine.

Method: after Olson 2009, over the likelihood field. The work is split into shares, one with each scan, while the
robot is at rest.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from robot_agent.localization.fit import confirms, evaluate_fit
from robot_agent.localization.hypotheses import Hypotheses, Hypothesis, Near, apart, fits, quality
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.localization.map_fields import MapFields

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
