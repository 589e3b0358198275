"""The command line: each command reads its options, calls what does the work, and turns the outcome into a code."""

import asyncio
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.table import Table

from fognav import __version__, checkout, doctor, kernels, system
from fognav.channels_command import channels_command
from fognav.output import NOT_TRUE, OK, WRONG_USE, WrongUseError, check_writable, console, print_json, write_report

app = typer.Typer(
    name="fognav",
    help="Keep a small indoor robot out of danger that it can't see yet.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
site_app = typer.Typer(help="Make and check sites.", no_args_is_help=True)
app.add_typer(site_app, name="site")
app.command("channels", epilog="Example: fognav channels --format acl --broker mqtt")(channels_command)

Yes = Annotated[
    bool, typer.Option("--yes", help="Install missing system packages without asking (CI=true says so too).")
]
Json = Annotated[bool, typer.Option("--json", help="Write one JSON object to standard output.")]


def _say(text: str) -> None:
    console.print(text, markup=False)


def _fail(message: str, code: int = NOT_TRUE) -> NoReturn:
    console.print(f"fognav: {message}", markup=False, style="red")
    raise typer.Exit(code)


def _version(show: bool) -> None:  # noqa: FBT001  # Typer calls it with its value alone
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
    del version  # its callback has done all


@app.command("doctor", epilog="Example: fognav doctor --json")
def doctor_command(*, json: Json = False) -> None:
    """Say what is installed, what is missing and how to get it."""
    found = list(doctor.checks())
    if json:
        print_json(doctor.as_json(found))
    else:
        table = Table(box=None, padding=(0, 2), show_header=False)
        marks = {"ok": "[green]ok[/]", "missing": "[red]missing[/]", "optional": "[yellow]optional[/]"}
        for check in found:
            table.add_row(marks[check.state], check.name, check.found)
            if check.remedy:
                table.add_row("", "", f"[dim]to do: {check.remedy}[/]")
        console.print(table)
    raise typer.Exit(NOT_TRUE if any(check.state == "missing" for check in found) else OK)


def _prepare(*, yes: bool) -> None:
    try:
        system.ensure([system.MOSQUITTO, system.REDIS], yes=yes, say=_say)
        kernels.make_warm(_say)
    except (system.MissingToolsError, kernels.KernelsError) as error:
        _fail(str(error))


@app.command(
    "test",
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    epilog="Example: fognav test --yes -k replica",
)
def run_tests(context: typer.Context, *, yes: Yes = False) -> None:
    """Set up what is missing, then run every test on all cores.

    Those with real brokers are among them; further arguments go to pytest (`-n 0` runs them one after the other).
    """
    from fognav import testing  # noqa: PLC0415  # the other commands need not wait for its imports

    _prepare(yes=yes)
    testing.get_browser(yes=yes, say=_say)
    done = subprocess.run(testing.pytest_command(context.args), check=False, cwd=checkout.root())
    raise typer.Exit(done.returncode)


@app.command("check", epilog="Example: fognav check --json")
def check_command(*, json: Json = False) -> None:
    """Check everything that needs no running.

    Format, lint, types, import contracts, dead code and generated files: all of them run, and the exit code is 1 if one
    fails.
    """
    from fognav import checks  # noqa: PLC0415  # the other commands need not wait for its imports

    def show(result: checks.CheckResult) -> None:
        mark = "[green]ok[/]    " if result.ok else "[red]failed[/]"
        console.print(f"{mark} {result.seconds:5.1f} s  {result.check.name}")
        if not result.ok:
            _say(result.output)

    begun = time.monotonic()
    try:
        results = asyncio.run(checks.run_checks(checks.CHECKS, checkout.root(), show))
    except WrongUseError as error:
        _fail(str(error), WRONG_USE)
    seconds, failed = time.monotonic() - begun, [result for result in results if not result.ok]
    if json:
        shown = [{"check": r.check.name, "ok": r.ok, "seconds": round(r.seconds, 1)} for r in results]
        print_json({"ok": not failed, "seconds": round(seconds, 1), "checks": shown})
    if failed:
        todo = "\n".join(f"  {result.check.name}: {result.check.remedy}" for result in failed)
        _fail(f"{len(failed)} of {len(results)} checks failed in {seconds:.0f} s:\n{todo}")
    _say(f"all {len(results)} checks hold ({seconds:.0f} s)")


@app.command("demo", epilog="Example: fognav demo --headless --report report.json --seed 7")
def demo_command(  # noqa: PLR0913  # each option is an argument
    *,
    headless: Annotated[bool, typer.Option("--headless", help="No terminal view and no page: for machines.")] = False,
    report: Annotated[Path | None, typer.Option("--report", metavar="F", help="Write the report (JSON) here.")] = None,
    site: Annotated[
        Path | None,
        typer.Option("--site", metavar="D", help="Folder of a site, or a name in sites/; estig without it."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of noise, area and moment.")] = 1,
    speed: Annotated[
        float,
        typer.Option("--speed", metavar="K", min=0.1, max=50.0, help="Simulated time against wall time."),
    ] = 1.0,
    no_hazard: Annotated[bool, typer.Option("--no-hazard", help="Block nothing on the way.")] = False,
    base: Annotated[
        str, typer.Option("--base", metavar="NAME", help="What the robot drives on: roomba600 or diffdrive.")
    ] = "roomba600",
    lidar: Annotated[
        str, typer.Option("--lidar", metavar="NAME", help="What the robot sees with: rplidar-a1 or ld19.")
    ] = "rplidar-a1",
    keep_running: Annotated[
        bool, typer.Option("--keep-running", help="Leave everything running after the drive, until Ctrl-C.")
    ] = False,
    record: Annotated[
        Path | None, typer.Option("--record", metavar="F", help="Record every channel to this MCAP file.")
    ] = None,
    page_port: Annotated[
        int, typer.Option("--page-port", metavar="P", min=0, max=65535, help="Port of the page; 0: any free one.")
    ] = 0,
    yes: Yes = False,
    json: Json = False,
) -> None:
    """Run the whole system with simulated hardware, and block its way.

    Exit code 0 only if the goal was reached without touching anything, by a way that avoids the blocked area; 1 if it
    was not, or was interrupted (the report says which); 2 if what was asked for can't be used.
    """
    from fog_runtime.site import SiteError, load_site  # noqa: PLC0415  # the other commands need not wait for imports
    from fognav.demo.command import run_demo  # noqa: PLC0415  # same
    from fognav.demo.options import Options  # noqa: PLC0415  # same

    try:
        folder = checkout.site_folder(site)
        load_site(folder)  # what can't be used is refused before anything is installed or compiled for it
        for file in (report, record):
            check_writable(file)
    except (WrongUseError, SiteError) as error:
        _fail(str(error), WRONG_USE)
    _prepare(yes=yes)
    options = Options(
        seed=seed,
        speed=speed,
        hazard=not no_hazard,
        base=base,
        lidar=lidar,
        keep_running=keep_running,
        record=record,
    )
    try:
        values = asyncio.run(run_demo(folder, options, headless=headless, page_port=page_port, say=_say))
        if report is not None:
            write_report(report, values)
    except WrongUseError as error:
        _fail(str(error), WRONG_USE)
    if json:
        print_json(values)
    raise typer.Exit(OK if values["success"] else NOT_TRUE)


Broker = Annotated[str, typer.Option("--mqtt", metavar="URL", help="The broker.")]
Router = Annotated[str, typer.Option("--zenoh", metavar="ENDPOINT", help="The zenoh router.")]
SiteId = Annotated[str, typer.Option("--site", metavar="ID", help="Id of the site, the second part of every key.")]


@app.command("record", epilog="Example: fognav record drive.mcap --seconds 60")
def record_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file to write.")],
    *,
    mqtt: Broker = "mqtt://127.0.0.1:1883",
    zenoh: Router = "tcp/127.0.0.1:7447",
    site: SiteId = "estig",
    seconds: Annotated[float, typer.Option("--seconds", min=0.0, help="How long; 0: until Ctrl-C.")] = 0.0,
    json: Json = False,
) -> None:
    """Record every channel of a running system to an MCAP file.

    Foxglove opens such files, and fognav replay sends them again.
    """
    from fog_runtime import logs  # noqa: PLC0415  # the other commands need not wait for its imports
    from fognav import recording  # noqa: PLC0415  # same

    logs.configure("record", "error", "text")
    try:
        check_writable(file)
        made = asyncio.run(recording.record(file, mqtt_url=mqtt, zenoh_endpoint=zenoh, site=site, seconds=seconds))
    except WrongUseError as error:
        _fail(str(error), WRONG_USE)
    if json:
        print_json(made)
    else:
        _say(f"wrote {file}: {made['seconds']} s, {made['messages']}")


@app.command("replay", epilog="Example: fognav replay drive.mcap --speed 2")
def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file that was recorded.")],
    *,
    mqtt: Broker = "mqtt://127.0.0.1:1883",
    zenoh: Router = "tcp/127.0.0.1:7447",
    site: SiteId = "estig",
    speed: Annotated[float, typer.Option("--speed", min=0.1, max=50.0, help="How many times as fast.")] = 1.0,
    json: Json = False,
) -> None:
    """Send a recording's messages again, at their times.

    They go to a broker and a router; services that listen there take them for the real thing.
    """
    from fog_runtime import logs  # noqa: PLC0415  # the other commands need not wait for its imports
    from fognav import recording  # noqa: PLC0415  # same

    logs.configure("replay", "error", "text")  # what went wrong is told by the command itself
    try:
        sent = asyncio.run(recording.play(file, mqtt_url=mqtt, zenoh_endpoint=zenoh, site=site, speed=speed))
    except WrongUseError as error:
        _fail(str(error), WRONG_USE)
    if json:
        print_json(sent)
    else:
        lost = f"; its end is missing: {sent['bytes_lost']} bytes are no whole record" if sent["bytes_lost"] else ""
        _say(f"sent {sent['sent']} messages of {file}{lost}")


@site_app.command(
    "new", epilog="Example: fognav site new --map floor.yaml --out sites/floor && fognav demo --site sites/floor"
)
def site_new(
    *,
    map_file: Annotated[Path, typer.Option("--map", metavar="MAP.yaml", help="map_server YAML; it stays where it is.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to make; it must not hold a site yet.")],
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Another seed proposes other places.")] = 1,
    json: Json = False,
) -> None:
    """Propose a site on any map_server map, ready for a demo.

    Writes DIR/site.toml, commented, as a starting point: places, a robot and watched areas.
    """
    from fognav.site_command import new_site  # noqa: PLC0415  # the other commands need not wait for its imports

    try:
        kernels.make_warm(_say)
        made = new_site(map_file, out, seed)
    except WrongUseError as error:
        _fail(str(error), WRONG_USE)
    except kernels.KernelsError as error:
        _fail(str(error))
    if json:
        print_json(made)
    else:
        _say(f"wrote {made['file']}: {made['areas']} watched areas. Try it: fognav demo --site {out}")


@site_app.command("check", epilog="Example: fognav site check sites/estig")
def site_check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with site.toml, or a name in sites/.")],
    *,
    json: Json = False,
) -> None:
    """Check a site: map, ids, and that everything lies on free floor."""
    from fognav.site_command import check_site  # noqa: PLC0415  # same

    try:
        found = check_site(checkout.site_folder(folder))
    except WrongUseError as error:
        _fail(str(error), WRONG_USE)
    if json:
        print_json(found)
    elif found["ok"]:
        _say(f"{folder}: all is well ({found['areas']} areas, {found['nodes']} nodes, {found['places']} places)")
    else:
        _fail(str(found["problem"]))
    raise typer.Exit(OK if found["ok"] else NOT_TRUE)


def main() -> None:
    """Run the command."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    # Whoever started it by `python -m` or by the launcher reads the one name that all documents use.
    app(prog_name="fognav")


if __name__ == "__main__":
    main()
