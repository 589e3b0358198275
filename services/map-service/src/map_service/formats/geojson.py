"""Zones as GeoJSON (RFC 7946), out and in; coordinates are metres in the frame `map`, not longitude and latitude.

A polygon or rectangle is a Polygon (`shape` tells which), a circle a Point with a `radius`, a corridor a LineString
with a `width`, all in m; everything else of a zone is a property under its name in REST. Of a zone with a time to live
the end is told, `expires_at`: a file is read at any time.
"""

import secrets
from collections.abc import Callable
from typing import Annotated, Any, Final, Literal

import msgspec
from fastapi import Response

from fog_contracts.messages import (
    CircleShape,
    CorridorShape,
    Finite,
    Message,
    PointXY,
    PolygonShape,
    RectangleShape,
    Shape,
    Zone,
)
from fog_contracts.site import Site
from fog_runtime.clock import Clock
from fog_runtime.concurrency import BusyError
from fog_runtime.http import Body, Operator, Routes
from fog_runtime.http.routes import InvalidBodyError
from fog_runtime.stores.redis_connection import StoreError
from map_service.problems import ZONES_NOT_LOADED, require_zones
from map_service.record_writer import ConflictError
from map_service.service import Service
from map_service.zone_bodies import ZoneBody, zone_from_body
from map_service.zones import ZoneError

GEOJSON: Final = "application/geo+json"
_PLANE: Final = "coordinates are metres in the frame map, not longitude and latitude"
_NAMED: Final = 20
"""Most wrong features that an answer names."""

_FIELDS: Final = frozenset(ZoneBody.__struct_fields__) - {"id", "shape", "ttl_s"}
"""The properties of a zone by which it is the same as another one."""

Position = Annotated[list[Finite], msgspec.Meta(min_length=2, max_length=3)]
"""x and y (m); a height is ignored."""


class _Geometry(Message, frozen=True, tag_field="type"):
    pass


class GeoPoint(_Geometry, frozen=True, kw_only=True, tag="Point"):
    """The centre of a circle."""

    coordinates: Position


class GeoLine(_Geometry, frozen=True, kw_only=True, tag="LineString"):
    """The middle of a corridor."""

    coordinates: list[Position]


class GeoPolygon(_Geometry, frozen=True, kw_only=True, tag="Polygon"):
    """A ring whose last position is its first one; zones have no holes."""

    coordinates: list[list[Position]]


class GeoMultiPolygon(_Geometry, frozen=True, kw_only=True, tag="MultiPolygon"):
    """What other programs write for one polygon, too."""

    coordinates: list[list[list[Position]]]


Geometry = GeoPoint | GeoLine | GeoPolygon | GeoMultiPolygon


class Feature(Message, frozen=True, kw_only=True):
    """A zone; an `id` (member or property) is generated if missing. Without geometry it has a `shape` as in REST."""

    type: Literal["Feature"]
    geometry: Geometry | None
    properties: dict[str, Any] = msgspec.field(default_factory=dict)
    id: str | None = None


class FeatureCollection(Message, frozen=True, kw_only=True):
    """Zones. Members that are not named here are ignored."""

    type: Literal["FeatureCollection"]
    features: Annotated[list[Feature], msgspec.Meta(max_length=500)]


class ImportedZone(Message, frozen=True, kw_only=True):
    """What became of a feature."""

    id: str
    outcome: Literal["added", "replaced", "unchanged"]
    version: int


class FeatureError(ValueError):
    """A feature is no zone: `field` is the path inside it, the message names the problem and the remedy."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


def feature_of(zone: Zone) -> dict[str, Any]:
    """Return a zone as a feature."""
    fields: dict[str, Any] = msgspec.to_builtins(zone)
    geometry, more = _geometry_of(zone.shape)
    left_out = {"id", "shape"} if zone.expires_at is None else {"id", "shape", "ttl_s"}
    properties = {name: value for name, value in fields.items() if name not in left_out and value is not None}
    return {"type": "Feature", "id": zone.id, "geometry": geometry, "properties": {**properties, **more}}


def _geometry_of(shape: Shape) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """Return a geometry, and the properties that it needs; for a kind of shape without one, the shape as a property."""
    write = _GEOMETRIES.get(type(shape))
    return (None, {"shape": msgspec.to_builtins(shape)}) if write is None else write(shape)


def _ring(points: list[PointXY], kind: str) -> tuple[dict[str, Any], dict[str, Any]]:
    return {"type": "Polygon", "coordinates": [[*points, points[0]]]}, {"shape": kind}


def _rectangle(shape: RectangleShape) -> tuple[dict[str, Any], dict[str, Any]]:
    (x0, y0), (x1, y1) = shape.corner, shape.opposite
    return _ring([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], "rectangle")


_GEOMETRIES: Final[dict[type, Callable[[Any], tuple[dict[str, Any], dict[str, Any]]]]] = {
    CircleShape: lambda shape: ({"type": "Point", "coordinates": shape.centre}, {"radius": shape.radius}),
    CorridorShape: lambda shape: ({"type": "LineString", "coordinates": shape.line}, {"width": shape.width}),
    RectangleShape: _rectangle,
    PolygonShape: lambda shape: _ring(shape.points, "polygon"),
}


def body_of(feature: Feature) -> ZoneBody:
    """Return a feature as the body of a zone; raises `FeatureError`."""
    given = feature.properties
    name = feature.id if feature.id is not None else given.get("id")
    known = _FIELDS | {"ttl_s"}
    fields = {name_: value for name_, value in given.items() if name_ in known and value is not None}
    if {"ttl_s", "expires_at"} <= fields.keys():
        raise FeatureError("properties.ttl_s", "give either ttl_s or expires_at, not both")
    shape = given.get("shape")
    if feature.geometry is not None:
        shape = msgspec.to_builtins(_shape_of(feature.geometry, given))
    elif not isinstance(shape, dict):
        raise FeatureError("geometry", "a zone needs a geometry, or a shape as REST has it among its properties")
    try:
        return msgspec.convert({**fields, "id": name, "shape": shape}, ZoneBody)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        path = path.strip("`").removeprefix("$.").replace("[", ".").replace("]", "")
        if path.startswith("shape"):
            raise FeatureError("geometry", f"{path}: {problem}; {_PLANE}") from error
        field = "id" if path == "id" else f"properties.{path}" if path.strip("$") else "properties"
        raise FeatureError(field, problem) from error


def _shape_of(geometry: Geometry, properties: dict[str, Any]) -> Shape:
    match geometry:
        case GeoPoint(coordinates=centre):
            return CircleShape(centre=_xy(centre), radius=_number(properties, "radius", "a Point is a circle's centre"))
        case GeoLine(coordinates=line):
            width = _number(properties, "width", "a LineString is a corridor's middle")
            return CorridorShape(line=[_xy(point) for point in line], width=width)
        case GeoMultiPolygon(coordinates=polygons):
            if len(polygons) != 1:
                raise FeatureError(
                    "geometry", f"it has {len(polygons)} polygons: a zone is one, make a feature of each"
                )
            return _polygon(polygons[0], properties)
        case GeoPolygon(coordinates=rings):
            return _polygon(rings, properties)


def _polygon(rings: list[list[list[float]]], properties: dict[str, Any]) -> Shape:
    if len(rings) != 1:
        raise FeatureError("geometry", "the polygon has holes or no ring: zones have no holes, draw several zones")
    points = [_xy(point) for point in rings[0]]
    if len(points) > 1 and points[0] == points[-1]:
        points = points[:-1]
    xs, ys = {x for x, _ in points}, {y for _, y in points}
    if properties.get("shape") == "rectangle" and len(points) == 4 and len(xs) == len(ys) == 2:  # corners
        return RectangleShape(corner=points[0], opposite=points[2])
    return PolygonShape(points=points)


def _xy(position: list[float]) -> PointXY:
    return position[0], position[1]


def _number(properties: dict[str, Any], name: str, why: str) -> float:
    value = properties.get(name)
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise FeatureError(f"properties.{name}", f"{why}: give its {name} in m")
    return float(value)


def add_geojson(routes: Routes, service: Service, site: Site, clock: Clock) -> None:
    """Add the routes; `routes` knows the errors of zones and of the store."""

    @routes.get("/api/v1/zones.geojson", media_type=GEOJSON, problems=ZONES_NOT_LOADED)
    async def export_zones() -> Response:
        """Return all zones as GeoJSON, in metres of the frame `map`."""
        require_zones(service)
        collection = {
            "type": "FeatureCollection",
            "fognav": {"site": site.id, "frame": "map", "unit": "m"},
            "features": [feature_of(zone) for zone in service.core.zones.zones()],
        }
        return Response(msgspec.json.encode(collection), media_type=GEOJSON)

    @routes.post(
        "/api/v1/zones.geojson",
        raises=[ConflictError, BusyError, StoreError, ZoneError, InvalidBodyError],
        problems=ZONES_NOT_LOADED,
    )
    async def import_zones(body: Body[FeatureCollection], caller: Operator) -> list[ImportedZone]:
        """Add zones from GeoJSON, in metres of the frame `map`, and replace those that have the same ids.

        Other zones stay. Nothing is changed unless every feature is valid; then they are stored one after another.
        """
        require_zones(service)
        await service.zones.reload_after_uncertain_write()
        zones = await _valid_zones(service, body, caller.name, clock.stamp())
        return [await _store(service, zone, caller.name) for zone in zones]


async def _valid_zones(service: Service, body: FeatureCollection, author: str, stamp: float) -> list[Zone]:
    """Return the zones of all features; raises `InvalidBodyError`, which names each wrong one."""
    zones: dict[str, Zone] = {}
    errors: list[dict[str, str]] = []
    for index, feature in enumerate(body.features):
        try:
            made = body_of(feature)
            zone = zone_from_body(made, made.id or f"z-{secrets.token_hex(4)}", author, stamp)
            prepared = await service.zones.prepare(zone)
            if prepared.zone.id in zones:
                problem = f"two features are zone {zone.id}: give each an id of its own"
                errors.append({"field": f"body.features.{index}.id", "problem": problem})
            zones[zone.id] = prepared.zone
        except FeatureError as error:
            errors.append({"field": f"body.features.{index}.{error.field}", "problem": str(error)})
        except ZoneError as error:
            field = "geometry" if error.field.startswith("shape") else f"properties.{error.field}".rstrip(".")
            hint = f"; {_PLANE}" if field == "geometry" else ""
            errors.append({"field": f"body.features.{index}.{field}", "problem": f"{error.message}{hint}"})
    if errors:
        raise InvalidBodyError(errors[:_NAMED])
    return list(zones.values())


async def _store(service: Service, zone: Zone, who: str) -> ImportedZone:
    known = service.core.zones.get(zone.id)
    if known is None:
        zone = await service.zones.create(zone, who)
        return ImportedZone(id=zone.id, outcome="added", version=zone.version)
    old = known.zone
    if all(getattr(zone, name) == getattr(old, name) for name in _FIELDS | {"shape"}):
        return ImportedZone(id=old.id, outcome="unchanged", version=old.version)
    zone = await service.zones.replace(zone, old.version, who)
    return ImportedZone(id=zone.id, outcome="replaced", version=zone.version)
