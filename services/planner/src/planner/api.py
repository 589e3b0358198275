"""REST under /api/v1: robots with their missions, plans on request, and operators' commands to robots."""

import secrets
from collections.abc import Callable, Mapping
from functools import partial

from fastapi import FastAPI
from msgspec import structs

from fog_contracts.messages import (
    Arrival,
    GoalOutcome,
    GoalView,
    Message,
    Mode,
    OutOfService,
    Place,
    PlanReply,
    PlanRequest,
    PlanView,
    Refusal,
    RobotPose,
    RobotSummary,
    ServiceReason,
    TimeToLive,
)
from fog_contracts.site import Site
from fog_runtime.health import Health
from fog_runtime.http import (
    Answer,
    Body,
    ClientHost,
    IfMatch,
    Operator,
    ProblemError,
    Routes,
    Tokens,
    Viewer,
    etag,
    expected_tag,
    make_app,
)
from fog_runtime.http.store_routes import (
    IdempotencyKey,
    IfNoneMatch,
    add_recovery,
    add_store_errors,
    attempt_of,
    must_be_new,
)
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.stores.redis_store import IdempotencyError
from planner.api_commands import KnownPlaces, add_commands
from planner.api_visits import add_visits
from planner.config import PlannerConfig
from planner.lifts.api import add_floors
from planner.problems import PlannerProblem
from planner.query_queue import BusyError
from planner.robot_operator import CommandError
from planner.schedules.api import add_schedules
from planner.service import Service
from planner.stops import GoalBody, MissionBody, Order
from planner.store import NO_MISSION, MissionConflictError, OutOfServiceError, StoredGoal
from planner.tours.api import (
    Conditions,
    MissionView,
    goal_pose,
    goal_refused,
    mission_answer,
    mission_order,
)
from planner.undo import add_undo


class ServiceBody(Message, frozen=True, kw_only=True):
    """Why a robot is out of service, and for how long (s); without `ttl_s` until somebody puts it back."""

    reason: ServiceReason
    ttl_s: TimeToLive | None = None


class RobotView(RobotSummary, frozen=True, kw_only=True):
    """A robot with its latest pose, state, goal and plan; `arrival`: null when it has no path, or waits.

    `waits`: why its mission does not go on here yet, such as while it comes by a lift; empty when it does.
    """

    pose: RobotPose | None
    arrival: Arrival | None = None
    waits: str = ""


def _goal_view(robot: str, stored: StoredGoal) -> GoalView:
    view = GoalView.of(robot, structs.replace(stored.goal, any_heading=stored.any_heading))
    assert view is not None  # what is stored has a pose
    return view


def _goal_answer(robot: str, stored: StoredGoal, status: int = 200) -> Answer[GoalView]:
    return Answer(_goal_view(robot, stored), etag(stored.goal.goal_id), status=status)


def _without_mission(robot: str) -> ProblemError:
    return ProblemError(PlannerProblem.NO_MISSION, f"robot {robot} has no mission: PUT one first")


class _Robots:
    """The robots that are configured or were heard from; asking for any other one is a problem (404)."""

    def __init__(self, service: Service, site: Site) -> None:
        self._service = service
        self._configured = {robot.id: robot for robot in site.robots}

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

    def check_single(self, robot: str) -> None:
        """Raise a `ProblemError` for an unknown robot, and for one whose id two agents use."""
        self.check(robot)
        if self._service.operator.is_doubled(robot):
            detail = f"two agents use the id of robot {robot}: switch one off, or give it another id, then try again"
            raise ProblemError(PlannerProblem.ROBOT_DOUBLED, detail)

    def mode(self, robot: str) -> Mode | None:
        """Return a robot's mode, None without a state."""
        state = self._service.states.get(robot)
        return None if state is None else state.mode

    def view(self, robot: str) -> RobotView:
        """Return a known robot with pose, state, mission and plan."""
        service, described = self._service, self._configured.get(robot)
        return RobotView(
            id=robot,
            configured=described is not None,
            pose=service.poses.get(robot),
            state=service.states.get(robot),
            goal=_goal_view(robot, service.goals[robot]) if robot in service.goals else None,
            plan=PlanView.of(service.path(robot)),
            out_of_service=service.missions.out_of_service(robot),
            arrival=service.arrival(robot) if robot in service.goals else None,
            waits=service.riding.waits(robot),
            start=None if described is None else described.start,
            dock=None if described is None else described.dock,
        )


def _places(service: Service, site: Site) -> Mapping[str, Place]:
    """Return the places by id: those of `site.toml` until the map-service has told how operators have changed them."""
    return site.places if service.places is None else service.places


def make_api(service: Service, site: Site, health: Health, tokens: Tokens, standby: Callable[[], str] = str) -> FastAPI:
    """Return the app over a running service; while `standby` returns a reason, nothing can be written."""
    app = make_app("Fognav planner", health, tokens, standby=standby)
    robots = _Robots(service, site)
    routes = Routes(app, "robots")
    add_store_errors(routes)
    places = partial(_places, service, site)
    routes.raises(
        OutOfServiceError,
        [PlannerProblem.OUT_OF_SERVICE],
        lambda error: ProblemError(PlannerProblem.OUT_OF_SERVICE, str(error)),
    )
    may_go = service.missions.require_in_service
    add_commands(routes, service.operator, places, check=robots.check, may_go=may_go, mode=robots.mode)
    _add_views(routes, service, robots)
    _add_service(routes, service, robots)
    _raise_busy(routes)
    _add_orders(routes, service, robots, places)
    _add_missions(routes, service, robots, places)
    add_undo(routes, service, robots.check)
    add_floors(routes, service, service.riding, robots.check_single)
    add_schedules(routes, service, robots.check, places, standby)
    add_visits(Routes(app, "visits"), lambda: service.visiting, standby)
    _add_plan(Routes(app, "plan"), service, robots, places)
    recovery = Routes(app, "store")
    add_store_errors(recovery)
    add_recovery(recovery, service.missions)
    return app


def _raise_busy(routes: Routes) -> None:
    """Let the routes raise that too many plans wait."""
    routes.raises(
        BusyError,
        [PlannerProblem.BUSY],
        lambda error: ProblemError(
            PlannerProblem.BUSY, str(error), headers={"Retry-After": f"{error.retry_after:.0f}"}
        ),
    )


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


def _add_orders(routes: Routes, service: Service, robots: _Robots, places: KnownPlaces) -> None:
    """Add the routes that send and stop robots."""
    routes.raises(
        MissionConflictError,
        [PlannerProblem.MISSION_CHANGED],
        lambda error: ProblemError(PlannerProblem.MISSION_CHANGED, str(error)),
    )

    @routes.put(
        "/api/v1/robots/{robot}/goal",
        status=(200, 201),
        raises=[IdempotencyError, MissionConflictError, OutOfServiceError, StoreError],
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
        robots.check_single(robot)
        pose, any_heading = goal_pose(body, places())
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
            raise goal_refused(answer, "body.place" if body.place else "body.pose")
        return _goal_answer(robot, answer, status=201 if new else 200)

    @routes.delete(
        "/api/v1/robots/{robot}/goal",
        raises=[MissionConflictError, OutOfServiceError, StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.NO_MISSION],
    )
    async def delete_goal(robot: str, caller: Operator, if_match: IfMatch = None) -> None:
        """Cancel a robot's mission; with If-Match, only if it is the one that was read.

        Also one with which the robot is on its way to this floor, or from it to another one while it has not left yet:
        it finishes its ride, and drives out of the lift. Once it has left, only the other floor can cancel it (409).
        """
        robots.check(robot)
        if not await service.riding.cancel(robot, caller.name, expected_tag(if_match)):
            raise _without_mission(robot)


def _add_missions(routes: Routes, service: Service, robots: _Robots, places: KnownPlaces) -> None:
    """Add the routes of missions with several stops; `routes` knows the errors of orders."""

    @routes.get("/api/v1/robots/{robot}/mission", problems=[PlannerProblem.NO_ROBOT, PlannerProblem.NO_MISSION])
    async def get_mission(robot: str, _caller: Viewer) -> Answer[MissionView]:
        """Return a robot's mission with all its stops, and its ETag; one that was sent to a goal has one stop."""
        robots.check(robot)
        stored = service.goals.get(robot)
        if stored is None:
            raise _without_mission(robot)
        return mission_answer(robot, stored)

    @routes.put(
        "/api/v1/robots/{robot}/mission",
        status=(200, 201),
        raises=[BusyError, CommandError, IdempotencyError, MissionConflictError, OutOfServiceError, StoreError],
        problems=[
            PlannerProblem.NO_ROBOT,
            PlannerProblem.ROBOT_DOUBLED,
            PlannerProblem.NO_PLACE,
            PlannerProblem.NO_LIFT,
            PlannerProblem.FLOOR_UNKNOWN,
            PlannerProblem.ROBOT_OUTDATED,
            PlannerProblem.NO_POSE,
            PlannerProblem.GOAL_REFUSED,
            PlannerProblem.DEADLINE_TOO_SOON,
        ],
    )
    async def put_mission(  # headers are parameters
        robot: str,
        body: Body[MissionBody],
        caller: Operator,
        if_match: IfMatch = None,
        if_none_match: IfNoneMatch = None,
        idempotency_key: IdempotencyKey = None,
    ) -> Answer[MissionView]:
        """Send a robot to one stop after the other, instead of its mission. `DELETE …/goal` ends all of it.

        Stops may be on other floors: the robot takes lifts there, and those floors' planners go on with the mission.

        With If-Match, only if it still has the leg that was read; with `If-None-Match: *`, only if it has no mission.
        """
        robots.check_single(robot)
        conditions = Conditions(
            caller.name,
            attempt_of(idempotency_key, caller, f"PUT /api/v1/robots/{robot}/mission", body),
            NO_MISSION if must_be_new(if_none_match) else expected_tag(if_match),
        )
        earlier = await service.missions.earlier_result(conditions.attempt)
        if earlier is not None:  # before anything that may have changed since is checked
            return mission_answer(robot, earlier)
        service.missions.require_in_service(robot)
        order = await mission_order(service, robot, body, places(), conditions, PlannerConfig.cruise_speed)
        new = robot not in service.goals
        answer = await service.send(order)
        if isinstance(answer, Refusal):
            raise goal_refused(answer, "body.stops.0")
        return mission_answer(robot, answer, status=201 if new else 200)


def _add_service(routes: Routes, service: Service, robots: _Robots) -> None:
    """Add the routes by which operators take robots out of service, and put them back."""

    @routes.put("/api/v1/robots/{robot}/out-of-service", raises=[StoreError], problems=[PlannerProblem.NO_ROBOT])
    async def put_out_of_service(robot: str, body: Body[ServiceBody], caller: Operator) -> OutOfService:
        """Take a robot out of service: its mission ends, and it gets none until it is put back, or `ttl_s` ends.

        That holds for everybody's goals, and after restarts. It is no stop: stop the robot first if it must not move.
        """
        robots.check(robot)
        now = service.stamp()
        until = None if body.ttl_s is None else now + body.ttl_s
        out = OutOfService(id=secrets.token_hex(8), reason=body.reason, by=caller.name, since=now, until=until)
        await service.missions.take_out(robot, out, caller.name)
        return out

    @routes.delete(
        "/api/v1/robots/{robot}/out-of-service",
        raises=[OutOfServiceError, StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.IN_SERVICE],
    )
    async def delete_out_of_service(robot: str, caller: Operator) -> None:
        """Put a robot back into service. It stays where it is until somebody sends it.

        One that has left for another floor can't be. One whose own record of its floor is older than this floor's
        can: by that the operator says that it is here.
        """
        robots.check(robot)
        if not await service.missions.put_back(robot, caller.name):
            raise ProblemError(PlannerProblem.IN_SERVICE, f"robot {robot} is in service")


def _add_plan(routes: Routes, service: Service, robots: _Robots, places: KnownPlaces) -> None:
    _raise_busy(routes)

    @routes.post("/api/v1/plan", raises=[BusyError])
    async def preview(client: ClientHost, body: Body[PlanRequest]) -> PlanReply:
        """Plan a path without side effects; the reply may be a refusal."""
        return await service.preview(body, client)

    @routes.post(
        "/api/v1/robots/{robot}/goal/dry-run",
        raises=[BusyError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.NO_PLACE, PlannerProblem.NO_POSE],
    )
    async def dry_run_goal(robot: str, body: Body[GoalBody], caller: Viewer) -> GoalOutcome:
        """Return the path that a robot would get to a goal from where it stands, and do nothing; or the refusal."""
        robots.check(robot)
        pose, _ = goal_pose(body, places())
        outcome = await service.dry_runs.goal(robot, pose.x, pose.y, f"person {caller.asker}")
        if outcome is None:
            detail = f"it is not known where robot {robot} is: switch it on and localize it, then try again"
            raise ProblemError(PlannerProblem.NO_POSE, detail)
        return outcome
