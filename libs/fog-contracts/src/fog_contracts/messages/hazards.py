"""The state of areas as the aggregator announces it (MQTT, JSON)."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from fog_contracts.messages.basics import (
    AreaState,
    Author,
    Count,
    Hash,
    Id,
    Message,
    Sentence,
    Stamp,
    TimeToLive,
    Trace,
)

SEVERITY: Final = {"clear": 0, "unknown": 1, "unknown_after_blocked": 2, "blocked": 3}
"""Severity of an area's hazard by its state; an area that was blocked before it became unknown ranks higher."""
AREAS_MAX: Final = 1000
"""Areas of a site: so many fit into one heartbeat of the aggregator, whatever their ids."""


OverrideState = Literal["blocked", "clear"]
OverrideReason = Annotated[str, Meta(min_length=1, max_length=200)]
"""Why an operator overrides an area, for other people."""


class HazardOverride(Message, frozen=True, kw_only=True):
    """An operator's word on an area, which counts instead of its nodes' for a time: `ttl_s` from `set_at` on.

    `measured` and `measured_penalty` are what the area's state and penalty would be without it.
    """

    state: OverrideState
    author: Author
    reason: OverrideReason
    set_at: Stamp
    ttl_s: TimeToLive
    measured: AreaState
    measured_penalty: Annotated[int, Meta(ge=0, le=254)]


class AreaHazard(Message, frozen=True, kw_only=True):
    """State of one area; `seq` grows by one with each change, `epoch` with each start of the aggregator.

    With an `override` the state is not that of the nodes: `blocked`, or `unknown` and passable where an operator
    declared the area clear, which nobody measures (ADR 16).
    """

    area: Id
    state: AreaState
    severity: Annotated[int, Meta(ge=0, le=3)]
    penalty: Annotated[int, Meta(ge=0, le=254)]
    since: Stamp
    seq: Count
    epoch: Count
    cause: Sentence
    nodes: dict[Id, AreaState] = {}
    explained_by: Id | None = None
    override: HazardOverride | None = None
    trace: Trace | None = None


class AggregatorHeartbeat(Message, frozen=True, kw_only=True):
    """The aggregator's sign of life, and its word on every area: a hazard that it does not list is not its own.

    `areas` has the `seq` of each area's announced hazard (0: none yet), `digest` (`fog_contracts.hazards.digest`)
    covers these hazards. Without `complete` there may be further areas, whose records are not loaded yet. `uptime` is
    the sender's monotonic clock with an arbitrary origin; how late a heartbeat arrives is computed from it, never from
    `stamp`.
    """

    epoch: Count
    areas: dict[Id, Count]
    complete: bool
    digest: Hash
    uptime: Annotated[float, Meta(ge=0.0, le=1e12, extra={"unit": "s"})]
    stamp: Stamp
