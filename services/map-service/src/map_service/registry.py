"""Cost layers by name, ours like anybody's: what installed packages registered as entry points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from fog_contracts.options import OptionError, read_options
from fog_runtime import parts
from map_service.layers.base import CostLayer, FloorPlan, LayerFactory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from map_service.costmap import StaticMap

GROUP: Final = "fognav.cost_layers"
STANDARD: Final = ("static", "hazards", "zones", "obstacles")
"""The layers of a site that chooses none, bottom first."""


class LayersError(ValueError):
    """A site's choice of layers that can't be used; the message names the entry, the field and the remedy."""


def make_layers(static: StaticMap, chosen: Sequence[str | Mapping[str, Any]] = ()) -> list[CostLayer]:
    """Return a site's layers over its floor plan, bottom first; raises `LayersError`.

    An entry is a layer's name, or a table with its `name` and its own options. The floor plan (`static`) is at the
    bottom, hazards and zones are never missing.
    """
    entries = [{"name": entry} if isinstance(entry, str) else dict(entry) for entry in chosen or STANDARD]
    names = [entry.get("name", "") for entry in entries]
    if names[0] != STANDARD[0]:
        raise LayersError(f"layers[0]: {STANDARD[0]!r} has to be the first, at the bottom. Put it there")
    for needed in STANDARD[:3]:
        if names.count(needed) != 1:
            raise LayersError(f"layers: {needed!r} has to be there once. List it, without it robots would be misled")
    plan = FloorPlan(static.geometry, static.cells)
    return [_layer(plan, index, entry) for index, entry in enumerate(entries)]


def _layer(plan: FloorPlan, index: int, entry: dict[str, Any]) -> CostLayer:
    name = str(entry.pop("name", ""))
    try:
        factory: LayerFactory[Any] = parts.load(GROUP, name, LayerFactory)
        return factory.make(plan, read_options(factory.options, entry))
    except parts.PartError as error:
        raise LayersError(f"layers[{index}]: {error}") from error
    except OptionError as error:
        raise LayersError(f"layers[{index}] ({name}): {error}. Correct the layer's options in site.toml") from error
