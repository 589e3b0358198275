"""How certain each pose of a graph is as seen from one of them, along the surest way (Dijkstra 1959)."""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import float64, int64, njit, types, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

_I64_FLAT = types.Array(types.int64, 1, "C", readonly=True)


@njit(
    void(_I64_FLAT, _I64_FLAT, _arrays.F64_GRID, int64, float64, _arrays.F64_OUT, _arrays.F64_OUT),
    cache=True,
    nogil=True,
)
def _spread(start: Any, others: Any, figures: Any, source: int, most: float, variance: Any, turn_variance: Any) -> None:
    variance[source] = turn_variance[source] = 0.0
    waiting = [(0.0, source)]
    while len(waiting) > 0:
        reached, node = heapq.heappop(waiting)
        if reached > most:
            break
        if reached > variance[node]:
            continue
        for k in range(start[node], start[node + 1]):
            total = reached + figures[k, 0] + turn_variance[node] * figures[k, 2]
            if total < variance[others[k]]:
                variance[others[k]], turn_variance[others[k]] = total, turn_variance[node] + figures[k, 1]
                heapq.heappush(waiting, (total, others[k]))


class Neighbours:
    """Which poses were measured as seen from which, and what that adds to the variance of a pose."""

    def __init__(self, count: int, ends: NDArray[np.int64], figures: NDArray[np.float64]) -> None:
        """Take the measured pairs among `count` poses: `ends`, their numbers (n, 2).

        figures: (n, 4) of each: the variance (m^2) that it adds from its first to its second pose and back, that of the
        turn (rad^2), and its squared length (m^2), by which a turn before it counts; of several steps in a row, the sum
        of their squares. Raises `ValueError` for a number that is no pose's.
        """
        if len(ends) and not 0 <= ends.min() <= ends.max() < count:
            raise ValueError(f"pairs must be of poses 0 to {count - 1}")
        both = np.stack((ends, ends[:, ::-1]), axis=1).reshape(-1, 2)
        order = np.argsort(both[:, 0], kind="stable")
        self._start = np.searchsorted(both[order, 0], np.arange(count + 1)).astype(np.int64)
        self._others = np.ascontiguousarray(both[order, 1])
        either = np.stack((figures[:, [0, 2, 3]], figures[:, [1, 2, 3]]), axis=1).reshape(-1, 3)
        self._figures = np.ascontiguousarray(either[order])

    def seen_from(self, source: int, most: float = math.inf) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the variances (m^2, rad^2) of all poses as seen from one; inf: no measurement leads there.

        most: m^2, above which nobody wants to know them, and they may be too large.
        A heading that is off moves all that follows, by a lever as long as the way; here it moves each step by itself.
        So a long way without loops is less certain than this says.
        """
        variance = np.full(len(self._start) - 1, np.inf)
        turn_variance = variance.copy()
        _spread(self._start, self._others, self._figures, source, most, variance, turn_variance)
        return variance, turn_variance
