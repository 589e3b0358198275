"""Loops: places to which the robot has come again, found by matching a stretch of its way to an earlier one.

A wrong loop is worse than none. A stretch is looked for no farther away than the way between may be wrong by now; it
must fit well, and where a second place fits nearly as well, none counts: along a corridor without features two places
look the same, and a fold would be drawn. What is certain is closed first, which makes the rest more certain.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.matching import Excluded
from fog_mapping.pose_graph import Certainty
from fog_mapping.poses import Edge, between, path_lengths
from fog_mapping.scans import cloud, reference_of, thinned
from fog_mapping.trajectory import GATES, independent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from fog_kernels.matching import Reference
    from fog_mapping.scans import Scan

_PLACE_EVERY_M: Final = 5.0
_PLACE_HALF_M: Final = 5.0
_MOST_AROUND_M: Final = 9.5
"""How much of the way to either side of a place counts at most where a stretch is looked for far from it."""
_STRETCH_EVERY_M: Final = 2.5
_STRETCH_HALF_M: Final = 2.5
_LEAST_SCANS: Final = 3
_LEAST_WAY_M: Final = 12.0
"""Two stretches of the way must be so far apart along it to be a loop, between their middles: no scan is in both."""
_NEAR_M: Final = 3.0
_SIGMAS: Final = 3.0
_LEAST_M: Final = 0.5
_LEAST_SIGMA_M: Final = 0.03
"""What a place and a stretch show is not known better than that."""
_LEAST_RAD: Final = math.radians(5.0)
_MOST_RAD: Final = math.radians(40.0)
_TURN_STEP: Final = math.radians(1.0)
_THIN_M: Final = 0.15
_LEAST_SCORE: Final = 0.5
_LEAST_SHARE: Final = 0.75
_MOST_RESIDUAL_M: Final = 0.05
_ALIKE: Final = 0.85
"""A second place whose score is so near to the best one's fits nearly as well."""
_SAME_M: Final = 0.6
_SAME_RAD: Final = math.radians(12.0)
_EXPLAINED: Final = 200.0
"""The second place is the same one if the best one's own uncertainty explains it, in squared deviations."""
_REPEATED: Final = 0.7
_MOST_TRIED: Final = 8
"""So many stretches, the nearest ones, are looked for at a place in a round: a robot that drives its rounds for hours
comes to each place again and again, and each time joined to each other would take the square of the time."""
_PLACES_AT_ONCE: Final = 64
_COUNTS: Final = 0.5
"""A loop that counts less than this contradicts the rest."""
_KEPT: Final = 0.3
"""A loop that counts less than this says nothing about what is certain."""
_FLOOR: Final = 1e-3


class Stretch(NamedTuple):
    """Scans `first` to `last` around the one in the `middle`, whose frame they are seen in."""

    middle: int
    first: int
    last: int


class Loop(NamedTuple):
    """Scan `second` was found at the place around scan `first`; score and share of points are 0 to 1, the rms in m."""

    first: int
    second: int
    score: float
    share: float
    residual: float


class LoopGroup(NamedTuple):
    """Loops whose ends are near each other along the way: one for people. The best one's scans, score and rms (m).

    name: the numbers of its scans in the log; pairs: how many matches it has; kept: whether most of them count.
    """

    name: str
    first: int
    second: int
    pairs: int
    kept: bool
    score: float
    residual: float


def grouped(loops: Sequence[tuple[Loop, float]], poses: NDArray[np.float64], numbers: Sequence[int]) -> list[LoopGroup]:
    """Return the groups of loops with their weights, in the order of the way; `numbers`: of the scans in the log."""
    way = path_lengths(poses)
    groups: list[list[tuple[Loop, float]]] = []
    for loop, weight in sorted(loops, key=lambda each: _ends(each[0])):
        at = way[list(_ends(loop))]
        for group in groups:
            if all(abs(at - way[list(_ends(group[-1][0]))]) < _LEAST_WAY_M):
                group.append((loop, weight))
                break
        else:
            groups.append([(loop, weight)])
    found = []
    for group in groups:
        best = max(group, key=lambda each: each[0].score)[0]
        first, second = _ends(best)
        counting = sum(weight >= _COUNTS for _, weight in group)
        found.append(
            LoopGroup(
                f"{numbers[first]}-{numbers[second]}", first, second, len(group), 2 * counting >= len(group),
                best.score, best.residual,
            )
        )  # fmt: skip
    return found


def _ends(loop: Loop) -> tuple[int, int]:
    return min(loop.first, loop.second), max(loop.first, loop.second)


class Searched(NamedTuple):
    """What is found by now: edges with the loops that they are, and how many pairs fit several places.

    changed: whether this round has found or given up any.
    """

    edges: list[Edge]
    loops: list[Loop]
    ambiguous: int
    changed: bool


class _Match(NamedTuple):
    """What a place and a stretch have shown: a loop, or none, as the stretch fits nowhere or at `several` places."""

    found: tuple[Edge, Loop] | None
    several: bool = False


class LoopSearch:
    """Looks for loops, round by round, as the trajectory gets better."""

    def __init__(
        self, scans: Sequence[Scan], poses: NDArray[np.float64], without: Sequence[tuple[int, int]], jobs: int
    ) -> None:
        """`without`: pairs of scans (by their place in `scans`) that are no loop, nor are those near them."""
        self._scans = scans
        self._way = path_lengths(poses)
        self._places = list(_stretches(self._way, _PLACE_EVERY_M, _PLACE_HALF_M))
        self._queries = list(_stretches(self._way, _STRETCH_EVERY_M, _STRETCH_HALF_M))
        self._ends = np.array(self._queries, np.int64).reshape(-1, 3)
        self._joints = np.unique([0, len(scans) - 1, *(one.middle for one in (*self._places, *self._queries))])
        self._without = [(self._way[first], self._way[second]) for first, second in without]
        self._tried: dict[tuple[int, int], float] = {}
        self._found: dict[tuple[int, int], _Match] = {}
        self._jobs = jobs

    def search(
        self,
        poses: NDArray[np.float64],
        edges: Sequence[Edge],
        weights: NDArray[np.float64],
        most: float,
        on_progress: Callable[[float], object] = lambda _: None,
    ) -> Searched:
        """Look for what may be a loop and is certain to `most` (m); the same for the same arguments."""
        counted = [k for k, edge in enumerate(edges) if not edge.loop or weights[k] >= _KEPT]
        certainty = Certainty(poses, self._joints, [edges[k] for k in counted], weights[counted])
        joints = np.searchsorted(self._joints, [place.middle for place in self._places])
        changed = False
        with ThreadPoolExecutor(self._jobs) as pool:
            for start in range(0, len(self._places), _PLACES_AT_ONCE):
                seen = certainty.seen_from(joints[start : start + _PLACES_AT_ONCE])
                some = range(start, start + len(seen))
                places = pool.map(partial(self._search_place, poses, most), some, seen)
                for number, found in zip(some, places, strict=True):
                    for index, match in found.items():
                        # What was found when less was certain may have been something else that looks like it.
                        before = self._found.get((number, index), _Match(None))
                        changed |= (match.found or before.found) is not None
                        self._found[number, index] = match
                    on_progress((number + 1) / len(self._places))
        kept = [match.found for match in self._found.values() if match.found is not None]
        ambiguous = sum(match.several for match in self._found.values())
        return Searched([edge for edge, _ in kept], [loop for _, loop in kept], ambiguous, changed)

    def _search_place(
        self, poses: NDArray[np.float64], most: float, number: int, seen: NDArray[np.float64]
    ) -> dict[int, _Match]:
        """Return what each stretch that was looked for at a place has shown."""
        place = self._places[number]
        wanted = list(itertools.islice(self._candidates(number, poses, seen, most), _MOST_TRIED))
        if not wanted:
            return {}
        # Wherever a stretch is looked for, all of it must have something to be like. Else, of a row of equal doors,
        # that in the middle of the place would win against the right one at its end.
        reach = min(_MOST_AROUND_M, _PLACE_HALF_M + max(max(half) for _, half, _ in wanted))
        reference = reference_of(self._scans, poses, self._around(place.middle, reach), poses[place.middle])
        return {
            index: self._match(reference, poses, place.middle, self._queries[index].middle, half, half_turn)
            for index, half, half_turn in wanted
        }

    def _match(
        self,
        reference: Reference,
        poses: NDArray[np.float64],
        first: int,
        second: int,
        half: tuple[float, float],
        half_turn: float,
    ) -> _Match:
        stretch = self._around(second, _STRETCH_HALF_M)
        if len(stretch) < _LEAST_SCANS:
            return _Match(None)
        points, lines = thinned(*cloud(self._scans, poses, stretch, poses[second]), _THIN_M)
        guess = tuple(between(poses[first], poses[second]))
        best = reference.search(points, guess, half, half_turn, _TURN_STEP, _LEAST_SCORE)
        if best is None:
            return _Match(None)
        fit = reference.align(points, lines, best.pose, best.pose, np.eye(3), GATES)
        if fit.share < _LEAST_SHARE or fit.residual > _MOST_RESIDUAL_M:
            return _Match(None)
        step, information = np.array(fit.pose), independent(fit.information)
        excluded = Excluded(best.pose, _SAME_M, _SAME_RAD)
        other = reference.search(points, guess, half, half_turn, _TURN_STEP, _ALIKE * best.score, excluded)
        if other is not None:
            off = np.array(other.pose) - step
            off[2] = math.remainder(off[2], math.tau)
            if off @ information @ off > _EXPLAINED:
                return _Match(None, several=True)
        edge = Edge(first, second, step, information + _FLOOR * np.eye(3), loop=True)
        return _Match((edge, Loop(first, second, best.score, fit.share, fit.residual)))

    def _around(self, middle: int, reach: float) -> list[int]:
        """Return the scans up to so far (m) from one along the way, none from beyond a break of the odometry."""
        near = np.flatnonzero(np.abs(self._way - self._way[middle]) <= reach)
        return [i for i in near.tolist() if self._scans[i].stretch == self._scans[middle].stretch]

    def _candidates(
        self, number: int, poses: NDArray[np.float64], seen: NDArray[np.float64], most: float
    ) -> Iterator[tuple[int, tuple[float, float], float]]:
        """Yield the stretches that may be at a place, the nearest first: number, how far and turned to look.

        seen: the covariances (joints, 3, 3) of the joints as seen from the place.
        """
        place = self._places[number]
        middles, first, last = self._ends.T
        covariance = seen[np.searchsorted(self._joints, middles)]
        step = between(poses[place.middle], poses[middles])[:, :2]
        away = np.hypot(*step.T)
        # What is nearer than that is seen from the place.
        beyond = step * np.maximum(0.0, 1.0 - _NEAR_M / np.maximum(away, 1e-9))[:, None]
        spread = covariance[:, :2, :2] + _LEAST_SIGMA_M**2 * np.eye(2)
        squares = np.einsum("ni,ni->n", beyond, np.linalg.solve(spread, beyond[:, :, None])[:, :, 0])
        off = _SIGMAS * np.sqrt(np.trace(spread, axis1=1, axis2=2))
        apart = (first > place.last) | (place.first > last)
        apart &= np.abs(self._way[middles] - self._way[place.middle]) >= _LEAST_WAY_M
        near = np.flatnonzero(apart & (off <= most) & (squares <= _SIGMAS**2))
        for index in near[np.argsort(away[near], kind="stable")].tolist():
            pair, size = (number, index), max(_LEAST_M, float(off[index]))
            # Looked for again once it is clearly more certain where; or less, if it was not found where it should be.
            lost = pair in self._found and self._found[pair].found is None
            tried = self._tried.get(pair, math.inf)
            if size >= _REPEATED * tried and not (lost and tried < _REPEATED * size):
                continue
            query = self._queries[index]
            if not self._is_refused(place, query):
                self._tried[pair] = size
                half_x, half_y, turn = _SIGMAS * np.sqrt(np.diagonal(covariance[index]).clip(0.0))
                yield (
                    index, (max(_LEAST_M, float(half_x)), max(_LEAST_M, float(half_y))),
                    min(max(_LEAST_RAD, float(turn)), _MOST_RAD),
                )  # fmt: skip

    def _is_refused(self, place: Stretch, query: Stretch) -> bool:
        ends = sorted((self._way[place.middle], self._way[query.middle]))
        return any(
            abs(ends[0] - min(pair)) < _LEAST_WAY_M and abs(ends[1] - max(pair)) < _LEAST_WAY_M
            for pair in self._without
        )


def _stretches(way: NDArray[np.float64], every: float, half: float) -> Iterator[Stretch]:
    for at in np.arange(0.0, way[-1] + every, every):
        inside = np.nonzero(np.abs(way - at) <= half)[0]
        if len(inside) >= _LEAST_SCANS:
            yield Stretch(int(np.argmin(np.abs(way - at))), int(inside[0]), int(inside[-1]))
