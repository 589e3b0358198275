"""REST: operators' overrides of areas, `/api/v1/areas/{area_id}/override` (ADR 16)."""

from fog_contracts.messages import Author, Count, Message, OverrideReason, OverrideState, Seconds, Stamp, TimeToLive
from fog_runtime.clock import Clock
from fog_runtime.http import (
    Answer,
    Body,
    Caller,
    IdempotencyKey,
    IfMatch,
    Operator,
    ProblemError,
    Routes,
    attempt_of,
    etag,
    expected_version,
)
from fog_runtime.stores.idempotency import IdempotencyError
from hazard_aggregator.areas.area_override import LONGEST_S, AreaOverride
from hazard_aggregator.service import Service
from hazard_aggregator.store import StoreError
from hazard_aggregator.writers.area_writer import ConflictError


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

    @routes.get("/api/v1/areas/{area_id}/override", problems={404: "No area has this id, or it has no override"})
    async def get_override(area_id: str) -> Answer[OverrideView]:
        """Return an area's override with its ETag."""
        _require_area(service, area_id)
        view = override_view(service, area_id, clock.now())
        if view is None:
            raise _without_override(area_id)
        return Answer(view, etag(view.version))

    @routes.put(
        "/api/v1/areas/{area_id}/override",
        status=(200, 201),
        raises=[ConflictError, IdempotencyError, StoreError],
        problems={404: "No area has this id"},
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
        _require_area(service, area_id)
        _require_allowed(body, caller)
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
        problems={404: "No area has this id, or it has no override"},
    )
    async def delete_override(area_id: str, caller: Operator, if_match: IfMatch = None) -> None:
        """End an area's override, with If-Match only if it is unchanged: its nodes count again."""
        if not await service.overrides.remove(area_id, caller.name, expected_version(if_match)):
            raise _without_override(area_id)


def no_such_area(area: str) -> ProblemError:
    """Return the problem of a request about an area that does not exist."""
    return ProblemError(404, f"there is no area {area}: GET /api/v1/areas lists those that there are")


def _without_override(area: str) -> ProblemError:
    return ProblemError(404, f"area {area} has no override: its nodes and sources decide; PUT one first")


def _require_area(service: Service, area: str) -> None:
    if not any(known.id == area and not known.removed for known in service.core.definitions()):
        raise no_such_area(area)


def _require_allowed(body: OverrideBody, caller: Caller) -> None:
    if body.state == "clear" and caller.role != "admin":
        raise ProblemError(
            403, f"to declare an area clear needs the role admin; {caller.name} has the role {caller.role}"
        )
    if body.ttl_s > (longest := LONGEST_S[body.state]):
        raise ProblemError(
            422, f"an area can be overridden as {body.state} for {longest:g} s at most", field="body.ttl_s"
        )


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
