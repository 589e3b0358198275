"""The aggregator's records in Redis: areas that operators changed, and the last hazard of every area."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec import structs

from fog_contracts.messages import AreaDefinition, AreaHazard, Count, Id, Message, Ring
from fog_runtime import logs
from fog_runtime.stores import records
from fog_runtime.stores.records import CursorError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Audit, Outcome, RedisStore, Table
from hazard_aggregator.alerts import StoredAlerts
from hazard_aggregator.areas import AreaOverride, Rest
from hazard_aggregator.history import (
    MAX_PERIODS,
    RETENTION_S,
    HistoryPage,
    Period,
    page_of,
    sameness,
)

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import Alert
    from fog_runtime.stores.redis_store import Attempt
    from hazard_aggregator.alerts import AlertEvent

_AREAS: Final = Table(records.AREAS, "area")
_HAZARDS: Final = records.HAZARDS
_OVERRIDES: Final = Table(records.OVERRIDES, "override")
_RESTS: Final = records.OVERRIDE_RESTS
_ALERTS: Final = records.ALERTS
_ALL: Final = "all"
_HISTORY: Final = records.HISTORY
_CURSOR: Final = re.compile(r"[0-9]{1,15}-[0-9]{1,15}")

_log = logs.get("store")


class _AllRests(Message, frozen=True, kw_only=True):
    overrides: dict[str, Rest]


class _Outline(Message, frozen=True, kw_only=True):
    """The part of an area's record that says where it is."""

    id: Id
    polygon: Ring
    version: Count = 0
    removed: bool = False

    def area(self) -> AreaDefinition:
        return AreaDefinition(id=self.id, polygon=self.polygon, version=self.version, removed=self.removed)


class Stored(NamedTuple):
    """What an aggregator loads when it starts, and when it begins to lead; `rests` are those of the overrides.

    `unreadable`: by area, why its definition could be read in part only, or not at all.
    """

    definitions: list[AreaDefinition]
    hazards: list[AreaHazard]
    overrides: list[AreaOverride]
    rests: dict[str, Rest]
    unreadable: dict[str, str]


class Store(RedisStore):
    """The aggregator's keys."""

    tables = (_AREAS.name, _HAZARDS, _OVERRIDES.name)

    async def load(self) -> Stored:
        """Return all readable records."""
        hazards = await self._readable_records(_HAZARDS, AreaHazard)
        definitions, unreadable = await self.areas()
        return Stored(definitions, list(hazards.values()), *await self.overrides(), unreadable)

    async def areas(self) -> tuple[list[AreaDefinition], dict[str, str]]:
        """Return the stored areas, and, by id, why others are unreadable.

        An unreadable one whose place can be read is returned without anything that watches it: it is unknown then. One
        that were left out would count as clear.
        """
        areas, unreadable = await self._decoded(_AREAS.name, AreaDefinition)
        if unreadable:
            outlines, _ = await self._decoded(_AREAS.name, _Outline)
            areas |= {name: outlines[name].area() for name in unreadable if name in outlines}
        return list(areas.values()), unreadable

    async def save_hazards(self, hazards: Iterable[AreaHazard]) -> None:
        """Write hazards durably (Redis answers after its fsync: `appendfsync always`)."""
        await self._write_records(_HAZARDS, {hazard.area: hazard for hazard in hazards})

    async def put_area(
        self, definition: AreaDefinition, *, expected: int, audit: Audit, before: AreaDefinition | None = None
    ) -> Outcome:
        """Write an area durably if the stored version is `expected` (0: none is stored, as for the site's own).

        `before` is the definition in force until now, for the audit entry of an area that was not stored yet.
        """
        return await self._swap(_AREAS, definition.id, definition, str(expected), audit, before=before)

    async def overrides(self) -> tuple[list[AreaOverride], dict[str, Rest]]:
        """Return the stored overrides, and the rests of their times by area; unreadable ones are left out."""
        found = await self._readable_records(_OVERRIDES.name, AreaOverride)
        await self._load_floor(_OVERRIDES.name)
        rests = (await self._readable_records(_RESTS, _AllRests)).get(_ALL)
        return list(found.values()), {} if rests is None else rests.overrides

    async def put_override(self, override: AreaOverride, audit: Audit) -> tuple[Outcome, AreaOverride]:
        """Write an override durably instead of the one of its version (0: there is none); return its new version."""
        if override.version > 0:
            new = structs.replace(override, version=override.version + 1)
            return await self._swap(_OVERRIDES, new.area, new, str(override.version), audit), new
        outcome, new = await self._create_override(override, audit)
        if outcome == "stale":
            # This process did not know of the newest deletion, and does now.
            outcome, new = await self._create_override(override, audit)
        return outcome, new

    async def _create_override(self, override: AreaOverride, audit: Audit) -> tuple[Outcome, AreaOverride]:
        new = structs.replace(override, version=self._floor(_OVERRIDES.name) + 1)
        return await self._swap(_OVERRIDES, new.area, new, "0", audit), new

    async def delete_override(self, override: AreaOverride, audit: Audit) -> Outcome:
        """Delete an override durably if the stored version is this one's; `ok` if there is none."""
        outcome = await self._swap(_OVERRIDES, override.area, None, str(override.version), audit)
        return "ok" if outcome == "missing" else outcome

    async def save_rests(self, rests: dict[str, Rest]) -> None:
        """Replace the stored rests of all overrides."""
        await self._write_records(_RESTS, {_ALL: _AllRests(overrides=rests)})

    async def begin_period(self, hazard: AreaHazard, period: Period) -> None:
        """Begin a period of an area's history durably, unless Redis has it, or it only continues the last one."""
        keys = [self._key(name) for name in ("generation", "writes", f"{_HISTORY}:{hazard.area}", self._epoch_key)]
        arguments = {
            "id_epoch": hazard.epoch,
            "id_seq": hazard.seq,
            "at": f"{period.began:.3f}",
            "same": sameness(period),
            "oldest": period.began - RETENTION_S,
            "entries": MAX_PERIODS,
        }
        await self._run(records.PERIOD, keys, _HISTORY, arguments, msgspec.json.encode(period))

    async def history(self, area: str, *, cursor: str | None, limit: int, at: Moment) -> HistoryPage:
        """Return a page of an area's history at this moment; raises `CursorError` and `StoreError`."""
        if cursor is not None and _CURSOR.fullmatch(cursor) is None:
            raise CursorError(f"{cursor!r} is no cursor: take the address of the next page from the Link header")
        key = self._key(f"{_HISTORY}:{area}")
        reply = await self._redis.read("XREVRANGE", key, cursor or "+", "-", "COUNT", limit + 2)
        found = [(entry_id.decode(), fields) for entry_id, fields in reply]
        return page_of([(name, _data(fields)) for name, fields in found], cursor=cursor, limit=limit, at=at)

    async def forget_histories(self, definitions: Collection[AreaDefinition], stamp: float) -> None:
        """Forget the histories of areas that are no more, in which nothing has begun for `RETENTION_S` before `stamp`.

        `definitions` are those in force and of removed areas. One that left `site.toml` has none: its last hazard is
        stored still.
        """
        present = {definition.id for definition in definitions if not definition.removed}
        stored = await self._readable_records(_HAZARDS, AreaHazard)
        for area in {*stored, *(definition.id for definition in definitions)} - present:
            key, oldest = self._key(f"{_HISTORY}:{area}"), f"{stamp - RETENTION_S:.3f}"
            await self._redis.write(("EVAL", records.FORGET, 1, key, oldest))

    async def alerts(self) -> list[Alert]:
        """Return the stored alerts."""
        found = (await self._readable_records(_ALERTS, StoredAlerts)).get(_ALL)
        return [] if found is None else found.alerts

    async def save_alerts(self, alerts: list[Alert]) -> None:
        """Replace the stored alerts."""
        await self._write_records(_ALERTS, {_ALL: StoredAlerts(alerts=alerts)})

    async def record_alert(self, event: AlertEvent) -> None:
        """Add what became of an alert to the audit trail, once."""
        audit = Audit(at=event.at, who=event.who, action=event.action)
        await self._record("alert", event.alert.id, msgspec.json.encode(event.alert), audit, fenced=True)

    async def earlier_override(self, attempt: Attempt | None) -> AreaOverride | None:
        """Return the override that an earlier attempt with the same idempotency key stored."""
        return await self.recall(attempt, AreaOverride)

    async def earlier_result(self, attempt: Attempt | None) -> AreaDefinition | None:
        """Return the area that an earlier attempt with the same idempotency key stored."""
        return await self.recall(attempt, AreaDefinition)

    async def restore(self, known: Stored, audit: Audit) -> None:
        """Replace the stored records by these, on an administrator's decision after Redis lost them."""
        tables: dict[str, dict[str, Message]] = {
            _AREAS.name: {definition.id: definition for definition in known.definitions},
            _HAZARDS: {hazard.area: hazard for hazard in known.hazards},
            _OVERRIDES.name: {override.area: override for override in known.overrides},
            _RESTS: {_ALL: _AllRests(overrides=known.rests)},
        }
        await self._adopt(tables, audit)


def _data(fields: Any) -> bytes:  # noqa: ANN401  # as redis gives them
    pairs = fields if isinstance(fields, dict) else dict(zip(fields[::2], fields[1::2], strict=True))
    return bytes(pairs[b"data"])


async def load_at_start(store: Store) -> tuple[Stored, bool]:
    """Return the stored records, and whether Redis answered; if not, none."""
    try:
        return await store.load(), True
    except StoreError as error:
        _log.warning("started_without_store", reason=str(error))
        return Stored([], [], [], {}, {}), False
