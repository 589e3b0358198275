"""`fognav map from-log`: make the map of a building from a log of scans and odometry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_runtime.configuration.maps import save_map
from fognav import kernels
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import check_writable, console, exit_codes, print_answer, print_json, writing
from fognav_experiments.lidar_logs import LogFormat, Poses, RangeMax, Scans  # noqa: TC001  # same

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap


def add_to(app: typer.Typer) -> None:
    """Add the command to `fognav map`."""
    app.command("from-log", epilog="Example: fognav map from-log drive.log.gz --out floor --png floor-loops.png")(
        map_from_log
    )


def map_from_log(  # noqa: PLR0913  # each option is an argument
    log_file: Annotated[Path, typer.Argument(metavar="LOG", help="Log: JSON lines, CARMEN or a recording of ROS 2.")],
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
    range_max: RangeMax = 20.0,
    seed: Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Seed of noise that is added.")] = 1,
    png: Annotated[
        Path | None, typer.Option("--png", metavar="FILE", help="Draw the map, the way and its loops.")
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
        for file in (Path(f"{out}.yaml"), png, trajectory):
            check_writable(file)
        log = read_log(log_file, log_format)
        used, is_noisy = log.select(scans), poses == "matched" and not log.odometry_measured
        kernels.warm_cache(lambda text: console.print(text, markup=False))
        made = mapping.map_log(
            with_noise(used, seed) if is_noisy else used, poses, without_loop or [], resolution, range_max
        )
        with writing(Path(f"{out}.yaml"), "Name another --out"):
            save_map(out, made.map)
        if png is not None:
            made.draw(png)
        if trajectory is not None:
            made.write_trajectory(trajectory)
        found = _described(made.map)
    if json:
        odometry = "reference with noise" if is_noisy else "measured"
        print_json({"file": f"{out}.yaml", **found, "odometry": odometry, **made.figures()})
        return
    for line in made.lines():
        print_answer(line)
    print_answer(f"wrote {out}.yaml: {found['width']} x {found['height']} cells, {found['occupied']} occupied")


def _described(map_: StaticMap) -> dict[str, object]:
    """Return size, resolution and origin of a map, and how many of its cells are free, occupied and unknown."""
    geometry = map_.geometry
    names = {"free": FREE, "occupied": LETHAL, "unknown": UNKNOWN}
    return {
        "width": geometry.width,
        "height": geometry.height,
        "resolution": geometry.resolution,
        "origin": [geometry.origin_x, geometry.origin_y, 0.0],
        **{name: int(np.count_nonzero(map_.cells == value)) for name, value in names.items()},
    }
