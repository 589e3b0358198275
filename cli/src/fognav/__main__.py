"""The command line: the list of its commands, each with an example."""

import signal
import sys
from typing import Annotated

import typer

from fognav import __version__
from fognav.commands import installed
from fognav.commands.access import ca_app, token_app
from fognav.commands.area import alert_app, area_app, map_app
from fognav.commands.backup import backup_command, restore_command, store_app
from fognav.commands.demo import demo_command, record_command, replay_command
from fognav.commands.develop import channels_command, check_command, docs_command, run_tests
from fognav.commands.map_clean import map_clean
from fognav.commands.map_files import map_check, map_convert, map_info
from fognav.commands.node import node_app
from fognav.commands.robot import robot_app
from fognav.commands.robot_file import robot_add, robot_check, robot_new
from fognav.commands.robot_tools import calibrate_command, map_record, robot_bringup, teleop_command
from fognav.commands.site import site_app
from fognav.commands.source import source_app
from fognav.commands.status import status_command
from fognav.commands.up import down_command, logs_command, up_command, upgrade_command
from fognav.commands.zone import zone_app
from fognav.doctor import doctor_command
from fognav.operate.options import NUMBERS
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
for group, name, added in (
    (installed.OPERATE, "robot", robot_app),
    (installed.OPERATE, "zone", zone_app),
    (installed.OPERATE, "area", area_app),
    (installed.OPERATE, "alert", alert_app),
    (installed.OPERATE, "map", map_app),
    (installed.SET_UP, "site", site_app),
    (installed.SET_UP, "node", node_app),
    (installed.SET_UP, "source", source_app),
    (installed.RUN, "store", store_app),
    (installed.RUN, "token", token_app),
    (installed.RUN, "ca", ca_app),
):
    app.add_typer(added, name=name, rich_help_panel=group)
for group, name, command, example in (
    (installed.TRY_IT, "demo", demo_command, "demo --headless --report report.json --seed 7"),
    (installed.TRY_IT, "doctor", doctor_command, "doctor --json"),
    (installed.OPERATE, "status", status_command, "status --json"),
    (installed.OPERATE, "teleop", teleop_command, "teleop --page --bind 192.168.7.20"),
    (installed.SET_UP, "calibrate", calibrate_command, "calibrate --write --robot-file robot.toml"),
    (installed.RUN, "up", up_command, "up --site sites/estig --site sites/floor2"),
    (installed.RUN, "down", down_command, "down"),
    (installed.RUN, "logs", logs_command, "logs map-service -f"),
    (installed.RUN, "upgrade", upgrade_command, "upgrade --check"),
    (
        installed.RUN,
        "backup",
        backup_command,
        "backup fog.tar.gz --site sites/estig --secrets keys --data /var/lib/fognav",
    ),
    (
        installed.RUN,
        "restore",
        restore_command,
        "restore fog.tar.gz --site sites/estig --secrets keys --data /var/lib/fognav",
    ),
    (installed.MEASURE, "record", record_command, "record drive.mcap --seconds 60"),
    (installed.MEASURE, "replay", replay_command, "replay drive.mcap --speed 2"),
    (installed.DEVELOP, "docs", docs_command, "docs --serve"),
    (installed.DEVELOP, "channels", channels_command, "channels --format acl --broker mqtt"),
):
    app.command(name, epilog=f"Example: fognav {example}", rich_help_panel=group)(command)
app.command(
    "test",
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    epilog="Example: fognav test --yes -k replica",
    rich_help_panel=installed.DEVELOP,
)(run_tests)
app.command("check", epilog="Example: fognav check --json", rich_help_panel=installed.DEVELOP)(check_command)
map_app.command("record", epilog="Example: fognav map record floor.mcap")(map_record)
map_app.command("check", epilog="Example: fognav map check floor.yaml --radius 0.17")(map_check)
map_app.command("clean", context_settings=NUMBERS, epilog="Example: fognav map clean floor.yaml erase 3.0 1.0 4.0 2.0")(
    map_clean
)
map_app.command("info", epilog="Example: fognav map info floor.yaml --json")(map_info)
map_app.command("convert", epilog="Example: fognav map convert floor.yaml floor.png --resolution 0.1")(map_convert)
robot_app.command("add", epilog="Example: fognav robot add r2 --credentials DIR")(robot_add)
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
