"""Runs the core: ticks it, connects it to its channels, and follows the store."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Counter, Gauge

from fog_contracts import channels as ch
from fog_contracts.site import Site
from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.configuration.uploaded_maps import UploadedMaps
from fog_runtime.stores.redis_connection import StoreError, StoreLostError
from fog_runtime.transports.edges import Edges
from map_service.places import StoredPlace, combined
from map_service.publisher import Publisher
from map_service.record_writer import RecordWriter
from map_service.site_map import MapFile, StoredMap
from map_service.store import PLACES, SITE_MAPS, ZONE_SETS, ZONE_SOURCES
from map_service.zone_sources import ZoneSources
from map_service.zone_times import MutedSource, SetOfZones
from map_service.zone_writer import ZoneTimesPersistence, ZoneWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Moment
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.records import AuditEntry, AuditPage
    from fog_runtime.transports.edges import Gate
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from map_service.core import MapCore
    from map_service.store import Store

TICK_S = ch.MAP_HEARTBEAT.period_s
STORE_PERIOD_S = 0.5

AGGREGATOR_AGE = Gauge(
    "fognav_aggregator_heartbeat_age_seconds", "Time since the aggregator's latest heartbeat was sent"
)
AGGREGATOR_DELAY = Gauge(
    "fognav_aggregator_heartbeat_delay_seconds",
    "How much longer the aggregator's latest heartbeat took than its fastest one",
)
AREAS_UNCONFIRMED = Gauge("fognav_areas_unconfirmed", "Areas whose hazard no living aggregator confirms")
OBSTACLES_REFUSED = Counter(
    "fognav_obstacles_refused_total",
    "Obstacle cells that are not on the map: it holds as many as it may, or their robot can't see them from its pose",
)
CLOCK_SYNCHRONIZED = Gauge("fognav_clock_synchronized", "Whether something keeps the time of day synchronized")
CLOCK_UNKNOWN = (
    "nothing keeps the time of day synchronized: zones with a start, an end or a schedule are in force until it is"
    " known (FOGNAV_WALL_CLOCK=trusted if the machine's clock is right)"
)

_log = logs.get("map")


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
        site: Site | None = None,
        maps: UploadedMaps | None = None,
        synchronized: Callable[[], bool] = lambda: True,
        boot: str = "",
    ) -> None:
        """Prepare; `gate` decides whether this process leads or stands by.

        `site` gives the initial places, and the sources of zones; `maps` are those that it was given by REST.
        `synchronized` tells whether the time of day is right; `boot` is `clock.boot_id`.
        """
        self.core = core
        self._synchronized = synchronized
        self._times = ZoneTimesPersistence(core, store, boot)
        self._store = store
        self._mqtt = mqtt
        self._clock = clock
        self._health = health
        self.zenoh = zenoh
        """For questions to the planner."""
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh, gate=gate)
        self.publisher = Publisher(core, self._edges, self._now)
        self.zones = ZoneWriter(core, store, self._times, self.publisher, health, self._now)
        self._site = site or Site(id="site")
        publish, places = self.publisher.publish, self._site.places
        self.initial_places = places
        """Those of `site.toml`."""
        self.sets = RecordWriter(
            ZONE_SETS, SetOfZones, store, self.zones, lambda sets: publish(core.put_zone_sets(sets, self._now()))
        )
        self.places = RecordWriter(
            PLACES, StoredPlace, store, self.zones, lambda stored: publish(core.put_places(combined(places, stored)))
        )
        self.muted = RecordWriter(ZONE_SOURCES, MutedSource, store, self.zones, lambda _: None)
        self.maps = maps or UploadedMaps(Path("maps"))
        self._map_file = MapFile(self.maps)
        self.site_map = RecordWriter(SITE_MAPS, StoredMap, store, self.zones, self._map_file.use)
        self.zones.beside = (self.sets, self.places, self.muted, self.site_map)
        core.put_places(combined(places, {}))
        self.zone_sources = ZoneSources(
            self._site, core, self.zones, self.sets, self.muted, self.publisher.publish, mqtt
        )
        self._leading = False
        self._serving_queries = False
        self._aggregator_alive = False
        self._refused_cells = 0

    def _now(self) -> Moment:
        return structs.replace(self._edges.now(), synchronized=self._synchronized())

    def subscribe(self) -> None:
        """Register the core's handlers; call before the connections run."""
        self._edges.subscribe(self.core.handlers(), self.publisher.publish)

    async def tick_loop(self) -> None:
        """Tick the core, and answer queries once it serves the map."""
        async for _ in ticker(self._clock, TICK_S):
            connected, at = self._mqtt.connected, self._now()
            publications = self.core.tick(at)
            if self.core.serving and not self._serving_queries:
                # Before the first publication: channels with a key for each area are served as these are published.
                self._serving_queries = True
                self._edges.serve(self.core.query_handlers())
            self.publisher.publish(publications)
            self._observe_aggregator(at.now)
            self._observe_layers()
            CLOCK_SYNCHRONIZED.set(at.synchronized)
            self._health.set("clock", ok=True, detail="" if at.synchronized else CLOCK_UNKNOWN)
            self._health.set("map", ok=self.core.serving, detail=self.core.missing())
            self._health.set("mqtt", ok=connected, detail="" if connected else "not connected to the broker")

    # --- Leading and standing by ------------------------------------------------------------------------------------

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load the stored zones and continue with this epoch; raises `StoreError` for a confirmed one.

        With a provisional epoch, while the store can't be read, or when it lost records, the known zones stay; the map
        is not served before zones were loaded once.
        """
        self._store.epoch = epoch
        try:
            await self.zones.load()
        except StoreError as error:
            if confirmed and not isinstance(error, StoreLostError):
                raise
            self.zones.must_reload = True
        await self.publisher.all_on_map()
        self._leading = self.zone_sources.leading = True
        self.publisher.publish(self.core.lead(epoch))
        await self.zone_sources.listen()

    def stand_by(self) -> None:
        """Follow the inputs, and the stored zones, which another process changes now."""
        self._leading = self.zone_sources.leading = False
        self._store.epoch = 0

    async def serves(self) -> bool:
        """Return whether the map is complete; a copy whose map is not leaves the lease to one whose map is."""
        return self.core.serving

    # --- The store --------------------------------------------------------------------------------------------------

    async def audit(self, kinds: Sequence[str], cursor: str | None, limit: int) -> AuditPage:
        """Return a page of the site's audit trail; raises `CursorError` and `StoreError`."""
        return await self._store.audit(kinds=kinds, cursor=cursor, limit=limit)

    async def undoable(self, entry: str, record: str, kinds: Sequence[str]) -> AuditEntry:
        """Return an entry of the audit trail that may be undone; raises `UndoError` and `StoreError`."""
        return await self._store.undoable(entry, record, kinds)

    async def store_loop(self) -> None:
        """Load the zones, retrying until the store answers; then monitor it, and reload after an uncertain write.

        On standby the zones follow the stored ones.
        """
        while True:
            try:
                if not self._leading and self.core.zones_loaded:
                    await self.zones.load()
                elif self.zones.must_reload or not self.core.zones_loaded:
                    await self.zones.load()
                    if warning := await self._store.durability_warning():
                        _log.warning("store_not_durable", remedy=warning)
                else:
                    await self._store.check()
                    await self._times.save(self._clock.now())
                    await self.zones.delete_ended()
                    self._health.set("store", ok=True)
                self._map_file.write(self._clock.now())
            except StoreError as error:
                # What was stored but never acknowledged may have gone with a failed primary.
                self.zones.must_reload = True
                self._health.set("store", ok=False, detail=str(error))
                if not self.core.zones_loaded:
                    self._health.set("zones", ok=False, detail=f"not loaded yet, so the map is not served: {error}")
            await asyncio.sleep(STORE_PERIOD_S)

    def _observe_layers(self) -> None:
        before, self._refused_cells = self._refused_cells, self.core.refused_cells
        OBSTACLES_REFUSED.inc(self._refused_cells - before)

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
