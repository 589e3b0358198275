"""The parameters of the planner's core."""

from dataclasses import dataclass
from typing import Literal

from fog_contracts.channels import MAP_HEARTBEAT, ROBOT_GOAL, ROBOT_POSE, ROBOT_RELEASE
from fog_contracts.costs import DEFAULT_INFLATION, Inflation
from fog_contracts.geometry import PATH_SPACING_M
from fog_contracts.messages import MAX_CELLS

WaitMode = Literal["off", "learned", "always"]
"""Whether robots wait: never; where enough blocks were seen to end by themselves; or by assumptions alone, too."""


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
    point_spacing: float = PATH_SPACING_M
    release_length: float = 15.0
    """How far ahead the path is released: the robot may drive this far without a message from the planner."""
    release_period_s: float = ROBOT_RELEASE.period_s
    path_retry_s: float = 1.0
    """How often a path is published again while the robot's state does not name its plan."""
    goal_retry_s: float = 1.0
    """How often a goal, or its end, is published again while the robot's state does not agree."""
    goal_repeat_s: float = ROBOT_GOAL.period_s
    """How often it is published when the robot has it: for consoles that connect later."""
    max_pose_age_s: float = 3.0 * ROBOT_POSE.max_age_s
    """Nothing is planned for a robot whose last pose is older: it is disconnected.

    This is longer than a pose counts as fresh: meanwhile a robot moves less than `max_deviation`, so its path still
    fits, while a pause in publishing would slow it down after every short loss of its radio link.
    """
    max_map_age_s: float = MAP_HEARTBEAT.max_age_s
    delta_grace_s: float = 0.5
    """How long a heartbeat may be ahead of the deltas before a snapshot is fetched."""
    max_expansions: int = 2 * MAX_CELLS
    """More than a search expands on the largest map; fewer would refuse goals there that can be reached."""
    unguided_expansions: int = 20_000_000
    """More cells are not expanded (0.7 s) for a robot whose goal has no distance field yet: it is refused so long."""
    quick_expansions: int = 20_000
    """After so many expanded cells (0.6 ms) a search first asks whether the goal can be reached at all ..."""
    detour_searches: int = 3
    """... and, if at least so many others wait, has a bound of the way round computed for all of them.

    Then paths are sent as they are found: nothing is done to make them a little cheaper.
    """
    second_expansions: int = 300_000
    """Searches for a cheaper way past things expand no more cells (9 ms) together: where nothing hurries, or waits."""
    standing_s: float = 60.0
    """What has stayed on the map for so long, zones above all, is in the distance fields, too."""
    goal_fields_bytes: int = 40_000_000
    """The memory of all goals' distance fields together."""
    landmark_bytes: int = 10_000_000
    """That of the landmarks' fields, which guide searches to goals that have none yet."""
    refused_retry_s: float = 1.0
    """A refused robot gets a new search at most this often, and only after a cost fell or the robot moved."""
    explain_period_s: float = 1.0
    """How often the reason of a refusal is looked for again while the map changes."""
    switch_dwell_s: float = 2.0
    """After a robot's path was moved to another way, the time before it is moved again although it is passable.

    It doubles with each switch that follows another within a minute, up to `max_switch_dwell_s`.
    """
    max_switch_dwell_s: float = 30.0
    wait: WaitMode = "learned"
    """Whether robots wait before what closes their way, if that is expected to take less time than the way round."""
    time_in_cost: bool = True
    """Whether a path costs the time that speed limits take, so that a slow place is gone round when that is quicker."""
    cruise_speed: float = 0.26
    """How fast (m/s) a robot gets on along its path, on average."""
