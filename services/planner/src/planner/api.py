"""REST under /api/v1: robots with their missions, and previews of ways. Reading needs no token, writing an operator."""

from typing import Annotated, Final

import msgspec
from fastapi import Depends, FastAPI, Request, Response

from fog_contracts.messages import (
    Id,
    Message,
    Metres,
    PlanReply,
    PlanRequest,
    Pose,
    Radians,
    Refusal,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
)
from fog_contracts.site import Site
from fog_runtime.health import Health
from fog_runtime.http import Caller, ProblemError, Tokens, answer_schema, body_schema, make_app, read_body, require
from planner.service import Service
from planner.store import StoredGoal, StoreError

RETRY_AFTER: Final = {"Retry-After": "1"}


class GoalPose(Message, frozen=True, kw_only=True):
    """A position in m, frame `map`; without `theta` (rad) any heading will do."""

    x: Metres
    y: Metres
    theta: Radians | None = None


class GoalBody(Message, frozen=True, kw_only=True):
    """Where to: the id of a place of the site, or a pose; exactly one of the two."""

    place: Id | None = None
    pose: GoalPose | None = None


class GoalView(Message, frozen=True, kw_only=True):
    """A mission; `any_heading`: the robot may arrive as it likes."""

    robot: str
    goal_id: str
    pose: Pose
    place: str | None
    any_heading: bool
    stamp: float


class PlanView(Message, frozen=True, kw_only=True):
    """The way in force: its version, how long it is, how much of it is released (m), or the refusal."""

    plan_id: int
    map_epoch: int
    map_seq: int
    points: int
    released_length: float
    refusal: Refusal | None


class RobotView(Message, frozen=True, kw_only=True):
    """A robot as the planner knows it."""

    id: str
    configured: bool
    pose: RobotPose | None
    state: RobotState | None
    goal: GoalView | None
    plan: PlanView | None


def _goal_view(robot: str, stored: StoredGoal) -> GoalView:
    goal: RobotGoal = stored.goal
    assert goal.pose is not None
    return GoalView(
        robot=robot,
        goal_id=goal.goal_id,
        pose=goal.pose,
        place=goal.place,
        any_heading=stored.any_heading,
        stamp=goal.stamp,
    )


def _plan_view(path: RobotPath) -> PlanView:
    return PlanView(
        plan_id=path.plan_id,
        map_epoch=path.map_epoch,
        map_seq=path.map_seq,
        points=len(path.points),
        released_length=path.released_length,
        refusal=path.refusal,
    )


def _json(value: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(value), status, media_type="application/json")


def make_api(service: Service, site: Site, health: Health, tokens: Tokens) -> FastAPI:
    """Return the app over a running service."""
    app = make_app("Fognav planner", health, tokens)
    configured = {robot.id for robot in site.robots}
    operator = Depends(require("operator"))

    def robots() -> list[str]:
        return sorted({*configured, *service.poses, *service.states, *service.goals})

    def known(robot: str) -> str:
        if robot not in robots():
            raise ProblemError(404, f"there is no robot {robot}: known are {', '.join(robots()) or 'none'}")
        return robot

    def wanted(body: GoalBody) -> tuple[Pose, bool]:
        if (body.place is None) == (body.pose is None):
            raise ProblemError(422, "give either a place or a pose, and not both", field="body")
        if body.pose is not None:
            theta = body.pose.theta
            return Pose(x=body.pose.x, y=body.pose.y, theta=theta or 0.0), theta is None
        place = site.places.get(body.place or "")
        if place is None:
            names = ", ".join(sorted(site.places)) or "none"
            raise ProblemError(422, f"there is no place {body.place}: known are {names}", field="body.place")
        return Pose(x=place.x, y=place.y, theta=place.theta or 0.0), place.theta is None

    @app.get("/api/v1/robots", tags=["robots"], summary="All robots", responses=answer_schema(app, list[RobotView]))
    async def list_robots() -> Response:
        views = [
            RobotView(
                id=robot,
                configured=robot in configured,
                pose=service.poses.get(robot),
                state=service.states.get(robot),
                goal=_goal_view(robot, service.goals[robot]) if robot in service.goals else None,
                plan=_plan_view(path) if (path := service.path(robot)) else None,
            )
            for robot in robots()
        ]
        return _json(views)

    @app.get(
        "/api/v1/robots/{robot}/goal", tags=["robots"], summary="A robot's mission",
        responses=answer_schema(app, GoalView),
    )  # fmt: skip
    async def get_goal(robot: str) -> Response:
        stored = service.goals.get(known(robot))
        if stored is None:
            raise ProblemError(404, f"robot {robot} has no mission")
        return _json(_goal_view(robot, stored))

    @app.put(
        "/api/v1/robots/{robot}/goal", tags=["robots"], summary="Send a robot to a place or pose",
        responses=answer_schema(app, GoalView), openapi_extra=body_schema(app, GoalBody),
    )  # fmt: skip
    async def put_goal(robot: str, request: Request, caller: Annotated[Caller, operator]) -> Response:
        known(robot)
        body = await read_body(request, GoalBody)
        pose, any_heading = wanted(body)
        try:
            answer = await service.send(robot, pose, caller.name, place=body.place, any_heading=any_heading)
        except StoreError as error:
            raise ProblemError(503, f"the mission is not stored: {error}", headers=RETRY_AFTER) from error
        if isinstance(answer, Refusal):
            field = "body.place" if body.place else "body.pose"
            raise ProblemError(
                422, answer.reason, field=field, code=answer.code, name=answer.name, nearest=answer.nearest
            )
        return _json(_goal_view(robot, answer))

    @app.delete("/api/v1/robots/{robot}/goal", tags=["robots"], summary="Cancel a robot's mission", status_code=204)
    async def delete_goal(robot: str, caller: Annotated[Caller, operator]) -> Response:
        try:
            there = await service.cancel(known(robot), caller.name)
        except StoreError as error:
            raise ProblemError(503, f"the mission is not cancelled: {error}", headers=RETRY_AFTER) from error
        if not there:
            raise ProblemError(404, f"robot {robot} has no mission")
        return Response(status_code=204)

    @app.post(
        "/api/v1/plan", tags=["plan"], summary="Preview a way; a refusal is an answer, too",
        responses=answer_schema(app, PlanReply), openapi_extra=body_schema(app, PlanRequest),
    )  # fmt: skip
    async def preview(request: Request) -> Response:
        return _json(await service.preview(await read_body(request, PlanRequest)))

    return app
