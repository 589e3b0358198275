"""Validates zones before they are stored, with errors that an operator understands. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.messages import ZoneSet
from fog_contracts.shapes import ShapeError, normalized_shape, rasterize_shape

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.grid import GridGeometry
    from fog_contracts.messages import Zone


class ZoneError(ValueError):
    """A zone is invalid: `field` is the path of the field in the zone, the message names the problem and the remedy."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field
        self.message = message


def validated_zone(zone: Zone, geometry: GridGeometry, stamp: float) -> Zone:
    """Return the zone as it is stored (polygons counter-clockwise); raises `ZoneError` that names field and remedy."""
    if zone.kind == "PENALTY" and zone.factor is None:
        raise ZoneError(
            "factor", "a PENALTY zone needs a factor from 1 to 5: how many free cells a cell counts"
        )
    if zone.kind == "SPEED_LIMIT" and zone.speed is None:
        raise ZoneError("speed", "a SPEED_LIMIT zone needs a speed in m/s")
    if zone.kind != "PENALTY" and zone.factor is not None:
        raise ZoneError("factor", f"a {zone.kind} zone has no factor: leave it out or make the kind PENALTY")
    if zone.kind != "SPEED_LIMIT" and zone.speed is not None:
        raise ZoneError("speed", f"a {zone.kind} zone has no speed: leave it out or make the kind SPEED_LIMIT")
    if zone.expires_at is not None and zone.expires_at <= max(stamp, zone.starts_at or 0.0):
        raise ZoneError("expires_at", "the zone would end before it starts: give a later time, or leave it out")
    try:
        shape = normalized_shape(zone.shape)
        on_map = rasterize_shape(shape, geometry).mask.any()
    except ShapeError as error:
        raise ZoneError(f"shape.{error.field}", error.problem) from error
    if not on_map:
        left, bottom, right, top = geometry.bounds
        raise ZoneError(
            "shape",
            f"the zone lies off the map, which reaches from ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}) m:"
            " move it onto the map",
        )
    return structs.replace(zone, shape=shape)


def list_size(zones: Sequence[Zone]) -> int:
    """Return the largest size (bytes) of the message that tells robots of these zones."""
    largest = 2**53
    return len(msgspec.msgpack.encode(ZoneSet(epoch=largest, seq=largest, zones=list(zones))))


def check_list_size(zone: Zone, zones: Sequence[Zone]) -> None:
    """Raise `ZoneError` when this zone, new or changed, would make the list of all zones too large for robots.

    A list that is too large already may shrink.
    """
    size = list_size([zone, *(known for known in zones if known.id != zone.id)])
    if size > max(ch.ZONES.limit, list_size(zones)):
        raise ZoneError(
            "shape",
            f"the list of all zones would have {size} bytes, and robots accept {ch.ZONES.limit}: give the shape fewer"
            " corners, or delete zones that nobody needs",
        )
