"""`fognav experiment sensitivity`, `sensors` and `people`: on what it depends what the fog saves."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Final

import typer

from fognav import checkout
from fognav.output import NOT_TRUE, WrongUseError, exit_codes, print_line
from fognav_experiments.commands.driving import measured_on, prepare, show

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.comparison.drives import RouteDraw
    from fognav_experiments.comparison.records import Folder
    from fognav_experiments.comparison.sensitivity import Plane, Quantity

_NOT_SWEPT: Final = "none"


def sensitivity_command(  # noqa: PLR0913  # each option is an argument
    *,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of records and report.")],
    readings: Annotated[
        str, typer.Option("--readings", metavar="N,N", help="Readings that confirm; none: not swept.")
    ] = "2,5,20",
    pause: Annotated[str, typer.Option("--pause", metavar="MS,MS", help="Pauses of the nodes.")] = "50,500",
    areas: Annotated[
        str, typer.Option("--areas", metavar="N,N", help="Watched areas; 0: all; none: not swept.")
    ] = "1,4,0",
    speeds: Annotated[str, typer.Option("--speeds", metavar="V,V", help="Speeds of the robot, m/s.")] = "0.2,0.3",
    delays: Annotated[
        str, typer.Option("--delays", metavar="MS,MS", help="Median delays of messages, ms.")
    ] = _NOT_SWEPT,
    gaps: Annotated[str, typer.Option("--gaps", metavar="N,N", help="Gaps of the radio a minute.")] = "0,2,10",
    stays: Annotated[
        str, typer.Option("--stays", metavar="S,S", help="How long blocks and false alarms stand, s.")
    ] = _NOT_SWEPT,
    known: Annotated[
        str, typer.Option("--known", metavar="N,N", help="Blocks as long that the planner has seen.")
    ] = "0,20",
    routes: Annotated[int, typer.Option("--routes", metavar="N", min=1, help="Routes of each point.")] = 3,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of all draws.")] = 1,
    jobs: Annotated[int | None, typer.Option("--jobs", metavar="N", min=1, help="Drives at a time; all cores.")] = None,
    site: Annotated[Path | None, typer.Option("--site", metavar="DIR", help="Site with experiment.toml.")] = None,
) -> None:
    """Sweep what the fog's saving depends on, and draw it as heat maps.

    Planes are driven on the first routes whose obstacle bars the way: readings by pause, areas by speed; if asked for,
    delays by gaps of the radio, and how long blocks and false alarms stand by what the planner knows of them. Each is
    left out by the word none. A sweep that was killed goes on where it was.
    """
    from fog_runtime.configuration.site import SiteError, load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.comparison import runner  # noqa: PLC0415  # same
    from fognav_experiments.comparison.records import Folder, FolderError  # noqa: PLC0415  # same
    from fognav_experiments.comparison.sensitivity import Axis, Plane  # noqa: PLC0415  # same

    with exit_codes():
        swept: list[Plane] = []
        command = "fognav experiment sensitivity"
        asked: list[tuple[tuple[Quantity, str, str], tuple[Quantity, str, str]]] = [
            (("readings", "--readings", readings), ("pause_ms", "--pause", pause)),
            (("areas", "--areas", areas), ("speed_m_s", "--speeds", speeds)),
            (("delay_ms", "--delays", delays), ("gaps_per_min", "--gaps", gaps)),
            (("stays_s", "--stays", stays), ("known_blocks", "--known", known)),
        ]
        for (x, option, values), (y, other, others) in asked:
            if values != _NOT_SWEPT:
                command += f" {option} {values} {other} {others}"
                swept.append(Plane(Axis(x, _values(values)), Axis(y, _values(others))))
            elif x in ("readings", "areas"):  # which are swept by default
                command += f" {option} {values}"
        if stays != _NOT_SWEPT:
            swept.append(swept[-1]._replace(false_alarms=True))
        if not swept:
            raise WrongUseError(
                "this leaves nothing to sweep: give one of --readings, --areas, --delays, --stays numbers"
            )
        command += f" --routes {routes} --seed {seed} --out DIR"
        try:
            place = checkout.site_folder(site)
            loaded = load_site(place)
            drawn = runner.barred_routes(loaded, runner.read_spec(loaded, place), seed, routes)
            folder = Folder(out)
            folder.begin(runner.new(loaded, place, seed), measured_on())
            failed = _sweep(loaded, folder, swept, drawn, command, jobs or os.cpu_count() or 1)
        except (SiteError, runner.SpecError, FolderError) as error:
            raise WrongUseError(str(error)) from error
    if failed:
        raise typer.Exit(NOT_TRUE)


def sensors_command(
    archive: Annotated[Path, typer.Argument(metavar="FILE", help="Archive of drives with --draws floor.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the report.")],
    site: Annotated[Path | None, typer.Option("--site", metavar="DIR", help="Site of the drives.")] = None,
) -> None:
    """Compare kinds of sensors by what a corridor costs and how many metres they would have saved in these drives."""
    from fog_runtime.configuration.site import SiteError, load_site  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.comparison import records, sensor_kinds  # noqa: PLC0415  # same

    command = f"fognav experiment sensors {archive} --out DIR"
    with exit_codes(), TemporaryDirectory(prefix="fognav-") as unpacked:
        try:
            folder = records.Folder(Path(unpacked))
            records.unpack_archive(archive, folder)
            loaded = load_site(checkout.site_folder(site))
            out.mkdir(parents=True, exist_ok=True)
            for file in sensor_kinds.publish(loaded, folder.drives.read(), command, out):
                print_line(str(file))
        except (records.FolderError, SiteError, OSError) as error:
            raise WrongUseError(str(error)) from error


def people_command(
    *,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of records and report.")],
    people: Annotated[
        str, typer.Option("--people", metavar="N,N", help="People on the floor; 0 is what others compare with.")
    ] = "0,1,5,10,20",
    runs: Annotated[int, typer.Option("--runs", metavar="N", min=1, help="Drives of each number and setup.")] = 10,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of all draws.")] = 1,
    jobs: Annotated[int | None, typer.Option("--jobs", metavar="N", min=1, help="Drives at a time; all cores.")] = None,
    site: Annotated[Path | None, typer.Option("--site", metavar="DIR", help="Site with experiment.toml.")] = None,
) -> None:
    """Drive the first route among walking people, led by the fog and without it.

    The report tells which blocks only passers-by made, who stood before a node unseen, and what people cost a robot.
    Drives that were killed go on when the command is repeated, also on another machine with the archive alone,
    people.jsonl.xz; more --runs add to those that are there.
    """
    from fog_runtime.configuration.site import SiteError, load_site  # noqa: PLC0415  # keeps the other commands fast
    from fog_runtime.files import SHARED, atomic_write  # noqa: PLC0415  # same
    from fognav_experiments.comparison import people as among  # noqa: PLC0415  # same
    from fognav_experiments.comparison import people_page, runner  # noqa: PLC0415  # same
    from fognav_experiments.comparison.records import DriveFiles, Folder, FolderError  # noqa: PLC0415  # same

    command = f"fognav experiment people --people {people} --runs {runs} --seed {seed} --out DIR"
    with exit_codes():
        counts = [int(number) for number in _values(people)]
        try:
            place = checkout.site_folder(site)
            loaded = load_site(place)
            asked = among.people_tasks(runner.read_spec(loaded, place), seed, runs, counts)
            folder = Folder(out)
            folder.begin(runner.new(loaded, place, seed), measured_on())
            files = DriveFiles(folder.path / "people", among.PeopleDrive)
            files.unpack(folder.path / among.ARCHIVE)
        except (SiteError, runner.SpecError, FolderError) as error:
            raise WrongUseError(str(error)) from error
        prepare()
        names = [task.name for task in asked]
        drives = among.people_drives(loaded, asked, files, jobs or os.cpu_count() or 1, checkout.revision())
        failed = show(names, files, drives)
        found = [drive for drive in files.read() if drive.name in names]
        measured = folder.description()["measured_on"]
        atomic_write(folder.path / among.ARCHIVE, files.pack({"measured_on": measured}), mode=SHARED)
        for file in people_page.publish(found, command, measured, folder.path):
            print_line(str(file))
    if failed:
        raise typer.Exit(NOT_TRUE)


def _sweep(  # what is driven, where and how
    site: LoadedSite,
    folder: Folder,
    swept: Sequence[Plane],
    drawn: Sequence[RouteDraw],
    command: str,
    jobs: int,
) -> int:
    """Drive a sweep and publish it; return how many drives failed."""
    from fognav_experiments.comparison import sensitivity  # noqa: PLC0415  # same
    from fognav_experiments.comparison.records import DriveFiles  # noqa: PLC0415  # keeps the other commands fast

    prepare()
    asked, files = sensitivity.sweep_tasks(swept, drawn), DriveFiles(folder.path / "sweep", sensitivity.SweptDrive)
    names = [task.name for task in asked]
    failed = show(names, files, sensitivity.sweep(site, asked, files, jobs, checkout.revision()))
    drives = [drive for drive in files.read() if drive.name in names]
    for file in sensitivity.publish(drives, swept, command, folder.description()["measured_on"], folder.path):
        print_line(str(file))
    return failed


def _values(text: str) -> list[float]:
    try:
        return [float(part) if "." in part else int(part) for part in text.split(",")]
    except ValueError as error:
        raise WrongUseError(f"{text} is no list of numbers: write them as 2,5,20") from error
