"""Validates zones before they are stored, with errors that an operator understands. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.messages import ZoneSet
from fog_contracts.shapes import ShapeError, normalized_shape, shape_spans
from map_service.zone_catalog import encoded_size
from map_service.zone_times import is_time_zone

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import Zone
    from fog_contracts.raster import Spans

MAX_ZONES: Final = 5_000
"""Most zones of a site."""
MAX_COVERAGE: Final = 64
"""How many times all zones together may cover the floor."""


class ZoneError(ValueError):
    """A zone is invalid: `field` is the path of the field in the zone, the message names the problem and the remedy."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


class PreparedZone(NamedTuple):
    """A valid zone as it is stored (polygons counter-clockwise), and its cells."""

    zone: Zone
    spans: Spans


def prepare_zone(zone: Zone, geometry: GridGeometry, stamp: float) -> PreparedZone:
    """Validate and rasterize a zone; raises `ZoneError` that names field and remedy.

    `stamp` is the time (s since the epoch), or 0 while that is not known. Large shapes take some ten milliseconds: a
    service runs it on another thread.
    """
    if zone.kind == "PENALTY" and zone.factor is None:
        raise ZoneError("factor", "a PENALTY zone needs a factor from 1 to 5: how many free cells a cell counts")
    if zone.kind == "SPEED_LIMIT" and zone.speed is None:
        raise ZoneError("speed", "a SPEED_LIMIT zone needs a speed in m/s")
    if zone.kind != "PENALTY" and zone.factor is not None:
        raise ZoneError("factor", f"a {zone.kind} zone has no factor: leave it out or make the kind PENALTY")
    if zone.kind != "SPEED_LIMIT" and zone.speed is not None:
        raise ZoneError("speed", f"a {zone.kind} zone has no speed: leave it out or make the kind SPEED_LIMIT")
    if zone.schedule is not None and not is_time_zone(zone.schedule.time_zone):
        problem = f"{zone.schedule.time_zone!r} is no time zone that this machine knows"
        raise ZoneError("schedule.time_zone", f"{problem}: name one such as Europe/Lisbon or UTC")
    if zone.expires_at is not None and zone.expires_at <= max(stamp, zone.starts_at or 0.0):
        raise ZoneError("expires_at", "the zone would end before it starts: give a later time, or leave it out")
    try:
        shape = normalized_shape(zone.shape)
        spans = shape_spans(shape, geometry)
    except ShapeError as error:
        raise ZoneError(f"shape.{error.field}", error.problem) from error
    if spans.window.empty:
        left, bottom, right, top = geometry.bounds
        raise ZoneError(
            "shape",
            f"the zone lies off the map, which reaches from ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}) m:"
            " move it onto the map",
        )
    return PreparedZone(structs.replace(zone, shape=shape), spans)


def check_room(prepared: PreparedZone, count: int, cells: int, geometry: GridGeometry) -> None:
    """Raise `ZoneError` when a zone is one too many for `count` others that cover `cells` cells in sum."""
    if count >= MAX_ZONES:
        raise ZoneError("", f"there are {count} zones already, which is the limit: delete zones that are not needed")
    floor = geometry.width * geometry.height
    if cells + prepared.spans.cells > MAX_COVERAGE * floor:
        problem = f"all zones together would cover the floor more than {MAX_COVERAGE} times"
        raise ZoneError("shape", f"{problem}: make it smaller, or delete zones that are not needed")


def zones_spans(zones: Iterable[Zone], geometry: GridGeometry) -> tuple[dict[str, Spans], dict[str, str]]:
    """Return the cells of each zone by its id, and, by id, why the shapes of others are invalid."""
    spans: dict[str, Spans] = {}
    invalid: dict[str, str] = {}
    for zone in zones:
        try:
            spans[zone.id] = named_spans(zone, geometry)
        except ShapeError as error:
            invalid[zone.id] = str(error)
    return spans, invalid


def named_spans(zone: Zone, geometry: GridGeometry) -> Spans:
    """Return the cells of a zone; raises `ShapeError`, which names the zone."""
    try:
        return shape_spans(zone.shape, geometry)
    except ShapeError as error:
        raise ShapeError(f"{zone.id}.shape.{error.field}", error.problem) from error


def list_size(size: int) -> int:
    """Return the largest size (bytes) of the message that tells robots of zones that have `size` bytes in sum."""
    return _EMPTY_LIST + size


def check_list_size(zone: Zone, others: int, known: int) -> None:
    """Raise `ZoneError` when this zone, new or changed, would make the list of all zones too large for robots.

    `others` are the bytes of all others (`encoded_size`), `known` those of all as they are: a list that is too large
    already may shrink.
    """
    size = list_size(others + encoded_size(zone))
    if size > max(ch.ZONES.limit, list_size(known)):
        raise ZoneError(
            "shape",
            f"the list of all zones would have {size} bytes, and robots accept {ch.ZONES.limit}: give the shape fewer"
            " corners, or delete zones that nobody needs",
        )


_LARGEST: Final = 2**53
_EMPTY_LIST: Final = len(msgspec.msgpack.encode(ZoneSet(epoch=_LARGEST, seq=_LARGEST, zones=[], active=[]))) + 2 * 4
"""Size of a list without zones, and of the longer numbers of zones and active ones in it."""
