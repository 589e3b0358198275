"""Cost layers by name: those that installed packages, this one included, registered as entry points."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from fog_contracts.site import OptionError, read_options
from fog_runtime.configuration import parts
from map_service.layers.base import CostLayer, LayerFactory

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.grid import StaticMap

GROUP: Final = "fognav.cost_layers"
DEFAULT_LAYERS: Final = ("static", "hazards", "zones", "obstacles", "reported")
"""The layers of a site that configures none, bottom first."""


class LayersError(ValueError):
    """A site's configuration of layers is invalid; the message names the entry, the field and the remedy."""


def make_layers(static: StaticMap, configured: Sequence[str | Mapping[str, Any]] = ()) -> list[CostLayer]:
    """Return a site's layers over its floor plan, bottom first; raises `LayersError`.

    An entry is a layer's name, or a table with its `name` and its options. The floor plan (`static`) must be the bottom
    layer; `hazards` and `zones` are mandatory. `reported` is added on top where it is not listed: robots of others are
    left out of all else that sees them, and would be nowhere.
    """
    entries = [{"name": entry} if isinstance(entry, str) else dict(entry) for entry in configured or DEFAULT_LAYERS]
    names = [entry.get("name", "") for entry in entries]
    if names[0] != DEFAULT_LAYERS[0]:
        raise LayersError(f"layers[0]: {DEFAULT_LAYERS[0]!r} must be the first (bottom) layer. Move it there")
    for mandatory in DEFAULT_LAYERS[:3]:
        if names.count(mandatory) != 1:
            raise LayersError(f"layers: {mandatory!r} must occur exactly once. List it once: robots rely on it")
    if DEFAULT_LAYERS[-1] not in names:
        entries.append({"name": DEFAULT_LAYERS[-1]})
    return [_make_layer(static, index, entry) for index, entry in enumerate(entries)]


def _make_layer(plan: StaticMap, index: int, entry: dict[str, Any]) -> CostLayer:
    name = str(entry.pop("name", ""))
    try:
        factory: LayerFactory[Any] = parts.load(GROUP, name, LayerFactory)
        return factory.make(plan, read_options(factory.options, entry))
    except parts.PartError as error:
        raise LayersError(f"layers[{index}]: {error}") from error
    except OptionError as error:
        raise LayersError(f"layers[{index}] ({name}): {error}. Correct the layer's options in site.toml") from error
