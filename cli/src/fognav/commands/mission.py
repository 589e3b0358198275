"""`fognav mission`: missions with several stops, now or by the clock."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from fognav.operate.fog import find_fog
from fognav.operate.options import (
    NUMBERS,
    FogOption,
    JsonOption,
    RobotOption,
    checked_id,
    duration,
    goal_body,
    weekly,
)
from fognav.output import exit_codes, local_time, print_list, print_result
from fognav.programs import PLANNER

if TYPE_CHECKING:
    from collections.abc import Mapping

mission_app = typer.Typer(help="Send robots to several stops, now or by the clock.", no_args_is_help=True)

_SCHEDULES: Final = "/api/v1/schedules"
Stops = Annotated[
    list[str],
    typer.Argument(
        metavar="STOP…", help="Places of the site, or X,Y[,THETA] in metres and radians; on another floor FLOOR:STOP."
    ),
]
ScheduleId = Annotated[str, typer.Argument(metavar="ID", help="The schedule's id: a to z, 0 to 9 and -.")]
BestOption = Annotated[bool, typer.Option("--best", help="In the order with the shortest way; 8 stops at most.")]
PriorityOption = Annotated[int, typer.Option("--priority", min=0, max=9, help="Planned first among equally urgent.")]
DeadlineOption = Annotated[
    str | None, typer.Option("--deadline", metavar="TIME", help="It ends so long after its begin, such as 30m.")
]
CutOption = Annotated[
    Literal["wait", "cancel", "nearest"],
    typer.Option("--when-cut", help="When no way leads to a stop: wait, end, or drive as near as possible."),
]
LimitOption = Annotated[
    str | None, typer.Option("--limit", metavar="TIME", help="It ends after so long without a way to a stop.")
]


@mission_app.command("send", context_settings=NUMBERS, epilog="Example: fognav mission send lab office b --best")
def mission_send(  # noqa: PLR0913  # each option is an argument
    stops: Stops,
    *,
    best: BestOption = False,
    priority: PriorityOption = 0,
    deadline: DeadlineOption = None,
    when_cut: CutOption = "wait",
    limit: LimitOption = None,
    robot: RobotOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Send a robot to one stop after the other, instead of its mission. `fognav robot cancel` ends it."""
    with exit_codes():
        found = find_fog(fog)
        body = _mission(stops, priority, deadline, when_cut, limit, best=best)
        made = found.send("PUT", PLANNER, f"/api/v1/robots/{found.robot(robot)}/mission", body)
        print_result(made, _line(made), json=json)


@mission_app.command("show", epilog="Example: fognav mission show --robot r1")
def mission_show(*, robot: RobotOption = None, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show a robot's mission with all its stops."""
    with exit_codes():
        found = find_fog(fog)
        mission = found.get(PLANNER, f"/api/v1/robots/{found.robot(robot)}/mission")
        print_result(mission, _line(mission), json=json)


@mission_app.command(
    "schedule",
    context_settings=NUMBERS,
    epilog="Example: fognav mission schedule post lab office --each 'mon-fri 08:00-09:00' --time-zone Europe/Lisbon",
)
def mission_schedule(  # noqa: PLR0913  # each option is an argument
    schedule: ScheduleId,
    stops: Stops,
    *,
    each: Annotated[
        list[str],
        typer.Option("--each", metavar="'DAYS TIMES'", help="Once in each: 'mon-fri 08:00-09:00'; repeatable."),
    ],
    time_zone: Annotated[str, typer.Option("--time-zone", metavar="NAME", help="Such as Europe/Lisbon.")],
    best: BestOption = False,
    priority: PriorityOption = 0,
    deadline: DeadlineOption = None,
    when_cut: CutOption = "wait",
    limit: LimitOption = None,
    disabled: Annotated[bool, typer.Option("--disabled", help="Not before fognav mission enable ID.")] = False,
    robot: RobotOption = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Let a robot begin a mission by the clock, each week; replaces the schedule of this id.

    It begins with the window or, while the robot is not free, later within it. What could not begin by its end is
    missed, and `fognav mission schedules` says why. Nothing begins at once: it counts from the next window on.
    """
    with exit_codes():
        found = find_fog(fog)
        body = {
            "robot": found.robot(robot),
            "mission": _mission(stops, priority, deadline, when_cut, limit, best=best),
            "weekly": {"time_zone": time_zone, "times": [weekly(text, "--each") for text in each]},
            "enabled": not disabled,
        }
        made = found.send("PUT", PLANNER, f"{_SCHEDULES}/{checked_id(schedule)}", body)
        print_result(made, _schedule(made), json=json)


@mission_app.command("schedules", epilog="Example: fognav mission schedules --json")
def mission_schedules(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the missions that begin by the clock: the next one of each, and what became of the last one."""
    with exit_codes():
        print_list("schedules", find_fog(fog).get(PLANNER, _SCHEDULES), _schedule, json=json)


@mission_app.command("enable", epilog="Example: fognav mission enable post")
def mission_enable(schedule: ScheduleId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a schedule's missions begin again, from the next window on."""
    _switch(schedule, fog, enabled=True, json=json)


@mission_app.command("disable", epilog="Example: fognav mission disable post")
def mission_disable(schedule: ScheduleId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let no mission of a schedule begin, and keep the schedule. A mission that has begun goes on."""
    _switch(schedule, fog, enabled=False, json=json)


@mission_app.command("unschedule", epilog="Example: fognav mission unschedule post")
def mission_unschedule(schedule: ScheduleId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Remove a schedule. A mission that has begun goes on."""
    with exit_codes():
        find_fog(fog).send("DELETE", PLANNER, f"{_SCHEDULES}/{checked_id(schedule)}")
        print_result({"id": schedule, "removed": True}, f"removed schedule {schedule}", json=json)


def _switch(schedule: str, address: str | None, *, enabled: bool, json: bool) -> None:
    with exit_codes():
        fog, path = find_fog(address), f"{_SCHEDULES}/{checked_id(schedule)}"
        known = fog.get(PLANNER, path)
        body = {name: known[name] for name in ("robot", "mission", "weekly")} | {"enabled": enabled}
        unchanged = {"If-Match": f'"{known["version"]}"'}  # not over what another operator has changed meanwhile
        made = fog.send("PUT", PLANNER, path, body, unchanged)
        print_result(made, _schedule(made), json=json)


def _mission(  # each option is an argument
    stops: list[str], priority: int, deadline: str | None, when_cut: str, limit: str | None, *, best: bool
) -> dict[str, object]:
    cut = {"do": when_cut, **({} if limit is None else {"limit_s": duration(limit, "--limit")})}
    ends = {} if deadline is None else {"deadline_s": duration(deadline, "--deadline")}
    order = "best" if best else "given"
    found = [_stop_body(stop) for stop in stops]
    return {"stops": found, "order": order, "priority": priority, "when_cut": cut, **ends}


def _stop_body(text: str) -> dict[str, object]:
    floor, colon, goal = text.rpartition(":")
    return {**goal_body(goal), **({"floor": checked_id(floor)} if colon else {})}


def _line(mission: Mapping[str, Any]) -> str:
    names = {"reached": "{} (reached)", "present": "{} (on the way)", "ahead": "{}"}
    stops = ", ".join(names[stop["state"]].format(_stop(stop)) for stop in mission["stops"])
    ends = "" if mission["deadline"] is None else f"; ends {local_time(mission['deadline'])}"
    aside = "" if mission["aside"] is None else "; no way leads there now: it waits as near as it gets"
    return f"{mission['robot']}: {stops}{ends}{aside}"


def _stop(stop: Mapping[str, Any]) -> str:
    floor = f"{stop['floor']}:" if stop.get("floor") else ""
    if stop["place"] is None and stop["pose"] is None:  # it rides, and stays in the cabin
        return f"the lift to {stop['floor']}"
    return floor + (stop["place"] or "({x:.2f}, {y:.2f})".format(**stop["pose"]))


def _schedule(schedule: Mapping[str, Any]) -> str:
    stops, weekly_times = schedule["mission"]["stops"], schedule["weekly"]
    times = "; ".join(f"{','.join(one['days'])} {one['begin']}-{one['end']}" for one in weekly_times["times"])
    parts = [
        f"{schedule['id']}: {schedule['robot']} to {', '.join(map(_stop, stops))}, {times} {weekly_times['time_zone']}"
    ]
    if not schedule["enabled"]:
        parts.append("disabled")
    elif schedule["waits"]:
        parts.append(f"due, but {schedule['waits']}")
    elif schedule["next"] is not None:
        parts.append(f"next {local_time(schedule['next'])}")
    else:
        parts.append("none is due within a week, or nothing keeps the time of day synchronized: install chrony")
    if (last := schedule["last"]) is not None:
        why = f" ({last['reason']})" if last["reason"] else ""
        parts.append(f"the one of {local_time(last['begin'])} was {last['outcome']}{why}")
    return "; ".join(parts)
