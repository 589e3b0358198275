"""`fognav robot`: an operator's commands to a robot, its state, and its mission."""

import asyncio
import contextlib
import math
import sys
import time
from collections.abc import Mapping
from typing import Annotated, Any, Final

import msgspec
import typer

from fog_contracts.commands import PROFILE_OF
from fog_contracts.messages import CommandKind, Mode, Pose, ProfileName
from fog_runtime import logs
from fognav.commands.robot_file import robot_app
from fognav.operate import robot_commands
from fognav.operate.fog import Fog, Outcome, RefusedError, find_fog
from fognav.operate.options import NUMBERS, FogOption, JsonOption, RobotOption, duration, goal_body, numbers
from fognav.output import (
    NOT_TRUE,
    FailedError,
    WrongUseError,
    envelope,
    exit_codes,
    print_answer,
    print_json,
    print_line,
    print_result,
)
from fognav.programs import MAP_SERVICE, PLANNER

_WAITS_FOR: Final[Mapping[Mode | None, str]] = {
    "INIT": "; it waits to be enabled (fognav robot enable)",
    "FAULT": "; it waits to be reset and enabled (fognav robot reset, fognav robot enable)",
}
"""What keeps a robot from a goal that was accepted, until its operator does it."""

Target = Annotated[str, typer.Argument(metavar="PLACE|X,Y[,THETA]", help="A place of the site, or metres and radians.")]
Start = Annotated[str, typer.Argument(metavar="PLACE|X,Y,THETA", help="A place of the site, or metres and radians.")]


@robot_app.command("enable", epilog="Example: fognav robot enable")
def robot_enable(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a robot drive that waits for it."""
    _run_command("enable", robot, fog, json=json)


@robot_app.command("disable", epilog="Example: fognav robot disable --robot r1")
def robot_disable(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Stop a robot at once; its mission is kept.

    The robot continues it when it is enabled again. While it can't be reached, this says so and tries again.
    """
    with exit_codes():
        _report(robot_commands.stop(find_fog(fog), robot, print_line), json=json)


@robot_app.command("reset", epilog="Example: fognav robot reset && fognav robot enable")
def robot_reset(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Reset a robot's latched fault, after its cause is gone."""
    _run_command("reset", robot, fog, json=json)


@robot_app.command("egress", epilog="Example: fognav robot egress && fognav robot watch --seconds 30")
def robot_egress(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a robot leave the blocked area or zone that it stands in.

    It drives out slowly, for 60 s at most, and then waits to be enabled. Watch it: the area is blocked for a reason.
    """
    _run_command("egress", robot, fog, json=json)


@robot_app.command("dock", epilog="Example: fognav robot dock && fognav robot watch --seconds 60")
def robot_dock(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Send an enabled robot to its dock.

    It drives to the front of the dock like to any goal; then its base drives into the dock by itself, for 60 s at most.
    Watch it there: the base does not know of zones.
    """
    _run_command("dock", robot, fog, json=json)


@robot_app.command("undock", epilog="Example: fognav robot undock")
def robot_undock(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a robot leave its dock, 0.3 m straight back.

    A goal does the same for an enabled robot.
    """
    _run_command("undock", robot, fog, json=json)


@robot_app.command("back-off", epilog="Example: fognav robot back-off && fognav robot reset")
def robot_back_off(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a robot back off from what it has bumped into, 10 cm at most.

    Its fault stays until it is reset. Look behind it first: only its lidar does otherwise.
    """
    _run_command("back_off", robot, fog, json=json)


@robot_app.command("turn", epilog="Example: fognav robot turn && fognav robot watch --seconds 15")
def robot_turn(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a robot turn in place to find out where it is.

    `fognav robot status` lists the places that its scans leave. It stops turning once it knows, and then waits to be
    enabled. Watch it: its lidar guards the turn, but it knows of no zone yet.
    """
    _run_command("turn", robot, fog, json=json)


@robot_app.command("advance", epilog="Example: fognav robot advance && fognav robot watch --seconds 15")
def robot_advance(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a robot drive 0.4 m ahead to find out where it is.

    This tells places apart between which a turn does not decide. Watch it: its lidar guards the way, but it knows of no
    zone yet.
    """
    _run_command("advance", robot, fog, json=json)


@robot_app.command("stop", epilog="Example: fognav robot stop")
def robot_stop(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Stop a robot at once and end its mission.

    While the robot can't be reached, neither directly nor through the planner, this says so and tries again.
    """
    with exit_codes():
        found = find_fog(fog)
        outcome = robot_commands.stop(found, robot, print_line)
        # The robot comes first: it stops whether or not the planner answers.
        reason = f"{outcome.reason}; {_end_mission(found, robot)}"
        _report(msgspec.structs.replace(outcome, reason=reason), json=json)


@robot_app.command("pose", context_settings=NUMBERS, epilog="Example: fognav robot pose 12.5,3,1.57")
def robot_pose(pose: Start, *, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Tell a robot where it is.

    This is for a robot that does not find out by itself; it must be disabled.
    """
    with exit_codes():
        found = find_fog(fog)
        place = _place(found, pose)
        if place is None:
            x, y, theta = numbers(pose, (3,), "X,Y,THETA")
        elif place.get("theta") is None:
            raise WrongUseError(f"place {pose} has no heading: give {place['x']},{place['y']},THETA")
        else:
            x, y, theta = place["x"], place["y"], place["theta"]
        outcome = robot_commands.command(found, found.robot(robot), "initial_pose", Pose(x=x, y=y, theta=theta))
        _report(outcome, json=json)


@robot_app.command("profile", epilog="Example: fognav robot profile fog")
def robot_profile(
    profile: Annotated[ProfileName, typer.Argument(help="Who plans: the robot on its own, or the fog.")],
    *,
    robot: RobotOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Let a robot navigate by another profile; it must be at rest.

    fog: by the fog's map and paths, as usual. default: on its own, as without Fognav, knowing no hazard, area or zone.
    full: on its own, but with the fog's hazards. Both need fognav-experiments on the robot.
    An agent that restarts is in the profile fog again.
    """
    kind = next(kind for kind, name in PROFILE_OF.items() if name == profile)
    _run_command(kind, robot, fog, json=json)


@robot_app.command("goal", context_settings=NUMBERS, epilog="Example: fognav robot goal b")
def robot_goal(
    goal: Target,
    *,
    floor: Annotated[
        str | None, typer.Option("--floor", help="The floor of the goal, if it is another one: it takes the lift.")
    ] = None,
    robot: RobotOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Send a robot to a place or position.

    It must be enabled to drive there.
    """
    with exit_codes():
        found = find_fog(fog)
        chosen = found.robot(robot)
        try:
            path, body = ("goal", goal_body(goal)) if floor is None else ("floor", {**goal_body(goal), "floor": floor})
            found.send("PUT", PLANNER, f"/api/v1/robots/{chosen}/{path}", body)
        except RefusedError as error:
            _report(_refused(error, _view(found, chosen)[1]), json=json)
        mode = _view(found, chosen)[1]
        waits, where = _WAITS_FOR.get(mode, ""), "" if floor is None else f" on {floor}, by the lift"
        _report(Outcome(accepted=True, reason=f"robot {chosen} goes to {goal}{where}{waits}", mode=mode), json=json)


@robot_app.command("cancel", epilog="Example: fognav robot cancel")
def robot_cancel(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """End a robot's mission; the robot stays enabled."""
    with exit_codes():
        found = find_fog(fog)
        chosen = found.robot(robot)
        try:
            found.send("DELETE", PLANNER, f"/api/v1/robots/{chosen}/goal")
        except RefusedError as error:
            _report(_refused(error, _view(found, chosen)[1]), json=json)
        except FailedError as error:
            # Without the planner the robot can drop its goal itself, until the planner is back.
            outcome = asyncio.run(_cancel(found, chosen))
            _report(msgspec.structs.replace(outcome, reason=f"{outcome.reason}; {error}"), json=json)
        _report(
            Outcome(accepted=True, reason=f"the mission of robot {chosen} is ended", mode=_view(found, chosen)[1]),
            json=json,
        )


@robot_app.command("take-out", epilog='Example: fognav robot take-out --reason "worn wheel" --for 2h')
def robot_take_out(
    *,
    reason: Annotated[str, typer.Option("--reason", help="What whoever asks for it is told.")],
    length: Annotated[
        str | None, typer.Option("--for", help="For how long, such as 30m or 2h; else until put-back.")
    ] = None,
    robot: RobotOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Take a robot out of service: nobody can send it.

    Its mission ends. That holds until `fognav robot put-back`, after restarts, too. It is no stop: the robot stays
    enabled.
    """
    with exit_codes():
        body = {"reason": reason, **({} if length is None else {"ttl_s": duration(length, "--for")})}
        _service(find_fog(fog), robot, "PUT", body, f"out of service: {reason}", json=json)


@robot_app.command("put-back", epilog="Example: fognav robot put-back --robot r1")
def robot_put_back(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Put a robot back into service, so that it can be sent again."""
    with exit_codes():
        _service(find_fog(fog), robot, "DELETE", None, "in service", json=json)


@robot_app.command("status", epilog="Example: fognav robot status --json")
def robot_status(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show a robot's mode, pose, mission and plan."""
    with exit_codes():
        found = find_fog(fog)
        view, mode = _view(found, found.robot(robot))
        if json:
            print_json({"mode": mode, "reasons": view["state"]["reasons"] if view["state"] else [], **view})
            return
        print_answer(f"{view['id']}: {_describe(view['state'], view['pose'])}")
        if mode == "FAULT":
            print_answer("  look at the robot and mend the cause, then: fognav robot reset, fognav robot enable")
        if (out := view.get("out_of_service")) is not None:
            until = (
                "" if out["until"] is None else time.strftime(", until %Y-%m-%d %H:%M", time.localtime(out["until"]))
            )
            print_answer(f"  out of service: {out['reason']} ({out['by']}{until}); fognav robot put-back ends that")
        if (goal := view["goal"]) is not None:
            print_answer(f"  goal: {goal['place'] or _position(goal['pose'])}")
        if why := view.get("waits"):
            print_answer(f"  waits: {why}")
        if (arrival := view.get("arrival")) is not None:
            times = f"{arrival['expected_s']:.0f} s ({arrival['earliest_s']:.0f} to {arrival['latest_s']:.0f})"
            print_answer(f"  arrives in {times}")
        if (plan := view["plan"]) is not None and plan["refusal"] is not None:
            print_answer(f"  no path: {plan['refusal']['reason']}")
        elif plan is not None and plan.get("blocked_way") is not None:
            print_answer(f"  {plan['blocked_way']['reason']}")
        elif plan is not None and plan.get("waits_for") is not None:
            print_answer(f"  waits for {plan['waits_for']} to pass")


@robot_app.command("watch", epilog="Example: fognav robot watch --seconds 60 --json")
def robot_watch(
    *,
    seconds: Annotated[float, typer.Option("--seconds", min=0.0, help="Duration; 0: until Ctrl-C.")] = 0.0,
    robot: RobotOption = None,
    fog: FogOption = None,
    json: Annotated[bool, typer.Option("--json", help="Write one JSON object per line to standard output.")] = False,
) -> None:
    """Print a robot's state whenever it changes.

    An unchanged state is printed once a second, because the robot publishes it so.
    """
    with exit_codes(), contextlib.suppress(KeyboardInterrupt):
        found = find_fog(fog)
        chosen = found.robot(robot)
        _watch(found, chosen, seconds, json=json)


def _run_command(kind: CommandKind, robot: str | None, fog: str | None, *, json: bool) -> None:
    with exit_codes():
        found = find_fog(fog)
        _report(robot_commands.command(found, found.robot(robot), kind), json=json)


async def _cancel(fog: Fog, robot: str) -> Outcome:
    logs.configure("fognav", "error", "text")
    async with robot_commands.connect(fog, robot) as connected:
        return await connected.stop("cancel")


def _report(outcome: Outcome, *, json: bool) -> None:
    """Print what became of a command and end it: with exit code 1 if it was refused."""
    line = f"{'accepted' if outcome.accepted else 'refused'}: {outcome.reason}"
    # The robot's own answer is newer than its last state, which may still have the mode before.
    if outcome.mode is not None and "the mode is " not in outcome.reason:
        line += f" (mode {outcome.mode})"
    print_result(msgspec.to_builtins(outcome), line, json=json)
    raise typer.Exit(0 if outcome.accepted else NOT_TRUE)


def _refused(error: RefusedError, mode: Mode | None) -> Outcome:
    code = error.problem.get("refusal") or error.code
    return Outcome(accepted=False, reason=str(error), mode=mode, code=code)


def _service(found: Fog, robot: str | None, method: str, body: object, became: str, *, json: bool) -> None:
    """Take a robot out of service, or put it back, and report what it is then."""
    chosen = found.robot(robot)
    mode = _view(found, chosen)[1]
    try:
        found.send(method, PLANNER, f"/api/v1/robots/{chosen}/out-of-service", body)
    except RefusedError as error:
        _report(_refused(error, mode), json=json)
    _report(Outcome(accepted=True, reason=f"robot {chosen} is {became}", mode=mode), json=json)


def _end_mission(fog: Fog, robot: str | None) -> str:
    try:
        fog.send("DELETE", PLANNER, f"/api/v1/robots/{fog.robot(robot)}/goal")
    except FailedError as error:
        if isinstance(error, RefusedError) and error.code == "no_mission":
            return "it had no mission"
        return f"its mission is not ended: {error}"
    return "its mission is ended"


def _place(fog: Fog, text: str) -> Mapping[str, Any] | None:
    """Return the place that a text names, None for numbers; raises `WrongUseError` for an unknown place."""
    if "," in text:
        return None
    places: dict[str, Mapping[str, Any]] = fog.get(MAP_SERVICE, "/api/v1/places")
    if text not in places:
        raise WrongUseError(f"there is no place {text}; known places: {', '.join(sorted(places)) or 'none'}")
    return places[text]


def _view(fog: Fog, robot: str) -> tuple[Mapping[str, Any], Any]:
    """Return the planner's view of a robot, and its mode (None if unknown); raises `FailedError` for no such robot."""
    robots = fog.get(PLANNER, "/api/v1/robots")
    for view in robots:
        if view["id"] == robot:
            return view, view["state"] and view["state"]["mode"]
    known = ", ".join(view["id"] for view in robots) or "none"
    raise FailedError(f"there is no robot {robot} at {fog.system.name}; known robots: {known}")


def _watch(fog: Fog, robot: str, seconds: float, *, json: bool) -> None:
    ends = time.monotonic() + seconds if seconds else math.inf
    for view in robot_commands.states(fog, robot):
        _print_state(robot, view["state"], view["pose"], json=json)
        if time.monotonic() >= ends:
            return


def _print_state(robot: str, state: Mapping[str, Any], pose: Mapping[str, Any] | None, *, json: bool) -> None:
    if json:
        sys.stdout.write(msgspec.json.encode(envelope({"robot": robot, **state, "pose": pose})).decode() + "\n")
        sys.stdout.flush()
    else:
        print_answer(f"{time.strftime('%H:%M:%S')} {_describe(state, pose)}")


def _describe(state: Mapping[str, Any] | None, pose: Mapping[str, Any] | None) -> str:
    if state is None:
        return "no state received yet"
    parts = [state["mode"], *state["reasons"][:3]]
    if pose is not None:
        parts.append(f"at {_position(pose)}" + ("" if pose["localized"] else ", not localized"))
    if places := state.get("places"):
        parts.append("it may be at " + " or ".join(_position(place) for place in places))
    if state["goal_distance"] is not None:
        parts.append(f"{state['goal_distance']:.1f} m to the goal")
    return "; ".join(parts)


def _position(pose: Mapping[str, Any]) -> str:
    return f"({pose['x']:.2f}, {pose['y']:.2f})"
