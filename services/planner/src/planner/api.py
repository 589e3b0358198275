"""REST under /api/v1: robots with their missions, plans on request, and operators' commands to robots."""

from collections.abc import Callable

from fastapi import FastAPI

from fog_contracts.messages import (
    CommandKind,
    CommandReply,
    Id,
    Message,
    Metres,
    Mode,
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
from fog_runtime.http import (
    Answer,
    Body,
    ClientHost,
    HttpProblem,
    IdempotencyKey,
    IfMatch,
    IfNoneMatch,
    Operator,
    ProblemCode,
    ProblemError,
    Routes,
    Tokens,
    Viewer,
    add_recovery,
    add_store_errors,
    attempt_of,
    etag,
    expected_tag,
    make_app,
    must_be_new,
)
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from planner.query_queue import BusyError
from planner.robot_operator import CommandError, RobotOperator
from planner.service import Service
from planner.store import NO_MISSION, MissionConflictError, Order, StoredGoal


class PlannerProblem(ProblemCode):
    """Problems of the planner."""

    NO_ROBOT = "no_robot", 404, "No robot has this id"
    NO_MISSION = "no_mission", 404, "The robot has no mission"
    NO_PLACE = "no_place", 422, "The site has no such place"
    GOAL_REFUSED = (
        "goal_refused",
        422,
        "The goal can never be reached: `refusal`, and Nav2's `code` and `name`, say why",
    )
    MISSION_CHANGED = "mission_changed", 412, "The robot has another mission than the request expects, or has one"
    ROBOT_DOUBLED = "robot_doubled", 409, "Two agents use this robot's id"
    COMMAND_REFUSED = "command_refused", 409, "The robot refuses: `refusal` and `causes` identify why"
    COMMAND_LOST = "command_lost", 504, "The robot does not answer, or this service has no operators' key"
    BUSY = "busy", 503, "Too many plans wait, or of this client: `Retry-After` says when to try again"


class StartPose(Message, frozen=True, kw_only=True):
    """Where a robot stands: m and rad, frame `map`."""

    x: Metres
    y: Metres
    theta: Radians


class CommandBody(Message, frozen=True, kw_only=True):
    """A command; `initial_pose` comes with a pose, or with the id of a place that has a heading."""

    kind: CommandKind
    pose: StartPose | None = None
    place: Id | None = None


class CommandOutcome(Message, frozen=True, kw_only=True):
    """An accepted command: what the robot says of it, and the robot's mode before it."""

    accepted: bool
    reason: str
    mode: Mode | None


def add_commands(
    routes: Routes,
    operator: RobotOperator,
    site: Site,
    *,
    check: Callable[[str], None],
    mode: Callable[[str], Mode | None],
) -> None:
    """Add the routes; `check` raises a `ProblemError` for an unknown robot, `mode` returns a robot's mode."""
    routes.raises(
        CommandError,
        [PlannerProblem.COMMAND_LOST],
        lambda error: ProblemError(PlannerProblem.COMMAND_LOST, str(error)),
    )

    def outcome(robot: str, reply: CommandReply) -> CommandOutcome:
        if not reply.accepted:
            raise ProblemError(
                PlannerProblem.COMMAND_REFUSED,
                reply.reason,
                mode=mode(robot),
                refusal=reply.code,
                causes=reply.causes,
            )
        return CommandOutcome(accepted=True, reason=reply.reason, mode=mode(robot))

    @routes.post(
        "/api/v1/robots/{robot}/commands",
        raises=[CommandError, StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.COMMAND_REFUSED, PlannerProblem.NO_PLACE],
    )
    async def post_command(robot: str, body: Body[CommandBody], caller: Operator) -> CommandOutcome:
        """Command a robot; the robot itself accepts or refuses."""
        check(robot)
        return outcome(robot, await operator.send(body.kind, robot, caller.name, _pose(body, site)))

    routes.urgent("/api/v1/robots/{robot}/stop")

    @routes.post(
        "/api/v1/robots/{robot}/stop",
        raises=[CommandError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.COMMAND_REFUSED],
    )
    async def stop(robot: str, client: ClientHost) -> CommandOutcome:
        """Stop a robot at once. Anybody may: this needs no token. An operator must enable it again."""
        check(robot)
        return outcome(robot, await operator.stop(robot, f"stop from {client or 'an unknown address'}"))


def _pose(body: CommandBody, site: Site) -> Pose | None:
    """Return the pose of a command; raises a `ProblemError` for one that does not belong to it, or lacks."""
    if body.kind != "initial_pose":
        if body.pose is not None or body.place is not None:
            detail = f"{body.kind} takes neither pose nor place: leave them out"
            raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.pose")
        return None
    if (body.pose is None) == (body.place is None):
        detail = "give either a pose or a place, and not both"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.pose")
    if body.pose is not None:
        return Pose(x=body.pose.x, y=body.pose.y, theta=body.pose.theta)
    place = site.places.get(body.place or "")
    if place is None or place.theta is None:
        known = ", ".join(sorted(name for name, found in site.places.items() if found.theta is not None)) or "none"
        detail = f"there is no place {body.place} with a heading; places that have one: {known}"
        raise ProblemError(PlannerProblem.NO_PLACE, detail, field="body.place")
    return Pose(x=place.x, y=place.y, theta=place.theta)


class GoalPose(Message, frozen=True, kw_only=True):
    """A position in m, frame `map`; without `theta` (rad) any heading is accepted."""

    x: Metres
    y: Metres
    theta: Radians | None = None


class GoalBody(Message, frozen=True, kw_only=True):
    """A goal: the id of a place of the site, or a pose; exactly one of the two."""

    place: Id | None = None
    pose: GoalPose | None = None


class GoalView(Message, frozen=True, kw_only=True):
    """A mission; `any_heading`: the robot may arrive with any heading."""

    robot: str
    goal_id: str
    pose: Pose
    place: str | None
    any_heading: bool
    stamp: float


class PlanView(Message, frozen=True, kw_only=True):
    """The current plan: version, number of corners, released length (m), or refusal."""

    plan_id: int
    map_epoch: int
    map_seq: int
    points: int
    released_length: float
    refusal: Refusal | None


class RobotView(Message, frozen=True, kw_only=True):
    """A robot with its latest pose, state, goal and plan."""

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


def _goal_answer(robot: str, stored: StoredGoal, status: int = 200) -> Answer[GoalView]:
    return Answer(_goal_view(robot, stored), etag(stored.goal.goal_id), status=status)


def _without_mission(robot: str) -> ProblemError:
    return ProblemError(PlannerProblem.NO_MISSION, f"robot {robot} has no mission: PUT one first")


def _plan_view(path: RobotPath) -> PlanView:
    return PlanView(
        plan_id=path.plan_id,
        map_epoch=path.map_epoch,
        map_seq=path.map_seq,
        points=len(path.points),
        released_length=path.released_length,
        refusal=path.refusal,
    )


class _Robots:
    """The robots that are configured or were heard from; asking for any other one is a problem (404)."""

    def __init__(self, service: Service, site: Site) -> None:
        self._service = service
        self._configured = {robot.id for robot in site.robots}

    def ids(self) -> list[str]:
        """Return the ids of all known robots, sorted."""
        service = self._service
        return sorted({*self._configured, *service.poses, *service.states, *service.goals})

    def check(self, robot: str) -> None:
        """Raise a `ProblemError` for an unknown robot."""
        known = self.ids()
        if robot not in known:
            detail = f"there is no robot {robot}; known robots: {', '.join(known) or 'none'}"
            raise ProblemError(PlannerProblem.NO_ROBOT, detail)

    def mode(self, robot: str) -> Mode | None:
        """Return a robot's mode, None without a state."""
        state = self._service.states.get(robot)
        return None if state is None else state.mode

    def view(self, robot: str) -> RobotView:
        """Return a known robot with pose, state, mission and plan."""
        service = self._service
        return RobotView(
            id=robot,
            configured=robot in self._configured,
            pose=service.poses.get(robot),
            state=service.states.get(robot),
            goal=_goal_view(robot, service.goals[robot]) if robot in service.goals else None,
            plan=_plan_view(path) if (path := service.path(robot)) else None,
        )


def _goal_pose(body: GoalBody, site: Site) -> tuple[Pose, bool]:
    """Return the pose of a goal, and whether any heading will do; raises a `ProblemError` for an invalid goal."""
    if (body.place is None) == (body.pose is None):
        raise ProblemError(HttpProblem.REQUEST_INVALID, "give either a place or a pose, and not both", field="body")
    if body.pose is not None:
        theta = body.pose.theta
        return Pose(x=body.pose.x, y=body.pose.y, theta=theta or 0.0), theta is None
    place = site.places.get(body.place or "")
    if place is None:
        names = ", ".join(sorted(site.places)) or "none"
        detail = f"there is no place {body.place}; known places: {names}"
        raise ProblemError(PlannerProblem.NO_PLACE, detail, field="body.place")
    return Pose(x=place.x, y=place.y, theta=place.theta or 0.0), place.theta is None


def make_api(service: Service, site: Site, health: Health, tokens: Tokens, standby: Callable[[], str] = str) -> FastAPI:
    """Return the app over a running service; while `standby` returns a reason, nothing can be written."""
    app = make_app("Fognav planner", health, tokens, standby=standby)
    robots = _Robots(service, site)
    routes = Routes(app, "robots")
    add_store_errors(routes)
    add_commands(routes, service.operator, site, check=robots.check, mode=robots.mode)
    _add_views(routes, service, robots)
    _add_orders(routes, service, robots, site)
    _add_plan(Routes(app, "plan"), service)
    recovery = Routes(app, "store")
    add_store_errors(recovery)
    add_recovery(recovery, service.missions)
    return app


def _add_views(routes: Routes, service: Service, robots: _Robots) -> None:
    """Add the routes that read robots and missions."""

    @routes.get("/api/v1/robots")
    async def list_robots(_caller: Viewer) -> list[RobotView]:
        """List all robots with pose, state, mission and plan."""
        return [robots.view(robot) for robot in robots.ids()]

    @routes.get("/api/v1/robots/{robot}", raises=[CommandError], problems=[PlannerProblem.NO_ROBOT])
    async def get_robot(robot: str, _caller: Viewer, after: float | None = None) -> RobotView:
        """Return a robot with pose, state, mission and plan.

        With `after`, the `clock` of a state that was read before, only when the robot has another one: to watch it.
        """
        robots.check(robot)
        if after is not None:
            await service.operator.next_state(robot, after)
        return robots.view(robot)

    @routes.get("/api/v1/robots/{robot}/goal", problems=[PlannerProblem.NO_ROBOT, PlannerProblem.NO_MISSION])
    async def get_goal(robot: str, _caller: Viewer) -> Answer[GoalView]:
        """Return a robot's mission with its ETag."""
        robots.check(robot)
        stored = service.goals.get(robot)
        if stored is None:
            raise _without_mission(robot)
        return _goal_answer(robot, stored)


def _add_orders(routes: Routes, service: Service, robots: _Robots, site: Site) -> None:
    """Add the routes that send and stop robots."""
    routes.raises(
        MissionConflictError,
        [PlannerProblem.MISSION_CHANGED],
        lambda error: ProblemError(PlannerProblem.MISSION_CHANGED, str(error)),
    )

    @routes.put(
        "/api/v1/robots/{robot}/goal",
        status=(200, 201),
        raises=[IdempotencyError, MissionConflictError, StoreError],
        problems=[
            PlannerProblem.NO_ROBOT,
            PlannerProblem.ROBOT_DOUBLED,
            PlannerProblem.NO_PLACE,
            PlannerProblem.GOAL_REFUSED,
        ],
    )
    async def put_goal(  # headers are parameters
        robot: str,
        body: Body[GoalBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[GoalView]:
        """Send a robot to a place or pose, instead of its mission.

        With If-Match, only if it still has the mission that was read; with `If-None-Match: *`, only if it has none.
        """
        robots.check(robot)
        if service.operator.is_doubled(robot):
            detail = f"two agents use the id of robot {robot}: switch one off, or give it another id, then try again"
            raise ProblemError(PlannerProblem.ROBOT_DOUBLED, detail)
        pose, any_heading = _goal_pose(body, site)
        order = Order(
            robot,
            pose,
            caller.name,
            place=body.place,
            any_heading=any_heading,
            attempt=attempt_of(idempotency_key, caller, f"PUT /api/v1/robots/{robot}/goal", body),
            expected=NO_MISSION if must_be_new(if_none_match) else expected_tag(if_match),
        )
        new = robot not in service.goals
        answer = await service.send(order)
        if isinstance(answer, Refusal):
            field = "body.place" if body.place else "body.pose"
            raise ProblemError(
                PlannerProblem.GOAL_REFUSED,
                answer.reason,
                field=field,
                code=answer.code,
                name=answer.name,
                refusal=answer.kind,
                nearest=answer.nearest,
            )
        return _goal_answer(robot, answer, status=201 if new else 200)

    @routes.delete(
        "/api/v1/robots/{robot}/goal",
        raises=[MissionConflictError, StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.NO_MISSION],
    )
    async def delete_goal(robot: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Cancel a robot's mission; with If-Match, only if it is the one that was read."""
        robots.check(robot)
        if not await service.missions.cancel(robot, caller.name, expected_tag(if_match)):
            raise _without_mission(robot)


def _add_plan(routes: Routes, service: Service) -> None:
    routes.raises(
        BusyError,
        [PlannerProblem.BUSY],
        lambda error: ProblemError(
            PlannerProblem.BUSY, str(error), headers={"Retry-After": f"{error.retry_after:.0f}"}
        ),
    )

    @routes.post("/api/v1/plan", raises=[BusyError])
    async def preview(client: ClientHost, body: Body[PlanRequest]) -> PlanReply:
        """Plan a path without side effects; the reply may be a refusal."""
        return await service.preview(body, client)
