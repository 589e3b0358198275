"""What a change of zones or areas would do, asked of the planner before anybody makes it (zenoh, msgpack)."""

from typing import Annotated, Literal

from msgspec import Meta

from fog_contracts.messages.basics import Cells, Count, Hash, Id, Message, PointXY
from fog_contracts.messages.maps import Cause, HazardArea, Layer, Packing, Zone
from fog_contracts.messages.robots import Points, Refusal

Length = Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
Duration = Annotated[float, Meta(ge=0.0, le=1e9, extra={"unit": "s"})]
Difference = Annotated[float, Meta(ge=-1e9, le=1e9)]


class MapPatch(Message, frozen=True, kw_only=True):
    """A window of one layer as it would be; `base` is the CRC-32 of the cells that it has now.

    By `base` the planner notices that its map differs in this window from the one that the patch was made for.
    """

    layer: Layer
    x: Cells
    y: Cells
    w: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    h: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    packing: Packing
    cells: bytes
    base: Hash


class Target(Message, frozen=True, kw_only=True):
    """A place that robots are sent to: one of the site's, or the front of a robot's dock (`id` is the robot's)."""

    kind: Literal["place", "dock"]
    id: Id
    at: PointXY


class DryRunRequest(Message, frozen=True, kw_only=True):
    """Asks what a change would do: its cells, the reasons of refusals that it adds or takes away, and the places.

    `zones` are the no-go zones that it would put into force, `removed` the ids of zones that are none any more,
    `hazards` the areas that it would change.
    """

    patches: Annotated[list[MapPatch], Meta(max_length=128)] = []
    zones: Annotated[list[Zone], Meta(max_length=5_000)] = []
    removed: Annotated[list[Id], Meta(max_length=5_000)] = []
    hazards: Annotated[list[HazardArea], Meta(max_length=100)] = []
    targets: Annotated[list[Target], Meta(max_length=2_000)] = []


class PathOutcome(Message, frozen=True, kw_only=True):
    """The rest of a path and how long it takes by the speeds that apply on it, or why there is none."""

    length_m: Length = 0.0
    seconds: Duration = 0.0
    refusal: Refusal | None = None


class RobotOutcome(Message, frozen=True, kw_only=True):
    """What a change would do to a robot; without a goal, only whether it would stand in a closed place.

    `replanned`: it would get another path. `extra_m` and `extra_s` are the differences where there is a path before and
    after. `inside` names what would close the place where it stands, and `way_out` is its path out of it; it stays
    there until an operator sends it out (`egress`). `at` is where it stands, `goal` where it is sent.
    """

    robot: Id
    at: PointXY | None = None
    goal: PointXY | None = None
    before: PathOutcome | None = None
    after: PathOutcome | None = None
    replanned: bool = False
    extra_m: Difference | None = None
    extra_s: Difference | None = None
    inside: list[Cause] = []
    way_out: PathOutcome | None = None


class ReachOutcome(Message, frozen=True, kw_only=True):
    """A place that a change cuts off from others, or connects: from which robots, and from which other places.

    `closed`: the place itself lies in what is closed. `more`: how many other places are not named.
    """

    kind: Literal["place", "dock"]
    id: Id
    closed: bool = False
    robots: list[Id] = []
    places: list[str] = []
    more: Count = 0


class DryRunOutcome(Message, frozen=True, kw_only=True):
    """What a change would do on this version of the map.

    `unfinished`: robots whose paths were not searched, because the time for that was over.
    """

    map_epoch: Count
    map_seq: Count
    robots: list[RobotOutcome] = []
    cut_off: list[ReachOutcome] = []
    connected: list[ReachOutcome] = []
    unfinished: list[Id] = []


class DryRunReply(Message, frozen=True, kw_only=True):
    """The outcome, or why there is none: `stale` (the map has changed: make the request again), or a refusal."""

    outcome: DryRunOutcome | None = None
    stale: bool = False
    refusal: Refusal | None = None


class GoalOutcome(Message, frozen=True, kw_only=True):
    """The path that a robot would get to a goal from where it stands, or why it would get none."""

    robot: Id
    map_epoch: Count
    map_seq: Count
    path: PathOutcome
    points: Points = []
