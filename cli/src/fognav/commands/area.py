"""`fognav area`, `alert` and `map`: the watched areas, what there needs attention, and how the map has them."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import typer

from fog_contracts.costs import INSCRIBED
from fognav.commands.map_files import map_app
from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, duration
from fognav.output import WrongUseError, exit_codes, local_time, print_list, print_result
from fognav.programs import AGGREGATOR, MAP_SERVICE

area_app = typer.Typer(help="List the watched areas and their history, and override one.", no_args_is_help=True)


@area_app.command("list", epilog="Example: fognav area list --json")
def area_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the watched areas with their state, and who overrides it."""
    with exit_codes():
        print_list("areas", find_fog(fog).get(AGGREGATOR, "/api/v1/areas"), _line, json=json)


@area_app.command("override", epilog="Example: fognav area override z1 --state blocked --for 2h --reason 'wet floor'")
def area_override(  # noqa: PLR0913  # each option is an argument
    area: Annotated[str, typer.Argument(metavar="AREA", help="The area's id, as fognav area list shows it.")],
    *,
    state: Annotated[
        Literal["blocked", "clear"] | None,
        typer.Option("--state", help="blocked: robots avoid it; clear: they may pass it slowly (admins only)."),
    ] = None,
    length: Annotated[
        str | None, typer.Option("--for", metavar="TIME", help="How long, such as 90s, 15m, 2h or 3d.")
    ] = None,
    reason: Annotated[str | None, typer.Option("--reason", help="Why, for other people.")] = None,
    remove: Annotated[bool, typer.Option("--remove", help="End it: the area's nodes count again.")] = False,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Block an area, or declare it clear, whatever its nodes report.

    It ends by itself after its time: after 30 days at most, and 15 minutes for an area that was declared clear.
    """
    with exit_codes():
        path = f"/api/v1/areas/{area}/override"
        if remove:
            if (state, length, reason) != (None, None, None):
                raise WrongUseError("--remove goes without --state, --for and --reason")
            find_fog(fog).send("DELETE", AGGREGATOR, path)
            override, line = None, f"area {area} is no longer overridden"
        else:
            if state is None or length is None or reason is None:
                raise WrongUseError("an override needs --state, --for and --reason; --remove ends one")
            body = {"state": state, "ttl_s": duration(length, "--for"), "reason": reason}
            override = find_fog(fog).send("PUT", AGGREGATOR, path, body)
            line = f"area {area} is overridden: {_override(override)}"
        print_result({"area": area, "override": override}, line, json=json)


@area_app.command("history", epilog="Example: fognav area history z1 --limit 20")
def area_history(
    area: Annotated[str, typer.Argument(metavar="AREA", help="The area's id, as fognav area list shows it.")],
    *,
    limit: Annotated[int, typer.Option("--limit", min=1, max=1000, help="How many periods.")] = 20,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """List the latest states of an area, newest first, and how long each lasted, restarts included."""
    with exit_codes():
        periods = find_fog(fog).get(AGGREGATOR, f"/api/v1/areas/{area}/history?limit={limit}")
        lines = map(_period, periods) if periods else [f"area {area} has no history yet"]
        print_result({"area": area, "periods": periods}, *lines, json=json)


def _line(area: Mapping[str, Any]) -> str:
    definition, hazard, override = area["definition"], area["hazard"], area["override"]
    label = f" ({definition['label']})" if definition["label"] else ""
    state = f"{hazard['state']}, {hazard['cause']}" if hazard else "nothing announced yet"
    if hazard and hazard["state"] == "blocked" and hazard.get("free"):
        state += "; a part of it is free, which robots pass slowly"
    if hazard and hazard["state"] == "clear" and (share := area.get("seen_share")) is not None:
        state += f"; its nodes see {share:.0%} of its floor"
    return f"{definition['id']}{label}: {state}" + (f" [{_override(override)}]" if override else "")


def _period(view: Mapping[str, Any]) -> str:
    period = view["period"]
    lasted = ("for " if view["ended"] is not None else "until now, for ") + _length(view["lasted_s"])
    return f"{local_time(period['began'])}: {period['state']} {lasted}, {period['cause']}"


def _override(override: Mapping[str, Any]) -> str:
    return f"{override['state']} by {override['author']} for another {_length(override['rest_s'])}"


def _length(seconds: float) -> str:
    """Return a length of time in words of two units at most."""
    whole = round(seconds)
    units = (("d", 86_400), ("h", 3600), ("min", 60), ("s", 1))
    parts = []
    for unit, size in units:
        count, whole = divmod(whole, size)
        if count:
            parts.append(f"{count} {unit}")
    return " ".join(parts[:2]) or "0 s"


alert_app = typer.Typer(help="List and acknowledge alerts of areas and nodes.", no_args_is_help=True)


@alert_app.command("list", epilog="Example: fognav alert list --json")
def alert_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List areas that are unknown or blocked for long, and nodes that are unknown for long."""
    with exit_codes():
        print_list("alerts", find_fog(fog).get(AGGREGATOR, "/api/v1/alerts"), _alert, json=json)


@alert_app.command("acknowledge", epilog="Example: fognav alert acknowledge area-unknown.z1")
def alert_acknowledge(
    alert: Annotated[str, typer.Argument(metavar="ALERT", help="The alert's id, as fognav alert list shows it.")],
    *,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Tell others that you look after an alert. It stays until its cause ends."""
    with exit_codes():
        seen = find_fog(fog).send("PUT", AGGREGATOR, f"/api/v1/alerts/{alert}/acknowledgement")
        print_result({"alert": seen}, f"{alert} is acknowledged by {seen['acknowledged_by']}", json=json)


def _alert(alert: Mapping[str, Any]) -> str:
    seen = f" [{alert['acknowledged_by']} looks after it]" if alert["acknowledged_by"] else ""
    return f"{alert['id']}: since {local_time(alert['since'])}, {alert['reason']}{seen}"


@map_app.command("hazards", epilog="Example: fognav map hazards --json")
def map_hazards(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the watched areas as the map has them: robots plan around those that are impassable.

    The map's own picture is /api/v1/costmap.png of the map-service.
    """
    with exit_codes():
        hazards = find_fog(fog).get(MAP_SERVICE, "/api/v1/hazards")
        lines = map(_on_map, sorted(hazards, key=lambda view: str(view["hazard"]["area"])))
        print_result({"hazards": hazards}, *(lines if hazards else ["no watched areas"]), json=json)


def _on_map(view: Mapping[str, Any]) -> str:
    """Return a hazard of the map-service as a line."""
    hazard = view["hazard"]
    cost = hazard["penalty"]
    costly = f"cost {cost}" if 0 < cost < INSCRIBED else "impassable" if cost else "passable"
    cause = f" ({hazard['cause']})" if hazard["cause"] else ""
    doubt = "" if view["confirmed"] else ", not confirmed: the hazard-aggregator is silent"
    return f"{hazard['area']}: {hazard['state']}, {costly}{cause}{doubt}"
