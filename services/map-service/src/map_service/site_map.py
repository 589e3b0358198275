"""Which map is in force: the record in Redis, and what the services of this machine read at their start."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Count, Id, Message
from fog_runtime import logs
from fog_runtime.configuration.uploaded_maps import MapInForce, MapName, UploadedMaps  # msgspec reads it

if TYPE_CHECKING:
    from collections.abc import Mapping

MAP_ID: Final = "map"
"""The record's id: there is one."""
_limited = logs.RateLimited(logs.get("map"), 60.0)


class StoredMap(Message, frozen=True, kw_only=True):
    """The map in force, by its fingerprint, and the one before it; null is that of `site.toml`.

    `over` is the fingerprint of the map of `site.toml` at that time.
    """

    id: Id
    name: MapName | None
    over: MapName
    previous: MapName | None = None
    version: Count = 1


class MapFile:
    """Lets the services of this machine have the stored map, by starting anew, once its record has changed."""

    def __init__(self, maps: UploadedMaps) -> None:
        self._maps = maps
        self._changed: Mapping[str, StoredMap] | None = None
        """Records that are to be put into force. None: nothing has changed, such as in a store that was emptied."""

    def use(self, records: Mapping[str, StoredMap]) -> None:
        """Put what is stored into force at the next `write`."""
        self._changed = records

    def write(self, now: float) -> None:
        """Put a change into force at `now` (s, monotonic); called again and again.

        So a full disk, or a map that is only on another machine, delays it until that is mended; either is logged.
        """
        if self._changed is None:
            return
        record = self._changed.get(MAP_ID)
        if record is not None and record.name is not None and not (file := self._maps.file(record.name)).is_file():
            remedy = "copy it from the other machine, or upload it again"
            _limited.warning("map_not_here", "missing", now, file=str(file), remedy=remedy)
            return
        try:
            self._maps.put(None if record is None else MapInForce(name=record.name, over=record.over))
        except OSError as error:
            remedy = "let FOGNAV_MAPS_DIR name a folder with room"
            _limited.warning("map_not_in_force", "failed", now, reason=str(error), remedy=remedy)
        else:
            self._changed = None
