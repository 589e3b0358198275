"""Writes of zones: validated, stored first, then put on the map; and what is loaded from the store and kept in it."""

from __future__ import annotations

import asyncio
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final

from msgspec import structs
from prometheus_client import Counter, Gauge

from fog_contracts import channels as ch
from fog_runtime import logs
from fog_runtime.concurrency import Worker
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Audit, RecoveryError
from map_service.record_writer import ConflictError
from map_service.store import ZONES
from map_service.zone_times import StoredState
from map_service.zones import check_list_size, check_room, check_sets, list_size, prepare_zone, zones_spans

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import Literal

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import Zone
    from fog_runtime.health import Health
    from fog_runtime.stores.redis_store import Attempt, Outcome, StoreStatus
    from map_service.core import MapCore
    from map_service.publisher import Publisher
    from map_service.record_writer import RecordWriter
    from map_service.store import Store
    from map_service.zone_times import Progress
    from map_service.zones import PreparedZone

PERIOD_S: Final = 30.0
"""How often the remaining times are stored: after a boot, a zone may last longer by up to this time."""

_log = logs.get("map")


class ZoneTimesPersistence:
    """Stores the times of zones: at once when one starts or ends, else periodically; `boot` is `clock.boot_id`."""

    def __init__(self, core: MapCore, store: Store, boot: str) -> None:
        self.boot = boot
        self._core = core
        self._store = store
        self._stored: dict[str, Progress] = {}
        self._stored_at = 0.0

    async def load(self) -> Mapping[str, Progress]:
        """Return the stored times by the zones' ids; raises `StoreError`."""
        return await self._store.zone_times()

    def current(self, now: float) -> dict[str, Progress]:
        """Return the times at `now` (s, monotonic) by the zones' ids."""
        return self._core.zone_progress(self.boot, now)

    async def save(self, now: float) -> None:
        """Store the times if that is due at `now` (s, monotonic); raises `StoreError`."""
        current = self.current(now)
        steps, stored_steps = (
            {name: (times.version, times.started, times.ended) for name, times in found.items()}
            for found in (current, self._stored)
        )
        if steps == stored_steps and (not current or now < self._stored_at + PERIOD_S):
            return
        await self._store.write_zone_times(current)
        self._stored, self._stored_at = current, now


UNUSABLE = Gauge("fognav_zones_unusable", "Stored zones that are left out of the map because their record is invalid")


class UnusableZones:
    """Why each of them is left out, by id."""

    def __init__(self) -> None:
        self.reasons: dict[str, str] = {}

    def replace(self, reasons: Mapping[str, str]) -> None:
        """Record which zones are left out now; each new one is logged."""
        for name, reason in reasons.items():
            if self.reasons.get(name) != reason:
                _log.error("stored_zone_unusable", zone=name, reason=reason, remedy="DELETE the zone and add it again")
        self.reasons = dict(reasons)
        UNUSABLE.set(len(reasons))

    def detail(self) -> str:
        """Return a text for /readyz that names them; empty without any."""
        named = ", ".join(f"{name} ({reason})" for name, reason in sorted(self.reasons.items()))
        return f"; left out, because their records are invalid: {named}"[:500] if named else ""


ZONE_WRITES = Counter("fognav_zone_writes_total", "Writes of zones to the store, by outcome", ["outcome"])
KEPT_S: Final = 3600.0
"""Zones that have ended are kept for so long, for people to see; they count towards the most that there may be."""
_DELETED_AT_ONCE: Final = 20
MAX_PREPARING = 64
"""Most zones that are validated or wait for it; further requests are answered with 503."""


class ZoneWriter:
    """Changes zones one after another: none is on the map before it is stored."""

    def __init__(  # the parts that it works with
        self,
        core: MapCore,
        store: Store,
        times: ZoneTimesPersistence,
        publisher: Publisher,
        health: Health,
        now: Callable[[], Moment],
    ) -> None:
        """Prepare; `now` says whether the time of day is known, too."""
        self._core = core
        self._store = store
        self._times = times
        self._publisher = publisher
        self._health = health
        self.now = now
        self.lock = asyncio.Lock()
        self._worker = Worker("zones", limit=MAX_PREPARING)
        self.unusable = UnusableZones()
        self.beside: tuple[RecordWriter[Any], ...] = ()
        """What is stored beside zones, and loaded before them."""
        self.must_reload = False
        """Whether stored zones may differ from those on the map: after a write whose outcome is unknown."""

    # --- Changes ----------------------------------------------------------------------------------------------------

    async def create(self, zone: Zone, who: str, attempt: Attempt | None = None, *, action: str = "create") -> Zone:
        """Store a new zone and put it on the map; raises `ZoneError`, `ConflictError` (exists), `StoreError`.

        An `attempt` that succeeded before returns its zone again; raises `IdempotencyError` for another request's.
        """
        async with self.lock:
            if (earlier := await self._earlier_result(attempt)) is not None:
                return earlier
            if self._core.zones.get(zone.id) is not None:
                # The store would treat an identical zone as a repeated attempt.
                raise ConflictError("exists", zone.id)
            prepared = await self._prepare(zone)
            audit = Audit(self.now().stamp, who, action, attempt)
            with self.uncertain_write():
                outcome, zone = await self._store.create(prepared.zone, audit)
            if (earlier := await self._unless_ok(outcome, zone.id, attempt)) is not None:
                return earlier
            self._publisher.publish(self._core.put_zone(zone, self.now(), prepared.spans))
        await self._publisher.all_on_map()
        return zone

    async def replace(
        self, zone: Zone, expected: int | None, who: str, attempt: Attempt | None = None, *, action: str = "replace"
    ) -> Zone:
        """Store a new version of a zone; with `expected`, only if that is its version. `attempt` as in `create`.

        Raises `ZoneError`, `ConflictError` (stale, missing), and `StoreError`.
        """
        async with self.lock:
            if (earlier := await self._earlier_result(attempt)) is not None:
                return earlier
            # The store would treat an identical zone as a repeated attempt.
            old = self._require(zone.id, expected)
            prepared = await self._prepare(structs.replace(zone, version=old.version + 1))
            audit = Audit(self.now().stamp, who, action, attempt)
            with self.uncertain_write():
                outcome = await self._store.replace(prepared.zone, expected=old.version, audit=audit)
            if (earlier := await self._unless_ok(outcome, zone.id, attempt)) is not None:
                return earlier
            self._publisher.publish(self._core.put_zone(prepared.zone, self.now(), prepared.spans))
        await self._publisher.all_on_map()
        return prepared.zone

    async def delete(self, zone_id: str, expected: int | None, who: str, *, action: str = "delete") -> None:
        """Delete a zone; with `expected`, only this version. Raises `ConflictError` (stale, missing), `StoreError`."""
        async with self.lock:
            zone = self._require(zone_id, expected)
            with self.uncertain_write():
                outcome = await self._store.delete(zone, Audit(self.now().stamp, who, action))
            await self._unless_ok(outcome, zone_id)
            self._publisher.publish(self._core.remove_zone(zone_id, self.now()))
        await self._publisher.all_on_map()

    async def delete_ended(self) -> None:
        """Delete zones that have been over for an hour; the audit trail keeps them. Raises `StoreError`."""
        for zone in self._core.zones_over(KEPT_S, self.now().now)[:_DELETED_AT_ONCE]:
            with suppress(ConflictError):  # somebody has changed it meanwhile
                await self.delete(zone.id, zone.version, "map-service")

    async def delete_unusable(self, zone_id: str, who: str) -> None:
        """Delete a zone that is left out because its record is invalid; raises `StoreError`."""
        async with self.lock:
            with self.uncertain_write():
                await self._store.delete_unusable(zone_id, Audit(self.now().stamp, who, "delete"))
            await self.load_while_locked()

    async def earlier_result(self, attempt: Attempt | None) -> Zone | None:
        """Return the zone that an earlier attempt stored, once it is on the map; None for a first attempt.

        Raises `IdempotencyError` for another request's attempt, and `StoreError`.
        """
        async with self.lock:
            return await self._earlier_result(attempt)

    async def store_status(self) -> StoreStatus:
        """Return what Redis and this process have; raises `StoreError`."""
        beside = {records.table.name: len(records.records) for records in self.beside}
        return await self._store.status({"zones": len(self._core.zones), **beside} if self._core.zones_loaded else {})

    async def recover_store(self, action: Literal["restore", "accept"], who: str) -> None:
        """Restore the zones from memory, or accept those in Redis, after Redis lost records.

        Raises `RecoveryError` and `StoreError`.
        """
        await self._store.require_loss()
        async with self.lock:
            audit = Audit(self.now().stamp, who, action)
            if action == "accept":
                await self._store.accept_loss(audit)
            elif self._core.zones_loaded:
                tables = {records.table.name: records.records for records in self.beside}
                tables[ZONES.name] = {zone.id: zone for zone in self._core.zones.zones()}
                await self._store.restore(tables, self._times.current(self.now().now), audit)
            else:
                raise RecoveryError(
                    "this service was started after the loss and has no zones: restore a backup of Redis, or accept"
                )
        await self.load()

    async def prepare(self, zone: Zone) -> PreparedZone:
        """Return a valid zone with its cells, and change nothing; raises `ZoneError` and `BusyError` as a write."""
        return await self._prepare(zone)

    # --- Loading ----------------------------------------------------------------------------------------------------

    async def load(self) -> None:
        """Replace the map's zones by the stored ones, where they differ; raises `StoreError`."""
        async with self.lock:
            await self.load_while_locked()

    async def reload_after_uncertain_write(self) -> None:
        """Load the zones if a failed write may have been stored, so that what is missing here is missing there, too.

        Raises `StoreError`.
        """
        if self._core.zones_loaded and self.must_reload:
            await self.load()

    async def load_while_locked(self) -> None:
        """Do as `load` while the lock is held."""
        core = self._core
        for records in self.beside:
            await records.load()
        zones, unreadable = await self._store.zones()
        known = {zone.id: zone for zone in core.zones.zones()}
        changed = [zone for zone in zones if zone.id not in known or known[zone.id].shape != zone.shape]
        # Not by the worker, for which many may wait: without its zones this process ends.
        spans, invalid = await asyncio.to_thread(zones_spans, changed, core.costmap.geometry)
        self.unusable.replace({**unreadable, **invalid})
        zones = [zone for zone in zones if zone.id not in invalid]
        if not core.zones_loaded or {zone.id: zone for zone in zones} != known:
            stored = StoredState(spans=spans, progress=await self._times.load(), boot=self._times.boot)
            self._publisher.publish(core.load_zones(zones, self.now(), stored))
        self.must_reload = False
        detail = f"{len(zones)} loaded{self.unusable.detail()}"
        if (excess := list_size(core.zones.size) - ch.ZONES.limit) > 0:
            detail += f"; their list is {excess} bytes too large for robots, which drive by the map alone: delete some"
            _log.error("zone_list_too_large", zones=len(zones), excess_bytes=excess, remedy="delete zones")
        self._health.set("zones", ok=True, detail=detail)
        self._health.set("store", ok=True)

    # --- Inside -----------------------------------------------------------------------------------------------------

    async def _earlier_result(self, attempt: Attempt | None) -> Zone | None:
        """Return the zone that an earlier attempt stored, once it is on the map."""
        earlier = await self._store.earlier_result(attempt)
        if earlier is not None and self.must_reload:
            await self.load_while_locked()
        return earlier

    async def _prepare(self, zone: Zone) -> PreparedZone:
        """Validate and rasterize a zone on the worker thread; raises `ZoneError`, and `BusyError` if too many wait."""
        at, zones, geometry = self.now(), self._core.zones, self._core.costmap.geometry
        stamp = at.stamp if at.synchronized else 0.0
        check_sets(zone, self._core.zone_sets.sets)
        prepared = await self._worker.run(prepare_zone, zone, geometry, stamp)
        old = zones.get(zone.id)
        count, cells, size = (0, 0, 0) if old is None else (1, old.cells, old.size)
        check_room(prepared, len(zones) - count, zones.cells - cells, geometry)
        check_list_size(prepared.zone, zones.size - size, zones.size)
        return prepared

    @contextmanager
    def uncertain_write(self) -> Iterator[None]:
        """Reload the zones after a failure: they may have been written although the reply was lost."""
        try:
            yield
        except StoreError as error:
            self.must_reload = True
            self._health.set("store", ok=False, detail=str(error))
            ZONE_WRITES.labels("failed").inc()
            raise

    def _require(self, zone_id: str, version: int | None) -> Zone:
        """Return a zone as it is on the map; raises `ConflictError` if there is none, or it has another version."""
        known = self._core.zones.get(zone_id)
        if known is None:
            raise ConflictError("missing", zone_id)
        if version not in (None, known.zone.version):
            raise ConflictError("stale", zone_id)
        return known.zone

    async def _unless_ok(self, outcome: Outcome, zone_id: str, attempt: Attempt | None = None) -> Zone | None:
        """Return None for a write that was done.

        Otherwise return the zone that an earlier attempt stored, which a hanging Redis carried out only now; raises
        `ConflictError` without one, and `StoreError`.
        """
        ZONE_WRITES.labels(outcome).inc()
        if outcome == "ok":
            return None
        self.must_reload = True
        if (earlier := await self._earlier_result(attempt)) is None:
            raise ConflictError(outcome, zone_id)
        return earlier
