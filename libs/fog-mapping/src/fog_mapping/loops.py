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

from fog_kernels.certainty import Neighbours
from fog_kernels.matching import Excluded
from fog_mapping.poses import Edge, between, path_lengths
from fog_mapping.scans import cloud, reference_of, thinned
from fog_mapping.trajectory import GATES, independent

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from fog_mapping.scans import Scan

_PLACE_EVERY_M: Final = 5.0
_PLACE_HALF_M: Final = 5.0
_STRETCH_EVERY_M: Final = 2.5
_STRETCH_HALF_M: Final = 2.5
_LEAST_WAY_M: Final = 12.0
"""Two stretches of the way must be so far apart along it to be a loop, between their middles."""
_NEAR_M: Final = 3.0
_SIGMAS: Final = 3.0
_LEAST_M: Final = 0.5
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
    """What was found: edges with the loops that they are, and how many pairs fitted several places."""

    edges: list[Edge]
    loops: list[Loop]
    ambiguous: int


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
        neighbours = _neighbours(self._joints, edges, weights)
        joined: list[Edge] = []
        loops: list[Loop] = []
        ambiguous = 0
        with ThreadPoolExecutor(self._jobs) as pool:
            places = pool.map(partial(self._search_place, poses, neighbours, most), range(len(self._places)))
            for done, found in enumerate(places, 1):
                joined.extend(found.edges)
                loops.extend(found.loops)
                ambiguous += found.ambiguous
                on_progress(done / len(self._places))
        return Searched(joined, loops, ambiguous)

    def _search_place(self, poses: NDArray[np.float64], neighbours: Neighbours, most: float, number: int) -> Searched:
        place = self._places[number]
        joint = int(np.searchsorted(self._joints, place.middle))
        known = neighbours.seen_from(joint, (most / _SIGMAS) ** 2 * (1.0 + 1e-9))
        wanted = list(itertools.islice(self._candidates(number, poses, *known, most), _MOST_TRIED))
        for index, half, _ in wanted:
            self._tried[number, index] = half
        edges: list[Edge] = []
        loops: list[Loop] = []
        ambiguous = 0
        if not wanted:
            return Searched(edges, loops, ambiguous)
        reference = reference_of(self._scans, poses, range(place.first, place.last + 1), poses[place.middle])
        for index, half, half_turn in wanted:
            query = self._queries[index]
            points, lines = thinned(
                *cloud(self._scans, poses, range(query.first, query.last + 1), poses[query.middle]), _THIN_M
            )
            guess = tuple(between(poses[place.middle], poses[query.middle]))
            best = reference.search(points, guess, half, half_turn, _TURN_STEP, _LEAST_SCORE)
            if best is None:
                continue
            fit = reference.align(points, lines, best.pose, best.pose, np.eye(3), GATES)
            if fit.share < _LEAST_SHARE or fit.residual > _MOST_RESIDUAL_M:
                continue
            information = independent(fit.information)
            other = reference.search(
                points, guess, half, half_turn, _TURN_STEP, _ALIKE * best.score,
                Excluded(best.pose, _SAME_M, _SAME_RAD),
            )  # fmt: skip
            step = np.array(fit.pose)
            if other is not None:
                off = between(step, np.array(other.pose))
                if off @ information @ off > _EXPLAINED:
                    ambiguous += 1
                    continue
            edges.append(Edge(place.middle, query.middle, step, information + _FLOOR * np.eye(3), loop=True))
            loops.append(Loop(place.middle, query.middle, best.score, fit.share, fit.residual))
        return Searched(edges, loops, ambiguous)

    def _candidates(
        self,
        number: int,
        poses: NDArray[np.float64],
        variance: NDArray[np.float64],
        turn_variance: NDArray[np.float64],
        most: float,
    ) -> Iterator[tuple[int, float, float]]:
        """Yield the stretches that may be at a place, the nearest first: number, how far and turned to look.

        variance, turn_variance: of the joints.
        """
        place = self._places[number]
        middles, first, last = self._ends.T
        joints = np.searchsorted(self._joints, middles)
        off = _SIGMAS * np.sqrt(variance[joints])
        away = np.hypot(*(poses[middles, :2] - poses[place.middle, :2]).T)
        apart = (first > place.last) | (place.first > last)
        apart &= np.abs(self._way[middles] - self._way[place.middle]) >= _LEAST_WAY_M
        near = np.flatnonzero(apart & (off <= most) & (away <= _NEAR_M + off))
        for index in near[np.argsort(away[near], kind="stable")].tolist():
            half = max(_LEAST_M, float(off[index]))
            # Looked for again once it is clearly more certain where.
            if half >= _REPEATED * self._tried.get((number, index), math.inf):
                continue
            query = self._queries[index]
            if not self._is_refused(place, query):
                turn = _SIGMAS * math.sqrt(turn_variance[joints[index]])
                yield index, half, min(max(_LEAST_RAD, turn), _MOST_RAD)

    def _is_refused(self, place: Stretch, query: Stretch) -> bool:
        ends = sorted((self._way[place.middle], self._way[query.middle]))
        return any(
            abs(ends[0] - min(pair)) < _LEAST_WAY_M and abs(ends[1] - max(pair)) < _LEAST_WAY_M
            for pair in self._without
        )


def _stretches(way: NDArray[np.float64], every: float, half: float) -> Iterator[Stretch]:
    for at in np.arange(0.0, way[-1] + every, every):
        inside = np.nonzero(np.abs(way - at) <= half)[0]
        if len(inside) >= 3:
            yield Stretch(int(np.argmin(np.abs(way - at))), int(inside[0]), int(inside[-1]))


def _neighbours(joints: NDArray[np.int64], edges: Sequence[Edge], weights: NDArray[np.float64]) -> Neighbours:
    """Return how certain the joints are as seen from one another; all ends of loops are joints.

    The way of many scans between two joints, which nothing else meets, counts as one step.
    """
    used = [edge for edge, weight in zip(edges, weights, strict=True) if not (edge.loop and weight < _KEPT)]
    covariance = np.linalg.inv(np.array([edge.information for edge in used]) + 1e-6 * np.eye(3))
    steps = np.array([edge.step for edge in used])
    square = steps[:, 0] ** 2 + steps[:, 1] ** 2
    # The way's edges come first, one from each scan to the next: what turns up to there add at the lever of each step.
    last, turn = int(joints[-1]), covariance[:, 2, 2]
    turned = np.concatenate(((0.0,), np.cumsum(turn[:last])))
    begin, end = (np.repeat(turned[some], np.diff(joints)) for some in (joints[:-1], joints[1:]))
    onward, back = turn.copy(), turn.copy()
    onward[:last], back[:last] = turned[1:] - begin, end - turned[:-1]
    added = (covariance[:, 0, 0] + covariance[:, 1, 1])[:, None] + np.column_stack((onward, back)) * square[:, None]
    figures = np.column_stack((added, turn, square))
    way = np.add.reduceat(figures[:last], joints[:-1], axis=0)
    numbers = np.arange(len(joints))
    loops = np.searchsorted(joints, [(edge.first, edge.second) for edge in used[last:]]).reshape(-1, 2)
    return Neighbours(
        len(joints),
        np.concatenate((np.column_stack((numbers[:-1], numbers[1:])), loops)),
        np.concatenate((way, figures[last:])),
    )
