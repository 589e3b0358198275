"""`fognav zone`: draw, list, show and remove the zones of a running system."""

import datetime as dt
import secrets
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

import typer

from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, numbers, points
from fognav.operate.systems import MAP_SERVICE
from fognav.output import WrongUseError, exit_codes, print_answer, print_json

zone_app = typer.Typer(help="Draw, list, show and remove zones.", no_args_is_help=True)

_ZONES: Final = "/api/v1/zones"
Kind = Literal["blocked", "penalty", "speed-limit"]
ZoneId = Annotated[str, typer.Argument(metavar="ID", help="The zone's id, as fognav zone list shows it.")]


@zone_app.command("add", epilog='Example: fognav zone add --circle 12.5,3,0.5 --reason "wet floor" --ttl 600')
def zone_add(  # noqa: PLR0913  # each option is an argument
    *,
    circle: Annotated[str | None, typer.Option("--circle", metavar="X,Y,R", help="A circle.")] = None,
    rectangle: Annotated[
        str | None, typer.Option("--rectangle", metavar="X,Y,X2,Y2", help="A rectangle by two opposite corners.")
    ] = None,
    polygon: Annotated[
        str | None, typer.Option("--polygon", metavar="'X,Y X,Y …'", help="A polygon by its corners.")
    ] = None,
    corridor: Annotated[
        str | None, typer.Option("--corridor", metavar="'X,Y X,Y …'", help="A line with --width around it.")
    ] = None,
    width: Annotated[float | None, typer.Option("--width", metavar="M", help="Width of the corridor.")] = None,
    kind: Annotated[Kind, typer.Option("--kind", help="The effect: no-go, more costly, or slower.")] = "blocked",
    factor: Annotated[float | None, typer.Option("--factor", help="For penalty: a metre counts this many.")] = None,
    speed: Annotated[float | None, typer.Option("--speed", metavar="M/S", help="For speed-limit.")] = None,
    reason: Annotated[str, typer.Option("--reason", help="Why, for other people.")] = "",
    ttl: Annotated[float | None, typer.Option("--ttl", metavar="S", help="Remove its effect after this time.")] = None,
    identifier: Annotated[str | None, typer.Option("--id", metavar="ID", help="Its id; default: a new one.")] = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Draw a zone, which takes effect at once.

    Robots avoid a blocked zone, prefer other ways to one with a penalty, and drive slowly in one with a speed limit.
    """
    with exit_codes():
        shape = _shape(circle, rectangle, polygon, corridor, width)
        # With an id from here, an attempt whose answer was lost can be repeated without making a second zone.
        body: dict[str, object] = {
            "id": identifier or f"z-{secrets.token_hex(4)}",
            "kind": kind.upper().replace("-", "_"),
            "shape": shape,
            "reason": reason,
        }
        optional = {"factor": factor, "speed": speed, "ttl_s": ttl}
        body |= {name: value for name, value in optional.items() if value is not None}
        zone = find_fog(fog).send("POST", MAP_SERVICE, _ZONES, body)
        _report(zone, json=json)


@zone_app.command("list", epilog="Example: fognav zone list --json")
def zone_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List all zones."""
    with exit_codes():
        found = find_fog(fog).get(MAP_SERVICE, _ZONES)
        if json:
            print_json(found)
            return
        for zone in found["zones"]:
            print_answer(_line(zone) + ("" if zone["id"] in found["active"] else " (has no effect now)"))
        if not found["zones"]:
            print_answer("no zones")


@zone_app.command("show", epilog="Example: fognav zone show z-1a2b3c4d")
def zone_show(zone: ZoneId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show one zone."""
    with exit_codes():
        _report(find_fog(fog).get(MAP_SERVICE, f"{_ZONES}/{zone}"), json=json)


@zone_app.command("remove", epilog="Example: fognav zone remove z-1a2b3c4d")
def zone_remove(zone: ZoneId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Remove a zone."""
    with exit_codes():
        find_fog(fog).send("DELETE", MAP_SERVICE, f"{_ZONES}/{zone}")
        if json:
            print_json({"id": zone, "removed": True})
        else:
            print_answer(f"removed zone {zone}")


def _shape(
    circle: str | None, rectangle: str | None, polygon: str | None, corridor: str | None, width: float | None
) -> dict[str, object]:
    given = [option for option in (circle, rectangle, polygon, corridor) if option is not None]
    if len(given) != 1:
        raise WrongUseError("give the zone one shape: --circle, --rectangle, --polygon or --corridor")
    if (corridor is None) != (width is None):
        raise WrongUseError("--corridor needs --width, and only a corridor has one")
    if circle is not None:
        x, y, radius = numbers(circle, (3,), "X,Y,R")
        return {"type": "circle", "centre": [x, y], "radius": radius}
    if rectangle is not None:
        x, y, x2, y2 = numbers(rectangle, (4,), "X,Y,X2,Y2")
        return {"type": "rectangle", "corner": [x, y], "opposite": [x2, y2]}
    if polygon is not None:
        return {"type": "polygon", "points": points(polygon, 3, "a polygon")}
    return {"type": "corridor", "line": points(str(corridor), 2, "a corridor"), "width": width}


def _report(zone: Mapping[str, Any], *, json: bool) -> None:
    if json:
        print_json(zone)
    else:
        print_answer(_line(zone))


def _line(zone: Mapping[str, Any]) -> str:
    parts = [f"{zone['id']}: {zone['kind']} {zone['shape']['type']}"]
    if zone["factor"] is not None:
        parts.append(f"factor {zone['factor']:g}")
    if zone["speed"] is not None:
        parts.append(f"{zone['speed']:g} m/s")
    if zone["reason"]:
        parts.append(zone["reason"])
    parts.append(f"by {zone['author']}")
    if zone["expires_at"] is not None:
        parts.append(f"until {_time(zone['expires_at'])}")
    return ", ".join(parts)


def _time(stamp: float) -> str:
    return dt.datetime.fromtimestamp(stamp).astimezone().isoformat(" ", "seconds")
