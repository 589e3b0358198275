"""`fognav map change`: another map for a site, also while its fog runs, with a preview and a way back."""

from __future__ import annotations

import re
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
import typer

from fog_contracts.messages import Place, Zone
from fog_runtime.configuration.maps import read_provenance, save_map
from fog_runtime.configuration.site import SITE_FILE, load_site
from fog_runtime.files import PRIVATE, atomic_write
from fognav import checkout, kernels, site_files
from fognav.commands.map_files import map_app
from fognav.hosting.folders import NodeFolder, recall
from fognav.hosting.local_nodes import KIND
from fognav.map_files import described, loaded, provenance
from fognav.operate.fog import Fog, find_fog
from fognav.operate.options import FogOption, JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.operate.robot_commands import stop_by_planner
from fognav.operate.systems import registered
from fognav.output import NOT_TRUE, FailedError, WrongUseError, exit_codes, print_line, print_result, writing
from fognav.programs import MAP_SERVICE, PLANNER, SERVICES

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap
    from fog_mapping.alignment import Alignment
    from fog_runtime.configuration.site import LoadedSite
    from fognav.map_change import Finding

_KEY: Final = "site"
"""In a map's provenance: what this command did."""
_IN_FORCE_S: Final = 240.0
"""For three services, one after another, on a Raspberry Pi."""
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
    right. Robots are stopped and lose their missions; each finds itself on the new map, and waits to be enabled.
    """
    from fognav import map_change as change  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes():
        if (map_file is None) is not back:
            raise WrongUseError("name either the new map, or --back")
        kernels.warm_cache(print_line)
        present = load_site(checkout.site_folder(site))
        name, static, alignment = _new_map(present, map_file, as_it_is=as_it_is)
        running = _running(present, fog)
        zones, poses, places = ([], {}, {}) if running is None else _known(running)
        found = change.findings(present.site, present.map, static, zones, poses, places)
        values: dict[str, Any] = {
            "site": present.site.id,
            "map": name,
            "previous": present.site.map,
            "alignment": None if alignment is None else alignment._asdict(),
            **described(static),
            **change.changed_area(present.map, static),
            "findings": change.as_values(found),
            "fog": None if running is None else running.system.name,
            "changed": False,
        }
        lines = _preview(present, values, found, running)
        refused = any(one.refused for one in found) or (bool(found) and not accept)
        if not preview and not refused:
            values["changed"] = True
            if map_file is not None:
                made = {**read_provenance(map_file), _KEY: {**provenance(map_file), "previous": present.site.map}}
                with writing(present.directory / name, "Run this as the folder's owner"):
                    save_map((present.directory / name).with_suffix(""), static, made)
            try:
                values |= _change(present, name, running)
            except (WrongUseError, FailedError):
                if map_file is not None and _named(present) != name:
                    for suffix in (".yaml", ".pgm"):
                        (present.directory / name).with_suffix(suffix).unlink(missing_ok=True)
                raise
            lines += _changed(present, values, running)
        elif refused:
            lines.append(_refusal(present, found))
        print_result(values, *lines, json=json)
        if refused:
            raise typer.Exit(NOT_TRUE)


def _new_map(present: LoadedSite, map_file: Path | None, *, as_it_is: bool) -> tuple[str, StaticMap, Alignment | None]:
    """Return the new map's name in the site's folder, the map in the present one's frame, and how it was laid there.

    None: its frame is taken for the present one's.
    """
    from fog_mapping.alignment import MisfitError  # noqa: PLC0415  # keeps the other commands fast
    from fognav.map_change import in_frame_of  # noqa: PLC0415  # same

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
    static, alignment = loaded(map_file), None
    try:
        if not as_it_is:
            static, alignment = in_frame_of(static, present.map)
    except MisfitError as error:
        raise FailedError(
            f"{map_file} can't be laid onto {folder / present.site.map}: {error}. If it has the same frame, "
            "say so: --as-it-is"
        ) from error
    stem = re.sub(r"-\d+$", "", Path(present.site.map).stem)
    number = 2
    while any((folder / f"{stem}-{number}{suffix}").exists() for suffix in (".yaml", ".pgm")):
        number += 1
    return f"{stem}-{number}.yaml", static, alignment


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


def _known(fog: Fog) -> tuple[list[Zone], dict[str, tuple[float, float]], dict[str, Place]]:
    """Return the zones, where each robot stands that knows it, and the places."""
    zones = msgspec.convert(fog.get(MAP_SERVICE, "/api/v1/zones")["zones"], list[Zone])
    places = msgspec.convert(fog.get(MAP_SERVICE, "/api/v1/places"), dict[str, Place])
    views = [view for view in fog.get(PLANNER, "/api/v1/robots") if view["pose"] and view["pose"]["localized"]]
    return zones, {view["id"]: (view["pose"]["x"], view["pose"]["y"]) for view in views}, places


def _stop_robots(fog: Fog) -> dict[str, str]:
    """Stop every robot, and end its mission; return what became of each."""
    told = {}
    for view in fog.get(PLANNER, "/api/v1/robots"):
        robot = view["id"]
        if view["state"] is None:
            told[robot] = "has not been heard of"
            continue
        try:
            stop_by_planner(fog, robot)
            told[robot] = "stopped"
        except FailedError as error:
            # It looks at the new map by itself as soon as it hears of that, and holds meanwhile.
            told[robot] = f"did not answer ({error})"
        if view["goal"] is not None:
            fog.send("DELETE", PLANNER, f"/api/v1/robots/{robot}/goal")
            told[robot] += f", its mission to {view['goal']['place'] or 'a position'} has ended"
    return told


@dataclass(frozen=True)
class _Node:
    """A fog node of `fognav up`, whose services can be told to read their map anew."""

    fog: Fog
    data: Path

    def epoch(self) -> int:
        return int(self.fog.get(MAP_SERVICE, "/api/v1/map")["epoch"])

    def pids(self) -> dict[str, int]:
        """Return the processes of the site's services, as the register has them."""
        system = self.fog.system
        found = [each for each in registered() if (each.name, each.data) == (system.name, system.data)]
        if not found:
            raise FailedError(f"the fog node {system.name} has ended")
        names = {name.rpartition(".")[2]: pid for name, pid in found[0].pids.items()}
        return {service: names[service] for service in SERVICES if service in names}

    def order(self, map_name: str) -> None:
        """Let the services start anew, one at a time."""
        file = NodeFolder(self.data).map_order(self.fog.system.site)
        file.parent.mkdir(mode=0o700, exist_ok=True)
        atomic_write(file, f"{map_name} {time.time_ns()}\n".encode(), mode=PRIVATE)

    def wait(self, before: dict[str, int], epoch: int) -> int:
        """Wait until all of them run anew and are ready; return the map's epoch. Raises `FailedError`."""
        deadline, trouble = time.monotonic() + _IN_FORCE_S, ""
        while time.monotonic() < deadline:
            now = self.pids()
            old = [service for service in SERVICES if now.get(service, before.get(service)) == before.get(service)]
            trouble = f"{', '.join(old)} still has the map before" if old else ""
            try:
                if not old:
                    for service in SERVICES:
                        self.fog.get(service, "/readyz")
                    if (reached := self.epoch()) > epoch:
                        return reached
            except FailedError as error:
                trouble = str(error)
            time.sleep(_POLL_S)
        raise FailedError(f"the new map was not in force after {_IN_FORCE_S:.0f} s: {trouble}")


def _change(present: LoadedSite, name: str, running: Fog | None) -> dict[str, Any]:
    """Put the map into the site's file, and into force where the fog runs here; return what was reached."""
    text = site_files.with_map(present, name)
    if running is None:
        site_files.write(present, text)
        return {}
    robots = _stop_robots(running)
    if running.system.data is None:
        site_files.write(present, text)
        return {"robots": robots}
    node = _Node(running, Path(running.system.data))
    before, epoch = node.pids(), node.epoch()
    site_files.write(present, text)
    node.order(name)
    try:
        reached = node.wait(before, epoch)
    except FailedError as error:
        site_files.write(present, site_files.with_map(present, present.site.map))
        node.order(present.site.map)
        raise FailedError(
            f"{error}. {present.directory / SITE_FILE} names {present.site.map} again, and the services start with "
            "that; their logs say more (fognav logs map-service)"
        ) from error
    return {"epoch_before": epoch, "epoch": reached, "robots": robots, "localized": _localized(running, reached)}


def _named(present: LoadedSite) -> str:
    """Return the map that the site's file names now."""
    return str(tomllib.loads((present.directory / SITE_FILE).read_text("utf-8"))["map"])


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


def _preview(present: LoadedSite, values: dict[str, Any], found: list[Finding], running: Fog | None) -> list[str]:
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
    lines = [f"site {present.site.id}: {present.site.map} becomes {values['map']}, {where}", floor]
    lines += [f"  {one}" + (" [can't be accepted]" if one.refused else "") for one in found]
    if running is None:
        lines.append("  no fog node of this site runs here: its zones, and where its robots stand, were not looked up")
    return lines


def _refusal(present: LoadedSite, found: list[Finding]) -> str:
    fixed = [f"{one.kind} {one.id}" for one in found if one.refused]
    if fixed:
        file = present.directory / SITE_FILE
        return f"nothing was changed: move {', '.join(fixed)} in {file} to where both maps allow it"
    return "nothing was changed: move what was named, or take it as it is with --accept"


def _changed(present: LoadedSite, values: dict[str, Any], running: Fog | None) -> list[str]:
    lines = [f"changed: {present.directory / SITE_FILE} names {values['map']}"]
    lines += [f"  robot {name}: {told}" for name, told in values.get("robots", {}).items()]
    if "epoch" in values:
        lines.append(f"  in force: the map's epoch is {values['epoch']}, and was {values['epoch_before']}")
        for name, place in values["localized"].items():
            there = (
                "has not found itself on it yet" if place is None else f"is at ({place[0]:.2f}, {place[1]:.2f}) on it"
            )
            lines.append(f"  robot {name} {there}; fognav robot enable --robot {name}")
    elif running is not None:
        services = " ".join(SERVICES)
        lines.append(f"  the services read it at their start: there, docker compose restart {services}")
    there = "back: fognav map change --back"
    if read_provenance(present.directory / values["map"]).get(_KEY) is None:
        there = f"the other one is still there: fognav map change {present.directory / present.site.map}"
    return [*lines, f"{there} --site {present.directory}"]
