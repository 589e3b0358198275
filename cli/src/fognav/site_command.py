"""`fognav site`: reads and writes the files of a proposed or checked site."""

import os
import re
from pathlib import Path

from fog_runtime.files import atomic_write
from fog_runtime.maps import MapFileError, load_map
from fog_runtime.site import SITE_FILE, SiteError, load_site
from fognav.output import WrongUseError

_ID_LENGTH = 32


def identifier(name: str) -> str:
    """Return an id for a name: lower-case letters, digits and hyphens."""
    plain = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")
    return plain[:_ID_LENGTH].strip("-") or "site"


def new_site(map_file: Path, out: Path, seed: int) -> dict[str, object]:
    """Write `out`/site.toml for a map; raises `WrongUseError`, and then writes nothing."""
    # Checking a site must not wait for the kernels, which only a proposal needs.
    from fognav.site_proposal import NoSiteError, propose, to_toml  # noqa: PLC0415  # see above

    target = out / SITE_FILE
    if target.exists():
        raise WrongUseError(f"{target} already exists: name another folder with --out, or remove it")
    try:
        static = load_map(map_file)
        relative = os.path.relpath(map_file.resolve(), out.resolve())
        site = propose(identifier(out.resolve().name), relative, static.geometry, static.cells, seed)
    except (MapFileError, NoSiteError) as error:
        raise WrongUseError(str(error)) from error
    try:
        atomic_write(target, to_toml(site).encode())
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
        "places": {name: [place.x, place.y] for name, place in site.places.items()},
    }


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
    }
