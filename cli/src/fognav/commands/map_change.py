"""`fognav map change`: another map for a site, also while its fog runs, with a preview and a way back."""

from __future__ import annotations

import base64
import re
import tempfile
import time
from pathlib import Path  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
import typer

from fog_runtime.configuration.maps import read_provenance, save_map
from fog_runtime.configuration.site import SITE_FILE, load_site
from fognav import checkout, kernels, site_files
from fognav.commands.map_files import map_app
from fognav.hosting.folders import recall
from fognav.hosting.local_nodes import KIND
from fognav.map_files import described, loaded, provenance
from fognav.operate.fog import Fog, find_fog
from fognav.operate.options import FogOption, JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.operate.systems import registered
from fognav.output import NOT_TRUE, FailedError, WrongUseError, exit_codes, print_line, print_result, writing
from fognav.programs import MAP_SERVICE, PLANNER

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap
    from fog_mapping.alignment import Alignment
    from fog_mapping.another_map import Finding
    from fog_runtime.configuration.site import LoadedSite

_KEY: Final = "site"
"""In a map's provenance: what this command did."""
_IN_FORCE_S: Final = 240.0
"""For three services on a Raspberry Pi."""
_LOOKED_AT_S: Final = 40.0
"""The service itself gives up after 28 s."""
_LOCALIZED_S: Final = 20.0
_POLL_S: Final = 0.2


@map_app.command("change", epilog="Example: fognav map change floor-clean.yaml --site sites/office")
def map_change(  # noqa: PLR0913  # each option is an argument
    map_file: Annotated[
        Path | None, typer.Argument(metavar="NEW.yaml", help="The new map; it is copied to the site's folder.")
    ] = None,
    *,
    site: Annotated[Path, typer.Option("--site", metavar="DIR", help="Folder of the site, or a name in sites/.")],
    preview: Annotated[bool, typer.Option("--preview", help="Tell what would change, and change nothing.")] = False,
    accept: Annotated[bool, typer.Option("--accept", help="Change it although something lies in a wall.")] = False,
    back: Annotated[bool, typer.Option("--back", help="Go back to the map before this one.")] = False,
    as_it_is: Annotated[
        bool, typer.Option("--as-it-is", help="The new map has the present one's frame: match no walls.")
    ] = False,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Change the map of a site, also while its fog runs, or go back.

    Everything on the site is looked up on the new map first: what lies in a wall there, or off the map, is named, and
    then nothing is changed (exit code 1). The new map is laid onto the present one, so that all coordinates stay
    right. A fog that runs gets it by REST, as from the console; without one the site's folder does. Robots are
    stopped and lose their missions; each finds itself on the new map, and waits to be enabled.
    """
    from fog_mapping import another_map  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes():
        if (map_file is None) is not back:
            raise WrongUseError("name either the new map, or --back")
        kernels.warm_cache(print_line)
        present = load_site(checkout.site_folder(site))
        running = _running(present, fog)
        values: dict[str, Any] = {"site": present.site.id, "fog": None if running is None else running.system.name}
        static: StaticMap | None = None
        if running is not None:
            values |= _looked_up(running, present, map_file, as_it_is=as_it_is)
        else:
            name, static, alignment = _new_map(present, map_file, as_it_is=as_it_is)
            found = another_map.findings(present.site, present.map, static)
            values |= {
                "map": name,
                "previous": present.site.map,
                "alignment": None if alignment is None else alignment._asdict(),
                **described(static),
                **msgspec.to_builtins(another_map.changed_area(present.map, static)),
                "findings": msgspec.to_builtins(found),
                "refused": any(one.refused for one in found),
                "accepted": not found,
            }
        lines = _preview(values, [msgspec.convert(one, another_map.Finding) for one in values["findings"]])
        refused = values["refused"] or not (values["accepted"] or accept)
        values["changed"] = not preview and not refused
        if values["changed"]:
            if running is not None:
                values |= _change(running, values["preview"])
            else:
                _write(present, map_file, values["map"], static)
            lines += _changed(present, values, running)
        elif refused:
            lines.append(_refusal(values))
        print_result(values, *lines, json=json)
        if refused:
            raise typer.Exit(NOT_TRUE)


def _new_map(present: LoadedSite, map_file: Path | None, *, as_it_is: bool) -> tuple[str, StaticMap, Alignment | None]:
    """Return the new map's name in the site's folder, the map in the present one's frame, and how it was laid there.

    None: its frame is taken for the present one's.
    """
    folder = present.directory
    if map_file is None:
        before = read_provenance(folder / present.site.map).get(_KEY)
        name = before.get("previous") if isinstance(before, dict) else None
        if not isinstance(name, str):
            raise WrongUseError(
                f"{folder / present.site.map} does not say which map was before it: it was not written by this "
                "command. Name a map instead of --back"
            )
        return name, loaded(folder / name), None
    static, alignment = _laid(present, map_file, as_it_is=as_it_is)
    stem = re.sub(r"-\d+$", "", Path(present.site.map).stem)
    number = 2
    while any((folder / f"{stem}-{number}{suffix}").exists() for suffix in (".yaml", ".pgm")):
        number += 1
    return f"{stem}-{number}.yaml", static, alignment


def _laid(present: LoadedSite, map_file: Path, *, as_it_is: bool) -> tuple[StaticMap, Alignment | None]:
    """Return a map in the present one's frame, and how it was laid there."""
    from fog_mapping.alignment import MisfitError, in_frame_of  # noqa: PLC0415  # keeps the other commands fast

    static = loaded(map_file)
    try:
        return (static, None) if as_it_is else in_frame_of(static, present.map)
    except MisfitError as error:
        raise FailedError(
            f"{map_file} can't be laid onto {present.directory / present.site.map}: {error}. If it has the same frame, "
            "say so: --as-it-is"
        ) from error


def _write(present: LoadedSite, map_file: Path | None, name: str, static: StaticMap | None) -> None:
    """Write the map beside the present one, and its name into the site's file."""
    if map_file is not None and static is not None:
        made = {**read_provenance(map_file), _KEY: {**provenance(map_file), "previous": present.site.map}}
        with writing(present.directory / name, "Run this as the folder's owner"):
            save_map((present.directory / name).with_suffix(""), static, made)
    try:
        site_files.write(present, site_files.with_map(present, name))
    except (WrongUseError, FailedError):
        if map_file is not None:
            for suffix in (".yaml", ".pgm"):
                (present.directory / name).with_suffix(suffix).unlink(missing_ok=True)
        raise


# --- the fog of the site -------------------------------------------------------------------------------------------


def _running(present: LoadedSite, address: str | None) -> Fog | None:
    """Return the fog that serves the site: this user's fog node with this folder, or the one at the address."""
    if address is not None:
        found = find_fog(address)
        if found.site != present.site.id:
            raise WrongUseError(
                f"--fog {address} serves site {found.site}, and {present.directory} is {present.site.id}"
            )
        return found
    for system in registered():
        if system.kind != KIND or system.site != present.site.id or system.data is None:
            continue
        folder = recall(Path(system.data)).sites.get(present.site.id)
        if folder is not None and Path(folder).resolve() == present.directory.resolve():
            return Fog(system)
    return None


def _looked_up(fog: Fog, present: LoadedSite, map_file: Path | None, *, as_it_is: bool) -> dict[str, Any]:
    """Return what the fog says of a map, or of the one before its own; raises `FailedError`."""
    alignment: Alignment | None = None
    body: dict[str, object] = {"back": True}
    if map_file is not None:
        static, alignment = _laid(present, map_file, as_it_is=as_it_is)
        body = {"upload": _uploaded(static)}
    seen = fog.send("POST", MAP_SERVICE, "/api/v1/map/preview", body, timeout_s=_LOOKED_AT_S)
    area = seen.pop("area")
    return {
        **seen,
        **area,
        "preview": seen.pop("id"),
        "map": seen["name"] or present.site.map,
        "previous": fog.get(MAP_SERVICE, "/api/v1/map/state")["name"] or present.site.map,
        "alignment": None if alignment is None else alignment._asdict(),
    }


def _uploaded(static: StaticMap) -> dict[str, str]:
    with tempfile.TemporaryDirectory() as folder:
        prefix = Path(folder) / "map"
        save_map(prefix, static, image="png")
        image = base64.b64encode(prefix.with_suffix(".png").read_bytes()).decode("ascii")
        return {"yaml": prefix.with_suffix(".yaml").read_text("utf-8"), "image": image}


def _change(fog: Fog, preview: str) -> dict[str, Any]:
    """Put a map into force that was looked at, and wait until it is; return what was reached. Raises `FailedError`."""
    epoch = int(fog.get(MAP_SERVICE, "/api/v1/map")["epoch"])
    fog.send("PUT", MAP_SERVICE, "/api/v1/map", {"preview": preview, "accept": True}, timeout_s=_LOOKED_AT_S)
    deadline, trouble, reached = time.monotonic() + _IN_FORCE_S, "it still has the map before", epoch
    while reached <= epoch:
        if time.monotonic() > deadline:
            raise FailedError(
                f"the new map was not in force after {_IN_FORCE_S:.0f} s: {trouble}. fognav logs map-service says more"
            )
        time.sleep(_POLL_S)
        try:
            reached = int(fog.get(MAP_SERVICE, "/api/v1/map")["epoch"])
            fog.get(MAP_SERVICE, "/readyz")
            fog.get(PLANNER, "/readyz")
        except FailedError as error:
            trouble, reached = str(error), epoch
    return {"epoch_before": epoch, "epoch": reached, "localized": _localized(fog, reached)}


def _localized(fog: Fog, epoch: int) -> dict[str, list[float] | None]:
    """Return where each robot that answers has found itself on the map of an epoch; None: not yet."""
    deadline = time.monotonic() + _LOCALIZED_S
    while True:
        try:
            views = [view for view in fog.get(PLANNER, "/api/v1/robots") if view["state"] is not None]
        except FailedError:  # the map is in force, whether the planner answers or not
            views = []
        found = {
            view["id"]: [round(view["pose"]["x"], 2), round(view["pose"]["y"], 2)]
            if view["state"]["map_epoch"] >= epoch and view["pose"] is not None and view["pose"]["localized"]
            else None
            for view in views
        }
        if (found and all(found.values())) or time.monotonic() > deadline:
            return found
        time.sleep(_POLL_S)


# --- what is told ----------------------------------------------------------------------------------------------------


def _preview(values: dict[str, Any], found: list[Finding]) -> list[str]:
    where = "its frame is taken for that of the present map"
    if (alignment := values["alignment"]) is not None:
        (x, y, theta), share, residual = alignment.values()
        moved = f"laid onto the present map at ({x:.3f}, {y:.3f}), turned by {theta:.4f} rad"
        where = moved if x or y or theta else "its frame is that of the present map"
        where += f" ({share:.0%} of the walls agree, {1000 * residual:.0f} mm rms)"
    floor = (
        f"  walls that become floor {values['wall_to_floor_m2']} m2, floor that becomes wall "
        f"{values['floor_to_wall_m2']} m2; newly known {values['newly_known_m2']} m2, no longer known "
        f"{values['no_longer_known_m2']} m2"
    )
    lines = [f"site {values['site']}: {values['previous']} becomes {values['map']}, {where}", floor]
    lines += [f"  {one}" + (" [can't be accepted]" if one.refused else "") for one in found]
    if values["fog"] is None:
        lines.append("  no fog node of this site runs here: its zones, and where its robots stand, were not looked up")
    elif not values["robots"]:
        lines.append("  the planner did not answer: where robots stand, and are sent, was not looked up")
    return lines


def _refusal(values: dict[str, Any]) -> str:
    fixed = [f"{one['kind']} {one['id']}" for one in values["findings"] if one["refused"]]
    if fixed:
        return f"nothing was changed: move {', '.join(fixed)} in {SITE_FILE} to where both maps allow it"
    return "nothing was changed: move what was named, or take it as it is with --accept"


def _changed(present: LoadedSite, values: dict[str, Any], running: Fog | None) -> list[str]:
    if running is None:
        lines = [f"changed: {present.directory / SITE_FILE} names {values['map']}"]
        if read_provenance(present.directory / values["map"]).get(_KEY) is None:
            file = present.directory / present.site.map
            return [*lines, f"the other one is still there: fognav map change {file} --site {present.directory}"]
    else:
        lines = [f"changed, and in force: the map's epoch is {values['epoch']}, and was {values['epoch_before']}"]
        for name, place in values["localized"].items():
            there = "has not found itself on it yet"
            if place is not None:
                there = f"is at ({place[0]:.2f}, {place[1]:.2f}) on it"
            lines.append(f"  robot {name} was stopped, and {there}; fognav robot enable --robot {name}")
    return [*lines, f"back: fognav map change --back --site {present.directory}"]
