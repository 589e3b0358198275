"""Writes of what the map-service keeps beside zones: sets of zones, places, sources; stored first, then used."""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from fog_runtime.stores.redis_store import Audit

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Mapping
    from contextlib import AbstractContextManager

    from fog_contracts.handlers import Moment
    from fog_runtime.stores.redis_store import Attempt, Outcome, Table
    from map_service.places import StoredPlace
    from map_service.site_map import StoredMap
    from map_service.store import Store
    from map_service.zone_times import MutedSource, SetOfZones


R = TypeVar("R", bound="SetOfZones | StoredPlace | MutedSource | StoredMap")


class ConflictError(Exception):
    """A record has another version than the writer expected, or exists already; `table` is where it is stored."""

    def __init__(self, outcome: Outcome, record_id: str, table: str = "zones") -> None:
        super().__init__(f"{table}: {record_id}: {outcome}")
        self.outcome = outcome
        self.id = record_id
        self.table = table


class Writing(Protocol):
    """What all writes of the service share (`ZoneWriter`)."""

    lock: asyncio.Lock
    must_reload: bool

    def now(self) -> Moment:
        """Return the current moment."""

    def uncertain_write(self) -> AbstractContextManager[None]:
        """Reload what is stored after a failure inside."""

    async def load_while_locked(self) -> None:
        """Load all that is stored; raises `StoreError`."""


class RecordWriter(Generic[R]):
    """Changes the records of one table, one after another: none is used before it is stored."""

    def __init__(
        self, table: Table, kind: type[R], store: Store, writing: Writing, use: Callable[[Mapping[str, R]], object]
    ) -> None:
        """Prepare; `use` is called with all records, by id, after each change and when they were loaded."""
        self.table = table
        self.records: Mapping[str, R] = {}
        """All records by id; nobody may change the mapping."""
        self._kind = kind
        self._store = store
        self._writing = writing
        self._use = use
        self._loaded = False

    async def load(self) -> None:
        """Use what is stored, at first and where it differs; raises `StoreError`."""
        stored = await self._store.read(self.table, self._kind)
        # At first even if there is nothing: a file of before, such as that of the map in force, may say otherwise.
        if stored != self.records or not self._loaded:
            self._replace(stored)
            self._loaded = True

    async def put(
        self,
        record: R,
        expected: int | None,
        who: str,
        attempt: Attempt | None = None,
        *,
        action: str = "",
        check: Callable[[R | None], object] = lambda _: None,
    ) -> R:
        """Store a record under the next version; return it with that. `expected` is the stored version (0: none).

        With None, whatever is stored is replaced. `check` is given what is stored and may raise. An `attempt` that
        succeeded before returns its record again; raises `IdempotencyError` for another request's. Raises
        `ConflictError` and `StoreError`.
        """
        async with self._writing.lock:
            if (earlier := await self._earlier(attempt)) is not None:
                return earlier
            old = self._require(record.id, expected)
            check(old)
            audit = Audit(self._writing.now().stamp, who, action or ("create" if old is None else "replace"), attempt)
            with self._writing.uncertain_write():
                version = None if old is None else old.version
                outcome, record = await self._store.write(self.table, record.id, record, version, audit)
            if outcome != "ok":
                self._writing.must_reload = True
                if (earlier := await self._earlier(attempt)) is None:
                    raise ConflictError(outcome, record.id, self.table.name)
                return earlier
            self._replace({**self.records, record.id: record})
        return record

    async def delete(
        self,
        record_id: str,
        expected: int | None,
        who: str,
        *,
        action: str = "delete",
        check: Callable[[], object] = lambda: None,
    ) -> None:
        """Delete a record; with `expected`, only this version. Raises `ConflictError` and `StoreError`."""
        async with self._writing.lock:
            old = self._require(record_id, expected)
            if old is None:
                raise ConflictError("missing", record_id, self.table.name)
            check()
            with self._writing.uncertain_write():
                audit = Audit(self._writing.now().stamp, who, action)
                outcome = await self._store.erase(self.table, record_id, old.version, audit)
            if outcome != "ok":
                self._writing.must_reload = True
                raise ConflictError(outcome, record_id, self.table.name)
            self._replace({name: record for name, record in self.records.items() if name != record_id})

    async def earlier_result(self, attempt: Attempt | None) -> R | None:
        """Return the record that an earlier attempt stored; None for a first attempt.

        Raises `IdempotencyError` for another request's attempt, and `StoreError`.
        """
        async with self._writing.lock:
            return await self._earlier(attempt)

    async def _earlier(self, attempt: Attempt | None) -> R | None:
        earlier = await self._store.recall(attempt, self._kind)
        if earlier is not None and self._writing.must_reload:
            await self._writing.load_while_locked()
        return earlier

    def _require(self, record_id: str, expected: int | None) -> R | None:
        """Return what is stored; raises `ConflictError` if that is not what is expected."""
        old = self.records.get(record_id)
        if expected not in (None, 0 if old is None else old.version):
            outcome: Outcome = "missing" if old is None else "exists" if expected == 0 else "stale"
            raise ConflictError(outcome, record_id, self.table.name)
        return old

    def _replace(self, records: Mapping[str, R]) -> None:
        self.records = records
        self._use(records)
