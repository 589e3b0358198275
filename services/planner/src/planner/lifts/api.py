"""REST: goals on other floors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.messages import FloorGoal, GoalView, Id, Message, Pose, Refusal
from fog_runtime.http import Body, HttpProblem, Operator, ProblemError, Routes
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from planner.lifts.rides import lift_to
from planner.problems import PlannerProblem
from planner.robot_operator import CommandError
from planner.stops import GoalPose, Order, Ride
from planner.store import OutOfServiceError
from planner.tours.api import goal_refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.site import Site
    from planner.lifts.riding import Robots


class FloorBody(Message, frozen=True, kw_only=True):
    """A floor, by its site's id, and where the robot goes there: a place of that floor, a pose, or just the lift."""

    floor: Id
    place: Id | None = None
    pose: GoalPose | None = None


def add_floors(routes: Routes, service: Robots, site: Site, check: Callable[[str], None]) -> None:
    """Add the route; `routes` knows the errors of commands and missions; `check` raises for an unknown robot."""

    @routes.put(
        "/api/v1/robots/{robot}/floor",
        raises=[CommandError, IdempotencyError, OutOfServiceError, StoreError],
        problems=[
            PlannerProblem.NO_ROBOT,
            PlannerProblem.ROBOT_DOUBLED,
            PlannerProblem.NO_LIFT,
            PlannerProblem.FLOOR_UNKNOWN,
            PlannerProblem.GOAL_REFUSED,
        ],
    )
    async def put_floor(robot: str, body: Body[FloorBody], caller: Operator) -> GoalView:
        """Send a robot to another floor, instead of its mission: to the nearest lift, by it, and on to the goal there.

        The answer has its goal on this floor, before the lift. Whether the goal exists there is found out there.
        """
        check(robot)
        if body.place is not None and body.pose is not None:
            detail = "give either a place or a pose of that floor, or neither"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body")
        lift = None if body.floor == site.id else lift_to(site.lifts, body.floor, service.poses.get(robot))
        if lift is None:
            known = sorted({floor for each in site.lifts for floor in each.floors} - {site.id})
            detail = f"no lift of {site.id} leads to {body.floor}; lifts lead to: {', '.join(known) or 'no floor'}"
            raise ProblemError(PlannerProblem.NO_LIFT, detail, field="body.floor")
        service.missions.require_in_service(robot)
        floors = service.operator.fresh_state(robot).floors
        if body.floor not in floors:
            detail = f"robot {robot} does not know {body.floor}; it knows: {', '.join(floors) or 'this floor only'}"
            raise ProblemError(PlannerProblem.FLOOR_UNKNOWN, detail, field="body.floor")
        goal = FloorGoal(place=body.place) if body.place is not None else None
        if (at := body.pose) is not None:
            goal = FloorGoal(pose=Pose(x=at.x, y=at.y, theta=at.theta or 0.0), any_heading=at.theta is None)
        ride = Ride(lift=lift.id, floor=body.floor, goal=goal, who=caller.name)
        sent = await service.send(Order(robot, lift.wait, caller.name, ride=ride))
        if isinstance(sent, Refusal):
            raise goal_refused(sent, "body.floor")
        view = GoalView.of(robot, sent.goal)
        assert view is not None  # what is stored has a pose
        return view
