"""`fognav source`: sensors that speak MQTT, as evidence for an area of a running system."""

from typing import Annotated, Any

import msgspec
import typer

from fog_contracts.messages import AreaDefinition, Limits, Source
from fognav.credentials import CredentialsOption, FloorOption, changeable_security, security_errors, user_on
from fognav.operate.fog import Fog, find_fog
from fognav.operate.options import FogOption, JsonOption, checked_id
from fognav.output import FailedError, WrongUseError, exit_codes, print_list, print_result
from fognav.programs import AGGREGATOR
from hazard_aggregator.source_values import PROFILES

source_app = typer.Typer(help="Use sensors that speak MQTT as evidence for an area.", no_args_is_help=True)

_SET: tuple[str, ...] = (
    "label",
    "polygon",
    "nodes",
    "sources",
    "number",
    "debounce",
    "fusion",
    "unknown",
    "alerts",
    "penalty",
)
"""The fields of an area that an operator sets."""

AreaOption = Annotated[str, typer.Option("--area", metavar="AREA", help="The area that the sensor watches.")]


@source_app.command(
    "add",
    epilog="Example: fognav source add fire-door --area z1 --profile zigbee2mqtt-contact --device fire_door",
)
def source_add(  # noqa: PLR0913  # each option is an argument
    name: Annotated[str, typer.Argument(metavar="NAME", help="The source's id: a to z, 0 to 9 and -, at most 32.")],
    *,
    area: AreaOption,
    profile: Annotated[str | None, typer.Option("--profile", help="fognav source profiles lists them.")] = None,
    device: Annotated[str, typer.Option("--device", help="The name that fills the profile's topics.")] = "",
    above: Annotated[float | None, typer.Option("--above", help="Blocked above this number.")] = None,
    below: Annotated[float | None, typer.Option("--below", help="Blocked below this number.")] = None,
    hysteresis: Annotated[
        float | None, typer.Option("--hysteresis", min=0, help="Clear when it is back by so much.")
    ] = None,
    penalty: Annotated[
        int | None, typer.Option("--penalty", min=1, max=253, help="Costly (1 to 253) instead of impassable.")
    ] = None,
    definition: Annotated[
        str | None, typer.Option("--source", metavar="JSON", help="Any further fields: topic, pointer, blocked, ...")
    ] = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Add a sensor to an area, or replace the one of this name there."""
    with exit_codes():
        given: dict[str, Any] = _decoded(definition)
        options = {"id": name, "profile": profile, "device": device or None, "penalty": penalty}
        given |= {key: value for key, value in options.items() if value is not None}
        if above is not None or below is not None:
            given["number"] = Limits(above=above, below=below, hysteresis=hysteresis or 0.0)
        elif hysteresis is not None:
            raise WrongUseError("--hysteresis needs the limit that it is of: --above or --below")
        try:
            source = msgspec.convert(msgspec.to_builtins(given), Source)
        except msgspec.ValidationError as error:
            raise WrongUseError(f"source {name}: {error}") from error
        found = find_fog(fog)
        old = _area(found, area)
        changed = [*(other for other in old.sources if other.id != name), source]
        _put(found, old, changed)
        values = {"area": area, "source": msgspec.to_builtins(source)}
        print_result(values, f"source {name} watches area {area}", json=json)


@source_app.command("remove", epilog="Example: fognav source remove fire-door --area z1")
def source_remove(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The source's id.")],
    *,
    area: AreaOption,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Take a sensor out of an area."""
    with exit_codes():
        found = find_fog(fog)
        old = _area(found, area)
        kept = [source for source in old.sources if source.id != name]
        if len(kept) == len(old.sources):
            names = ", ".join(source.id for source in old.sources) or "none"
            raise FailedError(f"area {area} has no source {name} (it has: {names})")
        _put(found, old, kept)
        print_result({"area": area, "removed": name}, f"source {name} no longer watches area {area}", json=json)


@source_app.command("list", epilog="Example: fognav source list --json")
def source_list(*, fog: FogOption = None, json: JsonOption = False) -> None:
    """List the sources of all areas with what they report."""
    with exit_codes():
        found = find_fog(fog)
        health = {(node["id"], node["area"]): node for node in found.get(AGGREGATOR, "/api/v1/nodes")}
        rows = [
            {**source, "area": view["definition"]["id"], "health": health.get((source["id"], view["definition"]["id"]))}
            for view in found.get(AGGREGATOR, "/api/v1/areas")
            for source in view["definition"].get("sources", [])
        ]
        print_list("sources", rows, _line, json=json)


@source_app.command("user", epilog="Example: fognav source user zigbee2mqtt --topic 'zigbee2mqtt/#' --credentials DIR")
def source_user(
    name: Annotated[str, typer.Argument(metavar="USER", help="The user's name: a to z, 0 to 9 and -.")],
    *,
    topic: Annotated[
        list[str] | None, typer.Option("--topic", metavar="T", help="What it may publish and read; repeatable.")
    ] = None,
    floor: FloorOption = None,
    security: CredentialsOption = None,
    json: JsonOption = False,
) -> None:
    """Let a sensor, or the gateway of many, use a broker with passwords: these topics and no other.

    Without --topic: a source of zones, which may use its own topics.
    """
    with exit_codes(), security_errors():
        made = changeable_security(security)
        user = checked_id(name) if topic else user_on(made, floor, checked_id(name))
        file = made.add_device(user, topic) if topic else made.add_node(user)
        print_result(
            {"user": user, "topics": topic or [], "credentials": str(file)},
            f"wrote {file}: its user, password and certificate are what {name} needs; then delete it here",
            "the broker knows it once it has read its lists again (SIGHUP)",
            json=json,
        )


@source_app.command("profiles", epilog="Example: fognav source profiles")
def source_profiles(*, json: JsonOption = False) -> None:
    """List the ready-made profiles with their topics."""
    lines = [
        f"{name}: {source.topic}" + ("" if source.blocked else " (needs --above or --below)")
        for name, source in PROFILES.items()
    ]
    print_result({"profiles": msgspec.to_builtins(PROFILES)}, *lines, json=json)


def _line(row: dict[str, Any]) -> str:
    state = f"{row['health']['state']}, {row['health']['reason']}" if row["health"] else "not known yet"
    return f"{row['area']}/{row['id']}: {state}"


def _decoded(text: str | None) -> dict[str, Any]:
    try:
        return msgspec.json.decode(text, type=dict[str, Any]) if text else {}
    except msgspec.DecodeError as error:
        raise WrongUseError(f"--source is no JSON object: {error}") from error


def _area(fog: Fog, area: str) -> AreaDefinition:
    return msgspec.convert(fog.get(AGGREGATOR, f"/api/v1/areas/{area}")["definition"], AreaDefinition)


def _put(fog: Fog, old: AreaDefinition, sources: list[Source]) -> None:
    """Store the area with these sources, unless somebody else has changed it meanwhile."""
    whole = msgspec.to_builtins(msgspec.structs.replace(old, sources=sources))
    # The place of an area that is the cone of a node follows from the node.
    body = {name: whole[name] for name in _SET if name != "polygon" or old.cone_of is None}
    fog.send("PUT", AGGREGATOR, f"/api/v1/areas/{old.id}", body, {"If-Match": f'"{old.version}"'})
