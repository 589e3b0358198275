"""The interface of cost layers (after Nav2's `Layer`: first the updated bounds, then costs inside a window)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from fog_contracts.grid import StaticMap, Window, combine_costs, combine_speed_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Moment, Publication
    from fog_contracts.messages import Cause, HazardArea, Trace
    from fog_contracts.shapes import ShapeMask

Options = TypeVar("Options", bound=msgspec.Struct)
Grid = NDArray[np.uint8]


class UpdatedBounds(NamedTuple):
    """A window in which a layer's costs changed, and why."""

    window: Window
    cause: Cause
    trace: Trace | None = None


class CostLayer(ABC):
    """One layer of the costmap; subclasses implement `update_costs` and override what else they need.

    A layer that changes calls `mark_updated`; after every message and tick, the marked windows are recomputed from all
    layers.
    """

    def __init__(self) -> None:
        self._updated: list[UpdatedBounds] = []

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that the layer subscribes to; what they return is published."""
        return {}

    def tick(self, at: Moment) -> Sequence[Publication]:  # noqa: ARG002  # for layers that depend on time
        """Advance to `at`, ten times a second; return what is to be published now."""
        return []

    def on_area(self, area: HazardArea, at: Moment) -> None:  # noqa: B027  # for layers that depend on areas
        """Hear how a watched area is on the map now, whenever that changes."""

    @abstractmethod
    def update_costs(self, window: Window, cost: Grid, speed: Grid) -> None:
        """Combine the layer's costs into `cost` and `speed`, both uint8 (window.height, window.width).

        They hold what the layers below wrote inside the window. No layer may lower a cost or raise a speed limit:
        `write_cost` and `write_speed_limit` guarantee that.
        """

    refused: int = 0
    """How many cells it did not take, because it holds as many as it may."""

    def mark_updated(self, window: Window, cause: Cause, trace: Trace | None = None) -> None:
        """Record that the layer's costs inside a window have changed."""
        self._updated.append(UpdatedBounds(window, cause, trace))

    def pop_updated_bounds(self) -> list[UpdatedBounds]:
        """Return the bounds that were marked since the last call."""
        updated, self._updated = self._updated, []
        return updated


class NoOptions(msgspec.Struct, frozen=True):
    """The options of a layer that has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerFactory(Generic[Options]):
    """What a layer registers under its name in the entry points `fognav.cost_layers`."""

    options: type[Options]
    make: Callable[[StaticMap, Options], CostLayer]


def write_cost(shape: ShapeMask, window: Window, cost: Grid, value: int) -> None:
    """Combine one cost into `cost` (the map inside `window`) in the shape's cells."""
    if (overlap := _overlap(shape, window, cost)) is not None:
        mask, below = overlap
        below[...] = combine_costs(below, np.full(below.shape, value, dtype=np.uint8), mask)


def write_speed_limit(shape: ShapeMask, window: Window, speed: Grid, value: int) -> None:
    """Combine one speed limit (cm/s) into `speed` (the map inside `window`) in the shape's cells."""
    if (overlap := _overlap(shape, window, speed)) is not None:
        mask, below = overlap
        below[...] = combine_speed_limits(below, np.where(mask, value, 0).astype(np.uint8))


def _overlap(shape: ShapeMask, window: Window, grid: Grid) -> tuple[NDArray[np.bool_], Grid] | None:
    """Return the shape's mask and the grid's cells where shape and window overlap, or None where they don't."""
    common = shape.window.intersection(window)
    if common.empty:
        return None
    in_shape, in_grid = (
        Window(common.x - frame.x, common.y - frame.y, common.width, common.height) for frame in (shape.window, window)
    )
    return shape.mask[in_shape.rows, in_shape.columns], grid[in_grid.rows, in_grid.columns]
