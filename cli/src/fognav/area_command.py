"""`fognav area`: the watched areas of a running system."""

from collections.abc import Mapping
from typing import Any

import typer

from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption
from fognav.operate.systems import AGGREGATOR
from fognav.output import exit_codes, print_json, print_line

area_app = typer.Typer(help="List the watched areas.", no_args_is_help=True)


@area_app.command("list", epilog="Example: fognav area list --json")
def area_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the watched areas with their state."""
    with exit_codes():
        areas = find_fog(fog).get(AGGREGATOR, "/api/v1/areas")
        if json:
            print_json({"areas": areas})
            return
        for area in areas:
            print_line(_line(area))
        if not areas:
            print_line("no areas")


def _line(area: Mapping[str, Any]) -> str:
    definition, hazard = area["definition"], area["hazard"]
    label = f" ({definition['label']})" if definition["label"] else ""
    state = f"{hazard['state']}, {hazard['cause']}" if hazard else "nothing announced yet"
    return f"{definition['id']}{label}: {state}"
