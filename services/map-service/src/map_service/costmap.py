"""The master costmap: combines and inflates the layers, and versions the result.

Pure, apart from `measure`, by which a process observes how long the steps take.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import structs

from fog_contracts.grid import Window
from fog_contracts.messages import Trace
from fog_contracts.replica import MasterMap
from fog_kernels.inflation import inflate, inflate_window, inflation_table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from contextlib import AbstractContextManager
    from typing import Final

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry, StaticMap
    from fog_contracts.handlers import Later
    from fog_contracts.messages import Cause, Layer, MapDelta, MapHeartbeat, MapSnapshot
    from fog_contracts.replica import Version
    from fog_kernels.inflation import InflationTable
    from map_service.layers.base import CostLayer, Grid, UpdatedBounds

COMMIT_CELLS: Final = 128 * 1024
"""About how many cells are recomputed at a time, so that the next heartbeat, hazard or request need not wait long."""
TILE: Final = 64
"""Cells per side of the tiles by which large changes are remembered."""
MAX_WINDOWS: Final = 64
"""Most windows that are recomputed exactly; more of them are recomputed by tiles."""


class Portion(NamedTuple):
    """Windows to be recomputed now, and the changes that they are parts of."""

    windows: list[Window]
    bounds: list[UpdatedBounds]


class PendingUpdates:
    """The updated bounds of all layers that are not on the map yet.

    A change of a large floor takes longer than the fleet may wait for a heartbeat. So what is large is recomputed in
    portions, each a version of its own, and what is small (a hazard) goes before it.
    """

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


class InflationLayer:
    """Holds the inflated map of a grid of this resolution (m per cell)."""

    def __init__(self, raw: Grid, resolution: float, inflation: Inflation) -> None:
        self.table = inflation_table(resolution, inflation)
        self.cost = inflate(raw, self.table)

    def update(self, raw: Grid, windows: Iterable[Window]) -> list[Window]:
        """Update the inflation around windows in which `raw` changed; return the windows of `cost` that it rewrote."""
        rewritten = (Window(*inflate_window(raw, self.table, *window, self.cost)) for window in windows)
        return [window for window in rewritten if not window.empty]

    def inflate_all(self, raw: Grid) -> Grid:
        """Return the inflation of a whole map, computed from scratch."""
        return inflate(raw, self.table)


class LayeredCostmap:
    """The versioned map that its layers (bottom first) and inflation result in."""

    def __init__(
        self, site: str, static: StaticMap, layers: Sequence[CostLayer], inflation: Inflation, epoch: int
    ) -> None:
        self.geometry = static.geometry
        self.measure: Callable[[str], AbstractContextManager[object]] = lambda _step: nullcontext()
        """Called with the name of each step of a commit, and entered around it."""
        self._layers = layers
        self._pending = PendingUpdates(static.geometry)
        for layer in layers:
            layer.pop_updated_bounds()  # everything is computed below
        self._raw, speed = self._combine_layers(self.geometry.whole)
        self._inflation = InflationLayer(self._raw, static.geometry.resolution, inflation)
        self._master = MasterMap(site, static.geometry, static.cells, self._inflation.cost, epoch)
        self._master.write([("speed", self.geometry.whole, speed)], [], [])

    @property
    def version(self) -> Version:
        """The current version."""
        return self._master.version

    @property
    def pending(self) -> bool:
        """Whether an update left windows for the next one."""
        return self._pending.waiting

    @property
    def cost(self) -> Grid:
        """The master costmap, uint8 (height, width)."""
        return self._master.layers["cost"]

    @property
    def speed(self) -> Grid:
        """The speed layer, uint8 (height, width), cm/s, 0 = no limit."""
        return self._master.layers["speed"]

    @property
    def layers(self) -> Sequence[CostLayer]:
        """The layers, bottom first."""
        return self._layers

    @property
    def raw(self) -> Grid:
        """The combined layers before the inflation, uint8 (height, width)."""
        return self._raw

    @property
    def inflation_table(self) -> InflationTable:
        """The inflation of this map."""
        return self._inflation.table

    @property
    def static(self) -> Grid:
        """The floor plan, uint8 (height, width)."""
        return self._master.static

    def set_epoch(self, epoch: int) -> None:
        """Continue with another epoch; cells and seq stay."""
        self._master.set_epoch(epoch)

    def heartbeat(self, uptime: float, clock: int) -> MapHeartbeat:
        """Return the message that carries the version, sent at `uptime` of the monotonic clock `clock`."""
        return self._master.heartbeat(uptime, clock)

    def snapshot(self) -> MapSnapshot:
        """Return the whole map."""
        return self._master.snapshot()

    def snapshot_later(self) -> Later[MapSnapshot]:
        """Return the whole map as it is now, to be encoded on any thread."""
        return self._master.snapshot_later()

    def recompute(self) -> tuple[Grid, Grid]:
        """Return cost and speed layer computed from scratch; the master must equal them, cell by cell."""
        raw, speed = self._combine_layers(self.geometry.whole)
        return self._inflation.inflate_all(raw), speed

    def update(self, stamp: float, cells: int | None = None) -> list[MapDelta]:
        """Recompute the layers' updated bounds; return the deltas of the new version, none when no cell differs.

        `stamp` (s since the epoch) is added to the traces of the hazards that caused it. Only about `cells` cells are
        recomputed (None: all), small windows first; what is left (`pending`) is for the next update.
        """
        updated = [bounds for layer in self._layers for bounds in layer.pop_updated_bounds()]
        if not updated and not self._pending.waiting:
            return []
        windows, updated = self._pending.take(updated, cells)
        changes: list[tuple[Layer, Window, Grid]] = []
        with self.measure("combine"):
            for window in windows:
                cost, speed = self._combine_layers(window)
                self._raw[window.rows, window.columns] = cost
                changes.append(("speed", window, speed))
        with self.measure("inflate"):
            inflated = self._inflation.update(self._raw, windows)
        changes.extend(("cost", window, self._inflation.cost[window.rows, window.columns]) for window in inflated)
        causes: list[Cause] = list(dict.fromkeys(bounds.cause for bounds in updated))
        traces = {
            (trace.area, trace.epoch, trace.seq): structs.replace(trace, costmap_published=stamp)
            for trace in (bounds.trace for bounds in updated)
            if trace is not None
        }
        with self.measure("version"):
            return self._master.write(changes, causes, list[Trace](traces.values()))

    def _combine_layers(self, window: Window) -> tuple[Grid, Grid]:
        """Return cost (not inflated) and speed limit of a window, combined from all layers."""
        cost = np.zeros((window.height, window.width), dtype=np.uint8)
        speed = np.zeros((window.height, window.width), dtype=np.uint8)
        for layer in self._layers:
            layer.update_costs(window, cost, speed)
        return cost, speed
