"""`fognav area`: the watched areas of a running system."""

import http.client
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import typer

from fognav.operate.fog import Fog, RefusedError, find_fog
from fognav.operate.options import FogOption, JsonOption
from fognav.operate.systems import AGGREGATOR, MAP_SERVICE
from fognav.output import exit_codes, print_json, print_line

area_app = typer.Typer(help="List the watched areas, and block one.", no_args_is_help=True)


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


@area_app.command("override", epilog="Example: fognav area override z1 blocked --ttl 3600 --reason inspection")
def area_override(
    area: Annotated[str, typer.Argument(metavar="AREA", help="The area's id, as fognav area list shows it.")],
    _state: Annotated[Literal["blocked"], typer.Argument(metavar="blocked", help="Robots shall avoid it.")],
    *,
    ttl: Annotated[float, typer.Option("--ttl", metavar="S", min=1.0, help="How long.")],
    reason: Annotated[str, typer.Option("--reason", help="Why, for other people.")],
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Block an area, whatever its nodes report.

    This draws a zone over it, named after the area: fognav zone remove area-AREA ends it early. An area can't be
    declared clear: nobody may hide from robots what a node sees.
    """
    with exit_codes():
        found = find_fog(fog)
        polygon = found.get(AGGREGATOR, f"/api/v1/areas/{area}")["definition"]["polygon"]
        body = {"kind": "BLOCKED", "shape": {"type": "polygon", "points": polygon}, "reason": reason, "ttl_s": ttl}
        zone = _put(found, f"/api/v1/zones/area-{area}", body)
        if json:
            print_json(zone)
        else:
            print_line(f"area {area} is blocked for {ttl:g} s by zone {zone['id']}")


def _put(fog: Fog, path: str, zone: Mapping[str, Any]) -> Any:  # noqa: ANN401  # JSON
    """Add a zone, or replace the one that is there."""
    try:
        return fog.send("PUT", MAP_SERVICE, path, zone, {"If-None-Match": "*"})
    except RefusedError as error:
        if error.status != http.client.PRECONDITION_FAILED:
            raise
    return fog.send("PUT", MAP_SERVICE, path, zone)


def _line(area: Mapping[str, Any]) -> str:
    definition, hazard = area["definition"], area["hazard"]
    label = f" ({definition['label']})" if definition["label"] else ""
    state = f"{hazard['state']}, {hazard['cause']}" if hazard else "nothing announced yet"
    return f"{definition['id']}{label}: {state}"
