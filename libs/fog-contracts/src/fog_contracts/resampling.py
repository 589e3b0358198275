"""Grids moved onto other grids: rotated, shifted, finer or coarser, without losing an obstacle."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from fog_contracts.costs import LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap

_BAND_CELLS: Final = 128 * 1024
"""About how many cells are converted at a time."""


def resampled(
    original: StaticMap,
    yaw: float = 0.0,
    origin: tuple[float, float] | None = None,
    *,
    resolution: float | None = None,
    aligned_to: GridGeometry | None = None,
) -> StaticMap:
    """Return a grid that is rotated about its lower-left corner (rad), which lies at `origin` (m) then.

    The new grid holds all of the old one, along the frame's axes: its first cell lies at its own corner, or where
    `aligned_to` has cells (with the resolution of that). A cell is what the old grid has at its centre, or unknown;
    but where an occupied one has its centre it is occupied, so that none is lost.
    """
    old = original.geometry
    new_x, new_y = (old.origin_x, old.origin_y) if origin is None else origin
    size = aligned_to.resolution if aligned_to is not None else resolution or old.resolution
    cos, sin = math.cos(yaw), math.sin(yaw)
    wide, high = old.width * old.resolution, old.height * old.resolution
    corners = [(x * cos - y * sin, x * sin + y * cos) for x, y in ((0.0, 0.0), (wide, 0.0), (0.0, high), (wide, high))]
    left, bottom = min(x for x, _ in corners), min(y for _, y in corners)
    right, top = max(x for x, _ in corners), max(y for _, y in corners)
    first_x, first_y = new_x + left, new_y + bottom
    if aligned_to is not None:
        first_x, first_y = (
            base + size * math.floor((value - base) / size + 1e-6)
            for value, base in ((first_x, aligned_to.origin_x), (first_y, aligned_to.origin_y))
        )
        left, bottom = first_x - new_x, first_y - new_y
    # The tolerance keeps quarter turns exact: rounding must not add an empty row.
    width = max(1, math.ceil((right - left) / size - 1e-6))
    height = max(1, math.ceil((top - bottom) / size - 1e-6))
    new = GridGeometry(width, height, size, first_x, first_y)

    cells = np.full((height, width), UNKNOWN, dtype=np.uint8)
    for rows in _bands(height, width):
        x, y = np.meshgrid(
            left + (np.arange(width) + 0.5) * size, bottom + (np.arange(rows.start, rows.stop) + 0.5) * size
        )
        column = np.floor((x * cos + y * sin) / old.resolution).astype(np.int64)
        row = np.floor((-x * sin + y * cos) / old.resolution).astype(np.int64)
        inside = (column >= 0) & (column < old.width) & (row >= 0) & (row < old.height)
        cells[rows][inside] = original.cells[row[inside], column[inside]]

    # An occupied cell may contain none of the new centres: mark also the cell that contains its own centre.
    for band in _bands(*old.shape):
        occupied_rows, columns = np.nonzero(original.cells[band] == LETHAL)
        px, py = (columns + 0.5) * old.resolution, (occupied_rows + band.start + 0.5) * old.resolution
        new_column = np.floor((px * cos - py * sin - left) / size).astype(np.int64)
        new_row = np.floor((px * sin + py * cos - bottom) / size).astype(np.int64)
        cells[np.clip(new_row, 0, height - 1), np.clip(new_column, 0, width - 1)] = LETHAL
    return StaticMap(new, cells)


def _bands(height: int, width: int) -> Iterator[slice]:
    """Return slices of consecutive rows of about _BAND_CELLS cells each."""
    rows = max(1, _BAND_CELLS // width)
    return (slice(first, min(first + rows, height)) for first in range(0, height, rows))
