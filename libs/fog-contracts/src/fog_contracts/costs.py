"""Cost values of every costmap cell, what they weigh on a path, how they are inflated, and how layers are combined.

The values are those of Nav2 (`nav2_costmap_2d/cost_values.hpp`), so that maps can be exchanged with it; the weights are
those of NavFn. Compiled kernels hold these values as constants, and numba does not notice that an imported constant
changed: after changing one, delete the kernels' cache (`__pycache__` of `fog_kernels`, or NUMBA_CACHE_DIR).
"""

import math
from dataclasses import dataclass
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

NEUTRAL_WEIGHT: Final = 50
"""What a length over free cells weighs on a path; over cells of cost c it weighs NEUTRAL_WEIGHT + COST_WEIGHT * c."""
COST_WEIGHT: Final = 0.8
COST_PER_FACTOR: Final = NEUTRAL_WEIGHT / COST_WEIGHT
"""The cost that makes a cell as heavy as one free cell more: cost c makes it 1 + c / COST_PER_FACTOR free cells."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inflation:
    """How lethal cells are inflated, as by Nav2's inflation layer.

    Within `inscribed_radius` (m, that of the robot) of a lethal cell the cost is INSCRIBED; beyond, up to
    `inflation_radius` (m), it decays as exp(-cost_scaling * distance), `cost_scaling` in 1/m. Raises ValueError for
    values that are negative or not finite.
    """

    inscribed_radius: float = 0.17
    inflation_radius: float = 0.55
    cost_scaling: float = 3.0

    def __post_init__(self) -> None:
        for name in ("inscribed_radius", "inflation_radius", "cost_scaling"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative, not {value}")


DEFAULT_INFLATION: Final = Inflation()
"""That of the master costmap: a Roomba's radius, and costs that keep paths in the middle of a corridor."""


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
