"""What people ask of a robot beside its missions: whether it is in service at all, and how its computer does."""

from typing import Annotated, Literal

from msgspec import Meta

from fog_contracts.messages.basics import Author, Described, Id, Message, Radians, Speed, Stamp
from fog_contracts.messages.maps import Shape

ServiceReason = Annotated[str, Meta(min_length=1, max_length=120)]


class OutOfService(Message, frozen=True, kw_only=True):
    """An operator keeps a robot out of service: it gets no goal from anybody until it is put back.

    It is no safety condition: a robot that is out of service may be enabled, driven by hand, and leave a blocked area
    on an operator's command. `id` is the record's version; `until` (s since the epoch) is when it ends by itself, None:
    when somebody ends it.
    """

    id: Annotated[str, Meta(max_length=64)]
    reason: ServiceReason
    by: Author
    since: Stamp
    until: Stamp | None = None


class ScheduleCode(Described):
    """Why a robot did not get a scheduled mission yet, where no problem, refusal or reason of the robot says so."""

    NOT_HEARD = "robot_not_heard", "the robot is not heard"
    HAS_MISSION = "robot_has_mission", "it has another mission"
    SERVES_VISITOR = "robot_serves_visitor", "it serves a visitor"
    CANT_DRIVE = "robot_cant_drive", "it can't drive now"
    PLANNER_AWAY = "planner_was_away", "the planner did not run, or its clock was not set"


CpuPercent = Annotated[float, Meta(ge=0.0, le=100_000.0, extra={"unit": "% of a core"})]
SignalLevel = Annotated[float, Meta(ge=-250.0, le=50.0, extra={"unit": "dBm"})]


class RobotVitals(Message, frozen=True, kw_only=True):
    """How a robot's computer does, once in two seconds.

    `cpu`: what each of the robot's processes has taken since the last message, in percent of one core. `wifi_dbm`: how
    strong its Wi-Fi is; null: it has none, or none that is connected.
    """

    cpu: Annotated[dict[Id, CpuPercent], Meta(max_length=8)]
    wifi_dbm: SignalLevel | None = None
    stamp: Stamp = 0.0


class Reported(Message, frozen=True, kw_only=True):
    """What another system says stands on the floor: a robot of others, where it is, or an obstacle; null: it is gone.

    It holds for `ttl` s after its arrival, so whoever reports it repeats it. A robot is a circle, `theta` and `v` say
    how it moves, and its body explains what sensor nodes see of it.
    """

    kind: Literal["robot", "obstacle"]
    shape: Shape | None
    ttl: Annotated[float, Meta(gt=0.0, le=60.0, extra={"unit": "s"})]
    theta: Radians = 0.0
    v: Speed = 0.0
    height: Annotated[float, Meta(gt=0.0, le=3.0, extra={"unit": "m"})] = 0.35
