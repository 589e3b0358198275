"""Sends robots that want to their docks in front of them, by missions."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Refusal
from fog_runtime import logs
from fog_runtime.stores.redis_connection import StoreError
from planner.stops import Order
from planner.store import NO_MISSION, MissionConflictError, OutOfServiceError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from fog_contracts.messages import Pose, RobotGoal, RobotState
    from planner.store import StoredGoal

    Send = Callable[[Order], Awaitable[StoredGoal | Refusal]]
    """Gives a robot a mission, or returns why there is none; may raise `StoreError`."""

_log = logs.get("planner")

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


class DockMissions:
    """Gives missions for docks, one at a time for each robot."""

    def __init__(self, staging: Mapping[str, Pose], send: Send) -> None:
        """`staging`: by robot, the pose in front of its dock."""
        self._goals = DockGoals(staging)
        self._send = send
        self._tasks: set[asyncio.Task[None]] = set()

    def on_state(self, robot: str, state: RobotState, goal: RobotGoal | None, now: float) -> None:
        """Send the robot, which has just published its state, in front of its dock if it wants to and is not sent."""
        pose = self._goals.due(robot, state, goal, now)
        if pose is not None:
            replaced = NO_MISSION if goal is None else goal.goal_id
            task = asyncio.get_running_loop().create_task(self._give(robot, pose, replaced), name="dock")
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _give(self, robot: str, pose: Pose, replaced: str) -> None:
        try:
            outcome = await self._send(Order(robot, pose, f"robot {robot}, to its dock", expected=replaced))
        except (MissionConflictError, OutOfServiceError):
            return  # an operator was faster, or keeps it where it is
        except StoreError as error:
            _log.error("dock_goal_failed", robot=robot, reason=str(error))
            return
        if isinstance(outcome, Refusal):
            _log.warning("dock_goal_refused", robot=robot, reason=outcome.reason)
