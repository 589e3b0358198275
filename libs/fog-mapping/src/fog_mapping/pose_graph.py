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

from fog_mapping.poses import wrap

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from fog_mapping.poses import Edge

_CHI_SQUARE: Final = 11.3
"""99 % of right measurements with 3 degrees of freedom are below."""
_PATIENCE_STEP: Final = 1.6
_CONVERGED: Final = 1e-5
_STEPS: Final = 12


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

    def step(self, poses: NDArray[np.float64], weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return the poses after one step, and the largest change."""
        errors, by_first, by_second = self._errors(poses), *self._slopes(poses)
        information = self._information * weights[:, None, None]
        first = np.einsum("eji,ejk->eik", by_first, information)
        second = np.einsum("eji,ejk->eik", by_second, information)
        blocks = [left @ right for left in (first, second) for right in (by_first, by_second)]
        matrix = csc_matrix(
            (np.concatenate([block.ravel() for block in blocks]), (self._rows, self._columns)),
            shape=(3 * self._count, 3 * self._count),
        )
        gradient = np.zeros((self._count, 3))
        np.add.at(gradient, self._first, np.einsum("eij,ej->ei", first, errors))
        np.add.at(gradient, self._second, np.einsum("eij,ej->ei", second, errors))
        factors = splu(
            matrix[3:, 3:].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        change = np.zeros((self._count, 3))
        change[1:] = factors.solve(-gradient.ravel()[3:]).reshape(-1, 3)
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

    def _slopes(self, poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the errors' derivatives (edges, 3, 3) by the first and the second pose."""
        first, away = poses[self._first], poses[self._second] - poses[self._first]
        cos, sin = np.cos(first[:, 2]), np.sin(first[:, 2])
        by_second = np.zeros((len(first), 3, 3))
        by_second[:, 0, 0] = by_second[:, 1, 1] = cos
        by_second[:, 0, 1], by_second[:, 1, 0] = sin, -sin
        by_second[:, 2, 2] = 1.0
        by_first = -by_second
        by_first[:, 0, 2] = -sin * away[:, 0] + cos * away[:, 1]
        by_first[:, 1, 2] = -cos * away[:, 0] - sin * away[:, 1]
        return by_first, by_second
