"""`fognav map`: maps of buildings, and what is on the fog's map now."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from fog_contracts.costs import FREE, INSCRIBED, LETHAL, UNKNOWN
from fog_contracts.grid import StaticMap
from fog_runtime.configuration.maps import save_map
from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, LogFormat, RangeMax, Scans
from fognav.operate.systems import MAP_SERVICE
from fognav.output import exit_codes, print_result, writing

map_app = typer.Typer(help="Make maps of buildings; show the hazards on the fog's map.", no_args_is_help=True)


@map_app.command("hazards", epilog="Example: fognav map hazards --json")
def map_hazards(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the watched areas as the map has them: robots plan around those that are impassable.

    The map's own picture is /api/v1/costmap.png of the map-service.
    """
    with exit_codes():
        hazards = find_fog(fog).get(MAP_SERVICE, "/api/v1/hazards")
        lines = map(_line, sorted(hazards, key=lambda view: str(view["hazard"]["area"])))
        print_result({"hazards": hazards}, *(lines if hazards else ["no watched areas"]), json=json)


def _line(view: Mapping[str, Any]) -> str:
    """Return a hazard of the map-service as a line."""
    hazard = view["hazard"]
    cost = hazard["penalty"]
    costly = f"cost {cost}" if 0 < cost < INSCRIBED else "impassable" if cost else "passable"
    cause = f" ({hazard['cause']})" if hazard["cause"] else ""
    doubt = "" if view["confirmed"] else ", not confirmed: the hazard-aggregator is silent"
    return f"{hazard['area']}: {hazard['state']}, {costly}{cause}{doubt}"


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
    from fognav.lidar_logs import build_map, read_log  # noqa: PLC0415  # kernels are slow

    with exit_codes():
        map_ = build_map(read_log(log_file, log_format).select(scans), resolution, range_max)
        with writing(Path(f"{out}.yaml"), "Name another --out"):
            save_map(out, map_)
        found = describe(map_)
    line = f"wrote {out}.yaml: {found['width']} x {found['height']} cells, {found['occupied']} occupied"
    print_result({"file": f"{out}.yaml", **found}, line, json=json)


def describe(map_: StaticMap) -> dict[str, object]:
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
