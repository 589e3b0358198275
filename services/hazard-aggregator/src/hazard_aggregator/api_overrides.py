"""REST of operators' overrides of areas, and of undoing a change by its entry in the audit trail."""

from typing import Final

from msgspec import structs

from fog_contracts.messages import (
    AreaDefinition,
    Author,
    Count,
    Message,
    OverrideReason,
    OverrideState,
    Seconds,
    Stamp,
    TimeToLive,
)
from fog_runtime.clock import Clock
from fog_runtime.http import Answer, Body, Caller, IfMatch, Operator, ProblemError, Routes, etag, expected_version
from fog_runtime.http.store_routes import IdempotencyKey, UndoBody, Undone, add_undo_errors, attempt_of, undone
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from fog_runtime.stores.undo import ACTION, UndoError, require_rest, values
from hazard_aggregator.area_size import AreaError, TooManyAreasError, check_size
from hazard_aggregator.areas import LONGEST_S, AreaOverride
from hazard_aggregator.problems import AreaProblem, no_such_area
from hazard_aggregator.service import Service
from hazard_aggregator.writers import ConflictError


class OverrideBody(Message, frozen=True, kw_only=True):
    """What an operator says of an area instead of its nodes, why, and for how long (`ttl_s`).

    `blocked` for 30 days at most; `clear`, which needs an admin's token, for 15 minutes at most.
    """

    state: OverrideState
    reason: OverrideReason
    ttl_s: TimeToLive


class OverrideView(Message, frozen=True, kw_only=True):
    """An override in force; `rest_s` is the time until it ends."""

    state: OverrideState
    author: Author
    reason: OverrideReason
    set_at: Stamp
    ttl_s: TimeToLive
    rest_s: Seconds
    version: Count


def override_view(service: Service, area: str, now: float) -> OverrideView | None:
    """Return the override of an area that is in force."""
    override = service.core.overrides.get(area)
    return None if override is None else _view(override, service.core.overrides.rest_s(area, now))


def add_overrides(routes: Routes, service: Service, clock: Clock) -> None:
    """Add the routes that set and remove overrides; `routes` knows the errors of areas and of the store."""

    @routes.get("/api/v1/areas/{area_id}/override", problems=[AreaProblem.NO_AREA, AreaProblem.NO_OVERRIDE])
    async def get_override(area_id: str) -> Answer[OverrideView]:
        """Return an area's override with its ETag."""
        require_area(service, area_id)
        view = override_view(service, area_id, clock.now())
        if view is None:
            raise _without_override(area_id)
        return Answer(view, etag(view.version))

    @routes.put(
        "/api/v1/areas/{area_id}/override",
        status=(200, 201),
        raises=[ConflictError, IdempotencyError, StoreError],
        problems=[AreaProblem.NO_AREA, AreaProblem.CLEAR_NEEDS_ADMIN, AreaProblem.OVERRIDE_TOO_LONG],
    )
    async def put_override(
        area_id: str,
        body: Body[OverrideBody],
        caller: Operator,
        if_match: IfMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[OverrideView]:
        """Override an area for a time; replies once it is durably stored.

        Robots avoid a `blocked` area whatever its nodes measure. They may pass a `clear` one, at half speed.
        """
        require_area(service, area_id)
        require_allowed(body.state, body.ttl_s, caller)
        new = service.core.overrides.get(area_id) is None
        override = await service.overrides.put(
            area_id,
            body.state,
            body.reason,
            body.ttl_s,
            caller.name,
            expected=expected_version(if_match),
            attempt=attempt_of(idempotency_key, caller, f"PUT /api/v1/areas/{area_id}/override", body),
        )
        rest_s = max(0.0, override.deadline - clock.now())
        return Answer(_view(override, rest_s), etag(override.version), status=201 if new else 200)

    @routes.delete(
        "/api/v1/areas/{area_id}/override",
        raises=[ConflictError, StoreError],
        problems=[AreaProblem.NO_AREA, AreaProblem.NO_OVERRIDE],
    )
    async def delete_override(area_id: str, caller: Operator, if_match: IfMatch = None) -> None:
        """End an area's override, with If-Match only if it is unchanged: its nodes count again."""
        if not await service.overrides.remove(area_id, caller.name, expected_version(if_match)):
            raise _without_override(area_id)


def _without_override(area: str) -> ProblemError:
    detail = f"area {area} has no override: its nodes and sources decide; PUT one first"
    return ProblemError(AreaProblem.NO_OVERRIDE, detail)


def require_area(service: Service, area: str) -> None:
    """Raise a `ProblemError` for an area that does not exist."""
    if not any(known.id == area and not known.removed for known in service.core.definitions()):
        raise no_such_area(area)


def require_allowed(state: OverrideState, ttl_s: float, caller: Caller) -> None:
    """Raise a `ProblemError` when a caller may not override an area so, or for so long (s)."""
    if state == "clear" and caller.role != "admin":
        detail = f"to declare an area clear needs the role admin; {caller.name} has the role {caller.role}"
        raise ProblemError(AreaProblem.CLEAR_NEEDS_ADMIN, detail)
    if ttl_s > (longest := LONGEST_S[state]):
        detail = f"an area can be overridden as {state} for {longest:.0f} s at most"
        raise ProblemError(AreaProblem.OVERRIDE_TOO_LONG, detail, field="body.ttl_s")


def _view(override: AreaOverride, rest_s: float) -> OverrideView:
    return OverrideView(
        state=override.state,
        author=override.author,
        reason=override.reason,
        set_at=override.set_at,
        ttl_s=override.ttl_s,
        rest_s=rest_s,
        version=override.version,
    )


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
