"""A graph of poses and what was measured between them, solved by Gauss and Newton, robust against wrong loops.

Wrong loops are found by graduated non-convexity (Yang, Antonante, Tzoumas, Carlone 2020, with Geman and McClure's
function): solved first as if all loops were right, then with ever less patience for those that contradict the rest.
Started with a robust function at once, a bent trajectory would throw its right loops away.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from fog_mapping.poses import Edge, wrap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray
    from scipy.sparse.linalg import SuperLU

_CHI_SQUARE: Final = 11.3
"""99 % of right measurements with 3 degrees of freedom are below."""
_PATIENCE_STEP: Final = 1.6
_CONVERGED: Final = 1e-5
_STEPS: Final = 12
_SOLVED_AT_ONCE: Final = 64
"""Joints whose covariances with all others are in memory together."""


class Solution(NamedTuple):
    """Poses (n, 3); how much each edge counts (1: fully, 0: not at all), and its squared error in deviations."""

    poses: NDArray[np.float64]
    weights: NDArray[np.float64]
    squares: NDArray[np.float64]


def solve(poses: NDArray[np.float64], edges: Sequence[Edge]) -> Solution:
    """Return the poses (n, 3) that fit the edges best, from given ones on; the first stays where it is.

    Every pose must be reached by edges that are no loops. Raises `RuntimeError` where one is not.
    """
    system = _System(len(poses), edges)
    weights = np.ones(len(edges))
    for _ in range(3):
        poses, _ = system.step(poses, weights)
    if system.loops.any():
        patience = max(1.0, 2.0 * float(system.squares(poses)[system.loops].max()) / _CHI_SQUARE)
        while patience > 1.0:
            patience = max(1.0, patience / _PATIENCE_STEP)
            weights = system.weights(poses, patience)
            for _ in range(2):
                poses, _ = system.step(poses, weights)
    for _ in range(_STEPS):
        poses, moved = system.step(poses, weights)
        weights = system.weights(poses, 1.0)
        if moved < _CONVERGED:
            break
    return Solution(poses, weights, system.squares(poses))


class Certainty:
    """How certain some poses of a graph are as seen from one another, once it is solved.

    These are the marginal covariances of its normal equations (Kaess and Dellaert 2009): a heading that is off moves
    all that follows by a lever as long as the way, and what loops say counts.
    """

    def __init__(
        self, poses: NDArray[np.float64], joints: NDArray[np.int64], edges: Sequence[Edge], weights: NDArray[np.float64]
    ) -> None:
        """`joints`: the numbers of these poses in their order, the first, the last and the ends of loops among them.

        edges: first those of the way, one from each pose (n, 3) to the next, then loops with their weights.
        """
        last = int(joints[-1])
        way, loops = edges[:last], edges[last:]
        # The way of many scans between two joints, which nothing else meets, counts as one step.
        begin, end = (np.repeat(some, np.diff(joints)) for some in (joints[:-1], joints[1:]))
        carried = np.zeros((last, 3, 3))
        turn = poses[:last, 2] - poses[begin, 2]
        carried[:, 0, 0] = carried[:, 1, 1] = np.cos(turn)
        carried[:, 1, 0] = np.sin(turn)
        carried[:, 0, 1], carried[:, 2, 2] = -carried[:, 1, 0], 1.0
        cos, sin = np.cos(poses[begin, 2]), np.sin(poses[begin, 2])
        lever_x, lever_y = (poses[end, :2] - poses[1 : last + 1, :2]).T
        carried[:, 0, 2], carried[:, 1, 2] = sin * lever_x - cos * lever_y, cos * lever_x + sin * lever_y
        covariance = np.linalg.inv(np.array([edge.information for edge in way]) + 1e-6 * np.eye(3))
        step = np.add.reduceat(carried @ covariance @ carried.transpose(0, 2, 1), joints[:-1], axis=0)
        joined = [Edge(k, k + 1, np.zeros(3), each) for k, each in enumerate(np.linalg.inv(step))]
        numbers = np.searchsorted(joints, [(edge.first, edge.second) for edge in loops]).reshape(-1, 2).tolist()
        joined += [
            Edge(first, second, edge.step, edge.information)
            for (first, second), edge in zip(numbers, loops, strict=True)
        ]
        self._poses, self._count = poses[joints], len(joints)
        counted = np.concatenate((np.ones(self._count - 1), weights[last:]))
        self._factors = _factors(_System(self._count, joined).matrix(self._poses, counted))
        self._own = np.zeros((self._count, 3, 3))
        for first in range(1, self._count, _SOLVED_AT_ONCE):
            some = np.arange(first, min(self._count, first + _SOLVED_AT_ONCE))
            self._own[some] = self._columns(some)[np.arange(len(some)), some]

    def _columns(self, joints: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the covariances (n, joints, 3, 3) of all joints with these."""
        right = np.zeros((3 * self._count, 3 * len(joints)))
        for k, joint in enumerate(joints.tolist()):
            right[3 * joint : 3 * joint + 3, 3 * k : 3 * k + 3] = np.eye(3)
        found = np.zeros_like(right)
        found[3:] = self._factors.solve(right[3:])
        return found.reshape(self._count, 3, len(joints), 3).transpose(2, 0, 1, 3)

    def seen_from(self, sources: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the covariances (n, joints, 3, 3; m, rad) of all joints as seen from some, numbered among the joints.

        In the axes of those seen from.
        """
        pairs = len(sources) * self._count
        first = np.repeat(self._poses[sources], self._count, axis=0)
        by_first, by_second = _slopes(first, np.tile(self._poses, (len(sources), 1)))
        both = by_second @ self._columns(sources).reshape(pairs, 3, 3) @ by_first.transpose(0, 2, 1)
        own = by_second @ np.tile(self._own, (len(sources), 1, 1)) @ by_second.transpose(0, 2, 1)
        seen = by_first @ np.repeat(self._own[sources], self._count, axis=0) @ by_first.transpose(0, 2, 1)
        return (seen + own + both + both.transpose(0, 2, 1)).reshape(len(sources), self._count, 3, 3)


class _System:
    """The normal equations of a graph."""

    def __init__(self, count: int, edges: Sequence[Edge]) -> None:
        self._count = count
        self._first = np.array([edge.first for edge in edges])
        self._second = np.array([edge.second for edge in edges])
        self._steps = np.array([edge.step for edge in edges])
        self._information = np.array([edge.information for edge in edges])
        self.loops = np.array([edge.loop for edge in edges])
        ends = (self._first, self._second)
        cells = np.arange(3)
        pairs = [(a, b) for a in ends for b in ends]
        self._rows = np.concatenate(
            [np.broadcast_to((3 * a)[:, None, None] + cells[:, None], (len(a), 3, 3)).ravel() for a, _ in pairs]
        )
        self._columns = np.concatenate(
            [np.broadcast_to((3 * b)[:, None, None] + cells, (len(b), 3, 3)).ravel() for _, b in pairs]
        )

    def squares(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return each edge's squared error in standard deviations."""
        errors = self._errors(poses)
        squares: NDArray[np.float64] = np.einsum("ei,eij,ej->e", errors, self._information, errors)
        return squares

    def weights(self, poses: NDArray[np.float64], patience: float) -> NDArray[np.float64]:
        """Return how much each edge counts by Geman and McClure, for loops; 1 for the others."""
        bound = patience * _CHI_SQUARE
        return np.where(self.loops, (bound / (bound + self.squares(poses))) ** 2, 1.0)

    def _weighed(self, poses: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return each edge's slopes, and these times its information."""
        by_first, by_second = _slopes(poses[self._first], poses[self._second])
        information = self._information * weights[:, None, None]
        first = np.einsum("eji,ejk->eik", by_first, information)
        second = np.einsum("eji,ejk->eik", by_second, information)
        return by_first, by_second, first, second

    def matrix(self, poses: NDArray[np.float64], weights: NDArray[np.float64]) -> csc_matrix:
        """Return the matrix (3 n, 3 n) of the normal equations."""
        by_first, by_second, first, second = self._weighed(poses, weights)
        blocks = [left @ right for left in (first, second) for right in (by_first, by_second)]
        return csc_matrix(
            (np.concatenate([block.ravel() for block in blocks]), (self._rows, self._columns)),
            shape=(3 * self._count, 3 * self._count),
        )

    def step(self, poses: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return the poses after one step, and the largest change."""
        errors = self._errors(poses)
        _, _, first, second = self._weighed(poses, weights)
        gradient = np.zeros((self._count, 3))
        np.add.at(gradient, self._first, np.einsum("eij,ej->ei", first, errors))
        np.add.at(gradient, self._second, np.einsum("eij,ej->ei", second, errors))
        change = np.zeros((self._count, 3))
        change[1:] = _factors(self.matrix(poses, weights)).solve(-gradient.ravel()[3:]).reshape(-1, 3)
        moved = poses + change
        moved[:, 2] = wrap(moved[:, 2])
        return moved, float(np.abs(change).max())

    def _errors(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        first, away = poses[self._first], poses[self._second] - poses[self._first]
        cos, sin = np.cos(first[:, 2]), np.sin(first[:, 2])
        seen = np.stack((cos * away[:, 0] + sin * away[:, 1], -sin * away[:, 0] + cos * away[:, 1], away[:, 2]), axis=1)
        errors: NDArray[np.float64] = seen - self._steps
        errors[:, 2] = wrap(errors[:, 2])
        return errors


def _factors(matrix: csc_matrix) -> SuperLU:
    """Return the factors of the normal equations, the first pose kept where it is."""
    return splu(
        matrix[3:, 3:].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def _slopes(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the derivatives (n, 3, 3) of the second poses (n, 3) as seen from the first, by either."""
    away = second - first
    cos, sin = np.cos(first[:, 2]), np.sin(first[:, 2])
    by_second = np.zeros((len(first), 3, 3))
    by_second[:, 0, 0] = by_second[:, 1, 1] = cos
    by_second[:, 0, 1], by_second[:, 1, 0] = sin, -sin
    by_second[:, 2, 2] = 1.0
    by_first = -by_second
    by_first[:, 0, 2] = -sin * away[:, 0] + cos * away[:, 1]
    by_first[:, 1, 2] = -cos * away[:, 0] - sin * away[:, 1]
    return by_first, by_second
