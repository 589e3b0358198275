"""Cost values of costmap cells, their weight on a path, and their inflation.

The values are those of Nav2 (`nav2_costmap_2d/cost_values.hpp`), so that maps can be exchanged with it; the weights are
those of NavFn. Compiled kernels hold these values as constants: each change compiles the kernels anew.

No arrays here: every process reads its settings with this module, and the guardian starts faster without numpy.
"""

import math
from dataclasses import dataclass
from typing import Final

FREE: Final = 0
"""No layer assigns a cost to the cell."""
PENALTY_MAX: Final = 252
"""The highest graded cost: undesired, still passable."""
INSCRIBED: Final = 253
"""A robot whose centre is in the cell is certain to be in collision."""
LETHAL: Final = 254
"""The cell holds an obstacle."""
UNKNOWN: Final = 255
"""The cell has not been observed; impassable to planner and robot by default."""

NO_SPEED_LIMIT: Final = 0
"""In the speed layer (uint8, cm/s): the cell sets no limit."""
DEGRADED_SPEED: Final = 15
"""Speed limit (cm/s) where a robot can't rely on what it knows: in unknown areas, and everywhere while it is DEGRADED.

Half the usual speed quarters the braking distance."""
ROBOT_RADIUS: Final = 0.17
"""Radius (m) of a robot's body, unless the site says otherwise: that of a Roomba."""

NEUTRAL_WEIGHT: Final = 50
"""Weight of a free cell on a path; a cell of cost c weighs NEUTRAL_WEIGHT + COST_WEIGHT * c."""
COST_WEIGHT: Final = 0.8
COST_PER_FACTOR: Final = NEUTRAL_WEIGHT / COST_WEIGHT
"""The cost that adds the weight of one free cell: cost c weighs as much as 1 + c / COST_PER_FACTOR free cells."""
PENALTY_FACTOR_MAX: Final = 5.0
"""The highest factor of a PENALTY zone: beyond about 5.03 every factor would be the highest graded cost."""


def penalty_cost(factor: float) -> int:
    """Return the cost (0 to 250) at which a free cell weighs `factor` (1 to PENALTY_FACTOR_MAX) free cells on a path.

    Factors that differ by 0.02 have different costs. Where a cell costs more already, that cost stays. Raises
    ValueError for a factor outside the range.
    """
    if not 1.0 <= factor <= PENALTY_FACTOR_MAX:
        raise ValueError(f"a penalty's factor must lie from 1 to {PENALTY_FACTOR_MAX:g}, not {factor}")
    return round(COST_PER_FACTOR * (factor - 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Inflation:
    """How lethal cells are inflated, as by Nav2's inflation layer.

    Within `inscribed_radius` (m, that of the robot) of a lethal cell the cost is INSCRIBED, even of unknown cells;
    beyond, up to `inflation_radius` (m, rounded up to whole cells), it decays as exp(-cost_scaling * distance),
    `cost_scaling` in 1/m. Raises ValueError for values that are negative or not finite.
    """

    inscribed_radius: float = ROBOT_RADIUS
    inflation_radius: float = 0.55
    cost_scaling: float = 3.0

    def __post_init__(self) -> None:
        for name in ("inscribed_radius", "inflation_radius", "cost_scaling"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative, not {value}")


DEFAULT_INFLATION: Final = Inflation()
"""Inflation of the master costmap: the radius of a Roomba, and costs that keep paths in the middle of a corridor."""


def is_traversable(cost: int) -> bool:
    """Whether the centre of a robot may be on a cell of this cost."""
    return cost < INSCRIBED
