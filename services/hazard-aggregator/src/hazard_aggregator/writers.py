"""Changes of areas and overrides by operators: each is stored before it takes effect. Ended overrides are deleted."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec import structs

from fog_runtime import logs
from fog_runtime.stores.redis_store import Audit
from hazard_aggregator.area_size import check_count
from hazard_aggregator.areas import AreaOverride

if TYPE_CHECKING:
    from fog_contracts.messages import AreaDefinition, OverrideState
    from fog_runtime.clock import Clock
    from fog_runtime.stores.redis_store import Attempt
    from fog_runtime.transports.edges import Edges
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.publisher import Publisher
    from hazard_aggregator.records import Records
    from hazard_aggregator.store import Store

ATTEMPTS: Final = 2
"""How often a change is tried: what is stored may differ from what this process knows, once."""

_log = logs.get("aggregator")


class _Earlier(NamedTuple):
    """The result of an earlier attempt at the same request."""

    definition: AreaDefinition


class ConflictError(Exception):
    """An area or its override has another version than the writer expected; the message names the remedy."""

    def __init__(self, area: str, what: str = "was changed by somebody else: read it again, then retry") -> None:
        super().__init__(f"area {area} {what}")


class AreaWriter:
    """Stores areas, and puts them into force."""

    def __init__(
        self, core: Aggregator, store: Store, records: Records, publisher: Publisher, edges: Edges, clock: Clock
    ) -> None:
        self._core = core
        self._store = store
        self._records = records
        self._publisher = publisher
        self._edges = edges
        self._clock = clock

    async def put_area(
        self,
        definition: AreaDefinition,
        who: str,
        *,
        expected: int | None = None,
        must_be_new: bool = False,
        attempt: Attempt | None = None,
        action: str = "put",
    ) -> AreaDefinition:
        """Store an area as its next version, then put it into force; with `expected`, only if that is its version.

        Without, it replaces whatever is stored. With `must_be_new`, only if there is none (a removed one counts as
        none). An `attempt` that succeeded before returns its area again. Raises `ConflictError`, `IdempotencyError`,
        `TooManyAreasError`, and `StoreError`: then the area may be stored or not.
        """
        async with self._records.lock:
            for _ in range(ATTEMPTS):
                old = await self._known(definition.id, attempt)
                if isinstance(old, _Earlier):
                    stored = old.definition
                    break
                if must_be_new and old is not None and not old.removed:
                    raise ConflictError(definition.id, "exists already: PUT it with If-Match, or choose another id")
                if expected is not None and (old is None or old.version != expected):
                    raise ConflictError(definition.id)
                check_count(definition, self._core.definitions())
                stored = structs.replace(definition, version=1 if old is None else old.version + 1)
                if await self._is_stored(stored, old, Audit(self._clock.stamp(), who, action, attempt)):
                    self._publisher.announce(self._core.put_area(stored, self._edges.now()))
                    break
                self._records.request_reload()
            else:
                raise ConflictError(definition.id)
        await self._records.subscribe()
        return stored

    async def _known(self, area: str, attempt: Attempt | None) -> AreaDefinition | _Earlier | None:
        """Return the area as it is stored, or the result of an earlier attempt, which is in force then."""
        with self._records.uncertain_write():
            await self._records.reload_holding_lock()
            if (earlier := await self._store.earlier_result(attempt)) is not None:
                await self._records.load_again()
                return _Earlier(earlier)
        return next((known for known in self._core.definitions() if known.id == area), None)

    async def _is_stored(self, definition: AreaDefinition, old: AreaDefinition | None, audit: Audit) -> bool:
        """Store an area as the successor of `old`; return whether that is what was stored. Raises `StoreError`."""
        version = definition.version - 1
        with self._records.uncertain_write():
            outcome = await self._store.put_area(definition, expected=version, audit=audit, before=old)
            if outcome == "missing":
                # An administrator accepted a store without this area, which stays in force: it is stored again.
                outcome = await self._store.put_area(definition, expected=0, audit=audit, before=old)
        return outcome == "ok"


OVERRIDE_CHANGED: Final = "has another override by now, or none: read it again, then retry"
PERIOD_S: Final = 10.0
"""How often the remaining times are stored: after a boot, an override may last longer by up to this time."""


class OverrideWriter:
    """Stores overrides, and puts them into force; `boot` is `clock.boot_id`."""

    def __init__(  # noqa: PLR0913  # the process's parts
        self,
        core: Aggregator,
        store: Store,
        records: Records,
        publisher: Publisher,
        edges: Edges,
        clock: Clock,
        boot: str,
    ) -> None:
        self._core = core
        self._store = store
        self._records = records
        self._publisher = publisher
        self._edges = edges
        self._clock = clock
        self._boot = boot
        self._rests_stored_at = 0.0

    async def put(  # noqa: PLR0913  # what an override says, and the conditions of the write
        self,
        area: str,
        state: OverrideState,
        reason: str,
        ttl_s: float,
        who: str,
        *,
        expected: int | None = None,
        attempt: Attempt | None = None,
        action: str = "override",
    ) -> AreaOverride:
        """Store an override instead of the area's former one, then put it into force.

        With `expected`, only if that is the former one's version (0: none); else whatever is stored. An `attempt`
        that succeeded before returns its override again. Raises `ConflictError`, `IdempotencyError`, and `StoreError`:
        then it may be stored or not.
        """
        async with self._records.lock:
            for _ in range(ATTEMPTS):
                with self._records.uncertain_write():
                    await self._records.reload_holding_lock()
                    if (earlier := await self._store.earlier_override(attempt)) is not None:
                        await self._records.load_again()
                        return earlier
                old = self._core.overrides.known(area)
                if expected is not None and (0 if old is None else old.version) != expected:
                    raise ConflictError(area, OVERRIDE_CHANGED)
                override = AreaOverride(
                    area=area,
                    state=state,
                    author=who,
                    reason=reason,
                    ttl_s=ttl_s,
                    set_at=self._clock.stamp(),
                    boot=self._boot,
                    deadline=self._clock.now() + ttl_s,
                    version=0 if old is None else old.version,
                )
                audit = Audit(override.set_at, who, action, attempt)
                with self._records.uncertain_write():
                    outcome, override = await self._store.put_override(override, audit)
                if outcome == "ok":
                    self._publisher.announce(self._core.put_override(override, self._edges.now()))
                    return override
                self._records.request_reload()
        raise ConflictError(area, OVERRIDE_CHANGED)

    async def remove(self, area: str, who: str, expected: int | None = None, *, action: str = "remove") -> bool:
        """Delete an area's override, and let its nodes count again; return whether there was one.

        With `expected`, only this version. Raises `ConflictError` and `StoreError`.
        """
        async with self._records.lock:
            with self._records.uncertain_write():
                # A deletion whose reply was lost may have been done.
                await self._records.reload_holding_lock()
            override = self._core.overrides.get(area)
            if override is None:
                return False
            if expected not in (None, override.version):
                raise ConflictError(area, OVERRIDE_CHANGED)
            await self._delete(override, Audit(self._clock.stamp(), who, action))
        return True

    async def keep(self) -> None:
        """Delete the overrides that have ended, and store the times that are left; raises `StoreError`.

        Call it twice a second while this process leads.
        """
        async with self._records.lock:
            for override in self._core.overrides.ended():
                try:
                    await self._delete(override, Audit(self._clock.stamp(), "hazard-aggregator", "end"))
                except ConflictError as error:
                    _log.warning("override_changed_elsewhere", area=override.area, reason=str(error))
            now = self._clock.now()
            if self._core.overrides.all() and now >= self._rests_stored_at + PERIOD_S:
                await self._store.save_rests(self._core.overrides.rests(self._boot, now))
                self._rests_stored_at = now

    async def _delete(self, override: AreaOverride, audit: Audit) -> None:
        with self._records.uncertain_write():
            outcome = await self._store.delete_override(override, audit)
        if outcome != "ok":
            self._records.request_reload()
            raise ConflictError(override.area)
        self._publisher.announce(self._core.remove_override(override.area, self._edges.now()))
