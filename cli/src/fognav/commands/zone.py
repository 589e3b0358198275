"""`fognav zone`: draw, list, show, switch and remove the zones of a running system."""

import secrets
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final, Literal

import typer

from fognav.operate.fog import Fog, RefusedError, find_fog
from fognav.operate.options import FogOption, JsonOption, checked_id, duration, moment, numbers, points, weekly
from fognav.output import WrongUseError, exit_codes, local_time, print_result
from fognav.programs import MAP_SERVICE

zone_app = typer.Typer(help="Draw, list, show, switch and remove zones.", no_args_is_help=True)

_ZONES: Final = "/api/v1/zones"
_SETS: Final = "/api/v1/zone-sets"
Kind = Literal["blocked", "penalty", "speed-limit", "release"]
ZoneId = Annotated[str, typer.Argument(metavar="ID", help="The zone's id, as fognav zone list shows it.")]


@zone_app.command("add", epilog='Example: fognav zone add --circle 12.5,3,0.5 --reason "wet floor" --for 10m')
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
    kind: Annotated[Kind, typer.Option("--kind", help="No-go, costlier, slower, or one robot at a time.")] = "blocked",
    factor: Annotated[float | None, typer.Option("--factor", help="For penalty: a metre counts this many.")] = None,
    speed: Annotated[float | None, typer.Option("--speed", metavar="M/S", help="For speed-limit.")] = None,
    reason: Annotated[str, typer.Option("--reason", help="Why, for other people.")] = "",
    length: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="How long from its start, such as 90s, 15m, 2h or 3d.")
    ] = None,
    start: Annotated[
        str | None, typer.Option("--from", metavar="WHEN", help="When it starts: 2026-11-24T18:30, or +2h from now.")
    ] = None,
    end: Annotated[str | None, typer.Option("--until", metavar="WHEN", help="When it ends, instead of --for.")] = None,
    each: Annotated[
        list[str] | None,
        typer.Option("--each", metavar="'DAYS TIMES'", help="Only then, each week: 'mon-fri 18:00-20:00'; repeatable."),
    ] = None,
    time_zone: Annotated[
        str | None, typer.Option("--time-zone", metavar="NAME", help="Of --each, such as Europe/Lisbon.")
    ] = None,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="ID", help="A set that it is switched with; repeatable.")
    ] = None,
    disabled: Annotated[
        bool, typer.Option("--disabled", help="Without an effect until fognav zone enable ID.")
    ] = False,
    identifier: Annotated[str | None, typer.Option("--id", metavar="ID", help="Its id; default: a new one.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the zone of this --id.")] = False,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Draw a zone, which takes effect at once or at its times.

    Robots avoid a blocked zone, prefer other ways to one with a penalty, and drive slowly in one with a speed limit.
    One at a time gets into a zone that asks for a release.
    """
    with exit_codes():
        shape = _shape(circle, rectangle, polygon, corridor, width)
        if replace and identifier is None:
            raise WrongUseError("--replace needs the --id of the zone that is replaced")
        times = _times(length, start, end, each or [], time_zone)
        # With an id from here, an attempt whose answer was lost can be repeated without making a second zone.
        body: dict[str, object] = {
            "id": identifier or f"z-{secrets.token_hex(4)}",
            "kind": kind.upper().replace("-", "_"),
            "shape": shape,
            "reason": reason,
        }
        optional = {
            "factor": factor,
            "speed": speed,
            "enabled": False if disabled else None,
            "sets": sets or None,
            **times,
        }
        body |= {name: value for name, value in optional.items() if value is not None}
        method, path = ("PUT", f"{_ZONES}/{identifier}") if replace else ("POST", _ZONES)
        service = find_fog(fog)
        made = service.send(method, MAP_SERVICE, path, body)
        print_result(made, _line(made), *_without_a_clock(service, [made]), json=json)


@zone_app.command("list", epilog="Example: fognav zone list --json")
def zone_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List all zones."""
    with exit_codes():
        service = find_fog(fog)
        found = service.get(MAP_SERVICE, _ZONES)
        lines = [
            _line(zone) + ("" if zone["id"] in found["active"] else " (has no effect now)") for zone in found["zones"]
        ]
        active = [zone for zone in found["zones"] if zone["id"] in found["active"]]
        print_result(found, *(lines or ["no zones"]), *_without_a_clock(service, active), json=json)


@zone_app.command("show", epilog="Example: fognav zone show z-1a2b3c4d")
def zone_show(zone: ZoneId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Show one zone."""
    with exit_codes():
        found = find_fog(fog).get(MAP_SERVICE, f"{_ZONES}/{zone}")
        print_result(found, _line(found), json=json)


@zone_app.command("enable", epilog="Example: fognav zone enable z-1a2b3c4d")
def zone_enable(zone: ZoneId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Let a zone have its effect again; a time of --for begins anew."""
    _switch(zone, fog, enabled=True, json=json)


@zone_app.command("disable", epilog="Example: fognav zone disable z-1a2b3c4d")
def zone_disable(zone: ZoneId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Take a zone's effect away, and keep the zone."""
    _switch(zone, fog, enabled=False, json=json)


@zone_app.command("remove", epilog="Example: fognav zone remove z-1a2b3c4d")
def zone_remove(zone: ZoneId, *, fog: FogOption = None, json: JsonOption = False) -> None:
    """Remove a zone."""
    with exit_codes():
        find_fog(fog).send("DELETE", MAP_SERVICE, f"{_ZONES}/{zone}")
        print_result({"id": zone, "removed": True}, f"removed zone {zone}", json=json)


@zone_app.command("set", epilog="Example: fognav zone set night off")
def zone_set(
    name: Annotated[str, typer.Argument(metavar="SET", help="Id of the set: a to z, 0 to 9 and -.")],
    state: Annotated[Literal["on", "off"], typer.Argument(help="Whether its zones may be in force.")],
    *,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Switch all zones of a set at once; a set that is new is added."""
    with exit_codes():
        found, path = find_fog(fog), f"{_SETS}/{checked_id(name)}"
        known = next((one for one in found.get(MAP_SERVICE, _SETS) if one["id"] == name), None)
        body = {key: known[key] for key in ("name", "schedule")} if known else {}
        condition = {"If-None-Match": "*"} if known is None else {"If-Match": f'"{known["version"]}"'}
        made = found.send("PUT", MAP_SERVICE, path, {**body, "enabled": state == "on"}, condition)
        effect = "on" if made["on"] else "off" if state == "off" else "off by its schedule"
        print_result(made, f"set {name} is {effect}; its zones: {', '.join(made['zones']) or 'none'}", json=json)


def _switch(zone: str, address: str | None, *, enabled: bool, json: bool) -> None:
    with exit_codes():
        fog = find_fog(address)
        known = fog.get(MAP_SERVICE, f"{_ZONES}/{zone}")
        body = {name: value for name, value in known.items() if name not in {"id", "author", "version"}}
        if body.get("ttl_s") is not None:
            del body["expires_at"]  # follows from it
        changed = {"If-Match": f'"{known["version"]}"'}  # not over what another operator has changed meanwhile
        made = fog.send("PUT", MAP_SERVICE, f"{_ZONES}/{zone}", {**body, "enabled": enabled}, changed)
        print_result(made, _line(made), json=json)


def _times(
    length: str | None, start: str | None, end: str | None, each: Sequence[str], time_zone: str | None
) -> dict[str, object]:
    """Return what a zone's body says of its times; raises `WrongUseError`."""
    if length is not None and end is not None:
        raise WrongUseError("give either --for or --until")
    if bool(each) != (time_zone is not None):
        raise WrongUseError("--each needs --time-zone, and nothing else has one")
    return {
        "ttl_s": None if length is None else duration(length, "--for"),
        "starts_at": None if start is None else moment(start, "--from"),
        "expires_at": None if end is None else moment(end, "--until"),
        "schedule": {"time_zone": time_zone, "times": [weekly(text, "--each") for text in each]} if each else None,
    }


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


def _without_a_clock(fog: Fog, zones: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return why zones are in force outside their times: the map-service knows no time of day. Empty if it does."""
    # The end of a time to live (`ttl_s`) is told by the clock that nobody sets.
    if not any(
        zone["starts_at"] or zone.get("schedule") or (zone["expires_at"] and not zone.get("ttl_s")) for zone in zones
    ):
        return []
    try:
        ready = fog.get(MAP_SERVICE, "/readyz")
    except RefusedError as error:  # it lacks something else, and says so of the clock all the same
        ready = error.problem
    clock = ready.get("parts", {}).get("clock", {}).get("detail")
    return [clock] if clock else []


def _line(zone: Mapping[str, Any]) -> str:
    parts = [f"{zone['id']}: {zone['kind']} {zone['shape']['type']}"]
    if zone["factor"] is not None:
        parts.append(f"factor {zone['factor']:g}")
    if zone["speed"] is not None:
        parts.append(f"{zone['speed']:g} m/s")
    if zone["reason"]:
        parts.append(zone["reason"])
    parts.append(f"by {zone['author']}")
    if not zone["enabled"]:
        parts.append("disabled")
    if zone.get("sets"):
        parts.append(f"in {', '.join(zone['sets'])}")
    if zone["starts_at"] is not None:
        parts.append(f"from {local_time(zone['starts_at'])}")
    if (schedule := zone.get("schedule")) is not None:
        windows = "; ".join(f"{','.join(each['days'])} {each['begin']}-{each['end']}" for each in schedule["times"])
        parts.append(f"each {windows} ({schedule['time_zone']})")
    if zone["expires_at"] is not None:
        parts.append(f"until {local_time(zone['expires_at'])}")
    return ", ".join(parts)
