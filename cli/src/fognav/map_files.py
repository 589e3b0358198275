"""Files of maps: what a map holds, where it came from, and errors of reading it as wrong use."""

from __future__ import annotations

import datetime as dt
import hashlib
import shlex
import sys
from typing import TYPE_CHECKING

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_runtime.configuration.maps import MapFileError, load_map
from fognav import __version__
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.grid import StaticMap


def loaded(file: Path) -> StaticMap:
    """Return a map; raises `WrongUseError`."""
    try:
        return load_map(file)
    except MapFileError as error:
        raise WrongUseError(str(error)) from error


def described(map_: StaticMap) -> dict[str, object]:
    """Return size, resolution and origin of a map, and how many of its cells are free, occupied and unknown."""
    geometry = map_.geometry
    names = {"free": FREE, "occupied": LETHAL, "unknown": UNKNOWN}
    return {
        "width": geometry.width,
        "height": geometry.height,
        "resolution": geometry.resolution,
        "origin": [geometry.origin_x, geometry.origin_y, 0.0],
        **{name: int((map_.cells == value).sum()) for name, value in names.items()},
    }


def provenance(*sources: Path, **more: object) -> dict[str, object]:
    """Return where a map comes from, for `save_map`: the files (with their hashes), this command and version, now."""
    return {
        "command": f"fognav {shlex.join(sys.argv[1:])}",
        "version": __version__,
        "date": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "sources": [{"file": file.name, "sha256": file_hash(file)} for file in sources],
        **more,
    }


def file_hash(file: Path) -> str | None:
    """Return the SHA-256 of a file, as hexadecimal digits; None for a folder. Raises `WrongUseError`."""
    try:
        if file.is_dir():
            return None
        with file.open("rb") as data:
            return hashlib.file_digest(data, "sha256").hexdigest()
    except OSError as error:
        raise WrongUseError(f"{file} can't be read: {error.strerror}. Check the path") from error
