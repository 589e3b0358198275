"""The map-service's records in Redis: zones, their sets, places, muted sources, the map; with optimistic versioning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeVar

from msgspec import structs

from fog_contracts.messages import Message, Zone
from fog_runtime.stores import records
from fog_runtime.stores.redis_store import ANY, Audit, Outcome, RedisStore, Table
from map_service.zone_times import Progress

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_runtime.stores.redis_store import Attempt

R = TypeVar("R", bound=Message)

ZONES: Final = Table(records.ZONES, "zone")
ZONE_SETS: Final = Table(records.ZONE_SETS, "set")
ZONE_SOURCES: Final = Table(records.ZONE_SOURCES, "source")
PLACES: Final = Table(records.PLACES, "place")
SITE_MAPS: Final = Table(records.SITE_MAPS, "map")

_TIMES: Final = records.ZONE_TIMES
_ALL: Final = "all"


class _AllTimes(Message, frozen=True, kw_only=True):
    zones: dict[str, Progress]


class Store(RedisStore):
    """The map-service's keys."""

    tables = (ZONES.name, ZONE_SETS.name, ZONE_SOURCES.name, PLACES.name, SITE_MAPS.name)

    async def zones(self) -> tuple[list[Zone], dict[str, str]]:
        """Return all stored zones, and, by id, why others are unreadable."""
        zones, unreadable = await self._decoded(ZONES.name, Zone)
        await self._load_floor(ZONES.name)
        return list(zones.values()), unreadable

    async def create(self, zone: Zone, audit: Audit) -> tuple[Outcome, Zone]:
        """Write a new zone durably; return it with its version, which no zone of this id had before."""
        return await self._create(ZONES, zone.id, zone, audit)

    async def _create(self, table: Table, name: str, record: R, audit: Audit) -> tuple[Outcome, R]:
        outcome: Outcome = "stale"
        for _ in range(2):
            record = structs.replace(record, version=self._floor(table.name) + 1)
            outcome = await self._swap(table, name, record, "0", audit)
            if outcome != "stale":
                break  # else this process did not know of the newest deletion, and does now
        return outcome, record

    async def replace(self, zone: Zone, *, expected: int, audit: Audit) -> Outcome:
        """Write a new version of a zone durably if the stored version is `expected`."""
        return await self._swap(ZONES, zone.id, zone, str(expected), audit)

    async def delete(self, zone: Zone, audit: Audit) -> Outcome:
        """Delete a zone durably if the stored version is this one's."""
        outcome = await self._swap(ZONES, zone.id, None, str(zone.version), audit)
        # The zone is deleted already: by an attempt whose reply was lost, or by somebody else.
        return "ok" if outcome == "missing" else outcome

    async def delete_unusable(self, zone_id: str, audit: Audit) -> None:
        """Delete a zone, whatever its record contains."""
        await self._swap(ZONES, zone_id, None, ANY, audit)

    async def zone_times(self) -> dict[str, Progress]:
        """Return the stored times of zones by id."""
        stored = (await self._readable_records(_TIMES, _AllTimes)).get(_ALL)
        return {} if stored is None else stored.zones

    async def write_zone_times(self, times: dict[str, Progress]) -> None:
        """Replace the stored times of all zones."""
        await self._write_records(_TIMES, {_ALL: _AllTimes(zones=times)})

    async def earlier_result(self, attempt: Attempt | None) -> Zone | None:
        """Return the zone that an earlier attempt with the same idempotency key stored."""
        return await self.recall(attempt, Zone)

    # --- Records beside zones ---------------------------------------------------------------------------------------

    async def read(self, table: Table, kind: type[R]) -> dict[str, R]:
        """Return the readable records of a table by id; an unreadable one is logged and left out."""
        found = await self._readable_records(table.name, kind)
        await self._load_floor(table.name)
        return found

    async def write(self, table: Table, name: str, record: R, expected: int | None, audit: Audit) -> tuple[Outcome, R]:
        """Write a record durably if the stored version is `expected` (None: there is none); return it as stored."""
        if expected is None:
            return await self._create(table, name, record, audit)
        record = structs.replace(record, version=expected + 1)
        return await self._swap(table, name, record, str(expected), audit), record

    async def erase(self, table: Table, name: str, expected: int, audit: Audit) -> Outcome:
        """Delete a record durably if the stored version is `expected`."""
        outcome = await self._swap(table, name, None, str(expected), audit)
        return "ok" if outcome == "missing" else outcome

    async def restore(
        self, tables: Mapping[str, Mapping[str, Message]], times: dict[str, Progress], audit: Audit
    ) -> None:
        """Replace the stored records by these (table, id), on an administrator's decision after Redis lost them.

        The zones' times go with them: a map-service that starts right afterwards must not let its zones last anew.
        """
        await self._adopt({**tables, _TIMES: {_ALL: _AllTimes(zones=times)}}, audit)
