"""What every painting layer does (after Nav2's `Layer`: bounds first, then costs inside a window)."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import combine_costs, combine_speed_limits
from fog_contracts.grid import Window

if TYPE_CHECKING:
    from fog_contracts.messages import Cause, Trace
    from map_service.shapes import Figure

Grid = NDArray[np.uint8]


class Touch(NamedTuple):
    """A window that a layer will paint otherwise than before, and why."""

    window: Window
    cause: Cause
    trace: Trace | None = None


class Layer(Protocol):
    """One layer of the costmap."""

    def tick(self, now: float, stamp: float) -> None:
        """Let time pass: `now` is monotonic (s), `stamp` seconds since the epoch."""

    def touched(self) -> list[Touch]:
        """Return what changed since this was last asked."""

    def paint(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Write into `cost` and `speed`, both uint8 (window.height, window.width): the map inside the window."""


def overlap(a: Window, b: Window) -> Window:
    """Return the cells that both windows have; it may be empty."""
    x, y = max(a.x, b.x), max(a.y, b.y)
    right, top = min(a.x + a.width, b.x + b.width), min(a.y + a.height, b.y + b.height)
    return Window(x, y, max(right - x, 0), max(top - y, 0))


def paint_figure(figure: Figure, window: Window, grid: Grid, value: int, *, speed: bool = False) -> None:
    """Combine one value into `grid` (the map inside `window`) wherever the figure has cells.

    Costs combine by `combine_costs`, speed limits (cm/s) by `combine_speed_limits`.
    """
    common = overlap(figure.window, window)
    if common.empty:
        return
    part = figure.mask[
        common.y - figure.window.y : common.y - figure.window.y + common.height,
        common.x - figure.window.x : common.x - figure.window.x + common.width,
    ]
    below = grid[
        common.y - window.y : common.y - window.y + common.height,
        common.x - window.x : common.x - window.x + common.width,
    ]
    if speed:
        below[...] = combine_speed_limits(below, np.where(part, value, 0).astype(np.uint8))
    else:
        below[...] = combine_costs(below, np.full(below.shape, value, dtype=np.uint8), part)
