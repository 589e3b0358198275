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
_log = logs.get("map")


class StoredMap(Message, frozen=True, kw_only=True):
    """The map in force, by its fingerprint, and the one before it; null is that of `site.toml`.

    `over` is the fingerprint of the map of `site.toml` at that time.
    """

    id: Id
    name: MapName | None
    over: MapName
    previous: MapName | None = None
    version: Count = 1


def put_into_force(maps: UploadedMaps, records: Mapping[str, StoredMap]) -> None:
    """Let the services of this machine have the stored map, by starting anew; one that is not here is logged."""
    record = records.get(MAP_ID)
    if record is not None and record.name is not None and not maps.file(record.name).is_file():
        remedy = "copy it from the other machine, or upload it again"
        _log.error("map_not_here", file=str(maps.file(record.name)), remedy=remedy)
        return
    try:
        maps.put(None if record is None else MapInForce(name=record.name, over=record.over))
    except OSError as error:
        _log.error("map_not_in_force", reason=str(error), remedy="let FOGNAV_MAPS_DIR name a folder with room")
