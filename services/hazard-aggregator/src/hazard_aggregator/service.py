"""Runs the core: publishes what it returns, stores its hazards, and stores areas before they take effect."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from prometheus_client import Counter, Gauge

from fog_runtime import logs
from fog_runtime.clock import ticker
from fog_runtime.stores.redis_connection import StoreError, StoreLostError
from fog_runtime.transports.edges import Edges
from hazard_aggregator.alert_persistence import AlertPersistence
from hazard_aggregator.area_size import excess
from hazard_aggregator.publisher import Availability, HistoryPersistence, Publisher
from hazard_aggregator.records import Records
from hazard_aggregator.writers import AreaWriter, OverrideWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.handlers import Publication
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.records import AuditEntry
    from fog_runtime.transports.edges import Gate
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.store import Store

TICK_S = 0.1
STORE_RETRY_S = 0.5

PENDING = Gauge("fognav_mqtt_pending_messages", "Messages that wait for the connection or for the broker's answer")
REJECTED = Counter(
    "fognav_readings_rejected_total",
    "Readings that do not count as measurements, by node and reason",
    ["node", "reason"],
)
FOREIGN = Counter(
    "fognav_foreign_messages_total",
    "Messages on the aggregator's topics that it did not publish itself, by what they are about",
    ["kind"],
)

_log = logs.get("aggregator")


class Service:
    """The running aggregator; its loops are tasks of the process."""

    def __init__(  # noqa: PLR0913  # the process's parts
        self,
        core: Aggregator,
        store: Store,
        mqtt: MqttEdge,
        zenoh: ZenohEdge,
        clock: Clock,
        health: Health,
        gate: Gate | None = None,
        *,
        boot: str = "",
        site: str = "",
    ) -> None:
        """Prepare; `gate` decides whether this process leads or stands by, `boot` is `clock.boot_id`.

        Home Assistant is told of the areas of `site`, the site's id, if that is given.
        """
        self.core = core
        self._store = store
        self._mqtt = mqtt
        self._gate = gate
        self._clock = clock
        self._health = health
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh, gate=gate)
        self._leading = asyncio.Event()
        self.history = HistoryPersistence(core, store, self._leading)
        self._availability = Availability(self._edges, self._leading)
        self.alerts = AlertPersistence(core, store, self._edges, clock, self._leading)
        self._publisher = Publisher(core, self._edges, self.history, site)
        self.records = Records(core, store, self._publisher, mqtt, self._edges, clock, health, boot)
        self.areas = AreaWriter(core, store, self.records, self._publisher, self._edges, clock)
        self.overrides = OverrideWriter(core, store, self.records, self._publisher, self._edges, clock, boot)
        self._limited = logs.RateLimited(_log)

    def subscribe(self) -> None:
        """Register the core's handlers; call before the connections run."""
        self._edges.subscribe(self.core.handlers(), self._publisher.announce, numbers=self.core.thesis_numbers())
        self._edges.serve(self.core.query_handlers())
        self._mqtt.on_connect(self._publisher.republish_all)
        self._mqtt.on_connect(self.alerts.publish)
        self._availability.subscribe(self._mqtt)
        self._mqtt.on_connection_lost(lambda: self._publisher.announce(self.core.on_connection_lost(self._edges.now())))

    async def tick_loop(self) -> None:
        """Tick the core, and report the broker connection's health."""
        async for _ in ticker(self._clock, TICK_S):
            self._publisher.announce(self.core.tick(self._edges.now()))
            self._report_foreign()
            for node, reason in self.core.pop_rejections():
                REJECTED.labels(node, reason).inc()
            PENDING.set(self._mqtt.pending)
            self._health.set(
                "mqtt", ok=self._mqtt.connected, detail="" if self._mqtt.connected else "not connected to the broker"
            )

    def _report_foreign(self) -> None:
        """Report what others say on our topics; on standby it is the leader."""
        found = self.core.pop_foreign()
        if not self._leading.is_set():
            return
        if self._gate is not None and (outranked_by := self.core.outranked_by) is not None:
            self._gate.on_rival(outranked_by)
        for foreign in found:
            FOREIGN.labels(foreign.kind).inc()
            self._limited.warning(
                "foreign_message",
                f"{foreign.kind} {foreign.epoch}",
                self._clock.now(),
                **foreign._asdict(),
                remedy="only one fog may use this broker and site; an area that left the site is deleted",
            )

    # --- The store --------------------------------------------------------------------------------------------------

    async def write_loop(self) -> None:
        """Store hazards, retrying until Redis has them; then announce the reliefs that were withheld for it."""
        await self.records.loaded.wait()
        if warning := await self._store.durability_warning():
            _log.warning("store_not_durable", remedy=warning)
        while True:
            await self._leading.wait()
            await self._publisher.write_pending.wait()
            self._publisher.write_pending.clear()
            while self._leading.is_set() and (unstored := self.core.to_store()):
                try:
                    await self._store.save_hazards(unstored)
                except StoreError as error:
                    self._health.set("store", ok=False, detail=str(error))
                    await asyncio.sleep(STORE_RETRY_S)
                    continue
                self._health.set("store", ok=True)
                self._publisher.announce(self.core.mark_stored(unstored))

    async def undoable(self, entry: str, record: str, kinds: Sequence[str]) -> AuditEntry:
        """Return an entry of the audit trail that may be undone; raises `UndoError` and `StoreError`."""
        return await self._store.undoable(entry, record, kinds)

    async def store_loop(self) -> None:
        """Monitor Redis; load its records as soon as it answers, before any write."""
        while True:
            await asyncio.sleep(STORE_RETRY_S)
            problem = excess(self.core.definitions())
            self._health.set("area_count", ok=not problem, detail=problem)
            try:
                await self._use_store()
            except StoreError as error:
                # What was stored but never acknowledged may have gone with a failed primary.
                self.records.request_reload()
                self._health.set("store", ok=False, detail=str(error))

    async def _use_store(self) -> None:
        if self._leading.is_set() and not self.records.loaded.is_set():
            self._publisher.publish(await self.records.load())
            self.records.mark_loaded()
        if self._leading.is_set():
            await self.records.reload()
            await self.history.forget_removed(self._edges.now())
            await self.records.keep_places()
            await self.overrides.keep()
        await self._store.check()
        self._health.set("store", ok=True)

    # --- Leading and standing by ------------------------------------------------------------------------------------

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load what is stored and continue with this epoch; raises `StoreError` for a confirmed one.

        With a provisional epoch, while the store can't be read, or when it lost records, the known areas go on.
        """
        self._store.epoch = epoch
        restored: Sequence[Publication] = []
        try:
            restored = await self.records.load()
        except StoreError as error:
            if confirmed and not isinstance(error, StoreLostError):
                raise
            self.records.request_reload()
            self._health.set("store", ok=False, detail=str(error))
        else:
            self.records.mark_loaded()
        if epoch > self.core.epoch:
            self._publisher.publish(self.core.set_epoch(epoch))
            # All but the deletions of what other aggregators left is published with the new epoch now.
            restored = [publication for publication in restored if publication.message is None]
        self._publisher.publish(restored)
        self._leading.set()
        self._availability.announce()
        self._publisher.write_pending.set()

    def stand_by(self) -> None:
        """Follow the nodes, and the hazards of the aggregator that leads; announce and store nothing."""
        self._leading.clear()
        self._store.epoch = 0
        self.core.overrides.follow_others()
