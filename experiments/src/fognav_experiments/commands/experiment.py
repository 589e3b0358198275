"""`fognav experiment`: compare robots that plan for themselves with one that the fog leads, as the thesis did."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from fognav import checkout
from fognav.commands.installed import MEASURE
from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, RobotOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import NOT_TRUE, WrongUseError, exit_codes, print_json, print_line
from fognav_experiments.commands.driving import count_failed, measured_on, prepare, show
from fognav_experiments.commands.sensitivity import people_command, sensitivity_command, sensors_command

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import Setup
    from fognav_experiments.comparison.live_drive import LiveOptions
    from fognav_experiments.comparison.records import Draws, Folder
    from fognav_experiments.comparison.runner import Task
    from fognav_experiments.scenarios.play import Played

experiment_app = typer.Typer(help="Compare setups as the thesis did, and play scenarios.")
experiment_app.command(
    "sensitivity", epilog="Example: fognav experiment sensitivity --out sweep --readings 2,5,20 --pause 50,500"
)(sensitivity_command)
experiment_app.command(
    "sensors", epilog="Example: fognav experiment sensors docs/results/estig-floor/drives.jsonl.xz --out sensors"
)(sensors_command)
experiment_app.command("people", epilog="Example: fognav experiment people --out people --people 0,5,20 --runs 10")(
    people_command
)


def add_to(app: typer.Typer) -> None:
    """Add the command to `fognav`."""
    app.add_typer(experiment_app, name="experiment", rich_help_panel=MEASURE)


@experiment_app.callback(
    invoke_without_command=True,
    epilog="Example: fognav experiment --setups default,lean,full,fog --runs 50 --seed 1 --out results",
)
def experiment_command(  # noqa: PLR0913  # each option is an argument
    context: typer.Context,
    *,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder of the records.")] = None,
    setups: Annotated[
        str | None, typer.Option("--setups", metavar="A,B", help="default, lean, full, fog; lean only in lockstep.")
    ] = None,
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=1, help="Runs of each setup.")] = 50,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of all draws.")] = 1,
    draws: Annotated[
        str, typer.Option("--draws", metavar="D", help="thesis: its few routes; floor: anywhere on the floor.")
    ] = "thesis",
    only: Annotated[int | None, typer.Option("--only", metavar="RUN", min=1, help="Only this run.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", metavar="N", min=1, help="Drives at the same time.")] = 1,
    site: Annotated[Path | None, typer.Option("--site", metavar="DIR", help="Site with experiment.toml.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Drive by real processes, with real brokers.")] = False,
    speed: Annotated[float, typer.Option("--speed", metavar="X", min=0.1, help="Of --live: times real time.")] = 1.0,
    cpu_quota: Annotated[
        float | None,
        typer.Option("--cpu-quota", metavar="SHARE", min=0.01, max=4.0, help="Of --live: the robot's share of a core."),
    ] = None,
    source: Annotated[
        Path | None, typer.Option("--from", metavar="FILE", help="Archive whose drives are not driven again.")
    ] = None,
    hardware: Annotated[
        bool, typer.Option("--hardware", help="Drive a real robot; asks a person to place it and each barrier.")
    ] = False,
    robot_file: Annotated[
        Path | None,
        typer.Option("--robot-file", metavar="F", help="Another simulated robot's settings (fognav robot new)."),
    ] = None,
    robot: RobotOption = None,
    fog: FogOption = None,
) -> None:
    """Repeat the thesis's experiment, one drive per run, route and setup: in lockstep, live, or with a real robot.

    A run is the routes of the site's experiment.toml. On each a drawn watched area is blocked at a drawn moment, the
    same for all setups. With --draws floor a run is one route between two stops anywhere on the floor, and any watched
    area is blocked. Each drive is one file, so a run that was killed goes on where it was when the command is
    repeated; --from goes on with the archive of a report, drives.jsonl.xz, on another day or machine. The setups of a
    route are driven one after another on one core, and again if the machine's load changed meanwhile: their CPU times
    are compared. Drives of --live and --hardware stand beside those in lockstep, and the report compares them; one that
    failed is driven again when the command is repeated, and stays in the count. The exit code is 1 if a drive failed
    or was skipped.
    """
    if context.invoked_subcommand is not None:
        return
    from fog_runtime.configuration.settings import SettingsError  # noqa: PLC0415  # same
    from fog_runtime.configuration.site import SiteError, load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments import machine  # noqa: PLC0415  # same
    from fognav_experiments.comparison import runner  # noqa: PLC0415  # same
    from fognav_experiments.comparison.live_drive import LiveOptions  # noqa: PLC0415  # same
    from fognav_experiments.comparison.records import Folder, FolderError, unpack_archive  # noqa: PLC0415  # same

    with exit_codes():
        if out is None:
            raise WrongUseError("name a folder for the records: --out DIR")
        if cpu_quota is not None and speed != 1.0:
            raise WrongUseError(f"--cpu-quota {cpu_quota:g} is a share of real time: leave --speed {speed:g} out")
        if hardware:
            _check_hardware(live=live, robot_file=robot_file)
        robot_file = robot_file and robot_file.resolve()
        place = checkout.site_folder(site)
        try:
            loaded = load_site(place)
            begun = runner.new(loaded, place, seed, _draws(draws, hardware=hardware), robot_file)
            numbers = [only] if only else range(1, runs + 1)
            chosen = _setups(setups, lockstep=not live and not hardware)
            asked = runner.tasks(runner.drawer(loaded, place, begun), numbers, chosen)
            runner.check_barriers(loaded, [] if hardware else asked)  # a person finds a place
            folder, commit = Folder(out), checkout.revision()
            if source is not None:
                print_line(f"{unpack_archive(source, folder, begun)} drives of {source} added to {out}")
            folder.begin(begun, {"commit": commit, **machine.describe()})
        except (SettingsError, SiteError, runner.SpecError, FolderError) as error:
            raise WrongUseError(str(error)) from error
        if hardware:
            failed = _drive_real_robot(loaded, asked, folder, fog, robot)
        elif live:
            options = LiveOptions(speed=speed, cpu_quota=cpu_quota, commit=commit, robot_file=robot_file)
            failed = _drive_live(loaded, asked, folder, options)
        else:
            prepare()
            records = runner.run(place, asked, folder, jobs, commit, robot_file)
            failed = show([task.name for task in asked], folder.drives, records)
    print_line(f"{len(asked) - failed} of {len(asked)} drives succeeded; records in {out}")
    if failed:
        raise typer.Exit(NOT_TRUE)


def _check_hardware(*, live: bool, robot_file: Path | None) -> None:
    if live:
        raise WrongUseError("--hardware and --live exclude each other: leave one of them out")
    if robot_file is not None:
        raise WrongUseError("--robot-file is of a simulated robot: leave it out, a real one has its own")


def _drive_live(site: LoadedSite, asked: Sequence[Task], folder: Folder, options: LiveOptions) -> int:
    """Drive by real processes; return how many drives failed."""
    from fognav_experiments.comparison.live_drive import live_drives  # noqa: PLC0415  # keeps the other commands fast

    prepare()
    files, names = folder.measured("live"), [options.name(task) for task in asked]
    return show(names, files, live_drives(site, asked, files, options, print_line))


def _drive_real_robot(
    site: LoadedSite, asked: Sequence[Task], folder: Folder, address: str | None, robot: str | None
) -> int:
    """Drive a robot of a fog node, with a person at this terminal; return how many drives failed."""
    from fognav_experiments.comparison.hardware_drive import drive_hardware  # noqa: PLC0415  # zenoh: keeps the other commands fast

    files = folder.measured("hardware")
    drive_hardware(site, asked, files, find_fog(address), robot, checkout.revision(), print_line)
    return count_failed([task.name for task in asked], files)


@experiment_app.command("report", epilog="Example: fognav experiment report results --out docs/results/estig")
def report_command(
    source: Annotated[Path, typer.Argument(metavar="DIR|FILE", help="Folder of the records, or their archive.")],
    *,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Folder of the report.")] = None,
    site: Annotated[Path | None, typer.Option("--site", metavar="DIR", help="Site of the drives.")] = None,
    with_live: Annotated[
        list[Path] | None,
        typer.Option("--with-live", metavar="DIR|FILE", help="Adds the drives of --live and --hardware from here."),
    ] = None,
) -> None:
    """Write the report of an experiment: Markdown, figures, CSV and an archive of all records.

    It shows the thesis's figures with ours beside them, paired differences with their tests, and where CPU time went.
    From the archive, drives.jsonl.xz, the report is made again, and the experiment goes on (--from). Memory, and what
    lockstep says beside real processes, it shows where DIR, or a folder or archive named by --with-live, has such
    drives.
    """
    from fog_runtime.configuration.site import SiteError  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.comparison.records import FolderError  # noqa: PLC0415  # same
    from fognav_experiments.comparison.report import publish  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.comparison.runner import SpecError, site_digest  # noqa: PLC0415  # same

    with exit_codes():
        if out is None and source.is_file():
            raise WrongUseError(f"{source} is an archive: name a folder for the report with --out DIR")
        try:
            with _records_of(source, with_live or []) as folder:
                place = checkout.site_folder(site)
                if site is not None and site_digest(place) != folder.description()["asked"]["site_digest"]:
                    raise WrongUseError(
                        f"--site {site} is not as it was when {source} was driven: name the site of these drives, or "
                        "leave it out, and the report does without what its map tells"
                    )
                written = publish(folder, out or source, place)
        except (FolderError, SiteError, SpecError, OSError) as error:
            raise WrongUseError(str(error)) from error
    for file in written:
        print_line(str(file))


@contextmanager
def _records_of(source: Path, with_live: Sequence[Path] = ()) -> Iterator[Folder]:
    """Provide a folder of records; that of an archive for as long as it is needed. Raises `FolderError`.

    `with_live`: folders and archives whose drives by real processes are added, in a folder that lasts as long.
    """
    from fognav_experiments.comparison.records import Folder, unpack_archive  # noqa: PLC0415  # keeps the other commands fast

    if not source.is_file() and not with_live:
        yield Folder(source)
        return
    with TemporaryDirectory(prefix="fognav-records-") as temporary:
        folder = Folder(Path(temporary))
        if source.is_file():
            unpack_archive(source, folder)
        else:
            folder.add(Folder(source))
        for other in with_live:
            with _records_of(other) as live:
                if not folder.add(live, only_measured=True):
                    print_line(f"{other} holds no drives by real processes that {source} lacks")
        yield folder


@experiment_app.command("scenarios", epilog="Example: fognav experiment scenarios wifi-gap-5s kidnapped")
def scenarios_command(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Scenarios; default: all.")] = None,
    *,
    table: Annotated[Path | None, typer.Option("--table", metavar="F", help="Write a table (Markdown) here.")] = None,
    json: JsonOption = False,
) -> None:
    """Play drives on which something goes wrong, in lockstep, and check how they end.

    Each is a file in experiments/scenarios with what happens and what is expected. The exit code is 1 if one of them
    ends in another way.
    """
    from fog_runtime.files import SHARED, atomic_write  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.figures import flat  # noqa: PLC0415  # same
    from fognav_experiments.scenarios.play import ScenarioError, markdown_page, play, read_scenario  # noqa: PLC0415  # same

    with exit_codes():
        files = _scenario_files(names or [])
        try:
            scenarios = {file.stem: read_scenario(file) for file in files}
        except ScenarioError as error:
            raise WrongUseError(str(error)) from error
        prepare()
        drives = {}
        for name, scenario in scenarios.items():
            drives[name] = play(scenario, checkout.root() / "sites")
            if not json:
                _print_played(name, drives[name])
            # Each time: a command that is ended after half an hour leaves what it has found.
            if table is not None:
                atomic_write(table, markdown_page(drives, dict(flat(measured_on()))).encode(), mode=SHARED)
    if json:
        print_json({"scenarios": [_played_row(name, played) for name, played in drives.items()]})
    if any(played.deviations for played in drives.values()):
        raise typer.Exit(NOT_TRUE)


def _played_row(name: str, played: Played) -> dict[str, object]:
    return {
        "scenario": name, "title": played.scenario.title, "as_expected": not played.deviations,
        "outcome": played.outcome, "distance_m": played.result.distance_m, "time_s": played.result.time_s,
        "deviations": played.deviations,
    }  # fmt: skip


def _print_played(name: str, played: Played) -> None:
    mark, time_s = "FAILED" if played.deviations else "ok    ", played.result.time_s or played.scenario.seconds
    print_line(f"{mark} {name:22} {played.outcome:9} {played.result.distance_m:6.1f} m {time_s:6.1f} s")
    for deviation in played.deviations:
        print_line(f"       {deviation}")


@experiment_app.command("film", epilog="Example: fognav experiment film drive.gif --from drives --run 2 --route ab")
def film_command(  # noqa: PLR0913  # each option is an argument
    out: Annotated[Path, typer.Argument(metavar="FILE", help="The film, .gif; or stills of one moment, .png.")],
    *,
    source: Annotated[
        Path, typer.Option("--from", metavar="DIR|FILE", help="Folder of the records, or their archive.")
    ],
    run: Annotated[int, typer.Option("--run", metavar="N", min=1, help="Run of the experiment.")] = 2,
    route: Annotated[str | None, typer.Option("--route", metavar="R", help="Its route, as ab; default: first.")] = None,
    setups: Annotated[str, typer.Option("--setups", metavar="A,B", help="default, lean, full, fog.")] = "default,fog",
    at: Annotated[float, typer.Option("--at", metavar="S", min=0.0, help="Of stills: s after the start.")] = 10.0,
    site: Annotated[Path | None, typer.Option("--site", metavar="DIR", help="Site with experiment.toml.")] = None,
) -> None:
    """Film one route of an experiment in several setups, side by side: map, hazards, paths and tracks, as a GIF.

    The drives are those of the records that `fognav experiment --out DIR` wrote; nothing is driven again. For stills
    they are driven anew until that moment: they show the costs, path and local window that each robot drives by.
    """
    from fog_runtime.configuration.site import SiteError, load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.comparison import runner  # noqa: PLC0415  # same
    from fognav_experiments.comparison.film import Film, NoStillError, UnfilmedDriveError, write_stills  # noqa: PLC0415  # same
    from fognav_experiments.comparison.records import FolderError  # noqa: PLC0415  # same

    with exit_codes():
        if out.suffix not in (".gif", ".png"):
            raise WrongUseError(f"{out} is neither GIF nor PNG: name a file that ends in .gif or .png")
        place = checkout.site_folder(site)
        try:
            loaded = load_site(place)
            with _records_of(source) as folder:
                drawn = runner.recorded_draw(folder, loaded, place, run, route)
                if out.suffix == ".png":
                    prepare()
                    write_stills(loaded, drawn, _chosen(setups), at, out)
                    return
                records = folder.read_drives(run, drawn.route.name, _chosen(setups))
            size = Film(loaded, drawn, records).write(out)
        except (SiteError, runner.SpecError, FolderError, UnfilmedDriveError, NoStillError) as error:
            raise WrongUseError(str(error)) from error
        except OSError as error:
            raise WrongUseError(f"{out} can't be written: {error.strerror}. Name another file") from error
    for record in records:
        print_line(f"{record.setup:8} {record.distance_m:6.1f} m {record.time_s:6.1f} s")
    print_line(f"{out}: {size / 1e6:.2f} MB")


def _scenario_files(names: list[str]) -> list[Path]:
    folder = checkout.root() / "experiments" / "scenarios"
    known = {file.stem: file for file in sorted(folder.glob("*.toml"))}
    if unknown := [name for name in names if name not in known]:
        raise WrongUseError(f"no scenario {', '.join(unknown)}: there are {', '.join(known)}")
    return [known[name] for name in names or known]


def _setups(setups: str | None, *, lockstep: bool) -> list[Setup]:
    """Return the setups to drive; real nodes can't be switched off, so `lean` is driven in lockstep only."""
    chosen = _chosen(setups or ("default,lean,full,fog" if lockstep else "default,full,fog"))
    if "lean" in chosen and not lockstep:
        raise WrongUseError("--setups lean is driven in lockstep only: leave out --live and --hardware, or lean")
    return chosen


def _draws(draws: str, *, hardware: bool) -> Draws:
    """Return of what routes are drawn; a real robot's stops are places of its site."""
    if draws == "thesis":
        return "thesis"
    if draws != "floor":
        raise WrongUseError(f"--draws {draws} is unknown: choose of thesis, floor")
    if hardware:
        raise WrongUseError("--draws floor has stops that are no places of the site: leave out --hardware, or --draws")
    return "floor"


def _chosen(setups: str) -> list[Setup]:
    from fognav_experiments.comparison.drives import PROFILE_OF_SETUP  # noqa: PLC0415  # keeps the other commands fast

    chosen = [known for name in setups.split(",") for known in PROFILE_OF_SETUP if known == name.strip()]
    if len(chosen) != len(setups.split(",")):
        raise WrongUseError(f"--setups {setups} names an unknown setup: choose of {', '.join(PROFILE_OF_SETUP)}")
    return chosen
