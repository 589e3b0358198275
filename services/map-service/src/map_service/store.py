"""The map-service's records in Redis: zones with optimistic versioning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec import structs

from fog_contracts.messages import Message, Zone
from fog_runtime.stores import records
from fog_runtime.stores.redis_store import ANY, Audit, Outcome, RedisStore, Table
from map_service.zone_times import Progress

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_runtime.stores.redis_store import Attempt

_ZONES: Final = Table(records.ZONES, "zone")

_TIMES: Final = records.ZONE_TIMES
_ALL: Final = "all"


class _AllTimes(Message, frozen=True, kw_only=True):
    zones: dict[str, Progress]


class Store(RedisStore):
    """The map-service's keys."""

    tables = (_ZONES.name,)

    async def zones(self) -> tuple[list[Zone], dict[str, str]]:
        """Return all stored zones, and, by id, why others are unreadable."""
        zones, unreadable = await self._decoded(_ZONES.name, Zone)
        await self._load_floor(_ZONES.name)
        return list(zones.values()), unreadable

    async def create(self, zone: Zone, audit: Audit) -> tuple[Outcome, Zone]:
        """Write a new zone durably; return it with its version, which no zone of this id had before."""
        outcome: Outcome = "stale"
        for _ in range(2):
            zone = structs.replace(zone, version=self._floor(_ZONES.name) + 1)
            outcome = await self._swap(_ZONES, zone.id, zone, "0", audit)
            if outcome != "stale":
                break  # else this process did not know of the newest deletion, and does now
        return outcome, zone

    async def replace(self, zone: Zone, *, expected: int, audit: Audit) -> Outcome:
        """Write a new version of a zone durably if the stored version is `expected`."""
        return await self._swap(_ZONES, zone.id, zone, str(expected), audit)

    async def delete(self, zone: Zone, audit: Audit) -> Outcome:
        """Delete a zone durably if the stored version is this one's."""
        outcome = await self._swap(_ZONES, zone.id, None, str(zone.version), audit)
        # The zone is deleted already: by an attempt whose reply was lost, or by somebody else.
        return "ok" if outcome == "missing" else outcome

    async def delete_unusable(self, zone_id: str, audit: Audit) -> None:
        """Delete a zone, whatever its record contains."""
        await self._swap(_ZONES, zone_id, None, ANY, audit)

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

    async def restore(self, zones: Iterable[Zone], audit: Audit) -> None:
        """Replace the stored zones by these, on an administrator's decision after Redis lost them."""
        await self._adopt({_ZONES.name: {zone.id: zone for zone in zones}}, audit)
