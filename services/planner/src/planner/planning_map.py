"""The map that paths are planned on: a replica of the master costmap, and a lower bound of its costs. Pure.

Its costs are raised by the time that speed limits take (`with_time`, ADR 75).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import COST_PER_FACTOR, DEGRADED_SPEED, INSCRIBED, LETHAL, PENALTY_MAX, UNKNOWN
from fog_contracts.follower import MapFollower
from fog_contracts.replica import decode_map
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from fog_kernels.inflation import inflate, inflation_table

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import Layer, MapDelta, MapHeartbeat, MapSnapshot, Trace
    from fog_contracts.replica import Applied, DecodedMap, Version

    Grid = NDArray[np.uint8]

_PART: Final = 30
"""Of so many points of a line the surroundings are looked at together."""
USUAL_SPEED: Final = 2 * DEGRADED_SPEED / 100
"""Speed (m/s) of a robot where nothing limits it."""


def _timed_costs() -> Grid:
    """Tabulate, by limit (cm/s, 0: none) and cost, the cost with the time that the limit takes.

    In a cell with a limit a robot spends as long as in USUAL_SPEED / limit cells without: the cost rises by that of the
    others, free ones. It stays passable, and so has a highest value: limits below 6 cm/s count no more than that.
    """
    limits = np.arange(256.0)
    limits[0] = np.inf
    extra = np.maximum(0.0, COST_PER_FACTOR * (100.0 * USUAL_SPEED / limits - 1.0))
    costs = np.arange(256)
    timed = np.minimum(np.rint(costs + extra[:, np.newaxis]), PENALTY_MAX)
    return np.where(costs < INSCRIBED, timed, costs).astype(np.uint8)


_TIMED_COSTS: Final = _timed_costs()


def under_body(speed: Grid, reach: int) -> Grid:
    """Return the limit (cm/s, 0: none) for a robot in each cell: the lowest within `reach` cells, under its body."""
    if not speed.any():
        return np.zeros(speed.shape, np.uint8)  # takes no memory where nothing is written
    lowest = speed - np.uint8(1)  # no limit becomes the highest
    for turned in (False, True):
        across = lowest.T if turned else lowest
        before = across.copy()
        for shift in range(1, min(reach, len(across) - 1) + 1):
            np.minimum(across[shift:], before[:-shift], out=across[shift:])
            np.minimum(across[:-shift], before[shift:], out=across[:-shift])
    return lowest + np.uint8(1)


def with_time(cost: Grid, limits: Grid) -> Grid:
    """Return a copy of the costs, raised by the time that limits (cm/s, 0: none) take; both have one shape.

    No cost falls, and none becomes or ceases to be impassable: what is below the costs stays below them.
    """
    timed, limited = cost.copy(), limits != 0
    if limited.any():
        timed[limited] = _TIMED_COSTS[limits[limited], cost[limited]]
    return timed


class StandingMap:
    """The costs that have stayed on the map: walls, zones, and whatever else nobody has taken away for a while.

    No cell has fallen below them for `period` (s); they are raised at most once in that time. Distance fields over
    them lead round what stands in the way for long; fields over the walls alone lead into it. A cell whose cost fell
    once is not trusted above that cost again, so that what comes and goes never outdates the fields a second time.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._begun = 0.0
        self.costs: Grid = np.zeros((0, 0), np.uint8)
        """Never above the newest costs of traversable cells; another array whenever a cost changes."""
        self._lowest = self.costs
        """The lowest cost of each cell since the period began."""
        self._distrusted = self.costs
        """By how much the highest cost that each cell may get is below the highest of all: 0 for most, untouched."""

    def load(self, cost: Grid, *, same_floor: bool, now: float) -> None:
        """Begin with a whole costmap; on the same floor as before what is known of its cells is kept."""
        if same_floor and cost.shape == self.costs.shape:
            self._lower(np.s_[:, :], cost)
            np.minimum(self._lowest, cost, out=self._lowest)
            return
        self.costs, self._lowest, self._begun = cost.copy(), cost.copy(), now
        self._distrusted = np.zeros(cost.shape, np.uint8)

    def update(self, window: Window, cost: Grid) -> None:
        """Follow a change of the costs in a window."""
        place = window.rows, window.columns
        np.minimum(self._lowest[place], cost, out=self._lowest[place])
        self._lower(place, cost)

    def _lower(self, place: tuple[slice, slice], cost: Grid) -> None:
        standing = self.costs[place]
        fell = (cost < standing) & (cost < INSCRIBED)
        if fell.any():
            self.costs = self.costs.copy()
            self.costs[place][fell] = cost[fell]
            self._distrusted[place][fell] = UNKNOWN - cost[fell]

    def settle(self, cost: Grid, now: float) -> None:
        """Raise the costs to the lowest ones of the period, when it has ended; `cost` is the newest costmap."""
        if now - self._begun < self._period or self.costs.size == 0:
            return
        lowest = np.minimum(self._lowest, UNKNOWN - self._distrusted)
        if np.any(lowest > self.costs):
            self.costs = np.maximum(lowest, self.costs)
        self._lowest, self._begun = cost.copy(), now


Mask = NDArray[np.bool_]
Cell = tuple[int, int]
"""(column, row)"""


@dataclass(frozen=True)
class PlanningMap:
    """One version of the map; all layers have the geometry's shape (height, width)."""

    geometry: GridGeometry
    version: Version
    cost: Grid
    """The master costmap, with the time that speed limits take."""
    static: Grid
    lower_bound: Grid
    """The inflated static map: the costs without any hazard, zone or obstacle."""
    standing: Grid
    """Costs that have stayed for a while; never above `cost` where that is traversable, never below `lower_bound`."""

    @cached_property
    def components(self) -> Components:
        """What can be reached from where; computed when it is first asked for (1 ms), for all robots."""
        return Components(self.cost)

    @property
    def has_components(self) -> bool:
        """Whether `components` is computed already."""
        return "components" in self.__dict__

    def avoiding(self, lines: Iterable[tuple[NDArray[np.float64], float]]) -> PlanningMap:
        """Return this map with all places lethal that are within a reach (m) of the points ((n, 2), m) of lines."""
        cost = self.cost.copy()
        resolution = self.geometry.resolution
        for points, reach in lines:
            # Of the points and the places only the cells are known.
            cells = math.ceil(reach / resolution + math.sqrt(2.0))
            for part in np.array_split(points, math.ceil(len(points) / _PART)) if len(points) else ():
                (left, bottom), (right, top) = part.min(axis=0).tolist(), part.max(axis=0).tolist()
                around = cells * resolution
                window = self.geometry.window_around(left - around, bottom - around, right + around, top + around)
                marks = np.zeros((window.height, window.width), np.bool_)
                at, _ = self.geometry.cells(part)
                columns, rows = at[:, 0] - window.x, at[:, 1] - window.y
                inside = (columns >= 0) & (columns < window.width) & (rows >= 0) & (rows < window.height)
                marks[rows[inside], columns[inside]] = True
                near = squared_distance_capped(marks, cells + 1) <= cells * cells
                cost[window.rows, window.columns][near] = LETHAL
        return replace(self, cost=cost)

    def reachable(self, start: Cell, goal: Cell) -> bool:
        """Whether a path leads from one traversable cell to another."""
        return self.components.connected(start, goal)


def body_reach(inflation: Inflation, geometry: GridGeometry) -> int:
    """Return how many cells a robot in the middle of its own one reaches each way; robots look at a square."""
    return math.floor(inflation.inscribed_radius / geometry.resolution + 0.5)


@dataclass(frozen=True)
class CostChange:
    """Changed cells of the costs: masks over a window, and the traces of the hazards that caused them."""

    window: Window
    changed: Mask
    decreased: Mask
    traces: list[Trace]

    @cached_property
    def any_decreased(self) -> bool:
        """Whether a cost fell."""
        return bool(self.decreased.any())

    def near(self, reach: float, geometry: GridGeometry) -> tuple[Window, Mask]:
        """Return the cells within `reach` (m) of a changed one, as a mask over a window; computed once for a reach."""
        found = self.__dict__.setdefault("_near", {})
        if reach not in found:
            cells = math.ceil(reach / geometry.resolution)
            grown = geometry.clip(self.window.grown(cells))
            padded = np.zeros((grown.height, grown.width), dtype=np.bool_)
            x, y = self.window.x - grown.x, self.window.y - grown.y
            padded[y : y + self.window.height, x : x + self.window.width] = self.changed
            found[reach] = grown, squared_distance_capped(padded, cells + 1) <= cells * cells
        window, mask = found[reach]
        return window, mask


@dataclass(frozen=True)
class PreparedMap:
    """A decoded snapshot with the lower bound of its costs, and the limits for robots in its cells."""

    decoded: DecodedMap
    lower_bound: Grid
    limits: Grid


def prepare_map(snapshot: MapSnapshot, inflation: Inflation) -> PreparedMap:
    """Decode and inflate a snapshot, on any thread; raises `MapError` when it is damaged."""
    decoded = decode_map(snapshot)
    table = inflation_table(decoded.geometry.resolution, inflation)
    inflated = inflate(np.ascontiguousarray(decoded.static), table)
    limits = under_body(decoded.layers["speed"], body_reach(inflation, decoded.geometry))
    return PreparedMap(decoded, np.minimum(inflated, decoded.layers["cost"], out=inflated), limits)


@dataclass(frozen=True)
class Loaded:
    """A snapshot was loaded; `restarted`: its epoch differs from that of the map before."""

    restarted: bool
    traces: list[Trace]


class MapTracker:
    """Follows the map-service's map, and reports which costs changed."""

    def __init__(
        self, inflation: Inflation, *, grace_s: float, max_age_s: float, standing_s: float, time_in_cost: bool = True
    ) -> None:
        self._inflation = inflation
        self._time_in_cost = time_in_cost
        self._max_age_s = max_age_s
        self._follower = MapFollower(grace_s=grace_s)
        self._cost: Grid = np.zeros((0, 0), dtype=np.uint8)
        """The costs that paths are planned on; without the time the replica's own array."""
        self._limits: Grid = self._cost
        self._lower_bound: Grid = self._cost
        self._standing = StandingMap(standing_s)
        self._current: PlanningMap | None = None
        self._copy: PlanningMap | None = None

    @property
    def current(self) -> PlanningMap | None:
        """The newest complete version; None before the first snapshot. The next delta changes its cells: don't keep it.

        The same version is the same object.
        """
        replica, current = self._follower.replica, self._current
        if replica.geometry is None or replica.version is None:
            return None
        standing = self._standing.costs
        bounds_are_new = current is None or current.lower_bound is not self._lower_bound
        if current is None or bounds_are_new or current.version != replica.version or current.standing is not standing:
            self._current = PlanningMap(
                replica.geometry, replica.version, self._cost, replica.static, self._lower_bound, standing
            )
        return self._current

    def copy(self) -> PlanningMap | None:
        """Return the newest version as a copy that no delta changes, for use on other threads; once per version."""
        current = self.current
        if current is None:
            return None
        if self._copy is None or self._copy.version != current.version or self._copy.static is not current.static:
            self._copy = replace(current, cost=current.cost.copy())
            if current.has_components:
                self._copy.__dict__["components"] = current.components  # of the same cells
        return self._copy

    @property
    def limits(self) -> Grid:
        """The speed limit (cm/s, 0: none) for a robot in each cell: the lowest under its body.

        The next delta changes its cells.
        """
        return self._limits

    @property
    def limits_on_grid(self) -> tuple[Grid, GridGeometry] | None:
        """The limits and their grid, for any thread; None before the first snapshot or while one is loaded."""
        geometry, limits = self._follower.replica.geometry, self._limits
        return None if geometry is None or limits.shape != geometry.shape else (limits, geometry)

    def layers(self) -> dict[Layer, Grid]:
        """Return copies of the newest version's layers, as the map-service has them."""
        return {layer: cells.copy() for layer, cells in self._follower.replica.layers.items()}

    def wants_snapshot(self, now: float) -> bool:
        """Whether a snapshot is needed to follow the map."""
        return self._follower.wants_snapshot(now)

    def is_fresh(self, now: float) -> bool:
        """Whether the replica is confirmed to be recent enough to release paths on it."""
        return not self.wants_snapshot(now) and self._follower.age(now) <= self._max_age_s

    def load(self, snapshot: MapSnapshot | PreparedMap, now: float) -> Loaded:
        """Load a snapshot; raises `MapError` and changes nothing when it is damaged or outdated.

        One that `prepare_map` has prepared takes 2 ms, another one 50 ms (2000 x 1200 cells).
        """
        prepared = snapshot if isinstance(snapshot, PreparedMap) else prepare_map(snapshot, self._inflation)
        before = self._follower.version
        applied = self._follower.on_snapshot(prepared.decoded, now)
        replica = self._follower.replica
        limits, lower_bound = prepared.limits, prepared.lower_bound
        has_deltas = applied.version != prepared.decoded.version
        if has_deltas:  # they arrived meanwhile, and were applied, too
            limits = under_body(replica.speed, body_reach(self._inflation, prepared.decoded.geometry))
        self._limits = limits
        cost = self._cost = with_time(replica.cost, limits) if self._time_in_cost else replica.cost
        if has_deltas:
            lower_bound = np.minimum(lower_bound, cost)
        same_floor = np.array_equal(lower_bound, self._lower_bound)
        if not same_floor:
            self._lower_bound = lower_bound
        self._standing.load(cost, same_floor=same_floor, now=now)
        if np.array_equal(self._standing.costs, self._lower_bound):
            self._standing.costs = self._lower_bound  # one array, so that fields are computed over one bound only
        self._copy = None
        self._current = None
        return Loaded(before is None or before.epoch != applied.version.epoch, applied.traces)

    def settle(self, now: float) -> None:
        """Let the standing costs follow what has stayed on the map; call it often."""
        if self.current is not None:
            self._standing.settle(self._cost, now)

    def on_heartbeat(self, heartbeat: MapHeartbeat, now: float) -> None:
        """Compare with the map-service's version; if deltas are missing, a snapshot is needed."""
        self._follower.on_heartbeat(heartbeat, now)

    def on_delta(self, delta: MapDelta, now: float) -> list[CostChange]:
        """Apply a delta; return which costs it changed."""
        applied = self._follower.on_delta(delta, now)
        if applied is None:
            return []
        self._copy = None
        return self._differences(applied)

    def _differences(self, applied: Applied) -> list[CostChange]:
        changes, replica = [], self._follower.replica
        for (layer, written), before in zip(applied.windows, applied.previous, strict=True):
            window = self._limit(written) if layer == "speed" else written
            place, previous = (window.rows, window.columns), before
            if self._time_in_cost:
                previous = self._cost[place].copy()
                self._cost[place] = with_time(replica.cost[place], self._limits[place])
            elif layer != "cost":
                continue
            cost = self._cost[place]
            self._adjust_lower_bound(window, cost)
            self._standing.update(window, cost)
            changed, decreased = cost != previous, cost < previous
            if changed.any():
                changes.append(CostChange(window, changed, decreased, applied.traces))
        return changes

    def _limit(self, window: Window) -> Window:
        """Update the limits after the speed layer has changed in a window; return where they may have changed."""
        geometry = self._follower.replica.geometry
        assert geometry is not None
        reach = body_reach(self._inflation, geometry)
        changed, around = geometry.clip(window.grown(reach)), geometry.clip(window.grown(2 * reach))
        limits = under_body(self._follower.replica.speed[around.rows, around.columns], reach)
        x, y = changed.x - around.x, changed.y - around.y
        self._limits[changed.rows, changed.columns] = limits[y : y + changed.height, x : x + changed.width]
        return changed

    def _adjust_lower_bound(self, window: Window, cost: Grid) -> None:
        """Lower the bound where traversable cells fall below it, in a new array, so that users notice the change."""
        bound = self._lower_bound[window.rows, window.columns]
        if np.any((cost < bound) & (cost < INSCRIBED)):
            self._lower_bound = self._lower_bound.copy()
            self._lower_bound[window.rows, window.columns] = np.minimum(bound, cost)
