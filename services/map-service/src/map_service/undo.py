"""Undoes an operator's change of a zone, a set of zones or a place, by its entry in the audit trail."""

from collections.abc import Callable
from typing import Final

from msgspec import structs

from fog_contracts.messages import Zone
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError
from fog_runtime.http import Body, Operator, Routes
from fog_runtime.http.store_routes import UndoBody, Undone, add_undo_errors, undone
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.undo import ACTION, UndoError, require_rest, values
from map_service.api_sets import check_unused
from map_service.places import PlaceError, StoredPlace, check_place
from map_service.problems import NO_SUCH_ZONE, MapProblem, require_zones
from map_service.record_requests import R, missing
from map_service.record_writer import ConflictError, RecordWriter
from map_service.service import Service
from map_service.zone_times import SetOfZones
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


def add_record_undo(routes: Routes, service: Service) -> None:
    """Add the routes for sets of zones and places; `routes` knows the errors of both, and of the store."""
    add_undo_errors(routes)

    @routes.post(
        "/api/v1/zone-sets/{set_id}/undo",
        raises=[UndoError, ConflictError, StoreError],
        problems=[MapProblem.ZONE_SET_USED, *missing(MapProblem.NO_ZONE_SET), MapProblem.ZONE_SET_CHANGED],
    )
    async def undo_set(set_id: str, body: Body[UndoBody], caller: Operator) -> Undone:
        """Undo a change of a set of zones, if nobody has changed it since."""
        require_zones(service)
        entry = await service.undoable(body.entry, set_id, ("set",))
        before, after = values(entry, SetOfZones)
        record = await bring_back(service.sets, before, after, caller.name, lambda: check_unused(service, set_id))
        await service.publisher.all_on_map()
        return undone("set", set_id, record)

    @routes.post(
        "/api/v1/places/{place}/undo",
        raises=[UndoError, ConflictError, StoreError, PlaceError],
        problems=[*missing(MapProblem.NO_SUCH_PLACE), MapProblem.PLACE_CHANGED],
    )
    async def undo_place(place: str, body: Body[UndoBody], caller: Operator) -> Undone:
        """Undo a change of a place, if nobody has changed it since; one of `site.toml` is as there again."""
        require_zones(service)
        entry = await service.undoable(body.entry, place, ("place",))
        before, after = values(entry, StoredPlace)
        if before is not None and not before.removed:
            check_place(place, before, service.core)  # the map may be another one
        await bring_back(service.places, before, after, caller.name)
        return undone("place", place, service.core.places.get(place))


async def bring_back(
    writer: RecordWriter[R], before: R | None, after: R | None, who: str, check: Callable[[], object] = lambda: None
) -> R | None:
    """Store what was before; `check` may refuse to delete a record. Return it, None if that was none."""
    if before is not None:
        return await writer.put(before, 0 if after is None else after.version, who, action=ACTION)
    if after is None:
        raise UndoError("not_undoable", "there was nothing before, and nothing after: there is nothing to undo")
    await writer.delete(after.id, after.version, who, action=ACTION, check=check)
    return None


async def _undo(service: Service, before: Zone | None, after: Zone | None, who: str, stamp: float) -> Zone | None:
    """Bring back what was before; return it, None if that was no zone."""
    if before is None:
        if after is None:
            raise UndoError("not_undoable", "there was no zone before, and none after: there is nothing to undo")
        await service.zones.delete(after.id, after.version, who, action=ACTION)
        await service.zone_sources.forget(after)
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
