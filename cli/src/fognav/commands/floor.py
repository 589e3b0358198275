"""`fognav floor`: list the floors of a building on several machines, and stop them (docs/campus.md)."""

import http.client
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from fog_runtime.credentials import CredentialsError
from fognav.operate.fog import RefusedError, find_fog
from fognav.operate.options import FogOption, JsonOption, checked_id
from fognav.output import NOT_TRUE, FailedError, WrongUseError, exit_codes, local_time, print_answer, print_json
from fognav.programs import CONSOLE

floor_app = typer.Typer(help="List floors on several machines, and stop them.", no_args_is_help=True)

_FLOORS: Final = "/api/v1/floors"
_STOP_S: Final = 15.0
"""A floor has 6 s for its answer."""


@floor_app.command("list", epilog="Example: fognav floor list --json")
def floor_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the floors that this fog node knows, with the age of what is known of each.

    The exit code is 1 if one is not reachable.
    """
    with exit_codes():
        floors = find_fog(fog).get(CONSOLE, _FLOORS)
        if json:
            print_json({"floors": floors})
        else:
            for entry in floors:
                print_answer(_line(entry))
        if not all(entry["reachable"] for entry in floors):
            raise typer.Exit(NOT_TRUE)


def _line(entry: dict[str, Any]) -> str:
    """Return a floor as a line: what is known of it, and how old that is."""
    floor = entry["floor"]
    known = "nothing is known of it" if floor is None else _state(floor)
    if entry["reachable"]:
        return f"{entry['id']}: {known}; {entry['age_s']:.0f} s old"
    since = "" if entry["heard"] is None else f" since {local_time(entry['heard'])}"
    return f"{entry['id']}: NOT REACHABLE{since}: {entry['detail']}. Before: {known}"


def _state(floor: dict[str, Any]) -> str:
    robots = [
        f"{robot['id']} {'never heard' if robot['age_s'] is None else robot['mode'] or 'without a state'}"
        for robot in floor["robots"]
    ]
    words = ["ready" if not floor["not_ready"] else "not ready"]
    words += [f"{service} lacks {missing}" for service, missing in floor["not_ready"].items()]
    words += ["stopped"] if floor["stopped"] else []
    words += [f"robots: {', '.join(robots) or 'none'}"]
    words += [f"{state}: {', '.join(floor[state])}" for state in ("blocked", "unknown") if floor[state]]
    return "; ".join(words)


@floor_app.command("stop", epilog="Example: fognav floor stop upstairs")
def floor_stop(
    floors: Annotated[list[str] | None, typer.Argument(metavar="FLOOR", help="Floors; default: all.")] = None,
    *,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Stop all robots of floors, of all without a FLOOR; an operator of each floor must enable them again.

    All floors are told at once, each once. The exit code is 1 if one has not acknowledged it: its line says what to do.
    Without a valid token it stops the floor of this fog node alone, and the exit code is 1.
    """
    with exit_codes():
        found = find_fog(fog)
        body = {"floors": [checked_id(floor) for floor in floors] if floors else None}
        refused: RefusedError | None = None
        try:
            stops = found.send("POST", CONSOLE, f"{_FLOORS}/stop", body, timeout_s=_STOP_S)
        except RefusedError as error:
            if floors or error.status not in (http.client.UNAUTHORIZED, http.client.FORBIDDEN):
                raise
            refused = error
            stops = [found.send("POST", CONSOLE, f"{_FLOORS}/here/stop", timeout_s=_STOP_S)]
        if json:
            print_json({"floors": stops})
        else:
            for stop in stops:
                print_answer(f"{stop['id']}: {_outcome(stop)}")
        if refused is not None:
            raise FailedError(f"no other floor was told: {refused}")
        if not all(stop["acknowledged"] for stop in stops):
            raise typer.Exit(NOT_TRUE)


def _outcome(stop: dict[str, Any]) -> str:
    if not stop["acknowledged"]:
        return f"NOT ACKNOWLEDGED: {stop['detail']}"
    stopped = [robot["id"] for robot in stop["robots"] if robot["stopped"]]
    away = [robot["id"] for robot in stop["robots"] if not robot["stopped"]]
    return f"stopped: {', '.join(stopped) or 'no robot'}" + (f"; away: {', '.join(away)}" if away else "")


def require_floors(file: Path) -> None:
    """Raise `SettingsError`, or `WrongUseError` for credentials in a list of floors that can't be used."""
    from console_service.floors import read_peers  # noqa: PLC0415  # web frameworks are slow to import

    try:
        read_peers(file, "")
    except CredentialsError as error:
        raise WrongUseError(str(error)) from error
