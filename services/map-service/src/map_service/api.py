"""REST under /api/v1: reading and writing zones; reading hazards, places, map, costmap and audit log.

Reading needs no token, except for the audit log; writing needs the role operator.
"""

import asyncio
import io
import secrets
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
import numpy as np
from fastapi import FastAPI, Response
from PIL import Image

from fog_contracts.messages import (
    HazardArea,
    Id,
    MapGeometry,
    MapInfo,
    Message,
    Zone,
)
from fog_contracts.site import Site
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError, Worker
from fog_runtime.health import Health
from fog_runtime.http import (
    MAP_UPLOADS,
    Answer,
    Body,
    Encoded,
    HttpProblem,
    IfMatch,
    Operator,
    Patch,
    PatchOf,
    ProblemError,
    Routes,
    Tokens,
    Viewer,
    etag,
    expected_version,
    make_app,
    patched,
)
from fog_runtime.http.store_routes import (
    IdempotencyKey,
    IfNoneMatch,
    PageSize,
    add_recovery,
    add_store_errors,
    attempt_of,
    must_be_new,
    next_page,
)
from fog_runtime.stores.records import KINDS, AuditEntry, CursorError
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import Attempt, IdempotencyError
from map_service.api_dry_run import add_dry_runs
from map_service.api_map_change import add_map_change
from map_service.api_masks import add_masks
from map_service.api_places import add_places
from map_service.api_sets import add_sets, add_sources
from map_service.applied import AppliedChange, ChangeKind
from map_service.core import ScrapeTarget
from map_service.costmap import LayeredCostmap
from map_service.formats.geojson import add_geojson
from map_service.layers.base import Grid
from map_service.problems import NO_SUCH_ZONE, ZONES_NOT_LOADED, MapProblem, add_busy_error, add_errors, require_zones
from map_service.record_writer import ConflictError
from map_service.service import Service
from map_service.undo import add_record_undo, add_undo
from map_service.zone_bodies import ZoneBody, body_of_zone, zone_from_body
from map_service.zones import ZoneError

Image.preinit()  # the first picture would load PIL's formats, while the map is served

AuditKind = Literal[
    "alert", "area", "map", "mission", "override", "place", "robot", "schedule", "service", "set", "source", "stop",
    "store", "zone",
]  # fmt: skip

_REFUSALS: Final = (ZoneError, BusyError, IdempotencyError, StoreError)


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


def make_api(  # noqa: PLR0913  # the process's parts
    service: Service,
    site: Site,
    clock: Clock,
    health: Health,
    tokens: Tokens,
    standby: Callable[[], str] = str,
    *,
    site_dir: Path = Path(),
) -> FastAPI:
    """Return the app over a running service; while `standby` returns a reason, nothing can be written.

    `site_dir` is the site's folder, whose map an upload replaces.
    """
    app = make_app("Fognav map-service", health, tokens, standby=standby, large=MAP_UPLOADS)
    zones = Routes(app, "zones")
    add_errors(zones)
    _add_zone_reads(zones, service)
    _add_zone_writes(zones, service, clock)
    add_dry_runs(zones, service, site, clock)
    add_geojson(zones, service, site, clock)
    add_undo(zones, service, clock)
    _add_applied(zones, service, clock)
    _add_zone_patch(zones, service, clock)
    _add_audit(zones, service)
    add_masks(zones, service, clock)
    add_sets(zones, service)
    add_sources(zones, service)
    places = Routes(app, "places")
    add_errors(places)
    add_places(places, service)
    add_record_undo(places, service)
    maps = Routes(app, "map")
    _add_views(maps, service, site)
    add_errors(maps)
    add_map_change(maps, service, site_dir)
    _add_scrape_targets(Routes(app, "robots"), service, clock)
    recovery = Routes(app, "store")
    add_store_errors(recovery)
    add_recovery(recovery, service.zones)
    return app


def _add_zone_reads(routes: Routes, service: Service) -> None:
    listing = _ZoneListing(service)

    @routes.get("/api/v1/zones", problems=ZONES_NOT_LOADED)
    async def list_zones() -> Encoded[ZoneList]:
        """List all zones with the map version that contains them."""
        require_zones(service)
        return listing.current()

    @routes.get("/api/v1/unusable-zones", problems=ZONES_NOT_LOADED)
    async def list_unusable_zones() -> list[UnusableZone]:
        """List the stored zones that are left out of the map because their records are invalid: DELETE them."""
        require_zones(service)
        return [UnusableZone(id=name, reason=reason) for name, reason in service.zones.unusable.reasons.items()]

    @routes.get("/api/v1/zones/{zone_id}", problems=NO_SUCH_ZONE)
    async def get_zone(zone_id: str) -> Answer[Zone]:
        """Return one zone with its ETag."""
        zone = _find_zone(service, zone_id)
        return Answer(zone, etag(zone.version))


def _add_zone_writes(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.post("/api/v1/zones", status=201, raises=[*_REFUSALS, ConflictError], problems=ZONES_NOT_LOADED)
    async def create_zone(
        body: Body[ZoneBody], caller: Operator, idempotency_key: IdempotencyKey = None
    ) -> Answer[Zone]:
        """Add a zone; replies once it is durably stored and on the map."""
        require_zones(service)
        attempt = attempt_of(idempotency_key, caller, "POST /api/v1/zones", body)
        zone = zone_from_body(body, body.id or f"z-{secrets.token_hex(4)}", caller.name, clock.stamp())
        zone = await service.zones.create(zone, caller.name, attempt)
        return Answer(zone, {**etag(zone.version), "Location": f"/api/v1/zones/{zone.id}"})

    @routes.put("/api/v1/zones/{zone_id}", status=(200, 201), raises=[*_REFUSALS, ConflictError], problems=NO_SUCH_ZONE)
    async def put_zone(  # headers are parameters
        zone_id: str,
        body: Body[ZoneBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[Zone]:
        """Replace a zone; with If-Match, only if it is unchanged. With `If-None-Match: *`, add it if it is new."""
        _same_id(body, zone_id)
        attempt = attempt_of(idempotency_key, caller, f"PUT /api/v1/zones/{zone_id}", body)
        new = must_be_new(if_none_match)
        # Before the condition, which the first attempt may have made false.
        if (earlier := await service.zones.earlier_result(attempt)) is not None:
            return Answer(earlier, etag(earlier.version), status=201 if new else None)
        zone = zone_from_body(body, zone_id, caller.name, clock.stamp())
        if new:
            return await _put_new(service, zone, caller.name, attempt)
        await service.zones.reload_after_uncertain_write()
        _require_matching(service, zone_id, if_match)
        zone = await service.zones.replace(zone, expected_version(if_match), caller.name, attempt)
        return Answer(zone, etag(zone.version))

    @routes.delete("/api/v1/zones/{zone_id}", raises=[ConflictError, StoreError], problems=NO_SUCH_ZONE)
    async def delete_zone(zone_id: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Delete a zone; with If-Match, only if it is unchanged."""
        await service.zones.reload_after_uncertain_write()
        if zone_id in service.zones.unusable.reasons:
            await service.zones.delete_unusable(zone_id, caller.name)
            return
        zone = _require_matching(service, zone_id, if_match)
        await service.zones.delete(zone_id, expected_version(if_match), caller.name)
        await service.zone_sources.forget(zone)


def _add_zone_patch(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.patch("/api/v1/zones/{zone_id}", raises=[*_REFUSALS, ConflictError], problems=NO_SUCH_ZONE)
    async def patch_zone(
        zone_id: str,
        patch: Annotated[Patch, PatchOf(ZoneBody)],
        caller: Operator,
        if_match: IfMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[Zone]:
        """Change fields of a zone; with If-Match, only if it is unchanged. Its time goes on unless the patch has one.

        A source's zone becomes an operator's by it, as by PUT.
        """
        attempt = attempt_of(idempotency_key, caller, f"PATCH /api/v1/zones/{zone_id}", patch)
        if (earlier := await service.zones.earlier_result(attempt)) is not None:
            return Answer(earlier, etag(earlier.version))
        await service.zones.reload_after_uncertain_write()
        old = _require_matching(service, zone_id, if_match)
        rest_s = service.core.zones[zone_id].times.progress("", clock.now()).rest_s
        body = patched(body_of_zone(old, patch, rest_s), patch)
        zone = zone_from_body(body, _same_id(body, zone_id), caller.name, clock.stamp())
        # The fields that stay are those that were read here.
        zone = await service.zones.replace(zone, old.version, caller.name, attempt)
        return Answer(zone, etag(zone.version))


def _add_applied(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.get("/api/v1/applied")
    async def applied(
        _caller: Viewer,
        limit: PageSize,
        kind: ChangeKind | None = None,
        id: str | None = None,  # noqa: A002  # the parameter's name
    ) -> list[AppliedChange]:
        """Return the latest change of each zone and area, newest first, and which robots drive by a map with it."""
        return list(islice(service.core.applied.changes(clock.now(), kind, id), limit))


def _add_audit(routes: Routes, service: Service) -> None:
    @routes.get("/api/v1/audit", raises=[CursorError, StoreError])
    async def audit(
        _caller: Viewer, limit: PageSize, kind: AuditKind | None = None, cursor: str | None = None
    ) -> Answer[list[AuditEntry]]:
        """Return the audit trail of all services, newest first; the Link header has the next page's address."""
        page = await service.audit(KINDS if kind is None else (kind,), cursor, limit)
        return Answer(page.entries, next_page("/api/v1/audit", page.next, limit, kind=kind))


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


def _add_scrape_targets(routes: Routes, service: Service, clock: Clock) -> None:
    @routes.get("/api/v1/prometheus/robots")
    async def scrape_targets() -> list[ScrapeTarget]:
        """Return where Prometheus finds the metrics of the robots that are alive, for its HTTP service discovery."""
        return service.core.robots.targets(clock.now())


async def _put_new(service: Service, zone: Zone, who: str, attempt: Attempt | None) -> Answer[Zone]:
    """Add a zone whose id comes from the path, if there is none."""
    require_zones(service)
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
    require_zones(service)
    entry = service.core.zones.get(zone_id)
    if entry is None:
        detail = f"there is no zone {zone_id}: GET /api/v1/zones lists those that there are"
        raise ProblemError(MapProblem.NO_ZONE, detail)
    return entry.zone


def _same_id(body: ZoneBody, zone_id: str) -> str:
    if body.id not in (None, zone_id):
        detail = f"the path names zone {zone_id}: leave the id out, or give the same id"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.id")
    return zone_id


def _require_matching(service: Service, zone_id: str, if_match: str | None) -> Zone:
    zone = _find_zone(service, zone_id)
    if expected_version(if_match) not in (None, zone.version):
        detail = f"zone {zone_id} is at version {zone.version}, not {if_match}: read it again, then retry"
        raise ProblemError(MapProblem.ZONE_CHANGED, detail)
    return zone


# --- What the map shows: hazards, geometry, and pictures of the floor plan and the costmap ----------------------------

_PNG: Final = "image/png"
_MAX_PICTURES: Final = 4
"""Most pictures that are being encoded or wait for it."""


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
    add_busy_error(routes)
    core, costmap = service.core, service.core.costmap
    pictures = _Pictures(costmap)

    @routes.get("/api/v1/hazards")
    async def hazards() -> list[HazardArea]:
        """Return every area with its hazard as on the map."""
        return core.hazards()

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

    @routes.get("/api/v1/map.yaml", media_type="application/yaml")
    async def map_yaml() -> Response:
        """Return what map_server needs beside the floor plan's picture."""
        g = costmap.geometry
        text = (
            f"image: map.png\nmode: trinary\nresolution: {g.resolution!r}\n"
            f"origin: [{g.origin_x!r}, {g.origin_y!r}, 0.0]\nnegate: 0\n"
            "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
        return Response(text, media_type="application/yaml")

    @routes.get("/api/v1/costmap.png", media_type=_PNG, raises=[BusyError], problems=ZONES_NOT_LOADED)
    async def costmap_png() -> Response:
        """Return the master costmap; a pixel's palette index is the cell's cost."""
        require_zones(service)
        return await pictures.response("cost", costmap.cost, _COSTS)


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
