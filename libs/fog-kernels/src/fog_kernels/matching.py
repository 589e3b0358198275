"""Matching of scans to other scans, for mapping: an exhaustive search by branch and bound, and a refinement on lines.

The search is Hess, Kohler, Rapp and Andor 2016: the score of a pose is the mean, over a scan's points, of a table that
is blurred around the points of the reference; tables of the maxima of ever larger squares bound the score of all poses
of a block, so that most of them are never looked at and none that is better is missed. The refinement is iterative
closest points with the distance to lines (Censi 2008), each point weighed by Cauchy's function.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per value
# would cost more than its work.
# ruff: noqa: ANN401, C901, PLR0912, PLR0913, PLR0915

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numba import float64, int64, njit, types, void

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

LEVELS: Final = 6
"""Tables of maxima: the squares of the last one are 2 ** (LEVELS - 1) cells wide."""
_PAD: Final = 1 << (LEVELS - 1)
_CELL_M: Final = 0.5
"""Width of the cells in which a point's neighbours are looked for: no gate may be larger."""
_MARGIN_M: Final = 1.0
_NEIGHBOURS: Final = 10
_STRAIGHT: Final = 0.1
"""Points lie on a line if they spread across it by less than this share (of variance) of what they spread along it."""
_CLEARER: Final = 2.0
"""A line of the points to one side that spread across it by so much less (variance) is the wall before a step. A line
over the step is tilted, and lies the farther on, the farther off it is seen from: the way past it becomes too long."""
_PARALLEL: Final = 0.8
"""Cosine of the angle up to which the lines of two points may be one wall."""
_CAUCHY: Final = 3.0
"""Residuals of so many deviations have half the weight."""

_OCCUPIED_SHARE: Final = 0.3
"""A cell is a wall if this share of the scans that reached it ended there: walls are grazed by many others."""

_F64_GRID_OUT = types.Array(types.float64, 2, "C")
_TABLES = types.Array(types.uint8, 3, "C", readonly=True)
_TABLES_OUT = types.Array(types.uint8, 3, "C")
_I64_FLAT = types.Array(types.int64, 1, "C", readonly=True)


class Found(NamedTuple):
    """The best pose (x, y in m, theta in rad) of a search, and its score, 0 to 1."""

    pose: tuple[float, float, float]
    score: float


class Aligned(NamedTuple):
    """A refined pose (x, y in m, theta in rad), and what speaks for it.

    information: (3, 3), of the lines alone: the inverse of the covariance over x, y, theta if residuals were
    independent. share: of the points that found a line. residual: rms distance (m) from these lines.
    """

    pose: tuple[float, float, float]
    information: NDArray[np.float64]
    share: float
    residual: float


class Excluded(NamedTuple):
    """Poses that a search leaves out: those within `radius` (m) and `angle` (rad) of `pose`."""

    pose: tuple[float, float, float]
    radius: float
    angle: float


_line_signature = types.UniTuple(float64, 4)(  # type: ignore[no-untyped-call]  # numba has no types
    _arrays.F64_GRID, int64, int64, int64, float64
)  # fmt: skip


@njit(_line_signature, cache=True, nogil=True)
def _line(points: Any, i: int, first: int, end: int, reach: float) -> Any:
    """Return the line of the points `first` to `end` that are within `reach` of point `i`.

    How many they are, the sums of their squared distances across and along it (m²), and its direction (rad).
    """
    sum_x = sum_y = xx = xy = yy = 0.0
    joined = 0
    for j in range(max(0, first), min(points.shape[0], end)):
        dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        if math.hypot(dx, dy) > reach:
            continue
        sum_x += dx
        sum_y += dy
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
        joined += 1
    xx -= sum_x * sum_x / joined
    xy -= sum_x * sum_y / joined
    yy -= sum_y * sum_y / joined
    root = math.sqrt(max(0.0, 0.25 * (xx - yy) ** 2 + xy * xy))
    return float(joined), 0.5 * (xx + yy) - root, 0.5 * (xx + yy) + root, 0.5 * math.atan2(2.0 * xy, xx - yy)


@njit(void(_arrays.F64_GRID, float64, _F64_GRID_OUT), cache=True, nogil=True)
def _normals(points: Any, reach: float, out: Any) -> None:
    for i in range(points.shape[0]):
        out[i, 0] = out[i, 1] = 0.0
        joined, across, along, angle = _line(points, i, i - _NEIGHBOURS, i + _NEIGHBOURS + 1, reach)
        if joined < 3.0:
            continue
        spread = across / (joined - 2.0)
        for first in (i - _NEIGHBOURS, i):
            side, side_across, side_along, side_angle = _line(points, i, first, first + _NEIGHBOURS + 1, reach)
            if side >= _NEIGHBOURS and _CLEARER * side_across / (side - 2.0) < spread:
                spread = _CLEARER * side_across / (side - 2.0)
                across, along, angle = side_across, side_along, side_angle
        if along <= 0.0 or across > _STRAIGHT * along:
            continue
        out[i, 0], out[i, 1] = -math.sin(angle), math.cos(angle)


@njit(void(_arrays.F64_GRID, float64, float64, float64, _arrays.U8_GRID, _TABLES_OUT), cache=True, nogil=True)
def _fill_tables(points: Any, resolution: float, left: float, bottom: float, blur: Any, tables: Any) -> None:
    """Blur the points into the first table, and take the maxima of ever larger squares for the others."""
    _, height, width = tables.shape
    reach = blur.shape[0] // 2
    for i in range(points.shape[0]):
        column = math.floor((points[i, 0] - left) / resolution)
        row = math.floor((points[i, 1] - bottom) / resolution)
        for y in range(max(0, row - reach), min(height, row + reach + 1)):
            for x in range(max(0, column - reach), min(width, column + reach + 1)):
                tables[0, y, x] = max(tables[0, y, x], blur[y - row + reach, x - column + reach])
    for level in range(1, tables.shape[0]):
        step = 1 << (level - 1)
        for y in range(height):
            for x in range(width):
                value = tables[level - 1, y, x]
                if x + step < width:
                    value = max(value, tables[level - 1, y, x + step])
                if y + step < height:
                    value = max(value, tables[level - 1, y + step, x])
                    if x + step < width:
                        value = max(value, tables[level - 1, y + step, x + step])
                tables[level, y, x] = value


@njit(int64(_TABLES, int64, types.Array(types.int64, 2, "C"), int64, int64, int64), cache=True, nogil=True)
def _sum_at(tables: Any, level: int, cells: Any, angle: int, dx: int, dy: int) -> int:
    """Return the sum of a table at the cells (angles, 2 * points) of one angle, moved by dx and dy."""
    _, height, width = tables.shape
    count = cells.shape[1] // 2
    total = 0
    for i in range(count):
        x, y = cells[angle, i] + dx, cells[angle, count + i] + dy
        if 0 <= x < width and 0 <= y < height:
            total += int(tables[level, y, x])
    return total


@njit(
    int64(
        _TABLES, _arrays.F64_GRID, float64, float64, float64, float64, float64, _arrays.F64_FLAT, float64, float64,
        float64, float64, float64, _arrays.F64_FLAT, _arrays.I64_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _search(
    tables: Any,
    points: Any,
    x0: float,
    y0: float,
    theta0: float,
    half_x: float,
    half_y: float,
    turns: Any,
    resolution: float,
    left: float,
    bottom: float,
    least: float,
    doubt: float,
    excluded: Any,
    best_at: Any,
) -> int:
    """Write the best cell offsets and turn; return its sum, or -1 if no pose has more than `least` a point."""
    count, angles = points.shape[0], turns.size
    cells = np.empty((angles, 2 * count), np.int64)
    for a in range(angles):
        cos, sin = math.cos(theta0 + turns[a]), math.sin(theta0 + turns[a])
        for i in range(count):
            cells[a, i] = math.floor((x0 + cos * points[i, 0] - sin * points[i, 1] - left) / resolution)
            cells[a, count + i] = math.floor((y0 + sin * points[i, 0] + cos * points[i, 1] - bottom) / resolution)
    reach_x, reach_y, top = math.ceil(half_x / resolution), math.ceil(half_y / resolution), tables.shape[0] - 1
    step = 1 << top
    across, blocks = (2 * reach_x) // step + 1, ((2 * reach_x) // step + 1) * ((2 * reach_y) // step + 1)
    bounds = np.empty(angles * blocks, np.int64)
    for block in range(bounds.size):
        a, rest = block // blocks, block % blocks
        bounds[block] = _sum_at(
            tables, top, cells, a, -reach_x + (rest % across) * step, -reach_y + (rest // across) * step
        )
    best = math.floor(least * count)
    found = -1
    stack = np.empty((4 * (top + 2), 5), np.int64)
    sums = np.empty(4, np.int64)
    for block in np.argsort(-bounds, kind="mergesort"):
        if bounds[block] <= best:
            break
        rest = block % blocks
        stack[0, 0], stack[0, 1], stack[0, 4] = top, block // blocks, bounds[block]
        stack[0, 2], stack[0, 3] = -reach_x + (rest % across) * step, -reach_y + (rest // across) * step
        waiting = 1
        while waiting > 0:
            waiting -= 1
            level, a, bound = stack[waiting, 0], stack[waiting, 1], stack[waiting, 4]
            dx, dy = stack[waiting, 2], stack[waiting, 3]
            if bound <= best or dx > reach_x or dy > reach_y:  # the last blocks reach beyond what is searched
                continue
            if level == 0:
                turned = (theta0 + turns[a] - excluded[2] + math.pi) % (2.0 * math.pi) - math.pi
                away = math.hypot(x0 + dx * resolution - excluded[0], y0 + dy * resolution - excluded[1])
                if away <= excluded[3] and abs(turned) <= excluded[4]:
                    continue
                away = dx * dx / max(1, reach_x * reach_x) + dy * dy / max(1, reach_y * reach_y)
                value = bound - math.floor(doubt * count * away)
                if value > best:
                    best = found = value
                    best_at[0], best_at[1], best_at[2] = dx, dy, a
                continue
            part = 1 << (level - 1)
            for quarter in range(4):
                sums[quarter] = _sum_at(
                    tables, level - 1, cells, a, dx + part * (quarter & 1), dy + part * (quarter >> 1)
                )
            for quarter in np.argsort(sums, kind="mergesort"):  # the best last, and so looked at first
                if sums[quarter] > best:
                    stack[waiting, 0], stack[waiting, 1], stack[waiting, 4] = level - 1, a, sums[quarter]
                    stack[waiting, 2] = dx + part * (quarter & 1)
                    stack[waiting, 3] = dy + part * (quarter >> 1)
                    waiting += 1
    return found


@njit(void(_arrays.F64_GRID, float64, float64, int64, int64, _arrays.I64_OUT, _arrays.I64_OUT), cache=True, nogil=True)
def _sort_by_cell(points: Any, left: float, bottom: float, width: int, height: int, start: Any, order: Any) -> None:
    """Write the points' numbers cell by cell, and where in them each cell begins (one more than there are cells)."""
    count = points.shape[0]
    cell = np.empty(count, np.int64)
    for i in range(count):
        column, row = math.floor((points[i, 0] - left) / _CELL_M), math.floor((points[i, 1] - bottom) / _CELL_M)
        cell[i] = row * width + column
        start[cell[i] + 1] += 1
    for i in range(width * height):
        start[i + 1] += start[i]
    following = start.copy()
    for i in range(count):
        order[following[cell[i]]] = i
        following[cell[i]] += 1


@njit(
    void(
        _arrays.F64_GRID, _arrays.F64_GRID, _arrays.F64_GRID, _arrays.F64_GRID, _I64_FLAT, _I64_FLAT, float64, float64,
        int64, int64, _arrays.F64_FLAT, _arrays.F64_GRID, _arrays.F64_FLAT, float64, _arrays.F64_OUT, _F64_GRID_OUT,
        _arrays.F64_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _align(
    points: Any,
    normals: Any,
    reference: Any,
    reference_normals: Any,
    start: Any,
    order: Any,
    left: float,
    bottom: float,
    width: int,
    height: int,
    prior: Any,
    prior_information: Any,
    gates: Any,
    sigma: float,
    pose: Any,
    information: Any,
    figures: Any,
) -> None:
    """Refine `pose` in place, one step of Gauss and Newton for each gate; write share and residual of the last one."""
    slope = np.empty(3)
    count = points.shape[0]
    for gate in gates:
        information[:] = 0.0
        slope[:] = 0.0
        matched, weights, squares = 0, 0.0, 0.0
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        for i in range(count):
            along_x = cos * points[i, 0] - sin * points[i, 1]
            along_y = sin * points[i, 0] + cos * points[i, 1]
            x, y = pose[0] + along_x, pose[1] + along_y
            normal_x = cos * normals[i, 0] - sin * normals[i, 1]
            normal_y = sin * normals[i, 0] + cos * normals[i, 1]
            on_line = normal_x != 0.0 or normal_y != 0.0
            column, row = math.floor((x - left) / _CELL_M), math.floor((y - bottom) / _CELL_M)
            nearest, nearest_at = gate * gate, -1
            for r in range(max(0, row - 1), min(height, row + 2)):
                for c in range(max(0, column - 1), min(width, column + 2)):
                    for k in range(start[r * width + c], start[r * width + c + 1]):
                        j = order[k]
                        other_x, other_y = reference_normals[j, 0], reference_normals[j, 1]
                        if other_x == 0.0 and other_y == 0.0:
                            continue
                        if on_line and abs(normal_x * other_x + normal_y * other_y) < _PARALLEL:
                            continue
                        square = (reference[j, 0] - x) ** 2 + (reference[j, 1] - y) ** 2
                        if square < nearest:
                            nearest, nearest_at = square, j
            if nearest_at < 0:
                continue
            n_x, n_y = reference_normals[nearest_at, 0], reference_normals[nearest_at, 1]
            error = n_x * (x - reference[nearest_at, 0]) + n_y * (y - reference[nearest_at, 1])
            weight = 1.0 / (1.0 + (error / (_CAUCHY * sigma)) ** 2)
            by_turn = n_y * along_x - n_x * along_y
            scaled = weight / (sigma * sigma)
            information[0, 0] += scaled * n_x * n_x
            information[0, 1] += scaled * n_x * n_y
            information[0, 2] += scaled * n_x * by_turn
            information[1, 1] += scaled * n_y * n_y
            information[1, 2] += scaled * n_y * by_turn
            information[2, 2] += scaled * by_turn * by_turn
            slope[0] += scaled * n_x * error
            slope[1] += scaled * n_y * error
            slope[2] += scaled * by_turn * error
            matched += 1
            weights += weight
            squares += weight * error * error
        information[1, 0], information[2, 0] = information[0, 1], information[0, 2]
        information[2, 1] = information[1, 2]
        figures[0] = matched / max(count, 1)
        figures[1] = math.sqrt(squares / weights) if weights > 0.0 else 0.0
        off_x, off_y = pose[0] - prior[0], pose[1] - prior[1]
        turned = (pose[2] - prior[2] + math.pi) % (2.0 * math.pi) - math.pi
        for k in range(3):
            slope[k] += (
                prior_information[k, 0] * off_x + prior_information[k, 1] * off_y + prior_information[k, 2] * turned
            )
        # Cholesky's decomposition of what is 3 x 3, symmetric, and positive by the prior.
        l_xx = math.sqrt(information[0, 0] + prior_information[0, 0])
        l_yx = (information[1, 0] + prior_information[1, 0]) / l_xx
        l_yy = math.sqrt(information[1, 1] + prior_information[1, 1] - l_yx * l_yx)
        l_tx = (information[2, 0] + prior_information[2, 0]) / l_xx
        l_ty = (information[2, 1] + prior_information[2, 1] - l_yx * l_tx) / l_yy
        l_tt = math.sqrt(information[2, 2] + prior_information[2, 2] - l_tx * l_tx - l_ty * l_ty)
        low_x = -slope[0] / l_xx
        low_y = (-slope[1] - l_yx * low_x) / l_yy
        low_turn = (-slope[2] - l_tx * low_x - l_ty * low_y) / l_tt
        turn = low_turn / l_tt
        move_y = (low_y - l_ty * turn) / l_yy
        pose[0] += (low_x - l_yx * move_y - l_tx * turn) / l_xx
        pose[1] += move_y
        pose[2] += turn


@njit(
    void(
        _arrays.F64_GRID, float64, float64, float64, float64, float64, int64, _arrays.I32_GRID_OUT,
        _arrays.I32_GRID_OUT, _arrays.I32_GRID_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _count_beams(
    ends: Any, x: float, y: float, resolution: float, left: float, bottom: float, number: int, hits: Any, passes: Any,
    latest: Any,
) -> None:  # fmt: skip
    """Count a scan's beams; `latest` holds for each cell the scan that counted there last: 2 n passed, 2 n + 1 hit."""
    height, width = hits.shape
    for i in range(ends.shape[0]):
        column, row = math.floor((ends[i, 0] - left) / resolution), math.floor((ends[i, 1] - bottom) / resolution)
        if 0 <= column < width and 0 <= row < height and latest[row, column] < 2 * number + 1:
            hits[row, column] += 1
            latest[row, column] = 2 * number + 1
    for i in range(ends.shape[0]):
        dx, dy = ends[i, 0] - x, ends[i, 1] - y
        length = math.hypot(dx, dy)
        # The last cell before the end belongs to the wall.
        steps = math.ceil((length - resolution) / (0.5 * resolution))
        for k in range(steps):
            share = 0.5 * k * resolution / length
            column = math.floor((x + share * dx - left) / resolution)
            row = math.floor((y + share * dy - bottom) / resolution)
            if 0 <= column < width and 0 <= row < height and latest[row, column] < 2 * number:
                passes[row, column] += 1
                latest[row, column] = 2 * number


_NOTHING_EXCLUDED: Final = np.array((0.0, 0.0, 0.0, -1.0, -1.0))


def normals(points: NDArray[np.float64], reach: float) -> NDArray[np.float64]:
    """Return for each point (n, 2; m; in the order of their bearings) the unit normal of the line that it lies on.

    The line is that of up to ten points to both sides, `reach` (m) away at most, or to one where the wall has a step;
    zeros: there is none.
    """
    out = np.empty_like(points)
    _normals(np.ascontiguousarray(points), reach, out)
    return out


class Reference:
    """Points (n, 2; m) with their normals (n, 2; zeros: none), to which scans are matched."""

    def __init__(self, points: NDArray[np.float64], normals_: NDArray[np.float64], resolution: float = 0.05) -> None:
        """`resolution`: m per cell of the search. Raises `ValueError` without points."""
        if not len(points):
            raise ValueError("a reference needs points")
        self._points, self._normals = np.ascontiguousarray(points), np.ascontiguousarray(normals_)
        self._resolution = _arrays.positive(resolution, "resolution")
        low = points.min(axis=0) - _MARGIN_M
        self._left, self._bottom = float(low[0]), float(low[1])
        self._size = points.max(axis=0) + _MARGIN_M - low
        width, height = (np.ceil(self._size / _CELL_M).astype(np.int64) + 1).tolist()
        self._shape = width, height
        self._start, self._order = np.zeros(width * height + 1, np.int64), np.empty(len(points), np.int64)
        _sort_by_cell(self._points, self._left, self._bottom, width, height, self._start, self._order)
        self._tables: NDArray[np.uint8] | None = None

    def search(
        self,
        points: NDArray[np.float64],
        guess: tuple[float, float, float],
        half: float | tuple[float, float],
        half_turn: float,
        turn: float,
        least: float,
        excluded: Excluded | None = None,
        doubt: float = 0.0,
    ) -> Found | None:
        """Return the best pose of a scan's points (n, 2; m) near a guess; None if none has a score above `least`.

        Poses are looked at up to `half` (m; or one for each axis) away, by cells, and turned by `half_turn` (rad) at
        most, in steps of `turn`. doubt: what a pose loses of its score `half` away, nearer by the square of the
        distance: where several fit alike, as along a corridor, the guess is believed.
        """
        if self._tables is None:
            self._tables = self._blurred()
        half_x, half_y = half if isinstance(half, tuple) else (half, half)
        steps = math.ceil(half_turn / turn)
        turns = np.arange(-steps, steps + 1) * turn
        left, bottom = self._left - _PAD * self._resolution, self._bottom - _PAD * self._resolution
        without = _NOTHING_EXCLUDED if excluded is None else np.array((*excluded.pose, excluded.radius, excluded.angle))
        at = np.zeros(3, np.int64)
        total = _search(
            self._tables, points, *guess, half_x, half_y, turns, self._resolution, left, bottom, 255.0 * least,
            255.0 * doubt, without, at,
        )  # fmt: skip
        if total < 0:
            return None
        dx, dy, turned = (int(value) for value in at)
        x, y = guess[0] + dx * self._resolution, guess[1] + dy * self._resolution
        return Found((x, y, guess[2] + float(turns[turned])), total / (255.0 * len(points)))

    def align(
        self,
        points: NDArray[np.float64],
        normals_: NDArray[np.float64],
        pose: tuple[float, float, float],
        prior: tuple[float, float, float],
        information: NDArray[np.float64],
        gates: NDArray[np.float64],
        sigma: float = 0.03,
    ) -> Aligned:
        """Refine the pose of a scan's points from `pose` on, drawn to `prior` with an `information` (3, 3), not 0.

        gates: (k,) m, how far the nearest line may be in each step, 0.5 at most. sigma: m, of a point from its line.
        """
        refined, lines, figures = np.array(pose, np.float64), np.zeros((3, 3)), np.zeros(2)
        _align(
            points, normals_, self._points, self._normals, self._start, self._order, self._left, self._bottom,
            *self._shape, np.array(prior, np.float64), information, gates, sigma, refined, lines, figures,
        )  # fmt: skip
        x, y, theta = (float(value) for value in refined)
        return Aligned((x, y, theta), lines, float(figures[0]), float(figures[1]))

    def _blurred(self, sigma: float = 0.1) -> NDArray[np.uint8]:
        reach = int(3.0 * sigma / self._resolution)
        away = np.arange(-reach, reach + 1) * self._resolution
        blur = np.round(255.0 * np.exp(-0.5 * (away**2 + away[:, None] ** 2) / sigma**2)).astype(np.uint8)
        width, height = (np.ceil(self._size / self._resolution).astype(np.int64) + 1 + _PAD).tolist()
        tables = np.zeros((LEVELS, height, width), np.uint8)
        left, bottom = self._left - _PAD * self._resolution, self._bottom - _PAD * self._resolution
        _fill_tables(self._points, self._resolution, left, bottom, blur, tables)
        return tables


class BeamCounts:
    """How many scans' beams have passed each cell of a grid, and how many have ended in it."""

    def __init__(self, shape: tuple[int, int], resolution: float, left: float, bottom: float) -> None:
        """`shape`: rows and columns; `left` and `bottom`: the grid's corner (m)."""
        self.hits, self.passes = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        self._latest = np.full(shape, -1, np.int32)
        self._grid = resolution, left, bottom
        self._scans = 0

    def cells(self) -> NDArray[np.uint8]:
        """Return the map that the scans show: free, wall or unknown."""
        seen = self.hits + self.passes
        cells = np.full(seen.shape, UNKNOWN, np.uint8)
        cells[seen > 0] = FREE
        cells[self.hits >= np.maximum(1.0, _OCCUPIED_SHARE * seen)] = LETHAL
        return cells

    def take(self, others: BeamCounts, row: int, column: int) -> None:
        """Count all that a smaller grid has counted, whose first cell lies at this row and column of this one."""
        height, width = others.hits.shape
        inside = np.s_[row : row + height, column : column + width]
        self.hits[inside] += others.hits
        self.passes[inside] += others.passes

    def add(self, x: float, y: float, ends: NDArray[np.float64]) -> None:
        """Count a scan from (x, y), whose beams end at `ends` (n, 2; m): each cell once, as hit if any ended in it."""
        resolution, left, bottom = self._grid
        _count_beams(
            np.ascontiguousarray(ends), x, y, resolution, left, bottom, self._scans, self.hits, self.passes,
            self._latest,
        )  # fmt: skip
        self._scans += 1
