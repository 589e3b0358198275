"""The master costmap: combines and inflates the layers, and versions the result.

Pure, apart from `measure`, by which a process observes how long the steps take.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING

import numpy as np
from msgspec import structs

from fog_contracts.messages import Trace
from fog_contracts.replica import MasterMap
from map_service.layers.inflation import InflationLayer
from map_service.pending import PendingUpdates

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from contextlib import AbstractContextManager

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import StaticMap, Window
    from fog_contracts.handlers import Later
    from fog_contracts.messages import Cause, Layer, MapDelta, MapHeartbeat, MapSnapshot
    from fog_contracts.replica import Version
    from map_service.layers.base import CostLayer, Grid


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
