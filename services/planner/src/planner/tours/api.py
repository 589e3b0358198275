"""REST: missions with several stops, and what a goal is."""

from __future__ import annotations

import math
import secrets
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from msgspec import structs, to_builtins

from fog_contracts.messages import (
    Message,
    PlanRefusal,
    PlanReply,
    PlanRequest,
    PointXY,
    Pose,
    Refusal,
    Stamp,
    Stop,
    Tour,
    WhenCut,
)
from fog_runtime.http import Answer, HttpProblem, ProblemError, etag
from planner.problems import PlannerProblem
from planner.stops import BEST_MAX, GoalBody, MissionBody, Order, Ride, StopBody, best_order

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import Place, RobotPose
    from planner.store import StoredGoal


class StopView(Message, frozen=True, kw_only=True):
    """A stop of a mission. `floor`: the other one that it is on, whose planner knows the pose of its place."""

    pose: Pose | None
    place: str | None
    any_heading: bool
    state: Literal["reached", "present", "ahead"]
    floor: str | None


class MissionView(Message, frozen=True, kw_only=True):
    """A mission; `goal_id` is its present goal. `aside`: it waits at, or drives to, the point nearest to its stop."""

    id: str
    robot: str
    goal_id: str
    stops: list[StopView]
    when_cut: WhenCut
    priority: int
    deadline: Stamp | None
    aside: PointXY | None


def _check_one(body: GoalBody, field: str) -> None:
    if (body.place is None) == (body.pose is None):
        raise ProblemError(HttpProblem.REQUEST_INVALID, "give either a place or a pose, and not both", field=field)


def goal_pose(body: GoalBody, places: Mapping[str, Place], field: str = "body") -> tuple[Pose, bool]:
    """Return the pose of a goal, and whether any heading will do; raises a `ProblemError` for an invalid goal."""
    _check_one(body, field)
    if body.pose is not None:
        theta = body.pose.theta
        return Pose(x=body.pose.x, y=body.pose.y, theta=theta or 0.0), theta is None
    place = places.get(body.place or "")
    if place is None:
        names = ", ".join(sorted(places)) or "none"
        detail = f"there is no place {body.place}; known places: {names}"
        raise ProblemError(PlannerProblem.NO_PLACE, detail, field=f"{field}.place")
    return Pose(x=place.x, y=place.y, theta=place.theta or 0.0), place.theta is None


def stop_of(body: StopBody, places: Mapping[str, Place], site: str, field: str) -> Stop:
    """Return a stop; raises a `ProblemError` for one that can't be. The places of other floors are not known here."""
    if body.floor in {None, site}:
        pose, any_heading = goal_pose(body, places, field)
        return Stop(pose=pose, place=body.place, any_heading=any_heading)
    _check_one(body, field)
    if (at := body.pose) is None:
        return Stop(place=body.place, floor=body.floor)
    return Stop(pose=Pose(x=at.x, y=at.y, theta=at.theta or 0.0), any_heading=at.theta is None, floor=body.floor)


def goal_refused(refusal: Refusal, field: str) -> ProblemError:
    """Return the problem of a goal that is refused."""
    return ProblemError(
        PlannerProblem.GOAL_REFUSED,
        refusal.reason,
        field=field,
        code=refusal.code,
        name=refusal.name,
        refusal=refusal.kind,
        nearest=refusal.nearest,
        causes=to_builtins(refusal.causes),
    )


def mission_answer(robot: str, stored: StoredGoal, status: int = 200) -> Answer[MissionView]:
    """Return a robot's mission with its ETag."""
    goal, tour = stored.goal, stored.tour or Tour(id=stored.goal.goal_id)
    assert goal.pose is not None  # what is stored has a pose
    present = tour.aside or stored.stop
    stops: list[tuple[Stop, Literal["reached", "present", "ahead"]]] = [
        *((stop, "reached") for stop in tour.reached), (present, "present"), *((stop, "ahead") for stop in tour.ahead)
    ]  # fmt: skip
    view = MissionView(
        id=tour.id,
        robot=robot,
        goal_id=goal.goal_id,
        stops=[StopView(**structs.asdict(stop), state=state) for stop, state in stops],
        when_cut=tour.when_cut,
        priority=tour.priority,
        deadline=tour.deadline,
        aside=None if tour.aside is None else (goal.pose.x, goal.pose.y),
    )
    return Answer(view, etag(goal.goal_id), status=status)


class Rides(Protocol):
    """What an order needs to know of other floors (`planner.lifts.riding`)."""

    @property
    def floor(self) -> str:
        """This floor."""

    def check(self, robot: str, stop: Stop, field: str, *, mission: bool) -> None:
        """Raise for a stop on a floor to which the robot can't be handed over."""

    def first_leg(self, robot: str, stop: Stop, who: str, field: str) -> tuple[Stop, Ride | None]:
        """Return where a robot goes for a stop: there, or to the lift."""


class Planner(Protocol):
    """What an order needs of the planner's service."""

    poses: dict[str, RobotPose]

    @property
    def riding(self) -> Rides:
        """The rides."""

    async def preview(self, request: PlanRequest, asker: str) -> PlanReply:
        """Plan a path without side effects."""

    def stamp(self) -> float:
        """Return the time, s since the epoch."""


class Conditions(NamedTuple):
    """Who orders a mission, by which attempt, and instead of which."""

    who: str
    attempt: Any
    expected: str | None


_NEVER: frozenset[str] = frozenset(
    {PlanRefusal.GOAL_OFF_MAP, PlanRefusal.GOAL_IN_WALL, PlanRefusal.GOAL_UNKNOWN, PlanRefusal.GOAL_NEAR_WALL}
)
"""Refusals that no end of a hazard lifts."""


def check_best(body: MissionBody, site: str, field: str) -> None:
    """Raise a `ProblemError` for a mission whose best order is not searched; `field` is where it stands."""
    if body.order != "best":
        return
    detail = ""
    if len(body.stops) > BEST_MAX:
        detail = f"the best order of {len(body.stops)} stops is not searched: give {BEST_MAX} at most, or order them"
    elif any(stop.floor not in {None, site} for stop in body.stops):
        detail = "the best order is searched among stops of this floor only: order them"
    if detail:
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field=f"{field}.order")


async def mission_order(
    planner: Planner,
    robot: str,
    body: MissionBody,
    places: Mapping[str, Place],
    conditions: Conditions,
    speed: float,
) -> Order:
    """Return the order of a mission; raises a `ProblemError` for one that can't be carried out.

    `speed` (m/s) is how fast robots get on. A stop that is cut off now is accepted, because hazards end, unless the
    mission is to be cancelled then. Ways on other floors are not known here. Raises `CommandError`, too.
    """
    riding = planner.riding
    stops = [stop_of(stop, places, riding.floor, f"body.stops.{number}") for number, stop in enumerate(body.stops)]
    check_best(body, riding.floor, "body")
    legs: list[tuple[Stop, Ride | None]] = []
    for number, stop in enumerate(stops):
        field = f"body.stops.{number}"
        riding.check(robot, stop, field, mission=True)
        if number and stop.floor is not None and stops[number - 1].floor is not None:
            legs.append((Stop(), None))  # which lifts lead from there to there, that floor knows
        else:
            legs.append(riding.first_leg(robot, stop, conditions.who, field))
    numbers = list(range(len(stops)))
    here = [leg.pose for leg, _ in legs]
    at = planner.poses.get(robot)
    if at is None or not at.localized:
        if body.order == "best" or body.deadline_s is not None or body.when_cut.do == "cancel":
            detail = f"it is not known where robot {robot} is: switch it on and localize it, then try again"
            raise ProblemError(PlannerProblem.NO_POSE, detail)
        start = here[0]
    else:
        start = Pose(x=at.x, y=at.y, theta=at.theta)
    ways = _Ways(planner, conditions.who, body.when_cut)
    if body.order == "best":
        first = [await ways.cost(start, pose, n) for n, pose in enumerate(here)]
        between = [[0.0 if a is b else await ways.cost(a, b, n) for n, b in enumerate(here)] for a in here]
        numbers = best_order(first, between)
    poses = [start, *(here[number] for number in numbers)]
    lengths = [await ways.length(a, b, n) for a, b, n in zip(poses[:-1], poses[1:], numbers, strict=True)]
    if body.deadline_s is not None and (seconds := sum(lengths) / speed) > body.deadline_s and math.isfinite(seconds):
        detail = f"the mission takes some {seconds:.0f} s, more than its {body.deadline_s:.0f} s"
        raise ProblemError(PlannerProblem.DEADLINE_TOO_SOON, detail, field="body.deadline_s", seconds=round(seconds))
    (present, ride), ahead = legs[numbers[0]], [stops[number] for number in numbers[1:]]
    assert present.pose is not None  # also that of a lift
    tour = Tour(
        id=secrets.token_hex(8),
        ahead=tuple(ahead),
        when_cut=body.when_cut,
        priority=body.priority,
        deadline=None if body.deadline_s is None else planner.stamp() + body.deadline_s,
        who=conditions.who,
    )
    return Order(
        robot, present.pose, conditions.who, place=present.place, any_heading=present.any_heading,
        attempt=conditions.attempt, expected=conditions.expected, action="mission", tour=tour, ride=ride,
    )  # fmt: skip


class _Ways:
    """The ways between stops, each planned once."""

    def __init__(self, planner: Planner, who: str, when_cut: WhenCut) -> None:
        self._planner = planner
        self._asker = f"person {who}"
        self._when_cut = when_cut
        self._known: dict[tuple[Pose | None, Pose | None], PlanReply] = {}

    async def _plan(self, start: Pose | None, goal: Pose | None, number: int) -> PlanReply:
        if start is None or goal is None:
            return PlanReply(length=0.0, cost=0.0)  # on another floor, whose planner knows the way
        known = self._known.get((start, goal)) or await self._planner.preview(
            PlanRequest(start=start, goal=goal), self._asker
        )
        self._known[start, goal] = known
        refusal = known.refusal
        if refusal is not None and (refusal.kind in _NEVER or self._when_cut.do == "cancel"):
            raise goal_refused(refusal, f"body.stops.{number}")
        return known

    async def cost(self, start: Pose | None, goal: Pose | None, number: int) -> float:
        """Return the cost of the way to a stop of this number, infinite if there is none now."""
        found = await self._plan(start, goal, number)
        return math.inf if found.refusal is not None else found.cost

    async def length(self, start: Pose | None, goal: Pose | None, number: int) -> float:
        """Return the length (m) of the way to a stop of this number, infinite if there is none now."""
        found = await self._plan(start, goal, number)
        return math.inf if found.refusal is not None else found.length
