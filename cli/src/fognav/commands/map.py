"""`fognav map`: maps of buildings."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated

import typer

from fognav.localization.logs import read_log
from fognav.localization.options import LogFormat, RangeMax, Scans  # noqa: TC001  # Typer reads annotations at run time
from fognav.operate.options import JsonOption  # noqa: TC001  # same
from fognav.output import WrongUseError, exit_codes, print_json, print_line

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap

map_app = typer.Typer(help="Make maps of buildings.", no_args_is_help=True)


@map_app.callback()
def _map() -> None:
    """Keep `from-log` a command of its own while it is the only one."""


@map_app.command("from-log", epilog="Example: fognav map from-log drive.log.gz --out floor --scans odd")
def map_from_log(  # noqa: PLR0913  # each option is an argument
    log_file: Annotated[Path, typer.Argument(metavar="LOG", help="Log with reference poses: JSON lines or CARMEN.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="PREFIX", help="PREFIX.yaml and PREFIX.pgm are written.")],
    log_format: LogFormat = "auto",
    scans: Scans = "all",
    resolution: Annotated[
        float, typer.Option("--resolution", metavar="M", min=0.01, max=1.0, help="Size of a cell (m).")
    ] = 0.05,
    range_max: RangeMax = 30.0,
    json: JsonOption = False,
) -> None:
    """Build a map from a log's scans at their reference poses.

    Each beam clears the cells that it passes and marks the one where it ends.
    """
    from fog_runtime.configuration.maps import save_map  # noqa: PLC0415  # keeps the other commands fast
    from fognav.localization.log_map import build_map  # noqa: PLC0415  # same

    with exit_codes():
        map_ = build_map(read_log(log_file, log_format).select(scans), resolution, range_max)
        try:
            save_map(out, map_)
        except OSError as error:
            raise WrongUseError(f"{out}.yaml can't be written: {error.strerror}. Name another --out") from error
        found = describe(map_)
    if json:
        print_json({"file": f"{out}.yaml", **found})
    else:
        print_line(f"wrote {out}.yaml: {found['width']} x {found['height']} cells, {found['occupied']} occupied")


def describe(map_: StaticMap) -> dict[str, object]:
    """Return size, resolution and origin of a map, and how many of its cells are free, occupied and unknown."""
    import numpy as np  # noqa: PLC0415  # keeps the other commands fast

    from fog_contracts.costs import FREE, LETHAL, UNKNOWN  # noqa: PLC0415  # same

    geometry = map_.geometry
    names = {"free": FREE, "occupied": LETHAL, "unknown": UNKNOWN}
    return {
        "width": geometry.width,
        "height": geometry.height,
        "resolution": geometry.resolution,
        "origin": [geometry.origin_x, geometry.origin_y, 0.0],
        **{name: int(np.count_nonzero(map_.cells == value)) for name, value in names.items()},
    }
