"""The command line: the list of its commands, each with an example."""

import signal
import sys
from importlib.util import find_spec
from typing import Annotated

import typer

from fognav import __version__
from fognav.commands import installed
from fognav.commands.map_files import map_app, map_convert, map_info
from fognav.commands.robot_file import robot_app, robot_check, robot_new
from fognav.commands.robot_tools import calibrate_command, map_record, robot_bringup, teleop_command
from fognav.output import OK

app = typer.Typer(
    name=installed.PROGRAM,
    cls=installed.Commands,
    help="Keep a small indoor robot out of danger that it can't see yet.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
# A robot's computer has this command without its extra `fog`.
if find_spec("map_service"):
    from fognav.commands import everything

    everything.add_to(app)
app.add_typer(robot_app, name="robot", rich_help_panel=installed.OPERATE)
app.add_typer(map_app, name="map", rich_help_panel=installed.OPERATE)
for group, name, command, example in (
    (installed.OPERATE, "teleop", teleop_command, "teleop --page --bind 192.168.7.20"),
    (installed.SET_UP, "calibrate", calibrate_command, "calibrate --write --robot-file robot.toml"),
):
    app.command(name, epilog=f"Example: fognav {example}", rich_help_panel=group)(command)
map_app.command("record", epilog="Example: fognav map record floor.mcap")(map_record)
map_app.command("info", epilog="Example: fognav map info floor.yaml --json")(map_info)
map_app.command("convert", epilog="Example: fognav map convert floor.yaml floor.png --resolution 0.1")(map_convert)
robot_app.command("new", epilog="Example: fognav robot new --base roomba600 --lidar rplidar-a1 --out robot.toml")(
    robot_new
)
robot_app.command("bringup", epilog="Example: fognav robot bringup --page --robot-file robot.toml")(robot_bringup)
robot_app.command("check", epilog="Example: fognav robot check robot.toml")(robot_check)


def _version(show: bool) -> None:  # noqa: FBT001  # Typer passes only its value
    if show:
        typer.echo(f"fognav {__version__}")
        raise typer.Exit(OK)


@app.callback()
def _main(
    *,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    del version  # handled by its callback


def main() -> None:
    """Run the command."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    # Help texts show the documented name, also when started by `python -m` or by the launcher.
    app(prog_name="fognav")


if __name__ == "__main__":
    main()
