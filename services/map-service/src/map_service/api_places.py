"""REST for places: added, moved, named and removed by operators."""

from typing import Annotated, Any

import msgspec

from fog_contracts.messages import Message, Metres, Place, Radians
from fog_runtime.http import (
    Answer,
    Body,
    Caller,
    IfMatch,
    Operator,
    Patch,
    PatchOf,
    ProblemError,
    Routes,
    etag,
    expected_version,
    patched,
)
from fog_runtime.http.store_routes import IdempotencyKey, IfNoneMatch, attempt_of
from fog_runtime.stores.redis_store import Attempt
from map_service.places import PlaceError, PlaceView, StoredPlace, check_place, warnings_of
from map_service.problems import ZONES_NOT_LOADED, MapProblem, require_zones
from map_service.record_requests import WRITES, Conditions, check_id, missing
from map_service.service import Service


class PlaceBody(Message, frozen=True, kw_only=True):
    """A place: m and rad, frame `map`; without `theta` any heading is accepted; `public`: for visitors, too."""

    x: Metres
    y: Metres
    theta: Radians | None = None
    label: Annotated[str, msgspec.Meta(max_length=100)] = ""
    public: bool = False


class _Places:
    """The places as people see them, and their changes."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._core, self._writer = service.core, service.places

    def view(self, name: str, place: Place) -> PlaceView:
        """Return a place with its version and warnings."""
        stored = self._writer.records.get(name)
        version = 0 if stored is None else stored.version
        return PlaceView(**_fields(place), version=version, warnings=warnings_of(place, self._core))

    def find(self, name: str) -> Place:
        """Return a place that is there; else raises a `ProblemError`."""
        require_zones(self._service)
        if (found := self._core.places.get(name)) is None:
            detail = f"there is no place {name}; places: {', '.join(self._core.places) or 'none'}"
            raise ProblemError(MapProblem.NO_SUCH_PLACE, detail)
        return found

    def conditions(self, name: str, if_match: str | None, if_none_match: str | None = None) -> Conditions:
        """Return the conditions of a request."""
        return Conditions(self._writer, name, if_match, if_none_match, exists=name in self._core.places)

    async def put(
        self, name: str, body: PlaceBody, caller: Caller, attempt: Attempt | None, conditions: Conditions
    ) -> Answer[PlaceView]:
        """Store a place; raises `PlaceError`, and what `WRITES` names."""
        check_place(name, Place(**_fields(body)), self._core)
        record, action = StoredPlace(id=name, **_fields(body)), "create" if conditions.new else "replace"
        stored = await self._writer.put(record, conditions.expected, caller.name, attempt, action=action)
        return Answer(self.view(name, stored), etag(stored.version), status=conditions.status)


def add_places(routes: Routes, service: Service) -> None:
    """Add the routes."""
    writer, core, shown = service.places, service.core, _Places(service)
    changed = [MapProblem.PLACE_CHANGED, *missing(MapProblem.NO_SUCH_PLACE)]
    routes.raises(
        PlaceError,
        [MapProblem.PLACE_INVALID],
        lambda error: ProblemError(MapProblem.PLACE_INVALID, error.message, field=f"body.{error.field}".rstrip(".")),
    )

    @routes.get("/api/v1/places")
    async def places() -> dict[str, PlaceView]:
        """Return the places by id: those of `site.toml`, as operators have changed them since."""
        return {name: shown.view(name, place) for name, place in core.places.items()}

    @routes.get("/api/v1/places/{place}", problems=[MapProblem.NO_SUCH_PLACE, *ZONES_NOT_LOADED])
    async def get_place(place: str) -> Answer[PlaceView]:
        """Return one place with its ETag."""
        found = shown.view(place, shown.find(place))
        return Answer(found, etag(found.version))

    @routes.put("/api/v1/places/{place}", status=(200, 201), raises=[*WRITES, PlaceError], problems=changed)
    async def put_place(  # headers are parameters
        place: str,
        body: Body[PlaceBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[PlaceView]:
        """Add or replace a place; its `warnings` name the zones that keep robots out of it."""
        require_zones(service)
        check_id(place)
        attempt = attempt_of(idempotency_key, caller, f"PUT /api/v1/places/{place}", body)
        if (earlier := await writer.earlier_result(attempt)) is not None:
            return Answer(shown.view(place, earlier), etag(earlier.version))
        return await shown.put(place, body, caller, attempt, shown.conditions(place, if_match, if_none_match))

    @routes.patch("/api/v1/places/{place}", raises=[*WRITES, PlaceError], problems=changed)
    async def patch_place(
        place: str,
        patch: Annotated[Patch, PatchOf(PlaceBody)],
        caller: Operator,
        if_match: IfMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[PlaceView]:
        """Change fields of a place: move it, or give it another name (`label`)."""
        attempt = attempt_of(idempotency_key, caller, f"PATCH /api/v1/places/{place}", patch)
        if (earlier := await writer.earlier_result(attempt)) is not None:
            return Answer(shown.view(place, earlier), etag(earlier.version))
        old = shown.find(place)
        before = PlaceBody(**_fields(old))
        conditions = shown.conditions(place, if_match)
        if conditions.expected is None:  # the fields that stay are those that were read here
            conditions.expected = shown.view(place, old).version
        return await shown.put(place, patched(before, patch), caller, attempt, conditions)

    @routes.delete("/api/v1/places/{place}", raises=WRITES, problems=changed)
    async def delete_place(place: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Remove a place. One of `site.toml` stays removed until it is PUT again."""
        old, expected = shown.find(place), expected_version(if_match)
        if place not in service.initial_places:
            await writer.delete(place, expected, caller.name)
            return
        gone = StoredPlace(id=place, **_fields(old), removed=True)
        await writer.put(gone, expected, caller.name, action="delete")


def _fields(place: Place | PlaceBody) -> dict[str, Any]:
    return {name: getattr(place, name) for name in ("x", "y", "theta", "label", "public")}
