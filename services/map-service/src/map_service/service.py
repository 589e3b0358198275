"""Runs the core: publishes what it returns, and stores zones before they take effect."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Counter, Gauge, Histogram

from fog_contracts import channels as ch
from fog_contracts.messages import MapDelta, Zone, ZoneSet
from fog_contracts.shapes import ShapeError
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from fog_runtime.edges import Edges
from map_service.store import Audit, RecoveryError, StoreError
from map_service.zone_validation import check_list_size, list_size, validated_zone

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Literal

    from fog_contracts.handlers import Publication
    from fog_runtime.audit import AuditPage
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.idempotency import Attempt
    from fog_runtime.mqtt_edge import MqttEdge
    from fog_runtime.zenoh_edge import ZenohEdge
    from map_service.core import MapCore
    from map_service.store import Outcome, Store

TICK_S = ch.MAP_HEARTBEAT.period_s
STORE_PERIOD_S = 0.5
AGGREGATOR_ROLE = "hazard-aggregator"

VERSION = Gauge("fognav_map_seq", "Sequence number of the map version within this epoch")
DELTA_BYTES = Histogram(
    "fognav_map_delta_bytes",
    "Size of the cells of one delta, encoded",
    buckets=(64, 256, 1024, 2048, 4096, 16384, 65536),
)
ZONES = Gauge("fognav_zones", "Zones, stored and active", ["state"])
ZONE_WRITES = Counter("fognav_zone_writes_total", "Writes of zones to the store, by outcome", ["outcome"])

_log = logs.get("map")


class ConflictError(Exception):
    """A zone has another version than the writer expected, or exists already."""

    def __init__(self, outcome: Outcome, zone_id: str) -> None:
        super().__init__(f"zone {zone_id}: {outcome}")
        self.outcome = outcome
        self.zone = zone_id


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
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh)
        self._zone_lock = asyncio.Lock()
        self._reload_zones = False
        self._serving_queries = False

    def subscribe(self) -> None:
        """Register the core's handlers; call before the connections run."""
        self._edges.subscribe(self.core.handlers(), self._publish)
        self._zenoh.subscribe_liveliness(self._on_liveliness)

    def _on_liveliness(self, role: str, name: str, alive: bool) -> None:  # noqa: FBT001  # the edge's callback
        if role == AGGREGATOR_ROLE:
            self._publish(self.core.on_aggregator(name, self._edges.now(), alive=alive))

    async def tick_loop(self) -> None:
        """Tick the core, and answer queries once it serves the map."""
        async for _ in ticker(self._clock, TICK_S):
            connected, at = self._mqtt.connected, self._edges.now()
            self._publish(self.core.on_broker(at, connected=connected))
            publications = self.core.tick(at)
            if self.core.serving and not self._serving_queries:
                # Before the first publication: channels with a key for each area are served as these are published.
                self._serving_queries = True
                self._edges.serve(self.core.query_handlers())
            self._publish(publications)
            self._health.set("map", ok=self.core.serving, detail=self.core.missing())
            self._health.set("mqtt", ok=connected, detail="" if connected else "not connected to the broker")

    # --- Zones: stored first, then put on the map -------------------------------------------------------------------

    async def create(self, zone: Zone, who: str, attempt: Attempt | None = None) -> Zone:
        """Store a new zone and put it on the map; raises `ZoneError`, `ConflictError` (exists), `StoreError`.

        An `attempt` that succeeded before returns its zone again; raises `IdempotencyError` for another request's.
        """
        async with self._zone_lock:
            if (earlier := await self._earlier_result(attempt)) is not None:
                return earlier
            stamp = self._clock.stamp()
            zone = validated_zone(zone, self.core.costmap.geometry, stamp)
            if any(known.id == zone.id for known in self.core.zones()):
                # The store would treat an identical zone as a repeated attempt.
                raise ConflictError("exists", zone.id)
            check_list_size(zone, self.core.zones())
            audit = Audit(stamp, who, "create", attempt)
            with self._uncertain_write():
                outcome, zone = await self._store.create(zone, audit)
            self._require_ok(outcome, zone.id)
            self._publish(self.core.put_zone(zone, self._edges.now()))
            return zone

    async def replace(self, zone: Zone, expected: int, who: str, attempt: Attempt | None = None) -> Zone:
        """Store a new version of a zone; raises `ZoneError`, `ConflictError` (stale, missing), `StoreError`.

        `attempt` as in `create`.
        """
        async with self._zone_lock:
            if (earlier := await self._earlier_result(attempt)) is not None:
                return earlier
            if not any(known.id == zone.id and known.version == expected for known in self.core.zones()):
                # The store would treat an identical zone as a repeated attempt.
                raise ConflictError("stale", zone.id)
            stamp = self._clock.stamp()
            zone = validated_zone(structs.replace(zone, version=expected + 1), self.core.costmap.geometry, stamp)
            check_list_size(zone, self.core.zones())
            audit = Audit(stamp, who, "replace", attempt)
            with self._uncertain_write():
                outcome = await self._store.replace(zone, expected=expected, audit=audit)
            self._require_ok(outcome, zone.id)
            self._publish(self.core.put_zone(zone, self._edges.now()))
            return zone

    async def delete(self, zone: Zone, who: str) -> None:
        """Delete this version of a zone; raises `ConflictError` (stale) and `StoreError`."""
        async with self._zone_lock:
            with self._uncertain_write():
                outcome = await self._store.delete(zone, Audit(self._clock.stamp(), who, "delete"))
            self._require_ok(outcome, zone.id)
            self._publish(self.core.remove_zone(zone.id, self._edges.now()))

    async def audit(self, kinds: Sequence[str], cursor: str | None, limit: int) -> AuditPage:
        """Return a page of the site's audit trail; raises `CursorError` and `StoreError`."""
        return await self._store.audit(kinds=kinds, cursor=cursor, limit=limit)

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Restore the zones from memory, or accept those in Redis, after Redis lost records.

        Raises `RecoveryError` and `StoreError`.
        """
        await self._store.require_loss()
        async with self._zone_lock:
            audit = Audit(self._clock.stamp(), who, action)
            if action == "accept":
                await self._store.accept_loss(audit)
            elif self.core.zones_loaded:
                await self._store.restore(self.core.zones(), audit)
            else:
                raise RecoveryError(
                    "this service was started after the loss and has no zones: restore a backup of Redis, or accept"
                )
        await self.load_zones()

    async def _earlier_result(self, attempt: Attempt | None) -> Zone | None:
        """Return the zone that an earlier attempt stored, once it is on the map."""
        earlier = await self._store.earlier_result(attempt)
        if earlier is not None and self._reload_zones:
            await self._load_zones()
        return earlier

    @contextmanager
    def _uncertain_write(self) -> Iterator[None]:
        """Reload the zones after a failure: they may have been written although the reply was lost."""
        try:
            yield
        except StoreError as error:
            self._reload_zones = True
            self._health.set("store", ok=False, detail=str(error))
            ZONE_WRITES.labels("failed").inc()
            raise

    def _require_ok(self, outcome: Outcome, zone_id: str) -> None:
        ZONE_WRITES.labels(outcome).inc()
        if outcome != "ok":
            self._reload_zones = True
            raise ConflictError(outcome, zone_id)

    async def load_zones(self) -> None:
        """Replace the map's zones by the stored ones; raises `StoreError`."""
        async with self._zone_lock:
            await self._load_zones()

    async def _load_zones(self) -> None:
        zones = await self._store.zones()
        try:
            self._publish(self.core.load_zones(zones, self._edges.now()))
        except ShapeError as error:
            raise StoreError(f"a stored zone is invalid: {error}; repair or delete it") from error
        self._reload_zones = False
        detail = f"{len(zones)} loaded"
        if (excess := list_size(zones) - ch.ZONES.limit) > 0:
            detail += f"; their list is {excess} bytes too large for robots, which drive by the map alone: delete some"
            _log.error("zone_list_too_large", zones=len(zones), excess_bytes=excess, remedy="delete zones")
        self._health.set("zones", ok=True, detail=detail)
        self._health.set("store", ok=True)

    async def store_loop(self) -> None:
        """Load the zones, retrying until the store answers; then monitor it, and reload after an uncertain write."""
        while True:
            try:
                if self._reload_zones or not self.core.zones_loaded:
                    await self.load_zones()
                    if warning := await self._store.durability_warning():
                        _log.warning("store_not_durable", remedy=warning)
                else:
                    await self._store.check()
                    self._health.set("store", ok=True)
            except StoreError as error:
                # What was stored but never acknowledged may have gone with a failed primary.
                self._reload_zones = True
                self._health.set("store", ok=False, detail=str(error))
                if not self.core.zones_loaded:
                    self._health.set("zones", ok=False, detail=f"not loaded yet, so the map is not served: {error}")
            await asyncio.sleep(STORE_PERIOD_S)

    # --- Publishing -------------------------------------------------------------------------------------------------

    def _publish(self, publications: Sequence[Publication]) -> None:
        for publication in publications:
            if isinstance(publication.message, MapDelta):
                self._record_delta(publication.message)
            elif isinstance(publication.message, ZoneSet):
                ZONES.labels("stored").set(len(publication.message.zones))
                ZONES.labels("active").set(len(self.core.active_zones()))
            self._edges.publish(publication)

    def _record_delta(self, delta: MapDelta) -> None:
        DELTA_BYTES.observe(len(delta.cells))
        if delta.part > 0:
            return
        VERSION.set(delta.seq)
        for trace in delta.traces:
            metrics.observe_trace(trace, ["costmap"])
        _log.info(
            "map_version_published",
            seq=delta.seq,
            parts=delta.parts,
            causes=[f"{c.id} {c.state}" for c in delta.causes],
        )
