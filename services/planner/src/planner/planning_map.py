"""The map that paths are planned on: a replica of the master costmap, and a lower bound of its costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import INSCRIBED
from fog_contracts.follower import MapFollower
from fog_kernels.inflation import inflate, inflation_table

if TYPE_CHECKING:
    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import MapDelta, MapHeartbeat, MapSnapshot, Trace
    from fog_contracts.replica import Applied, Version

Grid = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Cell = tuple[int, int]
"""(column, row)"""


@dataclass(frozen=True)
class PlanningMap:
    """One version of the map; all layers have the geometry's shape (height, width)."""

    geometry: GridGeometry
    version: Version
    cost: Grid
    """The master costmap."""
    static: Grid
    lower_bound: Grid
    """The inflated static map: the costs without any hazard, zone or obstacle."""


@dataclass(frozen=True)
class CostChange:
    """Changed cells of the master costmap: masks over a window, and the traces of the hazards that caused them."""

    window: Window
    changed: Mask
    decreased: Mask
    traces: list[Trace]


@dataclass(frozen=True)
class Loaded:
    """A snapshot was loaded; `restarted`: its epoch differs from that of the map before."""

    restarted: bool
    traces: list[Trace]


class MapTracker:
    """Follows the map-service's map, and reports which costs changed."""

    def __init__(self, inflation: Inflation, *, grace_s: float, max_age_s: float) -> None:
        self._inflation = inflation
        self._max_age_s = max_age_s
        self._follower = MapFollower(grace_s=grace_s)
        self._previous: Grid = np.zeros((0, 0), dtype=np.uint8)
        self._lower_bound: Grid = self._previous

    @property
    def current(self) -> PlanningMap | None:
        """The newest complete version; None before the first snapshot."""
        replica = self._follower.replica
        if replica.geometry is None or replica.version is None:
            return None
        return PlanningMap(replica.geometry, replica.version, replica.cost, replica.static, self._lower_bound)

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot is needed to follow the map."""
        return self._follower.wants_snapshot(now)

    def is_fresh(self, now: float) -> bool:
        """Whether the replica is confirmed to be recent enough to release paths on it."""
        return not self.wants_snapshot(now) and self._follower.age(now) <= self._max_age_s

    def load(self, snapshot: MapSnapshot, now: float) -> Loaded:
        """Load a snapshot; raises `MapError` and changes nothing when it is damaged or outdated."""
        before = self._follower.version
        applied = self._follower.on_snapshot(snapshot, now)
        replica = self._follower.replica
        table = inflation_table(snapshot.geometry.resolution, self._inflation)
        lower_bound = np.minimum(inflate(np.ascontiguousarray(replica.static), table), replica.cost)
        if not np.array_equal(lower_bound, self._lower_bound):
            self._lower_bound = lower_bound
        self._previous = replica.cost.copy()
        return Loaded(before is None or before.epoch != snapshot.epoch, applied.traces)

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Compare with the map-service's version; if deltas are missing, a snapshot is needed."""
        self._follower.on_heartbeat(heartbeat, now)

    def on_delta(self, delta: MapDelta, now: float) -> list[CostChange]:
        """Apply a delta; return which costs it changed."""
        applied = self._follower.on_delta(delta, now)
        return [] if applied is None else self._differences(applied)

    def _differences(self, applied: Applied) -> list[CostChange]:
        changes = []
        for layer, window in applied.windows:
            if layer != "cost":
                continue
            previous = self._previous[window.rows, window.columns]
            cost = self._follower.replica.cost[window.rows, window.columns]
            self._adjust_lower_bound(window, cost)
            changed, decreased = cost != previous, cost < previous
            if changed.any():
                changes.append(CostChange(window, changed, decreased, applied.traces))
            self._previous[window.rows, window.columns] = cost
        return changes

    def _adjust_lower_bound(self, window: Window, cost: Grid) -> None:
        """Lower the bound where traversable cells fall below it, in a new array, so that users notice the change."""
        bound = self._lower_bound[window.rows, window.columns]
        if np.any((cost < bound) & (cost < INSCRIBED)):
            self._lower_bound = self._lower_bound.copy()
            self._lower_bound[window.rows, window.columns] = np.minimum(bound, cost)
