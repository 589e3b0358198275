"""The way that scans tell by themselves: each is matched to those before it, near where odometry says that it is."""

from __future__ import annotations

import cmath
import itertools
import math
from collections import defaultdict
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_kernels.matching import Reference
from fog_mapping.poses import Edge, between, compose
from fog_mapping.scans import reference_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from fog_mapping.scans import Scan

GATES: Final = np.array([0.45] * 3 + [0.3] * 3 + [0.2] * 4 + [0.12] * 5)
"""How far (m) the line of a point may be, step by step of a refinement."""
_INDEPENDENT: Final = 0.1
"""The returns of a scan err together (a lidar's bias, a wall that is not straight): so much of them is independent."""
_SPURIOUS: Final = 0.01
"""Normals err by some degrees, so that plain walls seem to say this share of what they say across also along."""
WINDOW: Final = 12
"""Scans before it that one is matched to."""
_SPREAD_M: Final = 8.0
_AROUND: Final = 40
"""Scans around one, by place, that it is to fit in the end."""
_CELL_M: Final = 1.0
"""Where a robot comes again and again, so many are nearer than that."""
_TURN_STEP: Final = math.radians(1.0)
_SEARCHED_SIGMAS: Final = 2.5
_MOST_M: Final = 0.6
_MOST_RAD: Final = 0.5
_DOUBT: Final = 0.05
_BREAK_M: Final = 2.0
_BREAK_RAD: Final = 0.5
"""Deviations of the odometry over a break of it: of a robot that somebody drove on for some seconds."""
_CLEAR_TURN_RAD: Final = 0.12
_TURNS_CHECKED: Final = 40
_MIRRORED_SHARE: Final = 0.75
_STRAIGHT_RAD: Final = 0.05
"""In turns a lidar that is off the robot's middle goes another way than the odometry says."""
_LEAST_STEPS: Final = 20
_ODOMETRY_SHARE: Final = 0.5
"""Odometry counts for as much less than its deviations say: they are those of a bad one."""


class AgainstOdometry(NamedTuple):
    """How scans moved where the odometry went straight on: turned from its direction (rad), and m for each of its m."""

    turned: float
    share: float


def independent(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what the lines of a scan really say (3, 3): less, as they err together, and nothing along plain walls."""
    (least, most), axes = np.linalg.eigh(information[:2, :2])
    said = information @ np.array((*axes[:, 0], 0.0))
    share = 1.0 if least <= _SPURIOUS * most else _SPURIOUS * most / least
    kept: NDArray[np.float64] = _INDEPENDENT * (information - share * np.outer(said, said) / max(least, 1e-9))
    return kept


def _turned(information: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """Return the same information (3, 3) in axes that are turned by `turn` (rad)."""
    axes = np.eye(3)
    axes[:2, :2] = ((math.cos(turn), -math.sin(turn)), (math.sin(turn), math.cos(turn)))
    kept: NDArray[np.float64] = axes.T @ information @ axes
    return kept


def match_in_order(
    scans: Sequence[Scan], on_progress: Callable[[int], None] = lambda _: None
) -> tuple[NDArray[np.float64], list[Edge]]:
    """Return the poses (n, 3) of the scans by matching, the first at the origin, and the edges between them.

    `on_progress` is called with the number of scans that are matched.
    """
    poses = np.zeros((len(scans), 3))
    edges: list[Edge] = []
    for i in range(1, len(scans)):
        poses[i], information = match_next(scans, poses, i)
        edges.append(Edge(i - 1, i, between(poses[i - 1], poses[i]), information))
        on_progress(i + 1)
    return poses, edges


def match_next(
    scans: Sequence[Scan], poses: NDArray[np.float64], i: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pose (3,) of scan `i` by those before it, whose poses (n, 3) are known.

    And its information (3, 3), along and across as the scan before it looks.
    """
    step = between(scans[i - 1].odometry, scans[i].odometry)
    guess = compose(poses[i - 1], step)
    near = [j for j in range(max(0, i - WINDOW), i) if math.hypot(*(poses[j] - guess)[:2]) < _SPREAD_M]
    before = reference_of(scans, poses, near or [i - 1])
    moved, turned = math.hypot(step[0], step[1]), abs(float(step[2]))
    deviation = 0.05 + 0.1 * moved + 0.05 * turned
    turn_deviation = 0.02 + 0.05 * moved + 0.12 * turned
    broken = scans[i - 1].stretch != scans[i].stretch
    if broken:
        deviation, turn_deviation = deviation + _BREAK_M, turn_deviation + _BREAK_RAD
    prior = np.diag((deviation**-2, deviation**-2, turn_deviation**-2))
    found = before.search(
        scans[i].points,
        tuple(guess),
        _SEARCHED_SIGMAS * deviation if broken else min(_MOST_M, _SEARCHED_SIGMAS * deviation),
        _SEARCHED_SIGMAS * turn_deviation if broken else min(_MOST_RAD, _SEARCHED_SIGMAS * turn_deviation),
        _TURN_STEP,
        0.0,
        doubt=_DOUBT,
    )
    start = tuple(guess) if found is None else found.pose
    aligned = before.align(scans[i].points, scans[i].normals, start, tuple(guess), prior, GATES)
    # A scan from after a break may be of another place that looks alike: only a loop tells.
    told = np.zeros((3, 3)) if broken else _turned(independent(aligned.information), float(poses[i - 1, 2]))
    return np.array(aligned.pose), told + _ODOMETRY_SHARE * prior


def against_odometry(scans: Sequence[Scan], edges: Sequence[Edge]) -> AgainstOdometry | None:
    """Return how the scans moved by matching (`match_in_order`) against the odometry; None where little is straight."""
    told, found = [], []
    for edge in edges:
        first, second = scans[edge.first], scans[edge.second]
        step = between(first.odometry, second.odometry)
        if first.stretch == second.stretch and abs(step[2]) < _STRAIGHT_RAD:
            told.append(complex(step[0], step[1]))
            found.append(complex(edge.step[0], edge.step[1]))
    if len(told) < _LEAST_STEPS:
        return None
    odometry = np.array(told)
    ratio = complex(np.vdot(odometry, found)) / max(1e-9, float((abs(odometry) ** 2).sum()))
    return AgainstOdometry(cmath.phase(ratio), abs(ratio))


def refuse_mirrored(scans: Sequence[Scan]) -> None:
    """Raise `ValueError` if scans turn one way where the odometry turns the other: no map could come of it."""
    mirrored = checked = 0
    for before, scan in itertools.pairwise(scans):
        x, y, turned = between(before.odometry, scan.odometry)
        if abs(turned) < _CLEAR_TURN_RAD or checked == _TURNS_CHECKED:
            continue
        checked += 1
        reference = Reference(before.points, before.normals)
        scores = []
        for turn in (turned, -turned):
            guess = float(x), float(y), float(turn)
            found = reference.search(scan.points, guess, 0.3, 0.3 * abs(turned), _TURN_STEP, 0.0)
            scores.append(0.0 if found is None else found.score)
        mirrored += scores[1] > scores[0]
    if checked >= _TURNS_CHECKED // 4 and mirrored > _MIRRORED_SHARE * checked:
        raise ValueError(
            f"the scans turn left where the odometry turns right, in {mirrored} of {checked} turns. The lidar stands "
            "on its head: mirror its angles (`mirrored` in robot.toml), or the odometry's, and record again"
        )


def settle(scans: Sequence[Scan], poses: NDArray[np.float64], sweeps: int = 2) -> NDArray[np.float64]:
    """Return poses at which each scan fits all those around it, whenever taken: a graph leaves walls blurred."""
    settled = poses.copy()
    gates = np.array((0.2, 0.2, 0.12, 0.12, 0.08, 0.08))
    stay = np.diag((100.0, 100.0, 400.0))
    cells = _Cells(settled)
    for _ in range(sweeps):
        for i in range(1, len(scans)):
            around = cells.nearest(i)
            if around:
                others = reference_of(scans, settled, around)
                pose = tuple(settled[i])
                settled[i] = others.align(scans[i].points, scans[i].normals, pose, pose, stay, gates).pose
                cells.moved(i)
    return settled


class _Cells:
    """Which of many poses lie in which square: one that is asked for its nearest need not look at all."""

    def __init__(self, poses: NDArray[np.float64]) -> None:
        """`poses`: (n, 3; m, rad), which may change, each followed by a call of `moved`."""
        self._poses = poses
        self._cell_of = [self._cell(i) for i in range(len(poses))]
        self._members: defaultdict[tuple[int, int], list[int]] = defaultdict(list)
        for i, cell in enumerate(self._cell_of):
            self._members[cell].append(i)

    def _cell(self, i: int) -> tuple[int, int]:
        return math.floor(self._poses[i, 0] / _CELL_M), math.floor(self._poses[i, 1] / _CELL_M)

    def moved(self, i: int) -> None:
        """Take in where pose `i` is now."""
        before, now = self._cell_of[i], self._cell(i)
        if now != before:
            self._members[before].remove(i)
            self._members[now].append(i)
            self._cell_of[i] = now

    def nearest(self, i: int) -> list[int]:
        """Return the nearest poses, `_AROUND` with `i` itself, nearest first: it is left out."""
        found = self._within(i, 1)
        if len(found) < _AROUND:
            found = self._within(i, math.ceil(0.5 * _SPREAD_M / _CELL_M))
        return [int(j) for j in found if j != i]

    def _within(self, i: int, reach: int) -> NDArray[np.int64]:
        """Return up to `_AROUND` poses that are less than `reach` cells away, nearest first, then in their order."""
        column, row = self._cell_of[i]
        cells = itertools.product(range(column - reach, column + reach + 1), range(row - reach, row + reach + 1))
        some = np.array(sorted(itertools.chain.from_iterable(self._members.get(cell, ()) for cell in cells)), np.int64)
        away = np.hypot(*(self._poses[some, :2] - self._poses[i, :2]).T)
        near = np.nonzero(away < reach * _CELL_M)[0]
        return some[near[np.argsort(away[near], kind="stable")[:_AROUND]]]
