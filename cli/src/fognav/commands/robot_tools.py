"""`fognav robot bringup`, `teleop`, `calibrate` and `map record`: tools that speak to the agent on their computer."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import (
    NOT_TRUE,
    FailedError,
    WrongUseError,
    answers,
    exit_codes,
    print_answer,
    print_json,
    print_line,
)

_INSTALLED: Final = Path("/run/fognav/agent.sock")

PageOption = Annotated[bool, typer.Option("--page", help="Serve a page with a pad for touch, mouse and keys.")]
BindOption = Annotated[
    list[str] | None, typer.Option("--bind", metavar="ADDRESS", help="Serve the page there, too, for other devices.")
]
PortOption = Annotated[int, typer.Option(min=0, max=65535, help="The page's port; 0: any free one.")]
RobotFileOption = Annotated[
    Path | None, typer.Option("--robot-file", metavar="FILE", help="The robot's settings, robot.toml.")
]
SocketOption = Annotated[
    Path | None, typer.Option("--socket", metavar="FILE", help="The agent's socket, if not found by itself.")
]


def _default_socket() -> Path:
    """Return where the agent of this computer serves its tools, by its environment or as installed."""
    guardian = os.environ.get("FOGNAV_GUARDIAN_SOCKET")
    return Path(guardian).with_name(_INSTALLED.name) if guardian else _INSTALLED


def robot_bringup(  # noqa: PLR0913  # one parameter for each option
    *,
    page: PageOption = False,
    bind: BindOption = None,
    port: PortOption = 0,
    robot_file: RobotFileOption = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="How long --json watches the robot.")] = 5.0,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Judge this computer's robot, and set its lidar's yaw by looking.

    Run it on the robot's computer, without a fog. In a terminal it shows findings and scan until Ctrl-C. On the page
    you turn, mirror and mask the scan, write that into robot.toml, and drive by held keys; nothing else moves.
    With --json, or without a terminal, it says the findings once, and exits with 1 if something needed is bad.
    """
    from fognav.robot_page import bringup, findings  # noqa: PLC0415  # loads kernels
    from fognav.robot_page.server import serve  # noqa: PLC0415  # same

    path, place = socket or _default_socket(), bringup.Place(robot_file)
    with exit_codes():
        if page:
            with contextlib.suppress(KeyboardInterrupt):
                asyncio.run(serve(path, ["127.0.0.1", *(bind or [])], port, lambda: bringup.BringupView(place)))
            return
        view = bringup.BringupView(place)
        live = sys.stdout.isatty() and not json
        found = bringup.show(path, view) if live else bringup.watch(path, view, seconds)
        if json:
            print_json(findings.as_json(found))
        else:
            answers.print(bringup.table(found))
        if any(finding.state == "bad" for finding in found):
            raise typer.Exit(NOT_TRUE)


def teleop_command(  # noqa: PLR0913  # one parameter for each option
    *,
    page: PageOption = False,
    bind: BindOption = None,
    port: PortOption = 0,
    gamepad: Annotated[
        Path | None, typer.Option("--gamepad", metavar="DEVICE", help="Drive by a game pad, such as /dev/input/js0.")
    ] = None,
    speed: Annotated[float, typer.Option(min=0.01, max=0.15, help="m/s.")] = 0.1,
    turn: Annotated[float, typer.Option(min=0.1, max=1.0, help="rad/s; more than 0.5 blurs a map.")] = 0.5,
    socket: SocketOption = None,
) -> None:
    """Drive this computer's robot by hand.

    It needs neither a map nor a fog. Run it on the robot's computer. Letting go, losing the link and ending the
    command stop the robot within 0.3 s.
    """
    from fognav.robot_page.driving import HELP, GamePad, Keyboard, drive, raw_terminal  # noqa: PLC0415  # loads kernels
    from fognav.robot_page.server import serve  # noqa: PLC0415  # same

    path = socket or _default_socket()
    with exit_codes():
        if page:
            with contextlib.suppress(KeyboardInterrupt):
                asyncio.run(serve(path, ["127.0.0.1", *(bind or [])], port))
        elif gamepad is not None:
            drive(path, GamePad(gamepad, speed, turn))
        elif not sys.stdin.isatty():
            raise WrongUseError("there is no terminal to read keys from: use --page or --gamepad")
        else:
            with raw_terminal():
                print_line(HELP.replace("\n", "\r\n") + "\r")
                drive(path, Keyboard(speed, turn))


def map_record(
    out: Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording, for `fognav map from-log`.")],
    *,
    seconds: Annotated[float | None, typer.Option(min=1.0, help="End by itself; else with Ctrl-C.")] = None,
    no_preview: Annotated[bool, typer.Option("--no-preview", help="Draw no map: it takes some of a core.")] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Record what this computer's robot measures while it is driven (`fognav teleop`), and watch its map grow.

    The map shown closes no loops: what `fognav map from-log` makes of the recording does, and is better. A recording
    that a loss of power or a full disk cut short can be read up to there.
    """
    from fognav.robot_page.recording import Recording  # noqa: PLC0415  # as above
    from fognav.robot_page.recording_view import shown, until_told  # noqa: PLC0415  # same

    with exit_codes():
        if out.exists():
            raise WrongUseError(f"{out} exists: name another file, or remove it")
        recording = Recording(out, preview=not no_preview)
        begun = time.monotonic()
        with until_told(seconds) as ends, shown(recording, begun) as show:
            recording.run(socket or _default_socket(), show, ends)
        if not recording.scans:
            raise FailedError(f"{out} has no scan: {recording.advice or 'the lidar tells nothing'}")
        figures: dict[str, Any] = {
            "file": str(out),
            "seconds": round(time.monotonic() - begun, 1),
            "scans": recording.scans,
            "megabytes": round(recording.megabytes, 2),
            "missed": recording.view.missed,
            "gaps": recording.gaps,
            "breaks": recording.breaks,
        }
        if json:
            print_json(figures)
        else:
            print_answer(f"{out}: {figures['scans']} scans in {figures['seconds']} s, {figures['megabytes']} MB")
            if recording.view.missed or recording.gaps:
                print_answer(f"{recording.view.missed} entries were missed, the link broke {recording.gaps} times")
            if recording.breaks:
                print_answer(
                    f"its odometry broke {recording.breaks} times: how far the robot moved meanwhile is a guess. "
                    "fognav map from-log says when: drive these parts again"
                )
            print_answer(f"next: fognav map from-log {out} --out floor --png floor-loops.png")


def calibrate_command(  # noqa: PLR0913  # one parameter for each option
    log: Annotated[
        Path | None, typer.Argument(metavar="LOG", help="A recording; without one the robot is recorded now.")
    ] = None,
    *,
    robot_file: RobotFileOption = None,
    write: Annotated[bool, typer.Option("--write", help="Write the result into the robot's settings.")] = False,
    accept: Annotated[
        list[Path] | None,
        typer.Option("--accept", metavar="LOG", help="Another drive that ends where it began: it must agree."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.mcap", help="Where a drive is recorded.")] = Path(
        "calibration.mcap"
    ),
    seconds: Annotated[float | None, typer.Option(min=1.0, help="End recording by itself; else with Ctrl-C.")] = None,
    by_itself: Annotated[
        bool, typer.Option("--by-itself", help="The robot drives by itself, in a free square around it.")
    ] = False,
    square: Annotated[
        float, typer.Option("--square", metavar="M", min=0.5, max=4.0, help="Side of that square.")
    ] = 1.2,
    yes: Annotated[bool, typer.Option("--yes", help="Let it drive by itself without asking.")] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Measure wheels and lidar by driving around.

    Some minutes in any room do. Drive by `fognav teleop` in a second terminal, slowly, with walls within reach of the
    lidar and nobody walking by: turn once to each side, drive straight ahead and back, and arcs to both sides. It says
    what is missing yet. With --by-itself the robot drives alone, after you agree, and Ctrl-C stops it at once.
    """
    from fognav.robot_page import by_itself as alone  # noqa: PLC0415  # loads kernels
    from fognav.robot_page import calibrating  # noqa: PLC0415  # same

    with exit_codes():
        if write and robot_file is None:
            raise WrongUseError("--write needs the robot's settings file: add --robot-file robot.toml")
        if write and robot_file is not None and not os.access(robot_file.parent, os.W_OK):
            raise WrongUseError(f"{robot_file} can't be written by you: run the same command by sudo")
        if log is not None:
            if by_itself:
                raise WrongUseError("--by-itself records a drive: leave out the log")
            recorded = calibrating.read(log)
        else:
            path, log = socket or _default_socket(), _new_recording(out)
            if by_itself and not yes:
                _ask_to_drive(square)
            recorded = alone.drive(path, log, square, seconds) if by_itself else calibrating.record(path, log, seconds)
        found, changed = calibrating.solve(recorded, robot_file)
        accepted: dict[str, float] = {}
        for other in accept or []:
            accepted |= calibrating.refuse_disagreement(found, recorded, other)
        if write and robot_file is not None:
            calibrating.write(robot_file, changed, calibrating.hash_of(log))
        if json:
            print_json(calibrating.as_json(found, changed, accepted))
        else:
            calibrating.tell(found, changed, accepted, written=write)


def _new_recording(out: Path) -> Path:
    """Return where a drive is recorded; raises `WrongUseError` if there is a file already."""
    if out.exists():
        raise WrongUseError(f"{out} exists: name another file with --out, or calibrate by it: fognav calibrate {out}")
    return out


def _ask_to_drive(square: float) -> None:
    """Let the operator agree that the robot drives by itself; raises `WrongUseError` if nobody does."""
    print_line(
        f"the robot will drive by itself for 3 to 10 minutes, at 0.12 m/s at most, in the {square:g} m square around "
        "it. Stand beside it, and keep people, animals and cables away. Ctrl-C, its bumper, and what its lidar sees "
        "come near stop it; stairs are its cliff sensors' alone. Over a network that stalls, Ctrl-C comes late: keep a "
        "hand at the battery's cut-off."
    )
    if not sys.stdin.isatty():
        raise WrongUseError(
            "nobody can be asked here whether the robot may drive by itself: stand beside it, add --yes"
        )
    if not typer.confirm("Let it drive?", err=True):
        raise WrongUseError("nothing has moved")
