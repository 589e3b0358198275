"""Recovers a robot that gets no further on its path: which move is due, from progress, trail and path."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.localization.pose import wrap
from robot_agent.motion.path_follower import at_speed
from robot_agent.motion.recovery import Recovery, Situation, step
from robot_agent.motion.recovery_moves import RecoveryMove
from robot_agent.motion.trail import Trail

if TYPE_CHECKING:
    from robot_agent.localization.pose import Pose2
    from robot_agent.motion.local_planner import Decision
    from robot_agent.motion.path_follower import PathFollower

_AIM_M: Final = 0.3
"""The robot turns towards the point of its path this far ahead."""


class Recoveries:
    """The recovery of one robot, and the trail that it backs up along."""

    def __init__(self) -> None:
        self._state = Recovery()
        self._trail = Trail()
        self._refused = False

    def reset(self) -> None:
        """Forget trail and moves: the robot is stopped, and may be moved by others meanwhile."""
        self._state = Recovery()
        self._trail.clear()
        self._refused = False

    def due(self, follower: PathFollower, pose: Pose2, odom: Pose2, cap: float, now: float) -> RecoveryMove | None:
        """Return the move to make now, None to follow the path; call it with each decision.

        pose, odom: the robot in `map` and `odom`. cap: the fastest that it may go (m/s). now: s, monotonic. While a
        move runs, the time without progress does not count.
        """
        self._trail.add(odom)
        points, _ = follower.released_ahead(_AIM_M)
        heading = math.atan2(points[-1][1] - pose.y, points[-1][0] - pose.x)
        seen = Situation(
            place=(odom.x, odom.y),
            stuck_for=follower.stuck_for(now) * at_speed(cap),
            error=wrap(heading - pose.theta),
            trail=self._trail.length,
            refused=self._refused,
        )
        self._state, self._refused = step(self._state, seen, now), False
        if self._state.running is None:
            return None
        follower.restart_progress_timer(now)
        if self._state.running.kind == "turn":
            return RecoveryMove(heading=heading)
        return RecoveryMove(trail=pose.transform(self._trail.behind(odom)))

    def on_decision(self, decision: Decision) -> None:
        """Record whether the move that runs could be made."""
        self._refused = self._state.running is not None and decision.blocked is not None
