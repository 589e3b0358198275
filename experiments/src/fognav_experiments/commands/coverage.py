"""`fognav site coverage`: what the nodes of a site see, in words, as JSON and as a picture."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # Typer reads it
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from fog_runtime.configuration.site import SiteError, load_site
from fognav import checkout, kernels
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads it
from fognav.output import FailedError, WrongUseError, check_writable, exit_codes, print_answer, print_json, print_line

if TYPE_CHECKING:
    from fog_contracts.site import Site
    from fog_runtime.configuration.site import LoadedSite
    from fognav_experiments.coverage import Coverage

_CONE: Final = "#96d7a0"
_AREA: Final = "#3c6ee6"
_SEEN: Final = "#008c3c"
_BLIND: Final = "#d23c28"
_NODE: Final = "#143c1e"


def add_to(app: typer.Typer) -> None:
    """Add the command to `fognav site`."""
    app.command("coverage", epilog="Example: fognav site coverage sites/estig --png coverage.png")(site_coverage)


def site_coverage(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with site.toml, or a name in sites/.")],
    *,
    png: Annotated[Path | None, typer.Option("--png", metavar="F", help="Draw it on the map.")] = None,
    json: JsonOption = False,
) -> None:
    """Show what the sensor nodes see of areas and routes.

    Routes are those between any two places. On a blind stretch no node notices a person. A lead is by how many seconds
    the fog may know of a hazard before the robot's own lidar could.
    """
    from fognav_experiments.coverage import coverage  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes():
        if png is not None:
            check_writable(png)
        try:
            loaded = load_site(checkout.site_folder(folder))
            kernels.warm_cache(print_line)
        except SiteError as error:
            raise WrongUseError(str(error)) from error
        except kernels.KernelsError as error:
            raise FailedError(str(error)) from error
        found = coverage(loaded.site, loaded.map)
        if png is not None:
            _draw(loaded, found, png)
        if json:
            print_json(_as_json(loaded.site, found))
            return
        for line in _lines(found):
            print_answer(line)


def _lines(found: Coverage) -> list[str]:
    lines = []
    for area in found.areas:
        nodes = ", ".join(area.nodes) or "no node"
        lines.append(f"area {area.area} ({nodes}): {100 * area.share:.0f} % of its floor is seen")
    for route in found.routes:
        share = 100 * route.blind_m / max(route.length_m, 1e-9)
        lines.append(
            f"route {route.start} to {route.goal}: {route.length_m:.1f} m, of these {route.blind_m:.1f} m blind "
            f"({share:.0f} %), the longest stretch {max((b - a for a, b in route.blind), default=0.0):.1f} m"
        )
        lines += [
            f"  a hazard in {lead.area}, {lead.entry_m:.1f} m ahead: known up to {lead.lead_s:.0f} s before the lidar "
            f"sees it, which is {lead.lidar_m:.1f} m before it"
            for lead in route.leads
        ]
    lines += [f"route {start} to {goal}: there is no way" for start, goal in found.unreachable]
    return lines


def _as_json(site: Site, found: Coverage) -> dict[str, Any]:
    return {
        "site": site.id,
        "areas": [{"id": area.area, "nodes": area.nodes, "seen_share": round(area.share, 3)} for area in found.areas],
        "routes": [
            {
                "from": route.start,
                "to": route.goal,
                "length_m": round(route.length_m, 2),
                "blind_m": round(route.blind_m, 2),
                "blind": [[round(begin, 2), round(end, 2)] for begin, end in route.blind],
                "leads": [
                    {
                        "area": lead.area,
                        "entry_m": round(lead.entry_m, 2),
                        "lidar_m": round(lead.lidar_m, 2),
                        "lead_s": round(lead.lead_s, 1),
                    }
                    for lead in route.leads
                ],
            }
            for route in found.routes
        ],
        "unreachable": [list(pair) for pair in found.unreachable],
    }


def _draw(loaded: LoadedSite, found: Coverage, file: Path) -> None:
    """Draw areas in blue, what nodes see in green, and routes: red where they are blind."""
    from fognav_experiments.figures import floor, write_png  # noqa: PLC0415  # keeps the other commands fast

    figure, axes = floor(loaded.map)
    for area in found.areas:
        for ring in area.cones:
            axes.fill(*zip(*ring, strict=True), color=_CONE)
    for area_site in loaded.site.areas:
        axes.fill(*zip(*area_site.polygon, strict=True), fill=False, edgecolor=_AREA)
    for route in found.routes:
        axes.plot(*route.points.T, color=_SEEN)
    # A stretch that one route shares with another is blind for both.
    for route in found.routes:
        for begin, end in route.blind:
            axes.plot(*route.points[(route.travelled >= begin) & (route.travelled <= end)].T, color=_BLIND)
    for places, size, colour in ((loaded.site.nodes, 16, _NODE), (loaded.site.places.values(), 40, _AREA)):
        axes.scatter([place.x for place in places], [place.y for place in places], size, color=colour, zorder=3)
    write_png(figure, file)
