"""State, observations and commands of a robot (zenoh, msgpack)."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from fog_contracts.messages.basics import (
    AngularSpeed,
    Boot,
    Count,
    Epochs,
    Finite,
    Id,
    Message,
    Metres,
    PointXY,
    Pose,
    Radians,
    Seconds,
    Sentence,
    Speed,
    Stamp,
    Trace,
)


class RobotPose(Message, frozen=True, kw_only=True):
    """A robot's estimated pose and twist; `covariance` is row-major 3 x 3 over (x, y, theta).

    `clock` is the agent's own monotonic clock, which tells how late a pose is; 0: it does not say.
    """

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
    clock: Seconds = 0.0


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
