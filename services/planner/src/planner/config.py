"""The parameters of the planner's core."""

from dataclasses import dataclass

from fog_contracts.channels import MAP_HEARTBEAT, ROBOT_GOAL, ROBOT_PATH, ROBOT_POSE
from fog_contracts.costs import DEFAULT_INFLATION, Inflation


@dataclass(frozen=True)
class PlannerConfig:
    """Lengths in m, times in s. `inflation` should equal the map-service's, which makes the search faster."""

    inflation: Inflation = DEFAULT_INFLATION
    corridor_half_width: float = 0.72
    """Half the width of the swept corridor: the robot's radius and the inflation band."""
    min_saving: float = 0.10
    """After a clearing, a path is replaced when another saves this share of the remaining cost."""
    hysteresis: float = 0.03
    """A passable path is replaced only when another saves this share, so that plans don't oscillate."""
    max_deviation: float = 1.0
    """Farther from its path, a robot gets a new one."""
    escape_distance: float = 0.5
    """How far a robot on an impassable cell may be from the nearest traversable one."""
    point_spacing: float = 0.10
    release_length: float = 15.0
    """How far ahead the path is released: the robot may drive this far without a message from the planner."""
    republish_s: float = ROBOT_PATH.period_s
    goal_republish_s: float = ROBOT_GOAL.period_s
    max_pose_age_s: float = 3.0 * ROBOT_POSE.max_age_s
    """Nothing is planned for a robot whose last pose is older: it is disconnected.

    This is longer than a pose counts as fresh: meanwhile a robot moves less than `max_deviation`, so its path still
    fits, while a pause in publishing would slow it down after every short loss of its radio link.
    """
    max_map_age_s: float = MAP_HEARTBEAT.max_age_s
    delta_grace_s: float = 0.5
    """How long a heartbeat may be ahead of the deltas before a snapshot is fetched."""
    max_expansions: int = 50_000_000
    max_goal_fields: int = 8
    """For how many goals a distance field is kept (20 to 30 MB each on 2000 x 1200 cells)."""
    max_egress_cells: int = 40_000
    """How many cells (100 m2 at 5 cm) an egress search expands at most."""
