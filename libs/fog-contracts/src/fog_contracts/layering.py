"""How the layers of a map are combined, cell by cell."""

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import LETHAL, NO_SPEED_LIMIT, UNKNOWN


def combine_costs(below: NDArray[np.uint8], layer: NDArray[np.uint8], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Combine a layer with the layers below it; all arrays have the same shape.

    A layer changes cells only where `mask` is true. There the higher cost wins, and no layer lowers a cost.
    Unknown (255) is the absence of a cost: only `LETHAL` replaces it, so that an obstacle seen in unexplored space
    counts, while a penalty does not make unexplored space traversable.
    """
    graded = np.where(below == UNKNOWN, np.where(layer == LETHAL, layer, below), np.maximum(below, layer))
    return np.where(mask & (layer != UNKNOWN), graded, below).astype(np.uint8)


def combine_speed_limits(below: NDArray[np.uint8], layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Combine two speed layers (uint8, cm/s, 0 = no limit): the lower limit wins."""
    both = np.minimum(below, layer)
    return np.where(below == NO_SPEED_LIMIT, layer, np.where(layer == NO_SPEED_LIMIT, below, both)).astype(np.uint8)
