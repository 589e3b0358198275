"""The commands of a fog node and of a checkout, which a robot's computer does not have."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fognav.commands import installed, map_change, robot  # noqa: F401  # they add to `fognav map` and `fognav robot`
from fognav.commands.access import ca_app, robot_add, token_app
from fognav.commands.area import alert_app, area_app
from fognav.commands.backup import backup_command, restore_command, store_app
from fognav.commands.bridge import bridge_command, rosbag_command
from fognav.commands.demo import demo_command, record_command, replay_command
from fognav.commands.develop import channels_command, check_command, docs_command, run_tests
from fognav.commands.floor import floor_app
from fognav.commands.map_clean import map_clean
from fognav.commands.map_files import map_app, map_check
from fognav.commands.map_plan import FORWARDED, map_from_plan
from fognav.commands.nav2_files import map_export, zone_import
from fognav.commands.node import node_app
from fognav.commands.robot_file import robot_app
from fognav.commands.site import site_app
from fognav.commands.source import source_app
from fognav.commands.status import status_command
from fognav.commands.up import down_command, logs_command, stack_command, up_command, upgrade_command
from fognav.commands.zone import zone_app
from fognav.doctor import doctor_command
from fognav.operate.options import NUMBERS

if TYPE_CHECKING:
    import typer


def add_to(app: typer.Typer) -> None:
    """Add them, each with an example."""
    for group, name, added in (
        (installed.OPERATE, "zone", zone_app),
        (installed.OPERATE, "area", area_app),
        (installed.OPERATE, "alert", alert_app),
        (installed.OPERATE, "floor", floor_app),
        (installed.SET_UP, "site", site_app),
        (installed.SET_UP, "node", node_app),
        (installed.SET_UP, "source", source_app),
        (installed.RUN, "store", store_app),
        (installed.RUN, "token", token_app),
        (installed.RUN, "ca", ca_app),
    ):
        app.add_typer(added, name=name, rich_help_panel=group)
    backup = "fog.tar.gz --site sites/estig --secrets keys --data /var/lib/fognav"
    for group, name, command, example in (
        (installed.TRY_IT, "demo", demo_command, "demo --headless --report report.json --seed 7"),
        (installed.TRY_IT, "doctor", doctor_command, "doctor --json"),
        (installed.OPERATE, "status", status_command, "status --json"),
        (installed.RUN, "up", up_command, "up --site sites/estig --site sites/floor2"),
        (installed.RUN, "down", down_command, "down"),
        (installed.RUN, "logs", logs_command, "logs map-service -f"),
        (installed.RUN, "stack", stack_command, "stack sites/ground@fog1.local sites/upstairs@fog2.local --out stacks"),
        (installed.RUN, "bridge", bridge_command, "bridge bridge.toml"),
        (installed.RUN, "upgrade", upgrade_command, "upgrade --check"),
        (installed.RUN, "backup", backup_command, f"backup {backup}"),
        (installed.RUN, "restore", restore_command, f"restore {backup}"),
        (installed.MEASURE, "record", record_command, "record drive.mcap --seconds 60"),
        (installed.MEASURE, "replay", replay_command, "replay drive.mcap --speed 2"),
        (installed.MEASURE, "rosbag", rosbag_command, "rosbag drive.mcap drive-bag"),
        (installed.DEVELOP, "docs", docs_command, "docs --serve"),
        (installed.DEVELOP, "channels", channels_command, "channels --format acl --broker mqtt"),
        (installed.DEVELOP, "check", check_command, "check --json"),
    ):
        app.command(name, epilog=f"Example: fognav {example}", rich_help_panel=group)(command)
    app.command(
        "test",
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
        epilog="Example: fognav test --yes -k replica",
        rich_help_panel=installed.DEVELOP,
    )(run_tests)
    robot_app.command("add", epilog="Example: fognav robot add r2 --credentials DIR")(robot_add)
    map_app.command("export", epilog="Example: fognav map export nav2")(map_export)
    zone_app.command("import", epilog="Example: fognav zone import keepout.yaml --save")(zone_import)
    map_app.command("check", epilog="Example: fognav map check floor.yaml --radius 0.17")(map_check)
    map_app.command(
        "clean", context_settings=NUMBERS, epilog="Example: fognav map clean floor.yaml erase 3.0 1.0 4.0 2.0"
    )(map_clean)
    map_app.command(
        "from-plan",
        context_settings=FORWARDED,
        epilog="Example: fognav map from-plan plan.png --points 120,80 980,80 --metres 21.5 --out floor",
    )(map_from_plan)
