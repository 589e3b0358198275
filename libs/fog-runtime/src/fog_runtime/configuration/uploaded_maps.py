"""Maps that a running fog was given: files in a folder of its data, and which of them is in force.

The one in force goes before the map that `site.toml` names, for as long as that is the one which it has replaced:
whoever lets `site.toml` name another map later means that one. Services read their map at their start only (ADR 66),
and end when another one is in force, to be started again by what supervises them.
"""

from __future__ import annotations

import asyncio
import hashlib
from typing import TYPE_CHECKING, Annotated, Final, Self

import msgspec

from fog_contracts.messages import Message
from fog_runtime import logs
from fog_runtime.configuration.site import LoadedSite, load_site
from fog_runtime.files import SHARED, atomic_write
from fog_runtime.process import AgainError, limit_the_end

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

    from fog_contracts.grid import StaticMap

FILE: Final = "in-force.json"
PERIOD_S: Final = 1.0
"""How soon a service sees that another map is in force: after the answer to whoever put it there."""
_log = logs.get("map")

MapName = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{16}$(?!\n)")]
"""A map's fingerprint, by which its files are named."""


class MapInForce(Message, frozen=True, kw_only=True):
    """The map in force (null: that of `site.toml`), instead of the map of `site.toml` with the fingerprint `over`."""

    name: MapName | None = None
    over: MapName


def fingerprint(static: StaticMap) -> MapName:
    """Return what identifies a map: of its cells and where they lie."""
    g = static.geometry
    found = hashlib.sha256(repr((g.width, g.height, g.resolution, g.origin_x, g.origin_y)).encode())
    found.update(static.cells.tobytes())
    return found.hexdigest()[:16]


class UploadedMaps:
    """The folder of one site's uploaded maps; it may not exist yet."""

    def __init__(self, folder: Path) -> None:
        """Take what is in force now for what this process has read."""
        self.folder = folder
        self.site_map: MapName | None = None
        """The fingerprint of the map of `site.toml`, if that was loaded."""
        self._seen = self._state()

    @classmethod
    def load(cls, root: Path, directory: Path, site: str = "") -> tuple[LoadedSite, Self]:
        """Return the site in a folder with the map in force, and its uploaded maps, which are in a folder of `root`.

        `site` is its id, if not that of `site.toml`. Raises `SiteError`.
        """
        loaded = load_site(directory)
        maps = cls(root / (site or loaded.site.id))
        record, maps.site_map = maps.in_force(), fingerprint(loaded.map)
        if record is None or record.name is None:
            return loaded, maps
        file = maps.file(record.name)
        if record.over != maps.site_map:
            _log.warning(
                "uploaded_map_superseded", file=str(file), map=loaded.site.map,
                remedy="site.toml names another map than when it was uploaded: that one is used. Upload it again",
            )  # fmt: skip
            return loaded, maps
        return load_site(directory, map_file=file), maps

    def file(self, name: MapName) -> Path:
        """Return the YAML file of a map; its picture has the same name."""
        return self.folder / f"{name}.yaml"

    def in_force(self) -> MapInForce | None:
        """Return which map is in force, None if that was never decided; an unreadable record is logged as none."""
        data = self._state()
        if not data:
            return None
        try:
            return msgspec.json.decode(data, type=MapInForce)
        except msgspec.DecodeError as error:
            remedy = "upload the map again, or delete the file"
            _log.error("map_in_force_unreadable", file=str(self.folder / FILE), reason=str(error), remedy=remedy)
            return None

    def put(self, record: MapInForce | None) -> None:
        """Let a map be in force; None leaves that to `site.toml`. Raises `OSError`."""
        data = b"" if record is None else msgspec.json.encode(record) + b"\n"
        if data != self._state():
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            atomic_write(self.folder / FILE, data, mode=SHARED)

    async def until_changed(self, before: Callable[[], Awaitable[object]] | None = None) -> None:
        """Wait until another map is in force than this process has read, call `before`, and raise `AgainError`."""
        while await asyncio.to_thread(self._state) == self._seen:  # noqa: ASYNC110  # another process writes the file
            await asyncio.sleep(PERIOD_S)
        if before is not None:
            await before()
        limit_the_end()
        raise AgainError("another map is in force")

    def _state(self) -> bytes:
        try:
            return (self.folder / FILE).read_bytes()
        except FileNotFoundError:
            return b""
