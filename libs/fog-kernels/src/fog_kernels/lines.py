"""Straight lines and paths made of them: integrals of the weight, shortcuts, how far lines part, nearest places.

Costs are integrated along lines of sight cell by cell (Amanatides and Woo 1987).

One module, although long: each kernel stands with the wrapper that checks its arrays.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call would cost
# more than its work.
# ruff: noqa: ANN401, C901, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import boolean, float64, int64, njit, void

from fog_contracts.costs import COST_WEIGHT, INSCRIBED, NEUTRAL_WEIGHT, PENALTY_MAX
from fog_kernels import _arrays
from fog_kernels.steps import DEFAULT_WEIGHTS, DIAGONAL, STRAIGHT, weights_of

if TYPE_CHECKING:
    from numpy.typing import NDArray


@njit(float64(_arrays.U8_GRID, _arrays.I32_FLAT, float64, float64, float64, float64, float64), cache=True, nogil=True)
def _line_cost(costmap: Any, weight: Any, x0: float, y0: float, x1: float, y1: float, limit: float) -> float:
    """Integrate the weight along a line in cell coordinates; infinite if blocked, or as soon as it exceeds limit."""
    height, width = costmap.shape
    x = math.floor(x0 + 0.5)
    y = math.floor(y0 + 0.5)
    last_x = math.floor(x1 + 0.5)
    last_y = math.floor(y1 + 0.5)
    if min(x, last_x) < 0 or max(x, last_x) >= width or min(y, last_y) < 0 or max(y, last_y) >= height:
        return math.inf
    dx = x1 - x0
    dy = y1 - y0
    length = math.sqrt(dx * dx + dy * dy)
    step_x = 1 if dx > 0.0 else -1
    step_y = 1 if dy > 0.0 else -1
    next_x = (x + 0.5 * step_x - x0) / dx if dx != 0.0 else math.inf
    next_y = (y + 0.5 * step_y - y0) / dy if dy != 0.0 else math.inf
    delta_x = abs(1.0 / dx) if dx != 0.0 else math.inf
    delta_y = abs(1.0 / dy) if dy != 0.0 else math.inf
    done = 0.0
    total = 0.0
    # Cells are counted instead of comparing parameters, so that rounding can't miss the last cell.
    left_x = abs(last_x - x)
    left_y = abs(last_y - y)
    while True:
        own = np.int64(weight[costmap[y, x]])
        if own == 0:
            return math.inf
        if left_x == 0 and left_y == 0:
            return total + max(1.0 - done, 0.0) * length * own
        corner = left_x > 0 and left_y > 0 and abs(next_x - next_y) < 1e-9
        if corner:
            # A corner may be crossed only where a diagonal step is allowed.
            if weight[costmap[y, x + step_x]] == 0 or weight[costmap[y + step_y, x]] == 0:
                return math.inf
            until = next_x
            x += step_x
            y += step_y
            next_x += delta_x
            next_y += delta_y
            left_x -= 1
            left_y -= 1
        elif left_y == 0 or (left_x > 0 and next_x < next_y):
            until = next_x
            x += step_x
            next_x += delta_x
            left_x -= 1
        else:
            until = next_y
            y += step_y
            next_y += delta_y
            left_y -= 1
        until = min(until, 1.0)
        total += (until - done) * length * own
        done = until
        if total > limit:
            return math.inf


@njit(
    float64(
        _arrays.U8_GRID, _arrays.I32_FLAT, _arrays.F64_GRID, _arrays.F64_FLAT, float64, float64, float64, float64
    ),
    cache=True, error_model="numpy",
)  # fmt: skip
def _cost_from(
    costmap: Any, weight: Any, points: Any, along: Any, begin: float, left: float, bottom: float, resolution: float
) -> float:
    """Integrate the weight along a line in metres from `begin` on; infinite if it is blocked."""
    after: Any = np.searchsorted(along, begin, side="right")
    if 0 < after < along.size:
        share = (begin - along[after - 1]) / (along[after] - along[after - 1])
        x = points[after - 1, 0] + share * (points[after, 0] - points[after - 1, 0])
        y = points[after - 1, 1] + share * (points[after, 1] - points[after - 1, 1])
    else:
        after = max(after, 1)
        x, y = points[after - 1, 0], points[after - 1, 1]
    x0, y0 = (x - left) / resolution - 0.5, (y - bottom) / resolution - 0.5
    total = 0.0
    for i in range(after, along.size):
        x1, y1 = (points[i, 0] - left) / resolution - 0.5, (points[i, 1] - bottom) / resolution - 0.5
        total += _line_cost(costmap, weight, x0, y0, x1, y1, math.inf)
        if math.isinf(total):
            break
        x0, y0 = x1, y1
    return total


@njit(float64(_arrays.U8_GRID, _arrays.I32_FLAT, _arrays.I32_PAIRS, _arrays.F64_OUT), cache=True, nogil=True)
def _cells_cost(costmap: Any, weight: Any, cells: Any, cumulated: Any) -> float:
    """Fill cumulated[i] with the cost from the first cell to cell i; infinite if a step isn't one of the grid's."""
    height, width = costmap.shape
    total = 0.0
    for i in range(cells.shape[0]):
        x = np.int64(cells[i, 0])
        y = np.int64(cells[i, 1])
        if x < 0 or x >= width or y < 0 or y >= height or weight[costmap[y, x]] == 0:
            return math.inf
        if i > 0:
            last_x = np.int64(cells[i - 1, 0])
            last_y = np.int64(cells[i - 1, 1])
            if abs(x - last_x) > 1 or abs(y - last_y) > 1:
                return math.inf
            if x != last_x and y != last_y:
                if weight[costmap[last_y, x]] == 0 or weight[costmap[y, last_x]] == 0:
                    return math.inf
                length = float(DIAGONAL)
            elif x != last_x or y != last_y:
                length = float(STRAIGHT)
            else:
                length = 0.0
            total += length * (np.int64(weight[costmap[y, x]]) + np.int64(weight[costmap[last_y, last_x]]))
        cumulated[i] = total / (2.0 * STRAIGHT)
    return total / (2.0 * STRAIGHT)


@njit(
    int64(_arrays.U8_GRID, _arrays.I32_FLAT, _arrays.I32_PAIRS, _arrays.F64_FLAT, _arrays.I64_OUT),
    cache=True,
    nogil=True,
)
def _shortcut(costmap: Any, weight: Any, cells: Any, cumulated: Any, kept: Any) -> int:
    """Keep cells between which straight lines cost no more than the path: exponential, then binary search."""
    last = cells.shape[0] - 1
    kept[0] = 0
    count = 1
    anchor = 0
    while anchor < last:
        good = anchor + 1
        stride = 2
        bad = last + 1
        while anchor + stride <= last or good < last:
            probe = min(anchor + stride, last)
            allowed = cumulated[probe] - cumulated[anchor] + 1e-9
            cost = _line_cost(
                costmap,
                weight,
                float(cells[anchor, 0]),
                float(cells[anchor, 1]),
                float(cells[probe, 0]),
                float(cells[probe, 1]),
                allowed,
            )
            if cost > allowed:
                bad = probe
                break
            good = probe
            if probe == last:
                break
            stride *= 2
        while bad - good > 1 and bad <= last:
            probe = (good + bad) // 2
            allowed = cumulated[probe] - cumulated[anchor] + 1e-9
            cost = _line_cost(
                costmap,
                weight,
                float(cells[anchor, 0]),
                float(cells[anchor, 1]),
                float(cells[probe, 0]),
                float(cells[probe, 1]),
                allowed,
            )
            if cost > allowed:
                bad = probe
            else:
                good = probe
        kept[count] = good
        count += 1
        anchor = good
    return count


_MOVES = np.array((4.0, 2.0, 1.0, 0.4))  # cells; 0.5 would lead to the border of two cells, which rounding crosses
_ROUNDS = 5


@njit(int64(_arrays.U8_GRID, _arrays.I32_FLAT, _arrays.F64_GRID_OUT), cache=True, nogil=True)
def _relax(costmap: Any, weight: Any, corners: Any) -> int:
    """Move each inner corner to the cheapest of the places around it, and leave out those that save nothing.

    Return how many are left, at the array's begin. Only corners next to one that has moved are looked at again.
    """
    count = corners.shape[0]
    costs = np.empty(count)
    for i in range(count - 1):
        costs[i] = _line_cost(
            costmap, weight, corners[i, 0], corners[i, 1], corners[i + 1, 0], corners[i + 1, 1], math.inf
        )
    due = np.empty(count, np.bool_)
    for move in _MOVES:
        due[:] = True
        for _ in range(_ROUNDS):
            changed = False
            i = 1
            while i < count - 1:
                if not due[i]:
                    i += 1
                    continue
                x0, y0, x1, y1 = corners[i - 1, 0], corners[i - 1, 1], corners[i + 1, 0], corners[i + 1, 1]
                best = costs[i - 1] + costs[i]
                straight = _line_cost(costmap, weight, x0, y0, x1, y1, best)
                if straight <= best:
                    count -= 1
                    corners[i:count] = corners[i + 1 : count + 1]
                    costs[i:count] = costs[i + 1 : count + 1]
                    due[i:count] = due[i + 1 : count + 1]
                    costs[i - 1] = straight
                    due[i - 1] = due[i] = changed = True
                    i = max(i - 1, 1)
                    continue
                x, y = corners[i, 0], corners[i, 1]
                due[i] = False
                for k in (0, 1, 2, 3, 5, 6, 7, 8):
                    to_x, to_y = x + move * (k % 3 - 1), y + move * (k // 3 - 1)
                    before = _line_cost(costmap, weight, x0, y0, to_x, to_y, best)
                    if before < best:
                        after = _line_cost(costmap, weight, to_x, to_y, x1, y1, best - before)
                        if before + after < best - 1e-3:
                            best = before + after
                            corners[i, 0], corners[i, 1], costs[i - 1], costs[i] = to_x, to_y, before, after
                            due[i - 1] = due[i] = due[i + 1] = changed = True
                i += 1
            if not changed:
                break
    return int(count)


@njit(void(_arrays.U8_GRID, _arrays.I32_PAIRS, int64, int64, _arrays.U8_GRID_OUT), cache=True, nogil=True)
def _raise_near(costmap: Any, cells: Any, reach: int, rise: int, raised: Any) -> None:
    """Raise the costs of traversable cells in squares around a path's cells, one of which in `reach` / 2 is enough."""
    height, width = costmap.shape
    for i in range(0, cells.shape[0], max(1, reach // 2)):
        for y in range(max(0, cells[i, 1] - reach), min(height, cells[i, 1] + reach + 1)):
            for x in range(max(0, cells[i, 0] - reach), min(width, cells[i, 0] + reach + 1)):
                if costmap[y, x] < INSCRIBED:
                    raised[y, x] = min(np.int64(costmap[y, x]) + rise, PENALTY_MAX)


@njit(boolean(_arrays.F64_GRID, _arrays.F64_GRID, float64, float64), cache=True, nogil=True, error_model="numpy")
def _leaves(line: Any, other: Any, reach: float, spacing: float) -> bool:
    """Whether a point of a line, sampled at most `spacing` apart, is farther than `reach` from another line."""
    nearest = 0
    last = max(other.shape[0] - 2, 0)
    for i in range(max(line.shape[0] - 1, 1)):
        end = min(i + 1, line.shape[0] - 1)
        dx = line[end, 0] - line[i, 0]
        dy = line[end, 1] - line[i, 1]
        samples = max(1, math.ceil(math.sqrt(dx * dx + dy * dy) / spacing))
        for k in range(samples + 1):
            x = line[i, 0] + dx * k / samples
            y = line[i, 1] + dy * k / samples
            found = False
            # The part that was near the last sample is looked at first.
            for turn in range(last + 1):
                j = (nearest + turn) % (last + 1)
                ahead = min(j + 1, other.shape[0] - 1)
                ex = other[ahead, 0] - other[j, 0]
                ey = other[ahead, 1] - other[j, 1]
                square = ex * ex + ey * ey
                along = 0.0
                if square > 0.0:
                    along = ((x - other[j, 0]) * ex + (y - other[j, 1]) * ey) / square
                along = min(max(along, 0.0), 1.0)
                off_x = x - other[j, 0] - along * ex
                off_y = y - other[j, 1] - along * ey
                if off_x * off_x + off_y * off_y <= reach * reach:
                    nearest = j
                    found = True
                    break
            if not found:
                return True
    return False


@njit(void(_arrays.F64_GRID, _arrays.F64_FLAT, int64, int64, float64, float64, _arrays.F64_OUT), cache=True, nogil=True)
def _nearest(points: Any, along: Any, first: int, last: int, x: float, y: float, found: Any) -> None:
    """Find where along the segments `first` to `last` (exclusive) the nearest place is, and its squared distance."""
    best = math.inf
    where = 0.0
    for i in range(first, last):
        delta_x = points[i + 1, 0] - points[i, 0]
        delta_y = points[i + 1, 1] - points[i, 1]
        square = delta_x * delta_x + delta_y * delta_y
        if not square > 0.0:
            continue  # a step of no length is no part of the line
        behind_x = x - points[i, 0]
        behind_y = y - points[i, 1]
        part = min(max((behind_x * delta_x + behind_y * delta_y) / square, 0.0), 1.0)
        gap_x = behind_x - part * delta_x
        gap_y = behind_y - part * delta_y
        gap = gap_x * gap_x + gap_y * gap_y
        if gap < best:
            best = gap
            where = along[i] + part * math.sqrt(square)
    found[0] = where
    found[1] = best


# It keeps the GIL: it takes some microseconds, and another thread may keep the GIL for longer before it gives it back.
@njit(
    void(_arrays.F64_GRID, _arrays.F64_FLAT, float64, float64, float64, float64, _arrays.F64_OUT),
    cache=True, error_model="numpy",
)  # fmt: skip
def nearest_place(points: Any, along: Any, low: float, high: float, x: float, y: float, found: Any) -> None:
    """Find where the nearest place is among those from `low` to `high` along the line, and its squared distance.

    Infinite without one. For other kernels; all others use `nearest_between`.
    """
    found[0] = 0.0
    found[1] = math.inf
    for i in range(points.shape[0] - 1):
        length = along[i + 1] - along[i]
        first = max(low - along[i], 0.0)
        last = min(high - along[i], length)
        if not length > 0.0 or first > last:
            continue
        unit_x = (points[i + 1, 0] - points[i, 0]) / length
        unit_y = (points[i + 1, 1] - points[i, 1]) / length
        behind_x = x - points[i, 0]
        behind_y = y - points[i, 1]
        part = min(max(behind_x * unit_x + behind_y * unit_y, first), last)
        gap_x = behind_x - part * unit_x
        gap_y = behind_y - part * unit_y
        gap = gap_x * gap_x + gap_y * gap_y
        if gap < found[1]:
            found[0] = along[i] + part
            found[1] = gap


@njit(
    float64(
        _arrays.F64_GRID, _arrays.F64_FLAT, float64, float64, float64, float64, float64, int64, int64, _arrays.U8_GRID
    ),
    cache=True, error_model="numpy",
)  # fmt: skip
def _first_inside(
    points: Any, along: Any, spacing: float, begin: float, left: float, bottom: float, resolution: float,
    column: int, row: int, mask: Any,
) -> float:  # fmt: skip
    """Return how far along the first sample from `begin` on is whose cell the mask has; infinite without one."""
    height, width = mask.shape
    for i in range(max(points.shape[0] - 1, 1)):
        end = min(i + 1, points.shape[0] - 1)
        if along[end] < begin:
            continue
        dx = points[end, 0] - points[i, 0]
        dy = points[end, 1] - points[i, 1]
        # A cell of margin: samples are rounded.
        if (
            max(points[i, 0], points[end, 0]) < left + (column - 1) * resolution
            or min(points[i, 0], points[end, 0]) > left + (column + width + 1) * resolution
            or max(points[i, 1], points[end, 1]) < bottom + (row - 1) * resolution
            or min(points[i, 1], points[end, 1]) > bottom + (row + height + 1) * resolution
        ):
            continue
        count = max(1, math.ceil(math.hypot(dx, dy) / spacing))
        for k in range(0 if i == 0 else 1, count + 1):
            share = k / count
            where = along[i] + share * (along[end] - along[i])
            if where < begin:
                continue
            x = points[end, 0] if k == count else points[i, 0] + share * dx
            y = points[end, 1] if k == count else points[i, 1] + share * dy
            to_right = math.floor((x - left) / resolution) - column
            up = math.floor((y - bottom) / resolution) - row
            if 0 <= to_right < width and 0 <= up < height and mask[up, to_right]:
                return float(where)
    return math.inf


@njit(
    int64(_arrays.F64_GRID, int64, int64, _arrays.F64_GRID, float64, float64),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _first_near(line: Any, first: int, last: int, other: Any, reach: float, spacing: float) -> int:
    """Find the first of the points `first` to `last` (exclusive) of a line within `reach` of a point of another one."""
    i = first
    while i < last:
        spare = math.inf
        j = 0
        while j < other.shape[0]:
            dx = line[i, 0] - other[j, 0]
            dy = line[i, 1] - other[j, 1]
            beyond = math.sqrt(dx * dx + dy * dy) - reach
            if beyond <= 0.0:
                return i
            # What is skipped is farther off than half of it.
            spare = min(spare, 0.5 * beyond)
            j += max(1, int(0.5 * beyond / spacing))
        i += max(1, int(min(spare, 1e9) / spacing))
    return -1


@njit(
    void(_arrays.F64_GRID, int64, int64, _arrays.F64_GRID, float64, float64, boolean[::1]),
    cache=True,
    nogil=True,
    error_model="numpy",
)
def _mark_near(line: Any, first: int, last: int, other: Any, reach: float, spacing: float, marked: Any) -> None:
    """Mark all points `first` to `last` (exclusive) of a line within `reach` of a point of another one."""
    i = first
    while i < last:
        spare = math.inf
        j = 0
        near = marked[i]
        while not near and j < other.shape[0]:
            dx = line[i, 0] - other[j, 0]
            dy = line[i, 1] - other[j, 1]
            beyond = math.sqrt(dx * dx + dy * dy) - reach
            near = beyond <= 0.0
            # What is skipped is farther off than half of it.
            spare = min(spare, 0.5 * beyond)
            j += max(1, int(0.5 * beyond / spacing))
        marked[i] = near
        i += 1 if near else max(1, int(min(spare, 1e9) / spacing))


def _cells_array(cells: NDArray[np.int32]) -> NDArray[np.int32]:
    _arrays.exact(cells, np.int32, 2, "cells")
    if cells.shape[0] == 0 or cells.shape[1] != 2:
        raise ValueError(f"cells must have shape (n, 2) with n >= 1, not {cells.shape}")
    return cells


def _check_line(points: NDArray[np.float64], along: NDArray[np.float64]) -> None:
    _arrays.exact(points, np.float64, 2, "points")
    _arrays.exact(along, np.float64, 1, "along")
    if points.shape != (along.size, 2):
        raise ValueError(f"points must have shape ({along.size}, 2), one for each entry of along, not {points.shape}")


def line_cost(
    costmap: NDArray[np.uint8],
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    neutral: int = NEUTRAL_WEIGHT,
    factor: float = COST_WEIGHT,
) -> float:
    """Return the integral of the weight along a straight line, in cells times weight.

    Coordinates are columns and rows, whole numbers being the centres of cells. Infinite when the line crosses a cell
    that isn't traversable, cuts a corner that a diagonal step may not cut, or leaves the grid.
    Raises TypeError or ValueError for a costmap of another type or shape.
    """
    costmap = _arrays.grid(costmap, "costmap")
    weight = weights_of(neutral, factor)
    return float(_line_cost(costmap, weight, float(x0), float(y0), float(x1), float(y1), math.inf))


def cost_from(
    costmap: NDArray[np.uint8],
    points: NDArray[np.float64],
    along: NDArray[np.float64],
    begin: float,
    grid: tuple[float, float, float],
) -> float:
    """Return the sum of `line_cost`, with the weights of the default, over a polyline's lines from `begin` (m) on.

    points: float64 (n, 2), m, n >= 1. along: float64 (n,), m from the first point along the line. `grid`: x and y (m)
    of the costmap's lower left corner, and its resolution (m). Raises TypeError or ValueError for other arrays.
    """
    costmap = _arrays.grid(costmap, "costmap")
    _check_line(points, along)
    if along.size == 0:
        raise ValueError("the line has no point")
    left, bottom, resolution = grid
    return float(_cost_from(costmap, DEFAULT_WEIGHTS, points, along, float(begin), left, bottom, resolution))


def shortcut(
    costmap: NDArray[np.uint8],
    cells: NDArray[np.int32],
    neutral: int = NEUTRAL_WEIGHT,
    factor: float = COST_WEIGHT,
    *,
    relax: bool = True,
) -> NDArray[np.float64]:
    """Straighten a path along lines of sight that cost no more than the sections that they replace.

    Then, with `relax`, the corners are moved where the lines cost less, because a path of 8 directions keeps to one
    side of what it passes. `cells` is int32 (n, 2) as (column, row), a path of `Planner.plan` on this costmap. Returns
    float64 (m, 2) in the same coordinates, the first and last cell kept: corners joined by straight lines, none of
    which crosses a cell that isn't traversable. Raises ValueError if the path itself crosses one or isn't connected,
    TypeError or ValueError for wrong types or shapes.
    """
    costmap = _arrays.grid(costmap, "costmap")
    cells = _cells_array(cells)
    weight = weights_of(neutral, factor)
    cumulated = np.empty(len(cells))
    if not math.isfinite(_cells_cost(costmap, weight, cells, cumulated)):
        raise ValueError("cells aren't a path on this costmap: plan again before straightening")
    kept = np.empty(len(cells), np.int64)
    count = int(_shortcut(costmap, weight, cells, cumulated, kept))
    corners = cells[kept[:count]].astype(np.float64)
    return corners[: _relax(costmap, weight, corners)].copy() if relax else corners


def raised_near(costmap: NDArray[np.uint8], cells: NDArray[np.int32], reach: int, rise: int) -> NDArray[np.uint8]:
    """Return a copy of a uint8 (h, w) costmap, dearer by `rise` within some `reach` cells of a path's cells.

    What is traversable stays so, and nothing else becomes it. `cells` is int32 (n, 2) as (column, row), all on the
    grid. Raises TypeError or ValueError for other types or shapes, or a `reach` or `rise` below 0.
    """
    if min(reach, rise) < 0:
        raise ValueError(f"reach and rise must be at least 0, not {reach} and {rise}")
    raised = _arrays.grid(costmap, "costmap").copy()
    _raise_near(costmap, _cells_array(cells), reach, rise, raised)
    return raised


def leaves(line: NDArray[np.float64], other: NDArray[np.float64], reach: float, spacing: float) -> bool:
    """Return whether a line leaves another one by more than `reach` somewhere.

    Both are float64 (n, 2), n >= 1, points joined by straight lines, in one unit with `reach` and `spacing`. The line's
    corners are looked at, and points between them at most `spacing` apart. Raises TypeError or ValueError for arrays of
    another type or shape.
    """
    for points, name in ((line, "line"), (other, "other")):
        _arrays.exact(points, np.float64, 2, name)
        if len(points) == 0 or points.shape[1] != 2:
            raise ValueError(f"{name} must have shape (n, 2) with n >= 1, not {points.shape}")
    return bool(_leaves(line, other, reach, _arrays.positive(spacing, "spacing")))


def first_inside(
    points: NDArray[np.float64],
    along: NDArray[np.float64],
    spacing: float,
    begin: float,
    grid: tuple[float, float, float],
    place: tuple[int, int],
    mask: NDArray[np.bool_],
) -> float:
    """Return how far along a polyline (m) its first sample lies in a cell of a mask; infinity if none does.

    points: float64 (n, 2), m, n >= 1. along: float64 (n,), m from the first point along the line. Samples are at most
    `spacing` (m) apart, as `fog_contracts.geometry.sampled` makes them; those before `begin` (m) are left out. `grid`:
    x and y (m) of its lower left corner, and its resolution (m). `place`: the column and row where the mask (h, w)
    begins. Raises TypeError or ValueError for other types or shapes.
    """
    _check_line(points, along)
    if along.size == 0:
        raise ValueError("the line has no point")
    left, bottom, resolution = grid
    cells = _arrays.grid(mask, "mask")
    spacing = _arrays.positive(spacing, "spacing")
    return float(
        _first_inside(points, along, spacing, float(begin), left, bottom, resolution, place[0], place[1], cells)
    )


def first_near(
    line: NDArray[np.float64], first: int, last: int, other: NDArray[np.float64], reach: float, spacing: float
) -> int:
    """Return the first of the points `first` to `last` (exclusive) of a line within `reach` of another's; -1: none is.

    Both are float64 (n, 2), points at most `spacing` apart, in one unit with `reach`. Points that can't be near are
    skipped, so that lines far apart cost little. Raises ValueError for points that the line does not have.
    """
    if not 0 <= first <= last <= len(line):
        raise ValueError(f"points {first} to {last} are not among the {len(line)} of the line")
    return int(_first_near(line, first, last, other, reach, spacing))


def mark_near(
    line: NDArray[np.float64],
    first: int,
    last: int,
    other: NDArray[np.float64],
    reach: float,
    spacing: float,
    marked: NDArray[np.bool_],
) -> None:
    """Mark all points `first` to `last` (exclusive) of a line that are within `reach` of another's points.

    As `first_near`; `marked` (len(line),) keeps the marks that it has. Raises ValueError for points that the line does
    not have, or marks of another length.
    """
    if not 0 <= first <= last <= len(line) == len(marked):
        raise ValueError(f"points {first} to {last} are not among the {len(line)} of the line, or {len(marked)} marks")
    _mark_near(line, first, last, other, reach, spacing, marked)


def nearest_between(
    points: NDArray[np.float64], along: NDArray[np.float64], low: float, high: float, x: float, y: float
) -> tuple[float, float]:
    """Return how far along a polyline (m) its nearest place to (x, y) is, and its distance (m; inf: there is none).

    As `nearest_on`, but only places from `low` to `high` (m) along the line are looked at.
    """
    _check_line(points, along)
    found = np.empty(2)
    nearest_place(points, along, float(low), float(high), float(x), float(y), found)
    return float(found[0]), math.sqrt(found[1])


def nearest_on(
    points: NDArray[np.float64], along: NDArray[np.float64], first: int, last: int, x: float, y: float
) -> tuple[float, float]:
    """Return how far along a polyline (m) its nearest place to (x, y) is, and its distance (m; inf: there is none).

    points: float64 (n, 2), m. along: float64 (n,), m from the first point along the line. Only the segments from
    `first` up to `last`, without it, are looked at; the first of several places counts. Raises TypeError or ValueError
    for other types or shapes, or segments that the line does not have.
    """
    _check_line(points, along)
    if not 0 <= first <= last <= max(along.size - 1, 0):
        raise ValueError(f"segments {first} to {last} are not among the {along.size - 1} of the line")
    found = np.empty(2)
    _nearest(points, along, first, last, float(x), float(y), found)
    return float(found[0]), math.sqrt(found[1])
