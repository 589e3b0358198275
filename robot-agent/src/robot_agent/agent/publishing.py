"""When the robot tells what of itself: its pose at 10 Hz, its state on change and at 1 Hz, obstacles at 1 Hz."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.messages import Message, RobotObstacles, RobotPose, RobotState

POSE_S: Final = ch.ROBOT_POSE.period_s
STATE_S: Final = ch.ROBOT_STATE.period_s
OBSTACLES_S: Final = ch.ROBOT_OBSTACLES.period_s
_SLACK_S: Final = 0.05
"""A tick that comes early by so much is due already: ticks are 0.1 s apart, and not exactly."""
_NUMBER: Final = re.compile(r"[\d.]+")


class PublishingPolicy:
    """Chooses at each tick (s, monotonic) what is published."""

    def __init__(self, robot: str) -> None:
        self._ids = {"robot": robot}
        self._pose_due = self._state_at = self._obstacles_at = -math.inf
        self._content: object = None

    def choose(
        self, pose: RobotPose | None, state: RobotState, obstacles: Callable[[], RobotObstacles | None], now: float
    ) -> list[Publication]:
        """Return what is due; `obstacles` is called only when a report of them is."""
        due: list[tuple[ch.Channel, Message]] = []
        if pose is not None and now >= self._pose_due - _SLACK_S:
            # Counted from when it was due, so that uneven ticks keep the rate.
            self._pose_due = max(self._pose_due, now - _SLACK_S) + POSE_S
            due.append((ch.ROBOT_POSE, pose))
        content = _content(state)
        if content != self._content or now - self._state_at >= STATE_S - _SLACK_S:
            self._content, self._state_at = content, now
            due.append((ch.ROBOT_STATE, state))
        if now - self._obstacles_at >= OBSTACLES_S - _SLACK_S:
            self._obstacles_at = now
            report = obstacles()
            if report is not None:
                due.append((ch.ROBOT_OBSTACLES, report))
        return [Publication(channel, message, self._ids) for channel, message in due]


def _content(state: RobotState) -> object:
    """Return what makes a state worth publishing at once: all but figures that change all the time."""
    return (
        state.mode,
        state.enabled,
        state.goal_id,
        state.goal_reached,
        state.plan_id,
        state.planner_epoch,
        state.map_epoch,
        state.map_seq,
        len(state.traces),
        tuple(_NUMBER.sub("", reason) for reason in state.reasons),
    )
