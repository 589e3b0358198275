"""A site as `site.toml` describes it: map, places, areas, nodes, robots and markers; lengths in m, angles in rad."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import Meta, field
from msgspec.structs import asdict

from fog_contracts.messages import (
    AlertPolicy,
    AreaDefinition,
    FreeWidth,
    FusionPolicy,
    Id,
    Message,
    Metres,
    Penalty,
    Place,
    Pose,
    Radians,
    Ring,
    Source,
    TimeToLive,
    UnknownPolicy,
    ZoneKind,
)

Options = TypeVar("Options", bound=msgspec.Struct)


class OptionError(ValueError):
    """An unknown, missing or invalid option: `field` is its name (empty: the whole mapping), `problem` says why."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}" if field else problem)
        self.field = field
        self.problem = problem


def read_options(kind: type[Options], given: Mapping[str, Any]) -> Options:
    """Return the options as `kind`; raises `OptionError` for one that is unknown or has a wrong value."""
    known = [field.encode_name for field in msgspec.structs.fields(kind)]
    for name in given:
        if name not in known:
            raise OptionError(name, f"there is no such option (known: {', '.join(known) or 'none'})")
    try:
        return msgspec.convert(dict(given), kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        raise OptionError(path.strip("`").removeprefix("$").lstrip("."), problem) from error


STAGING_M: Final = 0.7
"""A robot looks for its dock from this far in front of its pose on the dock."""


def learned_share(seen: int, samples: int) -> float:
    """Return the share of what was seen in so many of some samples: the middle of its 95 % interval.

    Two more of either kind make that (Agresti and Coull 1998): none of 256 is 0.8 %, not 0. So a rare share is rather
    taken for too high than for too low, by which what was rare in a short time would count as impossible.
    """
    return (seen + 2) / (samples + 4)


class Sonar(Message, frozen=True, kw_only=True):
    """One sonar of a node: its direction relative to the node's, and the calibrated range limit.

    An echo nearer than `range_limit` means `blocked`. One from beyond `range_max`, the farthest that the free area
    gives, means `unknown`: something before it reflects the sound away; None: any echo from beyond the limit is clear.
    `no_echo_is_clear` is true only where calibration recorded that nothing is in range; elsewhere the opposite wall
    normally echoes, and a missing echo means `unknown`. A node of which no sonar hears anything is never clear.
    `false_echo_rate`: the share of readings of the free area with an echo nearer than the limit, as its calibration
    showed it. `time_of_flight`: it measures by light.
    """

    angle: Radians = 0.0
    range_limit: Annotated[float, Meta(gt=0.02, le=4.0)]
    range_max: Annotated[float, Meta(gt=0.02, le=20.0)] | None = None
    no_echo_is_clear: bool = False
    false_echo_rate: Annotated[float, Meta(gt=0.0, lt=1.0)] | None = None
    time_of_flight: bool = False

    def __post_init__(self) -> None:
        if self.range_max is not None and self.range_max <= self.range_limit:
            raise ValueError(
                f"range_max {self.range_max:g} must exceed range_limit {self.range_limit:g}: nothing is clear"
            )


class NodeSite(Message, frozen=True, kw_only=True):
    """A sensor node: position, direction (frame `map`), height above the floor, and the area that it watches.

    With a `penalty` it makes the area costly instead of impassable. `every_reading`: its board publishes every
    reading, as the thesis's; else ten after each change and then one a second. Simulated nodes do the same.
    """

    id: Id
    area: Id
    x: Metres
    y: Metres
    theta: Radians
    height: Annotated[float, Meta(gt=0.0, le=5.0)] = 0.3
    sonars: Annotated[list[Sonar], Meta(min_length=1, max_length=8)]
    penalty: Penalty | None = None
    every_reading: bool = False


class AreaSite(Message, frozen=True, kw_only=True):
    """A watched area: where it is, debounce (the name `rule` and that rule's options), number on the thesis's topics.

    It is a polygon, or what the sonars of one of its nodes see: then `cone_of` names the node, the file has no polygon,
    and loading the site fills it in.
    """

    id: Id
    label: str = ""
    polygon: Ring = field(default_factory=list)
    cone_of: Id | None = None
    number: Annotated[int, Meta(ge=0, le=9999)] | None = None
    debounce: dict[str, Any] = field(default_factory=dict)
    fusion: FusionPolicy = FusionPolicy()
    unknown: UnknownPolicy = UnknownPolicy()
    alerts: AlertPolicy = AlertPolicy()
    penalty: Penalty | None = None
    free_width: FreeWidth | None = None


class SourceSite(Source, frozen=True, kw_only=True):
    """A sensor that speaks MQTT, and the area that it watches."""

    area: Id

    @property
    def source(self) -> Source:
        """The source without its area, as the area's definition has it."""
        return Source(**{name: value for name, value in asdict(self).items() if name != "area"})


class ZoneSourceSite(Message, frozen=True, kw_only=True):
    """A system of others that may put zones on the map over MQTT, as the broker's user `id`, and what it may at most.

    `max_area`: of each zone (m²); `max_ttl_s`: how long each may last from now on; `per_minute`: messages. It may
    switch the sets of zones in `sets`.
    """

    id: Id
    label: str = ""
    kinds: list[ZoneKind] = field(default_factory=lambda: ["BLOCKED", "PENALTY", "SPEED_LIMIT"])
    max_zones: Annotated[int, Meta(ge=0, le=500)] = 10
    max_area: Annotated[float, Meta(gt=0.0, le=1e6)] = 50.0
    max_ttl_s: TimeToLive = 3600.0
    per_minute: Annotated[int, Meta(ge=1, le=600)] = 30
    sets: list[Id] = field(default_factory=list)


ON_DOCK: Final = "dock"
"""Where an idle robot goes that goes to its dock; no place may have this id then."""


class IdleSite(Message, frozen=True, kw_only=True):
    """Where a robot goes that has had no mission for `after_s` (s): `go` is `dock`, or the id of a place."""

    go: Id
    after_s: Annotated[float, Meta(ge=10.0, le=86_400.0)] = 300.0


class RobotSite(Message, frozen=True, kw_only=True):
    """A robot of this site: its start pose, and the radius and height of its body.

    `radius`: how far its body reaches from the point between its driven wheels. Nobody guesses it: a robot that takes
    itself for smaller than it is touches what it believes to pass.
    `dock`: its pose while it stands on its dock, facing it; None if it has none here. `idle`: where it goes without a
    mission; None: it stays where its last one ended.
    """

    id: Id
    start: Pose
    dock: Pose | None = None
    radius: Annotated[float, Meta(gt=0.0, le=2.0)]
    height: Annotated[float, Meta(gt=0.0, le=3.0)] = 0.35
    idle: IdleSite | None = None

    @property
    def staging(self) -> Pose | None:
        """The pose in front of the dock, facing it, from which the base finds it by itself; None without a dock."""
        if self.dock is None:
            return None
        x, y, theta = self.dock.x, self.dock.y, self.dock.theta
        return Pose(x=x - STAGING_M * math.cos(theta), y=y - STAGING_M * math.sin(theta), theta=theta)


BEFORE_MARKER_M: Final = (0.15, 0.3)
"""So far in front of a marker the floor is free. It hangs on the face of a wall, whose cells may reach past it."""


class MarkerSite(Message, frozen=True, kw_only=True):
    """A marker on a wall, by whose picture a robot with a camera knows where it is: an AprilTag of the family 36h11.

    id: what its pattern encodes. x, y: its centre on the wall's face; theta: where its face looks, away from the wall.
    size: the side of its black square.
    """

    id: Annotated[int, Meta(ge=0, le=586)]
    x: Metres
    y: Metres
    theta: Radians
    size: Annotated[float, Meta(ge=0.02, le=1.0)] = 0.16


class LiftSite(Message, frozen=True, kw_only=True):
    """A lift as this floor has it: all floors that it serves give it the same id, each its place on the own map.

    `cabin`: where a robot stands in it, facing out of its door. `wait`: where it waits before the door, facing it, out
    of the way of those who come out. `floors`: the sites' ids that it serves, this one's among them.
    """

    id: Id
    cabin: Pose
    wait: Pose
    floors: Annotated[list[Id], Meta(min_length=2, max_length=200)]


class DemoPlan(Message, frozen=True, kw_only=True):
    """The drive that the demo shows here: from one place to another, and the areas that may become blocked."""

    start: Id
    goal: Id
    areas: list[Id] = field(default_factory=list)


class VisitorsSite(Message, frozen=True, kw_only=True):
    """What visitors may use: `robots` lead them to public places; without any there are no visits."""

    robots: list[Id] = field(default_factory=list)


class Site(Message, frozen=True, kw_only=True):
    """A site as `site.toml` describes it.

    `layers` are those of the costmap, bottom first, each by name or as a table with `name` and the layer's own
    options; an empty list means the standard layers.
    """

    id: Id
    name: str = ""
    map: str = "map.yaml"
    places: dict[Id, Place] = field(default_factory=dict)
    areas: list[AreaSite] = field(default_factory=list)
    nodes: list[NodeSite] = field(default_factory=list)
    sources: list[SourceSite] = field(default_factory=list)
    zone_sources: list[ZoneSourceSite] = field(default_factory=list)
    robots: list[RobotSite] = field(default_factory=list)
    markers: list[MarkerSite] = field(default_factory=list)
    visitors: VisitorsSite = VisitorsSite()
    lifts: list[LiftSite] = field(default_factory=list)
    layers: list[str | dict[str, Any]] = field(default_factory=list)
    demo: DemoPlan | None = None

    @property
    def staging(self) -> dict[str, Pose]:
        """By robot, the pose in front of its dock; robots without a dock are left out."""
        return {robot.id: pose for robot in self.robots if (pose := robot.staging) is not None}

    @property
    def senders(self) -> list[str]:
        """The users of the broker that the site has besides roles: its nodes, and the sources of zones."""
        return [*(node.id for node in self.nodes), *(source.id for source in self.zone_sources)]

    def definitions(self) -> list[AreaDefinition]:
        """Return the areas as the aggregator publishes them, each with the nodes that watch it."""
        return [
            AreaDefinition(
                id=area.id,
                label=area.label,
                polygon=area.polygon,
                cone_of=area.cone_of,
                nodes=[node.id for node in self.nodes if node.area == area.id],
                sources=[source.source for source in self.sources if source.area == area.id],
                number=area.number,
                debounce=area.debounce,
                fusion=area.fusion,
                unknown=area.unknown,
                alerts=area.alerts,
                penalty=area.penalty,
                free_width=area.free_width,
            )
            for area in self.areas
        ]
