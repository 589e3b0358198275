"""What the planner's core can be told."""

from dataclasses import dataclass

from fog_contracts.channels import MAP_HEARTBEAT, ROBOT_GOAL, ROBOT_PATH, ROBOT_STATE
from fog_contracts.costs import DEFAULT_INFLATION, Inflation


@dataclass(frozen=True)
class PlannerConfig:
    """Lengths in m, times in s. The inflation is the map-service's; it only makes the search faster."""

    inflation: Inflation = DEFAULT_INFLATION
    corridor: float = 0.72
    """Half the width of the swept corridor: the robot's radius and the inflation band."""
    saving: float = 0.10
    """A cheaper path elsewhere is taken when it saves this share of the remaining cost."""
    hysteresis: float = 0.03
    """A path that is still passable is kept unless another saves this share, so that no robot dithers between two."""
    stray: float = 1.0
    escape: float = 0.5
    """How far a robot inside the inscribed band may be from the nearest cell where it could be."""
    spacing: float = 0.10
    release: float = 15.0
    """How much of the path ahead of the robot it may drive without hearing from the planner again."""
    republish_s: float = ROBOT_PATH.period_s
    goal_republish_s: float = ROBOT_GOAL.period_s
    robot_silent_s: float = ROBOT_STATE.max_age_s
    """Nothing is planned for a robot whose last pose is older: it is away, and hears nothing either."""
    map_age_s: float = MAP_HEARTBEAT.max_age_s
    gap_s: float = 0.5
    """How long a heartbeat may run ahead of the deltas before the map is fetched whole."""
    max_expansions: int = 50_000_000
    goal_fields: int = 8
    """Goals for which a distance field is kept (20 to 30 MB each on 2000 x 1200 cells)."""
    egress_cells: int = 40_000
    """Cells (100 m2 at 5 cm) that a search for a way out of a blocked area looks at."""
