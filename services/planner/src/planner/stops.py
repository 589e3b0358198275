"""Orders, and missions with several stops: which is next, the best order, what is done when the way is cut. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

from msgspec import Meta, structs

from fog_contracts.messages import (
    STOPS_MAX,
    Author,
    Code,
    FloorGoal,
    Id,
    Message,
    Metres,
    PlanRefusal,
    PointXY,
    Pose,
    Priority,
    Radians,
    Sentence,
    Stamp,
    Stop,
    TimeToLive,
    Tour,
    WeeklySchedule,
    WhenCut,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Sequence

    from fog_runtime.clock import Clock
    from fog_runtime.stores.redis_store import Attempt

BEST_MAX: Final = 8
"""Of more stops the best order is not searched."""


class Ride(Message, frozen=True, kw_only=True):
    """A mission to another floor: by which lift, which floor, and the goal there (`fog_contracts.handover`, ADR 76).

    Its present goal is the place before the lift's door or, once it `boards`, the one in its cabin.
    """

    lift: Id
    floor: Id
    goal: FloorGoal | None = None
    who: Author = ""
    boards: bool = False


class GoalPose(Message, frozen=True, kw_only=True):
    """A position in m, frame `map`; without `theta` (rad) any heading is accepted."""

    x: Metres
    y: Metres
    theta: Radians | None = None


class GoalBody(Message, frozen=True, kw_only=True):
    """A goal: the id of a place of the site, or a pose; exactly one of the two."""

    place: Id | None = None
    pose: GoalPose | None = None


class StopBody(GoalBody, frozen=True, kw_only=True):
    """A stop: a goal, on another floor of the building if it names one (`Site.id`)."""

    floor: Id | None = None


class MissionBody(Message, frozen=True, kw_only=True):
    """A mission: its stops in the `given` order, or in the `best` one, whose way is the shortest (8 at most).

    With stops on several floors the order is the given one.
    `when_cut`: what to do when no way leads to a stop. `deadline_s`: it ends so long after the order, whatever is left.
    Of equally urgent missions that of higher `priority` is planned first.
    """

    stops: Annotated[list[StopBody], Meta(min_length=1, max_length=STOPS_MAX)]
    order: Literal["given", "best"] = "given"
    when_cut: WhenCut = WhenCut()
    deadline_s: TimeToLive | None = None
    priority: Priority = 0


class Occasion(Message, frozen=True, kw_only=True):
    """What became of the mission of one window, which began at `begin` (s since the epoch).

    `mission`: the id of the one that was given; `reason`: why it was missed, `code` identifies it as `waits_code`
    does.
    """

    begin: Stamp
    at: Stamp
    outcome: Literal["given", "missed"]
    mission: str | None = None
    reason: Sentence = ""
    code: Code = ""


class ScheduledMission(Message, frozen=True, kw_only=True):
    """A mission that a robot gets in each window of a weekly schedule, as stored. `since`: when it was written."""

    id: Id
    robot: Id
    mission: MissionBody
    weekly: WeeklySchedule
    enabled: bool = True
    author: str = ""
    since: Stamp
    version: str
    last: Occasion | None = None


class Order(NamedTuple):
    """A mission as an operator orders it, and the conditions of the order.

    `any_heading`: ignore the pose's theta. `expected` is the id of the mission that it replaces, or `NO_MISSION`; None
    replaces any. `action` is the audit trail's word for it. `idle`: see `RobotGoal`.
    """

    robot: str
    pose: Pose
    who: str
    place: str | None = None
    any_heading: bool = False
    attempt: Attempt | None = None
    expected: str | None = None
    action: str = "goal"
    visit: bool = False
    idle: bool = False
    tour: Tour | None = None
    ride: Ride | None = None


def next_leg(tour: Tour, present: Stop) -> tuple[Stop, Tour]:
    """Return the next stop, and the tour then, when the present goal is reached; the tour must go on."""
    if tour.aside is not None:
        return tour.aside, structs.replace(tour, leg=tour.leg + 1, aside=None)
    reached = (*tour.reached, present)
    return tour.ahead[0], structs.replace(tour, leg=tour.leg + 1, reached=reached, ahead=tour.ahead[1:], nearest=None)


def carried(tour: Tour, origin: str, floor: str) -> Tour:
    """Return a mission as a robot takes it along from the floor `origin` to `floor`, whose stops name none there."""

    def read_there(stops: tuple[Stop, ...]) -> tuple[Stop, ...]:
        named = ((stop, stop.floor or origin) for stop in stops)
        return tuple(structs.replace(stop, floor=None if name == floor else name) for stop, name in named)

    return structs.replace(tour, leg=tour.leg + 1, reached=read_there(tour.reached), ahead=read_there(tour.ahead))


def leg_aside(tour: Tour, present: Stop, nearest: PointXY) -> tuple[Stop, Tour]:
    """Return the reachable point nearest to the present stop as a stop, and the tour on the way there."""
    stop = Stop(pose=Pose(x=nearest[0], y=nearest[1], theta=0.0), any_heading=True)
    return stop, structs.replace(tour, leg=tour.leg + 1, aside=present, nearest=nearest)


def best_order(first: Sequence[float], between: Sequence[Sequence[float]]) -> list[int]:
    """Return the order of n stops whose way is cheapest: exact, by dynamic programming over sets (Held and Karp 1962).

    `first`: the cost from the start to each; `between`: n x n, from each to each. Infinite where no way leads; orders
    with fewer such steps are better. At most `BEST_MAX` stops. Raises ValueError for more.
    """
    count = len(first)
    if count > BEST_MAX:
        raise ValueError(f"the best order of {count} stops is not searched: at most {BEST_MAX}")

    def step(cost: float) -> tuple[int, float]:
        return (1, 0.0) if math.isinf(cost) else (0, cost)

    best: dict[tuple[int, int], tuple[int, float, list[int]]] = {
        (1 << stop, stop): (*step(first[stop]), [stop]) for stop in range(count)
    }
    for visited in range(1, 1 << count):
        for last in range(count):
            known = best.get((visited, last))
            if known is None:
                continue
            for stop in range(count):
                if visited & 1 << stop:
                    continue
                closed, cost = step(between[last][stop])
                key = visited | 1 << stop, stop
                found = known[0] + closed, known[1] + cost, [*known[2], stop]
                if key not in best or found[:2] < best[key][:2]:
                    best[key] = found
    whole = (1 << count) - 1
    return min((best[whole, last] for last in range(count)), key=lambda found: found[:2])[2]


_CUT: Final = frozenset(
    {
        PlanRefusal.CUT_OFF,
        PlanRefusal.CUT_BY_WALLS,
        PlanRefusal.CUT_BY_OBSTACLES,
        PlanRefusal.CUT_BY_PLACES,
        PlanRefusal.GOAL_CLOSED,
        PlanRefusal.GOAL_OBSTRUCTED,
    }
)
"""The refusals that a mission's rule is about; its `limit_s` is about all."""
_AT_START: Final = frozenset({PlanRefusal.START_OFF_MAP, PlanRefusal.START_CLOSED, PlanRefusal.START_OBSTRUCTED})
"""Those that no other goal ends."""
CUT_S: Final = 3.0
"""A way that is cut for less is not cut, and one that is open for less is not open: what flickers changes nothing."""
_ELSEWHERE_M: Final = 1.0
"""So far from the last nearest point another one is worth to be driven to."""

CutAct = Literal["wait", "cancel", "nearest", "on"]
"""What is done about a way that is cut; `on`: go on to the stop itself, from the way to the nearest point."""


class CutTimes:
    """Since when no way leads to a robot's present goal, and to its stop. Times in s."""

    def __init__(self) -> None:
        self._stop: tuple[str, int] | None = None
        self._leg = -1
        self._cut_from = self._without_from = self._open_from = math.inf

    def see(self, tour: Tour, kind: str | None, now: float) -> tuple[float, float]:
        """Return for how long the way to the present goal has been cut, and for how long none has led to the stop.

        `kind`: why the present goal is refused, None when a path leads to it. The second goes on while the robot is on
        its way to the nearest point, counts every refusal, and ends when the way has been open for a while.
        """
        stop = tour.id, len(tour.reached)
        if stop != self._stop:
            self._stop, self._without_from, self._open_from = stop, math.inf, math.inf
        is_cut = kind in _CUT if tour.aside is None else kind is not None and kind not in _AT_START
        before = self._cut_from if tour.leg == self._leg else math.inf
        self._leg, self._cut_from = tour.leg, min(before, now) if is_cut else math.inf
        if kind is not None:
            self._without_from, self._open_from = min(self._without_from, now), math.inf
        elif tour.aside is None:
            self._open_from = min(self._open_from, now)
            if now - self._open_from >= CUT_S:
                self._without_from = math.inf
        return max(0.0, now - self._cut_from), max(0.0, now - self._without_from)


def act_on_cut(tour: Tour, nearest: PointXY | None, cut_s: float, without_s: float) -> CutAct:
    """Return what is to be done about a way that is cut.

    `cut_s`, `without_s`: as `CutTimes.see` returns them. `nearest`: the point that can be reached.
    """
    policy = tour.when_cut
    if policy.limit_s is not None and without_s >= policy.limit_s:
        return "cancel"
    if cut_s < CUT_S:
        return "wait"
    if policy.do == "cancel":
        return "cancel"
    if tour.aside is not None:
        return "on"
    if policy.do != "nearest" or nearest is None:
        return "wait"
    elsewhere = tour.nearest is None or math.dist(tour.nearest, nearest) > _ELSEWHERE_M
    return "nearest" if elsewhere else "wait"


class Ends:
    """Tells when what has an end at a time of day has ended: by the monotonic clock, so that no jump ends it early.

    Of what was there before this process nothing ends before the time of day is known to be right (`synchronized`).
    """

    def __init__(self, clock: Clock, synchronized: Callable[[], bool]) -> None:
        self._clock, self._synchronized = clock, synchronized
        self._ends: dict[str, float] = {}

    def count(self, name: str, end: float) -> None:
        """Count from now on to an end (s since the epoch) that was asked for by the same clock."""
        self._ends[name] = self._clock.now() + end - self._clock.stamp()

    def passed(self, name: str, end: float | None) -> bool:
        """Whether the end (s since the epoch; None: there is none) has passed."""
        if end is None:
            return False
        if name not in self._ends and self._synchronized():
            self.count(name, end)
        return self._clock.now() >= self._ends.get(name, math.inf)

    def keep(self, names: Container[str]) -> None:
        """Forget all others."""
        self._ends = {name: end for name, end in self._ends.items() if name in names}
