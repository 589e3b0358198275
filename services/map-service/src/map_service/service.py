"""Runs the core: publishes what it returns, and stores zones before they take effect."""

from __future__ import annotations

import asyncio
import dataclasses
from contextlib import contextmanager
from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Counter, Gauge, Histogram

from fog_contracts import channels as ch
from fog_contracts.messages import MapDelta, MapHeartbeat, Zone, ZoneSet
from fog_contracts.shapes import ShapeError
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from fog_runtime.edges import Edges
from fog_runtime.work import Worker
from map_service.store import Audit, RecoveryError, StoreError, StoreLostError
from map_service.times_keeper import TimesKeeper
from map_service.zone_times import StoredState
from map_service.zone_validation import check_list_size, check_room, list_size, prepare_zone, zones_spans

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Literal

    from fog_contracts.handlers import Moment, Publication
    from fog_runtime.audit import AuditPage
    from fog_runtime.clock import Clock
    from fog_runtime.edges import Gate
    from fog_runtime.health import Health
    from fog_runtime.idempotency import Attempt
    from fog_runtime.mqtt_edge import MqttEdge
    from fog_runtime.zenoh_edge import ZenohEdge
    from map_service.core import MapCore
    from map_service.store import Outcome, Store
    from map_service.zone_validation import PreparedZone

TICK_S = ch.MAP_HEARTBEAT.period_s
STORE_PERIOD_S = 0.5

VERSION = Gauge("fognav_map_seq", "Sequence number of the map version within this epoch")
DELTA_BYTES = Histogram(
    "fognav_map_delta_bytes",
    "Size of the cells of one delta, encoded",
    buckets=(64, 256, 1024, 2048, 4096, 16384, 65536),
)
ZONES = Gauge("fognav_zones", "Zones, stored and active", ["state"])
ZONE_WRITES = Counter("fognav_zone_writes_total", "Writes of zones to the store, by outcome", ["outcome"])
AGGREGATOR_AGE = Gauge(
    "fognav_aggregator_heartbeat_age_seconds", "Time since the aggregator's latest heartbeat was sent"
)
AGGREGATOR_DELAY = Gauge(
    "fognav_aggregator_heartbeat_delay_seconds",
    "How much longer the aggregator's latest heartbeat took than its fastest one",
)
AREAS_UNCONFIRMED = Gauge("fognav_areas_unconfirmed", "Areas whose hazard no living aggregator confirms")
REQUESTS = Counter(
    "fognav_aggregator_requests_total", "Requests to publish all hazards again, because the map missed some"
)

COMMIT_SECONDS = Histogram(
    "fognav_map_commit_seconds",
    "Time of a map version's steps: combining the layers, inflating them, making the version",
    ["step"],
    buckets=(0.0001, 0.00025, 0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0),
)
HEARTBEAT_GAP = Histogram(
    "fognav_map_heartbeat_gap_seconds",
    "Time between two heartbeats of the map",
    buckets=(0.09, 0.11, 0.125, 0.15, 0.2, 0.25, 0.3, 0.5, 1.0, 2.0, 5.0),
)
EPOCH = Gauge("fognav_map_epoch", "Epoch of the map: when this process claimed it, in ms since 1970")
CLOCK_UNKNOWN = (
    "nothing keeps the time of day synchronized: zones with a start, an end or a schedule are in force until it is"
    " known (FOGNAV_WALL_CLOCK=trusted if the machine's clock is right)"
)
MAX_PREPARING = 64
"""Most zones that are validated or wait for it; further requests are answered with 503."""

_log = logs.get("map")


class ConflictError(Exception):
    """A zone has another version than the writer expected, or exists already."""

    def __init__(self, outcome: Outcome, zone_id: str) -> None:
        super().__init__(f"zone {zone_id}: {outcome}")
        self.outcome = outcome
        self.zone = zone_id


class Service:
    """The running map-service; its loops are tasks of the process."""

    def __init__(  # noqa: PLR0913  # the process's parts
        self,
        core: MapCore,
        store: Store,
        mqtt: MqttEdge,
        zenoh: ZenohEdge,
        clock: Clock,
        health: Health,
        gate: Gate | None = None,
        *,
        synchronized: Callable[[], bool] = lambda: True,
        boot: str = "",
    ) -> None:
        """Prepare; `gate` decides whether this process leads or stands by.

        `synchronized` tells whether the time of day is right; `boot` is `clock.boot_id`.
        """
        self.core = core
        self._synchronized = synchronized
        self._times = TimesKeeper(core, store, boot)
        self._store = store
        self._mqtt = mqtt
        self._clock = clock
        self._health = health
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh, gate=gate)
        self._zone_lock = asyncio.Lock()
        self._zone_worker = Worker("zones", limit=MAX_PREPARING)
        self._changes_wait = asyncio.Event()
        self._all_on_map = asyncio.Event()
        self._all_on_map.set()
        self._last_heartbeat: float | None = None
        core.costmap.measure = lambda step: COMMIT_SECONDS.labels(step).time()
        self._reload_zones = False
        self._leading = False
        self._serving_queries = False
        self._aggregator_alive = False

    def _now(self) -> Moment:
        return dataclasses.replace(self._edges.now(), synchronized=self._synchronized())

    def subscribe(self) -> None:
        """Register the core's handlers; call before the connections run."""
        self._edges.subscribe(self.core.handlers(), self._publish)

    async def tick_loop(self) -> None:
        """Tick the core, and answer queries once it serves the map."""
        async for _ in ticker(self._clock, TICK_S):
            connected, at = self._mqtt.connected, self._now()
            publications = self.core.tick(at)
            if self.core.serving and not self._serving_queries:
                # Before the first publication: channels with a key for each area are served as these are published.
                self._serving_queries = True
                self._edges.serve(self.core.query_handlers())
            self._publish(publications)
            self._observe_aggregator(at.now)
            self._health.set("clock", ok=True, detail="" if at.synchronized else CLOCK_UNKNOWN)
            self._health.set("map", ok=self.core.serving, detail=self.core.missing())
            self._health.set("mqtt", ok=connected, detail="" if connected else "not connected to the broker")

    async def commit_loop(self) -> None:
        """Put large changes on the map portion by portion; other tasks run in between."""
        while True:
            await self._changes_wait.wait()
            while self.core.pending:
                self._publish(self.core.continue_commit(self._now()))
                await asyncio.sleep(0)
            self._changes_wait.clear()
            self._all_on_map.set()

    # --- Leading and standing by ------------------------------------------------------------------------------------

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load the stored zones and continue with this epoch; raises `StoreError` for a confirmed one.

        With a provisional epoch, while the store can't be read, or when it lost records, the known zones stay; the map
        is not served before zones were loaded once.
        """
        self._store.epoch = epoch
        try:
            await self.load_zones()
        except StoreError as error:
            if confirmed and not isinstance(error, StoreLostError):
                raise
            self._reload_zones = True
        await self._all_on_map.wait()
        self._leading = True
        self._publish(self.core.lead(epoch))

    def stand_by(self) -> None:
        """Follow the inputs, and the stored zones, which another process changes now."""
        self._leading = False
        self._store.epoch = 0

    # --- Zones: stored first, then put on the map -------------------------------------------------------------------

    async def create(self, zone: Zone, who: str, attempt: Attempt | None = None) -> Zone:
        """Store a new zone and put it on the map; raises `ZoneError`, `ConflictError` (exists), `StoreError`.

        An `attempt` that succeeded before returns its zone again; raises `IdempotencyError` for another request's.
        """
        async with self._zone_lock:
            if (earlier := await self._earlier_result(attempt)) is not None:
                return earlier
            stamp = self._clock.stamp()
            if any(known.id == zone.id for known in self.core.zones()):
                # The store would treat an identical zone as a repeated attempt.
                raise ConflictError("exists", zone.id)
            zone, spans = await self._prepare(zone, stamp)
            audit = Audit(stamp, who, "create", attempt)
            with self._uncertain_write():
                outcome, zone = await self._store.create(zone, audit)
            self._require_ok(outcome, zone.id)
            self._publish(self.core.put_zone(zone, self._now(), spans))
        await self._all_on_map.wait()
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
            zone, spans = await self._prepare(structs.replace(zone, version=expected + 1), stamp)
            audit = Audit(stamp, who, "replace", attempt)
            with self._uncertain_write():
                outcome = await self._store.replace(zone, expected=expected, audit=audit)
            self._require_ok(outcome, zone.id)
            self._publish(self.core.put_zone(zone, self._now(), spans))
        await self._all_on_map.wait()
        return zone

    async def delete(self, zone: Zone, who: str) -> None:
        """Delete this version of a zone; raises `ConflictError` (stale) and `StoreError`."""
        async with self._zone_lock:
            with self._uncertain_write():
                outcome = await self._store.delete(zone, Audit(self._clock.stamp(), who, "delete"))
            self._require_ok(outcome, zone.id)
            self._publish(self.core.remove_zone(zone.id, self._now()))
        await self._all_on_map.wait()

    async def _prepare(self, zone: Zone, stamp: float) -> PreparedZone:
        """Validate and rasterize a zone on the worker thread; raises `ZoneError`, and `BusyError` if too many wait."""
        stamp = stamp if self._synchronized() else 0.0
        geometry, others = self.core.costmap.geometry, self.core.zones_besides(zone.id)
        prepared = await self._zone_worker.run(prepare_zone, zone, geometry, stamp)
        check_room(prepared, *others, geometry)
        await self._zone_worker.run(check_list_size, prepared.zone, self.core.zones())
        return prepared

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

    async def reload_after_uncertain_write(self) -> None:
        """Load the zones if a failed write may have been stored, so that what is missing here is missing there, too.

        Raises `StoreError`.
        """
        if self.core.zones_loaded and self._reload_zones:
            await self.load_zones()

    async def earlier_result(self, attempt: Attempt | None) -> Zone | None:
        """Return the zone that an earlier attempt stored, once it is on the map; None for a first attempt.

        Raises `IdempotencyError` for another request's attempt, and `StoreError`.
        """
        async with self._zone_lock:
            return await self._earlier_result(attempt)

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
        """Replace the map's zones by the stored ones, where they differ; raises `StoreError`."""
        async with self._zone_lock:
            await self._load_zones()

    async def _load_zones(self) -> None:
        zones = await self._store.zones()
        known = {zone.id: zone for zone in self.core.zones()}
        if not self.core.zones_loaded or {zone.id: zone for zone in zones} != known:
            changed = [zone for zone in zones if zone.id not in known or known[zone.id].shape != zone.shape]
            try:
                spans = await self._zone_worker.run(zones_spans, changed, self.core.costmap.geometry)
                stored = StoredState(spans=spans, progress=await self._times.load(), boot=self._times.boot)
                self._publish(self.core.load_zones(zones, self._now(), stored))
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
        """Load the zones, retrying until the store answers; then monitor it, and reload after an uncertain write.

        On standby the zones follow the stored ones.
        """
        while True:
            try:
                if not self._leading and self.core.zones_loaded:
                    await self.load_zones()
                elif self._reload_zones or not self.core.zones_loaded:
                    await self.load_zones()
                    if warning := await self._store.durability_warning():
                        _log.warning("store_not_durable", remedy=warning)
                else:
                    await self._store.check()
                    await self._times.save(self._clock.now())
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
            if publication.channel is ch.AGGREGATOR_REQUEST:
                REQUESTS.inc()
                _log.warning("hazards_requested", missing=self.core.aggregator.overdue(self._clock.now()))
            elif isinstance(publication.message, MapDelta):
                self._record_delta(publication.message)
            elif isinstance(publication.message, ZoneSet):
                ZONES.labels("stored").set(len(publication.message.zones))
                ZONES.labels("active").set(len(self.core.active_zones()))
            elif isinstance(publication.message, MapHeartbeat):
                self._record_heartbeat()
            self._edges.publish(publication)
        if self.core.pending:
            self._all_on_map.clear()
            self._changes_wait.set()

    def _record_heartbeat(self) -> None:
        now, last = self._clock.now(), self._last_heartbeat
        self._last_heartbeat = now
        if last is not None:
            HEARTBEAT_GAP.observe(now - last)

    def _observe_aggregator(self, now: float) -> None:
        aggregator = self.core.aggregator
        AGGREGATOR_AGE.set(aggregator.age(now))
        AGGREGATOR_DELAY.set(aggregator.delay_s)
        AREAS_UNCONFIRMED.set(sum(not area.confirmed for area in self.core.hazards()))
        alive = aggregator.alive(now)
        if alive != self._aggregator_alive:
            self._aggregator_alive = alive
            if alive:
                _log.info("aggregator_alive", epoch=aggregator.epoch)
            else:
                _log.warning("aggregator_lost", consequence="no area counts as clear")

    def _record_delta(self, delta: MapDelta) -> None:
        DELTA_BYTES.observe(len(delta.cells))
        if delta.part > 0:
            return
        VERSION.set(delta.seq)
        EPOCH.set(delta.epoch)
        for trace in delta.traces:
            metrics.observe_trace(trace, ["costmap"])
        _log.info(
            "map_version_published",
            seq=delta.seq,
            parts=delta.parts,
            causes=[f"{c.id} {c.state}" for c in delta.causes],
        )
