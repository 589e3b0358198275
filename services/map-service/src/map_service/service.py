"""Between the core and the world: hazards and obstacles in, versions of the map out, zones stored before they count."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Counter, Gauge, Histogram

from fog_contracts import channels as ch
from fog_contracts.geometry import GeometryError
from fog_contracts.messages import (
    AreaDefinition,
    AreaHazard,
    HazardArea,
    MapSnapshot,
    RobotObstacles,
    RobotPose,
    Zone,
)
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from map_service.shapes import ZoneError, checked_zone
from map_service.store import Audit, StoreError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Iterable

    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.mqtt_edge import MqttEdge
    from fog_runtime.zenoh_edge import ZenohEdge
    from map_service.core import MapChange, MapCore
    from map_service.store import AuditEntry, Outcome, Store

BEAT_S = ch.MAP_HEARTBEAT.period_s
RETRY_S = 0.5
AGGREGATOR = "hazard-aggregator"
ABSENT_S = 3.0
"""How long (s) the aggregator, or the broker, may be gone until no area counts as clear any more."""

VERSION = Gauge("fognav_map_seq", "Version (seq) of the map within this epoch")
DELTA_BYTES = Histogram(
    "fognav_map_delta_bytes", "Cells of one delta, packed", buckets=(64, 256, 1024, 2048, 4096, 16384, 65536)
)
ZONES = Gauge("fognav_zones", "Zones that are stored", ["state"])
ZONE_WRITES = Counter("fognav_zone_writes_total", "Writes of zones by outcome", ["outcome"])

_log = logs.get("map")


class ConflictError(Exception):
    """A write met another version than it expected."""

    def __init__(self, outcome: Outcome, zone_id: str) -> None:
        super().__init__(f"zone {zone_id}: {outcome}")
        self.outcome = outcome


class Service:
    """The running map-service; its loops are tasks of the process."""

    def __init__(
        self, core: MapCore, store: Store, mqtt: MqttEdge, zenoh: ZenohEdge, clock: Clock, health: Health
    ) -> None:
        self.core = core
        self._store = store
        self._mqtt = mqtt
        self._zenoh = zenoh
        self._clock = clock
        self._health = health
        self._writing = asyncio.Lock()
        self._serving = False
        self._zones_read = asyncio.Event()
        self._in_doubt = False
        self._answered: set[str] = set()
        self._aggregators: set[str] = set()
        self._unvouched_since: float | None = None

    # --- What comes in ----------------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Say what to be called for."""
        self._mqtt.on(ch.AREA_DEFINITION, self._on_definition, AreaDefinition)
        self._mqtt.on(ch.AREA_HAZARD, self._on_hazard, AreaHazard)
        self._zenoh.subscribe(ch.ROBOT_OBSTACLES, RobotObstacles, self._on_obstacles)
        self._zenoh.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose)
        self._zenoh.watch_live(self._on_live)

    def _on_definition(self, _ids: dict[str, str], definition: AreaDefinition) -> None:
        try:
            self._emit(self.core.on_definition(definition, self._clock.stamp()))
        except GeometryError as error:
            metrics.REFUSED.labels(ch.AREA_DEFINITION.name).inc()
            _log.error("area_refused", area=definition.id, reason=str(error))

    def _on_hazard(self, _ids: dict[str, str], hazard: AreaHazard) -> None:
        self._emit(self.core.on_hazard(hazard, self._clock.stamp()))

    def _on_obstacles(self, ids: dict[str, str], seen: RobotObstacles) -> None:
        self._emit(self.core.on_obstacles(ids["robot"], seen, self._clock.now(), self._clock.stamp()))

    def _on_pose(self, ids: dict[str, str], pose: RobotPose) -> None:
        self.core.on_pose(ids["robot"], pose, self._clock.now())

    def _on_live(self, role: str, name: str, alive: bool) -> None:  # noqa: FBT001  # the edge's callback
        if role != AGGREGATOR:
            return
        (self._aggregators.add if alive else self._aggregators.discard)(name)
        self._judge_word()

    def _judge_word(self) -> None:
        """Let areas count as clear only while the aggregator is there, and the broker that carries its word."""
        if self._aggregators and self._mqtt.connected:
            self._unvouched_since = None
            self._emit(self.core.on_aggregator(present=True, stamp=self._clock.stamp()))
        elif self._unvouched_since is None:
            self._unvouched_since = self._clock.now()
        elif self._clock.now() - self._unvouched_since > ABSENT_S:
            self._emit(self.core.on_aggregator(present=False, stamp=self._clock.stamp()))

    # --- Zones: stored first, then they count -----------------------------------------------------------------------

    async def create(self, zone: Zone, who: str) -> Zone:
        """Store a new zone and put it on the map; raises `ZoneError`, `ConflictError` (exists), `StoreError`."""
        async with self._writing:
            stamp = self._clock.stamp()
            zone = checked_zone(structs.replace(zone, version=1), self.core.geometry, stamp)
            if any(known.id == zone.id for known in self.core.zones()):
                # The store would take a zone that is the very same for a repeated attempt.
                raise ConflictError("exists", zone.id)
            await self._write(
                self._store.put(zone, expected=0, audit=Audit(at=stamp, who=who, action="create")), zone.id
            )
            self._emit(self.core.put_zone(zone, self._clock.stamp()))
            return zone

    async def replace(self, zone: Zone, expected: int, who: str) -> Zone:
        """Store a new version of a zone; raises `ZoneError`, `ConflictError` (stale, missing), `StoreError`."""
        async with self._writing:
            stamp = self._clock.stamp()
            zone = checked_zone(structs.replace(zone, version=expected + 1), self.core.geometry, stamp)
            audit = Audit(at=stamp, who=who, action="replace")
            await self._write(self._store.put(zone, expected=expected, audit=audit), zone.id)
            self._emit(self.core.put_zone(zone, self._clock.stamp()))
            return zone

    async def delete(self, zone: Zone, who: str) -> None:
        """Delete this version of a zone; raises `ConflictError` (stale) and `StoreError`."""
        async with self._writing:
            audit = Audit(at=self._clock.stamp(), who=who, action="delete")
            await self._write(self._store.delete(zone, audit), zone.id)
            self._emit(self.core.remove_zone(zone.id, self._clock.stamp()))

    @property
    def zones_are_read(self) -> bool:
        """Whether the stored zones are on the map."""
        return self._zones_read.is_set()

    async def audit(self, limit: int) -> list[AuditEntry]:
        """Return the newest entries of the audit log; raises `StoreError`."""
        return await self._store.audit(limit)

    async def _write(self, attempt: Awaitable[Outcome], zone_id: str) -> None:
        try:
            outcome = await attempt
        except StoreError as error:
            # It may have been written although the answer was lost: read again before trusting the memory.
            self._in_doubt = True
            self._health.set("store", ok=False, detail=str(error))
            ZONE_WRITES.labels("failed").inc()
            raise
        ZONE_WRITES.labels(outcome).inc()
        if outcome != "ok":
            self._in_doubt = True
            raise ConflictError(outcome, zone_id)

    async def read_zones(self) -> None:
        """Make the map's zones those that are stored; raises `StoreError`."""
        async with self._writing:
            stored = {zone.id: zone for zone in await self._store.zones()}
            stamp = self._clock.stamp()
            for zone in self.core.zones():
                if zone.id not in stored:
                    self._emit(self.core.remove_zone(zone.id, stamp))
            for zone in stored.values():
                try:
                    self._emit(self.core.put_zone(zone, stamp))
                except ZoneError as error:
                    raise StoreError(
                        f"the stored zone {zone.id} can't be used: {error}; repair or delete it"
                    ) from error
            self._in_doubt = False
            self._zones_read.set()
        self._health.set("zones", ok=True, detail=f"{len(stored)} read")
        self._health.set("store", ok=True)

    async def store_loop(self) -> None:
        """Read the zones, however long it takes; afterwards watch the store and read again when in doubt."""
        while True:
            try:
                if self._in_doubt or not self._zones_read.is_set():
                    await self.read_zones()
                    if weakness := await self._store.weakness():
                        _log.warning("store_is_weak", remedy=weakness)
                else:
                    await self._store.ping()
                    self._health.set("store", ok=True)
            except StoreError as error:
                self._health.set("store", ok=False, detail=str(error))
                if not self._zones_read.is_set():
                    self._health.set("zones", ok=False, detail=f"not read yet, so the map is not served: {error}")
            await asyncio.sleep(RETRY_S)

    # --- What goes out ----------------------------------------------------------------------------------------------

    def _emit(self, change: MapChange) -> None:
        for delta in change.deltas:
            DELTA_BYTES.observe(len(delta.cells))
        if change.deltas:
            VERSION.set(self.core.version.seq)
            first = change.deltas[0]
            for trace in first.traces:
                metrics.observe_trace(trace, ["costmap"])
            _log.info("version", seq=first.seq, parts=first.parts, causes=[f"{c.id} {c.state}" for c in first.causes])
        if not self._serving:
            return
        for delta in change.deltas:
            self._zenoh.publish(ch.MAP_DELTA, delta)
        self._tell_hazards(change.hazards)
        if change.zones is not None:
            self._tell_zones()

    def _tell_hazards(self, hazards: Iterable[HazardArea]) -> None:
        for told in hazards:
            area = told.hazard.area
            self._zenoh.publish(ch.HAZARD, told, area=area)
            if area not in self._answered:
                self._answered.add(area)
                self._zenoh.serve(ch.HAZARD, self._hazard, area=area)

    def _tell_zones(self) -> None:
        zones = self.core.zone_set()
        ZONES.labels("stored").set(len(zones.zones))
        ZONES.labels("active").set(len(self.core.active_zones()))
        self._zenoh.publish(ch.ZONES, zones)

    def _hazard(self, ids: dict[str, str], _request: None) -> HazardArea:
        return next(told for told in self.core.hazards() if told.hazard.area == ids["area"])

    def _snapshot(self, _ids: dict[str, str], _request: None) -> MapSnapshot:
        return self.core.snapshot()

    async def beat_loop(self, hazards_wait_s: float) -> None:
        """Wait until the map is whole, then serve it: heartbeats, deltas, snapshots, reasons."""
        await self._wait_until_whole(hazards_wait_s)
        self._zenoh.serve(ch.MAP_SNAPSHOT, self._snapshot)
        self._zenoh.serve(ch.ZONES, lambda _ids, _request: self.core.zone_set())
        self._serving = True
        self._tell_hazards(self.core.hazards())
        self._tell_zones()
        self._health.set("map", ok=True)
        async for now in ticker(self._clock, BEAT_S):
            stamp = self._clock.stamp()
            self._judge_word()
            self._emit(self.core.tick(now, stamp))
            self._zenoh.publish(ch.MAP_HEARTBEAT, self.core.heartbeat(stamp))
            self._health.set("mqtt", ok=self._mqtt.connected, detail="" if self._mqtt.connected else "no broker")

    async def _wait_until_whole(self, hazards_wait_s: float) -> None:
        """Return when the zones are read and every area is heard of; after the wait, the others count as unknown."""
        self._health.set("map", ok=False, detail="the zones are not read yet")
        begun = self._clock.now()
        if not self._aggregators:
            # An aggregator that never appears is as good as one that left. One may be there already: its news can
            # arrive before this runs.
            self._unvouched_since = begun
        await self._zones_read.wait()
        while (unheard := self.core.unheard_areas()) and self._clock.now() - begun < hazards_wait_s:
            self._health.set("map", ok=False, detail=f"waiting for the hazards of {', '.join(unheard)}")
            await self._clock.sleep(BEAT_S)
