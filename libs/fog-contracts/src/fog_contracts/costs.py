"""Cost values of every costmap cell, and the one rule that combines layers.

The values are those of Nav2 (`nav2_costmap_2d/cost_values.hpp`), so that maps can be exchanged with it.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

FREE: Final = 0
"""Nothing is known against driving here."""
PENALTY_MAX: Final = 252
"""The highest graded cost: undesired, still passable."""
INSCRIBED: Final = 253
"""A robot whose centre is here surely touches something."""
LETHAL: Final = 254
"""Something is here."""
UNKNOWN: Final = 255
"""Nobody has looked here; impassable to planner and robot by default."""

NO_SPEED_LIMIT: Final = 0
"""In the speed layer (uint8, cm/s): the cell sets no limit."""


def is_traversable(cost: int) -> bool:
    """Whether the centre of a robot may be on a cell of this cost."""
    return cost < INSCRIBED


def combine_costs(below: NDArray[np.uint8], layer: NDArray[np.uint8], opinion: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Combine a layer with what lies below it; all arrays have the same shape.

    A layer has a say only where `opinion` is true. There the higher cost wins, and no layer lowers a cost.
    Unknown (255) is no cost but the lack of one: it yields to `LETHAL` alone, so that a danger seen in unexplored
    space counts, while a mere penalty does not make unexplored space passable.
    """
    graded = np.where(below == UNKNOWN, np.where(layer == LETHAL, layer, below), np.maximum(below, layer))
    return np.where(opinion & (layer != UNKNOWN), graded, below).astype(np.uint8)


def combine_speed_limits(below: NDArray[np.uint8], layer: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Combine two speed layers (uint8, cm/s, 0 = no limit): the lower limit wins."""
    both = np.minimum(below, layer)
    return np.where(below == NO_SPEED_LIMIT, layer, np.where(layer == NO_SPEED_LIMIT, below, both)).astype(np.uint8)
