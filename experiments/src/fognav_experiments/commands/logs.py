"""Commands on recorded logs of a lidar: `fognav localize` and `fognav map from-log`."""

from __future__ import annotations

import os
import time
from pathlib import Path  # Typer reads annotations at run time
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.progress import Progress

from fog_runtime.configuration.maps import MapFileError, load_map, save_map
from fognav import checkout, kernels
from fognav.commands.installed import MEASURE
from fognav.map_files import described, provenance
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import (
    NOT_TRUE,
    WrongUseError,
    check_writable,
    console,
    exit_codes,
    print_answer,
    print_json,
    writing,
)
from fognav_experiments.lidar_logs import LogFormat, Poses, RangeMax, Scans  # noqa: TC001  # same

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap
    from fognav_experiments.lidar_logs import Selection
    from fognav_experiments.lidar_logs.logs import LidarLog, LogScan


INTEL: Final = "intel_odom_ref_scan.jsonl.gz"


def add_localize(app: typer.Typer) -> None:
    """Add the command to `fognav`."""
    epilog = "Example: fognav localize --map floor.yaml --log drive.log.gz --scans even --json"
    app.command("localize", epilog=epilog, rich_help_panel=MEASURE)(localize_command)


def localize_command(  # noqa: PLR0913  # each option is an argument
    *,
    map_file: Annotated[Path, typer.Option("--map", metavar="MAP.yaml", help="map_server map of the building.")],
    log_file: Annotated[Path, typer.Option("--log", metavar="LOG", help="A log, as map from-log reads it.")],
    log_format: LogFormat = "auto",
    scans: Scans = "all",
    search: Annotated[bool, typer.Option("--global", help="Start by a search of the whole map.")] = False,
    kidnap: Annotated[bool, typer.Option("--kidnap", help="Carry the robot away unnoticed, half way.")] = False,
    trials: Annotated[
        int | None,
        typer.Option("--trials", metavar="N", min=1, help="With --global or --kidnap: N random excerpts of the log."),
    ] = None,
    first: Annotated[int, typer.Option("--first", metavar="N", min=0, help="Leave out N of the scans first.")] = 0,
    count: Annotated[int | None, typer.Option("--count", metavar="N", min=2, help="Use at most N scans.")] = None,
    range_max: RangeMax = 30.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of the filter and of added noise.")] = 1,
    png: Annotated[Path | None, typer.Option("--png", metavar="F", help="Draw map, reference and estimates.")] = None,
    json: JsonOption = False,
) -> None:
    """Evaluate the localization on a recorded log.

    The log has reference poses. If its odometry is its reference (corrected CARMEN logs), noise is added to it. The
    exit code is 1 if no pose was found, or one that is wrong. With --trials starts without a pose (--global) or robots
    that are carried away unnoticed (--kidnap) are counted, and it is 1 if any pose was wrong while it was good.
    """
    from fognav_experiments import localization_trials as tried  # noqa: PLC0415  # same
    from fognav_experiments.lidar_logs.logs import read_log  # noqa: PLC0415  # keeps the other commands fast
    from robot_agent.config import LocalizationConfig  # noqa: PLC0415  # same
    from robot_agent.localization.map_fields import map_fields  # noqa: PLC0415  # same

    with exit_codes():
        if trials is not None and search == kidnap:
            raise WrongUseError("--trials counts starts without a pose or kidnapped robots: add --global or --kidnap")
        check_writable(png)
        map_, log = _load_map(map_file), read_log(log_file, log_format)
        used = _with_references(log, scans, first, count, log_file)
        kernels.warm_cache(lambda text: console.print(text, markup=False))
        if not log.odometry_measured:
            used = tried.with_noise(used, seed)
        used, gap = tried.kidnapped(used) if kidnap and trials is None else (used, None)
        config = LocalizationConfig(range_max=range_max)
        fields = map_fields(map_.cells, map_.geometry, config)
        with Progress(console=console, disable=not console.is_terminal) as progress:
            task = progress.add_task("localizing", total=trials or len(used))

            def show(number: int) -> None:
                progress.update(task, completed=number + 1)

            if trials is not None:
                run = tried.random_kidnappings if kidnap else tried.random_starts
                found = run(fields, used, config, trials=trials, seed=seed, on_trial=show)
            else:
                samples = tried.track(fields, used, config, seed=seed, search=search, on_scan=show)
                odometry = "measured" if log.odometry_measured else "reference with noise"
                figures = tried.figures(samples, search=search, gap=gap)
                found = {"odometry": odometry, "global": search, **figures}
                if png is not None:
                    tried.write_plot(png, map_, samples)
    if json:
        print_json({"map": str(map_file), "log": str(log_file), "selection": scans, "seed": seed, **found})
    else:
        for name, value in found.items():
            print_answer(f"{name:26} {value}")
    if found.get("wrong") or found.get("falsely_good_scans") or found.get("converged_right") is False:
        raise typer.Exit(NOT_TRUE)


def _load_map(file: Path) -> StaticMap:
    try:
        return load_map(file)
    except MapFileError as error:
        raise WrongUseError(str(error)) from error


def _with_references(log: LidarLog, scans: Selection, first: int, count: int | None, file: Path) -> list[LogScan]:
    used = [scan for scan in log.select(scans) if scan.reference is not None][first:][:count]
    if len(used) < 2:
        raise WrongUseError(f"{file} has fewer than two such scans with a reference pose. Name a corrected log")
    return used


def add_bench(app: typer.Typer) -> None:
    """Add the command to `fognav bench`."""
    app.command("mapping", epilog="Example: fognav bench mapping --json")(bench_mapping)


def bench_mapping(
    *,
    log_file: Annotated[
        Path | None, typer.Option("--log", metavar="LOG", help="Another log than that of the Intel Research Lab.")
    ] = None,
    scans: Annotated[
        int | None,
        typer.Option("--scans", metavar="N", min=2, help="Drive the log's way in its map until there are N scans."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Make a map of a recorded floor: the time, the memory, and how far it is off the log's reference.

    The log is looked for in the folder that FOGNAV_DATA names. `seconds` run on the clock, from the log in memory to
    the map; `cpu_seconds` are those of all cores; `rss_mb` is the most that the process had. `scans_fit` tells how two
    scans 1 m apart lie on each other by this trajectory and by the log's reference, which is a SLAM result itself. With
    --scans the log is a simulated one, of a robot that drives the same way forth and back for hours.
    """
    from fog_mapping.relations import scans_fit  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments import machine  # noqa: PLC0415  # same
    from fognav_experiments.lidar_logs import mapping  # noqa: PLC0415  # same
    from fognav_experiments.lidar_logs.logs import read_log  # noqa: PLC0415  # same
    from fognav_experiments.lidar_logs.long_drive import write_long_drive  # noqa: PLC0415  # same
    from fognav_experiments.localization_trials import with_noise  # noqa: PLC0415  # same

    with exit_codes():
        file = log_file or recordings() / "lidar_logs" / INTEL
        kernels.warm_cache(lambda text: console.print(text, markup=False))
        log = read_log(file)
        if scans is not None:
            with TemporaryDirectory() as folder:
                write_long_drive(log.scans, scans, file := Path(folder) / f"{scans}-scans.jsonl")
                log = read_log(file)
        used = log.scans if log.odometry_measured else with_noise(log.scans, 1)
        started = time.monotonic()
        made = mapping.map_log(used, "matched", (), 0.05, 30.0)
        seconds = time.monotonic() - started
    found = made.figures()
    found |= {"seconds": round(seconds, 2), "cpu_seconds": found["seconds"], "loops": len(made.loops or ())}
    if made.reference is not None and scans is None:
        fits = scans_fit(mapping.scans_of(used, 30.0), made.poses, made.reference)
        found["scans_fit"] = {name: fit._asdict() for name, fit in zip(("matched", "reference"), fits, strict=False)}
    if json:
        print_json({"bench": "mapping", "log": file.name, **found, **machine.describe()})
        return
    for name, value in found.items():
        print_answer(f"{name:20} {value}")


def recordings() -> Path:
    """Return the folder of recordings: FOGNAV_DATA, or that beside the checkout; raises `WrongUseError`."""
    folder = Path(os.environ.get("FOGNAV_DATA") or checkout.root().parent / "shared" / "data")
    if not (folder / "lidar_logs" / INTEL).is_file():
        raise WrongUseError(
            f"{folder} has no lidar_logs/{INTEL}. Let FOGNAV_DATA name the folder of recordings, or name a --log"
        )
    return folder


def add_from_log(app: typer.Typer) -> None:
    """Add the command to `fognav map`."""
    app.command("from-log", epilog="Example: fognav map from-log drive.log.gz --out floor --png floor-loops.png")(
        map_from_log
    )


def map_from_log(  # noqa: PLR0913  # each option is an argument
    log_file: Annotated[Path, typer.Argument(metavar="LOG", help="Of map record, ROS 2 or CARMEN, or JSON lines.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="PREFIX", help="PREFIX.yaml and PREFIX.pgm are written.")],
    log_format: LogFormat = "auto",
    scans: Scans = "all",
    poses: Annotated[
        Poses, typer.Option("--poses", help="Find out where scans were taken, or believe the log's reference.")
    ] = "matched",
    without_loop: Annotated[
        list[str] | None,
        typer.Option("--without-loop", metavar="A-B", help="A loop of the list that is none; can be repeated."),
    ] = None,
    resolution: Annotated[
        float, typer.Option("--resolution", metavar="M", min=0.01, max=1.0, help="Size of a cell (m).")
    ] = 0.05,
    range_max: RangeMax = 30.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of noise that is added.")] = 1,
    png: Annotated[
        Path | None, typer.Option("--png", metavar="FILE", help="Draw the map, the way and its loops.")
    ] = None,
    film: Annotated[
        Path | None, typer.Option("--film", metavar="GIF", help="Show how the map grew, and what became of it.")
    ] = None,
    trajectory: Annotated[
        Path | None, typer.Option("--trajectory", metavar="FILE", help="Write `stamp x y theta` for each used scan.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Build a map from a log's scans and odometry.

    Each scan is matched to those before it, and places to which the robot comes again are found and joined (loops).
    Each loop is listed: look at them, and leave out with --without-loop what is none. What most scans look through
    becomes free, so people who walked by are left out. Where the log's odometry is its reference, noise is added to it.
    """
    from fognav_experiments.lidar_logs import mapping  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.lidar_logs.logs import read_log  # noqa: PLC0415  # same
    from fognav_experiments.localization_trials import with_noise  # noqa: PLC0415  # same

    with exit_codes():
        for file in (Path(f"{out}.yaml"), png, film, trajectory):
            check_writable(file)
        log = read_log(log_file, log_format)
        used, is_noisy = log.select(scans), poses == "matched" and not log.odometry_measured
        kernels.warm_cache(lambda text: console.print(text, markup=False))
        made = mapping.map_log(
            with_noise(used, seed) if is_noisy else used, poses, without_loop or [], resolution, range_max
        )
        with writing(Path(f"{out}.yaml"), "Name another --out"):
            save_map(out, made.map, provenance(log_file))
        if png is not None:
            made.draw(png)
        if film is not None:
            made.film(film, range_max)
        if trajectory is not None:
            made.write_trajectory(trajectory)
        found = described(made.map)
    if json:
        odometry = "reference with noise" if is_noisy else "measured"
        print_json({"file": f"{out}.yaml", **found, "odometry": odometry,
                    "stamps_mended": log.stamps_mended, **made.figures()})  # fmt: skip
        return
    if log.stamps_mended:
        print_answer(
            f"{log.stamps_mended} of {len(log.scans)} stamps go back, repeat or leap: the order of the scans in the "
            "file was believed instead. No scan was left out"
        )
    for line in made.lines():
        print_answer(line)
    print_answer(f"wrote {out}.yaml: {found['width']} x {found['height']} cells, {found['occupied']} occupied")
