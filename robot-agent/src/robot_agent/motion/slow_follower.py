"""Following a line slowly, without regard to the map: turn in place towards it, then drive along it (pure pursuit).

For movements on which the map's costs must not count, such as out of a blocked area. The safety gate caps the speed,
and the stop field guards against what the lidar sees.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from robot_agent.hardware import Twist
from robot_agent.localization.pose import wrap

if TYPE_CHECKING:
    from robot_agent.localization.pose import Pose2
    from robot_agent.motion.path_follower import PathFollower

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
