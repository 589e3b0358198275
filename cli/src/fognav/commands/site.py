"""`fognav site`: creates and checks sites, and lets a fog node in containers serve several."""

from pathlib import Path
from typing import Annotated, Final

import typer

from fognav import checkout, kernels, site_files
from fognav.commands import installed
from fognav.hosting.compose_floors import OVERRIDE, write_override
from fognav.operate.options import JsonOption
from fognav.output import NOT_TRUE, exit_codes, fail, print_json, print_line, print_result

site_app = typer.Typer(cls=installed.Commands, help="Create and check sites.", no_args_is_help=True)

LITTLE_SEEN: Final = 0.5
"""`site check` names the areas of whose floor their nodes see a smaller share."""
OutOption = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to create, without a site in it.")]
SeedOption = Annotated[int, typer.Option("--seed", metavar="N", min=0, help="Each seed proposes other places.")]


@site_app.command(
    "new", epilog="Example: fognav site new --map floor.yaml --out sites/floor && fognav demo --site sites/floor"
)
def site_new(
    *,
    map_file: Annotated[Path, typer.Option("--map", metavar="MAP.yaml", help="map_server YAML; it is copied to DIR.")],
    out: OutOption,
    seed: SeedOption = 1,
    json: JsonOption = False,
) -> None:
    """Propose a site on any map_server map, ready for a demo.

    This writes a commented DIR/site.toml with places, a robot and watched areas, as a starting point.
    """
    _propose(map_file, out, seed, whole_floor=False, json=json)


@site_app.command(
    "from-map", epilog="Example: fognav site from-map floor.yaml --out sites/floor && fognav site coverage sites/floor"
)
def site_from_map(
    map_file: Annotated[Path, typer.Argument(metavar="MAP.yaml", help="As fognav map from-log writes it.")],
    *,
    out: OutOption,
    seed: SeedOption = 1,
    json: JsonOption = False,
) -> None:
    """Make a site of a building's map, for a fog and for a demo.

    It proposes places all over the floor that a robot can reach, and areas with their nodes where something in the way
    leaves another way. Each node is sure, on this map, that its area is clear. The map is copied to DIR.
    """
    _propose(map_file, out, seed, whole_floor=True, json=json)


def _propose(map_file: Path, out: Path, seed: int, *, whole_floor: bool, json: bool) -> None:
    with exit_codes():
        kernels.warm_cache(print_line)
        made = site_files.new_site(map_file, out, seed, whole_floor=whole_floor)
    if json:
        print_json(made)
        return
    places = ", ".join(f"{name} ({x:.2f}, {y:.2f})" for name, (x, y) in made["places"].items())
    print_line(f"wrote {made['file']}: {made['areas']} watched areas. Try it: fognav demo --site {out}")
    print_line(f"places: {places}")
    if made["why_no_areas"]:
        print_line(f"no watched areas, so that a demo shows no hazard: {made['why_no_areas']}")


@site_app.command("check", epilog="Example: fognav site check sites/estig")
def site_check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with site.toml, or a name in sites/.")],
    *,
    json: JsonOption = False,
) -> None:
    """Check a site: map, ids, and that everything is on free floor."""
    with exit_codes():
        found = site_files.check_site(checkout.site_folder(folder))
    if json:
        print_json(found)
    elif found["ok"]:
        counts = ", ".join(f"{found[each]} {each}" for each in ("areas", "nodes", "places", "markers"))
        print_line(f"{folder}: ok ({counts})")
        if found["unbounded_nodes"]:
            print_line(
                f"nodes with a sonar without range_max: {found['unbounded_nodes']}. To it an echo from behind the wall "
                "is clear: fognav node calibrate NODE --site DIR, unless it hears no wall"
            )
        little = {area: share for area, share in found["seen_shares"].items() if share < LITTLE_SEEN}
        if little:
            shares = ", ".join(f"{area} {share:.0%}" for area, share in little.items())
            print_line(
                f"areas of which their nodes see little: {shares}. What stands on the rest leaves them clear. Give "
                "them `cone_of`, a shorter polygon, or more nodes: fognav site coverage DIR --png FILE draws the beams"
            )
        if found["areas_never_half_free"]:
            print_line(
                f"areas whose free_width has no effect: {found['areas_never_half_free']}. Only two sonars with a "
                "range_max, or one that measures by light, show a part of an area free"
            )
    else:
        fail(str(found["problem"]))
    if not found["ok"]:
        raise typer.Exit(NOT_TRUE)


@site_app.command(
    "compose", epilog="Example: fognav site compose sites/upstairs && docker compose up -d --remove-orphans"
)
def site_compose(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="[DIR]...", help="Every floor but the first; none: no further ones.")
    ] = None,
    *,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Default: docker-compose.override.yml here.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Let the fog node in containers serve further floors.

    It writes the file that compose reads besides docker-compose.yml, at its next `docker compose up`. Name all floors
    each time, in the same order, which gives them their ports; and again after an upgrade.
    """
    with exit_codes():
        root = checkout.root()
        sites = [checkout.site_folder(folder) for folder in folders or []]
        made = write_override(sites, root, out or root / OVERRIDE)
    line = f"{made['file']} has {len(sites)} further floors: docker compose up -d --remove-orphans"
    print_result(made, line, json=json, write=print_line)
