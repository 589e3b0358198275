"""What a scenario's file says: a drive, what happens on it, and what is expected. Pure.

Lengths in m, frame `map`; angles in rad; times in s of the simulated clock, from the goal on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Protocol

import msgspec
from msgspec import Meta

from fog_contracts.messages import Id, Mode, PointXY, ProfileName, ReasonCode, Ring

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fognav_experiments.lockstep import DriveEvent

Metres = Annotated[float, Meta(ge=0.0)]
Seconds = Annotated[float, Meta(ge=0.0)]


class Event(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """Something that happens once the robot has driven `at_m`, and no earlier than `at_s`."""

    at_m: Metres = 0.0
    at_s: Seconds = 0.0


class Obstacle(Event, frozen=True, kw_only=True, tag="obstacle"):
    """Somebody or something stands on the floor, for `seconds` (0: from then on), which lidar and sonars see.

    `area`: the watched area whose nodes must see it, if they are honest. It waits until the robot is `keep_m` away.
    What has less than 0.25 m of `height` (m) no lidar sees, and a sonar only if it reaches up into its cone: a low
    thing, or the edge of a table top that a lidar looks beneath. What is `soft` swallows sound.
    """

    polygon: Ring
    seconds: Seconds = 0.0
    area: Id | None = None
    keep_m: Metres = 0.0
    height: Annotated[float, Meta(gt=0.0, le=5.0)] = 1.0
    soft: bool = False


class Hole(Event, frozen=True, kw_only=True, tag="hole"):
    """Stairs lead down where the map has floor: only a base's cliff sensors find them. It waits as an obstacle does."""

    polygon: Ring
    keep_m: Metres = 0.0


class Person(Event, frozen=True, kw_only=True, tag="person"):
    """Somebody walks along a line (m) at `speed` (m/s), waits for a robot that is nearer than 1 m, and is gone then."""

    line: list[PointXY]
    speed: Annotated[float, Meta(gt=0.0, le=3.0)] = 1.0


class NoGoZone(Event, frozen=True, kw_only=True, tag="zone"):
    """An operator draws a no-go zone, which no sensor sees; `seconds` later it is lifted (0: never)."""

    polygon: Ring
    seconds: Seconds = 0.0


class SpeedZone(Event, frozen=True, kw_only=True, tag="speed-zone"):
    """An operator draws a zone with a limit of `speed` (m/s); `seconds` later it is lifted (0: never)."""

    polygon: Ring
    speed: Annotated[float, Meta(ge=0.01, le=2.54)]
    seconds: Seconds = 0.0


class SilentNode(Event, frozen=True, kw_only=True, tag="silent-node"):
    """A sensor node says nothing more, for `seconds` (0: for ever)."""

    node: Id
    seconds: Seconds = 0.0


class FaultyNode(Event, frozen=True, kw_only=True, tag="faulty-node"):
    """A sensor node goes wrong, for `seconds` (0: for ever).

    stuck: its sonars' lines hang, and it knows. flapping: it says blocked and clear by turns, a second each.
    lies-clear: it says that nothing is there, whatever it sees; lies-blocked: that something is.
    """

    node: Id
    fault: Literal["stuck", "flapping", "lies-clear", "lies-blocked"]
    seconds: Seconds = 0.0


class DeceivedNode(Event, frozen=True, kw_only=True, tag="deceived-node"):
    """The sonars of a node hear something else than what is there, for `seconds` (0: for ever); its firmware is honest.

    An echo comes from `scale` times its range and `offset` (m) more, none with the probability `lost`, and any with
    `stray`: a wrong temperature, a detour, something on the sonar, a dead or covered one, another one's bursts.
    """

    node: Id
    scale: Annotated[float, Meta(ge=0.0, le=3.0)] = 1.0
    offset: Annotated[float, Meta(ge=-4.0, le=4.0)] = 0.0
    lost: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    stray: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    seconds: Seconds = 0.0


class ClockChange(Event, frozen=True, kw_only=True, tag="clock"):
    """A computer's wall clock jumps by `jump_s` and gains `rate` seconds a second for `seconds` then.

    chrony slews by 83,333 ppm at most, NTP's kernel by 500. Processes count intervals by a clock that nothing slews
    (ADR 17): from then on it gains `crystal` seconds a second.
    """

    computer: Literal["robot", "fog"]
    jump_s: float = 0.0
    rate: Annotated[float, Meta(gt=-0.5, le=0.5)] = 0.0
    crystal: Annotated[float, Meta(ge=-1e-4, le=1e-4)] = 0.0
    seconds: Seconds = 0.0


class SlowLink(Event, frozen=True, kw_only=True, tag="slow-link"):
    """For `seconds` each message between robot and fog takes `delay_s`, and none is lost."""

    seconds: Seconds
    delay_s: Seconds


class Restart(Event, frozen=True, kw_only=True, tag="restart"):
    """A process of the fog dies, and is there again `seconds` later, with what its store holds."""

    process: Literal["aggregator", "map-service", "planner"]
    seconds: Annotated[float, Meta(gt=0.0)]


class SlewedNode(Event, frozen=True, kw_only=True, tag="slewed-node"):
    """From then on the clock of a sensor node gains `rate` seconds a second."""

    node: Id
    rate: Annotated[float, Meta(gt=-0.5, le=0.5)]


class LinkGap(Event, frozen=True, kw_only=True, tag="link-gap"):
    """For `seconds` the robot hears nothing of the fog (`down`), or the fog nothing of the robot (`up`), or both."""

    seconds: Seconds
    down: bool = True
    up: bool = True


class Kidnapping(Event, frozen=True, kw_only=True, tag="kidnapping"):
    """Somebody carries the robot to another place; its wheels do not turn meanwhile."""

    to: PointXY
    theta: float = 0.0


class BlindLidar(Event, frozen=True, kw_only=True, tag="blind-lidar"):
    """Nothing returns the lidar's beams between two angles (counter-clockwise) for `seconds` (0: for ever)."""

    begin: float
    end: float
    seconds: Seconds = 0.0


class Command(Event, frozen=True, kw_only=True, tag="command"):
    """An operator gives the robot this command, once; it may refuse."""

    command: Literal["enable", "disable", "cancel", "egress", "back_off", "turn", "advance", "reset"]


class HeldWheel(Event, frozen=True, kw_only=True, tag="held-wheel"):
    """A threshold holds one side of the robot for `seconds`: its wheel turns on the spot, and its encoder counts."""

    wheel: Literal["left", "right"]
    seconds: Seconds


class Push(Event, frozen=True, kw_only=True, tag="push"):
    """A threshold turns the robot by this angle at once; its wheels do not."""

    turn: float


class HungAgent(Event, frozen=True, kw_only=True, tag="hung-agent"):
    """The robot's agent hangs for `seconds`; its guardian does not, and what base and lidar send waits."""

    seconds: Annotated[float, Meta(gt=0.0)]


class DeadAgent(Event, frozen=True, kw_only=True, tag="dead-agent"):
    """The robot's agent dies, and another one is started `seconds` later, with what was stored."""

    seconds: Annotated[float, Meta(gt=0.0)]


class SilentLidar(Event, frozen=True, kw_only=True, tag="silent-lidar"):
    """The lidar sends nothing for `seconds`."""

    seconds: Annotated[float, Meta(gt=0.0)]


class FrozenLidar(Event, frozen=True, kw_only=True, tag="frozen-lidar"):
    """The lidar sends its last turns again and again for `seconds`, as a stuck bridge or a driver's buffer does."""

    seconds: Annotated[float, Meta(gt=0.0)]
    turns: Annotated[int, Meta(ge=1, le=5)] = 1


class BadLine(Event, frozen=True, kw_only=True, tag="bad-line"):
    """For `seconds` the serial line of a device loses bytes, or changes a bit, with these probabilities, both ways.

    While it is `stalled` what the device sends waits, and comes at once then.
    """

    device: Literal["base", "lidar"]
    seconds: Annotated[float, Meta(gt=0.0)]
    lost: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    flipped: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    stalled: bool = False


class BusyRadio(Event, frozen=True, kw_only=True, tag="busy-radio"):
    """For `seconds` messages between robot and fog take times of a lognormal distribution, the same for 0.1 s.

    And so do readings of the nodes, each its own. `median_s`, `sigma`: of the times. `gaps_per_min`: how often nothing
    arrives in one direction or in both, by a lognormal distribution around 0.3 s.
    """

    seconds: Seconds
    median_s: Annotated[float, Meta(gt=0.0)] = 0.003
    sigma: Annotated[float, Meta(ge=0.0)] = 1.9
    gaps_per_min: Annotated[float, Meta(ge=0.0)] = 1.0


AnyEvent = (
    Obstacle
    | Person
    | NoGoZone
    | SpeedZone
    | SilentNode
    | FaultyNode
    | DeceivedNode
    | SlewedNode
    | LinkGap
    | SlowLink
    | BusyRadio
    | Restart
    | HungAgent
    | DeadAgent
    | ClockChange
    | SilentLidar
    | FrozenLidar
    | BadLine
    | Hole
    | Command
    | HeldWheel
    | Push
    | Kidnapping
    | BlindLidar
)


class Expected(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What must be true of the drive, besides that the robot touches nothing.

    `outcome`: how it ends; `driving` if it had not ended after the scenario's time. `modes`: modes that the robot must
    have entered, `never`: those that it must not have. `reason`: identifier of a reason of its modes. Of several
    robots all must arrive; their distances are added up, and there are at most `plans` paths for all of them together.
    `plans` is only for several robots; `modes`, `never` and `reason` are only for one.
    """

    outcome: str = "reached"
    distance_m: tuple[Metres, Metres] = (0.0, 1e6)
    time_s: tuple[Seconds, Seconds] = (0.0, 1e6)
    modes: list[Mode] = []
    never: list[Mode] = []
    reason: ReasonCode | None = None
    plans: int | None = None


class OtherRobot(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Another robot, which drives from `start` (x, y, theta) to `goal` at the same time."""

    start: tuple[float, float, float]
    goal: PointXY


class Scenario(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A drive from `start` (x, y, theta) to `goal` of the site's first robot; it is ended after `seconds`.

    With `others` nothing else happens: no events, and all are led by the fog. `one_robot`: places that
    an operator keeps for one of them at a time. `wait`: whether robots wait before what
    closes their way (ADR 72).
    """

    title: str
    start: tuple[float, float, float]
    goal: PointXY
    expected: Expected
    events: list[AnyEvent] = []
    site: Id = "estig"
    profile: ProfileName = "fog"
    seconds: Seconds = 300.0
    seed: int = 1
    others: list[OtherRobot] = []
    one_robot: list[Ring] = []
    wait: Literal["off", "learned", "always"] = "learned"

    def __post_init__(self) -> None:
        """Raise `ValueError` for what can't be played."""
        if self.others and (self.events or self.profile != "fog"):
            raise ValueError("a scenario with others has no events, and no other profile than fog")
        if self.one_robot and not self.others:
            raise ValueError("places for one robot at a time need others: give the scenario others, or no one_robot")
        expected = self.expected
        if self.others and (expected.modes or expected.never or expected.reason):
            raise ValueError("what a scenario with others expects has no modes, never or reason: nobody records these")
        if not self.others and expected.plans is not None:
            raise ValueError("what a scenario without others expects has no plans: nobody counts these")


class Ended(Protocol):
    """How a drive went, or several together."""

    @property
    def contacts(self) -> int:
        """Contacts with walls, obstacles and one another."""

    @property
    def reason(self) -> str:
        """Why it ended."""

    @property
    def distance_m(self) -> float:
        """Distance driven."""

    @property
    def time_s(self) -> float | None:
        """Time until the end, None if it was broken off."""


def deviations(expected: Expected, result: Ended, outcome: str, events: Sequence[DriveEvent]) -> list[str]:
    """Return what differs from what was expected; `outcome` may be `driving`, `events` are those since the goal."""
    entered = [event.description for event in events if event.description.startswith("robot: ")]
    modes = {description.split()[1] for description in entered}
    found = []
    if result.contacts:
        found.append(f"{result.contacts} contacts")
    if outcome != expected.outcome:
        found.append(f"outcome {outcome} ({result.reason}), not {expected.outcome}")
    low, high = expected.distance_m
    if not low <= result.distance_m <= high:
        found.append(f"{result.distance_m:.1f} m driven, not {low:g} to {high:g}")
    shortest, longest = expected.time_s
    if result.time_s is not None and not shortest <= result.time_s <= longest:
        found.append(f"it took {result.time_s:.1f} s, not {shortest:g} to {longest:g}")
    found += [f"never in {mode}" for mode in expected.modes if mode not in modes]
    found += [f"was in {mode}" for mode in expected.never if mode in modes]
    if expected.reason is not None and not any(expected.reason in event.codes for event in events):
        found.append(f"no reason {expected.reason}")
    return found
