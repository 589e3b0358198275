"""Exact distances around the robot to everything that it knows: lethal cells of the map, and points of its lidar.

Lethal cells are solid squares and lidar points are points, whatever the grid's resolution: the distance at a cell's
centre is exact, so bilinear interpolation between centres is off by a millimetre where it matters, and no padding for
the rounding to cells is needed.
"""

# Kernels take arrays and scalars, typed by their compiled signatures, and are single functions where a call per cell
# would cost more than its work.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numba import float64, int64, njit, void

from fog_contracts.costs import INSCRIBED, LETHAL, PENALTY_MAX, UNKNOWN, Inflation
from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from fog_kernels.robot import Body, DwaLimits, DwaSettings

NEAR: Final = PENALTY_MAX
"""Marks cells where only the distance at the exact position tells whether the body is free."""
_FINER: Final = 2
"""Cells of the field per cell of the map, along each axis."""
_TABLE: Final = 256
"""Entries of the table of costs by distance."""


class Clearance(NamedTuple):
    """A square window around the robot, aligned with the map's cells and `_FINER` times as fine.

    `cost`: uint8 (n, n); 0..251 a free place and its cost, NEAR for a place to be judged by its distance, INSCRIBED
    where the body is certain to be nearer than the padding or the map says so, LETHAL and UNKNOWN as in the map; beyond
    the map UNKNOWN. `distance`: float32 (n, n), m from a cell's centre to the nearest thing, capped.
    `resolution`: m per cell; the window's lower-left corner lies at (origin_x, origin_y) in `map`.
    """

    cost: NDArray[np.uint8]
    distance: NDArray[np.float32]
    resolution: float
    origin_x: float
    origin_y: float


# Inlined before compilation: passing an array to a compiled function costs reference counting at each call.
_helper = njit(inline="always", cache=True)


@_helper
def _mark(squares: Any, across: Any, x: float, y: float, half: float, reach: float, fine: float) -> None:
    """Lower the squared distances around a square (centre x, y and half its side, m from the first cell's corner).

    `across`: float32 (n,) of scratch. The distance to a square is that to a point, less half a side along each axis.
    """
    size = squares.shape[0]
    begin = max(math.ceil((x - half - reach) / fine - 0.5), 0)
    end = min(math.floor((x + half + reach) / fine - 0.5) + 1, size)
    low = max(math.ceil((y - half - reach) / fine - 0.5), 0)
    high = min(math.floor((y + half + reach) / fine - 0.5) + 1, size)
    if begin < end and low < high:
        part = across[begin:end]
        for k in range(part.size):
            off = max(abs((begin + k + 0.5) * fine - x) - half, 0.0)
            part[k] = off * off
        for row in range(low, high):
            off = max(abs((row + 0.5) * fine - y) - half, 0.0)
            square = np.float32(off * off)
            line = squares[row, begin:end]
            for k in range(line.size):
                line[k] = min(line[k], part[k] + square)


@_helper
def _is_amid(costmap: Any, row: int, column: int) -> bool:
    """Return whether all four neighbours are lethal: such a cell is nearest to nothing but itself."""
    height, width = costmap.shape
    amid: bool = (
        0 < row < height - 1
        and 0 < column < width - 1
        and costmap[row - 1, column] == LETHAL
        and costmap[row + 1, column] == LETHAL
        and costmap[row, column - 1] == LETHAL
        and costmap[row, column + 1] == LETHAL
    )
    return amid


@_helper
def _grade(
    costmap: Any,
    first_column: int,
    first_row: int,
    reach: float,
    blocked: float,
    free: float,
    table: Any,
    cost: Any,
    distance: Any,
) -> None:
    """Turn squared distances into distances, and set each cell's cost."""
    height, width = costmap.shape
    size = cost.shape[0]
    scale = (table.size - 1) / reach
    for row in range(size):
        r = first_row + row // _FINER
        for column in range(size):
            c = first_column + column // _FINER
            here = UNKNOWN
            if 0 <= r < height and 0 <= c < width:
                here = int(costmap[r, c])
            away = 0.0 if here == LETHAL else math.sqrt(distance[row, column])
            distance[row, column] = away
            if here < INSCRIBED:
                if away < blocked:
                    here = INSCRIBED
                elif away < free:
                    here = NEAR
                else:
                    here = max(min(here, NEAR - 1), int(table[int(away * scale)]))
            cost[row, column] = here


@njit(
    void(
        _arrays.U8_GRID, float64, float64, float64, _arrays.F64_GRID, int64, int64, float64, float64, float64,
        _arrays.U8_FLAT, _arrays.U8_GRID_OUT, _arrays.F32_GRID_OUT,
    ),
    cache=True,
    nogil=True,
)  # fmt: skip
def _clearance(
    costmap: Any,
    resolution: float,
    origin_x: float,
    origin_y: float,
    points: Any,
    first_column: int,
    first_row: int,
    reach: float,
    blocked: float,
    free: float,
    table: Any,
    cost: Any,
    distance: Any,
) -> None:
    """Fill `cost` and `distance` (see `Clearance`); their first cell lies in this column and row of the costmap.

    Nearer than `blocked` (m) the body is certain to be too near to something, farther than `free` it certainly isn't.
    `table`: cost by distance, from 0 to `reach` (m), which caps the distances.
    """
    height, width = costmap.shape
    size = cost.shape[0]
    fine = resolution / _FINER
    left = origin_x + first_column * resolution
    bottom = origin_y + first_row * resolution
    across = np.empty(size, np.float32)
    distance[:, :] = np.float32(reach * reach)
    beyond = size * fine + reach
    for i in range(points.shape[0]):
        x, y = points[i, 0] - left, points[i, 1] - bottom
        if -reach <= x <= beyond and -reach <= y <= beyond:
            _mark(distance, across, x, y, 0.0, reach, fine)
    around = math.ceil(reach / resolution)
    side = size // _FINER
    for r in range(max(first_row - around, 0), min(first_row + side + around, height)):
        for c in range(max(first_column - around, 0), min(first_column + side + around, width)):
            if costmap[r, c] == LETHAL and not _is_amid(costmap, r, c):
                x = (c - first_column + 0.5) * resolution
                y = (r - first_row + 0.5) * resolution
                _mark(distance, across, x, y, 0.5 * resolution, reach, fine)

    _grade(costmap, first_column, first_row, reach, blocked, free, table, cost, distance)


@lru_cache(maxsize=8)
def _cost_table(inflation: Inflation, inscribed: float, reach: float) -> NDArray[np.uint8]:
    """Return the cost by distance, from 0 to `reach` (m): the map's exponential decay from the inscribed radius on."""
    away = np.linspace(0.0, reach, _TABLE)
    decay = np.exp(-inflation.cost_scaling * np.maximum(away - inscribed, 0.0))
    table = np.where(away < inflation.inflation_radius, (NEAR - 1) * decay, 0.0).astype(np.uint8)
    table.setflags(write=False)
    return table


def sampling_slack(body: Body, cell: float, limits: DwaLimits, settings: DwaSettings) -> float:
    """Return how much (m) nearer a body may come between the places where its distances are looked up.

    Places on an arc are `dt` apart: between two of them, a disc that keeps a distance at both comes nearer by the
    sagitta of the chord, and of the arc. Between the centres of cells (`cell`: m) distances are interpolated, and a
    distance to a point at d grows by up to cell^2 / 4d more slowly than the straight line.
    """
    near = body.inscribed + settings.padding
    step = limits.v_max * settings.dt
    # On an arc v * w is highest with half of the wheels' speed each for driving and turning.
    bend = limits.wheel_max**2 / (2.0 * limits.axle) * settings.dt**2
    return step**2 / (8.0 * near) + bend / 8.0 + cell**2 / (4.0 * near)


def clearance(
    costmap: NDArray[np.uint8],
    resolution: float,
    origin_x: float,
    origin_y: float,
    points: ArrayLike,
    x: float,
    y: float,
    body: Body,
    inflation: Inflation,
    limits: DwaLimits,
    settings: DwaSettings,
    *,
    at_least: float = 0.0,
) -> Clearance:
    """Return the distances around a robot at (x, y), as far as its arcs can reach, and `at_least` (m) to each side.

    `costmap`: uint8 (h, w) around the robot, row 0 at the bottom, its lower-left corner at (origin_x, origin_y) in
    `map`, `resolution` m per cell. `points`: (n, 2) m in `map`, what the lidar sees. `inflation` grades free places by
    their distance from the nearest thing; its inscribed radius is the body's.
    Raises TypeError or ValueError for wrong types or shapes, and ValueError for points that aren't finite.
    """
    costmap = _arrays.grid(costmap, "costmap")
    resolution = _arrays.positive(resolution, "resolution")
    seen = np.ascontiguousarray(points, dtype=np.float64).reshape(-1, 2)
    if not (np.isfinite(seen).all() and math.isfinite(x) and math.isfinite(y)):
        raise ValueError("points and position must be finite: leave out beams without an echo")
    fine = resolution / _FINER
    slack = sampling_slack(body, fine, limits, settings)
    diagonal = fine * math.sqrt(0.5)
    blocked = body.inscribed + settings.padding - diagonal
    free = body.circumscribed + settings.padding + slack + diagonal
    reach = max(inflation.inflation_radius, free + fine)
    escape = _escape_reach(settings)
    span = max(limits.v_max * settings.horizon(limits), escape) + (body.circumscribed if len(body.discs) else 0.0)
    cells = math.ceil(max(span, at_least) / resolution) + 1
    first_column = math.floor((x - origin_x) / resolution) - cells
    first_row = math.floor((y - origin_y) / resolution) - cells
    size = _FINER * (2 * cells + 1)
    cost = np.empty((size, size), np.uint8)
    distance = np.empty((size, size), np.float32)
    _clearance(
        costmap, resolution, origin_x, origin_y, seen, first_column, first_row, reach,
        blocked, free, _cost_table(inflation, body.inscribed, reach), cost, distance,
    )  # fmt: skip
    return Clearance(cost, distance, fine, origin_x + first_column * resolution, origin_y + first_row * resolution)


def _escape_reach(settings: DwaSettings) -> float:
    """Return how far (m) an escaping arc leads."""
    return max(settings.escape_v * settings.sim_time, 0.3)
