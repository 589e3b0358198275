"""Runs the core: publishes what it returns, stores its hazards, and stores areas before they take effect."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final, get_args

from msgspec import structs
from prometheus_client import Counter, Gauge

from fog_contracts import channels as ch
from fog_contracts.messages import AreaHazard, AreaState
from fog_runtime import logs, metrics
from fog_runtime.clock import ticker
from fog_runtime.edges import Edges
from fog_runtime.redis_connection import StoreRefusedError
from hazard_aggregator.store import Audit, RecoveryError, StoreError, StoreLostError, usable_areas

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Literal

    from fog_contracts.handlers import Publication
    from fog_contracts.messages import AreaDefinition
    from fog_runtime.clock import Clock
    from fog_runtime.edges import Gate
    from fog_runtime.health import Health
    from fog_runtime.idempotency import Attempt
    from fog_runtime.mqtt_edge import MqttEdge
    from fog_runtime.zenoh_edge import ZenohEdge
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.store import Store

TICK_S = 0.1
STORE_RETRY_S = 0.5
AREA_STATES: Final[tuple[str, ...]] = get_args(AreaState)

HAZARDS = Gauge("fognav_hazards", "Whether an area is announced in this state (1) or not (0)", ["area", "state"])
WITHHELD = Gauge("fognav_hazards_withheld", "Areas whose relief is withheld until it is stored")
UNSTORED = Gauge("fognav_hazards_unstored", "Areas whose newest hazard is not stored yet")
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


class ConflictError(Exception):
    """An area has another version than the writer expected."""

    def __init__(self, area: str) -> None:
        super().__init__(f"area {area} was changed by somebody else")


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
    ) -> None:
        """Prepare; `gate` decides whether this process leads or stands by."""
        self.core = core
        self._store = store
        self._mqtt = mqtt
        self._gate = gate
        self._edges = Edges(clock, mqtt=mqtt, zenoh=zenoh, gate=gate)
        self._clock = clock
        self._health = health
        self._write_pending = asyncio.Event()
        self._store_loaded = asyncio.Event()
        self._area_lock = asyncio.Lock()
        self._reload_areas = False
        self._leading = asyncio.Event()
        self._limited = logs.RateLimited(_log)
        self._logged: dict[str, int] = {}  # the seq of each area's last hazard in the log

    def subscribe(self) -> None:
        """Register the core's handlers; call before the connections run."""
        self._edges.subscribe(self.core.handlers(), self._announce, numbers=self.core.thesis_numbers())
        self._edges.serve(self.core.query_handlers())
        self._mqtt.on_connect(self._republish_all)

    async def put_area(
        self,
        definition: AreaDefinition,
        who: str,
        *,
        expected: int | None = None,
        must_be_new: bool = False,
        attempt: Attempt | None = None,
    ) -> AreaDefinition:
        """Store an area as its next version, then put it into force; with `expected`, only if that is its version.

        With `must_be_new`, only if there is none (a removed one counts as none). An `attempt` that succeeded before
        returns its area again. Raises `ConflictError`, `IdempotencyError`, and `StoreError`: then the area may be
        stored or not.
        """
        async with self._area_lock:
            with self._uncertain_write():
                if (earlier := await self._store.earlier_result(attempt)) is not None:
                    if self._reload_areas:
                        await self._load_areas()
                    return earlier
            old = next((known for known in self.core.definitions() if known.id == definition.id), None)
            if must_be_new and old is not None and not old.removed:
                raise ConflictError(definition.id)
            if expected is not None and (old is None or old.version != expected):
                raise ConflictError(definition.id)
            definition = structs.replace(definition, version=1 if old is None else old.version + 1)
            with self._uncertain_write():
                await self._store_area(definition, old, Audit(self._clock.stamp(), who, "put", attempt))
            self._announce(self.core.put_area(definition, self._edges.now()))
        await self._subscribe_numbers()
        return definition

    async def _store_area(self, definition: AreaDefinition, old: AreaDefinition | None, audit: Audit) -> None:
        """Store an area as the successor of `old`; raises `ConflictError` and `StoreError`."""
        version = definition.version - 1
        outcome = await self._store.put_area(definition, expected=version, audit=audit, before=old)
        if outcome == "missing":
            # An administrator accepted a store without this area, which stays in force: it is stored again.
            outcome = await self._store.put_area(definition, expected=0, audit=audit, before=old)
        if outcome != "ok":
            self._reload_areas = True
            raise ConflictError(definition.id)

    @contextmanager
    def _uncertain_write(self) -> Iterator[None]:
        """Reload the areas after a failure: one may have been written although the reply was lost."""
        if not self._store_loaded.is_set():
            # Neither versions nor conditions can be judged by the site's definitions alone.
            raise StoreRefusedError("the stored areas are not loaded yet: /readyz says why")
        try:
            yield
        except StoreError as error:
            self._reload_areas = True
            self._health.set("store", ok=False, detail=str(error))
            raise

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Restore areas and hazards from memory, or accept those in Redis, after Redis lost records.

        Raises `RecoveryError` and `StoreError`.
        """
        await self._store.require_loss()
        audit = Audit(self._clock.stamp(), who, action)
        async with self._area_lock:
            if action == "accept":
                await self._store.accept_loss(audit)
                self._reload_areas = True
            elif self._store_loaded.is_set():
                stored = [definition for definition in self.core.definitions() if definition.version > 0]
                await self._store.restore(stored, self.core.announced().values(), audit)
            else:
                raise RecoveryError(
                    "this service was started after the loss and has no stored areas: restore a backup of Redis, or"
                    " accept"
                )

    async def _reload_stored_areas(self) -> None:
        """Put stored areas into force that differ from the known ones; raises `StoreError`."""
        async with self._area_lock:
            await self._load_areas()
        await self._subscribe_numbers()

    async def _load_areas(self) -> None:
        known = {definition.id: definition for definition in self.core.definitions()}
        for definition in usable_areas(await self._store.areas(), self.core.check):
            if definition != known.get(definition.id):
                self._announce(self.core.put_area(definition, self._edges.now()))
        self._reload_areas = False

    # --- Publishing -------------------------------------------------------------------------------------------------

    def _announce(self, publications: Sequence[Publication]) -> None:
        """Publish decisions of the core, and log each new one once, however often it is published again."""
        for publication in publications:
            hazard = publication.message
            if isinstance(hazard, AreaHazard) and self._logged.get(hazard.area) != hazard.seq:
                self._logged[hazard.area] = hazard.seq
                if hazard.trace is not None:
                    metrics.observe_trace(hazard.trace, ["debounce"])
                _log.info(
                    "hazard_announced", area=hazard.area, state=hazard.state, penalty=hazard.penalty, cause=hazard.cause
                )
        self._publish(publications)

    def _publish(self, publications: Sequence[Publication]) -> None:
        for publication in publications:
            if isinstance(hazard := publication.message, AreaHazard):
                for state in AREA_STATES:
                    HAZARDS.labels(hazard.area, state).set(hazard.state == state)
            elif publication.message is None and publication.channel is ch.AREA_HAZARD:
                for state in AREA_STATES:
                    with suppress(KeyError):  # an area that another aggregator had published
                        HAZARDS.remove(publication.ids["area"], state)
            self._edges.publish(publication)
        WITHHELD.set(len(self.core.withheld()))
        UNSTORED.set(len(self.core.to_store()))
        if self.core.to_store():
            self._write_pending.set()

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

    async def _republish_all(self) -> None:
        self._publish(self.core.republish_all())

    async def _subscribe_numbers(self) -> None:
        for number in self.core.thesis_numbers():
            await self._mqtt.add_number(ch.THESIS_AREA, number)

    async def tick_loop(self) -> None:
        """Tick the core, and report the broker connection's health."""
        async for _ in ticker(self._clock, TICK_S):
            self._announce(self.core.tick(self._edges.now()))
            self._report_foreign()
            for node, reason in self.core.pop_rejections():
                REJECTED.labels(node, reason).inc()
            PENDING.set(self._mqtt.pending)
            self._health.set(
                "mqtt", ok=self._mqtt.connected, detail="" if self._mqtt.connected else "not connected to the broker"
            )

    # --- The store --------------------------------------------------------------------------------------------------

    async def write_loop(self) -> None:
        """Store hazards, retrying until Redis has them; then announce the reliefs that were withheld for it."""
        await self._store_loaded.wait()
        if warning := await self._store.durability_warning():
            _log.warning("store_not_durable", remedy=warning)
        while True:
            await self._leading.wait()
            await self._write_pending.wait()
            self._write_pending.clear()
            while self._leading.is_set() and (unstored := self.core.to_store()):
                try:
                    await self._store.save_hazards(unstored)
                except StoreError as error:
                    self._health.set("store", ok=False, detail=str(error))
                    await asyncio.sleep(STORE_RETRY_S)
                    continue
                self._health.set("store", ok=True)
                self._announce(self.core.mark_stored(unstored))

    def mark_store_loaded(self) -> None:
        """Record that the stored state is loaded, which allows writing."""
        self._store_loaded.set()
        self._health.set("store", ok=True)

    async def store_loop(self) -> None:
        """Monitor Redis; load its records as soon as it answers, before any write."""
        while True:
            await asyncio.sleep(STORE_RETRY_S)
            try:
                await self._use_store()
            except StoreError as error:
                # What was stored but never acknowledged may have gone with a failed primary.
                self._reload_areas = True
                self._health.set("store", ok=False, detail=str(error))

    async def _use_store(self) -> None:
        if self._leading.is_set() and not self._store_loaded.is_set():
            self._publish(await self._load())
            self.mark_store_loaded()
        if self._leading.is_set() and self._reload_areas:
            await self._reload_stored_areas()
        await self._store.check()
        self._health.set("store", ok=True)

    async def _load(self) -> Sequence[Publication]:
        """Put the stored areas and hazards into force; return everything, to be published."""
        async with self._area_lock:
            stored = await self._store.load()
            usable = usable_areas(stored.definitions, self.core.check)
            publications = self.core.restore(usable, stored.hazards, self._edges.now())
        await self._subscribe_numbers()
        return publications

    # --- Leading and standing by ------------------------------------------------------------------------------------

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load what is stored and continue with this epoch; raises `StoreError` for a confirmed one.

        With a provisional epoch, while the store can't be read, or when it lost records, the known areas go on.
        """
        self._store.epoch = epoch
        restored: Sequence[Publication] = []
        try:
            restored = await self._load()
        except StoreError as error:
            if confirmed and not isinstance(error, StoreLostError):
                raise
            self._health.set("store", ok=False, detail=str(error))
        else:
            self.mark_store_loaded()
        if epoch > self.core.epoch:
            self._publish(self.core.set_epoch(epoch))
        # All but the deletions of what other aggregators left is published with the new epoch already.
        self._publish([publication for publication in restored if publication.message is None])
        self._leading.set()
        self._write_pending.set()

    def stand_by(self) -> None:
        """Follow the nodes, and the hazards of the aggregator that leads; announce and store nothing."""
        self._leading.clear()
