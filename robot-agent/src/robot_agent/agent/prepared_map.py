"""A snapshot of the map with all that takes long to make of it, so that loading it takes no time."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from fog_contracts.replica import decode_map

if TYPE_CHECKING:
    from fog_contracts.messages import MapSnapshot
    from fog_contracts.replica import DecodedMap
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.map_fields import MapFields


class PreparedMap(NamedTuple):
    """A snapshot of the map, its cells, and the fields of its static map for localization."""

    snapshot: MapSnapshot
    decoded: DecodedMap
    fields: MapFields


def prepare_map(snapshot: MapSnapshot, localizer: Localizer) -> PreparedMap:
    """Decode a snapshot and compute its fields, some 0.4 s for 2000 x 1200 cells; raises `MapError` when it is invalid.

    It changes nothing and may run on any thread. Each result can be loaded once.
    """
    decoded = decode_map(snapshot)
    return PreparedMap(snapshot, decoded, localizer.fields_of(decoded.static, decoded.geometry))
