"""`fognav demo`, `record` and `replay`: the whole system with simulated hardware, and what its channels carry."""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from fog_runtime import logs
from fog_runtime.configuration import parts
from fog_runtime.configuration.site import load_site
from fog_runtime.credentials import Credentials
from fognav import checkout, console_page, kernels, recording, system
from fognav.credentials import own_credentials
from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, YesOption
from fognav.output import (
    NOT_TRUE,
    OK,
    WrongUseError,
    check_writable,
    exit_codes,
    print_json,
    print_line,
    print_result,
    write_report,
)
from fognav.programs import BROKER, ROUTER
from fognav_sim import emulators


def _known_parts(group: str) -> str:
    return " or ".join(parts.names(group))


Broker = Annotated[str, typer.Option("--mqtt", metavar="URL", help="MQTT broker.")]
Router = Annotated[str, typer.Option("--zenoh", metavar="ENDPOINT", help="zenoh router.")]
SiteId = Annotated[str, typer.Option("--site", metavar="ID", help="Id of the site, the second part of every key.")]
_MQTT, _ZENOH, _SITE = "mqtt://127.0.0.1:1883", "tcp/127.0.0.1:7447", "estig"


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
    with_: Annotated[
        str | None,
        typer.Option("--with", metavar="WORLD", help="A robot of others follows, led by ros2, rmf or vda5050."),
    ] = None,
    embedded: Annotated[
        bool,
        typer.Option("--embedded", help="Use Python packages instead of Mosquitto and Redis, as without them."),
    ] = False,
    page_port: Annotated[
        int, typer.Option("--page-port", metavar="P", min=0, max=65535, help="Port of the page; 0: any free one.")
    ] = 0,
    yes: YesOption = False,
    json: JsonOption = False,
) -> None:
    """Run the whole system with simulated hardware; block its path.

    The exit code is 0 if the robot reached the goal without contact and avoided the blocked area; 1 if it did not, or
    the demo was interrupted (see the report); 2 if an option or file can't be used.
    """
    from fognav.demo.options import Options, embedded_servers, hardware  # noqa: PLC0415  # kernels are slow
    from fognav.demo.view import run_demo  # noqa: PLC0415  # same
    from fognav.running_bridge import GUESTS, require_ros2  # noqa: PLC0415  # same

    with exit_codes():
        if with_ is not None:
            if with_ not in GUESTS:
                raise WrongUseError(f"--with {with_}: no such system. Use: --with {' or --with '.join(GUESTS)}")
            require_ros2()
        loaded = load_site(checkout.site_folder(site))
        for file in (report, record):
            check_writable(file)
        base, lidar = hardware(robot_file, base, lidar)
        # What can't be used was refused by now, before anything is installed or compiled.
        packages = embedded_servers(forced=embedded, yes=yes, print_line=print_line)
        system.prepare_node_code(print_line, yes=yes)
        kernels.warm_cache(print_line)
        if not headless:
            console_page.build_in_background(checkout.root(), print_line)
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
            guest=with_ or "",
        )
        values = asyncio.run(run_demo(loaded, options, headless=headless, page_port=page_port, print_line=print_line))
        if report is not None:
            write_report(report, values)
    if json:
        print_json(values)
    raise typer.Exit(OK if values["success"] else NOT_TRUE)


def record_command(  # noqa: PLR0913  # each option is an argument
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file to write.")],
    *,
    mqtt: Annotated[
        str | None, typer.Option("--mqtt", metavar="URL", help="MQTT broker; default: that of the running system.")
    ] = None,
    zenoh: Annotated[
        str | None, typer.Option("--zenoh", metavar="ENDPOINT", help="zenoh router; default: that of the same.")
    ] = None,
    site: Annotated[str | None, typer.Option("--site", metavar="ID", help="Id of the site; default: the same.")] = None,
    fog: FogOption = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.0, help="Duration; 0: until Ctrl-C.")] = 0.0,
    json: JsonOption = False,
) -> None:
    """Record every channel of a running system to an MCAP file.

    Foxglove opens such files; fognav replay publishes their messages again.
    """
    logs.configure("record", "error", "text")
    with exit_codes():
        check_writable(file)
        url, endpoint, site_id, own = _to_record(mqtt, zenoh, site, fog)
        recorded = asyncio.run(
            recording.record(
                file, mqtt_url=url, zenoh_endpoint=endpoint, site=site_id, seconds=seconds, credentials=own
            )
        )
    line = f"wrote {file}: {recorded['seconds']} s, {recorded['messages']}"
    print_result(recorded, line, json=json, write=print_line)


def _to_record(
    mqtt: str | None, zenoh: str | None, site: str | None, fog: str | None
) -> tuple[str, str, str, Credentials]:
    """Return broker, router, site and the recorder's credentials: the running system's, if no server is named."""
    if mqtt is None and zenoh is None:
        found = find_fog(fog)
        console = found.system.credentials_file
        own = own_credentials(None if console is None else str(Path(console).with_name("recorder.toml")))
        return found.system.urls[BROKER], found.system.urls[ROUTER], site or found.site, own
    return mqtt or _MQTT, zenoh or _ZENOH, site or _SITE, own_credentials()


def replay_command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MCAP file of a recording.")],
    *,
    mqtt: Broker = _MQTT,
    zenoh: Router = _ZENOH,
    site: SiteId = _SITE,
    speed: Annotated[float, typer.Option("--speed", min=0.1, max=50.0, help="Speed factor.")] = 1.0,
    json: JsonOption = False,
) -> None:
    """Publish a recording's messages again, with their timing.

    They go to a broker and a router; services connected there process them like live messages.
    """
    logs.configure("replay", "error", "text")  # the command itself reports errors
    with exit_codes():
        sent = asyncio.run(recording.play(file, mqtt_url=mqtt, zenoh_endpoint=zenoh, site=site, speed=speed))
    lost = f"; the file is cut off: {sent['bytes_lost']} bytes at its end are incomplete" if sent["bytes_lost"] else ""
    print_result(sent, f"published {sent['sent']} messages of {file}{lost}", json=json, write=print_line)
