"""Undoes an operator's change of an area or of its override, by its entry in the audit trail."""

from typing import Final

from msgspec import structs

from fog_contracts.messages import AreaDefinition
from fog_runtime.clock import Clock
from fog_runtime.http import Body, Caller, Operator, ProblemError, Routes
from fog_runtime.http.store_routes import UndoBody, Undone, add_undo_errors, undone
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from fog_runtime.stores.undo import ACTION, UndoError, require_rest, values
from hazard_aggregator.api_overrides import require_allowed, require_area
from hazard_aggregator.area_size import AreaError, TooManyAreasError, check_size
from hazard_aggregator.areas import AreaOverride
from hazard_aggregator.problems import AreaProblem
from hazard_aggregator.service import Service
from hazard_aggregator.writers import ConflictError

_KINDS: Final = ("area", "override")


def add_undo(routes: Routes, service: Service, clock: Clock) -> None:
    """Add the route; `routes` knows the errors of areas and of the store."""
    add_undo_errors(routes)

    @routes.post(
        "/api/v1/areas/{area_id}/undo",
        raises=[UndoError, ConflictError, IdempotencyError, StoreError, TooManyAreasError],
        problems=[
            AreaProblem.NO_AREA,
            AreaProblem.AREA_INVALID,
            AreaProblem.CLEAR_NEEDS_ADMIN,
            AreaProblem.OVERRIDE_TOO_LONG,
        ],
    )
    async def undo_area(area_id: str, body: Body[UndoBody], caller: Operator) -> Undone:
        """Undo a change of an area, or of its override, if nobody has changed it since. An undo can be undone, too.

        An override that comes back has the rest of its time; one that declares the area clear needs an admin.
        """
        entry = await service.undoable(body.entry, area_id, _KINDS)
        if entry.kind == "area":
            area = await _undo_area(service, *values(entry, AreaDefinition), caller.name)
            return undone("area", area_id, None if area.removed else area)
        require_area(service, area_id)
        override = await _undo_override(service, *values(entry, AreaOverride), caller, clock.stamp())
        return undone("override", area_id, override)


async def _undo_area(
    service: Service, before: AreaDefinition | None, after: AreaDefinition | None, who: str
) -> AreaDefinition:
    """Bring back what was before, an area that was new as a removed one; return it."""
    if after is None:
        raise UndoError("not_undoable", "the audit trail does not tell what the area was after the change")
    area = structs.replace(after, removed=True) if before is None else before
    try:
        area = service.core.checked(area)
        check_size(area)
    except AreaError as error:
        detail = f"the area as it was before is none any more: {error.field}: {error.problem}"
        raise ProblemError(AreaProblem.AREA_INVALID, detail, field="body.entry") from error
    return await service.areas.put_area(area, who, expected=after.version, action=ACTION)


async def _undo_override(
    service: Service, before: AreaOverride | None, after: AreaOverride | None, caller: Caller, stamp: float
) -> AreaOverride | None:
    """Bring back the override that was before, if its time is not over; return it, None if there is none now."""
    expected = 0 if after is None else after.version
    ended = before is None or before.set_at + before.ttl_s <= stamp
    if after is not None and ended:
        await service.overrides.remove(after.area, caller.name, expected, action=ACTION)
        return None
    if before is None:
        raise UndoError("not_undoable", "there was no override before, and none after: there is nothing to undo")
    rest = require_rest(before.set_at + before.ttl_s, stamp, f"the override of area {before.area}")
    ttl_s = min(rest, before.ttl_s)
    require_allowed(before.state, ttl_s, caller)
    return await service.overrides.put(
        before.area, before.state, before.reason, ttl_s, caller.name, expected=expected, action=ACTION
    )
