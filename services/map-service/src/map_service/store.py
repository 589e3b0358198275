"""Redis as the record of what operators drew: zones with optimistic versions, and who did what when."""

from __future__ import annotations

from typing import Final

import msgspec

from fog_contracts.messages import Zone
from fog_runtime.redis_store import Audit, Outcome, RedisStore, StoreError, Table

__all__ = ["Audit", "AuditEntry", "Outcome", "Store", "StoreError"]

_ZONES: Final = Table("zones", "zone")


class AuditEntry(Audit, frozen=True, kw_only=True):
    """What was done to a zone; `before` and `after` are null where there was or is none."""

    zone: str
    before: Zone | None
    after: Zone | None


class Store(RedisStore):
    """The map-service's keys."""

    async def zones(self) -> list[Zone]:
        """Return all stored zones; one that can't be read is an error: a no-go zone must not be missing silently."""
        return list((await self._records(_ZONES.name, Zone)).values())

    async def put(self, zone: Zone, *, expected: int, audit: Audit) -> Outcome:
        """Write a zone durably if the stored version is `expected` (0: none is stored)."""
        return await self._swap(_ZONES, zone.id, zone, str(expected), audit)

    async def delete(self, zone: Zone, audit: Audit) -> Outcome:
        """Delete a zone durably if the stored version is this one's."""
        outcome = await self._swap(_ZONES, zone.id, None, str(zone.version), audit)
        # Gone already is what was wanted: an attempt whose answer was lost, or somebody else's hand.
        return "ok" if outcome == "missing" else outcome

    async def audit(self, limit: int) -> list[AuditEntry]:
        """Return the newest entries about zones, newest first."""
        return [_entry(fields) for fields in await self.audit_entries(limit) if _ZONES.subject in fields]


def _entry(fields: dict[str, str]) -> AuditEntry:
    before, after = (
        msgspec.json.decode(fields[name], type=Zone) if fields[name] else None for name in ("before", "after")
    )
    return AuditEntry(
        at=float(fields["at"]),
        who=fields["who"],
        action=fields["action"],
        zone=fields["zone"],
        before=before,
        after=after,
    )
