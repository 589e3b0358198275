"""REST for sets of zones that are switched together, and for the sources that put zones over MQTT."""

from typing import Final

from msgspec import structs

from fog_contracts.messages import Message, Sentence, WeeklySchedule
from fog_contracts.weekly import is_time_zone
from fog_runtime.http import Answer, Body, IfMatch, Operator, ProblemError, Routes, Viewer, etag, expected_version
from fog_runtime.http.store_routes import IdempotencyKey, IfNoneMatch, attempt_of
from map_service.problems import ZONES_NOT_LOADED, MapProblem, require_zones
from map_service.record_requests import WRITES, Conditions, check_id, missing
from map_service.service import Service
from map_service.zone_sources import ZoneSourceView
from map_service.zone_times import MutedSource, SetOfZones

MAX_SETS: Final = 200
"""Most sets of zones of a site."""
_SHOWN: Final = 5


class SetBody(Message, frozen=True, kw_only=True):
    """A set of zones that are switched together; with a `schedule` it is on in the schedule's windows only."""

    name: Sentence = ""
    enabled: bool = True
    schedule: WeeklySchedule | None = None


class SetView(SetOfZones, frozen=True, kw_only=True):
    """A set of zones, whether it is on now, and the ids of its zones."""

    on: bool
    zones: list[str]


class MuteBody(Message, frozen=True, kw_only=True):
    """Whether a source's messages are to be refused; its zones stay."""

    muted: bool


class _Sets:
    """The sets of zones as people see them."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def view(self, one: SetOfZones) -> SetView:
        """Return a set, with its zones."""
        core = self._service.core
        zones = [entry.zone.id for entry in core.zones.in_sets() if one.id in entry.zone.sets]
        return SetView(**structs.asdict(one), on=one.id not in core.zone_sets.off, zones=sorted(zones))

    def find(self, set_id: str) -> SetOfZones:
        """Return a set that is there; else raises a `ProblemError`."""
        require_zones(self._service)
        known = self._service.sets.records
        if (found := known.get(set_id)) is None:
            detail = f"there is no set of zones {set_id}; there are: {', '.join(sorted(known)) or 'none'}"
            raise ProblemError(MapProblem.NO_ZONE_SET, detail)
        return found


def check_unused(service: Service, set_id: str) -> None:
    """Raise a `ProblemError` for a set that zones name."""
    users = sorted(entry.zone.id for entry in service.core.zones.in_sets() if set_id in entry.zone.sets)
    if users:
        named = ", ".join(users[:_SHOWN]) + (", ..." if len(users) > _SHOWN else "")
        detail = f"{len(users)} zones name the set {set_id} ({named}): take them out of it, or delete them, first"
        raise ProblemError(MapProblem.ZONE_SET_USED, detail)


def add_sets(routes: Routes, service: Service) -> None:
    """Add the routes of sets of zones."""
    sets, shown = service.sets, _Sets(service)

    @routes.get("/api/v1/zone-sets", problems=ZONES_NOT_LOADED)
    async def list_sets() -> list[SetView]:
        """List the sets of zones, and which of them are on."""
        require_zones(service)
        return [shown.view(one) for _, one in sorted(sets.records.items())]

    @routes.get("/api/v1/zone-sets/{set_id}", problems=[MapProblem.NO_ZONE_SET, *ZONES_NOT_LOADED])
    async def get_set(set_id: str) -> Answer[SetView]:
        """Return one set of zones with its ETag."""
        found = shown.find(set_id)
        return Answer(shown.view(found), etag(found.version))

    @routes.put(
        "/api/v1/zone-sets/{set_id}",
        status=(200, 201),
        raises=WRITES,
        problems=[MapProblem.ZONE_SET_CHANGED, MapProblem.ZONE_SET_INVALID, *missing(MapProblem.NO_ZONE_SET)],
    )
    async def put_set(  # headers are parameters
        set_id: str,
        body: Body[SetBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[SetView]:
        """Add or replace a set of zones: switching it off takes all its zones off the map at once."""
        require_zones(service)
        check_id(set_id)
        attempt = attempt_of(idempotency_key, caller, f"PUT /api/v1/zone-sets/{set_id}", body)
        if (earlier := await sets.earlier_result(attempt)) is not None:
            return Answer(shown.view(earlier), etag(earlier.version))
        conditions = Conditions(sets, set_id, if_match, if_none_match, exists=set_id in sets.records)
        _check_set(body, len(sets.records), new=conditions.new)
        record = SetOfZones(id=set_id, name=body.name, enabled=body.enabled, schedule=body.schedule)
        stored = await sets.put(record, conditions.expected, caller.name, attempt)
        await service.publisher.all_on_map()
        return Answer(shown.view(stored), etag(stored.version), status=conditions.status)

    @routes.delete(
        "/api/v1/zone-sets/{set_id}",
        raises=WRITES,
        problems=[MapProblem.ZONE_SET_CHANGED, MapProblem.ZONE_SET_USED, *missing(MapProblem.NO_ZONE_SET)],
    )
    async def delete_set(set_id: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Delete a set that no zone names."""
        shown.find(set_id)
        await sets.delete(set_id, expected_version(if_match), caller.name, check=lambda: check_unused(service, set_id))


def add_sources(routes: Routes, service: Service) -> None:
    """Add the routes of sources of zones."""
    sources, muted = service.zone_sources, service.muted

    @routes.get("/api/v1/zone-sources")
    async def list_zone_sources(_caller: Viewer) -> list[ZoneSourceView]:
        """List the sources of zones: what they have on the map, and what was refused."""
        return sources.views()

    @routes.put(
        "/api/v1/zone-sources/{source}",
        raises=WRITES,
        problems=[MapProblem.ZONE_SOURCE_CHANGED, *missing(MapProblem.NO_ZONE_SOURCE)],
    )
    async def put_zone_source(
        source: str,
        body: Body[MuteBody],
        caller: Operator,
        if_match: IfMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[ZoneSourceView]:
        """Mute a source of zones, or let it speak again."""
        require_zones(service)
        known = {view.id: view for view in sources.views()}
        if source not in known:
            detail = f"there is no source of zones {source}; site.toml has: {', '.join(known) or 'none'}"
            raise ProblemError(MapProblem.NO_ZONE_SOURCE, detail)
        attempt = attempt_of(idempotency_key, caller, f"PUT /api/v1/zone-sources/{source}", body)
        record = MutedSource(id=source, muted=body.muted)
        stored = await muted.put(record, expected_version(if_match), caller.name, attempt)
        return Answer(structs.replace(known[source], muted=stored.muted, version=stored.version), etag(stored.version))


def _check_set(body: SetBody, count: int, *, new: bool) -> None:
    if body.schedule is not None and not is_time_zone(body.schedule.time_zone):
        problem = f"{body.schedule.time_zone!r} is no time zone that this machine knows"
        detail = f"{problem}: name one such as Europe/Lisbon or UTC"
        raise ProblemError(MapProblem.ZONE_SET_INVALID, detail, field="body.schedule.time_zone")
    if new and count >= MAX_SETS:
        detail = f"there are {MAX_SETS} sets already, which is the limit: delete one that is not needed"
        raise ProblemError(MapProblem.ZONE_SET_INVALID, detail, field="body")
