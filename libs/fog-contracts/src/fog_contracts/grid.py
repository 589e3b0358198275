"""A grid in the frame `map`: its geometry, metres on one side and cells on the other, and how layers on it combine."""

import math
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import LETHAL, NO_SPEED_LIMIT, UNKNOWN

Scalar = TypeVar("Scalar", bound=np.generic)


class Window(NamedTuple):
    """A rectangle of cells: columns x..x+width-1, rows y..y+height-1, row 0 at the bottom."""

    x: int
    y: int
    width: int
    height: int

    @property
    def rows(self) -> slice:
        """The rows as an index of an array of shape (height, width)."""
        return slice(self.y, self.y + self.height)

    @property
    def columns(self) -> slice:
        """The columns as an index of an array of shape (height, width)."""
        return slice(self.x, self.x + self.width)

    @property
    def empty(self) -> bool:
        """Whether the window holds no cell."""
        return self.width <= 0 or self.height <= 0

    def union(self, other: "Window") -> "Window":
        """Return the smallest window that holds both."""
        if self.empty:
            return other
        if other.empty:
            return self
        x, y = min(self.x, other.x), min(self.y, other.y)
        right = max(self.x + self.width, other.x + other.width)
        top = max(self.y + self.height, other.y + other.height)
        return Window(x, y, right - x, top - y)

    def intersection(self, other: "Window") -> "Window":
        """Return the window of the cells that are in both; it may be empty."""
        x, y = max(self.x, other.x), max(self.y, other.y)
        right = min(self.x + self.width, other.x + other.width)
        top = min(self.y + self.height, other.y + other.height)
        return Window(x, y, max(right - x, 0), max(top - y, 0))

    def grown(self, cells: int) -> "Window":
        """Return the window with a margin of `cells` on every side."""
        return Window(self.x - cells, self.y - cells, self.width + 2 * cells, self.height + 2 * cells)


class GridGeometry(msgspec.Struct, frozen=True):
    """Size, resolution (m per cell) and origin (m, lower-left corner of cell (0, 0), frame `map`) of a grid.

    Arrays over it are row-major with shape (height, width); row 0 is at the bottom. The grid is aligned with the
    frame: the yaw of a map_server origin is resolved when the map is loaded.
    """

    width: int
    height: int
    resolution: float
    origin_x: float
    origin_y: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a grid needs at least one cell, not {self.width} x {self.height}")
        if not (math.isfinite(self.resolution) and self.resolution > 0):
            raise ValueError(f"resolution must be a positive number of metres per cell, not {self.resolution}")
        if not (math.isfinite(self.origin_x) and math.isfinite(self.origin_y)):
            raise ValueError(f"origin must be finite, not ({self.origin_x}, {self.origin_y})")

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of an array over this grid: (height, width)."""
        return self.height, self.width

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Extent in metres: (left, bottom, right, top)."""
        right = self.origin_x + self.width * self.resolution
        top = self.origin_y + self.height * self.resolution
        return self.origin_x, self.origin_y, right, top

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """Cell (column, row) that holds the point (x, y) in metres; it may lie outside the grid."""
        column = math.floor((x - self.origin_x) / self.resolution)
        row = math.floor((y - self.origin_y) / self.resolution)
        return column, row

    def centre(self, column: int, row: int) -> tuple[float, float]:
        """Centre (m) of a cell."""
        return self.origin_x + (column + 0.5) * self.resolution, self.origin_y + (row + 0.5) * self.resolution

    def cells(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the cells that hold `points` ((n, 2), m), and which of them the grid has.

        Cells are int64 (n, 2), each (column, row); the mask is (n,). A cell whose mask is False must not be used as an
        index: it lies outside the grid.
        """
        scaled = (
            np.asarray(points, dtype=np.float64).reshape(-1, 2) - (self.origin_x, self.origin_y)
        ) / self.resolution
        cells = np.floor(scaled).astype(np.int64)
        columns, rows = cells[:, 0], cells[:, 1]
        # One column after the other: numpy takes several times as long for the same along rows of two.
        inside: NDArray[np.bool_] = (columns >= 0) & (columns < self.width) & (rows >= 0) & (rows < self.height)
        return cells, inside

    def grid_coordinates(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where `points` ((n, 2), m) lie in columns and rows (float64 (n, 2)), centres being whole numbers."""
        origin = np.array((self.origin_x, self.origin_y))
        coordinates: NDArray[np.float64] = (np.asarray(points).reshape(-1, 2) - origin) / self.resolution - 0.5
        return coordinates

    def centres(self, cells: NDArray[np.integer | np.floating]) -> NDArray[np.float64]:
        """Return the centres (float64 (n, 2), m) of cells ((n, 2), each (column, row)); inverts `grid_coordinates`."""
        origin = np.array((self.origin_x, self.origin_y))
        centres: NDArray[np.float64] = origin + (np.asarray(cells).reshape(-1, 2) + 0.5) * self.resolution
        return centres

    def sample(self, grid: NDArray[Scalar], points: NDArray[np.float64], outside: float) -> NDArray[Scalar]:
        """Return the values ((n,)) of `grid` (height, width) at `points` ((n, 2), m); `outside` where it has none."""
        cells, inside = self.cells(points)
        values = np.full(len(cells), outside, dtype=grid.dtype)
        values[inside] = grid[cells[inside, 1], cells[inside, 0]]
        return values

    def axes(self, window: Window) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the x ((width,), m) of the centres of a window's columns, and the y ((height,), m) of its rows."""
        columns = np.arange(window.x, window.x + window.width, dtype=np.float64)
        rows = np.arange(window.y, window.y + window.height, dtype=np.float64)
        xs = self.origin_x + (columns + 0.5) * self.resolution
        ys = self.origin_y + (rows + 0.5) * self.resolution
        return xs, ys

    def contains_cell(self, column: int, row: int) -> bool:
        """Whether the grid has this cell."""
        return 0 <= column < self.width and 0 <= row < self.height

    def contains(self, x: float, y: float) -> bool:
        """Whether the point (x, y) in metres lies on the grid."""
        return self.contains_cell(*self.cell(x, y))

    def clip(self, window: Window) -> Window:
        """Return the part of a window that lies on the grid; it may be empty."""
        return self.whole.intersection(window)

    def window_around(self, left: float, bottom: float, right: float, top: float) -> Window:
        """Return the cells that a rectangle in metres touches, clipped to the grid."""
        x, y = self.cell(left, bottom)
        last_x, last_y = self.cell(right, top)
        return self.clip(Window(x, y, last_x - x + 1, last_y - y + 1))

    @property
    def whole(self) -> Window:
        """The window of all cells."""
        return Window(0, 0, self.width, self.height)

    def part(self, window: Window) -> "GridGeometry":
        """Geometry of a window of this grid."""
        return GridGeometry(
            width=window.width,
            height=window.height,
            resolution=self.resolution,
            origin_x=self.origin_x + window.x * self.resolution,
            origin_y=self.origin_y + window.y * self.resolution,
        )


@dataclass(frozen=True)
class StaticMap:
    """A site's floor plan, aligned with the frame `map`: uint8 (height, width), 0 free, 254 occupied, 255 unknown."""

    geometry: GridGeometry
    cells: NDArray[np.uint8]


def combine_costs(below: NDArray[np.uint8], layer: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Combine a layer with the layers below it; all arrays have the same shape.

    A layer changes cells only where `mask` is true. There the higher cost wins, and no layer lowers a cost.
    Unknown (255) is the absence of a cost: only `LETHAL` replaces it, so that an obstacle seen in unexplored space
    counts, while a penalty does not make unexplored space traversable.
    """
    graded = np.where(below == UNKNOWN, np.where(layer == LETHAL, layer, below), np.maximum(below, layer))
    return np.where(mask & (layer != UNKNOWN), graded, below).astype(np.uint8)


def combine_speed_limits(below: NDArray[np.uint8], layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Combine two speed layers (uint8, cm/s, 0 = no limit): the lower limit wins."""
    both = np.minimum(below, layer)
    return np.where(below == NO_SPEED_LIMIT, layer, np.where(layer == NO_SPEED_LIMIT, below, both)).astype(np.uint8)
