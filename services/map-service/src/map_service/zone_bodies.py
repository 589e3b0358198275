"""Zones as REST takes them."""

from typing import Annotated, Final

import msgspec

from fog_contracts.messages import (
    Id,
    Message,
    PenaltyFactor,
    Sentence,
    Shape,
    Stamp,
    TimeToLive,
    WeeklySchedule,
    Zone,
    ZoneKind,
    ZoneSets,
)
from fog_runtime.http import HttpProblem, Patch, ProblemError

_SHORTEST_S: Final = 0.001
"""The time to live of a zone that was about to end when something else of it was changed."""
_SENT: Final = ("kind", "shape", "factor", "speed", "reason", "starts_at", "schedule", "sets", "enabled")


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
    sets: ZoneSets = msgspec.field(default_factory=list)
    enabled: bool = True


def zone_from_body(body: ZoneBody, zone_id: str, author: str, stamp: float) -> Zone:
    """Return the zone of a body, at `stamp` (s since the epoch); raises a `ProblemError` for two ends."""
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
        sets=body.sets,
        enabled=body.enabled,
    )


def body_of_zone(zone: Zone, patch: Patch, rest_s: float | None) -> ZoneBody:
    """Return a zone as it is sent, for a patch of it; `rest_s` is what remains of its time to live, if that is known.

    What remains is sent, unless the patch gives the zone another start or end: its time goes on.
    """
    ttl_s = zone.ttl_s
    if patch.get("expires_at") is not None:
        ttl_s = None
    elif ttl_s is not None and rest_s is not None and not patch.keys() & {"ttl_s", "starts_at"}:
        ttl_s = max(rest_s, _SHORTEST_S)
    fields = {name: getattr(zone, name) for name in _SENT}
    return ZoneBody(**fields, ttl_s=ttl_s, expires_at=zone.expires_at if zone.ttl_s is None else None)
