"""Goals of robots that want to their docks: the pose in front of it, from which the base finds it by itself. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.messages import Pose, RobotGoal, RobotState

PAUSE_S: Final = 2.0
"""A goal takes a moment to be stored and set; until then it is not given again."""


class DockGoals:
    """Which robot is to be sent to the front of its dock; `now` is s of a monotonic clock."""

    def __init__(self, staging: Mapping[str, Pose]) -> None:
        """`staging`: by robot, the pose (frame `map`) in front of its dock."""
        self._staging = staging
        self._sent_at: dict[str, float] = {}

    def due(self, robot: str, state: RobotState, goal: RobotGoal | None, now: float) -> Pose | None:
        """Return the pose to send a robot to that has just published its state; None when it needs no other goal.

        A state from before the robot heard of its mission, or of the end of it, tells nothing: an operator who has sent
        it elsewhere meanwhile would be overruled.
        """
        pose = self._staging.get(robot)
        if pose is None or not state.wants_dock or (goal is not None and goal.pose == pose):
            return None
        if state.goal_id != (None if goal is None else goal.goal_id):
            return None
        if now - self._sent_at.get(robot, -math.inf) < PAUSE_S:
            return None
        self._sent_at[robot] = now
        return pose
