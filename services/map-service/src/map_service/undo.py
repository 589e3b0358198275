"""Undoes an operator's change of a zone, by its entry in the audit trail."""

from typing import Final

from msgspec import structs

from fog_contracts.messages import Zone
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError
from fog_runtime.http import Body, Operator, Routes, UndoBody, Undone, add_undo_errors, undone
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.undo import ACTION, UndoError, require_rest, values
from map_service.problems import NO_SUCH_ZONE
from map_service.service import Service
from map_service.zone_writer import ConflictError
from map_service.zones import ZoneError

_KINDS: Final = ("zone",)


def add_undo(routes: Routes, service: Service, clock: Clock) -> None:
    """Add the route; `routes` knows the errors of zones and of the store."""
    add_undo_errors(routes)

    @routes.post(
        "/api/v1/zones/{zone_id}/undo",
        raises=[UndoError, ZoneError, ConflictError, BusyError, StoreError],
        problems=NO_SUCH_ZONE,
    )
    async def undo_zone(zone_id: str, body: Body[UndoBody], caller: Operator) -> Undone:
        """Undo a change of a zone, if nobody has changed the zone since. An undo can be undone, too.

        A zone that comes back with a time to live has the rest of it.
        """
        await service.zones.reload_after_uncertain_write()
        entry = await service.undoable(body.entry, zone_id, _KINDS)
        return undone("zone", zone_id, await _undo(service, *values(entry, Zone), caller.name, clock.stamp()))


async def _undo(service: Service, before: Zone | None, after: Zone | None, who: str, stamp: float) -> Zone | None:
    """Bring back what was before; return it, None if that was no zone."""
    if before is None:
        if after is None:
            raise UndoError("not_undoable", "there was no zone before, and none after: there is nothing to undo")
        await service.zones.delete(after.id, after.version, who, action=ACTION)
        return None
    zone = _with_rest(before, stamp)
    if after is None:
        return await service.zones.create(zone, who, action=ACTION)
    return await service.zones.replace(zone, after.version, who, action=ACTION)


def _with_rest(zone: Zone, stamp: float) -> Zone:
    """Return a zone of the past as it is to be stored now; raises `UndoError` if it would have ended."""
    if zone.expires_at is None:
        return zone
    rest = require_rest(zone.expires_at, stamp, f"zone {zone.id}")
    return zone if zone.ttl_s is None else structs.replace(zone, ttl_s=min(rest, zone.ttl_s))
