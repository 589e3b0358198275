"""Windows of the map that wait to be recomputed, handed out in portions of limited size. Pure.

A change of a large floor takes longer than the fleet may wait for a heartbeat. So what is large is recomputed in
portions, each a version of its own, and what is small (a hazard) goes before it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fog_contracts.grid import Window

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Final

    from fog_contracts.grid import GridGeometry
    from map_service.layers.base import UpdatedBounds

TILE: Final = 64
"""Cells per side of the tiles by which large changes are remembered."""
MAX_WINDOWS: Final = 64
"""Most windows that are recomputed exactly; more of them are recomputed by tiles."""


class Portion(NamedTuple):
    """Windows to be recomputed now, and the changes that they are parts of."""

    windows: list[Window]
    bounds: list[UpdatedBounds]


class PendingUpdates:
    """The updated bounds of all layers that are not on the map yet."""

    def __init__(self, geometry: GridGeometry) -> None:
        self._geometry = geometry
        self._tiles = np.zeros((-(-geometry.height // TILE), -(-geometry.width // TILE)), dtype=np.bool_)
        self._in_tiles: list[UpdatedBounds] = []

    @property
    def waiting(self) -> bool:
        """Whether something was left for a later portion."""
        return bool(self._in_tiles)

    def take(self, updated: Sequence[UpdatedBounds], cells: int | None) -> Portion:
        """Add bounds, and return a portion of about `cells` (None: all that waits); small windows come first."""
        exact: list[UpdatedBounds] = []
        remaining = self._geometry.width * self._geometry.height if cells is None else cells
        for bounds in updated:
            size = bounds.window.width * bounds.window.height
            if len(exact) < MAX_WINDOWS and size <= remaining:
                exact.append(bounds)
                remaining -= size
            else:
                self._postpone(bounds)
        if cells is None and self._in_tiles:
            remaining = self._tiles.size * TILE * TILE
        windows = merge_overlapping([bounds.window for bounds in exact])
        large = self._take_tiles(remaining)
        causes = [bounds for bounds in self._in_tiles if any(_overlap(bounds.window, window) for window in large)]
        if not self._tiles.any():
            self._in_tiles = []
        return Portion([*windows, *large], [*exact, *causes])

    def _postpone(self, bounds: UpdatedBounds) -> None:
        window = bounds.window
        if window.empty:
            return
        self._in_tiles.append(bounds)
        last_row, last_column = (window.y + window.height - 1) // TILE, (window.x + window.width - 1) // TILE
        self._tiles[window.y // TILE : last_row + 1, window.x // TILE : last_column + 1] = True

    def _take_tiles(self, cells: int) -> list[Window]:
        """Remove tiles of about `cells` in all, bottom first, and return them as windows that don't overlap."""
        windows: list[Window] = []
        while cells >= TILE * TILE and self._tiles.any():
            row = int(np.argmax(self._tiles.any(axis=1)))
            first = int(np.argmax(self._tiles[row]))
            run = self._tiles[row, first : first + cells // (TILE * TILE)]
            columns = len(run) if run.all() else int(np.argmin(run))
            # Equal runs above make one window.
            limit = max(1, cells // (TILE * TILE * columns))
            above = self._tiles[row : row + limit, first : first + columns].sum(axis=1) == columns
            rows = len(above) if above.all() else int(np.argmin(above))
            self._tiles[row : row + rows, first : first + columns] = False
            window = Window(first * TILE, row * TILE, columns * TILE, rows * TILE)
            cells -= window.width * window.height
            windows.append(self._geometry.clip(window))
        return windows


def _overlap(a: Window, b: Window) -> bool:
    return not a.intersection(b).empty


def merge_overlapping(windows: list[Window]) -> list[Window]:
    """Merge overlapping windows, so that no cell is computed twice; disjoint windows stay separate and small."""
    result: list[Window] = []
    for window in windows:
        if window.empty:
            continue
        grown = window
        disjoint = []
        for other in result:
            if grown.intersection(other).empty:
                disjoint.append(other)
            else:
                grown = grown.union(other)
        # Once grown, it may overlap further windows.
        result = [*disjoint, grown] if grown == window else merge_overlapping([*disjoint, grown])
    return result
