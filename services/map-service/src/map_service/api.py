"""REST under /api/v1: zones for operators; hazards, places, map, costmap and audit entries to look at.

Reading needs no token but for the audit log; writing needs the role operator.
"""

import asyncio
import io
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, Final

import msgspec
import numpy as np
from fastapi import Depends, FastAPI, Header, Request, Response
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
    Caller,
    ProblemError,
    Tokens,
    answer_schema,
    body_schema,
    make_app,
    read_body,
    require,
)
from map_service.layers.base import Grid
from map_service.service import ConflictError, Service
from map_service.store import AuditEntry, StoreError
from map_service.zone_validation import ZoneError

RETRY_AFTER: Final = {"Retry-After": "1"}
_IMAGE: Final[dict[int | str, dict[str, Any]]] = {200: {"description": "The picture", "content": {"image/png": {}}}}


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
    _add_zones(app, service, clock)
    _add_views(app, service, site)
    return app


def _add_zones(app: FastAPI, service: Service, clock: Clock) -> None:
    operator = Annotated[Caller, Depends(require("operator"))]
    etag = Annotated[str | None, Header(alias="If-Match", description="the zone's ETag: refuse if it changed since")]

    @app.get("/api/v1/zones", tags=["zones"], responses=answer_schema(app, ZoneList))
    async def list_zones() -> Response:
        """List all zones with the map version that shows them."""
        _check_read(service)
        version = service.core.costmap.version
        zones = service.core.zones()
        answer = ZoneList(zones=zones, active=service.core.active_zones(), epoch=version.epoch, seq=version.seq)
        return _json(answer)

    @app.post("/api/v1/zones", tags=["zones"], status_code=201, openapi_extra=body_schema(app, ZoneBody))
    async def create_zone(request: Request, caller: operator) -> Response:
        """Draw a zone; the answer comes once it is stored for good and on the map."""
        _check_read(service)
        body = await _zone_body(request)
        name = body.id or f"z-{secrets.token_hex(4)}"
        with _problems(name):
            zone = await service.create(_zone(body, name, caller, clock.stamp()), caller.name)
        return _json(zone, 201, {"ETag": f'"{zone.version}"', "Location": f"/api/v1/zones/{zone.id}"})

    @app.get("/api/v1/zones/{zone_id}", tags=["zones"], responses=answer_schema(app, Zone))
    async def get_zone(zone_id: str) -> Response:
        """Return one zone with its ETag."""
        zone = _known(service, zone_id)
        return _json(zone, headers={"ETag": f'"{zone.version}"'})

    @app.put("/api/v1/zones/{zone_id}", tags=["zones"], openapi_extra=body_schema(app, ZoneBody))
    async def put_zone(request: Request, zone_id: str, caller: operator, if_match: etag = None) -> Response:
        """Replace a zone; with If-Match only if nobody changed it since."""
        body = await _zone_body(request)
        if body.id not in (None, zone_id):
            raise ProblemError(422, f"the path says {zone_id}: leave the id out or say the same", field="body.id")
        old = _matching(service, zone_id, if_match)
        with _problems(zone_id):
            zone = await service.replace(_zone(body, zone_id, caller, clock.stamp()), old.version, caller.name)
        return _json(zone, headers={"ETag": f'"{zone.version}"'})

    @app.delete("/api/v1/zones/{zone_id}", tags=["zones"], status_code=204)
    async def delete_zone(zone_id: str, caller: operator, if_match: etag = None) -> Response:
        """Take a zone away; with If-Match only if nobody changed it since."""
        old = _matching(service, zone_id, if_match)
        with _problems(zone_id):
            await service.delete(old, caller.name)
        return Response(status_code=204)

    @app.get("/api/v1/audit", tags=["zones"], responses=answer_schema(app, list[AuditEntry]))
    async def audit(_: Annotated[Caller, Depends(require("viewer"))], limit: int = 100) -> Response:
        """Return who did what, newest first."""
        with _problems(""):
            return _json(await service.audit(max(1, min(limit, 1000))))


def _add_views(app: FastAPI, service: Service, site: Site) -> None:
    core, costmap = service.core, service.core.costmap
    pictures: dict[str, tuple[object, bytes]] = {}

    async def picture(name: str, cells: Grid, palette: bytes) -> Response:
        """Encode off the loop, once per version; the pixels' values are the cells'."""
        known = pictures.get(name)
        if known is None or known[0] != costmap.version:
            # The copy is taken before the loop can change the map.
            pictures[name] = known = (costmap.version, await asyncio.to_thread(_png, cells.copy(), palette))
        return Response(known[1], media_type="image/png", headers={"Cache-Control": "no-cache"})

    @app.get("/api/v1/hazards", tags=["map"], responses=answer_schema(app, list[HazardArea]))
    async def hazards() -> Response:
        """Return every area with its hazard as it stands on the map."""
        return _json(core.hazards())

    @app.get("/api/v1/places", tags=["map"], responses=answer_schema(app, dict[str, Place]))
    async def places() -> Response:
        """Return the site's named poses."""
        return _json(site.places)

    @app.get("/api/v1/map", tags=["map"], responses=answer_schema(app, MapInfo))
    async def map_info() -> Response:
        """Return the map's geometry and version."""
        g = costmap.geometry
        geometry = MapGeometry(
            width=g.width, height=g.height, resolution=g.resolution, origin_x=g.origin_x, origin_y=g.origin_y
        )
        return _json(MapInfo(site=site.id, geometry=geometry, epoch=costmap.version.epoch, seq=costmap.version.seq))

    @app.get("/api/v1/map.png", tags=["map"], response_class=Response, responses=_IMAGE)
    async def map_png() -> Response:
        """Return the floor plan: white is free, black occupied, grey unknown."""
        return await picture("map", costmap.static, _PLAN)

    @app.get("/api/v1/costmap.png", tags=["map"], response_class=Response, responses=_IMAGE)
    async def costmap_png() -> Response:
        """Return the master costmap; a pixel's palette index is the cell's cost."""
        _check_read(service)
        return await picture("cost", costmap.cost, _COSTS)


@contextmanager
def _problems(name: str) -> Iterator[None]:
    """Turn what the service raises about the zone `name` into problem documents."""
    try:
        yield
    except ZoneError as error:
        raise ProblemError(422, error.message, field=f"body.{error.field}") from error
    except StoreError as error:
        detail = f"the store does not answer, so nothing was changed for certain: try again ({error})"
        raise ProblemError(503, detail, headers=RETRY_AFTER) from error
    except ConflictError as error:
        if error.outcome == "exists":
            raise ProblemError(409, f"zone {name} exists already: choose another id, or PUT it") from error
        raise ProblemError(412, f"zone {name} was changed by somebody else: read it again and decide") from error


def _check_read(service: Service) -> None:
    if not service.core.zones_are_read:
        raise ProblemError(
            503, "the stored zones are not read yet: try again once /readyz says so", headers=RETRY_AFTER
        )


def _known(service: Service, zone_id: str) -> Zone:
    _check_read(service)
    for zone in service.core.zones():
        if zone.id == zone_id:
            return zone
    raise ProblemError(404, f"there is no zone {zone_id}")


def _matching(service: Service, zone_id: str, if_match: str | None) -> Zone:
    zone = _known(service, zone_id)
    if if_match is not None and if_match.strip() not in ("*", f'"{zone.version}"'):
        detail = f"zone {zone_id} is at version {zone.version}, not {if_match}: read it again and decide"
        raise ProblemError(412, detail)
    return zone


async def _zone_body(request: Request) -> ZoneBody:
    try:
        return await read_body(request, ZoneBody)
    except ProblemError as error:
        remedies = {
            "body.shape.points": "an outline needs at least three corners: draw one more",
            "body.shape.line": "a corridor needs at least two points: draw one more",
        }
        for known in error.errors:
            if (remedy := remedies.get(known["field"])) and "length" in known["problem"]:
                known["problem"] += f"; {remedy}"
        error.detail = "; ".join(f"{known['field']}: {known['problem']}" for known in error.errors)
        raise


def _zone(body: ZoneBody, name: str, caller: Caller, stamp: float) -> Zone:
    if body.ttl_s is not None and body.expires_at is not None:
        raise ProblemError(422, "give either ttl_s or expires_at, not both", field="body.ttl_s")
    return Zone(
        id=name,
        kind=body.kind,
        shape=body.shape,
        factor=body.factor,
        speed=body.speed,
        reason=body.reason,
        author=caller.name,
        starts_at=body.starts_at,
        expires_at=body.expires_at if body.ttl_s is None else stamp + body.ttl_s,
        enabled=body.enabled,
    )


def _json(content: object, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    return Response(msgspec.json.encode(content), status, headers, media_type="application/json")


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
