"""Orders, and missions with several stops: which is next, the best order, what is done when the way is cut. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

from msgspec import Meta, structs

from fog_contracts.messages import Id, Message, PlanRefusal, PointXY, Pose, Stamp, TimeToLive

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import RobotPath
    from fog_runtime.stores.redis_store import Attempt

STOPS_MAX: Final = 20
BEST_MAX: Final = 8
"""Of more stops the best order is not searched."""


class Stop(Message, frozen=True, kw_only=True):
    """Where a robot is to go: a pose, that of a place or not; `any_heading`: its theta does not count."""

    pose: Pose
    place: Id | None = None
    any_heading: bool = False


class WhenCut(Message, frozen=True, kw_only=True):
    """What to do when every way to a stop is cut: wait, cancel the mission, or drive to the nearest reachable point.

    `limit_s`: after so long without a way the mission ends all the same. It counts anew after a restart.
    """

    do: Literal["wait", "cancel", "nearest"] = "wait"
    limit_s: TimeToLive | None = None


Priority = Annotated[int, Meta(ge=0, le=9)]


class Tour(Message, frozen=True, kw_only=True):
    """A mission beside its present goal, which is leg number `leg` of it.

    `reached` and `ahead` are its stops before and behind the present one. `aside`: the present goal is only the
    reachable point nearest to this stop; `nearest`: the last such point. `deadline` (s since the epoch): it ends then.
    """

    id: str
    leg: int = 0
    reached: tuple[Stop, ...] = ()
    ahead: tuple[Stop, ...] = ()
    when_cut: WhenCut = WhenCut()
    priority: Priority = 0
    deadline: Stamp | None = None
    aside: Stop | None = None
    nearest: PointXY | None = None

    @property
    def goal_id(self) -> str:
        """The id of the present goal: another one for each leg."""
        return f"{self.id}-{self.leg}"

    @property
    def goes_on(self) -> bool:
        """Whether another leg follows the present one."""
        return self.aside is not None or bool(self.ahead)


class Order(NamedTuple):
    """A mission as an operator orders it, and the conditions of the order.

    `any_heading`: ignore the pose's theta. `expected` is the id of the mission that it replaces, or `NO_MISSION`; None
    replaces any. `action` is the audit trail's word for it.
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
    tour: Tour | None = None


def next_leg(tour: Tour, present: Stop) -> tuple[Stop, Tour]:
    """Return the next stop, and the tour then, when the present goal is reached; the tour must go on."""
    if tour.aside is not None:
        return tour.aside, structs.replace(tour, leg=tour.leg + 1, aside=None)
    reached = (*tour.reached, present)
    return tour.ahead[0], structs.replace(tour, leg=tour.leg + 1, reached=reached, ahead=tour.ahead[1:], nearest=None)


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
CUT_S: Final = 3.0
"""A way that is cut for less is not cut: what flickers ends no mission."""
_ELSEWHERE_M: Final = 1.0
"""So far from the last nearest point another one is worth to be driven to."""

CutAct = Literal["wait", "cancel", "nearest"]


def is_cut(path: RobotPath | None, goal_id: str) -> bool:
    """Whether no way leads to a goal by its robot's last path or refusal."""
    if path is None or path.refusal is None or path.goal_id != goal_id:
        return False
    return path.refusal.kind in _CUT


def act_on_cut(tour: Tour, nearest: PointXY | None, cut_s: float) -> CutAct:
    """Return what is to be done about a way that is cut for so long (s); `nearest`: the point that can be reached."""
    policy = tour.when_cut
    if cut_s < CUT_S:
        return "wait"
    if policy.do == "cancel" or (policy.limit_s is not None and cut_s >= policy.limit_s):
        return "cancel"
    if policy.do != "nearest" or tour.aside is not None or nearest is None:
        return "wait"
    elsewhere = tour.nearest is None or math.dist(tour.nearest, nearest) > _ELSEWHERE_M
    return "nearest" if elsewhere else "wait"
