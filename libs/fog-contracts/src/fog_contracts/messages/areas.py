"""Areas: the sensors that watch them, their policies, their hazards as they are announced, alerts (MQTT, JSON)."""

from collections.abc import Iterable
from typing import Annotated, Any, Final, Literal

from msgspec import Meta, field

from fog_contracts.messages.basics import (
    AreaState,
    Author,
    Code,
    Count,
    Described,
    Finite,
    Hash,
    Id,
    Message,
    Ring,
    Seconds,
    Sentence,
    Stamp,
    TimeToLive,
    Trace,
)


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
    """A topic that says whether a sensor is connected, as plain text or, with `pointer`, in a JSON document.

    `recalls`: it is a gateway's, which repeats what its sensors said before it went offline once it is online again.
    """

    topic: Topic
    pointer: Pointer | None = None
    online: Meaning = field(default_factory=lambda: ["online"])
    offline: Meaning = field(default_factory=lambda: ["offline"])
    recalls: bool = False


Penalty = Annotated[int, Meta(ge=1, le=253)]
"""The cost of an area that a blocked sensor makes costly instead of impassable."""


FreeWidth = Annotated[float, Meta(ge=0.2, le=5.0, extra={"unit": "m"})]
"""How wide a part of a blocked area must be that its sensors show free, for robots to pass it slowly."""


class Quantity(Message, frozen=True, kw_only=True):
    """What a node of Fognav measures besides ranges: its id, and the `kind` of its `NodeValue`, such as temperature."""

    node: Id
    kind: Id


class Source(Message, frozen=True, kw_only=True):
    """Any sensor that speaks MQTT, or a quantity that a node measures, as evidence for an area.

    `topic` is one sensor's, without wildcards. `pointer` is where its payload, a JSON document, has the value (None:
    the payload is plain text; of several, the first that leads to one); `blocked` and `clear` are what it means, or
    `number` for a number, and `no_value` what a message without a number means: `clear` counts only once it has
    measured something since it was unknown. A `profile` gives all that is not given here, with `device` for the name in
    its topics. `period_s` is the time between two messages; without one the sensor publishes on change, and needs an
    `availability`. While not all of these have said that it is connected, it clears nothing. With a `penalty`, a
    blocked sensor makes the area costly instead of impassable. `debounce` as in an area; without it each message
    counts. A `quantity` has no topic, but the limits of its `number`.
    """

    id: Id
    profile: Id | None = None
    device: Annotated[str, Meta(max_length=100)] = ""
    topic: Topic | None = None
    pointer: Pointer | Annotated[list[Pointer], Meta(min_length=1, max_length=5)] | None = None
    blocked: Meaning = []
    clear: Meaning = []
    number: Limits | None = None
    no_value: AreaState = "unknown"
    availability: Availability | Annotated[list[Availability], Meta(max_length=5)] | None = None
    period_s: Annotated[float, Meta(gt=0.0, le=86_400.0, extra={"unit": "s"})] | None = None
    penalty: Penalty | None = None
    debounce: dict[str, Any] = {}
    quantity: Quantity | None = None

    @property
    def pointers(self) -> list[str | None]:
        """Where the value may be, in the order in which to look; None: the payload is the value."""
        return [*self.pointer] if isinstance(self.pointer, list) else [self.pointer]

    @property
    def availabilities(self) -> list[Availability]:
        """What says whether its sensor is connected; all must."""
        found = self.availability
        return found if isinstance(found, list) else [] if found is None else [found]


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

    With `cone_of` the polygon is what the sonars of that node see. `number` identifies it on the thesis's topics.
    `debounce` holds the rule's name (`rule`) and its options. With a `penalty`, nodes and sources make it costly
    instead of impassable. With a `free_width`, robots may pass slowly where sonars hear the far wall while the area is
    blocked, if that part is so wide. `epoch` is that of the aggregator that publishes it.
    """

    id: Id
    label: Annotated[str, Meta(max_length=100)] = ""
    polygon: Ring
    cone_of: Id | None = None
    nodes: list[Id] = []
    sources: list[Source] = []
    number: Annotated[int, Meta(ge=0, le=9999)] | None = None
    debounce: dict[str, Any] = {}
    fusion: FusionPolicy = FusionPolicy()
    unknown: UnknownPolicy = UnknownPolicy()
    alerts: AlertPolicy = AlertPolicy()
    penalty: Penalty | None = None
    free_width: FreeWidth | None = None
    version: Count = 0
    removed: bool = False
    epoch: Count = 0


SEVERITY: Final = {"clear": 0, "unknown": 1, "unknown_after_blocked": 2, "blocked": 3}
"""Severity of an area's hazard by its state; an area that was blocked before it became unknown ranks higher."""
PASSABLE_PENALTY: Final = 200
"""The highest cost of an area that an operator declared clear: robots prefer other ways, but can pass."""
AREAS_MAX: Final = 1000
"""Areas of a site: so many fit into one heartbeat of the aggregator, whatever their ids."""

OverrideState = Literal["blocked", "clear"]
OverrideReason = Annotated[str, Meta(min_length=1, max_length=200)]
"""Why an operator overrides an area, for other people."""


class HazardOverride(Message, frozen=True, kw_only=True):
    """An operator's override of an area, which counts instead of its nodes' for a time: `ttl_s` from `set_at` on.

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
    declared the area clear, which nobody measures (ADR 16). `free`: outlines in a blocked area that its sensors show
    free, of an area with a `free_width`. `code` identifies the `cause` (`NodeCode`) if it is that of
    the node or source `decided_by`.
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
    code: Code = ""
    decided_by: Id | None = None
    free: Annotated[list[Ring], Meta(max_length=64)] = []


class AggregatorHeartbeat(Message, frozen=True, kw_only=True):
    """The aggregator's sign of life, and its list of every area: a hazard that it does not list is not its own.

    `areas` has the `seq` of each area's announced hazard (0: none yet), `digest` (`hazards_digest`) covers these
    hazards. Without `complete` there may be further areas, whose records are not loaded yet. `uptime` is
    the sender's monotonic clock with an arbitrary origin; how late a heartbeat arrives is computed from it, never from
    `stamp`.
    """

    epoch: Count
    areas: dict[Id, Count]
    complete: bool
    digest: Hash
    uptime: Annotated[float, Meta(ge=0.0, le=1e12, extra={"unit": "s"})]
    stamp: Stamp


_HASH_BITS = 63


def is_relief(hazard: AreaHazard, before: AreaHazard | None) -> bool:
    """Whether a hazard allows robots more than the one before (an area without one counts as forbidden)."""
    if before is None:
        return hazard.state == "clear"
    if hazard.penalty < before.penalty or any(part not in before.free for part in hazard.free):
        return True
    return hazard.state == "clear" and before.state != "clear"


def hazards_digest(hazards: Iterable[AreaHazard]) -> int:
    """Return a 63-bit hash of the hazards' areas, seqs, states and penalties; their order does not matter."""
    import hashlib  # noqa: PLC0415  # the guardian loads messages, too, and never needs it

    lines = sorted(f"{h.area} {h.seq} {h.state} {h.penalty}" + (f" {h.free}" if h.free else "") for h in hazards)
    whole = hashlib.blake2b("\n".join(lines).encode(), digest_size=8).digest()
    return int.from_bytes(whole, "big") >> (64 - _HASH_BITS)


class NodeCode(Described):
    """Why a node or source of an area is blocked, clear or unknown."""

    # what it measures
    SOMETHING_NEAR = "something_near", "an echo is nearer than its limit"
    NOTHING_NEAR = "nothing_near", "no echo is nearer than its limit"
    SEES_ROBOT = "sees_robot", "its echo is a robot's, by the robot's pose"
    REPORTED = "reported", "it reports its state itself"
    BEYOND_LIMITS = "beyond_limits", "its number is beyond its limits"
    WITHIN_LIMITS = "within_limits", "its number is within its limits"
    MEASURES_NOTHING = "measures_nothing", "it measures nothing, which has the meaning that its settings say"
    BLOCKED_BEFORE = "blocked_before", "the area was blocked before the restart"
    # why nobody knows
    NOT_HEARD = "not_heard", "no reading was received yet"
    SILENT = "silent", "it has been silent for too long"
    OFFLINE = "offline", "it went offline"
    CONNECTION_LOST = "connection_lost", "the connection to the broker was lost, and it tells only changes"
    NOT_CONNECTED_YET = "not_connected_yet", "it reports clear, and nobody says yet that it is connected"
    FLAPS = "flaps", "it changes too often"
    CONTRADICTORY = "contradictory", "its readings contradict one another, or its state its ranges"
    POSE_LATE = "pose_late", "it saw a robot whose pose came late"
    ROBOT_STAYS = "robot_stays", "a robot has stood before it for too long"
    REPORTS_UNKNOWN = "reports_unknown", "it reports unknown"
    ECHO_STUCK = "echo_stuck", "the echo line of a sonar is stuck"
    NO_ECHO = "no_echo", "no echo where there should be one, as if it were dead or covered"
    IMPLAUSIBLE = "implausible", "what it measures can't be"
    SONARS_DIFFER = "sonars_differ", "it has other sonars than the site says"
    NOT_UNDERSTOOD = "not_understood", "its message is not in its format, or means neither blocked nor clear"
    NO_LIMITS = "no_limits", "it has no limits for its number"


AlertKind = Literal["area-unknown", "area-blocked", "node-unknown"]


class Alert(Message, frozen=True, kw_only=True):
    """A condition of an area, or of a node or source in it, that has lasted for as long as the area's policy allows.

    It lasts since `since` and was raised at `raised`, or acknowledged by an operator at `acknowledged_at`. `reason` is
    the newest one, `code` its identifier if it is a node's (`NodeCode`).
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
    code: Code = ""


class AlertList(Message, frozen=True, kw_only=True):
    """The present alerts, those that nobody has acknowledged first: the first of very many only.

    `total` counts all of them, `unseen` those that nobody has acknowledged.
    """

    epoch: Count
    total: Count
    unseen: Count
    alerts: list[Alert]
