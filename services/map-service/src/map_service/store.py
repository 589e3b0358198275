"""The map-service's records in Redis: zones with optimistic versioning, and the audit log."""

from __future__ import annotations

from typing import Final

import msgspec

from fog_contracts.messages import Zone
from fog_runtime.redis_store import Audit, Outcome, RedisStore, StoreError, Table

__all__ = ["Audit", "AuditEntry", "Outcome", "Store", "StoreError"]

_ZONES: Final = Table("zones", "zone")


class AuditEntry(Audit, frozen=True, kw_only=True):
    """A change of a zone; `before` and `after` are null where the zone did or does not exist."""

    zone: str
    before: Zone | None
    after: Zone | None


class Store(RedisStore):
    """The map-service's keys."""

    async def zones(self) -> list[Zone]:
        """Return all stored zones; an unreadable one raises `StoreError`: a no-go zone must never be left out."""
        return list((await self._records(_ZONES.name, Zone)).values())

    async def put(self, zone: Zone, *, expected: int, audit: Audit) -> Outcome:
        """Write a zone durably if the stored version is `expected` (0: none is stored)."""
        return await self._swap(_ZONES, zone.id, zone, str(expected), audit)

    async def delete(self, zone: Zone, audit: Audit) -> Outcome:
        """Delete a zone durably if the stored version is this one's."""
        outcome = await self._swap(_ZONES, zone.id, None, str(zone.version), audit)
        # The zone is deleted already: by an attempt whose reply was lost, or by somebody else.
        return "ok" if outcome == "missing" else outcome

    async def audit(self, limit: int) -> list[AuditEntry]:
        """Return the newest entries about zones, newest first."""
        return [_audit_entry(fields) for fields in await self.audit_entries(limit) if _ZONES.subject in fields]


def _audit_entry(fields: dict[str, str]) -> AuditEntry:
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
