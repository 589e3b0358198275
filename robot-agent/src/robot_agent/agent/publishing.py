"""When the robot publishes: pose at 10 Hz, standing at 2.5 Hz, state on change and at 1 Hz, obstacles at 1 Hz.

An obstacle that bars its way is published at once.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.messages import Message, RobotObstacles, RobotPose, RobotState

POSE_S: Final = ch.ROBOT_POSE.period_s
STANDING_POSE_S: Final = ch.ROBOT_POSE.idle_period_s
"""Period of the same pose again: others use it for long enough that one message may be lost, and another late."""
STATE_S: Final = ch.ROBOT_STATE.period_s
OBSTACLES_S: Final = ch.ROBOT_OBSTACLES.period_s
_SLACK_S: Final = 0.05
"""A message is published up to this much before it is due: ticks are not exactly 0.1 s apart."""
_NUMBER: Final = re.compile(r"[\d.]+")


class PublishingPolicy:
    """Selects at each tick (s, monotonic) what is published."""

    def __init__(self, robot: str) -> None:
        self._ids = {"robot": robot}
        self._pose_due = self._standing_due = self._state_at = self._obstacles_at = -math.inf
        self._content: object = None

    def due(
        self,
        pose: Callable[[], RobotPose | None],
        state: RobotState,
        obstacles: Callable[[], RobotObstacles | None],
        now: float,
        *,
        barred: bool = False,
        standing: bool = False,
    ) -> list[Publication]:
        """Return the publications that are due; `pose` and `obstacles` are called only when they are due.

        `barred`: an obstacle on the path ahead must be reported at once. `standing`: the robot knows where it is, and
        neither moves nor is about to. Its pose is published at once when it begins to move, and with each change of its
        state: it may just have found out that it is elsewhere.
        """
        messages: list[tuple[ch.Channel, Message]] = []
        content = _content(state)
        changed = content != self._content
        due = self._pose_due
        if standing:
            due = now if changed else self._standing_due
        if now >= due - _SLACK_S and (found := pose()) is not None:
            # Counted from when it was due, so that uneven ticks keep the rate.
            begun = max(due, now - _SLACK_S)
            self._pose_due, self._standing_due = begun + POSE_S, begun + STANDING_POSE_S
            messages.append((ch.ROBOT_POSE, found))
        if changed or now - self._state_at >= STATE_S - _SLACK_S:
            self._content, self._state_at = content, now
            messages.append((ch.ROBOT_STATE, state))
        if barred or now - self._obstacles_at >= OBSTACLES_S - _SLACK_S:
            self._obstacles_at = now
            report = obstacles()
            if report is not None:
                messages.append((ch.ROBOT_OBSTACLES, report))
        return [Publication(channel, message, self._ids) for channel, message in messages]


def _content(state: RobotState) -> object:
    """Return the part of a state whose change is published at once: all but continuously changing numbers."""
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
        tuple(map(_without_numbers, state.reasons)),
    )


@lru_cache(maxsize=64)
def _without_numbers(reason: str) -> str:
    return _NUMBER.sub("", reason)
