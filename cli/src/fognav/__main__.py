"""The command line: the list of its commands, each with an example."""

import signal
import sys
from typing import Annotated, Final

import typer

from fognav import __version__
from fognav.commands.installed import DEVELOP, MEASURE, OPERATE, PROGRAM, RUN, SET_UP, TRY_IT, Commands, Row

_BACKUP: Final = "fog.tar.gz --site sites/estig --secrets keys --data /var/lib/fognav"
_STACK: Final = "stack sites/ground@fog1.local sites/upstairs@fog2.local --out stacks"
_PLAN: Final = "map from-plan plan.png --points 120,80 980,80 --metres 21.5 --out floor"
# What begins with "-" may be a number there. A single point of `map from-plan` takes the next option for its second:
# what that leaves is told with it.
_NUMBERS: Final = {"ignore_unknown_options": True}
_ANY: Final = {"allow_extra_args": True, **_NUMBERS}
_MAP: Final = "commands.map_files"
_UP: Final = "commands.up"
_DRIVES: Final = "commands.demo"
_DEVELOP: Final = "commands.develop"
_TOOLS: Final = "commands.robot_tools"
_NEW: Final = "robot new --base roomba600 --lidar rplidar-a1 --out robot.toml"


class _Fognav(Commands):
    rows = (
        Row(TRY_IT, "demo", f"{_DRIVES}:demo_command", "demo --headless --report report.json --seed 7"),
        Row(TRY_IT, "doctor", "doctor:doctor_command", "doctor --json"),
        Row(OPERATE, "status", "commands.status:status_command", "status --json"),
        Row(OPERATE, "teleop", f"{_TOOLS}:teleop_command", "teleop --page --bind 192.168.7.20", robot=True),
        Row(OPERATE, "zone", "commands.zone:zone_app"),
        Row("", "zone import", "commands.nav2_files:zone_import", "zone import keepout.yaml --save"),
        Row(OPERATE, "area", "commands.area:area_app"),
        Row(OPERATE, "alert", "commands.area:alert_app"),
        Row(OPERATE, "floor", "commands.floor:floor_app"),
        Row(OPERATE, "robot", "commands.robot_file:robot_app", also=("commands.robot",), robot=True),
        Row("", "robot add", "commands.access:robot_add", "robot add r2 --credentials DIR"),
        Row("", "robot new", "commands.robot_file:robot_new", _NEW, robot=True),
        Row(
            "",
            "robot bringup",
            f"{_TOOLS}:robot_bringup",
            "robot bringup --page --robot-file robot.toml",
            robot=True,
        ),
        Row("", "robot check", "commands.robot_file:robot_check", "robot check robot.toml", robot=True),
        Row(OPERATE, "mission", "commands.mission:mission_app"),
        Row(OPERATE, "map", f"{_MAP}:map_app", also=("commands.map_change", "commands.area"), robot=True),
        Row("", "map export", "commands.nav2_files:map_export", "map export nav2"),
        Row("", "map check", f"{_MAP}:map_check", "map check floor.yaml --radius 0.17"),
        Row(
            "",
            "map clean",
            "commands.map_clean:map_clean",
            "map clean floor.yaml erase 3.0 1.0 4.0 2.0",
            _NUMBERS,
        ),
        Row("", "map from-plan", "commands.map_plan:map_from_plan", _PLAN, {"allow_extra_args": True}),
        Row("", "map record", f"{_TOOLS}:map_record", "map record floor.mcap", robot=True),
        Row("", "map info", f"{_MAP}:map_info", "map info floor.yaml --json", robot=True),
        Row("", "map convert", f"{_MAP}:map_convert", "map convert floor.yaml a.png --resolution 0.1", robot=True),
        Row(
            SET_UP, "calibrate", f"{_TOOLS}:calibrate_command", "calibrate --write --robot-file robot.toml", robot=True
        ),
        Row(SET_UP, "site", "commands.site:site_app"),
        Row(SET_UP, "node", "commands.node:node_app"),
        Row(SET_UP, "source", "commands.source:source_app"),
        Row(RUN, "up", f"{_UP}:up_command", "up --site sites/estig --site sites/floor2"),
        Row(RUN, "down", f"{_UP}:down_command", "down"),
        Row(RUN, "logs", f"{_UP}:logs_command", "logs map-service -f"),
        Row(RUN, "stack", f"{_UP}:stack_command", _STACK),
        Row(RUN, "bridge", "commands.bridge:bridge_command", "bridge bridge.toml"),
        Row(RUN, "upgrade", f"{_UP}:upgrade_command", "upgrade --check"),
        Row(RUN, "backup", "commands.backup:backup_command", f"backup {_BACKUP}"),
        Row(RUN, "restore", "commands.backup:restore_command", f"restore {_BACKUP}"),
        Row(RUN, "store", "commands.backup:store_app"),
        Row(RUN, "token", "commands.access:token_app"),
        Row(RUN, "ca", "commands.access:ca_app"),
        Row(MEASURE, "record", f"{_DRIVES}:record_command", "record drive.mcap --seconds 60"),
        Row(MEASURE, "replay", f"{_DRIVES}:replay_command", "replay drive.mcap --speed 2"),
        Row(MEASURE, "rosbag", "commands.bridge:rosbag_command", "rosbag drive.mcap drive-bag"),
        Row(DEVELOP, "docs", f"{_DEVELOP}:docs_command", "docs --serve"),
        Row(DEVELOP, "channels", f"{_DEVELOP}:channels_command", "channels --format acl --broker mqtt"),
        Row(DEVELOP, "check", f"{_DEVELOP}:check_command", "check --json"),
        Row(DEVELOP, "test", f"{_DEVELOP}:run_tests", "test --yes -k replica", _ANY),
    )


app = typer.Typer(
    name=PROGRAM,
    cls=_Fognav,
    help="Keep a small indoor robot out of danger that it can't see yet.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _version(show: bool) -> None:  # noqa: FBT001  # Typer passes only its value
    if show:
        typer.echo(f"fognav {__version__}")
        raise typer.Exit


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
