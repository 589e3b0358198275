"""REST that brings zones out as masks of Nav2's costmap filters, and painted masks in as zones."""

import io
import math
import secrets
import tempfile
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np
from fastapi import Response
from PIL import Image, UnidentifiedImageError

from fog_contracts.grid import GridGeometry
from fog_contracts.messages import Id, Message, PolygonShape, Sentence, TimeToLive, Zone
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError, Worker
from fog_runtime.configuration.maps import MapFileError, Occupancy, load_occupancy
from fog_runtime.http import Body, Operator, ProblemError, Routes
from fog_runtime.stores.redis_connection import StoreError
from map_service.formats import masks
from map_service.layers.base import Grid
from map_service.problems import ZONES_NOT_LOADED, MapProblem, require_zones
from map_service.record_writer import ConflictError
from map_service.service import Service
from map_service.zone_bodies import ZoneBody, zone_from_body
from map_service.zones import MAX_ZONES, ZoneError

_PNG: Final = "image/png"
_YAML: Final = "application/yaml"
_MAX_WAITING: Final = 4
_MAX_PIXELS: Final = 16_000_000
_FILTER: Final = {
    "keepout": "nav2_costmap_2d::KeepoutFilter; its filter info: type 0, base 0.0, multiplier 1.0",
    "speed": f"nav2_costmap_2d::SpeedFilter; its filter info: type 2 (m/s), base 0.0, multiplier {masks.SPEED_STEP}",
}


class MaskBody(Message, frozen=True, kw_only=True):
    """A mask: `png` in base64, and what map_server needs to read it; without `yaml` it covers the map, white is free.

    A speed mask's limits are `value * multiplier` (m/s). Unless `save`, its zones are only told. Their ids are `id`, or
    one that is made, with a number.
    """

    kind: masks.MaskKind
    png: bytes
    yaml: Annotated[str, msgspec.Meta(max_length=4000)] | None = None
    multiplier: Annotated[float, msgspec.Meta(gt=0.0, le=10.0)] = masks.SPEED_STEP
    save: bool = False
    id: Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,26}$(?!\n)")] | None = None
    reason: Sentence = ""
    ttl_s: TimeToLive | None = None


class MaskZone(Message, frozen=True, kw_only=True):
    """A zone of a mask, and how many of the mask's cells it is of."""

    zone: Zone
    cells: int


class MaskReport(Message, frozen=True, kw_only=True):
    """The zones of a mask; `saved`: they are stored and on the map."""

    saved: bool
    zones: list[MaskZone]


def add_masks(routes: Routes, service: Service, clock: Clock) -> None:
    """Add the routes; `routes` knows the errors of zones and of the store."""
    worker = Worker("masks", limit=_MAX_WAITING)

    async def png(kind: masks.MaskKind) -> Response:
        require_zones(service)
        data = await worker.run(_png, _values(service, kind))
        return Response(data, media_type=_PNG, headers={"Cache-Control": "no-cache"})

    @routes.get("/api/v1/masks/keepout.png", media_type=_PNG, raises=[BusyError], problems=ZONES_NOT_LOADED)
    async def keepout_png() -> Response:
        """Return the no-go and penalty zones in force as a mask for Nav2's KeepoutFilter: black is no-go."""
        return await png("keepout")

    @routes.get("/api/v1/masks/speed.png", media_type=_PNG, raises=[BusyError], problems=ZONES_NOT_LOADED)
    async def speed_png() -> Response:
        """Return the speed limits in force as a mask for Nav2's SpeedFilter: the darker the faster, white is none."""
        return await png("speed")

    @routes.get("/api/v1/masks/keepout.yaml", media_type=_YAML)
    async def keepout_yaml() -> Response:
        """Return what map_server needs beside the keepout mask."""
        return Response(yaml_of("keepout", service.core.costmap.geometry), media_type=_YAML)

    @routes.get("/api/v1/masks/speed.yaml", media_type=_YAML)
    async def speed_yaml() -> Response:
        """Return what map_server needs beside the speed mask."""
        return Response(yaml_of("speed", service.core.costmap.geometry), media_type=_YAML)

    @routes.post(
        "/api/v1/masks",
        raises=[ZoneError, ConflictError, BusyError, StoreError],
        problems=[MapProblem.MASK_INVALID, *ZONES_NOT_LOADED],
    )
    async def post_mask(body: Body[MaskBody], caller: Operator) -> MaskReport:
        """Make zones of a painted mask, a polygon for each connected part; unless `save`, only tell which."""
        require_zones(service)
        await service.zones.reload_after_uncertain_write()
        try:
            occupancy, parts = await worker.run(_read, body, service.core.costmap.geometry)
        except masks.MaskError as error:
            raise ProblemError(MapProblem.MASK_INVALID, str(error), field="body.png") from error
        except MapFileError as error:
            raise ProblemError(MapProblem.MASK_INVALID, _told(error), field="body.yaml") from error
        prefix = body.id or f"m-{secrets.token_hex(3)}"
        made = [_zone(body, part, occupancy, f"{prefix}-{number}") for number, part in enumerate(parts, 1)]
        zones = [zone_from_body(each, str(each.id), caller.name, clock.stamp()) for each in made]
        zones = [(await service.zones.prepare(zone)).zone for zone in zones]
        if body.save:
            _require_free(service, zones)
            zones = [await service.zones.create(zone, caller.name) for zone in zones]
        told = [MaskZone(zone=zone, cells=part.cells) for zone, part in zip(zones, parts, strict=True)]
        return MaskReport(saved=body.save, zones=told)


def yaml_of(kind: masks.MaskKind, geometry: GridGeometry) -> str:
    """Return the text of a mask's YAML file, which map_server reads beside the picture."""
    return (
        f"# {_FILTER[kind]}\n"
        f"image: {kind}.png\nmode: scale\nresolution: {geometry.resolution!r}\n"
        f"origin: [{geometry.origin_x!r}, {geometry.origin_y!r}, 0.0]\nnegate: 0\n"
        "occupied_thresh: 1.0\nfree_thresh: 0.0\n"
    )


def _values(service: Service, kind: masks.MaskKind) -> Grid:
    """Return the mask of the zones in force."""
    geometry = service.core.costmap.geometry
    cost, speed = (np.zeros((geometry.height, geometry.width), np.uint8) for _ in range(2))
    service.core.write_zones(cost, speed)
    return masks.keepout_values(cost) if kind == "keepout" else masks.speed_values(speed)


def _png(values: Grid) -> bytes:
    data = io.BytesIO()
    Image.fromarray(masks.to_shades(values)).save(data, "PNG", compress_level=1)
    return data.getvalue()


def _read(body: MaskBody, geometry: GridGeometry) -> tuple[Occupancy, list[masks.Part]]:
    """Return a mask as map_server reads it, and its parts; raises `MaskError` and `MapFileError`."""
    try:
        with Image.open(io.BytesIO(body.png)) as picture:
            width, height = picture.size
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise masks.MaskError("the mask is no picture that can be read: save it as PNG") from error
    if width * height > _MAX_PIXELS:
        raise masks.MaskError(f"the mask has {width} x {height} pixels, more than {_MAX_PIXELS}: make it smaller")
    if body.yaml is None and (width, height) != (geometry.width, geometry.height):
        raise masks.MaskError(
            f"the mask has {width} x {height} pixels, and the map {geometry.width} x {geometry.height}: paint on"
            f" GET /api/v1/masks/{body.kind}.png, or give the mask's yaml"
        )
    with tempfile.TemporaryDirectory() as folder:
        image, file = Path(folder) / "mask.png", Path(folder) / "mask.yaml"
        image.write_bytes(body.png)
        lines = (body.yaml or yaml_of(body.kind, geometry)).splitlines()
        named = [line for line in lines if not line.startswith("image:")]
        file.write_text("\n".join(["image: mask.png", *named]) + "\n", "utf-8")
        occupancy = load_occupancy(file)
    parts = masks.parts_of(occupancy.values)
    if not parts:
        raise masks.MaskError("the mask is empty: nothing is painted on it")
    return occupancy, parts


def _told(error: MapFileError) -> str:
    """Return what is wrong with a mask, without where it lay for a moment."""
    return str(error).replace(f"{error.file.parent}/", "")


def _zone(body: MaskBody, part: masks.Part, occupancy: Occupancy, name: Id) -> ZoneBody:
    g, (cos, sin) = occupancy.geometry, (math.cos(occupancy.yaw), math.sin(occupancy.yaw))
    points = [
        (
            round(g.origin_x + (x * cos - y * sin) * g.resolution, 4),
            round(g.origin_y + (x * sin + y * cos) * g.resolution, 4),
        )
        for x, y in part.outline
    ]
    if body.kind == "speed":
        effect = {"kind": "SPEED_LIMIT", "speed": round(part.value * body.multiplier, 4)}
    elif masks.is_blocked(part.value):
        effect = {"kind": "BLOCKED"}
    else:
        effect = {"kind": "PENALTY", "factor": masks.factor_of(part.value)}
    try:
        return msgspec.convert(
            {**effect, "id": name, "shape": msgspec.to_builtins(PolygonShape(points=points)), "reason": body.reason,
             "ttl_s": body.ttl_s},
            ZoneBody,
        )  # fmt: skip
    except msgspec.ValidationError as error:
        detail = f"the value {part.value} is no zone's: {error}"
        raise ProblemError(MapProblem.MASK_INVALID, detail, field="body.multiplier") from error


def _require_free(service: Service, zones: list[Zone]) -> None:
    """Raise before anything is stored if one of the zones can't be."""
    for zone in zones:
        if service.core.zones.get(zone.id) is not None:
            raise ConflictError("exists", zone.id)
    if len(service.core.zones) + len(zones) > MAX_ZONES:
        raise ZoneError("png", f"there would be more than {MAX_ZONES} zones: delete zones that are not needed")
