"""REST: goals on other floors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_contracts.messages import GoalView, Id, Message, Pose, Refusal, Stop
from fog_runtime.http import Body, HttpProblem, Operator, ProblemError, Routes
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from planner.problems import PlannerProblem
from planner.robot_operator import CommandError
from planner.stops import GoalPose, Order
from planner.store import OutOfServiceError
from planner.tours.api import goal_refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from planner.lifts.riding import Riding, Robots


class FloorBody(Message, frozen=True, kw_only=True):
    """A floor, by its site's id, and where the robot goes there: a place of that floor, a pose, or just the lift."""

    floor: Id
    place: Id | None = None
    pose: GoalPose | None = None


def add_floors(routes: Routes, service: Robots, riding: Riding, check: Callable[[str], None]) -> None:
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
        if body.floor == riding.floor:
            detail = f"no lift leads to {riding.floor}: it is this floor"
            raise ProblemError(PlannerProblem.NO_LIFT, detail, field="body.floor")
        if body.place is not None and body.pose is not None:
            detail = "give either a place or a pose of that floor, or neither"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body")
        service.missions.require_in_service(robot)
        pose = None
        if (at := body.pose) is not None:
            pose = Pose(x=at.x, y=at.y, theta=at.theta or 0.0)
        stop = Stop(place=body.place, pose=pose, any_heading=at is not None and at.theta is None, floor=body.floor)
        before, ride = riding.first_leg(robot, stop, caller.name, "body")
        riding.check(robot, stop, "body", mission=False)
        assert before.pose is not None  # a lift has one
        sent = await service.send(Order(robot, before.pose, caller.name, ride=ride))
        if isinstance(sent, Refusal):
            raise goal_refused(sent, "body.floor")
        view = GoalView.of(robot, sent.goal)
        assert view is not None  # what is stored has a pose
        return view
