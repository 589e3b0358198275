"""Operators' zones: their shapes, effects and times (zenoh, msgpack)."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from fog_contracts.costs import PENALTY_FACTOR_MAX
from fog_contracts.messages.basics import Count, Id, Message, PointXY, Ring, Sentence, Stamp, TimeToLive

ZoneKind = Literal["BLOCKED", "PENALTY", "SPEED_LIMIT"]
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


class Zone(Message, frozen=True, kw_only=True):
    """An operator's zone: shape, effect (factor for PENALTY, m/s for SPEED_LIMIT), reason, author and validity.

    With `ttl_s` (s from its start) the zone ends by a monotonic clock, and `expires_at` only says when that will be.
    With a `schedule` it is in force in the schedule's windows only.
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
    enabled: bool = True
    version: Count = 1


class ZoneSet(Message, frozen=True, kw_only=True):
    """All stored zones, with the map version that contains them; `active` are the ids of those in force.

    Whether a zone is in force follows from no clock of the receiver: it is what the map-service has decided.
    """

    epoch: Count
    seq: Count
    zones: list[Zone]
    active: list[Id]
