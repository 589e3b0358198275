"""REST under /api/v1: reading and writing zones; reading hazards, places, map, costmap and audit log.

Reading needs no token, except for the audit log; writing needs the role operator.
"""

import asyncio
import io
import secrets
from collections.abc import Callable
from typing import Annotated, Final, Literal

import msgspec
import numpy as np
from fastapi import FastAPI, Response
from PIL import Image

from fog_contracts.messages import (
    HazardArea,
    Id,
    MapGeometry,
    Message,
    PenaltyFactor,
    Sentence,
    Shape,
    Stamp,
    TimeToLive,
    WeeklySchedule,
    Zone,
    ZoneKind,
)
from fog_contracts.site import Place, Site
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError, Worker
from fog_runtime.health import Health
from fog_runtime.http import (
    RETRY_AFTER,
    Answer,
    Body,
    Encoded,
    HttpProblem,
    IdempotencyKey,
    IfMatch,
    IfNoneMatch,
    Operator,
    PageSize,
    ProblemCode,
    ProblemError,
    Routes,
    Tokens,
    Viewer,
    add_recovery,
    add_store_errors,
    attempt_of,
    etag,
    expected_version,
    make_app,
    must_be_new,
    next_page,
)
from fog_runtime.http.routes import InvalidBodyError
from fog_runtime.stores.records import KINDS, AuditEntry, CursorError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, IdempotencyError
from map_service.core import ScrapeTarget
from map_service.costmap import LayeredCostmap
from map_service.layers.base import Grid
from map_service.service import Service
from map_service.zone_writer import ConflictError
from map_service.zones import ZoneError

AuditKind = Literal["alert", "area", "mission", "override", "robot", "stop", "store", "zone"]

Image.preinit()  # the first picture would load PIL's formats, while the map is served

_PNG: Final = "image/png"
_MAX_PICTURES: Final = 4
"""Most pictures that are being encoded or wait for it."""
_REFUSALS: Final = (ZoneError, BusyError, IdempotencyError, StoreError)


class MapProblem(ProblemCode):
    """Problems of the map-service."""

    NO_ZONE = "no_zone", 404, "No zone has this id"
    ZONE_EXISTS = "zone_exists", 409, "A zone with this id exists already"
    ZONE_CHANGED = "zone_changed", 412, "The zone is not as the request expects: somebody else changed or added it"
    ZONE_INVALID = "zone_invalid", 422, "The zone is invalid, or one too many: `errors` names its fields"
    ZONES_NOT_LOADED = "zones_not_loaded", 503, "The stored zones are not loaded yet"
    BUSY = "busy", 503, "Too many requests wait for a calculation: `Retry-After` says when to try again"


_ZONES_NOT_LOADED: Final = (MapProblem.ZONES_NOT_LOADED,)
_NO_SUCH_ZONE: Final = (MapProblem.NO_ZONE, MapProblem.ZONES_NOT_LOADED)


class ZoneBody(Message, frozen=True, kw_only=True):
    """A zone that an operator draws; without `id` one is generated; `ttl_s` (s from its start) or `expires_at`."""

    id: Id | None = None
    kind: ZoneKind
    shape: Shape
    factor: PenaltyFactor | None = None
    speed: Annotated[float, msgspec.Meta(ge=0.01, le=2.54)] | None = None
    reason: Sentence = ""
    starts_at: Stamp | None = None
    expires_at: Stamp | None = None
    ttl_s: TimeToLive | None = None
    schedule: WeeklySchedule | None = None
    enabled: bool = True


class ZoneList(Message, frozen=True, kw_only=True):
    """All zones, the ids of the active ones, and the map version that contains them."""

    zones: list[Zone]
    active: list[str]
    epoch: int
    seq: int


class UnusableZone(Message, frozen=True, kw_only=True):
    """A stored zone that is left out of the map, and why."""

    id: str
    reason: str


class MapInfo(Message, frozen=True, kw_only=True):
    """The map's geometry and version; its images have the geometry's size, and their first row is the map's top."""

    site: str
    geometry: MapGeometry
    epoch: int
    seq: int


def make_api(  # the process's parts
    service: Service, site: Site, clock: Clock, health: Health, tokens: Tokens, standby: Callable[[], str] = str
) -> FastAPI:
    """Return the app over a running service; while `standby` returns a reason, nothing can be written."""
    app = make_app("Fognav map-service", health, tokens, standby=standby)
    zones = Routes(app, "zones")
    _add_errors(zones)
    _add_zone_reads(zones, service)
    _add_zone_writes(zones, service, clock)
    _add_audit(zones, service)
    _add_views(Routes(app, "map"), service, site)
    _add_scrape_targets(Routes(app, "robots"), service, clock)
    recovery = Routes(app, "store")
    add_store_errors(recovery)
    add_recovery(recovery, service.zones)
    return app


def _add_zone_reads(routes: Routes, service: Service) -> None:
    listing = _ZoneListing(service)

    @routes.get("/api/v1/zones", problems=_ZONES_NOT_LOADED)
    async def list_zones() -> Encoded[ZoneList]:
        """List all zones with the map version that contains them."""
        _require_zones(service)
        return listing.current()

    @routes.get("/api/v1/unusable-zones", problems=_ZONES_NOT_LOADED)
    async def list_unusable_zones() -> list[UnusableZone]:
        """List the stored zones that are left out of the map because their records are invalid: DELETE them."""
        _require_zones(service)
        return [UnusableZone(id=name, reason=reason) for name, reason in service.zones.unusable.reasons.items()]

    @routes.get("/api/v1/zones/{zone_id}", problems=_NO_SUCH_ZONE)
    async def get_zone(zone_id: str) -> Answer[Zone]:
        """Return one zone with its ETag."""
        zone = _find_zone(service, zone_id)
        return Answer(zone, etag(zone.version))


def _add_zone_writes(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.post("/api/v1/zones", status=201, raises=[*_REFUSALS, ConflictError], problems=_ZONES_NOT_LOADED)
    async def create_zone(
        body: Body[ZoneBody], caller: Operator, idempotency_key: IdempotencyKey = None
    ) -> Answer[Zone]:
        """Add a zone; replies once it is durably stored and on the map."""
        _require_zones(service)
        attempt = attempt_of(idempotency_key, caller, "POST /api/v1/zones", body)
        zone = _zone_from_body(body, body.id or f"z-{secrets.token_hex(4)}", caller.name, clock.stamp())
        zone = await service.zones.create(zone, caller.name, attempt)
        return Answer(zone, {**etag(zone.version), "Location": f"/api/v1/zones/{zone.id}"})

    @routes.put(
        "/api/v1/zones/{zone_id}", status=(200, 201), raises=[*_REFUSALS, ConflictError], problems=_NO_SUCH_ZONE
    )
    async def put_zone(  # headers are parameters
        zone_id: str,
        body: Body[ZoneBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[Zone]:
        """Replace a zone; with If-Match, only if it is unchanged. With `If-None-Match: *`, add it if it is new."""
        if body.id not in (None, zone_id):
            detail = f"the path names zone {zone_id}: leave the id out, or give the same id"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.id")
        attempt = attempt_of(idempotency_key, caller, f"PUT /api/v1/zones/{zone_id}", body)
        new = must_be_new(if_none_match)
        # Before the condition, which the first attempt may have made false.
        if (earlier := await service.zones.earlier_result(attempt)) is not None:
            return Answer(earlier, etag(earlier.version), status=201 if new else None)
        zone = _zone_from_body(body, zone_id, caller.name, clock.stamp())
        if new:
            return await _put_new(service, zone, caller.name, attempt)
        await service.zones.reload_after_uncertain_write()
        _require_matching(service, zone_id, if_match)
        zone = await service.zones.replace(zone, expected_version(if_match), caller.name, attempt)
        return Answer(zone, etag(zone.version))

    @routes.delete("/api/v1/zones/{zone_id}", raises=[ConflictError, StoreError], problems=_NO_SUCH_ZONE)
    async def delete_zone(zone_id: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Delete a zone; with If-Match, only if it is unchanged."""
        await service.zones.reload_after_uncertain_write()
        if zone_id in service.zones.unusable.reasons:
            await service.zones.delete_unusable(zone_id, caller.name)
            return
        _require_matching(service, zone_id, if_match)
        await service.zones.delete(zone_id, expected_version(if_match), caller.name)


def _add_audit(routes: Routes, service: Service) -> None:
    @routes.get("/api/v1/audit", raises=[CursorError, StoreError])
    async def audit(
        _caller: Viewer, limit: PageSize, kind: AuditKind | None = None, cursor: str | None = None
    ) -> Answer[list[AuditEntry]]:
        """Return the audit trail of all services, newest first; the Link header has the next page's address."""
        page = await service.audit(KINDS if kind is None else (kind,), cursor, limit)
        return Answer(page.entries, next_page("/api/v1/audit", page.next, limit, kind=kind))


def _add_errors(routes: Routes) -> None:
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
    _add_busy_error(routes)
    routes.raises(
        ConflictError,
        [MapProblem.ZONE_EXISTS, MapProblem.ZONE_CHANGED],
        _conflict,
    )
    routes.raises(InvalidBodyError, [], _with_remedies)


def _conflict(error: ConflictError) -> ProblemError:
    if error.outcome == "exists":
        detail = f"zone {error.zone} exists already: choose another id, or PUT it"
        return ProblemError(MapProblem.ZONE_EXISTS, detail)
    if error.outcome == "missing":
        return ProblemError(MapProblem.NO_ZONE, f"there is no zone {error.zone} any more: POST it to add it again")
    detail = f"zone {error.zone} was changed by somebody else: read it again, then retry"
    return ProblemError(MapProblem.ZONE_CHANGED, detail)


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


def _add_busy_error(routes: Routes) -> None:
    routes.raises(
        BusyError,
        [MapProblem.BUSY],
        lambda error: ProblemError(MapProblem.BUSY, f"{error}: try again", headers=RETRY_AFTER),
    )


class _ZoneListing:
    """The list of all zones, encoded when they change and not for each who asks: thousands of them take some ms."""

    def __init__(self, service: Service) -> None:
        self._core = service.core
        self._zones: tuple[list[Zone] | None, msgspec.Raw] = None, msgspec.Raw()
        self._active: tuple[list[str] | None, msgspec.Raw] = None, msgspec.Raw()

    def current(self) -> Encoded[ZoneList]:
        """Return the list as it is now."""
        version, zones, active = self._core.costmap.version, self._core.zones.zones(), self._core.zones.active()
        if self._zones[0] is not zones:
            self._zones = zones, msgspec.Raw(msgspec.json.encode(zones))
        if self._active[0] is not active:
            self._active = active, msgspec.Raw(msgspec.json.encode(active))
        parts = {"zones": self._zones[1], "active": self._active[1], "epoch": version.epoch, "seq": version.seq}
        return Encoded(msgspec.json.encode(parts))


class _Pictures:
    """PNGs whose pixel values are the cells', encoded on a thread of their own, once per version for all who ask."""

    def __init__(self, costmap: LayeredCostmap) -> None:
        self._costmap = costmap
        self._worker = Worker("pictures", limit=_MAX_PICTURES)
        self._latest: dict[str, tuple[object, asyncio.Future[bytes]]] = {}

    async def response(self, name: str, cells: Grid, palette: bytes) -> Response:
        """Return the picture of the current version; raises `BusyError` while too many are being encoded."""
        version, picture = self._latest.get(name, (None, None))
        if picture is None or version != self._costmap.version or (picture.done() and picture.exception()):
            # Copied before the event loop can change the map.
            picture = asyncio.ensure_future(self._worker.run(_png, cells.copy(), palette))
            self._latest[name] = self._costmap.version, picture
        return Response(await asyncio.shield(picture), media_type=_PNG, headers={"Cache-Control": "no-cache"})


def _add_views(routes: Routes, service: Service, site: Site) -> None:
    _add_busy_error(routes)
    core, costmap = service.core, service.core.costmap
    pictures = _Pictures(costmap)

    @routes.get("/api/v1/hazards")
    async def hazards() -> list[HazardArea]:
        """Return every area with its hazard as on the map."""
        return core.hazards()

    @routes.get("/api/v1/places")
    async def places() -> dict[str, Place]:
        """Return the site's named poses."""
        return site.places

    @routes.get("/api/v1/map")
    async def map_info() -> MapInfo:
        """Return the map's geometry and version."""
        g = costmap.geometry
        geometry = MapGeometry(
            width=g.width, height=g.height, resolution=g.resolution, origin_x=g.origin_x, origin_y=g.origin_y
        )
        return MapInfo(site=site.id, geometry=geometry, epoch=costmap.version.epoch, seq=costmap.version.seq)

    @routes.get("/api/v1/map.png", media_type=_PNG, raises=[BusyError])
    async def map_png() -> Response:
        """Return the floor plan: white is free, black occupied, grey unknown."""
        return await pictures.response("map", costmap.static, _PLAN)

    @routes.get("/api/v1/costmap.png", media_type=_PNG, raises=[BusyError], problems=_ZONES_NOT_LOADED)
    async def costmap_png() -> Response:
        """Return the master costmap; a pixel's palette index is the cell's cost."""
        _require_zones(service)
        return await pictures.response("cost", costmap.cost, _COSTS)


def _add_scrape_targets(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.get("/api/v1/prometheus/robots")
    async def scrape_targets() -> list[ScrapeTarget]:
        """Return where Prometheus finds the metrics of the robots that are alive, for its HTTP service discovery."""
        return service.core.robots.targets(clock.now())


def _require_zones(service: Service) -> None:
    if not service.core.zones_loaded:
        detail = "the stored zones are not loaded yet: try again once /readyz reports ready"
        raise ProblemError(MapProblem.ZONES_NOT_LOADED, detail, headers=RETRY_AFTER)


async def _put_new(service: Service, zone: Zone, who: str, attempt: Attempt | None) -> Answer[Zone]:
    """Add a zone whose id comes from the path, if there is none."""
    _require_zones(service)
    try:
        msgspec.convert(zone.id, Id)
    except msgspec.ValidationError as error:
        detail = f"{zone.id!r} is no valid id: use a to z, 0 to 9 and -, at most 32"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="path") from error
    try:
        zone = await service.zones.create(zone, who, attempt)
    except ConflictError as error:
        detail = f"zone {zone.id} exists already: PUT it with If-Match"
        raise ProblemError(MapProblem.ZONE_CHANGED, detail) from error
    return Answer(zone, etag(zone.version), status=201)


def _find_zone(service: Service, zone_id: str) -> Zone:
    _require_zones(service)
    entry = service.core.zones.get(zone_id)
    if entry is None:
        detail = f"there is no zone {zone_id}: GET /api/v1/zones lists those that there are"
        raise ProblemError(MapProblem.NO_ZONE, detail)
    return entry.zone


def _require_matching(service: Service, zone_id: str, if_match: str | None) -> None:
    zone = _find_zone(service, zone_id)
    if expected_version(if_match) not in (None, zone.version):
        detail = f"zone {zone_id} is at version {zone.version}, not {if_match}: read it again, then retry"
        raise ProblemError(MapProblem.ZONE_CHANGED, detail)


def _zone_from_body(body: ZoneBody, zone_id: str, author: str, stamp: float) -> Zone:
    if body.ttl_s is not None and body.expires_at is not None:
        detail = "give either ttl_s or expires_at, not both"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.ttl_s")
    return Zone(
        id=zone_id,
        kind=body.kind,
        shape=body.shape,
        factor=body.factor,
        speed=body.speed,
        reason=body.reason,
        author=author,
        starts_at=body.starts_at,
        expires_at=body.expires_at if body.ttl_s is None else max(stamp, body.starts_at or 0.0) + body.ttl_s,
        ttl_s=body.ttl_s,
        schedule=body.schedule,
        enabled=body.enabled,
    )


def _png(cells: Grid, palette: bytes) -> bytes:
    """Return a PNG whose palette indices are the cells; the image's first row is the grid's last."""
    image = Image.fromarray(np.ascontiguousarray(cells[::-1]))
    image.putpalette(palette)
    data = io.BytesIO()
    image.save(data, "PNG", compress_level=1)
    return data.getvalue()


def _palette(special: dict[int, tuple[int, int, int]]) -> bytes:
    """Return a palette of 256 colours: graded costs from near white to orange, other costs as in `special`."""
    colours = [(255, 250 - cost // 2, 240 - cost * 220 // 252) for cost in range(253)] + [(0, 0, 0)] * 3
    for cost, colour in special.items():
        colours[cost] = colour
    return bytes(channel for colour in colours for channel in colour)


_PLAN: Final = _palette({0: (255, 255, 255), 254: (0, 0, 0), 255: (205, 205, 205)})
_COSTS: Final = _palette({0: (255, 255, 255), 253: (90, 160, 220), 254: (150, 0, 40), 255: (205, 205, 205)})
