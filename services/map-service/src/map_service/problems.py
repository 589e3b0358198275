"""The map-service's problem documents: one for each exception that it raises, and those of its routes."""

from typing import Final

from fog_runtime.concurrency import BusyError
from fog_runtime.http import RETRY_AFTER, HttpProblem, ProblemCode, ProblemError, Routes
from fog_runtime.http.routes import InvalidBodyError
from fog_runtime.http.store_routes import add_store_errors
from fog_runtime.stores.records import CursorError
from map_service.record_writer import ConflictError
from map_service.service import Service
from map_service.zones import ZoneError


class MapProblem(ProblemCode):
    """Problems of the map-service."""

    NO_ZONE = "no_zone", 404, "No zone has this id", "Choose one of GET /api/v1/zones, or POST a new one"
    ZONE_EXISTS = (
        "zone_exists", 409, "A zone with this id exists already", "Choose another id, or PUT it (zone add --replace)"
    )  # fmt: skip
    ZONE_CHANGED = (
        "zone_changed", 412, "The zone is not as the request expects: somebody else changed or added it",
        "Read the zone again, then decide anew",
    )  # fmt: skip
    ZONE_INVALID = (
        "zone_invalid", 422, "The zone is invalid, or one too many: `errors` names its fields",
        "Correct the fields that `errors` names, or remove another zone",
    )  # fmt: skip
    NO_ZONE_SET = (
        "no_zone_set",
        404,
        "No set of zones has this id",
        "Choose one of GET /api/v1/zone-sets, or PUT a new one",
    )
    ZONE_SET_CHANGED = (
        "zone_set_changed", 412, "The set of zones is not as the request expects: somebody else changed or added it",
        "Read the set again, then decide anew",
    )  # fmt: skip
    ZONE_SET_USED = (
        "zone_set_used", 409, "Zones name the set, so that it can't be removed",
        "Take the zones out of the set, or remove them, first",
    )  # fmt: skip
    ZONE_SET_INVALID = (
        "zone_set_invalid", 422, "The set of zones is invalid, or one too many",
        "Correct the fields that `errors` names, or remove another set",
    )  # fmt: skip
    NO_ZONE_SOURCE = (
        "no_zone_source", 404, "`site.toml` names no such source of zones", "Choose one of GET /api/v1/zone-sources"
    )  # fmt: skip
    ZONE_SOURCE_CHANGED = (
        "zone_source_changed", 412, "The source is not as the request expects: somebody else changed it",
        "Read the source again, then decide anew",
    )  # fmt: skip
    NO_SUCH_PLACE = "no_such_place", 404, "No place has this id", "Choose one of GET /api/v1/places, or PUT a new one"
    PLACE_CHANGED = (
        "place_changed", 412, "The place is not as the request expects: somebody else changed or added it",
        "Read the place again, then decide anew",
    )  # fmt: skip
    PLACE_INVALID = (
        "place_invalid", 422, "The place lies off the map or in a wall, or is one too many",
        "Move it to a free cell of the map, or remove another place",
    )  # fmt: skip
    MASK_INVALID = (
        "mask_invalid", 422, "The mask can't become zones: `detail` says why",
        "Paint fewer, larger parts in few shades, on the picture of GET /api/v1/masks/keepout.png",
    )  # fmt: skip
    MAP_INVALID = (
        "map_invalid", 422, "The upload is no map, or one too large: `detail` says why",
        "Upload the YAML file and the picture (PGM or PNG) that map_server writes",
    )  # fmt: skip
    NO_MAP_PREVIEW = "no_map_preview", 404, "There is no such preview of a map", "Upload the map, and look at it, again"
    NO_MAP_BEFORE = "no_map_before", 404, "There is no map before the one in force", "Upload the map that you want"
    MAP_NOT_SEEN = (
        "map_not_seen", 412, "The map would not do any more what its preview says",
        "Look at the preview again, then decide",
    )  # fmt: skip
    MAP_CHANGED = (
        "map_changed", 412, "Somebody else has changed the map", "Look at the preview again, then decide anew"
    )  # fmt: skip
    MAP_DOES_NOT_FIT = (
        "map_does_not_fit", 422, "Something would lie in a wall of the map or off it, or its walls are others",
        "Move what `detail` names, or accept it",
    )  # fmt: skip
    ZONES_NOT_LOADED = (
        "zones_not_loaded", 503, "The stored zones are not loaded yet",
        "Try again in a moment: /readyz says when they are",
    )  # fmt: skip
    UNKNOWN_ZONE = "unknown_zone", 422, "The request names a zone that there is not", "Choose one of GET /api/v1/zones"
    UNKNOWN_ZONE_SET = (
        "unknown_zone_set", 422, "The request names a set of zones that there is not",
        "Choose one of GET /api/v1/zone-sets",
    )  # fmt: skip
    UNKNOWN_AREA = "unknown_area", 422, "The request names an area that there is not", "Choose one of GET /api/v1/areas"
    DRY_RUN_REFUSED = "dry_run_refused", 422, "The change is too large to be computed at once", "Try a smaller change"
    PLANNER_AWAY = (
        "planner_away", 503, "The planner has no answer: `Retry-After` says when to try again",
        "Wait as long as `Retry-After` says",
    )  # fmt: skip
    BUSY = (
        "busy", 503, "Too many requests wait for a calculation: `Retry-After` says when to try again",
        "Wait as long as `Retry-After` says",
    )  # fmt: skip


ZONES_NOT_LOADED: Final = (MapProblem.ZONES_NOT_LOADED,)
NO_SUCH_ZONE: Final = (MapProblem.NO_ZONE, MapProblem.ZONES_NOT_LOADED)


def add_errors(routes: Routes) -> None:
    """Register the problem document of each exception that the service raises."""
    routes.raises(
        ZoneError,
        [MapProblem.ZONE_INVALID],
        lambda error: ProblemError(MapProblem.ZONE_INVALID, error.message, field=f"body.{error.field}"),
    )
    add_store_errors(routes)
    routes.raises(
        CursorError,
        [HttpProblem.REQUEST_INVALID],
        lambda error: ProblemError(HttpProblem.REQUEST_INVALID, str(error), field="query.cursor"),
    )
    add_busy_error(routes)
    routes.raises(
        ConflictError,
        [MapProblem.ZONE_EXISTS, MapProblem.ZONE_CHANGED],
        _conflict,
    )
    routes.raises(InvalidBodyError, [], _with_remedies)


def _conflict(error: ConflictError) -> ProblemError:
    what, missing, changed = {
        "zones": ("zone", MapProblem.NO_ZONE, MapProblem.ZONE_CHANGED),
        "zone_sets": ("set of zones", MapProblem.NO_ZONE_SET, MapProblem.ZONE_SET_CHANGED),
        "zone_sources": ("source", MapProblem.NO_ZONE_SOURCE, MapProblem.ZONE_SOURCE_CHANGED),
        "places": ("place", MapProblem.NO_SUCH_PLACE, MapProblem.PLACE_CHANGED),
        "site_maps": ("change", MapProblem.MAP_CHANGED, MapProblem.MAP_CHANGED),
    }[error.table]
    if error.outcome == "exists" and missing is MapProblem.NO_ZONE:
        detail = f"zone {error.id} exists already"
        return ProblemError(MapProblem.ZONE_EXISTS, detail)
    if error.outcome == "missing":
        return ProblemError(missing, f"there is no {what} {error.id} any more: add it again")
    return ProblemError(changed, f"{what} {error.id} was changed by somebody else: read it again, then retry")


def _with_remedies(error: InvalidBodyError) -> InvalidBodyError:
    """Add a remedy to the errors about shapes with too few points."""
    remedies = {
        "body.shape.points": "a polygon needs at least three corners: add one",
        "body.shape.line": "a corridor needs at least two points: add one",
    }
    errors = [
        {**entry, "problem": f"{entry['problem']}; {remedies[entry['field']]}"}
        if entry["field"] in remedies and "length" in entry["problem"]
        else entry
        for entry in error.errors
    ]
    return InvalidBodyError(errors)


def add_busy_error(routes: Routes) -> None:
    """Answer requests for which there is no room with 503."""
    routes.raises(
        BusyError,
        [MapProblem.BUSY],
        lambda error: ProblemError(MapProblem.BUSY, f"{error}: try again", headers=RETRY_AFTER),
    )


def require_zones(service: Service) -> None:
    """Raise a `ProblemError` while the stored zones are not loaded."""
    if not service.core.zones_loaded:
        detail = "the stored zones are not loaded yet: try again once /readyz reports ready"
        raise ProblemError(MapProblem.ZONES_NOT_LOADED, detail, headers=RETRY_AFTER)
