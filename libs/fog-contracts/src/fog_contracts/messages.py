"""Every message that crosses a process border, as frozen types; units are metres, radians and seconds, frame `map`.

Stamps are seconds since the Unix epoch by the sender's clock (`fog_runtime.clock.Clock.stamp`); they serve traces and
people. Freshness is never computed from them but from the receiver's own monotonic clock.
"""

from typing import Annotated, Any, Final, Literal

from msgspec import Meta, Struct, field
from msgspec.structs import replace

from fog_contracts.costs import PENALTY_FACTOR_MAX

# The lookahead refuses a line feed at the end, which a bare $ accepts.
Id = Annotated[str, Meta(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$(?!\n)")]
# Bounds also refuse NaN and infinity: no comparison with a bound holds for NaN.
Finite = Annotated[float, Meta(ge=-1e12, le=1e12)]
# The units appear in the generated documents and in the firmware's header.
Metres = Annotated[float, Meta(ge=-100_000.0, le=100_000.0, extra={"unit": "m"})]
Radians = Annotated[float, Meta(ge=-1_000.0, le=1_000.0, extra={"unit": "rad"})]
Speed = Annotated[float, Meta(ge=-10.0, le=10.0, extra={"unit": "m/s"})]
AngularSpeed = Annotated[float, Meta(ge=-10.0, le=10.0, extra={"unit": "rad/s"})]
Stamp = Annotated[float, Meta(ge=0.0, le=1e12, extra={"unit": "s"})]
Seconds = Annotated[float, Meta(ge=0.0, le=1e12, extra={"unit": "s"})]
"""A reading of a monotonic clock, which means nothing to another host."""
TimeToLive = Annotated[float, Meta(gt=0.0, le=1e9, extra={"unit": "s"})]
Boot = Annotated[str, Meta(max_length=32)]
"""Id of one run of a process: random, so that no other run has it."""
Count = Annotated[int, Meta(ge=0, le=2**53)]
Sent = tuple[Count, Seconds]
"""When a message was sent: the id of a monotonic clock of its sender, and that clock's reading. How late messages come
is computed from it (`fog_contracts.liveness.Delays`)."""
Hash = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Cells = Annotated[int, Meta(ge=0, le=65_535, extra={"unit": "cells"})]
SENTENCE_MAX: Final = 500
"""Characters of the longest sentence."""
Sentence = Annotated[str, Meta(max_length=SENTENCE_MAX)]
PointXY = tuple[Metres, Metres]
Ring = Annotated[list[PointXY], Meta(min_length=3, max_length=500)]

AreaState = Literal["blocked", "clear", "unknown"]
SonarStatus = Literal["ok", "no_echo", "stuck"]
CalibrationResult = Literal["done", "stuck", "unsteady", "too_near"]


class Message(Struct, frozen=True, kw_only=True):
    """Base of all messages: frozen, fields by name; unknown fields are ignored when decoding."""


class Pose(Message, frozen=True, kw_only=True):
    """Position and heading in the frame `map`."""

    x: Metres
    y: Metres
    theta: Radians


Epochs = dict[Id, Count]
"""The highest epoch received of each service, by its role: whoever leads it next needs a higher one."""


class Leader(Message, frozen=True, kw_only=True):
    """The announcement of the one process of a service that acts; `holder` identifies it."""

    epoch: Count
    holder: Annotated[str, Meta(min_length=1, max_length=100)]
    epochs: Epochs = {}


# --- Sensor side (MQTT, JSON) ---------------------------------------------------------------------------------------


class NodeReading(Message, frozen=True, kw_only=True):
    """One measurement of a node: all its sonars once. A range that is missing is null, never 0."""

    seq: Count
    boot: Count
    uptime_ms: Count
    range_m: Annotated[list[Annotated[float, Meta(gt=0.0, le=20.0)] | None], Meta(min_length=1, max_length=8)]
    status: Annotated[list[SonarStatus], Meta(min_length=1, max_length=8)]
    state: AreaState
    rssi: Annotated[int, Meta(ge=-200, le=100)] | None = None
    fw: Annotated[str, Meta(max_length=64)] = ""

    def __post_init__(self) -> None:
        if len(self.range_m) != len(self.status):
            raise ValueError(f"range_m has {len(self.range_m)} entries but status has {len(self.status)}")


class NodeValue(Message, frozen=True, kw_only=True):
    """A measured quantity (temperature, gas, ...) that is a hazard above the aggregator's threshold."""

    seq: Count
    boot: Count
    kind: Id
    value: Annotated[float, Meta(ge=-1e9, le=1e9)]
    unit: Annotated[str, Meta(max_length=16)]


class NodeConfig(Message, frozen=True, kw_only=True):
    """Settings of a node: per sonar the range below which an echo means `blocked`."""

    version: Count
    range_limit_m: Annotated[list[Annotated[float, Meta(gt=0.0, le=20.0)]], Meta(min_length=1, max_length=8)]
    no_echo_is_clear: Annotated[list[bool], Meta(min_length=1, max_length=8)]
    pause_ms: Annotated[int, Meta(ge=10, le=60_000)] = 50


class NodeCalibration(Message, frozen=True, kw_only=True):
    """What a node has learned on command; it holds until a configuration with another version comes.

    Per sonar: how it ended, the settings that count now, and the pulse (us, 0: none) by which its board says "no echo".
    """

    boot: Count
    config_version: Count
    result: Annotated[list[CalibrationResult], Meta(min_length=1, max_length=8)]
    range_limit_m: Annotated[list[Annotated[float, Meta(gt=0.0, le=20.0)]], Meta(min_length=1, max_length=8)]
    no_echo_is_clear: Annotated[list[bool], Meta(min_length=1, max_length=8)]
    no_echo_us: Annotated[list[Annotated[int, Meta(ge=0, le=80_000)]], Meta(min_length=1, max_length=8)]


class NodeUpdate(Message, frozen=True, kw_only=True):
    """A node's next firmware: where it is, and its maker's signature (ECDSA P-256) of number, board, size, SHA-256."""

    number: Annotated[int, Meta(ge=1, le=2**31 - 1)]
    board: Id
    size: Annotated[int, Meta(ge=1, le=4_194_304)]
    sha256: Annotated[str, Meta(min_length=64, max_length=64)]
    signature: Annotated[str, Meta(min_length=16, max_length=144)]
    url: Annotated[str, Meta(min_length=8, max_length=200)]


class Trace(Message, frozen=True, kw_only=True):
    """Stamps of the stages that one hazard passes, from first reading to first wheel command; 0 = not reached yet."""

    area: Id
    epoch: Count
    seq: Count
    first_reading: Stamp = 0.0
    confirmed: Stamp = 0.0
    costmap_published: Stamp = 0.0
    plan_published: Stamp = 0.0
    path_received: Stamp = 0.0
    first_command: Stamp = 0.0


SEVERITY: Final = {"clear": 0, "unknown": 1, "unknown_after_blocked": 2, "blocked": 3}
"""Severity of an area's hazard by its state; an area that was blocked before it became unknown ranks higher."""


Author = Annotated[str, Meta(max_length=100)]
"""The name of the token with which a change was made."""
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


class UnknownPolicy(Message, frozen=True, kw_only=True):
    """When an area's nodes and sources are unknown, and the cost of an unknown area that was clear before.

    One is unknown when it is silent for `silent_after_s` (a source with a period of its own: three of these), and when
    it flaps: when it changes between blocked and clear more than `max_changes` times within a minute, until it keeps
    one state for 5 s.
    """

    silent_after_s: Annotated[float, Meta(ge=0.5, le=3600.0)] = 3.0
    penalty: Annotated[int, Meta(ge=0, le=254)] = 200
    max_changes: Annotated[int, Meta(ge=1, le=1000)] = 30


class AlertPolicy(Message, frozen=True, kw_only=True):
    """After how long (s) people are told that an area is unknown or blocked, or a node or source unknown; 0: never."""

    unknown_after_s: Seconds = 300.0
    blocked_after_s: Seconds = 3600.0
    node_after_s: Seconds = 120.0


Topic = Annotated[str, Meta(min_length=1, max_length=200)]
Pointer = Annotated[str, Meta(max_length=200, pattern=r"^(/([^/~]|~[01])*)*$(?!\n)")]
"""A JSON pointer (RFC 6901); the empty one is the whole document."""
Meaning = Annotated[list[str | bool | float], Meta(max_length=20)]
"""Values that mean the same; texts are compared without regard to upper and lower case."""


class Limits(Message, frozen=True, kw_only=True):
    """What a number means: blocked above `above` or below `below`, clear when it is back by `hysteresis`.

    Outside of `minimum` to `maximum` it is implausible. All in the sensor's own unit.
    """

    above: Finite | None = None
    below: Finite | None = None
    hysteresis: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0
    minimum: Finite | None = None
    maximum: Finite | None = None


class Availability(Message, frozen=True, kw_only=True):
    """A topic that says whether a sensor is connected; without `pointer` its payload is plain text."""

    topic: Topic
    pointer: Pointer | None = None
    online: Meaning = field(default_factory=lambda: ["online"])
    offline: Meaning = field(default_factory=lambda: ["offline"])


Penalty = Annotated[int, Meta(ge=1, le=253)]
"""The cost of an area that a blocked sensor makes costly instead of impassable."""


class Quantity(Message, frozen=True, kw_only=True):
    """What a node of Fognav measures besides ranges: its id, and the `kind` of its `NodeValue`, such as temperature."""

    node: Id
    kind: Id


class Source(Message, frozen=True, kw_only=True):
    """Any sensor that speaks MQTT, or a quantity that a node measures, as evidence for an area.

    `topic` may contain wildcards. `pointer` is where its payload, a JSON document, has the value (None: the payload is
    plain text); `blocked` and `clear` are what it means, or `number` for a number. A `profile` gives all that is not
    given here, with `device` for the name in its topics. `period_s` is the time between two messages; without one the
    sensor publishes on change, and needs an `availability`. With a `penalty`, a blocked sensor makes the area costly
    instead of impassable. `debounce` as in an area; without it each message counts. A `quantity` has no topic, but the
    limits of its `number`.
    """

    id: Id
    profile: Id | None = None
    device: Annotated[str, Meta(max_length=100)] = ""
    topic: Topic | None = None
    pointer: Pointer | None = None
    blocked: Meaning = []
    clear: Meaning = []
    number: Limits | None = None
    availability: Availability | None = None
    period_s: Annotated[float, Meta(gt=0.0, le=86_400.0, extra={"unit": "s"})] | None = None
    penalty: Penalty | None = None
    debounce: dict[str, Any] = {}
    quantity: Quantity | None = None


class FusionPolicy(Message, frozen=True, kw_only=True):
    """When an area's nodes and sources together mean blocked: `any`, `all`, or those whose weights reach `at_least`.

    `quorum` counts them; `weighted` adds their `weights` (1 for one that is not named). The area is clear once those
    that are unknown could not make it blocked.
    """

    rule: Literal["any", "all", "quorum", "weighted"] = "any"
    at_least: Annotated[float, Meta(gt=0.0, le=1000.0)] = 1.0
    weights: dict[Id, Annotated[float, Meta(ge=0.0, le=1000.0)]] = {}


class AreaDefinition(Message, frozen=True, kw_only=True):
    """An area: its polygon, the nodes and sources that watch it, and how their readings are debounced and fused.

    `number` identifies it on the thesis's topics. `debounce` holds the rule's name (`rule`) and its options. With a
    `penalty`, nodes and sources make it costly instead of impassable. `epoch` is that of the aggregator that publishes
    it.
    """

    id: Id
    label: Annotated[str, Meta(max_length=100)] = ""
    polygon: Ring
    nodes: list[Id] = []
    sources: list[Source] = []
    number: Annotated[int, Meta(ge=0, le=9999)] | None = None
    debounce: dict[str, Any] = {}
    fusion: FusionPolicy = FusionPolicy()
    unknown: UnknownPolicy = UnknownPolicy()
    alerts: AlertPolicy = AlertPolicy()
    penalty: Penalty | None = None
    version: Count = 0
    removed: bool = False
    epoch: Count = 0


AlertKind = Literal["area-unknown", "area-blocked", "node-unknown"]


class Alert(Message, frozen=True, kw_only=True):
    """A condition of an area, or of a node or source in it, that has lasted for as long as the area's policy allows.

    It lasts since `since` and was raised at `raised`, or acknowledged by an operator at `acknowledged_at`. `reason` is
    the newest one.
    """

    id: Annotated[str, Meta(max_length=100)]
    kind: AlertKind
    area: Id
    node: Id | None = None
    reason: Annotated[str, Meta(max_length=200)]
    since: Stamp
    raised: Stamp
    acknowledged_by: Author | None = None
    acknowledged_at: Stamp | None = None


class AlertList(Message, frozen=True, kw_only=True):
    """The present alerts, those that nobody has acknowledged first: the first of very many only.

    `total` counts all of them, `unseen` those that nobody has acknowledged.
    """

    epoch: Count
    total: Count
    unseen: Count
    alerts: list[Alert]


MAX_CELLS: Final = 100_000_000
"""Limit of a map (500 m x 500 m at 5 cm), so that a damaged or hostile snapshot can't exhaust the memory."""

# --- Map (zenoh, msgpack) -------------------------------------------------------------------------------------------


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


# --- Planner (zenoh, msgpack) ---------------------------------------------------------------------------------------

PLAN_CODES = {
    0: "OK",
    203: "START_OUTSIDE_MAP",
    204: "GOAL_OUTSIDE_MAP",
    205: "START_OCCUPIED",
    206: "GOAL_OCCUPIED",
    207: "TIMEOUT",
    208: "NO_VALID_PATH",
}
"""Nav2's error codes of `ComputePathToPose`, with their names."""

PlanCode = Literal[0, 203, 204, 205, 206, 207, 208]
Points = Annotated[list[PointXY], Meta(max_length=100_000)]


class Refusal(Message, frozen=True, kw_only=True):
    """Why there is no path: Nav2's code, a sentence, what blocks the path, and the nearest reachable point."""

    code: PlanCode
    reason: Sentence
    causes: list[Cause] = []
    nearest: PointXY | None = None

    @property
    def name(self) -> str:
        """Nav2's name of the code."""
        return PLAN_CODES[self.code]


class PlanRequest(Message, frozen=True, kw_only=True):
    """Request for a path between two poses, without side effects."""

    start: Pose
    goal: Pose


class PlanReply(Message, frozen=True, kw_only=True):
    """A path (points at least 5 cm apart, frame `map`) with its length in metres, or the refusal.

    `retry_after`: the planner was too busy to look for a path; ask again after so many seconds.
    """

    points: Points = []
    length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})] = 0.0
    cost: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0
    map_epoch: Count = 0
    map_seq: Count = 0
    refusal: Refusal | None = None
    retry_after: Annotated[float, Meta(ge=0.0, le=3600.0, extra={"unit": "s"})] | None = None


class RobotGoal(Message, frozen=True, kw_only=True):
    """The mission of a robot; `pose` is null when it has none (cancelled or reached).

    `any_heading`: the robot may arrive with any heading, that of `pose` does not count.
    """

    goal_id: Annotated[str, Meta(max_length=64)]
    pose: Pose | None
    any_heading: bool = False
    place: Id | None = None
    stamp: Stamp = 0.0
    planner_epoch: Count = 0


class RobotRelease(Message, frozen=True, kw_only=True):
    """How much of a path the robot may drive (m), twice a second: the path is still good on this version of the map.

    It keeps the path of this plan alive, and no other: a robot that does not have it hears nothing from its planner.
    """

    plan_id: Count
    planner_epoch: Count
    released_length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
    map_epoch: Count
    map_seq: Count
    sent: Sent | None = None


class RobotPath(Message, frozen=True, kw_only=True):
    """The path to the goal, or why there is none; published once per plan, and again until the robot names its plan.

    `points` are the corners, joined by straight lines (`fog_contracts.geometry.sampled` puts points between them). The
    robot may drive the first `released_length` metres without hearing from the planner again; `RobotRelease` extends
    that while all is well.
    """

    plan_id: Count
    planner_epoch: Count
    goal_id: Annotated[str, Meta(max_length=64)]
    points: Points
    map_epoch: Count
    map_seq: Count
    released_length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
    goal_theta: Radians | None = None
    refusal: Refusal | None = None
    traces: list[Trace] = []
    stamp: Stamp = 0.0
    sent: Sent | None = None

    def after(self, release: RobotRelease) -> "RobotPath":
        """Return the path with a release of its plan; that of another plan changes nothing."""
        if (release.planner_epoch, release.plan_id) != (self.planner_epoch, self.plan_id):
            return self
        return replace(
            self,
            released_length=release.released_length,
            map_epoch=release.map_epoch,
            map_seq=release.map_seq,
        )


# --- Robot (zenoh, msgpack) -----------------------------------------------------------------------------------------


class RobotPose(Message, frozen=True, kw_only=True):
    """A robot's estimated pose and twist; `covariance` is row-major 3 x 3 over (x, y, theta)."""

    x: Metres
    y: Metres
    theta: Radians
    covariance: Annotated[list[Finite], Meta(min_length=9, max_length=9)]
    v: Speed
    w: AngularSpeed
    radius: Annotated[float, Meta(gt=0.0, le=2.0, extra={"unit": "m"})]
    height: Annotated[float, Meta(gt=0.0, le=3.0, extra={"unit": "m"})]
    stamp: Stamp
    localized: bool = True


Mode = Literal["INIT", "NORMAL", "DEGRADED", "HOLD", "PROTECTIVE_STOP", "FAULT", "EGRESS", "DOCK"]


class LoopHealth(Message, frozen=True, kw_only=True):
    """How well the agent's loops keep their periods (seconds) since its start.

    `late_stops`: protective stops that a delay of its computer explains; they do not count towards a fault.
    """

    control_p99_s: Finite = 0.0
    stream_p99_s: Finite = 0.0
    late: Count = 0
    late_stops: Count = 0


Charging = Literal["no", "reconditioning", "bulk", "trickle", "waiting", "fault"]
"""What a charger does; `waiting`: it is connected and gives no current."""


class Power(Message, frozen=True, kw_only=True):
    """A robot's battery and charger as its base measures them; None for what it does not measure.

    `current_a` is positive into the battery.
    """

    voltage_v: Annotated[Finite, Meta(extra={"unit": "V"})] | None = None
    current_a: Annotated[Finite, Meta(extra={"unit": "A"})] | None = None
    charge_ah: Annotated[Finite, Meta(extra={"unit": "Ah"})] | None = None
    capacity_ah: Annotated[Finite, Meta(extra={"unit": "Ah"})] | None = None
    temperature_c: Annotated[Finite, Meta(extra={"unit": "°C"})] | None = None
    charging: Charging | None = None


Strength = Annotated[int, Meta(ge=0, le=4095)]


ProfileName = Literal["default", "full", "fog"]
"""How a robot navigates: on its own; on its own with the fog's hazards; or by the fog's map and paths."""


class RobotState(Message, frozen=True, kw_only=True):
    """A robot's mode with its reasons, the map version and plan that it follows, and the epochs that it received.

    `boot` is the id of this run of its agent, `clock` the agent's own monotonic clock: a command names both.
    `proximity` has the strength of each of the base's light sensors, from the left to the right; empty without any.
    `metrics` is the address (host:port) at which Prometheus reaches the robot's metrics; empty if it can't.
    `docked`: it stands on its dock. `wants_dock`: it asks the planner for the goal in front of its dock.
    `places`: where on the map it may be, most likely first, while its scans do not decide; empty otherwise.
    """

    mode: Mode
    reasons: list[Sentence]
    enabled: bool
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] | None
    goal_id: Annotated[str, Meta(max_length=64)] | None
    map_epoch: Count
    map_seq: Count
    plan_id: Count | None
    planner_epoch: Count | None = None
    goal_reached: bool = False
    goal_distance: Annotated[Finite, Meta(extra={"unit": "m"})] | None = None
    loop: LoopHealth = LoopHealth()
    traces: list[Trace] = []
    stamp: Stamp = 0.0
    epochs: Epochs = {}
    boot: Boot = ""
    clock: Seconds = 0.0
    power: Power | None = None
    proximity: Annotated[list[Strength], Meta(max_length=16)] = []
    profile: ProfileName = "fog"
    metrics: Annotated[str, Meta(max_length=128)] = ""
    docked: bool = False
    wants_dock: bool = False
    places: Annotated[list[Pose], Meta(max_length=8)] = []


VIEW_SECTORS: Final = 180
"""Sectors of a robot's view, each 2 degrees wide, counted counter-clockwise from the map's x axis."""


REACH_UNIT_M: Final = 0.05
"""Unit of a view's ranges, which end at 255 of them: 12.75 m."""


class View(Message, frozen=True, kw_only=True):
    """What a robot's lidar sees from (x, y) (m, frame `map`).

    `reach` has a byte for each sector: the nearest range in units of 5 cm, rounded down, 0 without any echo. Up to that
    range the floor is free at the lidar's height; a sector without an echo carries no information.
    """

    x: Metres
    y: Metres
    reach: Annotated[bytes, Meta(min_length=180, max_length=180)]


class RobotObstacles(Message, frozen=True, kw_only=True):
    """Points (m, frame `map`) that a robot's lidar sees and the map does not contain.

    They hold until a robot's view shows that they are gone, and at most for `ttl` seconds after they were last seen.
    """

    points: Annotated[list[PointXY], Meta(max_length=2_000)]
    stamp: Stamp
    ttl: Annotated[float, Meta(gt=0.0, le=600.0, extra={"unit": "s"})]
    view: View | None = None


CommandKind = Literal[
    "enable",
    "disable",
    "cancel",
    "egress",
    "dock",
    "undock",
    "back_off",
    "turn",
    "advance",
    "reset",
    "initial_pose",
    "profile_default",
    "profile_full",
    "profile_fog",
]


class RobotCommand(Message, frozen=True, kw_only=True):
    """An operator's command: single-use (`nonce`), valid 5 s from `issued_at`, signed (`fog_contracts.commands`).

    `boot` and `issued_at` are `boot` and `clock` of the robot's latest state: the command's age is measured by the
    robot's clock alone, and another run of the agent refuses it. What stops the robot (`disable`,
    `cancel`) is carried out unsigned, too, and whatever the other fields say.
    """

    kind: CommandKind
    robot: Id
    operator: Annotated[str, Meta(min_length=1, max_length=100)]
    nonce: Annotated[str, Meta(min_length=16, max_length=64)]
    issued_at: Seconds = 0.0
    boot: Boot = ""
    pose: Pose | None = None
    signature: Annotated[bytes, Meta(max_length=64)] = b""


class CommandReply(Message, frozen=True, kw_only=True):
    """Whether the command was accepted, and if not, why."""

    accepted: bool
    reason: Sentence


class EgressRequest(Message, frozen=True, kw_only=True):
    """Request of a robot inside a blocked area for a path that leaves it."""

    robot: Id
    pose: Pose


# --- Simulation (zenoh, msgpack): not part of a real system ---------------------------------------------------------


class SimObstacle(Message, frozen=True, kw_only=True):
    """An obstacle on the simulated floor: an upright prism with this polygon and height (m)."""

    id: Id
    polygon: Ring
    height: Annotated[float, Meta(gt=0.0, le=5.0, extra={"unit": "m"})] = 1.0


class SimTruth(Message, frozen=True, kw_only=True):
    """Ground truth of the simulated world; `clearance` is the distance (m) from the robot's rim to what is nearest."""

    robot: Id
    x: Metres
    y: Metres
    theta: Radians
    left: Speed
    right: Speed
    distance: Annotated[float, Meta(ge=0.0, extra={"unit": "m"})]
    clearance: Annotated[float, Meta(extra={"unit": "m"})]
    min_clearance: Annotated[float, Meta(extra={"unit": "m"})]
    contacts: Count
    obstacles: list[SimObstacle] = []
    stamp: Stamp = 0.0
    sustained_speed: float = 1.0


class SimCommand(Message, frozen=True, kw_only=True):
    """Change the simulated world: place obstacles, remove them by id, move the robot elsewhere (`kidnap`)."""

    place: list[SimObstacle] = []
    remove: list[Id] = []
    kidnap: Pose | None = None
    lidar_silent: bool | None = None
    nodes_silent: list[Id] | None = None
