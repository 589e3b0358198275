"""What paths are compared with: searches of packages that can be installed, and paths along a potential's gradient.

The gradient's path is that of NavFn, the global planner of ROS: a potential spreads from the goal over the four
neighbours of each cell, by a quadratic interpolation of the wave's front, and the path follows its gradient in steps of
half a cell (Brock and Khatib 1999, Konolige 2000). Written anew from that description, ordered by a heap instead of
NavFn's three buffers: it serves as a reference of cost, not of time.
"""

# Kernels take arrays and scalars.
# ruff: noqa: ANN401

from __future__ import annotations

import heapq
import importlib
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import njit

from fog_kernels.steps import DEFAULT_WEIGHTS, DIAGONAL, STRAIGHT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Cell = tuple[int, int]
    Grid = NDArray[np.uint8]

Search = Callable[["Cell", "Cell"], object]
"""A search between two cells (column, row)."""


def _pyastar2d(package: Any, costmap: Grid) -> Search:
    weights = DEFAULT_WEIGHTS[costmap].astype(np.float32)
    weights[weights == 0] = np.inf
    return lambda start, goal: package.astar_path(weights, start[::-1], goal[::-1], allow_diagonal=True)


def _tcod(package: Any, costmap: Grid) -> Search:
    weights = np.ascontiguousarray(DEFAULT_WEIGHTS[costmap])

    def search(start: Cell, goal: Cell) -> object:
        finder = package.Pathfinder(package.SimpleGraph(cost=weights, cardinal=STRAIGHT, diagonal=DIAGONAL))
        finder.add_root(start[::-1])
        return finder.path_to(goal[::-1])

    return search


def _skimage(package: Any, costmap: Grid) -> Search:
    weights = DEFAULT_WEIGHTS[costmap].astype(np.float64)
    weights[weights == 0] = -1.0
    return lambda start, goal: package.route_through_array(weights, start[::-1], goal[::-1], geometric=True)


_PEERS: Final = {
    "pyastar2d": ("pyastar2d", _pyastar2d),
    "tcod": ("tcod.path", _tcod),
    "scikit_image": ("skimage.graph", _skimage),
}


def installed_peers(costmap: Grid) -> tuple[dict[str, Search], list[str]]:
    """Return the searches of other packages on a costmap by the package's name, and the packages that are missing."""
    found, missing = {}, []
    for name, (module, prepare) in _PEERS.items():
        try:
            found[name] = prepare(importlib.import_module(module), costmap)
        except ImportError:
            missing.append(name)
    return found, missing


_UNREACHED: Final = 1e300


@njit(cache=True, nogil=True)
def _spread(weights: Any, goal: int) -> Any:
    """Return the potential of every cell; the weights' border is impassable (0)."""
    height, width = weights.shape
    potential = np.full((height, width), _UNREACHED)
    potential[goal // width, goal % width] = 0.0
    queue = [(0.0, goal)]
    while len(queue) > 0:
        value, cell = heapq.heappop(queue)
        if value > potential[cell // width, cell % width]:
            continue
        for step in (1, -1, width, -width):
            y, x = (cell + step) // width, (cell + step) % width
            weight = weights[y, x]
            if weight == 0:
                continue
            beside, above = min(potential[y, x - 1], potential[y, x + 1]), min(potential[y - 1, x], potential[y + 1, x])
            least, share = min(beside, above), abs(beside - above) / weight
            rise = 1.0 if share >= 1.0 else -0.2301 * share * share + 0.5307 * share + 0.7040
            if least + weight * rise < potential[y, x] - 1e-6:
                potential[y, x] = least + weight * rise
                heapq.heappush(queue, (potential[y, x], cell + step))
    return potential


@njit(cache=True, nogil=True)
def _fall(potential: Any, x: int, y: int) -> tuple[float, float]:
    """Return the direction in which the potential falls at a cell; out of a wall, beside one."""
    here = potential[y, x]
    along = np.zeros(2)
    for axis in range(2):
        before = potential[y, x - 1] if axis == 0 else potential[y - 1, x]
        after = potential[y, x + 1] if axis == 0 else potential[y + 1, x]
        if here >= _UNREACHED:
            along[axis] = -1.0 if before < _UNREACHED else 1.0 if after < _UNREACHED else 0.0
        else:
            along[axis] += before - here if before < _UNREACHED else 0.0
            along[axis] += here - after if after < _UNREACHED else 0.0
    length = math.hypot(along[0], along[1])
    return (along[0] / length, along[1] / length) if length > 0.0 else (0.0, 0.0)


@njit(cache=True, nogil=True)
def _follow(potential: Any, x: int, y: int, goal_x: int, goal_y: int, points: Any) -> int:
    """Write the path down the potential; return its number of points, 0 where it finds no way down."""
    off_x, off_y = 0.0, 0.0
    count = 0
    while count < points.shape[0] - 1:
        points[count, 0], points[count, 1] = x + off_x, y + off_y
        count += 1
        if math.hypot(x + off_x - goal_x, y + off_y - goal_y) < 0.75:
            points[count, 0], points[count, 1] = goal_x, goal_y
            return count + 1
        around = potential[y - 1 : y + 2, x - 1 : x + 2]
        turns_back = count > 2 and (points[count - 1] == points[count - 3]).all()
        if turns_back or around.max() >= _UNREACHED:
            lowest = around.argmin()
            x, y, off_x, off_y = x + lowest % 3 - 1, y + lowest // 3 - 1, 0.0, 0.0
            continue
        fall_x, fall_y = 0.0, 0.0
        for k in range(4):
            share = (off_x if k % 2 else 1.0 - off_x) * (off_y if k // 2 else 1.0 - off_y)
            along_x, along_y = _fall(potential, x + k % 2, y + k // 2)
            fall_x += share * along_x
            fall_y += share * along_y
        length = math.hypot(fall_x, fall_y)
        if length == 0.0:
            return 0
        off_x, off_y = off_x + 0.5 * fall_x / length, off_y + 0.5 * fall_y / length
        if abs(off_x) > 1.0:
            x, off_x = x + int(math.copysign(1.0, off_x)), off_x - math.copysign(1.0, off_x)
        if abs(off_y) > 1.0:
            y, off_y = y + int(math.copysign(1.0, off_y)), off_y - math.copysign(1.0, off_y)
    return 0


def gradient_path_cost(costmap: Grid, start: Cell, goal: Cell) -> float:
    """Return what the gradient's path costs by the integral of `lines.line_cost`; NaN if it finds no way.

    It may touch impassable cells, which count as the dearest of the others.
    """
    weights = np.pad(DEFAULT_WEIGHTS[costmap], 1)
    potential = _spread(weights, (goal[1] + 1) * weights.shape[1] + goal[0] + 1)
    points = np.empty((200_000, 2))
    count = _follow(potential, start[0] + 1, start[1] + 1, goal[0] + 1, goal[1] + 1, points)
    if count == 0:
        return math.nan
    line = np.repeat(points[:count], 2, axis=0)[1:-1].reshape(-1, 2, 2)
    shares = (np.arange(10) + 0.5)[:, None, None] / 10.0
    samples = np.floor(line[:, 0] + shares * (line[:, 1] - line[:, 0]) + 0.5).astype(int)
    passed = weights[samples[..., 1], samples[..., 0]]
    passed[passed == 0] = weights.max()
    return float(np.sum(passed.mean(axis=0) * np.hypot(*(line[:, 1] - line[:, 0]).T)))
