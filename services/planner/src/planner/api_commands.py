"""REST of operators' commands to robots."""

from collections.abc import Callable, Mapping

from fog_contracts.messages import CommandKind, CommandReply, Id, Message, Metres, Mode, Place, Pose, Radians
from fog_runtime.http import Anybody, Body, ClientHost, HttpProblem, Operator, ProblemError, Routes
from fog_runtime.stores.redis_connection import StoreError
from planner.problems import PlannerProblem
from planner.robot_operator import CommandError, RobotOperator
from planner.store import OutOfServiceError

KnownPlaces = Callable[[], Mapping[str, Place]]
"""Returns the places that there are now, by id."""


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
    places: KnownPlaces,
    *,
    check: Callable[[str], None],
    may_go: Callable[[str], None],
    mode: Callable[[str], Mode | None],
) -> None:
    """Add the routes; `check` raises a `ProblemError` for an unknown robot, `mode` returns a robot's mode.

    `may_go` raises `OutOfServiceError` for a robot that gets no goal, such as its dock.
    """
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
        raises=[CommandError, OutOfServiceError, StoreError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.COMMAND_REFUSED, PlannerProblem.NO_PLACE],
    )
    async def post_command(robot: str, body: Body[CommandBody], caller: Operator) -> CommandOutcome:
        """Command a robot; the robot itself accepts or refuses."""
        check(robot)
        if body.kind == "dock":
            may_go(robot)
        return outcome(robot, await operator.send(body.kind, robot, caller.name, _pose(body, places())))

    routes.urgent("/api/v1/robots/{robot}/stop")

    @routes.post(
        "/api/v1/robots/{robot}/stop",
        raises=[CommandError],
        problems=[PlannerProblem.NO_ROBOT, PlannerProblem.COMMAND_REFUSED],
    )
    async def stop(robot: str, client: ClientHost, caller: Anybody) -> CommandOutcome:
        """Stop a robot at once. Anybody may: this needs no token. An operator must enable it again."""
        check(robot)
        sender = f"stop from {client or 'an unknown address'}" if caller is None else caller.name
        commands = caller is not None and caller.role in ("operator", "admin")
        return outcome(robot, await operator.stop(robot, sender, each=commands))


def _pose(body: CommandBody, places: Mapping[str, Place]) -> Pose | None:
    """Return the pose of a command; raises a `ProblemError` for one that does not belong to it, or lacks."""
    if body.kind == "hand_over":
        detail = "a robot is handed over by a goal on another floor: PUT /api/v1/robots/{robot}/floor"
        raise ProblemError(HttpProblem.REQUEST_INVALID, detail, field="body.kind")
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
    place = places.get(body.place or "")
    if place is None or place.theta is None:
        known = ", ".join(sorted(name for name, found in places.items() if found.theta is not None)) or "none"
        detail = f"there is no place {body.place} with a heading; places that have one: {known}"
        raise ProblemError(PlannerProblem.NO_PLACE, detail, field="body.place")
    return Pose(x=place.x, y=place.y, theta=place.theta)
