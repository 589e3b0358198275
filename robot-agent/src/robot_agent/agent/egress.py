"""The way out of a blocked area, on an operator's command: asked of the planner, then driven slowly.

The safety gate decides whether the robot may move (`robot_agent.safety.maneuver`); the stop field guards each command.
The map's costs must not count there, so the way is followed without regard to them: turn in place towards it, then
drive along it (pure pursuit).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.geometry import PATH_SPACING_M, sampled
from fog_contracts.messages import EgressRequest, Pose
from robot_agent.hardware import Twist
from robot_agent.localization.pose import wrap
from robot_agent.motion.local_planner import turning_at_most, wheels
from robot_agent.motion.path_follower import PathFollower

if TYPE_CHECKING:
    from fog_contracts.messages import PlanReply
    from robot_agent.config import AgentConfig
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.gate import SafetyOutputs
    from robot_agent.safety.stop_field import Wheels

_LOOKAHEAD_M: Final = 0.25
_TURN_FROM_RAD: Final = 0.35
"""With a larger error of its heading the robot turns in place."""
_TURN_MAX_RAD_S: Final = 0.8
_GAIN_PER_S: Final = 2.0


def follow_slowly(follower: PathFollower, pose: Pose2, speed: float) -> Twist:
    """Return the motion (m/s, rad/s) of a robot at `pose` (frame `map`) along the path, at most at `speed` (m/s)."""
    points, _ = follower.released_ahead(_LOOKAHEAD_M)
    x, y = points[-1]
    error = wrap(math.atan2(y - pose.y, x - pose.x) - pose.theta)
    w = min(max(_GAIN_PER_S * error, -_TURN_MAX_RAD_S), _TURN_MAX_RAD_S)
    if abs(error) > _TURN_FROM_RAD:
        return Twist(0.0, w)
    return Twist(speed * math.cos(error), w)


_ASK_AGAIN_S: Final = 1.0
"""Pause before the planner is asked again, after it gave no way out or did not answer."""
_FROM_HERE_M: Final = 0.25
"""A way out that was asked for within so much of where the robot is begins here: farther than its pose's noise and what
it still rolls, no farther than it looks ahead on the way."""


class Egress:
    """The way out, while the robot is on it. `now` is s of the robot's monotonic clock."""

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self._follower: PathFollower | None = None
        self._problem: str | None = None
        self._ask_at = -math.inf
        self._asked: list[EgressRequest] = []

    def begin(self) -> None:
        """Forget the way out of an earlier egress, and what was asked for it: replies to that may still come."""
        self._follower = self._problem = None
        self._ask_at = -math.inf
        self._asked.clear()

    def request(self, pose: Pose2 | None, safety: SafetyOutputs, now: float) -> EgressRequest | None:
        """Return the query to send to the planner now; None when none is due."""
        if safety.mode != "EGRESS" or self._follower is not None or pose is None or now < self._ask_at:
            return None
        self._ask_at = now + _ASK_AGAIN_S
        request = EgressRequest(robot=self._config.robot, pose=Pose(x=pose.x, y=pose.y, theta=pose.theta))
        self._asked.append(request)
        return request

    def on_reply(self, request: EgressRequest, reply: PlanReply | None, pose: Pose2 | None, now: float) -> None:
        """Handle the planner's reply to a request; None when it did not answer.

        It may take seconds, in which the robot is moved, ends this egress and begins another. A way out that does not
        begin where the robot is now is not followed; the next request asks for one that does.
        """
        if self._follower is not None or request not in self._asked:
            return
        if reply is None:
            self._problem = "the planner does not answer"
        elif pose is None:
            self._problem = "the robot does not know where it is"
        elif (moved := math.hypot(pose.x - request.pose.x, pose.y - request.pose.y)) > _FROM_HERE_M:
            self._problem = f"the robot is {moved:.1f} m from where it asked the planner for a way out, and asks again"
        elif reply.refusal is not None:
            self._problem = reply.refusal.reason
        elif len(reply.points) > 1:
            self._problem = None
            corners = np.array(reply.points, dtype=np.float64)
            self._follower = PathFollower(sampled(corners, PATH_SPACING_M), math.inf)
            self._follower.advance(pose.x, pose.y, now)

    def advance(self, pose: Pose2 | None, now: float) -> None:
        """Update the robot's place on the way out."""
        if self._follower is not None and pose is not None:
            self._follower.advance(pose.x, pose.y, now)

    @property
    def remaining(self) -> float:
        """Metres to the end of the way out, by way of its nearest point; infinite while there is none."""
        follower = self._follower
        return math.inf if follower is None else follower.remaining + follower.distance

    def problem(self, limited: str | None) -> str | None:
        """Return what keeps the robot from the way out; `limited`: why its wheels are stopped."""
        return self._problem or limited

    def wheels(self, pose: Pose2 | None) -> Wheels:
        """Return the wheel speeds (m/s) along the way out; zero while there is none."""
        if self._follower is None or pose is None:
            return 0.0, 0.0
        motion = follow_slowly(self._follower, pose, self._config.safety.speed_egress)
        v, w = turning_at_most(motion.v, motion.w, self._config.motion.limits.w_max)
        return wheels(v, w, self._config.drive_train.axle_m)
