"""REST under /api/v1: zones for operators; hazards, places, map, costmap and audit entries to look at.

Reading needs no token but for the audit log; writing needs the role operator.
"""

import asyncio
import io
import secrets
from typing import Annotated, Final

import msgspec
import numpy as np
from fastapi import FastAPI, Response
from PIL import Image

from fog_contracts.messages import (
    HazardArea,
    Id,
    MapGeometry,
    Message,
    Sentence,
    Shape,
    Stamp,
    Zone,
    ZoneKind,
)
from fog_contracts.site import Place, Site
from fog_runtime.clock import Clock
from fog_runtime.health import Health
from fog_runtime.http import (
    Answer,
    Body,
    IfMatch,
    Operator,
    ProblemError,
    Routes,
    Tokens,
    Viewer,
    etag,
    expected_version,
    make_app,
)
from fog_runtime.http.routes import InvalidBodyError
from map_service.layers.base import Grid
from map_service.service import ConflictError, Service
from map_service.store import AuditEntry, StoreError
from map_service.zone_validation import ZoneError

_PNG: Final = "image/png"
_NOT_READ: Final = {503: "The stored zones are not read yet, or the store does not answer"}
_UNKNOWN: Final = {404: "There is no such zone", **_NOT_READ}
_RETRY_AFTER: Final = {"Retry-After": "1"}


class ZoneBody(Message, frozen=True, kw_only=True):
    """What an operator draws; without `id` one is made up; `ttl_s` (s from now) is another way to say `expires_at`."""

    id: Id | None = None
    kind: ZoneKind
    shape: Shape
    factor: Annotated[float, msgspec.Meta(ge=1.0, le=100.0)] | None = None
    speed: Annotated[float, msgspec.Meta(ge=0.01, le=2.54)] | None = None
    reason: Sentence = ""
    starts_at: Stamp | None = None
    expires_at: Stamp | None = None
    ttl_s: Annotated[float, msgspec.Meta(gt=0.0, le=1e9)] | None = None
    enabled: bool = True


class ZoneList(Message, frozen=True, kw_only=True):
    """All zones, the ids of those that hold now, and the map version that shows them."""

    zones: list[Zone]
    active: list[str]
    epoch: int
    seq: int


class MapInfo(Message, frozen=True, kw_only=True):
    """The map's geometry and version; pictures have the geometry's size, their first row is the map's top."""

    site: str
    geometry: MapGeometry
    epoch: int
    seq: int


def make_api(service: Service, site: Site, clock: Clock, health: Health, tokens: Tokens) -> FastAPI:
    """Return the app over a running service."""
    app = make_app("Fognav map-service", health, tokens)
    _add_zones(Routes(app, "zones"), service, clock)
    _add_views(Routes(app, "map"), service, site)
    return app


def _add_zones(routes: Routes, service: Service, clock: Clock) -> None:
    _add_errors(routes)

    @routes.get("/api/v1/zones", problems=_NOT_READ)
    async def list_zones() -> ZoneList:
        """List all zones with the map version that shows them."""
        _check_read(service)
        version = service.core.costmap.version
        zones = service.core.zones()
        return ZoneList(zones=zones, active=service.core.active_zones(), epoch=version.epoch, seq=version.seq)

    @routes.post("/api/v1/zones", status=201, raises=[ZoneError, ConflictError, StoreError], problems=_NOT_READ)
    async def create_zone(body: Body[ZoneBody], caller: Operator) -> Answer[Zone]:
        """Draw a zone; the answer comes once it is stored for good and on the map."""
        _check_read(service)
        name = body.id or f"z-{secrets.token_hex(4)}"
        zone = await service.create(_zone(body, name, caller.name, clock.stamp()), caller.name)
        return Answer(zone, {**etag(zone.version), "Location": f"/api/v1/zones/{zone.id}"})

    @routes.get("/api/v1/zones/{zone_id}", problems=_UNKNOWN)
    async def get_zone(zone_id: str) -> Answer[Zone]:
        """Return one zone with its ETag."""
        zone = _known(service, zone_id)
        return Answer(zone, etag(zone.version))

    @routes.put("/api/v1/zones/{zone_id}", raises=[ZoneError, ConflictError, StoreError], problems=_UNKNOWN)
    async def put_zone(zone_id: str, body: Body[ZoneBody], caller: Operator, if_match: IfMatch = None) -> Answer[Zone]:
        """Replace a zone; with If-Match only if nobody changed it since."""
        if body.id not in (None, zone_id):
            raise ProblemError(422, f"the path says {zone_id}: leave the id out or say the same", field="body.id")
        old = _matching(service, zone_id, if_match)
        zone = await service.replace(_zone(body, zone_id, caller.name, clock.stamp()), old.version, caller.name)
        return Answer(zone, etag(zone.version))

    @routes.delete("/api/v1/zones/{zone_id}", raises=[ConflictError, StoreError], problems=_UNKNOWN)
    async def delete_zone(zone_id: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Take a zone away; with If-Match only if nobody changed it since."""
        await service.delete(_matching(service, zone_id, if_match), caller.name)

    @routes.get("/api/v1/audit", raises=[StoreError])
    async def audit(_caller: Viewer, limit: int = 100) -> list[AuditEntry]:
        """Return who did what, newest first."""
        return await service.audit(max(1, min(limit, 1000)))


def _add_errors(routes: Routes) -> None:
    """Say which problem each exception of the service is."""
    routes.raises(
        ZoneError,
        {422: "The zone can't be used: `errors` names its fields"},
        lambda error: ProblemError(422, error.message, field=f"body.{error.field}"),
    )
    routes.raises(
        StoreError,
        {503: "The store does not answer, so nothing was changed for certain"},
        lambda error: ProblemError(
            503,
            f"the store does not answer, so nothing was changed for certain: try again ({error})",
            headers=_RETRY_AFTER,
        ),
    )
    routes.raises(
        ConflictError,
        {409: "There is such a zone already", 412: "Somebody else changed it"},
        lambda error: (
            ProblemError(409, f"zone {error.zone} exists already: choose another id, or PUT it")
            if error.outcome == "exists"
            else ProblemError(412, f"zone {error.zone} was changed by somebody else: read it again and decide")
        ),
    )
    routes.raises(InvalidBodyError, {}, _with_remedy)


def _with_remedy(error: InvalidBodyError) -> InvalidBodyError:
    """Say what to do about an outline that is too short, in the operator's words."""
    remedies = {
        "body.shape.points": "an outline needs at least three corners: draw one more",
        "body.shape.line": "a corridor needs at least two points: draw one more",
    }
    errors = [
        {**known, "problem": f"{known['problem']}; {remedies[known['field']]}"}
        if known["field"] in remedies and "length" in known["problem"]
        else known
        for known in error.errors
    ]
    return InvalidBodyError(errors)


def _add_views(routes: Routes, service: Service, site: Site) -> None:
    core, costmap = service.core, service.core.costmap
    pictures: dict[str, tuple[object, bytes]] = {}

    async def picture(name: str, cells: Grid, palette: bytes) -> Response:
        """Encode off the loop, once per version; the pixels' values are the cells'."""
        known = pictures.get(name)
        if known is None or known[0] != costmap.version:
            # The copy is taken before the loop can change the map.
            pictures[name] = known = (costmap.version, await asyncio.to_thread(_png, cells.copy(), palette))
        return Response(known[1], media_type=_PNG, headers={"Cache-Control": "no-cache"})

    @routes.get("/api/v1/hazards")
    async def hazards() -> list[HazardArea]:
        """Return every area with its hazard as it stands on the map."""
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

    @routes.get("/api/v1/map.png", media_type=_PNG)
    async def map_png() -> Response:
        """Return the floor plan: white is free, black occupied, grey unknown."""
        return await picture("map", costmap.static, _PLAN)

    @routes.get("/api/v1/costmap.png", media_type=_PNG, problems=_NOT_READ)
    async def costmap_png() -> Response:
        """Return the master costmap; a pixel's palette index is the cell's cost."""
        _check_read(service)
        return await picture("cost", costmap.cost, _COSTS)


def _check_read(service: Service) -> None:
    if not service.core.zones_are_read:
        raise ProblemError(
            503, "the stored zones are not read yet: try again once /readyz says so", headers=_RETRY_AFTER
        )


def _known(service: Service, zone_id: str) -> Zone:
    _check_read(service)
    for zone in service.core.zones():
        if zone.id == zone_id:
            return zone
    raise ProblemError(404, f"there is no zone {zone_id}")


def _matching(service: Service, zone_id: str, if_match: str | None) -> Zone:
    zone = _known(service, zone_id)
    if expected_version(if_match) not in (None, zone.version):
        detail = f"zone {zone_id} is at version {zone.version}, not {if_match}: read it again and decide"
        raise ProblemError(412, detail)
    return zone


def _zone(body: ZoneBody, name: str, author: str, stamp: float) -> Zone:
    if body.ttl_s is not None and body.expires_at is not None:
        raise ProblemError(422, "give either ttl_s or expires_at, not both", field="body.ttl_s")
    return Zone(
        id=name,
        kind=body.kind,
        shape=body.shape,
        factor=body.factor,
        speed=body.speed,
        reason=body.reason,
        author=author,
        starts_at=body.starts_at,
        expires_at=body.expires_at if body.ttl_s is None else stamp + body.ttl_s,
        enabled=body.enabled,
    )


def _png(cells: Grid, palette: bytes) -> bytes:
    """Return a PNG whose palette indices are the cells; the picture's first row is the grid's last."""
    image = Image.fromarray(np.ascontiguousarray(cells[::-1]))
    image.putpalette(palette)
    data = io.BytesIO()
    image.save(data, "PNG", compress_level=1)
    return data.getvalue()


def _palette(special: dict[int, tuple[int, int, int]]) -> bytes:
    """Return 256 colours: graded costs run from near white to orange."""
    colours = [(255, 250 - cost // 2, 240 - cost * 220 // 252) for cost in range(253)] + [(0, 0, 0)] * 3
    for cost, colour in special.items():
        colours[cost] = colour
    return bytes(part for colour in colours for part in colour)


_PLAN: Final = _palette({0: (255, 255, 255), 254: (0, 0, 0), 255: (205, 205, 205)})
_COSTS: Final = _palette({0: (255, 255, 255), 253: (90, 160, 220), 254: (150, 0, 40), 255: (205, 205, 205)})
