"""`fognav site`: reads and writes the files of a proposed or checked site."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from fog_runtime.configuration.maps import MapFileError, load_map, save_map
from fog_runtime.configuration.site import SITE_FILE, SiteError, load_site
from fog_runtime.files import SHARED, atomic_write
from fognav.output import WrongUseError
from fognav.site_text import to_toml

_ID_LENGTH = 32
_MAP: Final = "map.yaml"


def identifier(name: str) -> str:
    """Return an id for a name: lower-case letters, digits and hyphens."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    return plain[:_ID_LENGTH].strip("-") or "site"


def _map_in(out: Path, map_file: Path) -> str:
    """Return the name of the site's map in its own folder, where it is copied to unless it is there already.

    A site must not depend on files elsewhere: containers get nothing but its folder. Raises `WrongUseError` if another
    map is in the way.
    """
    if map_file.resolve().parent == out.resolve():
        return map_file.name
    for name in (_MAP, f"{Path(_MAP).stem}.pgm"):
        if (out / name).exists():
            raise WrongUseError(f"{out / name} already exists: name another folder with --out, or remove it")
    return _MAP


def new_site(map_file: Path, out: Path, seed: int) -> dict[str, object]:
    """Write `out`/site.toml for a map, and copy the map there; raises `WrongUseError`, and then writes nothing."""
    # Checking a site must not wait for the kernels, which only a proposal needs.
    from fognav.site_proposal import NoSiteError, propose  # noqa: PLC0415  # see above

    target = out / SITE_FILE
    if target.exists():
        raise WrongUseError(f"{target} already exists: name another folder with --out, or remove it")
    map_name = _map_in(out, map_file)
    copied = None if (out / map_name).exists() else out / map_name
    try:
        static = load_map(map_file)
        site, why = propose(identifier(out.resolve().name), map_name, static.geometry, static.cells, seed)
    except (MapFileError, NoSiteError) as error:
        raise WrongUseError(str(error)) from error
    try:
        if copied is not None:
            save_map(copied.with_suffix(""), static)
        atomic_write(target, to_toml(site).encode(), mode=SHARED)
    except OSError as error:
        raise WrongUseError(f"{target} can't be written: {error.strerror}. Name another folder with --out") from error
    try:
        load_site(out)
    except SiteError:
        target.unlink()
        raise
    return {
        "file": str(target),
        "site": site.id,
        "areas": len(site.areas),
        "why_no_areas": why,
        "places": {name: [place.x, place.y] for name, place in site.places.items()},
    }


def compose_floors(folders: Sequence[Path], root: Path, out: Path) -> dict[str, object]:
    """Write the override of a checkout's compose file for further floors; without folders, remove it.

    Raises `WrongUseError` as `override`, and for a file that this command has not written.
    """
    from fognav.hosting.compose_floors import BASE, HEADER, override  # noqa: PLC0415  # keeps the other commands fast

    if out.exists() and not out.read_text("utf-8").startswith(HEADER):
        raise WrongUseError(f"{out} is not by this command: move it, or name another file with --out")
    if folders:
        atomic_write(out, override(folders, (root / BASE).read_text("utf-8")).encode(), mode=SHARED)
    else:
        out.unlink(missing_ok=True)
    return {"file": str(out), "sites": [str(folder) for folder in folders]}


def check_site(folder: Path) -> dict[str, object]:
    """Return the contents of a site, or the problem with it."""
    try:
        loaded = load_site(folder)
    except SiteError as error:
        return {"ok": False, "problem": str(error)}
    site = loaded.site
    return {
        "ok": True,
        "site": site.id,
        "areas": len(site.areas),
        "nodes": len(site.nodes),
        "places": len(site.places),
        "robots": len(site.robots),
        "demo": site.demo is not None,
        "unbounded_nodes": [node.id for node in site.nodes if any(each.range_max is None for each in node.sonars)],
    }
