"""Changes areas: each is stored as its next version before it takes effect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec import structs

from hazard_aggregator.area_size import check_count
from hazard_aggregator.store import Audit

if TYPE_CHECKING:
    from fog_contracts.messages import AreaDefinition
    from fog_runtime.clock import Clock
    from fog_runtime.stores.idempotency import Attempt
    from fog_runtime.transports.edges import Edges
    from hazard_aggregator.core import Aggregator
    from hazard_aggregator.publisher import Publisher
    from hazard_aggregator.store import Store
    from hazard_aggregator.writers.records import Records


ATTEMPTS: Final = 2
"""How often a change is tried: what is stored may differ from what this process knows, once."""


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
                if await self._is_stored(stored, old, Audit(self._clock.stamp(), who, "put", attempt)):
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
            await self._records.reload_locked()
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
