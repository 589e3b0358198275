"""Changes areas: each is stored as its next version before it takes effect."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from hazard_aggregator.store import Audit

if TYPE_CHECKING:
    from fog_contracts.messages import AreaDefinition
    from fog_runtime.clock import Clock
    from fog_runtime.edges import Edges
    from fog_runtime.idempotency import Attempt
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.publisher import Publisher
    from hazard_aggregator.records import Records
    from hazard_aggregator.store import Store


class ConflictError(Exception):
    """An area has another version than the writer expected."""

    def __init__(self, area: str) -> None:
        super().__init__(f"area {area} was changed by somebody else")


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
    ) -> AreaDefinition:
        """Store an area as its next version, then put it into force; with `expected`, only if that is its version.

        With `must_be_new`, only if there is none (a removed one counts as none). An `attempt` that succeeded before
        returns its area again. Raises `ConflictError`, `IdempotencyError`, and `StoreError`: then the area may be
        stored or not.
        """
        async with self._records.lock:
            with self._records.uncertain_write():
                if (earlier := await self._store.earlier_result(attempt)) is not None:
                    await self._records.reload_locked()
                    return earlier
            old = next((known for known in self._core.definitions() if known.id == definition.id), None)
            if must_be_new and old is not None and not old.removed:
                raise ConflictError(definition.id)
            if expected is not None and (old is None or old.version != expected):
                raise ConflictError(definition.id)
            definition = structs.replace(definition, version=1 if old is None else old.version + 1)
            with self._records.uncertain_write():
                await self._store_area(definition, old, Audit(self._clock.stamp(), who, "put", attempt))
            self._publisher.announce(self._core.put_area(definition, self._edges.now()))
        await self._records.subscribe_numbers()
        return definition

    async def _store_area(self, definition: AreaDefinition, old: AreaDefinition | None, audit: Audit) -> None:
        """Store an area as the successor of `old`; raises `ConflictError` and `StoreError`."""
        version = definition.version - 1
        outcome = await self._store.put_area(definition, expected=version, audit=audit, before=old)
        if outcome == "missing":
            # An administrator accepted a store without this area, which stays in force: it is stored again.
            outcome = await self._store.put_area(definition, expected=0, audit=audit, before=old)
        if outcome != "ok":
            self._records.request_reload()
            raise ConflictError(definition.id)
