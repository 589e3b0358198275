"""The master costmap: hazards, zones and obstacles in, versions of the map out. Pure: time comes as an argument."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
from msgspec import structs

from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.messages import HazardArea, MapDelta, MapHeartbeat, MapSnapshot, Trace, Zone, ZoneSet
from fog_contracts.replica import MasterMap
from map_service import layers
from map_service.layers.protocol import overlap

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.costs import Inflation
    from fog_contracts.grid import GridGeometry, Window
    from fog_contracts.messages import AreaDefinition, AreaHazard, Cause, Layer, RobotObstacles, RobotPose
    from fog_contracts.replica import Version
    from map_service.layers.protocol import Grid, Touch


class StaticMap(Protocol):
    """A floor plan: geometry, and cells uint8 (height, width): 0 free, 254 occupied, 255 unknown."""

    @property
    def geometry(self) -> GridGeometry:
        """Size, resolution and origin."""

    @property
    def cells(self) -> Grid:
        """The plan itself."""


@dataclass(frozen=True)
class MapChange:
    """What to publish after an input: the deltas of a new version (none when no cell differs), and the reasons."""

    deltas: list[MapDelta] = field(default_factory=list)
    hazards: list[HazardArea] = field(default_factory=list)
    zones: ZoneSet | None = None


class MapCore:
    """Holds the layers and the versioned map; every input returns what changed.

    `definitions` are areas known from the site: until the aggregator speaks of
    them they count as unknown.
    """

    def __init__(
        self,
        site: str,
        static: StaticMap,
        epoch: int,
        inflation: Inflation = DEFAULT_INFLATION,
        *,
        definitions: Iterable[AreaDefinition] = (),
    ) -> None:
        self.geometry = static.geometry
        self._layers = layers.stack(static.geometry, static.cells)
        for definition in definitions:
            self._layers.hazards.define(definition)
        self._touches()
        self._raw, speed = self._painted()
        self._inflation = layers.InflationLayer(self._raw, static.geometry.resolution, inflation)
        self._master = MasterMap(site, static.geometry, static.cells, self._inflation.cost, epoch)
        self._master.write([("speed", self._whole, speed)], [], [])

    # --- What it holds ----------------------------------------------------------------------------------------------

    @property
    def version(self) -> Version:
        """The version that holds now."""
        return self._master.version

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

    def heartbeat(self, stamp: float) -> MapHeartbeat:
        """Return the message that carries the version."""
        return self._master.heartbeat(stamp)

    def snapshot(self) -> MapSnapshot:
        """Return the whole map."""
        return self._master.snapshot()

    def zones(self) -> list[Zone]:
        """Return all zones by id."""
        return self._layers.zones.zones()

    def active_zones(self) -> list[str]:
        """Return the ids of the zones that hold now."""
        return self._layers.zones.active()

    def zone_set(self) -> ZoneSet:
        """Return all zones with the map version that shows them."""
        return ZoneSet(epoch=self.version.epoch, seq=self.version.seq, zones=self.zones())

    def hazards(self) -> list[HazardArea]:
        """Return every area with its hazard."""
        return self._layers.hazards.described()

    def unheard_areas(self) -> list[str]:
        """Return the areas of which the aggregator has not spoken yet."""
        return self._layers.hazards.unheard()

    def recomputed(self) -> tuple[Grid, Grid]:
        """Return cost and speed layer computed from scratch: what the master must equal, cell by cell."""
        raw, speed = self._painted()
        return self._inflation.whole(raw), speed

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def on_definition(self, definition: AreaDefinition, stamp: float) -> MapChange:
        """Take an area's definition; raises `GeometryError` for a polygon that can't be used."""
        return self._commit(stamp, self._layers.hazards.define(definition))

    def on_hazard(self, hazard: AreaHazard, stamp: float) -> MapChange:
        """Take an area's state; what was overtaken is ignored."""
        return self._commit(stamp, self._layers.hazards.take(hazard))

    def on_aggregator(self, present: bool, stamp: float) -> MapChange:  # noqa: FBT001  # the news itself
        """Take whether the aggregator is there: without it, clear areas become unknown."""
        return self._commit(stamp, self._layers.hazards.set_watched(present))

    def put_zone(self, zone: Zone, stamp: float) -> MapChange:
        """Add or replace a zone; raises `ZoneError` for a shape that can't be used."""
        self._layers.zones.put(zone, stamp)
        return self._commit(stamp, zones=True)

    def remove_zone(self, zone_id: str, stamp: float) -> MapChange:
        """Forget a zone."""
        return self._commit(stamp, zones=self._layers.zones.remove(zone_id))

    def on_obstacles(self, robot: str, seen: RobotObstacles, now: float, stamp: float) -> MapChange:
        """Take what a robot's lidar sees."""
        self._layers.obstacles.see(robot, seen, now)
        return self._commit(stamp)

    def on_pose(self, robot: str, pose: RobotPose, now: float) -> None:
        """Take where a robot is; obstacles that are this robot vanish with the next tick."""
        self._layers.obstacles.robot_at(robot, pose, now)

    def tick(self, now: float, stamp: float) -> MapChange:
        """Let zones begin and end and obstacles expire; call ten times a second."""
        before = self.active_zones()
        for layer in self._layers.order:
            layer.tick(now, stamp)
        return self._commit(stamp, zones=self.active_zones() != before)

    # --- Inside -----------------------------------------------------------------------------------------------------

    @property
    def _whole(self) -> Window:
        return self.geometry.clip(self.geometry.window_around(*self.geometry.bounds))

    def _touches(self) -> list[Touch]:
        return [touch for layer in self._layers.order for touch in layer.touched()]

    def _paint(self, window: Window) -> tuple[Grid, Grid]:
        """Return cost (not inflated) and speed of a window, painted by all layers."""
        cost = np.zeros((window.height, window.width), dtype=np.uint8)
        speed = np.zeros((window.height, window.width), dtype=np.uint8)
        for layer in self._layers.order:
            layer.paint(window, cost, speed)
        return cost, speed

    def _painted(self) -> tuple[Grid, Grid]:
        return self._paint(self._whole)

    def _commit(self, stamp: float, hazards: list[HazardArea] | None = None, *, zones: bool = False) -> MapChange:
        """Recompute what the layers touched and turn it into a version."""
        touches = self._touches()
        windows = merged([touch.window for touch in touches])
        changes: list[tuple[Layer, Window, Grid]] = []
        for window in windows:
            cost, speed = self._paint(window)
            self._raw[window.rows, window.columns] = cost
            changes.append(("speed", window, speed))
        changes.extend(
            ("cost", window, self._inflation.cost[window.rows, window.columns])
            for window in self._inflation.update(self._raw, windows)
        )
        causes: list[Cause] = list(dict.fromkeys(touch.cause for touch in touches))
        traces = {
            (trace.area, trace.epoch, trace.seq): structs.replace(trace, costmap_published=stamp)
            for trace in (touch.trace for touch in touches)
            if trace is not None
        }
        deltas = self._master.write(changes, causes, list[Trace](traces.values()))
        return MapChange(deltas, hazards or [], self.zone_set() if zones else None)


def merged(windows: list[Window]) -> list[Window]:
    """Unite windows that overlap, so that no cell is painted twice; windows apart stay apart and small."""
    result: list[Window] = []
    for window in windows:
        if window.empty:
            continue
        grown = window
        apart = []
        for other in result:
            if overlap(grown, other).empty:
                apart.append(other)
            else:
                grown = grown.union(other)
        # Having grown, it may overlap one that it did not before.
        result = [*apart, grown] if grown == window else merged([*apart, grown])
    return result
