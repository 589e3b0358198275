"""Zones as REST takes them."""

from typing import Annotated

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
)
from fog_runtime.http import HttpProblem, ProblemError


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
        enabled=body.enabled,
    )
