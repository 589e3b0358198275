"""Keeps what is in force equal to what is stored: loads records, again after uncertain writes, and recovers them."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager
from typing import TYPE_CHECKING

from msgspec import structs
from prometheus_client import Gauge

from fog_contracts import channels as ch
from fog_contracts.messages import FusionPolicy
from fog_runtime import logs
from fog_runtime.stores.redis_connection import StoreError, StoreRefusedError
from fog_runtime.stores.redis_store import Audit, RecoveryError
from hazard_aggregator.area_size import AreaError, check_size
from hazard_aggregator.overrides import StoredOverrides
from hazard_aggregator.source_values import SourceError
from hazard_aggregator.store import Stored

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from typing import Final, Literal

    from fog_contracts.handlers import Publication
    from fog_contracts.messages import AreaDefinition
    from fog_runtime.clock import Clock
    from fog_runtime.health import Health
    from fog_runtime.stores.redis_store import StoreStatus
    from fog_runtime.transports.edges import Edges
    from fog_runtime.transports.mqtt_edge import MqttEdge
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.publisher import Publisher
    from hazard_aggregator.store import Store

UNUSABLE = Gauge("fognav_areas_unusable", "Stored areas that nothing watches because their records are invalid")

_log = logs.get("aggregator")


class UnusableAreas:
    """Why each of them is unusable, by id; `checked` returns an area as it counts, or raises `AreaError`."""

    def __init__(self, checked: Callable[[AreaDefinition], AreaDefinition], health: Health) -> None:
        self._checked = checked
        self._health = health
        self.reasons: dict[str, str] = {}
        self._records: dict[str, AreaDefinition] = {}
        self.moved: list[AreaDefinition] = []
        """Areas of the last call that are the cones of nodes, and are elsewhere now than their records have them."""

    def made_usable(self, definitions: Iterable[AreaDefinition], unreadable: Mapping[str, str]) -> list[AreaDefinition]:
        """Return stored areas such that each is usable: without nodes and sources those that are not, or were not read.

        A rule may have gone with the package that provided it, or the node whose cone the area is. The area stays on
        the map where its record has it, unknown, until somebody PUTs it again: left out, it would count as clear.
        `unreadable` tells why records could not be read.
        """
        reasons, usable, records = dict(unreadable), [], {}
        self.moved = []
        for definition in definitions:
            try:
                usable.append(self._usable(definition))
                if usable[-1].polygon != definition.polygon:
                    self.moved.append(usable[-1])
            except AreaError as error:
                reasons[definition.id] = str(error)
                records[definition.id] = definition
                rest = structs.replace(definition, nodes=[], sources=[], debounce={}, fusion=FusionPolicy())
                usable.append(structs.replace(rest, cone_of=None))
        self._records = records
        self._report(reasons)
        return usable

    def of_site(self, definitions: Iterable[AreaDefinition]) -> list[AreaDefinition]:
        """Return the areas of a site's file; without anything that watches them those that have an invalid source.

        They are unknown until somebody mends them, and the floor goes on. Raises `AreaError` for other mistakes.
        """
        usable = []
        for definition in definitions:
            try:
                usable.append(self._checked(definition))
            except SourceError as error:
                remedy = "mend it in site.toml, or PUT the area; until then it is unknown"
                _log.error("site_area_unusable", area=definition.id, reason=str(error), remedy=remedy)
                rest = self._checked(structs.replace(definition, sources=[], fusion=FusionPolicy()))
                usable.append(structs.replace(rest, nodes=[], cone_of=None))
        return usable

    def as_stored(self, definition: AreaDefinition) -> AreaDefinition:
        """Return the record of an area in force: whole, where it was made usable and was not PUT again since then."""
        record = self._records.get(definition.id)
        return definition if record is None or record.version != definition.version else record

    def _usable(self, definition: AreaDefinition) -> AreaDefinition:
        if definition.removed:
            return definition
        counts = self._checked(definition)
        check_size(counts)
        return counts

    def _report(self, reasons: dict[str, str]) -> None:
        for area, reason in reasons.items():
            if self.reasons.get(area) != reason:
                _log.error("stored_area_unusable", area=area, reason=reason, remedy="PUT the area again")
        self.reasons = reasons
        UNUSABLE.set(len(reasons))
        named = ", ".join(f"{area} ({reason})" for area, reason in sorted(reasons.items()))
        detail = f"unknown until they are PUT again, because their records are invalid: {named}"
        self._health.set("areas", ok=True, detail=detail[:500] if named else "")


_ITSELF: Final = "hazard-aggregator"
"""Who changed an area without an operator's request, in the audit trail."""


class Records:
    """The stored areas, hazards and overrides. Who changes one holds `lock`, and writes inside `uncertain_write`.

    `loaded` is set once the records were loaded, before which nothing may be written; `boot` is `clock.boot_id`.
    """

    def __init__(  # noqa: PLR0913  # the process's parts
        self,
        core: Aggregator,
        store: Store,
        publisher: Publisher,
        mqtt: MqttEdge,
        edges: Edges,
        clock: Clock,
        health: Health,
        boot: str,
    ) -> None:
        self.lock = asyncio.Lock()
        self.loaded = asyncio.Event()
        self._core = core
        self._store = store
        self._publisher = publisher
        self._mqtt = mqtt
        self._edges = edges
        self._clock = clock
        self._health = health
        self._boot = boot
        self._unusable = UnusableAreas(core.checked, health)
        self._reload_due = False

    def mark_loaded(self) -> None:
        """Record that the stored state is loaded, which allows writing."""
        self.loaded.set()
        self._health.set("store", ok=True)

    def request_reload(self) -> None:
        """Have the records loaded again: they may differ from what is in force."""
        self._reload_due = True

    @contextmanager
    def uncertain_write(self) -> Iterator[None]:
        """Reload the records after a failure: one may have been written although the reply was lost."""
        if not self.loaded.is_set():
            # Neither versions nor conditions can be judged by the site's definitions alone.
            raise StoreRefusedError("the stored areas are not loaded yet: /readyz says why")
        try:
            yield
        except StoreError as error:
            self._reload_due = True
            self._health.set("store", ok=False, detail=str(error))
            raise

    async def load(self) -> Sequence[Publication]:
        """Put the stored records into force; return everything, to be published. Raises `StoreError`."""
        async with self.lock:
            stored = await self._store.load()
            usable = self._unusable.made_usable(stored.definitions, stored.unreadable)
            overrides = StoredOverrides(stored.overrides, stored.rests, self._boot)
            changed = self._core.load_overrides(overrides, self._edges.now())
            publications = [*changed, *self._core.restore(usable, stored.hazards, self._edges.now())]
        await self.subscribe()
        return publications

    async def reload(self) -> None:
        """Put stored records into force that differ from the known ones, if there may be any; raises `StoreError`."""
        if not self._reload_due:
            return
        async with self.lock:
            await self.reload_holding_lock()
        await self.subscribe()

    async def reload_holding_lock(self) -> None:
        """Do the same for a caller that holds `lock`, who calls `subscribe` then."""
        if not self._reload_due:
            return
        known = {definition.id: definition for definition in self._core.definitions()}
        for definition in self._unusable.made_usable(*await self._store.areas()):
            if definition != known.get(definition.id):
                self._publisher.announce(self._core.put_area(definition, self._edges.now()))
        overrides = StoredOverrides(*await self._store.overrides(), self._boot)
        self._publisher.announce(self._core.load_overrides(overrides, self._edges.now()))
        self._reload_due = False

    async def keep_places(self) -> None:
        """Store where areas are now that are the cones of nodes which have moved; raises `StoreError`.

        That is where such an area stays if its node leaves the site.
        """
        async with self.lock:
            while self._unusable.moved:
                definition = self._unusable.moved[-1]
                audit = Audit(self._clock.stamp(), _ITSELF, "follow")
                with self.uncertain_write():
                    # Of another version, it was PUT since then, with the place of that time.
                    await self._store.put_area(definition, expected=definition.version, audit=audit)
                self._unusable.moved.pop()

    async def load_again(self) -> None:
        """Put the stored records into force whether or not they may differ, for a caller that holds `lock`."""
        self._reload_due = True
        await self.reload_holding_lock()

    async def subscribe(self) -> None:
        """Subscribe to the thesis's topics of all areas, and to their sources' own."""
        topics, again = self._core.source_topics(), self._core.pop_new_source_topics()
        await self._mqtt.listen_to_foreign(topics, self._on_source, again)
        for number in self._core.thesis_numbers():
            await self._mqtt.add_number(ch.THESIS_AREA, number)

    def _on_source(self, topic: str, payload: bytes | None, retained: bool) -> None:  # noqa: FBT001  # as the edge calls it
        self._publisher.announce(self._core.on_source(topic, payload, self._edges.now(), retained=retained))

    async def store_status(self) -> StoreStatus:
        """Return what Redis and this process have; raises `StoreError`."""
        known = self._in_memory()
        counts = {
            "areas": len(known.definitions),
            "hazards": len(known.hazards),
            "overrides": len(known.overrides),
        }
        return await self._store.status(counts if self.loaded.is_set() else {})

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Restore the records from memory, or accept those in Redis, after Redis lost records.

        Raises `RecoveryError` and `StoreError`.
        """
        await self._store.require_loss()
        audit = Audit(self._clock.stamp(), who, action)
        async with self.lock:
            if action == "accept":
                await self._store.accept_loss(audit)
                self._reload_due = True
            elif self.loaded.is_set():
                await self._store.restore(self._in_memory(), audit)
            else:
                raise RecoveryError(
                    "this service was started after the loss and has no stored areas: restore a backup of Redis, or"
                    " accept"
                )

    def _in_memory(self) -> Stored:
        """Return what of the records in force is stored."""
        overrides = self._core.overrides
        return Stored(
            [self._unusable.as_stored(each) for each in self._core.definitions() if each.version > 0],
            list(self._core.announced().values()),
            overrides.all(),
            overrides.rests(self._boot, self._clock.now()),
            {},
        )
