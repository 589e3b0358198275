"""Ways round what is blocked for robots of others that tell where they go: `/ROBOT/fognav/advice`.

A goal is the last `/ROBOT/goal_pose`, or the end of the robot's own `/ROBOT/plan`. The way is the planner's for a robot
of Fognav, from where the robot is; nobody makes it drive that way. An empty one says that there is none, or no goal any
more. It is told once a second.
"""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_bridges.floor import Request
from fog_bridges.ros2 import messages as ros
from fog_bridges.ros2.others import check_frame, is_finite
from fog_bridges.ros2.wire import RosMessage, Topic, WireError
from fog_runtime import logs
from fog_runtime.clock import ticker

if TYPE_CHECKING:
    from fog_bridges.floor import Floor
    from fog_bridges.ros2.dds import DdsSession
    from fog_bridges.ros2.others import Others
    from fog_bridges.ros2.session import RosSession
    from fog_contracts.messages import PointXY
    from fog_runtime.clock import Clock

GOAL_TYPE: Final = "geometry_msgs/msg/PoseStamped"
PATH_TYPE: Final = "nav_msgs/msg/Path"
PERIOD_S: Final = 1.0
THERE_M: Final = 0.3
"""So near its goal a robot has reached it."""
GOAL_MAX_AGE_S: Final = 600.0
"""A goal that nobody has told again for so long is forgotten: that a robot has given it up, no topic says."""
RADIUS_MAX_M: Final = 0.25
"""The planner's ways are wide enough for robots of Fognav, and lead out of a robot's own place so far only."""
_log = logs.get("ros2")


class Advice:
    """The goals of robots of others, and the ways there."""

    def __init__(self, session: RosSession | DdsSession, floor: Floor, clock: Clock, others: Others) -> None:
        """Hear of goals, and tell ways, on `session`; ask `floor` for them."""
        self._session, self._floor, self._clock, self._others = session, floor, clock, others
        self._goals: dict[str, tuple[PointXY, float]] = {}
        self._advised: set[str] = set()
        self._limited = logs.RateLimited(_log)

    def subscribe(self) -> None:
        """Register subscriptions."""
        for name, radius in self._others.radii.items():
            if radius <= RADIUS_MAX_M:
                self._session.subscribe(Topic(f"{name}/goal_pose", GOAL_TYPE), partial(self._on_goal, name))
                self._session.subscribe(Topic(f"{name}/plan", PATH_TYPE), partial(self._on_plan, name))

    def _on_goal(self, name: str, told: RosMessage) -> None:
        self._take(name, told.header.frame_id, told.pose.position)

    def _on_plan(self, name: str, told: RosMessage) -> None:
        if told.poses:
            last = told.poses[-1]
            self._take(name, last.header.frame_id or told.header.frame_id, last.pose.position)

    def _take(self, name: str, frame: str, at: RosMessage) -> None:
        check_frame(frame)
        if not is_finite(at.x, at.y):
            raise WireError(f"a goal at ({at.x}, {at.y})")
        self._goals[name] = (at.x, at.y), self._clock.now()

    async def loop(self) -> None:
        """Tell each robot that has a goal the way there; never ends."""
        async for now in ticker(self._clock, PERIOD_S):
            for name in self._others.radii:
                points = await self._way(name, now)
                if points or name in self._advised:
                    (self._advised.add if points else self._advised.discard)(name)
                    stamp = self._clock.stamp()
                    self._session.publish(Topic(f"{name}/fognav/advice", PATH_TYPE), ros.way(points, stamp), stamp)

    async def _way(self, name: str, now: float) -> list[PointXY]:
        """Return the corners of a robot's way; empty without a goal, or any way there."""
        at, (goal, told_at) = self._others.at(name, now), self._goals.get(name, ((0.0, 0.0), -math.inf))
        if now - told_at > GOAL_MAX_AGE_S or at is None:
            return []
        if math.dist(at, goal) < THERE_M:
            self._goals.pop(name, None)
            return []
        poses = {key: {"x": x, "y": y, "theta": 0.0} for key, (x, y) in (("start", at), ("goal", goal))}
        answer = await self._floor.ask(Request("POST", "/api/v1/plan", poses))
        refusal = answer.refusal or (answer.body.get("refusal") or {}).get("reason", "")
        if refusal:
            self._limited.info("no_advice", name, now, robot=name, reason=refusal)
            return []
        return [(x, y) for x, y in answer.body.get("points", ())]
