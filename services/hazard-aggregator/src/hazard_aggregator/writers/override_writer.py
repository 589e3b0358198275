"""Changes operators' overrides: each is stored before it takes effect, and deleted when it has ended."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_runtime import logs
from hazard_aggregator.areas.area_override import AreaOverride
from hazard_aggregator.store import Audit
from hazard_aggregator.writers.area_writer import ATTEMPTS, ConflictError

if TYPE_CHECKING:
    from fog_contracts.messages import OverrideState
    from fog_runtime.clock import Clock
    from fog_runtime.stores.idempotency import Attempt
    from fog_runtime.transports.edges import Edges
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.publisher import Publisher
    from hazard_aggregator.store import Store
    from hazard_aggregator.writers.records import Records

OVERRIDE_CHANGED: Final = "has another override by now, or none: read it again, then retry"
PERIOD_S: Final = 10.0
"""How often the remaining times are stored: after a boot, an override may last longer by up to this time."""

_log = logs.get("aggregator")


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
    ) -> AreaOverride:
        """Store an override instead of the area's former one, then put it into force.

        With `expected`, only if that is the former one's version; else it replaces whatever is stored. An `attempt`
        that succeeded before returns its override again. Raises `ConflictError`, `IdempotencyError`, and `StoreError`:
        then it may be stored or not.
        """
        async with self._records.lock:
            for _ in range(ATTEMPTS):
                with self._records.uncertain_write():
                    await self._records.reload_locked()
                    if (earlier := await self._store.earlier_override(attempt)) is not None:
                        await self._records.load_again()
                        return earlier
                old = self._core.overrides.known(area)
                if expected is not None and (old is None or old.version != expected):
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
                audit = Audit(override.set_at, who, "override", attempt)
                with self._records.uncertain_write():
                    outcome, override = await self._store.put_override(override, audit)
                if outcome == "ok":
                    self._publisher.announce(self._core.put_override(override, self._edges.now()))
                    return override
                self._records.request_reload()
        raise ConflictError(area, OVERRIDE_CHANGED)

    async def remove(self, area: str, who: str, expected: int | None = None) -> bool:
        """Delete an area's override, and let its nodes count again; return whether there was one.

        With `expected`, only this version. Raises `ConflictError` and `StoreError`.
        """
        async with self._records.lock:
            with self._records.uncertain_write():
                # A deletion whose reply was lost may have been done.
                await self._records.reload_locked()
            override = self._core.overrides.get(area)
            if override is None:
                return False
            if expected not in (None, override.version):
                raise ConflictError(area, OVERRIDE_CHANGED)
            await self._delete(override, Audit(self._clock.stamp(), who, "remove"))
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
