"""The versioned map, the reasons for its costs, and operators' zones: shapes, effects and times (zenoh, msgpack)."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from fog_contracts.costs import PENALTY_FACTOR_MAX
from fog_contracts.messages.areas import AreaHazard
from fog_contracts.messages.basics import (
    Cells,
    Count,
    Hash,
    Id,
    Message,
    Metres,
    PointXY,
    Radians,
    Ring,
    Sent,
    Sentence,
    Stamp,
    TimeToLive,
    Trace,
)

MAX_CELLS: Final = 100_000_000
"""Limit of a map (500 m x 500 m at 5 cm), so that a damaged or hostile snapshot can't exhaust the memory."""


class MapGeometry(Message, frozen=True, kw_only=True):
    """Size in cells, resolution in m per cell, lower-left corner in the frame `map`."""

    width: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    height: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    resolution: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "m/cell"})]
    origin_x: Metres
    origin_y: Metres

    def __post_init__(self) -> None:
        if self.width * self.height > MAX_CELLS:
            raise ValueError(f"{self.width} x {self.height} cells are more than {MAX_CELLS}")


class Cause(Message, frozen=True, kw_only=True):
    """Why cells changed: the hazard, zone, obstacle or map that changed, and its new state."""

    kind: Literal["hazard", "zone", "obstacle", "map"]
    id: Annotated[str, Meta(max_length=64)]
    state: Annotated[str, Meta(max_length=32)]


Layer = Literal["cost", "speed"]
Packing = Literal["raw", "zlib"]


class MapDelta(Message, frozen=True, kw_only=True):
    """One window of one layer of a new map version; a version is applied when all its `parts` have arrived.

    `cells` is uint8, row-major, row 0 at the bottom, `w * h` values after unpacking. `hash` is the hash of the whole
    map (`fog_contracts.replica`) after the version.
    """

    epoch: Count
    seq: Count
    part: Annotated[int, Meta(ge=0, le=65_535)]
    parts: Annotated[int, Meta(ge=1, le=65_535)]
    layer: Layer
    x: Cells
    y: Cells
    w: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    h: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    packing: Packing
    cells: bytes
    hash: Hash
    causes: list[Cause] = []
    traces: list[Trace] = []


class MapHeartbeat(Message, frozen=True, kw_only=True):
    """The map-service's current version, 10 times a second."""

    epoch: Count
    seq: Count
    hash: Hash
    sent: Sent


class MapSnapshot(Message, frozen=True, kw_only=True):
    """The whole map at one version; the layers are zlib-packed uint8 grids of the same geometry.

    `static` is the floor plan for localization (0 free, 254 occupied, 255 unknown), without hazards and zones.
    """

    site: Id
    epoch: Count
    seq: Count
    hash: Hash
    geometry: MapGeometry
    cost: bytes
    speed: bytes
    static: bytes


class HazardArea(Message, frozen=True, kw_only=True):
    """A hazard with its area's polygon: the reason for costs inside it; `epoch` is the map-service's.

    `confirmed`: the aggregator lives and confirms the hazard; if not, the area may have changed since.
    """

    hazard: AreaHazard
    polygon: Ring
    label: str = ""
    confirmed: bool = True
    epoch: Count = 0


ZoneKind = Literal["BLOCKED", "PENALTY", "SPEED_LIMIT", "RELEASE"]
"""RELEASE: one robot at a time, as the planner's leases see to it; such a zone costs nothing."""
PenaltyFactor = Annotated[float, Meta(ge=1.0, le=PENALTY_FACTOR_MAX)]


class PolygonShape(Message, frozen=True, kw_only=True, tag="polygon", tag_field="type"):
    """A simple polygon, any orientation."""

    points: Ring


class RectangleShape(Message, frozen=True, kw_only=True, tag="rectangle", tag_field="type"):
    """An upright rectangle by two opposite corners."""

    corner: PointXY
    opposite: PointXY


class CircleShape(Message, frozen=True, kw_only=True, tag="circle", tag_field="type"):
    """A circle by centre and radius."""

    centre: PointXY
    radius: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "m"})]


class CorridorShape(Message, frozen=True, kw_only=True, tag="corridor", tag_field="type"):
    """Everything within half a width of a polyline."""

    line: Annotated[list[PointXY], Meta(min_length=2, max_length=500)]
    width: Annotated[float, Meta(gt=0.0, le=1000.0, extra={"unit": "m"})]


Shape = PolygonShape | RectangleShape | CircleShape | CorridorShape

WEEKDAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
Weekday = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
TimeOfDay = Annotated[str, Meta(pattern=r"^([01][0-9]|2[0-3]):[0-5][0-9]$(?!\n)")]


class WeeklyTime(Message, frozen=True, kw_only=True):
    """A window on some days of each week, from `begin` to `end` (HH:MM); an end not later is of the next day."""

    days: Annotated[list[Weekday], Meta(min_length=1, max_length=7)]
    begin: TimeOfDay
    end: TimeOfDay


class WeeklySchedule(Message, frozen=True, kw_only=True):
    """The windows of each week, in the local time of a time zone (such as Europe/Lisbon)."""

    time_zone: Annotated[str, Meta(min_length=1, max_length=64)]
    times: Annotated[list[WeeklyTime], Meta(min_length=1, max_length=20)]


ZoneSets = Annotated[list[Id], Meta(max_length=8)]


class Zone(Message, frozen=True, kw_only=True):
    """An operator's zone: shape, effect (factor for PENALTY, m/s for SPEED_LIMIT), reason, author and validity.

    With `ttl_s` (s from its start) the zone ends by a monotonic clock, and `expires_at` only says when that will be.
    With a `schedule` it is in force in the schedule's windows only, and never while one of its `sets` is off.
    `source`: which source of zones put it, over MQTT; null: an operator did.
    """

    id: Id
    kind: ZoneKind
    shape: Shape
    factor: PenaltyFactor | None = None
    speed: Annotated[float, Meta(ge=0.01, le=2.54, extra={"unit": "m/s"})] | None = None
    reason: Sentence = ""
    author: Annotated[str, Meta(max_length=100)] = ""
    starts_at: Stamp | None = None
    expires_at: Stamp | None = None
    ttl_s: TimeToLive | None = None
    schedule: WeeklySchedule | None = None
    sets: ZoneSets = []
    source: Id | None = None
    enabled: bool = True
    version: Count = 1


class ZoneRequest(Message, frozen=True, kw_only=True):
    """A zone that a source puts on the map for a limited time: `ttl_s`, or `expires_at`, and not both.

    An empty message removes it. A retained message needs `expires_at`: nobody knows how old it is.
    """

    kind: ZoneKind
    shape: Shape
    factor: PenaltyFactor | None = None
    speed: Annotated[float, Meta(ge=0.01, le=2.54, extra={"unit": "m/s"})] | None = None
    reason: Sentence = ""
    ttl_s: TimeToLive | None = None
    expires_at: Stamp | None = None


class Place(Message, frozen=True, kw_only=True):
    """A named pose; without `theta` any heading is accepted. Visitors may send robots to those that are `public`."""

    x: Metres
    y: Metres
    theta: Radians | None = None
    label: Annotated[str, Meta(max_length=100)] = ""
    public: bool = False


PLACES_MAX: Final = 1_000
"""Most places of a site."""


class PlaceSet(Message, frozen=True, kw_only=True):
    """All places by id: those of `site.toml` as operators have changed them since; `epoch` is the map-service's."""

    epoch: Count
    places: dict[Id, Place]


class ZoneSet(Message, frozen=True, kw_only=True):
    """All stored zones, with the map version that contains them; `active` are the ids of those in force.

    Whether a zone is in force follows from no clock of the receiver: it is what the map-service has decided.
    """

    epoch: Count
    seq: Count
    zones: list[Zone]
    active: list[Id]
