"""The command line: each command reads its options, runs the function that does the work, and sets the exit code."""

import asyncio
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from fog_runtime.configuration import parts
from fognav import __version__, checkout, doctor, kernels, node_code, system
from fognav.commands import installed
from fognav.commands.alert import alert_app
from fognav.commands.area import area_app
from fognav.commands.backup import backup_command, restore_command
from fognav.commands.ca import ca_app
from fognav.commands.channels import channels_command
from fognav.commands.docs import docs_command
from fognav.commands.map import map_app
from fognav.commands.node import node_app
from fognav.commands.robot import robot_app
from fognav.commands.robot_file import robot_add, robot_check, robot_new
from fognav.commands.source import source_app
from fognav.commands.status import status_command
from fognav.commands.store import store_app
from fognav.commands.token import token_app
from fognav.commands.up import down_command, logs_command, up_command
from fognav.commands.upgrade import upgrade_command
from fognav.commands.zone import zone_app
from fognav.operate.options import JsonOption
from fognav.output import (
    NOT_TRUE,
    OK,
    WRONG_USE,
    WrongUseError,
    answers,
    check_writable,
    console,
    exit_codes,
    fail,
    print_json,
    print_line,
    write_report,
)
from fognav_sim import emulators

app = typer.Typer(
    name="fognav",
    cls=installed.Commands,
    help="Keep a small indoor robot out of danger that it can't see yet.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
site_app = typer.Typer(cls=installed.SiteCommands, help="Create and check sites.", no_args_is_help=True)
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
    (installed.OPERATE, "status", status_command, "status --json"),
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
    (installed.DEVELOP, "docs", docs_command, "docs --serve"),
    (installed.DEVELOP, "channels", channels_command, "channels --format acl --broker mqtt"),
):
    app.command(name, epilog=f"Example: fognav {example}", rich_help_panel=group)(command)
robot_app.command("add", epilog="Example: fognav robot add r2 --credentials DIR")(robot_add)
robot_app.command("new", epilog="Example: fognav robot new --base roomba600 --lidar rplidar-a1 --out robot.toml")(
    robot_new
)
robot_app.command("check", epilog="Example: fognav robot check robot.toml")(robot_check)

Yes = Annotated[bool, typer.Option("--yes", help="Install missing system packages without asking (as does CI=true).")]


def _known_parts(group: str) -> str:
    return " or ".join(parts.names(group))


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


def _prepare(*, yes: bool) -> None:
    try:
        system.ensure([system.MOSQUITTO, system.REDIS], yes=yes, print_line=print_line)
        kernels.warm_cache(print_line)
    except (system.MissingToolsError, kernels.KernelsError) as error:
        fail(str(error))


@app.command(
    "test",
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    epilog="Example: fognav test --yes -k replica",
    rich_help_panel=installed.DEVELOP,
)
def run_tests(context: typer.Context, *, yes: Yes = False) -> None:
    """Set up what is missing, then run the tests on all cores.

    These are some minutes of them, or those that you name. With --all every test runs, with --rest those that are
    left out without it, with --long new random worlds and containers, which keeps its result in
    tests/last-long-run.txt. Further arguments go to pytest (`-n 0` runs one at a time).
    """
    from fognav import testing  # noqa: PLC0415  # keeps the other commands fast

    _prepare(yes=yes)
    testing.get_optional_tools(yes=yes, print_line=print_line)
    done = subprocess.run(testing.pytest_command(context.args), check=False, cwd=checkout.root())
    raise typer.Exit(done.returncode)


@app.command("check", epilog="Example: fognav check --json", rich_help_panel=installed.DEVELOP)
def check_command(*, json: JsonOption = False) -> None:
    """Run all static checks.

    These are format, lint, types, import contracts, declared imports, dead code and generated files. All of them
    run; the exit code is 1 if one fails.
    """
    from fognav import checks  # noqa: PLC0415  # keeps the other commands fast

    def show(result: checks.CheckResult) -> None:
        mark = "[green]ok[/]    " if result.ok else "[red]failed[/]"
        console.print(f"{mark} {result.seconds:5.1f} s  {result.check.name}")
        if not result.ok:
            print_line(result.output)

    started = time.monotonic()
    try:
        results = asyncio.run(checks.run_checks(checks.CHECKS, checkout.root(), show))
    except WrongUseError as error:
        fail(str(error), WRONG_USE)
    seconds, failed = time.monotonic() - started, [result for result in results if not result.ok]
    if json:
        shown = [{"check": r.check.name, "ok": r.ok, "seconds": round(r.seconds, 1)} for r in results]
        print_json({"ok": not failed, "seconds": round(seconds, 1), "checks": shown})
    if failed:
        remedies = "\n".join(f"  {result.check.name}: {result.check.remedy}" for result in failed)
        fail(f"{len(failed)} of {len(results)} checks failed in {seconds:.0f} s:\n{remedies}")
    print_line(f"all {len(results)} checks passed ({seconds:.0f} s)")


@app.command(
    "demo", epilog="Example: fognav demo --headless --report report.json --seed 7", rich_help_panel=installed.TRY_IT
)
def demo_command(  # noqa: PLR0913  # each option is an argument
    *,
    headless: Annotated[bool, typer.Option("--headless", help="No terminal view and no page: for scripts.")] = False,
    report: Annotated[Path | None, typer.Option("--report", metavar="F", help="Write the report (JSON) here.")] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="D", help="Folder of a site, or a name in sites/; default: estig."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the noise and of the hazard.")] = 1,
    speed: Annotated[
        float,
        typer.Option("--speed", metavar="K", min=0.1, max=50.0, help="Simulated seconds per second."),
    ] = 1.0,
    no_hazard: Annotated[bool, typer.Option("--no-hazard", help="Place no barrier on the path.")] = False,
    base: Annotated[
        str | None, typer.Option("--base", metavar="NAME", help=f"The robot's base: {_known_parts(emulators.BASES)}.")
    ] = None,
    lidar: Annotated[
        str | None,
        typer.Option("--lidar", metavar="NAME", help=f"The robot's lidar: {_known_parts(emulators.LIDARS)}."),
    ] = None,
    robot_file: Annotated[
        Path | None,
        typer.Option(
            "--robot-file", metavar="F", help="Settings of the robot, from fognav robot new; its ports do not count."
        ),
    ] = None,
    keep_running: Annotated[
        bool, typer.Option("--keep-running", help="Keep the system running after the drive, until Ctrl-C.")
    ] = False,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="F", help="Record every channel to this MCAP file.")
    ] = None,
    embedded: Annotated[
        bool,
        typer.Option("--embedded", help="Use Python packages instead of Mosquitto and Redis, as without them."),
    ] = False,
    page_port: Annotated[
        int, typer.Option("--page-port", metavar="P", min=0, max=65535, help="Port of the page; 0: any free one.")
    ] = 0,
    yes: Yes = False,
    json: JsonOption = False,
) -> None:
    """Run the whole system with simulated hardware; block its path.

    The exit code is 0 if the robot reached the goal without contact and avoided the blocked area; 1 if it did not, or
    the demo was interrupted (see the report); 2 if an option or file can't be used.
    """
    from fog_runtime.configuration.settings import SettingsError  # noqa: PLC0415  # same
    from fog_runtime.configuration.site import SiteError, load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav.commands.demo import run_demo  # noqa: PLC0415  # same
    from fognav.demo.options import Options, hardware  # noqa: PLC0415  # same
    from fognav.demo.servers import embedded_servers  # noqa: PLC0415  # same

    try:
        folder = checkout.site_folder(site)
        load_site(folder)  # a site that can't be used is refused before anything is installed or compiled
        for file in (report, record):
            check_writable(file)
        base, lidar = hardware(robot_file, base, lidar)
    except (WrongUseError, SiteError, SettingsError) as error:
        fail(str(error), WRONG_USE)
    try:
        packages = embedded_servers(forced=embedded, yes=yes, print_line=print_line)
        node_code.prepare(print_line, yes=yes)
        kernels.warm_cache(print_line)
    except (system.MissingToolsError, kernels.KernelsError) as error:
        fail(str(error))
    options = Options(
        seed=seed,
        speed=speed,
        hazard=not no_hazard,
        base=base,
        lidar=lidar,
        robot_file=robot_file and robot_file.resolve(),
        keep_running=keep_running,
        record=record,
        embedded=packages,
    )
    try:
        values = asyncio.run(run_demo(folder, options, headless=headless, page_port=page_port, print_line=print_line))
        if report is not None:
            write_report(report, values)
    except WrongUseError as error:
        fail(str(error), WRONG_USE)
    if json:
        print_json(values)
    raise typer.Exit(OK if values["success"] else NOT_TRUE)


@app.command("doctor", epilog="Example: fognav doctor --json", rich_help_panel=installed.TRY_IT)
def doctor_command(*, json: JsonOption = False) -> None:
    """Show what is installed, what is missing and how to install it."""
    found = list(doctor.checks())
    if json:
        print_json(doctor.as_json(found))
    else:
        table = Table(box=None, padding=(0, 2), show_header=False)
        marks = {"ok": "[green]ok[/]", "missing": "[red]missing[/]", "optional": "[yellow]optional[/]"}
        for check in found:
            table.add_row(marks[check.state], check.name, check.found)
            if check.remedy:
                table.add_row("", "", f"[dim]remedy: {check.remedy}[/]")
        answers.print(table)
    raise typer.Exit(NOT_TRUE if any(check.state == "missing" for check in found) else OK)


Broker = Annotated[str, typer.Option("--mqtt", metavar="URL", help="MQTT broker.")]
Router = Annotated[str, typer.Option("--zenoh", metavar="ENDPOINT", help="zenoh router.")]
SiteId = Annotated[str, typer.Option("--site", metavar="ID", help="Id of the site, the second part of every key.")]


@app.command("record", epilog="Example: fognav record drive.mcap --seconds 60", rich_help_panel=installed.MEASURE)
def record_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file to write.")],
    *,
    mqtt: Broker = "mqtt://127.0.0.1:1883",
    zenoh: Router = "tcp/127.0.0.1:7447",
    site: SiteId = "estig",
    seconds: Annotated[float, typer.Option("--seconds", min=0.0, help="Duration; 0: until Ctrl-C.")] = 0.0,
    json: JsonOption = False,
) -> None:
    """Record every channel of a running system to an MCAP file.

    Foxglove opens such files; fognav replay publishes their messages again.
    """
    from fog_runtime import logs  # noqa: PLC0415  # keeps the other commands fast
    from fognav import recording  # noqa: PLC0415  # same

    logs.configure("record", "error", "text")
    try:
        check_writable(file)
        recorded = asyncio.run(recording.record(file, mqtt_url=mqtt, zenoh_endpoint=zenoh, site=site, seconds=seconds))
    except WrongUseError as error:
        fail(str(error), WRONG_USE)
    if json:
        print_json(recorded)
    else:
        print_line(f"wrote {file}: {recorded['seconds']} s, {recorded['messages']}")


@app.command("replay", epilog="Example: fognav replay drive.mcap --speed 2", rich_help_panel=installed.MEASURE)
def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file of a recording.")],
    *,
    mqtt: Broker = "mqtt://127.0.0.1:1883",
    zenoh: Router = "tcp/127.0.0.1:7447",
    site: SiteId = "estig",
    speed: Annotated[float, typer.Option("--speed", min=0.1, max=50.0, help="Speed factor.")] = 1.0,
    json: JsonOption = False,
) -> None:
    """Publish a recording's messages again, with their timing.

    They go to a broker and a router; services connected there process them like live messages.
    """
    from fog_runtime import logs  # noqa: PLC0415  # keeps the other commands fast
    from fognav import recording  # noqa: PLC0415  # same

    logs.configure("replay", "error", "text")  # the command itself reports errors
    try:
        sent = asyncio.run(recording.play(file, mqtt_url=mqtt, zenoh_endpoint=zenoh, site=site, speed=speed))
    except WrongUseError as error:
        fail(str(error), WRONG_USE)
    if json:
        print_json(sent)
    else:
        lost = (
            f"; the file is cut off: {sent['bytes_lost']} bytes at its end are incomplete" if sent["bytes_lost"] else ""
        )
        print_line(f"published {sent['sent']} messages of {file}{lost}")


@site_app.command(
    "new", epilog="Example: fognav site new --map floor.yaml --out sites/floor && fognav demo --site sites/floor"
)
def site_new(
    *,
    map_file: Annotated[Path, typer.Option("--map", metavar="MAP.yaml", help="map_server YAML; it is copied to DIR.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to create, without a site in it.")],
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Each seed proposes other places.")] = 1,
    json: JsonOption = False,
) -> None:
    """Propose a site on any map_server map, ready for a demo.

    This writes a commented DIR/site.toml with places, a robot and watched areas, as a starting point.
    """
    from fognav.commands.site import new_site  # noqa: PLC0415  # keeps the other commands fast

    try:
        kernels.warm_cache(print_line)
        made = new_site(map_file, out, seed)
    except WrongUseError as error:
        fail(str(error), WRONG_USE)
    except kernels.KernelsError as error:
        fail(str(error))
    if json:
        print_json(made)
    else:
        print_line(f"wrote {made['file']}: {made['areas']} watched areas. Try it: fognav demo --site {out}")
        if made["why_no_areas"]:
            print_line(f"no watched areas, so that a demo shows no hazard: {made['why_no_areas']}")


@site_app.command("check", epilog="Example: fognav site check sites/estig")
def site_check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with site.toml, or a name in sites/.")],
    *,
    json: JsonOption = False,
) -> None:
    """Check a site: map, ids, and that everything is on free floor."""
    from fognav.commands.site import check_site  # noqa: PLC0415  # keeps the other commands fast

    try:
        found = check_site(checkout.site_folder(folder))
    except WrongUseError as error:
        fail(str(error), WRONG_USE)
    if json:
        print_json(found)
    elif found["ok"]:
        print_line(f"{folder}: ok ({found['areas']} areas, {found['nodes']} nodes, {found['places']} places)")
        if found["unbounded_nodes"]:
            print_line(
                f"nodes with a sonar without range_max: {found['unbounded_nodes']}. To it an echo from behind the wall "
                "is clear: fognav node calibrate NODE --site DIR, unless it hears no wall"
            )
    else:
        fail(str(found["problem"]))
    raise typer.Exit(OK if found["ok"] else NOT_TRUE)


@site_app.command(
    "compose", epilog="Example: fognav site compose sites/upstairs && docker compose up -d --remove-orphans"
)
def site_compose(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="[DIR]...", help="Every floor but the first; none: no further ones.")
    ] = None,
    *,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Default: docker-compose.override.yml here.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Let the fog node in containers serve further floors.

    It writes the file that compose reads besides docker-compose.yml, at its next `docker compose up`. Name all floors
    each time, in the same order, which gives them their ports; and again after an upgrade.
    """
    from fognav.commands.site import compose_floors  # noqa: PLC0415  # keeps the other commands fast
    from fognav.hosting.compose_floors import OVERRIDE  # noqa: PLC0415  # same

    with exit_codes():
        root = checkout.root()
        sites = [checkout.site_folder(folder) for folder in folders or []]
        made = compose_floors(sites, root, out or root / OVERRIDE)
    if json:
        print_json(made)
    else:
        print_line(f"{made['file']} has {len(sites)} further floors: docker compose up -d --remove-orphans")


def main() -> None:
    """Run the command."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    # Help texts show the documented name, also when started by `python -m` or by the launcher.
    app(prog_name="fognav")


if __name__ == "__main__":
    main()
