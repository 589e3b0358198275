"""Geometry of a grid in the frame `map`: metres on one side, cells on the other."""

import math
from typing import NamedTuple

import msgspec


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

    def grown(self, cells: int) -> "Window":
        """Return the window with a margin of `cells` on every side."""
        return Window(self.x - cells, self.y - cells, self.width + 2 * cells, self.height + 2 * cells)


class GridGeometry(msgspec.Struct, frozen=True):
    """Size, resolution (m per cell) and origin (m, lower-left corner of cell (0, 0), frame `map`) of a grid.

    Arrays over it are row-major with shape (height, width); row 0 is at the bottom. The grid is aligned with the
    frame: a map_server origin yaw is resolved when a map is loaded, never carried around.
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

    def contains_cell(self, column: int, row: int) -> bool:
        """Whether the grid has this cell."""
        return 0 <= column < self.width and 0 <= row < self.height

    def contains(self, x: float, y: float) -> bool:
        """Whether the point (x, y) in metres lies on the grid."""
        return self.contains_cell(*self.cell(x, y))

    def clip(self, window: Window) -> Window:
        """Return the part of a window that lies on the grid; it may be empty."""
        x, y = max(window.x, 0), max(window.y, 0)
        right = min(window.x + window.width, self.width)
        top = min(window.y + window.height, self.height)
        return Window(x, y, max(right - x, 0), max(top - y, 0))

    def window_around(self, left: float, bottom: float, right: float, top: float) -> Window:
        """Return the cells that a rectangle in metres touches, clipped to the grid."""
        x, y = self.cell(left, bottom)
        last_x, last_y = self.cell(right, top)
        return self.clip(Window(x, y, last_x - x + 1, last_y - y + 1))

    def part(self, window: Window) -> "GridGeometry":
        """Geometry of a window of this grid."""
        return GridGeometry(
            width=window.width,
            height=window.height,
            resolution=self.resolution,
            origin_x=self.origin_x + window.x * self.resolution,
            origin_y=self.origin_y + window.y * self.resolution,
        )
